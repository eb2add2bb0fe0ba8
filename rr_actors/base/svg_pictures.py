"""SVG pictures of trees and graphs: boxes from left to right, and lines between them. They need no other program.

Each box has its place in a tree: below the first box with a line to it. The other lines are dashed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import msgspec

from rr_actors.base.notebook import escape

MOST = 500
"""The most boxes of a picture; its last line counts the boxes that are left out."""

_CHARACTER = 6.7  # pixels, of the font
_LINE = 15
_PAD = 8
_GAP_X, _GAP_Y = 36, 10
_WIDEST = 44  # characters of a line
_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


class Box(msgspec.Struct, frozen=True):
    """A box: its lines of text, its colour, and whether its corners are round."""

    lines: Sequence[str]
    fill: str = "#ffffff"
    is_round: bool = False


class _Place(msgspec.Struct):
    x: float
    y: float
    width: float
    height: float


def draw(boxes: Mapping[str, Box], edges: Sequence[tuple[str, str]]) -> str:
    """Return an SVG document of these boxes, by their names, and of lines from box to box.

    Rings are drawn, too: a line that leads back is dashed.
    """
    left_out = len(boxes) - MOST
    shown = dict(list(boxes.items())[:MOST])
    lines = [(above, below) for above, below in dict.fromkeys(edges) if above in shown and below in shown]
    below = _tree(shown, lines)
    places = _places(shown, below)
    width = max((place.x + place.width for place in places.values()), default=0) + _PAD
    height = max((place.y + place.height for place in places.values()), default=0) + _PAD
    note = ""
    if left_out > 0:
        height += 2 * _LINE
        note = f'<text x="{_PAD}" y="{height - _LINE:.0f}">{left_out} more are left out</text>'
    in_tree = {(above, child) for above, children in below.items() for child in children}
    parts = [_line(places[above], places[child], dashed=(above, child) not in in_tree) for above, child in lines]
    parts += [_box(shown[name], place) for name, place in places.items()]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="ui-monospace, monospace" font-size="11">'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{"".join(parts)}{note}</svg>'
    )


def _tree(boxes: Mapping[str, Box], edges: Sequence[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the boxes below each box. A box is below the first box with a line to it that is not below the box."""
    above: dict[str, str] = {}
    below: dict[str, list[str]] = {name: [] for name in boxes}
    for parent, child in edges:
        if child not in above and not _is_below(parent, child, above):
            above[child] = parent
            below[parent].append(child)
    return below


def _is_below(name: str, other: str, above: Mapping[str, str]) -> bool:
    """Return whether the box `name` is the box `other`, or below it."""
    place: str | None = name
    while place is not None:
        if place == other:
            return True
        place = above.get(place)
    return False


def _places(boxes: Mapping[str, Box], below: Mapping[str, list[str]]) -> dict[str, _Place]:
    sizes = {name: _size(box) for name, box in boxes.items()}
    children = {child for inner in below.values() for child in inner}
    depths: dict[str, int] = {}
    order: list[str] = []
    ahead = [(name, 0) for name in reversed(list(boxes)) if name not in children]
    while ahead:
        name, depth = ahead.pop()
        depths[name] = depth
        order.append(name)
        ahead += [(child, depth + 1) for child in reversed(below[name])]
    columns: dict[int, float] = {}
    for name, depth in depths.items():
        columns[depth] = max(columns.get(depth, 0.0), sizes[name][0])
    starts, x = dict[int, float](), float(_PAD)
    for depth in range(len(columns)):
        starts[depth] = x
        x += columns[depth] + _GAP_X
    places: dict[str, _Place] = {}
    y = float(_PAD)
    for name in order:
        if not below[name]:
            places[name] = _Place(starts[depths[name]], y, *sizes[name])
            y += sizes[name][1] + _GAP_Y
    for name in reversed(order):
        if below[name]:
            first, last = places[below[name][0]], places[below[name][-1]]
            middle = (first.y + last.y + last.height) / 2
            places[name] = _Place(starts[depths[name]], max(_PAD, middle - sizes[name][1] / 2), *sizes[name])
    return {name: places[name] for name in boxes}


def _size(box: Box) -> tuple[float, float]:
    longest = max((len(_cut(line)) for line in box.lines), default=0)
    return longest * _CHARACTER + 2 * _PAD, len(box.lines) * _LINE + _PAD


def _box(box: Box, place: _Place) -> str:
    rounding = place.height / 2 if box.is_round and len(box.lines) == 1 else 12 if box.is_round else 2
    texts = "".join(
        f'<text x="{place.x + _PAD:.1f}" y="{place.y + (number + 1) * _LINE:.1f}"'
        f"{' font-weight=' + chr(34) + 'bold' + chr(34) if not number else ''}>{_text(line)}</text>"
        for number, line in enumerate(box.lines)
    )
    whole = " ".join(box.lines)
    return (
        f'<g><title>{_text(whole, cut=False)}</title><rect x="{place.x:.1f}" y="{place.y:.1f}" '
        f'width="{place.width:.1f}" height="{place.height:.1f}" rx="{rounding:.0f}" '
        f'fill="{escape(box.fill)}" stroke="#555555"/>{texts}</g>'
    )


def _line(start: _Place, end: _Place, *, dashed: bool) -> str:
    x1, y1 = start.x + start.width, start.y + start.height / 2
    x2, y2 = end.x, end.y + end.height / 2
    bend = max(_GAP_X / 2, abs(x2 - x1) / 2)
    dash = ' stroke-dasharray="4 3"' if dashed else ""
    return (
        f'<path d="M{x1:.1f} {y1:.1f} C{x1 + bend:.1f} {y1:.1f} {x2 - bend:.1f} {y2:.1f} {x2:.1f} {y2:.1f}" '
        f'fill="none" stroke="#888888"{dash}/>'
    )


def _cut(line: str) -> str:
    return line if len(line) <= _WIDEST else line[: _WIDEST - 1] + "…"


def _text(line: str, *, cut: bool = True) -> str:
    """Return the text escaped for XML, with a replacement for each character that XML does not allow."""
    return escape(_NOT_XML.sub("�", _cut(line) if cut else line))
