"""The feed: what happens in a system, numbered, to the consoles that follow it. On the loop.

An event costs a list's append for each reader; they are sent twenty times a second, many in one frame. A reader that
does not read fills its own list and nothing else. When that is full it is emptied; the reader hears later how many
events it has missed, and how the tree is now.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from rr_actors.base.errors import NotSerializable, shown
from rr_actors.registrar.model.messages import readable
from rr_actors.system.console.console_messages import ANSWER_LIMIT_BYTES, Event, Events, Follow
from rr_actors.wire.frames import framed

KEPT = 2000
"""How many events wait for one reader, before it has missed them."""
BATCH_S = 0.05
"""How long an event may wait for others to be sent with it."""
_BATCH = 500


class Reader:
    """One console that follows.

    Args:
        send: writes a frame to its connection.
        fall_behind: called when it can be written to again and has missed events: it sends a Missed, then calls
            caught_up().
    """

    def __init__(self, follow: Follow, send: Callable[[bytes], None], fall_behind: Callable[[], None]) -> None:
        self.missed = 0
        self.is_blocked = False
        self.newest = 0
        self._kinds = frozenset(follow.events)
        self._about = follow.about
        self._send = send
        self._fall_behind = fall_behind
        self._is_catching_up = False
        self._waiting: list[Event] = []

    def hear(self, event: Event) -> None:
        """Keep an event for it, if it wants it."""
        if self._kinds and event.event not in self._kinds:
            return
        if self._about and not any(self._about in text for text in event.facts.values() if isinstance(text, str)):
            return
        self._waiting.append(event)
        self.newest = event.seq
        if len(self._waiting) > KEPT:
            self.missed += len(self._waiting)
            self._waiting.clear()

    def flush(self) -> None:
        """Send what waits, as far as its connection takes it."""
        if self.is_blocked or self._is_catching_up:
            return
        if self.missed:
            self._is_catching_up = True
            self._fall_behind()
            return
        while self._waiting and not self.is_blocked:
            batch, self._waiting = self._waiting[:_BATCH], self._waiting[_BATCH:]
            self._send(_framed(batch))

    def take_missed(self) -> tuple[int, int]:
        """How many it has missed, and up to which number; what waits came later or is counted."""
        missed, seq = self.missed, self.newest
        if self._waiting:
            seq = self._waiting[0].seq - 1
        self.missed = 0
        return missed, seq

    def caught_up(self) -> None:
        """It has heard what it had missed: events go on."""
        self._is_catching_up = False
        self.flush()


class Feed:
    """The feed of one system.

    Args:
        listen: has a listener called for each event, as long as there is a reader; returns what ends that.
    """

    def __init__(self, listen: Callable[[Callable[[dict[str, Any]], None]], Callable[[], None]]) -> None:
        self.seq = 0
        self._listen = listen
        self._unlisten: Callable[[], None] | None = None
        self._readers: list[Reader] = []
        self._timer: asyncio.TimerHandle | None = None

    def add(self, reader: Reader) -> None:
        """Have it hear what happens from now on."""
        self._readers.append(reader)
        if self._unlisten is None:
            self._unlisten = self._listen(self.heard)

    def remove(self, reader: Reader) -> None:
        """It hears nothing any more; with the last one the system's processes are told that nobody listens."""
        if reader in self._readers:
            self._readers.remove(reader)
        if not self._readers and self._unlisten is not None:
            unlisten, self._unlisten = self._unlisten, None
            unlisten()

    def heard(self, facts: dict[str, Any]) -> None:
        """This has happened."""
        self.seq += 1
        at = facts.get("at")
        rest = {key: value for key, value in facts.items() if key not in ("event", "at")}
        event = Event(self.seq, at if isinstance(at, float) else time.time(), facts["event"], rest)
        for reader in self._readers:
            reader.hear(event)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(BATCH_S, self._flush)

    def _flush(self) -> None:
        self._timer = None
        for reader in list(self._readers):
            reader.flush()

    def close(self) -> None:
        """Send what waits, and nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._flush()
        for reader in list(self._readers):
            self.remove(reader)


def _framed(events: list[Event]) -> bytes:
    try:
        return framed(Events(events), ANSWER_LIMIT_BYTES)
    except NotSerializable:  # half a character in a file's name, or very long texts
        return framed(Events([_readable(event) for event in events]), ANSWER_LIMIT_BYTES)


def _readable(event: Event) -> Event:
    facts: dict[str, Any] = {}
    for key, value in event.facts.items():
        facts[readable(key)] = value if isinstance(value, bool | float) else readable(shown(value))
    return Event(event.seq, event.at, event.event, facts)
