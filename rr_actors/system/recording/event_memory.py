"""The memory of a system: what happened in it, also while nobody watched, in memory and in a file on its disk.

The file outlives the processes, the tree and the system, so anybody can look at it afterwards. Each line is a JSON
object: an event with its facts. A line that a crash has cut is left out, and the others are read.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec

from rr_actors.base.errors import readable
from rr_actors.base.folder import Folder
from rr_actors.base.names import child_meant, no_child
from rr_actors.base.reporting.log import Log

logger = Log("rr_actors")

FILE = "history.jsonl"
"""When its first event is too old, or it is half as long as both may be, it becomes the older one of two."""
OLDER = "history.1.jsonl"
_RING_BYTES = 2**20  # of the newest lines, kept in memory: a damaged disk does not lose them
_BEGINNING = 2**16  # of a file, which has its first event
_LONG = 10_000  # characters of a text
_TRACEBACK = 4000
_PATH = '"path":"'  # in the line of a child's event; it is seen much faster than the line is decoded


class Event(msgspec.Struct, frozen=True):
    """Something that happened.

    Attributes:
        seq: its number. The numbers count all events of the system that a console heard, in their order. 0: none heard
            it.
        at: its time, in seconds since the epoch.
        event: its kind, as in System.subscribe().
        facts: the other keys of the event, as plain data.
    """

    seq: int
    at: float
    event: str
    facts: dict[str, Any]

    @classmethod
    def of(cls, event: dict[str, Any], seq: int = 0) -> Self:
        """Return the event that System.subscribe() would tell of."""
        facts = event.copy()
        return cls(seq, facts.pop("at"), facts.pop("event"), facts)

    @property
    def path(self) -> str:
        """The path of the child that it is about; "" for another event."""
        return self.facts.get("path", "")

    def flat(self) -> dict[str, Any]:
        """Return it as plain data, with its number if it has one."""
        return {"event": self.event, "at": self.at, **({"seq": self.seq} if self.seq else {}), **self.facts}

    def readable(self, limit: int = _LONG) -> Self:
        """Return it with texts that can be sent and stored, each of at most `limit` characters."""
        facts = {key: readable(fact, limit) if isinstance(fact, str) else fact for key, fact in self.facts.items()}
        return msgspec.structs.replace(self, facts=facts)


class _Known(msgspec.Struct):
    """The facts in a line that readers rely on: a line in which one has another type is damaged."""

    event: str
    at: float
    path: str = ""
    kind: str = ""
    state: str | None = None
    pid: int | None = None
    reason: str = ""
    detail: str = ""
    traceback: str = ""
    delay_s: float = 0.0
    ready_s: float | None = None
    up_s: float | None = None
    registrar: str = ""
    server: str = ""
    resource_id: str = ""
    request: str = ""
    source: str = ""
    status_id: str = ""
    heard_by: str = ""


_check = msgspec.json.Decoder(_Known).decode
_decode = msgspec.json.Decoder(dict[str, Any]).decode
_encode = msgspec.json.Encoder(enc_hook=str).encode


class EventMemory:
    """The memory of a system. take() is called on the loop, the rest from any thread. `began`: when the system did.

    Args:
        folder: the state directory. The events of earlier runs are there.
        limit_bytes: how long both files may be together.
        kept_s: for how many seconds an event is remembered. The older file goes when it has none of these.
    """

    def __init__(self, folder: Folder, limit_bytes: int, kept_s: float) -> None:
        self._folder = folder
        self._limit_bytes, self._kept_s = limit_bytes // 2, kept_s
        self._lines = deque[bytes]()
        self._bytes = 0
        self.began = time.time()
        self._file_began: float | None = None
        self._is_cut = False  # whether the file may end within a line
        self._has_failed = False

    @property
    def directory(self) -> Path:
        """The state directory."""
        return self._folder.path

    def take(self, facts: dict[str, Any]) -> None:
        """Keep an event."""
        if traceback := facts.get("traceback"):
            facts = facts | {"traceback": traceback[-_TRACEBACK:]}
        event = Event.of(facts).readable()
        line = _encode(event.flat())
        self._lines.append(line)
        self._bytes += len(line)
        while self._bytes > _RING_BYTES and len(self._lines) > 1:
            self._bytes -= len(self._lines.popleft())
        try:
            self._write(line + b"\n", event.at)
            self._is_cut = False
        except OSError as error:  # a full disk, or the directory is gone
            self._is_cut = True
            if not self._has_failed:
                self._has_failed = True
                logger.warning("%s: not written, from now on: %s", self._folder.path / FILE, error.strerror)

    def _write(self, line: bytes, at: float) -> None:
        found = self._folder.look(FILE)
        if found is None or self._file_began is None:
            self._file_began = at if found is None else self._left_since(at)
        size = 0 if found is None else found.st_size
        if size and (size + len(line) > self._limit_bytes or at - self._file_began > self._kept_s):
            self._folder.rename(FILE, OLDER)
            self._file_began = at
            self._is_cut = False
        if self._is_cut:
            line = b"\n" + line
        with self._folder.open(FILE, os.O_WRONLY | os.O_APPEND | os.O_CREAT) as file:
            if file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _left_since(self, now: float) -> float:
        """Look at the file that an earlier run has left, and return the time of its first event."""
        with self._folder.open(FILE) as file:
            first = _event_or_none(file.read(_BEGINNING).partition(b"\n")[0])
            file.seek(-1, os.SEEK_END)
            self._is_cut = file.read(1) != b"\n"
        return now if first is None else first.at

    def newest(self, limit: int, accepts: Callable[[Event], bool] | None = None, about: str = "") -> list[Event]:
        """Return the newest events, at most `limit`, that a function accepts, oldest first.

        Args:
            about: a text that is in each of them, such as an id or a path.
        """
        earliest, text = time.time() - self._kept_s, about.encode("utf-8", "backslashreplace")
        events = (_event_or_none(line) for line in self._newest_lines(text))
        found = (event for event in events if event and event.at >= earliest and (accepts is None or accepts(event)))
        return list(itertools.islice(found, limit))[::-1]

    def _newest_lines(self, text: bytes) -> Iterator[bytes]:
        ring = self._lines.copy()
        yield from (line for line in reversed(ring) if text in line)
        known = {b"", *ring}
        for content in _contents(self._folder):
            yield from (line for line in reversed(content.split(b"\n")) if text in line and line not in known)

    def of_children(self, limit: int, since: float = 0.0) -> list[Event]:
        """Return the newest events of children, at most `limit`, since a time, oldest first."""
        return self.newest(limit, lambda event: event.path != "" and event.at >= since, _PATH)


def _contents(folder: Folder) -> list[bytes]:
    """Return the contents of the newer file and of the older one, as far as they can be read."""
    contents: list[bytes] = []
    for name in (FILE, OLDER):
        with contextlib.suppress(OSError):
            contents.append(folder.read(name))
    if len(contents) == 2 and contents[0] and contents[1].startswith(contents[0]):
        del contents[0]  # it has become the older one between the two reads
    return contents


def event_in(line: bytes) -> Event:
    """Return the event in a line.

    Raises:
        msgspec.ValidationError: it is no event.
        msgspec.DecodeError, UnicodeDecodeError, RecursionError: the line is damaged.
    """
    _check(line)
    return Event.of(_decode(line))


def _event_or_none(line: bytes) -> Event | None:
    try:
        return event_in(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def left_events(state_dir: Path, limit: int, accepts: Callable[[Event], bool] | None = None) -> list[Event]:
    """Return the newest events that the systems of a state directory have left, oldest first; none without it."""
    try:
        with Folder.at(state_dir, to_read=True) as folder:
            return EventMemory(folder, 0, math.inf).newest(limit, accepts)
    except OSError:
        return []


def is_of_child(event: Event) -> bool:
    """Return whether an event is about a child."""
    return event.path != ""


def events_of(events: Sequence[Event], child: str) -> list[Event]:
    """Return the events of the child of a path or id, and of all below it; with "" all of them.

    Raises:
        NotFound: there is no such child among them or above them, or several have the id.
    """
    if not child:
        return list(events)
    paths = {path for event in events for path in _with_parents(event.path)}  # a root has no event of its own
    if (found := child_meant(child, paths)) is None:
        raise no_child(child, paths)
    return events_below(events, found)


def events_below(events: Sequence[Event], path: str) -> list[Event]:
    """Return the events of the child at this path, and of all below it; none if none is kept."""
    return [event for event in events if f"{event.path}/".startswith(f"{path}/")]


def _with_parents(path: str) -> Iterator[str]:
    """Yield a path, then those of the supervisors above it."""
    while path:
        yield path
        path = path.rpartition("/")[0]
