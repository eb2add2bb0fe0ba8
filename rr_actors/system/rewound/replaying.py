"""Replaying: the decisions of a recording, decided again by today's code.

A registrar's decision follows from what it knows and a message, and from nothing else. So a recording of a fault is a
test: replay() says where today's code decides in another way than the code that was recorded.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from rr_actors.base.errors import ConfigError, NotFound, UsageError, counted, did_you_mean, few, shown
from rr_actors.registrar.decisions.decided import Began, Decided
from rr_actors.registrar.decisions.deciding_again import DecidedAgain, Difference, RowChange
from rr_actors.registrar.decisions.typed_values import UnknownValue, value_from
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.recordings import Recording, read_recording


class ReplayStep(msgspec.Struct, frozen=True):
    """A decision of a registrar, or all that it knew when the recording began.

    Attributes:
        number: 1 for the registrar's first step in the recording.
        at: its time, in seconds since the epoch.
        registrar: the registrar's name; `process`: the path of its process; `pid`: that process's id.
        what: what was recorded.
        rows: the rows that were changed.
        differences: what today's code decides in another way. Of a step with all that the registrar knew, what the
            decisions before do not lead to.
        is_decided: whether it was decided again. No decision is after one that is different, or after missing ones,
            until the recording has once more all that the registrar knows.
    """

    number: int
    at: float
    registrar: str
    process: str
    pid: int
    what: Began | Decided
    rows: tuple[RowChange, ...] = ()
    differences: tuple[Difference, ...] = ()
    is_decided: bool = True


class Replay:
    """The decisions of a recording, decided again. replay() makes it.

    Attributes:
        title: the system, or the file.
        steps: those of each registrar, in their order, by its name.
        notes: which decisions are missing in the recording.
    """

    def __init__(self, title: str, steps: dict[str, list[ReplayStep]], notes: Sequence[str]) -> None:
        self.title = title
        self.steps = steps
        self.notes = list(notes)

    def of(self, registrar: str) -> list[ReplayStep]:
        """Return the steps of a registrar.

        Raises:
            NotFound: the recording has no decision of it. `.id`, `.known`
        """
        if registrar not in self.steps:
            known = tuple(sorted(self.steps))
            text = f"{self.title}: no decision of a registrar {shown(registrar)}; it has those of {few(known)}"
            raise NotFound(text + did_you_mean(registrar, known), id=registrar, known=known)
        return self.steps[registrar]

    def step(self, registrar: str, number: int) -> ReplayStep:
        """Return a step by its number.

        Raises:
            NotFound: the recording has no decision of the registrar.
            UsageError: it has not so many.
        """
        steps = self.of(registrar)
        if not 1 <= number <= len(steps):
            raise UsageError(f"step: expected a number from 1 to {len(steps)}, got {number}")
        return steps[number - 1]

    @property
    def differences(self) -> list[ReplayStep]:
        """The steps that today's code decides in another way; of each registrar, after the first of them none is known.

        Empty: it decides the same.
        """
        return [step for steps in self.steps.values() for step in steps if step.differences]

    @property
    def not_decided(self) -> list[ReplayStep]:
        """The decisions that were not decided again."""
        return [step for steps in self.steps.values() for step in steps if not step.is_decided]

    def __repr__(self) -> str:
        count = sum(map(len, self.steps.values()))
        different, left = len(self.differences), len(self.not_decided)
        return f"<Replay of {self.title}: {counted(count, 'step')}, {different} different, {left} not decided again>"


def replay(what: Recording | str | os.PathLike[str]) -> Replay:
    """Decide again what a recording has of the registrars' decisions: a Recording, or the file of one.

    It runs the pure functions of registrars alone: no callback, no process, and no code from the file.

    Raises:
        ConfigError: the file cannot be read, is damaged, has no decisions, or was written by a version of the package
            whose decisions this one cannot read.
    """
    recording = what if isinstance(what, Recording) else read_recording(what)
    title = recording.system if isinstance(what, Recording) else os.fspath(what)
    entries = recording.decisions()
    if not entries:
        how = "system.record(decisions=True), or rr-actors record FILE --decisions, records them"
        raise ConfigError(f"{title}: it has no decisions: {how}", file=str(title))
    try:
        return _replayed(str(title), sorted(entries, key=lambda entry: entry.seq))
    except (UnknownValue, TypeError, KeyError, AttributeError, ValueError) as error:
        text = f"{title}: the decisions in it cannot be read: {error}; use the version of rr_actors that recorded it"
        raise ConfigError(text, file=str(title)) from error


class _Note(msgspec.Struct, frozen=True):
    """The facts of an entry: the note's number in its registrar, and which part of how many `note` is."""

    number: int
    part: int
    parts: int
    note: str


class _Line(msgspec.Struct):
    """One registrar of one process, as its notes are read."""

    again: DecidedAgain
    last: int = 0  # the number of its last whole note


def _replayed(title: str, entries: Iterable[Entry]) -> Replay:
    steps: dict[str, list[ReplayStep]] = {}
    lines: dict[tuple[str, int], _Line] = {}
    notes: list[str] = []
    for entry, number, text in _whole(entries):
        line = lines.setdefault((entry.registrar, entry.pid), _Line(DecidedAgain()))
        value = value_from(text)
        if not isinstance(value, Began | Decided):
            raise TypeError(f"expected a decision, got {type(value).__name__}")
        if number != line.last + 1 and line.again.is_known:
            if number > line.last + 1:
                count = number - line.last - 1
                missing = f"{counted(count, 'decision')} {'is' if count == 1 else 'are'} missing"
                notes.append(f"{entry.registrar}: {missing} before its step {_next(steps, entry)}")
            line.again.lose()
        line.last = number
        steps.setdefault(entry.registrar, []).append(_step(entry, _next(steps, entry), value, line.again))
    return Replay(title, steps, notes)


def _next(steps: dict[str, list[ReplayStep]], entry: Entry) -> int:
    return len(steps.get(entry.registrar, ())) + 1


def _step(entry: Entry, number: int, value: Began | Decided, again: DecidedAgain) -> ReplayStep:
    where = number, entry.at, entry.registrar, entry.process, entry.pid, value
    if isinstance(value, Began):
        return ReplayStep(*where, differences=again.begin(value))
    result = again.decide(value)
    return ReplayStep(*where, result.rows, result.differences, result.is_decided)


def _whole(entries: Iterable[Entry]) -> Iterator[tuple[Entry, int, str]]:
    """Yield each note of which no part is missing, with its first entry and its number."""
    waiting: dict[tuple[str, int], list[tuple[Entry, _Note]]] = {}
    for entry in entries:
        key = entry.registrar, entry.pid
        note = msgspec.convert(entry.facts, _Note)
        parts = waiting.setdefault(key, [])
        if note.part != len(parts) + 1 or (parts and parts[0][1].number != note.number):
            parts.clear()
        if note.part == len(parts) + 1:
            parts.append((entry, note))
        if parts and len(parts) == note.parts:
            del waiting[key]
            yield parts[0][0], note.number, "".join(part.note for _, part in parts)
