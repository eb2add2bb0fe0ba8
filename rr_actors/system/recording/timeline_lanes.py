"""Lanes of a timeline: from the entries of a recording to a lane for each child, a bar for each life, and marks.

A life that began before the first entry begins with it. A life of which no end is known, because its system was killed,
ends where the next one begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec

from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.event_texts import event_text

KINDS = {
    "gave_up": "gave up (escalation)",
    "killed": "killed",
    "crashed": "exited with an error",
    "start_failed": "start failed",
    "lost": "resource lost",
    "failed": "load or unload failed",
    "ERROR": "status ERROR or FATAL",
    "WARNING": "status WARNING",
    "stopped": "stopped",
    "restarted": "restarted",
    "started": "started",
    "restored": "restored",
    "unloaded": "unloaded",
    "loaded": "loaded",
    "status": "other status",
}
"""The kinds of marks, with their names for people, the worst first."""
BAD = ("gave_up", "killed", "crashed", "start_failed", "lost", "failed", "ERROR", "WARNING")
OF_CHILDREN = frozenset(("gave_up", "killed", "crashed", "start_failed", "stopped", "restarted", "started"))
"""The kinds of marks that are about children; the others are about resources."""

_KEPT = 4000
"""How many bars or marks a lane keeps before it merges those that are close to each other."""
_TOLD = 5  # texts of merged marks
_WORST = {kind: number for number, kind in enumerate(KINDS)}
_CHILD_EVENTS = {
    "started": "started",
    "restarted": "restarted",
    "ignored": "stopped",
    "start_failed": "start_failed",
    "deleted": "stopped",
    "gave_up": "gave_up",
    "auto_shutdown": "gave_up",
}
_ENDS = {"abnormal": "crashed", "killed": "killed"}
_RESOURCE_EVENTS = {"loaded": "loaded", "unloaded": "unloaded", "load_failed": "failed", "unload_failed": "failed"}
_STATES = {"WARNING": "WARNING", "ERROR": "ERROR", "FATAL": "ERROR"}
_LOST = "FATAL lost"

_T = TypeVar("_T")


class Mark(msgspec.Struct, frozen=True):
    """An event on a lane, or several that are too close to each other to be told apart.

    Attributes:
        at: of the first event, seconds since the epoch.
        kind: of the worst event, a key of KINDS.
        text: what happened and why, a line for each event; of many events, the first ones and how many of each kind.
        count: how many events.
        counts: how many events of each kind, if they are several.
    """

    at: float
    kind: str
    text: str
    count: int = 1
    counts: dict[str, int] = {}

    @property
    def label(self) -> str:
        """How many events of the worst kind, and "+" if there are others: "12+"; "" for one event."""
        return _label(self.counts or {self.kind: self.count}, self.kind)


class Bar(msgspec.Struct, frozen=True):
    """A life of a child, or several that are too short to be told apart.

    Attributes:
        begin: seconds since the epoch; None if it began before the recording.
        end: None while it lives.
        ready: when its start was done; None if that is not known.
        pid: of its process; 0 if that is not known.
        how: how it ended: "killed", "crashed", "stopped", or "unknown"; "" while it lives.
        count: how many lives.
    """

    begin: float | None
    end: float | None = None
    ready: float | None = None
    pid: int = 0
    how: str = ""
    count: int = 1


class Lane(msgspec.Struct, frozen=True):
    """What happened to one child.

    Attributes:
        path: its path in the tree.
        kind: "supervisor", "manager" or "actor"; "" if that is not known.
        bars, marks: oldest first.
    """

    path: str
    kind: str
    bars: list[Bar]
    marks: list[Mark]

    @property
    def trouble(self) -> tuple[int, int]:
        """Return how bad the worst mark is, 0 for the worst kind, and minus the number of bad marks."""
        bad = [mark for mark in self.marks if mark.kind in BAD]
        return min((_WORST[mark.kind] for mark in bad), default=len(_WORST)), -sum(mark.count for mark in bad)


@dataclass
class _Building:
    kind: str = ""
    bars: list[Bar] = field(default_factory=list[Bar])
    marks: list[Mark] = field(default_factory=list[Mark])
    step_s: float = 0.0

    @property
    def alive(self) -> Bar | None:
        return self.bars[-1] if self.bars and self.bars[-1].end is None else None

    def mark(self, mark: Mark) -> None:
        self.marks.append(mark)
        self.marks = self._bounded(self.marks, merged_marks, mark.at - self.marks[0].at)

    def begin(self, bar: Bar) -> None:
        self.bars.append(bar)
        first = self.bars[0].begin or self.bars[0].end
        self.bars = self._bounded(self.bars, merged_bars, (bar.begin or 0.0) - (first or 0.0))

    def change(self, **changes: float | str | None) -> None:
        """Change the newest bar."""
        self.bars[-1] = msgspec.structs.replace(self.bars[-1], **changes)

    def _bounded(self, those: list[_T], merged: Callable[[list[_T], float], list[_T]], span_s: float) -> list[_T]:
        while len(those) > _KEPT:
            self.step_s = max(2 * self.step_s, span_s / _KEPT, 0.001)
            those = merged(those, self.step_s)
        return those


class Lanes:
    """Builds lanes from entries, which come in the order of their time. For one thread.

    However many entries it takes, a lane keeps at most 4,000 bars and as many marks: then it merges neighbours.
    """

    def __init__(self) -> None:
        self._lanes: dict[str, _Building] = {}
        self._of_registrars: dict[str, _Building] = {}
        self.began: float | None = None
        self.latest = 0.0

    def take(self, entry: Entry) -> None:
        """Add an entry."""
        if self.began is None:
            self.began = entry.at
        self.latest = max(self.latest, entry.at)
        if entry.event in ("exited", "stopped", "ended") and entry.process and entry.facts:
            self._end(entry)
        elif entry.event in _CHILD_EVENTS:
            self._take_child(entry)
        elif entry.registrar:
            self.sees(entry.process, entry.pid, entry.at)
            if (mark := _mark_of(entry)) is not None:
                self._of_registrars.setdefault(entry.registrar, _Building()).mark(mark)

    def lanes(self) -> list[Lane]:
        """Return the lanes, each supervisor before its children. An application's registrars are on the root's lane."""
        for path in list(self._lanes):
            for above in _above(path):
                self._lanes.setdefault(above, _Building("supervisor"))
        of_path: dict[str, list[Mark]] = {}
        for registrar, building in self._of_registrars.items():
            found = [path for path, lane in self._lanes.items() if _id(path) == registrar and lane.kind != "supervisor"]
            home = found[0] if found else "root"
            self._lanes.setdefault(home, _Building("supervisor"))
            of_path.setdefault(home, []).extend(building.marks)
        return [
            Lane(path, lane.kind, list(lane.bars), sorted([*lane.marks, *of_path.get(path, ())], key=_at))
            for path, lane in ((path, self._lanes[path]) for path in _ordered(list(self._lanes)))
        ]

    def sees(self, path: str, pid: int, at: float) -> None:
        """Take a sign of life of a child's process."""
        if not path or not pid:
            return
        lane = self._lane(path)
        if lane.bars and (lane.alive is not None or lane.bars[-1].pid == pid):
            return  # or it is a last sign of one that has ended
        lane.begin(Bar(at if lane.bars else None, pid=pid))
        for above in _above(path):
            if (supervisor := self._lane(above, "supervisor")).alive is None:
                supervisor.begin(Bar(at if supervisor.bars else None))

    def _lane(self, path: str, kind: str = "") -> _Building:
        lane = self._lanes.setdefault(path, _Building())
        lane.kind = lane.kind or kind
        return lane

    def _take_child(self, entry: Entry) -> None:
        path, facts = entry.process, entry.facts
        kind = _CHILD_EVENTS[entry.event]
        lane = self._lane(path, str(facts.get("kind", "")))
        if kind in ("started", "restarted"):
            self._start(path, lane, entry)
        elif kind == "gave_up" and "/" in path:  # its supervisor did
            lane = self._lane(path.rpartition("/")[0], "supervisor")
        lane.mark(Mark(entry.at, kind, text_of(entry)))

    def _start(self, path: str, lane: _Building, entry: Entry) -> None:
        begin = entry.at - float(entry.facts.get("ready_s") or 0.0)
        alive = lane.alive
        if alive is not None and alive.ready is None and alive.pid in (0, entry.pid):  # there were signs of this life
            earliest = begin if alive.begin is None else min(begin, alive.begin)
            lane.change(begin=earliest, ready=entry.at, pid=entry.pid)
        else:
            if alive is not None:
                lane.change(end=max(begin, alive.begin or begin), how="unknown")
            lane.begin(Bar(begin, ready=entry.at, pid=entry.pid))
        for above in _above(path):
            if (supervisor := self._lane(above, "supervisor")).alive is None:
                supervisor.begin(Bar(begin))

    def _end(self, entry: Entry) -> None:
        facts = entry.facts
        how = _ENDS.get(str(facts.get("reason", "")), "stopped")
        lane = self._lane(entry.process, str(facts.get("kind", "")))
        up_s = facts.get("up_s")
        ready = None if up_s is None else entry.at - float(up_s)
        if lane.alive is None and ready is not None:
            lane.begin(Bar(None))
        if (alive := lane.alive) is not None:
            if alive.ready is None and ready is not None:
                lane.change(ready=ready, begin=ready - float(facts.get("ready_s") or 0.0))
            lane.change(end=entry.at, how=how, pid=alive.pid or entry.pid)
        if entry.event == "ended":
            for path, below in self._lanes.items():
                if path.startswith(f"{entry.process}/") and below.alive is not None:
                    below.change(end=entry.at, how="stopped")
        lane.mark(Mark(entry.at, how, text_of(entry)))


def text_of(entry: Entry) -> str:
    """Return a line that says what happened, and why."""
    if entry.facts:
        return event_text(entry.at, entry.event, entry.facts)
    return event_text(entry.at, "restored", {"server": entry.server, "detail": entry.detail})  # its recover callback


def _mark_of(entry: Entry) -> Mark | None:
    if entry.event == "ended" and entry.name == "recover":
        return None if entry.detail else Mark(entry.at, "restored", text_of(entry))  # else its status says so
    if entry.event == "status":
        is_lost = entry.detail.startswith(_LOST)
        return Mark(entry.at, "lost" if is_lost else _STATES.get(entry.detail.split(" ")[0], "status"), text_of(entry))
    kind = _RESOURCE_EVENTS.get(entry.event)
    return None if kind is None else Mark(entry.at, kind, text_of(entry))


# -- what is too close to be told apart --------------------------------------------------------------------------------


def merged_marks(marks: Iterable[Mark], step_s: float, letter_s: float = 0.0) -> list[Mark]:
    """Return the marks, with one in place of those that follow each other within step_s seconds.

    Args:
        letter_s: how much longer a mark is for each letter of its label.
    """
    groups: list[list[Mark]] = []
    counts: Counter[str] = Counter()  # of the last group
    for mark in marks:
        wide_s = step_s
        if counts:
            wide_s += letter_s * len(_label(counts, min(counts, key=_badness)))
        if groups and mark.at - groups[-1][0].at < wide_s:
            groups[-1].append(mark)
        else:
            groups.append([mark])
            counts.clear()
        if letter_s:
            counts.update(mark.counts or {mark.kind: mark.count})
    return [group[0] if len(group) == 1 else _one_mark(group) for group in groups]


def _label(counts: Mapping[str, int], worst: str) -> str:
    count = counts[worst]
    number = "" if count == 1 else f"{count}" if count < 1000 else f"{count // 1000}k"
    return number + "+" * (len(counts) > 1)


def _badness(kind: str) -> int:
    return _WORST[kind]


def _one_mark(group: list[Mark]) -> Mark:
    counts: Counter[str] = Counter()
    for mark in group:
        counts.update(mark.counts or {mark.kind: mark.count})
    kinds = sorted(counts, key=_badness)
    parts = ", ".join(f"{counts[kind]} × {KINDS[kind]}" for kind in kinds)
    lines = [line for mark in group for line in mark.text.splitlines()[1 if mark.counts else 0 :]]
    worst = [mark.text for mark in group if mark.kind == kinds[0] and not mark.counts]
    shown = list(dict.fromkeys([*worst, *lines]))[:_TOLD]
    return Mark(group[0].at, kinds[0], "\n".join([parts, *shown]), counts.total(), dict(counts))


def merged_bars(bars: Iterable[Bar], step_s: float) -> list[Bar]:
    """Return the bars, with one in place of those that begin and end within step_s seconds."""
    found: list[Bar] = []
    for bar in bars:
        first = found[-1] if found else None
        if first is not None and first.begin is not None and bar.end is not None and bar.end - first.begin < step_s:
            found[-1] = msgspec.structs.replace(
                bar, begin=first.begin, ready=first.ready, count=first.count + bar.count
            )
        else:
            found.append(bar)
    return found


def chosen_lanes(lanes: list[Lane], most: int) -> list[Lane]:
    """Return at most so many lanes, in their order: those with the worst marks, and the supervisors above them."""
    if len(lanes) <= most:
        return lanes
    chosen: set[str] = set()
    for lane in sorted(lanes, key=lambda one: one.trouble):
        wanted = {lane.path, *_above(lane.path)} - chosen
        if len(chosen) + len(wanted) <= most:
            chosen |= wanted
    return [lane for lane in lanes if lane.path in chosen]


def _above(path: str) -> list[str]:
    parts = path.split("/")
    return ["/".join(parts[:number]) for number in range(1, len(parts))]


def _id(path: str) -> str:
    return path.rpartition("/")[2]


def _at(mark: Mark) -> float:
    return mark.at


def _ordered(paths: list[str]) -> list[str]:
    """Return the paths, each before those below it; children of one supervisor in the order in which they appeared."""
    below: dict[str, list[str]] = {}
    for path in paths:
        below.setdefault(path.rpartition("/")[0], []).append(path)
    ordered: list[str] = []
    ahead = list(reversed(below.get("", [])))
    while ahead:
        path = ahead.pop()
        ordered.append(path)
        ahead += reversed(below.get(path, []))
    return ordered
