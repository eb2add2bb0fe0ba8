"""Recorder: sends the messages and callbacks of one process up while somebody records.

The caller's thread makes an entry and appends it to a list. At most 10 ms later the loop sends a batch to the
application's process. The unsent entries of a killed process are lost. While nobody records, nothing of this is called.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rr_actors.actors.messaging.message_notes import Stamp
from rr_actors.base.errors import Unavailable
from rr_actors.registrar.model.messages import Message
from rr_actors.registrar.model.recorded import DECIDED, Entry, message_entry
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.thread_rules import on_loop

RECORDED = "recorded"
"""The event that carries a batch: "entries", encoded, and "dropped", the number of entries without room."""
KEPT = 10_000
"""How many entries may wait for the loop. More are counted and dropped."""
_TOGETHER = 200
"""How many entries are sent in one message; those of a decision may be 64 KiB long."""
BATCH_S = 0.01

_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(list[Entry]).decode


class Recorder:
    """The recorder of one process. Call it from any thread.

    Args:
        path: the process's, "root/cameras".
        emit: sends an event to the application's process; called on the loop.
        sender: returns the name of the manager whose callback runs the calling code, and the callback's resource; the
            path of the process and "" if none does.
    """

    def __init__(
        self, path: str, dispatcher: Dispatcher, emit: Callable[..., None], sender: Callable[[], tuple[str, str]]
    ) -> None:
        self.sender = sender
        self._path = path
        self._dispatcher = dispatcher
        self._emit = emit
        self._lock = threading.Lock()
        self._waiting: list[Entry] = []
        self._dropped = 0
        self._scheduled = False
        self._pid = os.getpid()

    def message(self, event: str, registrar: str, peer: str, message: Message, at: float | None = None) -> None:
        """Record that a registrar of this process has "sent" a message to `peer`, or "received" one from it.

        Args:
            at: seconds since the epoch; None: now. The peer may read a message before this call.
        """
        at = time.time() if at is None else at
        self._add(message_entry(at, event, self._path, self._pid, registrar, peer, message))

    def callback(self, event: str, server: str, role: str, resource: str, detail: str = "") -> None:
        """Record that a callback of "registrar/server" "began" or "ended".

        `detail`: "attempt 2" of one that a crash has interrupted before, and the error that ended it.
        """
        registrar = server.rpartition("/")[0]
        where = (self._path, self._pid, registrar)
        self._add(Entry(time.time(), event, 0, *where, "", role, "", resource, "", server, detail))

    def actor_message(self, event: str, actor: str, peer: str, stamp: Stamp, cause: str, text: str) -> None:
        """Record that an actor of this process has "sent" a message to `peer`, or "received" one from it."""
        where = (self._path, self._pid, actor, peer)
        self._add(Entry(time.time(), event, 0, *where, stamp.kind, stamp.id, "", cause, "", text))

    def decision(self, registrar: str, number: int, parts: Sequence[str]) -> bool:
        """Record the note of this number about a decision of a registrar. Return False if there was no room for it."""
        at, where = time.time(), (self._path, self._pid, registrar)
        count = len(parts)
        entries = [
            Entry(at, DECIDED, 0, *where, facts={"number": number, "part": part, "parts": count, "note": text})
            for part, text in enumerate(parts, 1)
        ]
        return self._add(*entries)

    def _add(self, *entries: Entry) -> bool:
        with self._lock:
            if len(self._waiting) + len(entries) > KEPT:
                self._dropped += len(entries)
                return False
            self._waiting += entries
        if not self._scheduled:  # set by the loop: if a thread is interrupted here, the next entry does this
            try:
                self._dispatcher.call(self._flush_soon)
            except Unavailable:  # the loop has ended, and nothing more can be sent
                self._waiting.clear()
        return True

    @on_loop
    def close(self) -> None:
        """Send the waiting entries before this process's part of the system ends."""
        if self._waiting:
            self._flush()

    @on_loop
    def _flush_soon(self) -> None:
        if not self._scheduled:
            self._scheduled = True
            self._dispatcher.loop.call_later(BATCH_S, self._flush)

    @on_loop
    def _flush(self) -> None:
        self._scheduled = False
        with self._lock:
            waiting, self._waiting = self._waiting, []
            dropped, self._dropped = self._dropped, 0
        for at in range(0, max(1, len(waiting)), _TOGETHER):
            self._emit(RECORDED, entries=_encode(waiting[at : at + _TOGETHER]), dropped=0 if at else dropped)


def entries_of(event: dict[str, Any]) -> list[Entry]:
    """Return the entries of a batch.

    Raises:
        msgspec.MsgspecError: the event has no valid batch.
    """
    return _decode(event["entries"])
