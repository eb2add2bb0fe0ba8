"""Curves: the figures of each child over the last ten minutes, as small SVG pictures."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rr_actors.base.notebook import escape
from rr_actors.system.console.console_messages import ChildRow, RegistrarRow
from rr_actors.tools.tables.child_tables import Figures, TreeTables

STEP_S = 5.0
STEPS = 120
"""Points of a curve, each for five seconds."""
_LEAST_S = 1.0  # between two looks: to read the usage of a thousand processes takes 0.06 s
_CHILDREN = 1000  # of which figures are kept
_WIDTH, _HEIGHT = STEPS, 32


@dataclass(frozen=True)
class _Kind:
    """A figure: its name, its text, and the least height of its curve, so that little makes no mountains."""

    name: str
    text: str
    least: float

    def said(self, value: float) -> str:
        return self.text.format(value)


_KINDS = (
    _Kind("CPU", "{:.1f} %", 10.0),
    _Kind("memory", "{:.0f} MiB", 10.0),
    _Kind("mailbox", "{:.0f}", 5.0),
    _Kind("resources", "{:.0f}", 5.0),
    _Kind("loads", "{:.1f}/s", 1.0),
)


@dataclass(frozen=True)
class Curve:
    """One figure of a child: its values, the oldest first; None where nobody looked."""

    kind: _Kind
    values: Sequence[float | None]

    @property
    def now(self) -> str:
        """The newest value, as text; "" if there is none of the last steps."""
        newest = next((value for value in self.values[:-4:-1] if value is not None), None)
        return "" if newest is None else self.kind.said(newest)

    def svg(self, path: str) -> str:
        """Return the picture, which says what it shows to those who cannot see it."""
        most = max([self.kind.least, *filter(None, self.values)])
        highest = self.kind.said(max(filter(None, self.values), default=0.0))
        said = f"{self.kind.name} of {path}: now {self.now or 'unknown'}, at most {highest}"
        return (
            f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none" role="img" aria-label="{escape(said)}">'
            f'<path d="{"".join(self._strokes(most))}"/></svg>'
        )

    def _strokes(self, most: float) -> Iterator[str]:
        """Yield the strokes of a line, which has gaps where nobody looked."""
        before: float | None = None
        for x, value in enumerate(self.values):
            if value is not None:
                y = _HEIGHT - 1 - round((_HEIGHT - 2) * value / most)
                yield f"{'M' if before is None else 'L'}{x} {y}h1"
            before = value


class FigureCurves:
    """The figures of the children of one system. take() is called by one thread, the rest by any."""

    def __init__(self) -> None:
        self._tree = TreeTables()
        self._points: dict[str, dict[str, deque[tuple[int, float]]]] = {}
        self._taken_at = -_LEAST_S
        self.step = 0  # that the newest figures are of

    def take(self, children: Sequence[ChildRow], registrars: Sequence[RegistrarRow]) -> None:
        """Take the figures of a moment; do nothing if the last ones are not a second old."""
        if (now := time.monotonic()) < self._taken_at + _LEAST_S:
            return
        self._taken_at, step = now, int(now // STEP_S)
        counts = {row.name: row.counts for row in registrars}
        kept = {row.path: self._points.get(row.path, {}) for row in children[:_CHILDREN]}
        for of in self._tree.figures(children[:_CHILDREN], counts, as_path=True):
            for name, value in _values(of):
                _add(kept[of.row.path].setdefault(name, deque(maxlen=STEPS)), step, value)
        self._points, self.step = kept, step

    def curves(self, match: str = "", limit: int = _CHILDREN) -> dict[str, list[Curve]]:
        """Return the curves of the first children with the text `match` in their paths, by path."""
        points, last = self._points, self.step
        found = [path for path in points if match in path][:limit]
        return {
            path: [_curve(kind, points[path][kind.name], last) for kind in _KINDS if kind.name in points[path]]
            for path in found
        }


def _values(of: Figures) -> Iterator[tuple[str, float]]:
    """Yield the figures of a child that are known."""
    if of.usage is not None:
        yield from (("CPU", of.usage.cpu_percent), ("memory", of.usage.memory_bytes / 2**20))
    yield from ((key, float(of.counts[key])) for key in ("mailbox", "resources") if key in of.counts)
    if of.loads is not None:
        yield "loads", of.loads


def _add(points: deque[tuple[int, float]], step: int, value: float) -> None:
    """Add a value; of several in one step the highest stays."""
    if points and points[-1][0] == step:
        value = max(value, points.pop()[1])
    points.append((step, value))


def _curve(kind: _Kind, points: deque[tuple[int, float]], last: int) -> Curve:
    known = dict(points.copy())
    return Curve(kind, [known.get(step) for step in range(last - STEPS + 1, last + 1)])
