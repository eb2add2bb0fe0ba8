"""Timelines: pictures of what happened, with a lane for each child, a bar for each life, and marks for events.

`import rr_actors` does not load this module: import it where you draw.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable
from typing import Any

import msgspec

from rr_actors.base.errors import counted
from rr_actors.base.names import in_short
from rr_actors.base.notebook import escape
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.event_files import read_events
from rr_actors.system.recording.event_texts import ago, clock
from rr_actors.system.recording.timeline_lanes import (
    BAD,
    KINDS,
    OF_CHILDREN,
    Bar,
    Lane,
    Lanes,
    Mark,
    chosen_lanes,
    merged_bars,
    merged_marks,
)

MOST_LANES = 150
"""The most lanes of an SVG picture. It shows those with the worst marks, and counts the others."""
MOST_SENT_LANES, MOST_SENT = 400, 20_000
"""The most lanes, and the most bars and marks, of a picture that a browser draws."""

_WIDTH, _LABEL, _RIGHT = 1100, 210, 36
_TOP, _ROW = 52, 32
_BAR_PX, _MARK_PX, _LETTER_PX = 3.0, 15.0, 7.0
"""Bars that begin and end within so many pixels are merged. A mark is so wide, and a letter of the count beside it."""
_TICK_PX = 96
_STEPS_S = (
    *(0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0),
    *(900.0, 1800.0, 3600.0, 7200.0, 10_800.0, 21_600.0, 43_200.0, 86_400.0),
)
_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_ROUND = "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0Z"

SHAPES = {
    "gave_up": "M0 -7L6 0H2.5V6H-2.5V0H-6Z",
    "killed": "M-5.5 -3L-3 -5.5L0 -2.5L3 -5.5L5.5 -3L2.5 0L5.5 3L3 5.5L0 2.5L-3 5.5L-5.5 3L-2.5 0Z",
    "crashed": "M0 -6.5L6.5 0L0 6.5L-6.5 0Z",
    "start_failed": "M-6 -5H6L0 6Z",
    "lost": "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0 -10 0ZM-3.5 3.5L3.5 -3.5",
    "failed": "M0 -5.5L5.5 0L0 5.5L-5.5 0Z",
    "ERROR": "M-2 -5H2L5 -2V2L2 5H-2L-5 2V-2Z",
    "WARNING": "M0 -5.5L5.5 4.5H-5.5Z",
    "stopped": "M-4.5 -4.5H4.5V4.5H-4.5Z",
    "restarted": "M-4.5 -6L6 0L-4.5 6Z",
    "started": "M-4.5 -6L6 0L-4.5 6Z",
    "restored": "M-1.5 -5H1.5V-1.5H5V1.5H1.5V5H-1.5V1.5H-5V-1.5H-1.5Z",
    "unloaded": _ROUND,
    "loaded": _ROUND,
    "status": "M-1.5 -5H1.5V5H-1.5Z",
}
"""The outline of each kind of mark: shapes differ, not colours alone."""

_RULES = """\
.rr-tl { color-scheme: light dark; --tl-back: #fff; --tl-text: #1c2529; --tl-dim: #5b6b73; --tl-line: #dde3e6;
  --tl-bar: #8cbfe6; --tl-edge: #2f6fa3; --tl-start: #d6e8f6; --tl-bad: #c1440e; --tl-deep: #8e2a7e; --tl-warn: #b87700;
  --tl-good: #00785a; --tl-fact: #0b5cad; --tl-calm: #6b7780; background: var(--tl-back); }
@media (prefers-color-scheme: dark) { .rr-tl { --tl-back: #15191c; --tl-text: #e4eaed; --tl-dim: #9fb0b9;
  --tl-line: #2f393f; --tl-bar: #2f618c; --tl-edge: #8cc4f2; --tl-start: #223a4e; --tl-bad: #ff8a5c; --tl-deep: #e59adb;
  --tl-warn: #f2b53c; --tl-good: #4fd0a8; --tl-fact: #7db9f5; --tl-calm: #a5b2ba; } }
.rr-tl text { font: 12px system-ui, sans-serif; fill: var(--tl-text); }
.rr-tl .dim { fill: var(--tl-dim); } .rr-tl .small { font-size: 11px; }
.rr-tl .count { font-size: 9px; font-weight: 700; stroke: var(--tl-back); stroke-width: 2; paint-order: stroke; }
.rr-tl .grid { stroke: var(--tl-line); } .rr-tl .back { fill: var(--tl-back); }
.rr-tl .bar { fill: var(--tl-bar); stroke: var(--tl-edge); stroke-width: 0.7; } .rr-tl .many { fill: var(--tl-edge); }
.rr-tl .unknown { stroke-dasharray: 3 2; } .rr-tl .starting { fill: var(--tl-start); }
.rr-tl .mark { fill: var(--tl-calm); stroke: var(--tl-back); stroke-width: 1; paint-order: stroke; }
.rr-tl .k-killed, .rr-tl .k-crashed, .rr-tl .k-start_failed, .rr-tl .k-ERROR { fill: var(--tl-bad); }
.rr-tl .k-gave_up { fill: var(--tl-deep); } .rr-tl .k-WARNING { fill: var(--tl-warn); }
.rr-tl .k-restarted, .rr-tl .k-restored { fill: var(--tl-good); } .rr-tl .k-loaded { fill: var(--tl-fact); }
.rr-tl .k-lost, .rr-tl .k-failed, .rr-tl .k-started, .rr-tl .k-unloaded { fill: var(--tl-back); stroke-width: 1.8;
  paint-order: normal; }
.rr-tl .k-lost, .rr-tl .k-failed { stroke: var(--tl-bad); } .rr-tl .k-started { stroke: var(--tl-good); }
.rr-tl .k-unloaded { stroke: var(--tl-fact); }
"""


def _for_all(rules: str) -> str:
    """Put the light colour before each that is a variable: programs that know no variables take it."""
    light = dict(re.findall(r"(--tl-\w+): (#\w+)", rules.partition("@media")[0]))
    return re.sub(r"([a-z]+): var\((--tl-\w+)\)", lambda use: f"{use[1]}: {light[use[2]]}; {use[0]}", rules)


CSS = _for_all(_RULES)


class Timeline:
    """A picture of what happened, from timeline_of() or read_timeline(). A notebook shows it.

    Attributes:
        since, until: its first and last time, seconds since the epoch.
        lanes: of all children, each supervisor before its own ones.
        title: what it shows, in a word.
        missed: how many entries are missing, as its recording says.
    """

    def __init__(self, lanes: list[Lane], since: float, until: float, title: str = "", missed: int = 0) -> None:
        self.lanes = lanes
        self.since = since
        self.until = max(until, since + 0.001)
        self.title = title
        self.missed = missed

    def as_of(self, at: float) -> Timeline:
        """Return the timeline as it was at a time: without what began or happened later."""
        return Timeline([_as_of(lane, at) for lane in self.lanes], self.since, min(at, self.until), self.title)

    def svg(self) -> str:
        """Return an SVG document, 1,100 pixels wide, with at most 150 lanes.

        Lives and events that are too close to be told apart are one mark, which has their number.
        """
        return _Drawing(self).document()

    def _repr_svg_(self) -> str:
        return self.svg()

    def __repr__(self) -> str:
        lanes = counted(len(self.lanes), "lane")
        return f"<Timeline of {self.title or 'a system'}: {lanes}, {ago(self.until - self.since)}>"

    @property
    def subject(self) -> str:
        """What the picture shows: its title, its time and the number of its lanes."""
        if not self.lanes:
            return f"{self.title}: nothing has happened".removeprefix(": ")
        span_s = self.until - self.since
        span = ago(span_s) if span_s >= 10 else f"{span_s:.1f} s"
        text = f"{clock(self.since)[:-4]} to {clock(self.until)[:-4]} ({span})"
        parts = (
            self.title,
            text,
            counted(len(self.lanes), "lane"),
            f"{counted(self.missed, 'entry')} missed" if self.missed else "",
        )
        return ", ".join(filter(None, parts))

    def plain(self) -> dict[str, Any]:
        """Return plain data, from which a browser draws the picture at any scale.

        At most 400 lanes are in it, and at most 20,000 bars and marks: of more, neighbours are merged and counted.
        """
        lanes = chosen_lanes(self.lanes, MOST_SENT_LANES)
        step_s = 0.0
        while sum(len(lane.bars) + len(lane.marks) for lane in lanes) > MOST_SENT:
            step_s = max(2 * step_s, (self.until - self.since) / MOST_SENT)
            lanes = [_merged(lane, step_s, step_s) for lane in lanes]
        return {
            "subject": self.subject,
            "since": self.since,
            "until": self.until,
            "left_out": len(self.lanes) - len(lanes),
            "lanes": [_plain_lane(lane) for lane in lanes],
        }


def looks() -> dict[str, Any]:
    """Return what a browser needs to draw any timeline: each kind's name, shape, and whether it is about children."""
    return {kind: [name, SHAPES[kind], kind in OF_CHILDREN, kind in BAD] for kind, name in KINDS.items()}


def _as_of(lane: Lane, at: float) -> Lane:
    begun = [bar for bar in lane.bars if bar.begin is None or bar.begin <= at]
    bars = [
        bar if bar.end is not None and bar.end <= at else msgspec.structs.replace(bar, end=None, how="")
        for bar in begun
    ]
    return msgspec.structs.replace(lane, bars=bars, marks=[mark for mark in lane.marks if mark.at <= at])


def timeline_of(entries: Iterable[Entry], title: str = "", missed: int = 0, since: float | None = None) -> Timeline:
    """Return the timeline of a recording's entries, which are in the order of their time.

    It has a lane for each child that an entry names. A child of which nothing was recorded has none.

    Args:
        since: when the recording began, seconds since the epoch. Default: None, with its first entry.
    """
    building = Lanes()
    for entry in entries:
        building.take(entry)
    began = building.began or since or 0.0
    return Timeline(building.lanes(), began if since is None else min(since, began), building.latest, title, missed)


def read_timeline(path: str | os.PathLike[str]) -> Timeline:
    """Return the timeline of a recording, of a state directory, or of the history.jsonl in one.

    A line of a history that is not whole is left out.

    Raises:
        ConfigError: it cannot be read, or is none of these; the error names the line.
    """
    found = read_events(path)
    return timeline_of(found.entries(), found.system, found.missed, None if found.is_history else found.since)


# -- as SVG ------------------------------------------------------------------------------------------------------------


class _Drawing:
    """Draws one timeline."""

    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline
        self._lanes = chosen_lanes(timeline.lanes, MOST_LANES)
        self._plot = _WIDTH - _LABEL - _RIGHT
        self._s_per_px = (timeline.until - timeline.since) / self._plot

    def document(self) -> str:
        timeline = self._timeline
        bottom = _TOP + _ROW * len(self._lanes)
        legend, height = self._legend(bottom + 24)
        left_out = len(timeline.lanes) - len(self._lanes)
        note = f", left out: {counted(left_out, 'lane')} with less trouble" if left_out else ""
        parts = [f'<text x="10" y="19">{_text(timeline.subject + note)}</text>', self._axis(bottom)]
        parts += [self._lane(lane, _TOP + _ROW * number) for number, lane in enumerate(self._lanes)]
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" class="rr-tl" role="img" width="{_WIDTH}" height="{height}" '
            f'viewBox="0 0 {_WIDTH} {height}"><title>{_text(timeline.subject)}</title><style>{CSS}</style>'
            f'<rect class="back" width="{_WIDTH}" height="{height}"/>{"".join(parts)}{legend}</svg>'
        )

    def _x(self, at: float) -> float:
        x = _LABEL + (at - self._timeline.since) / self._s_per_px
        return min(max(x, _LABEL), _WIDTH - _RIGHT)

    def _axis(self, bottom: int) -> str:
        step_s = next((step for step in _STEPS_S if step / self._s_per_px >= _TICK_PX), 0.0)
        if not step_s:
            step_s = 86_400.0 * -(-_TICK_PX * self._s_per_px // 86_400.0)
        parts: list[str] = []
        for at in _ticks(self._timeline.since, self._timeline.until, step_s):
            x = self._x(at)
            parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP - 8}" y2="{bottom}"/>')
            if x < _WIDTH - 40:  # there is room for its text
                label = f'<text class="dim small" x="{x:.1f}" y="{_TOP - 13}" text-anchor="middle">'
                parts.append(f"{label}{_tick(at, step_s)}</text>")
        return "".join(parts)

    def _lane(self, lane: Lane, y: int) -> str:
        merged = _merged(lane, *(pixels * self._s_per_px for pixels in (_BAR_PX, _MARK_PX, _LETTER_PX)))
        depth = min(lane.path.count("/"), 6)
        name, x = lane.path.rpartition("/")[2], 10 + 14 * depth
        label = in_short(name, (_LABEL - x) // 7)
        weight = ' font-weight="700"' if lane.kind == "supervisor" else ""
        head = (
            f'<line class="grid" x1="0" x2="{_WIDTH}" y1="{y + _ROW}" y2="{y + _ROW}"/>'
            f'<text x="{x}" y="{y + 16}"{weight}>{_text(label)}<title>{_text(lane.path)}</title></text>'
        )
        bars = "".join(self._bar(bar, lane.path, y + 6) for bar in merged.bars)
        marks = "".join(self._mark(mark, y + (12 if mark.kind in OF_CHILDREN else 25)) for mark in merged.marks)
        return f"<g>{head}{bars}{marks}</g>"

    def _bar(self, bar: Bar, path: str, y: int) -> str:
        x1 = self._x(self._timeline.since if bar.begin is None else bar.begin)
        x2 = self._x(self._timeline.until if bar.end is None else bar.end)
        looks = f"bar{' many' if bar.count > 1 else ''}{' unknown' if bar.how == 'unknown' else ''}"
        bars = f'<rect class="{looks}" x="{x1:.1f}" y="{y}" width="{max(x2 - x1, 1.5):.1f}" height="12" rx="2"/>'
        if bar.ready is not None and bar.count == 1 and (ready := self._x(bar.ready)) > x1 + 1:
            bars += f'<rect class="bar starting" x="{x1:.1f}" y="{y}" width="{ready - x1:.1f}" height="12" rx="2"/>'
        return f"<g>{bars}<title>{_text(bar_text(bar, path))}</title></g>"

    def _mark(self, mark: Mark, y: int) -> str:
        x = self._x(mark.at)
        shape = f'<path class="mark k-{mark.kind}" transform="translate({x:.1f} {y})" d="{SHAPES[mark.kind]}"/>'
        number = f'<text class="count" x="{x + 8:.1f}" y="{y + 3}">{mark.label}</text>' if mark.label else ""
        return f"<g>{shape}{number}<title>{_text(mark.text)}</title></g>"

    def _legend(self, y: int) -> tuple[str, int]:
        used = {mark.kind for lane in self._lanes for mark in lane.marks}
        parts: list[str] = []
        x = 20
        for kind in (kind for kind in KINDS if kind in used):
            width = 26 + 7 * len(KINDS[kind])
            if x + width > _WIDTH:
                x, y = 20, y + 20
            parts.append(
                f'<path class="mark k-{kind}" transform="translate({x} {y - 4})" d="{SHAPES[kind]}"/>'
                f'<text class="small" x="{x + 11}" y="{y}">{escape(KINDS[kind])}</text>'
            )
            x += width
        return "".join(parts), y + 14


def bar_text(bar: Bar, path: str) -> str:
    """Return a line about a life: "root/cameras, pid 71, 12:00:01.250 to 12:00:09.500, killed"."""
    begin = "before" if bar.begin is None else clock(bar.begin)
    end = "now" if bar.end is None else clock(bar.end)
    what = f"{bar.count} lives" if bar.count > 1 else f"pid {bar.pid}" if bar.pid else ""
    how = "its end is not known" if bar.how == "unknown" else bar.how
    return ", ".join(filter(None, (path, what, f"{begin} to {end}", how)))


def _merged(lane: Lane, bar_s: float, mark_s: float, letter_s: float = 0.0) -> Lane:
    tree = merged_marks((mark for mark in lane.marks if mark.kind in OF_CHILDREN), mark_s, letter_s)
    resources = merged_marks((mark for mark in lane.marks if mark.kind not in OF_CHILDREN), mark_s, letter_s)
    marks = sorted([*tree, *resources], key=lambda mark: mark.at)
    return msgspec.structs.replace(lane, bars=merged_bars(lane.bars, bar_s), marks=marks)


def _plain_lane(lane: Lane) -> dict[str, Any]:
    bars = [[bar.begin, bar.ready, bar.end, bar.how, bar.count, bar_text(bar, lane.path)] for bar in lane.bars]
    marks = [[mark.at, mark.kind, mark.text, mark.counts or {mark.kind: mark.count}] for mark in lane.marks]
    return {"path": lane.path, "kind": lane.kind, "bars": bars, "marks": marks}


def _ticks(since: float, until: float, step_s: float) -> list[float]:
    """Return the times that are multiples of the step, counted from midnight of this place."""
    offset = time.localtime(since).tm_gmtoff
    first = -(-(since + offset) // step_s)
    count = int((until + offset) / step_s - first) + 1
    return [(first + number) * step_s - offset for number in range(max(0, count))]


def _tick(at: float, step_s: float) -> str:
    then = time.localtime(round(at, 3))
    if step_s >= 86_400:
        return time.strftime("%Y-%m-%d", then)
    if step_s >= 60:
        return time.strftime("%H:%M", then)
    text = time.strftime("%H:%M:%S", then)
    return text if step_s >= 1 else text + f"{round(at, 3) % 1:.3f}"[1:]


def _text(text: str) -> str:
    return escape(_NOT_XML.sub("\ufffd", text))
