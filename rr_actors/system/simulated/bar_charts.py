"""Bar charts of parts of a whole, as SVG. They need no other program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rr_actors.base.notebook import escape

_WIDTH, _BAR, _ROW, _CHARACTER, _PAD = 900, 480, 24, 6.7, 8


class Bar(NamedTuple):
    """A bar from 0 to `part`, 1 at most, a line at `mark`, a label before it and a text behind it."""

    label: str
    part: float
    mark: float
    text: str


def bar_chart(bars: Sequence[Bar], title: str) -> str:
    """Return an SVG document with a bar in each row, all on one scale from 0 to 1."""
    left = min(_WIDTH - _BAR - 90, max((len(bar.label) for bar in bars), default=0) * _CHARACTER) + 2 * _PAD
    height = (len(bars) + 1) * _ROW + 2 * _PAD
    rows = [_row(bar, left, _PAD + (index + 1) * _ROW) for index, bar in enumerate(bars)]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" '
        f'height="{height}" font-family="system-ui, sans-serif" font-size="12"><title>{escape(title)}</title>'
        f'<rect width="100%" height="100%" fill="#ffffff"/>'
        f'<text x="{_PAD}" y="{_PAD + 12}" fill="#5b6b73">{escape(title)}</text>{"".join(rows)}</svg>'
    )


def _row(bar: Bar, left: float, top: float) -> str:
    middle, full, mark = top + _ROW - 9, _BAR * bar.part, left + _BAR * bar.mark
    return (
        f'<text x="{left - _PAD:.1f}" y="{middle}" text-anchor="end" fill="#1c2529">{escape(bar.label)}</text>'
        f'<rect x="{left:.1f}" y="{top + 4}" width="{_BAR}" height="{_ROW - 8}" fill="#eef1f3"/>'
        f'<rect x="{left:.1f}" y="{top + 4}" width="{full:.1f}" height="{_ROW - 8}" fill="#2f6fa3"/>'
        f'<path d="M{mark:.1f} {top + 2}v{_ROW - 4}" stroke="#c1440e" stroke-width="2"/>'
        f'<text x="{left + _BAR + _PAD:.1f}" y="{middle}" fill="#1c2529">{escape(bar.text)}</text>'
    )
