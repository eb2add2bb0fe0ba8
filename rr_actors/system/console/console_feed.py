"""The feed: it numbers the events of a system and sends them to the consoles that follow it. On the loop.

An event costs one append to a list for each reader. Twenty times a second the feed sends the events, many in one frame.
A reader that does not read fills only its own list. A full list is emptied. Later the reader hears how many events it
has missed, and how the tree is then.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors.base.errors import TEXT_LIMIT, NotSerializable, readable
from rr_actors.registrar.model.recorded import DECIDED, Entry
from rr_actors.system.console.console_messages import (
    ANSWER_LIMIT_BYTES,
    BeginRecording,
    Entries,
    Events,
    Follow,
    mentions,
)
from rr_actors.system.event_subscribers import Subscribers
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recordings
from rr_actors.wire.frames import framed

KEPT = 2000
"""The most events that wait for one reader; with one more, it has missed them all."""
KEPT_OF_RECORDING = 50_000
"""The most entries that wait for one reader that records."""
BATCH_S = 0.05
"""Seconds that an event waits for others, to be sent with them."""
_BATCH = 500
_NOTES = ANSWER_LIMIT_BYTES // 2  # characters of the notes of decisions in a batch
_SHORT = 1000  # characters of a text, so that a batch of them fits into a frame


class Reader:
    """One console that follows the events, or records.

    Args:
        send: writes a frame to the console's connection.
        fall_behind: called when the console reads again and has missed events. It sends a Missed, then calls
            caught_up().
    """

    def __init__(
        self, follow: Follow | BeginRecording, send: Callable[[bytes], None], fall_behind: Callable[[], None]
    ) -> None:
        self.missed = 0
        self.is_blocked = False
        self.newest = 0
        self.records = isinstance(follow, BeginRecording)
        self.wants_decisions = isinstance(follow, BeginRecording) and follow.decisions
        self._kept = KEPT_OF_RECORDING if self.records else KEPT
        wanted = Follow() if isinstance(follow, BeginRecording) else follow
        self._kinds = frozenset(wanted.events)
        self._about = wanted.about
        self._send = send
        self._fall_behind = fall_behind
        self._is_catching_up = False
        self._waiting: list[Event | Entry] = []
        self._dropped = 0

    @property
    def is_behind(self) -> bool:
        """Whether events wait for the console, or were missed and it has not heard so."""
        return bool(self._waiting) or self.missed > 0

    def hear(self, event: Event) -> None:
        """Keep an event for the console, if the console has asked for such events."""
        if self._kinds and event.event not in self._kinds:
            return
        if not self._about or mentions(event.facts, self._about):
            self._keep(event)

    def take(self, entries: list[Entry], dropped: int) -> None:
        """Keep entries of a recording for the console."""
        self._dropped += dropped
        for entry in entries:
            self._keep(entry)

    def _keep(self, what: Event | Entry) -> None:
        self._waiting.append(what)
        self.newest = what.seq
        if len(self._waiting) > self._kept:
            self.missed += len(self._waiting)
            self._waiting.clear()

    def flush(self) -> None:
        """Send the events that wait, as long as the connection takes them."""
        if self.is_blocked or self._is_catching_up:
            return
        if self.missed:
            self._is_catching_up = True
            self._fall_behind()
            return
        while self._waiting and not self.is_blocked:
            count = _together(self._waiting)
            batch, self._waiting = self._waiting[:count], self._waiting[count:]
            self._send(_entries(batch, self._dropped) if self.records else _events(batch))
            self._dropped = 0

    def take_missed(self) -> tuple[int, int]:
        """Return how many events were missed, and the number of the last one; begin to count anew."""
        missed, seq = self.missed, self.newest
        if self._waiting:
            seq = self._waiting[0].seq - 1
        self.missed = 0
        return missed, seq

    def caught_up(self) -> None:
        """Note that the console has received the Missed, and go on with the events."""
        self._is_catching_up = False
        self.flush()


class Feed:
    """The feed of one system.

    Args:
        subscribers: the feed is one of them as long as it has a reader of events.
        recordings: each reader that records begins one.
    """

    def __init__(self, subscribers: Subscribers, recordings: Recordings) -> None:
        self.seq = 0
        self._subscribers = subscribers
        self._recordings = recordings
        self._readers: dict[Reader, Callable[[], None] | None] = {}  # with the function that ends its recording
        self._unlisten: Callable[[], None] | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def readers(self) -> list[Reader]:
        """The consoles that follow or record now."""
        return list(self._readers)

    def add(self, reader: Reader) -> None:
        """Send a reader what happens from now on."""
        self._readers[reader] = None
        if reader.records:
            sink = functools.partial(self._recorded, reader)
            self._readers[reader] = self._recordings.begin(sink, decisions=reader.wants_decisions)
        elif self._unlisten is None:
            self._unlisten = self._subscribers.listen(self.heard)

    def remove(self, reader: Reader) -> None:
        """Send a reader nothing more; with the last reader of events, end the feed's own subscription."""
        if (end := self._readers.pop(reader, None)) is not None:
            end()
        if self._unlisten is not None and all(other.records for other in self._readers):
            unlisten, self._unlisten = self._unlisten, None
            unlisten()

    def heard(self, facts: dict[str, Any]) -> None:
        """Number an event, and keep it for the readers."""
        self.seq += 1
        event = Event.of(facts, self.seq)
        for reader in self._readers:
            if not reader.records:
                reader.hear(event)
        self._flush_soon()

    def _recorded(self, reader: Reader, entries: list[Entry], dropped: int) -> None:
        reader.take(entries, dropped)
        self._flush_soon()

    def _flush_soon(self) -> None:
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(BATCH_S, self._flush)

    def _flush(self) -> None:
        self._timer = None
        for reader in self.readers:
            reader.flush()

    def close(self) -> None:
        """Send the events that wait, and remove all readers."""
        if self._timer is not None:
            self._timer.cancel()
            self._flush()
        for reader in self.readers:
            self.remove(reader)


def _together(waiting: list[Event | Entry]) -> int:
    """Return how many of those that wait are sent in one frame: of the long notes of decisions, fewer."""
    size = 0
    for count, what in enumerate(waiting[:_BATCH]):
        size += len(what.facts.get("note", "")) if what.event == DECIDED else 0
        if size > _NOTES and count:
            return count
    return _BATCH


def _entries(entries: list[Any], dropped: int) -> bytes:
    try:
        return framed(Entries(entries, dropped), ANSWER_LIMIT_BYTES)
    except NotSerializable:  # half a character in a file's name, or very long texts
        bare = [msgspec.structs.replace(one, detail=readable(one.detail[:_SHORT]), facts={}) for one in entries]
        return framed(Entries(bare, dropped), ANSWER_LIMIT_BYTES)


def _events(events: list[Any]) -> bytes:
    try:
        return framed(Events(events), ANSWER_LIMIT_BYTES)
    except NotSerializable:  # as above
        return framed(Events([event.readable(TEXT_LIMIT) for event in events]), ANSWER_LIMIT_BYTES)
