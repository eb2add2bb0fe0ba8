"""Rewinding: the steps of a recording, the moment after each of them, and what changed when.

A step is an entry that changes the tree or a resource. Others, most messages for instance, are passed over.
"""

from __future__ import annotations

import bisect
import itertools
import os

import msgspec

from rr_actors.base.errors import ConfigError, UsageError, few, shown
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.event_files import read_events
from rr_actors.system.recording.event_texts import clock, event_text
from rr_actors.system.recording.recordings import Present, Recording
from rr_actors.system.rewound.moments import Change, Fold, Moment, differences, first_moment, moment_after

_KEPT = 100  # moments, at the most, from which others are folded
_APART = 200  # entries between two of them, at least
GONE = "gone"
"""The state of what is not there, for people."""


class Step(msgspec.Struct, frozen=True):
    """An entry that changes the tree or a resource.

    Attributes:
        number: 1 for the first step.
        at: its time, in seconds since the epoch.
        entry: the entry.
        changes: what it changes.
    """

    number: int
    at: float
    entry: Entry
    changes: tuple[Change, ...]

    def __str__(self) -> str:
        entry = self.entry
        if entry.facts:
            return event_text(entry.at, entry.event, entry.facts)
        said = f"{entry.name} {entry.event}"  # a callback
        return "  ".join(filter(None, (clock(entry.at), said, self.changes[0].name, entry.detail)))


class Rewound:
    """A recording that can be looked at as it was at any moment. rewind() makes it.

    Attributes:
        title: the system, or the file.
        since, until: the times of its beginning and of its last entry, in seconds since the epoch.
        steps: what changed the tree or a resource, in the order of time.
        missed: how many entries are missing, as the recording says.
        left_out: how many resources were there at the beginning that the recording does not have.
        notes: why more of the beginning is not known.
        knows_beginning: whether the recording noted what was there when it began; else the entries tell.
        is_history: whether it is the history of a state directory, which has events alone.
    """

    def __init__(self, recording: Recording) -> None:
        self.title = recording.system
        self.missed = recording.missed
        self._entries = recording.entries()
        self.is_history = recording.is_history
        present = msgspec.convert(recording.present, list[Present])
        self.knows_beginning = bool(present)
        self.left_out = sum(part.left_out for part in present)
        self.notes = [note for part in present for note in part.notes]
        first = self._entries[0].at if self._entries else recording.since
        self.since = min(recording.since or first, first)
        self.until = max((entry.at for entry in self._entries), default=self.since)
        fold = Fold(first_moment(self._entries, recording.present, self.since))
        self._kept: list[tuple[int, Moment]] = [(0, fold.moment)]  # how many entries each has
        apart = max(_APART, len(self._entries) // _KEPT)
        self.steps: list[Step] = []
        self._ends: list[int] = []  # how many entries there are up to each step
        for count, entry in enumerate(self._entries, 1):
            if changes := fold.take(entry):
                self.steps.append(Step(len(self.steps) + 1, entry.at, entry, tuple(changes)))
                self._ends.append(count)
            if count % apart == 0:
                self._kept.append((count, fold.moment))
        self._times = list(itertools.accumulate((step.at for step in self.steps), max))

    @property
    def has_entries(self) -> bool:
        """Whether anything was recorded."""
        return bool(self._entries)

    def __len__(self) -> int:
        return len(self.steps)

    def moment(self, number: int) -> Moment:
        """Return the moment after so many steps; 0: as it began. It is the same on the way forward and back.

        Raises:
            UsageError: there are not so many steps.
        """
        if not 0 <= number <= len(self.steps):
            raise UsageError(f"step: expected a number from 0 to {len(self.steps)}, got {number}")
        if number == 0:
            return self._kept[0][1]
        end = self._ends[number - 1]
        count, kept = self._kept[bisect.bisect_right(self._kept, end, key=lambda one: one[0]) - 1]
        return moment_after(kept, self._entries[count:end])

    def number_at(self, at: float) -> int:
        """Return how many steps there are up to a time, in seconds since the epoch."""
        return bisect.bisect_right(self._times, at + 0.0005)  # people type the milliseconds that they see

    def when(self, text: str, state: str) -> list[tuple[Step, Change]]:
        """Return when something came into a state: a child or resource with this text in its name or id.

        Args:
            state: one of those that a moment shows, in any case, or "gone".

        Raises:
            UsageError: nothing with this text came into this state. The error says which states there were.
        """
        about = [(step, one) for step in self.steps for one in step.changes if text in one.name or text in one.id]
        found = [
            (step, one)
            for step, one in about
            if one.before != one.after and (one.after or GONE).casefold() == state.casefold()
        ]
        if not found:
            states = dict.fromkeys(one.after or GONE for _, one in about)
            said = f"it was: {few(list(states))}" if about else "nothing of this name has changed"
            raise UsageError(f"--when: expected a name and the state that it came into, got {shown(text)}, "
                             f"which never became {shown(state)}; {said}")  # fmt: skip
        return found

    def between(self, first: int, last: int) -> list[Change]:
        """Return what is different after `last` steps from what was after `first` steps."""
        return differences(self.moment(first), self.moment(last))


def rewind(what: Recording | str | os.PathLike[str]) -> Rewound:
    """Return a recording, or the file of one, a state directory, or its history.jsonl, to be looked at at any moment.

    Raises:
        ConfigError: it cannot be read; the error names the line.
    """
    recording = what if isinstance(what, Recording) else read_events(what)
    try:
        return Rewound(recording)
    except msgspec.ValidationError as error:
        where = recording.system if isinstance(what, Recording) else os.fspath(what)
        text = f'{where}: "present": expected what rr-actors record writes: {error}'
        raise ConfigError(text, file=str(where)) from error
