"""Recordings: the events, exits and messages of a system while it is recorded, in memory or in a file.

A file has one line of JSON for its header, and one for each entry. An entry "missed" says how many entries are missing
at its place. Entries "present" say what was there when the recording began. If the recording process was killed, its
file can be read to the last whole line.
"""

from __future__ import annotations

import functools
import io
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec

from rr_actors.base.errors import ConfigError, UsageError, counted, readable, shortened, shown, text_of
from rr_actors.base.folder import open_plain
from rr_actors.base.names import time_in
from rr_actors.base.reporting.log import Log
from rr_actors.base.steps import Steps
from rr_actors.registrar.links.recorder import RECORDED, entries_of
from rr_actors.registrar.model.recorded import DEAD_LETTER, DECIDED, Entry, in_order
from rr_actors.registrar.pages import ResourceRow
from rr_actors.registrar.queries import Query, ResourceInfo
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.figures import Counters
from rr_actors.system.recording.traces import Trace, messages_of, trace_of

logger = Log("rr_actors")

VERSION = 1
LIMIT = 100_000
"""The default number of entries that a recording in memory keeps: about 50 MB."""
LINE_LIMIT = 2**20
"""The longest line that is read from a file, in bytes."""
WAITING = 50_000
"""How many entries may wait for a slow disk; further entries are counted and dropped."""
_MISSED = "missed"  # the event of a line that says how many entries are missing
_PRESENT = "present"  # the event of a line that says what was there when the recording began
_TOGETHER = 200  # resources or children of such a line
_LATE_S = 0.1  # how long a process may take to send its last entries
_TOLD = 60  # bytes of a damaged line that an error shows
_WRITTEN_S = 10.0  # how long the end of a recording waits for the disk

Sink = Callable[[list[Entry], int], None]
"""A function that the loop calls with new entries, and with the number of entries that were dropped."""


class Header(msgspec.Struct, frozen=True):
    """The first line of a file: the version of its format, the system, and when the recording began."""

    recording: int
    system: str
    at: float


class PresentChild(msgspec.Struct, frozen=True):
    """A child that is there when a recording begins, and since when it is in its state."""

    path: str
    kind: str = ""
    state: str = ""
    pid: int | None = None
    since: float | None = None


class PresentResource(msgspec.Struct, frozen=True):
    """A resource that is there when a recording begins, and since when."""

    id: str
    server: str = ""
    text: str = ""
    phase: str = ""
    state: str = ""
    message: str = ""
    since: float | None = None


class Present(msgspec.Struct, frozen=True, omit_defaults=True):
    """A part of what is there when a recording begins.

    Attributes:
        left_out: how many resources are not in any part.
        notes: why more is not known.
    """

    children: list[PresentChild] = []
    resources: list[PresentResource] = []
    left_out: Annotated[int, msgspec.Meta(ge=0)] = 0
    notes: list[str] = []


class Recordings:
    """Numbers the entries of a running system, and gives them to its sinks. On the loop, except begin() and close().

    Args:
        record: a function that has its argument called for each event, and returns a function that ends this.
        want_decisions: has the registrars note their decisions, and returns a function that ends this.
        counters: get all entries, too, except those of decisions.
    """

    def __init__(
        self,
        record: Callable[[Callable[[dict[str, Any]], None]], Callable[[], None]],
        want_decisions: Callable[[], Callable[[], None]],
        counters: Counters,
    ) -> None:
        self.seq = 0
        self._counters = counters
        self._record = record
        self._want_decisions = want_decisions
        self._unrecord: Callable[[], None] | None = None
        self._sinks: dict[Sink, Callable[[], object] | None] = {}
        self._of_decisions: dict[Sink, Callable[[], None]] = {}  # what ends that the registrars note them, by sink
        self._lock = threading.Lock()

    def begin(
        self, sink: Sink, closed: Callable[[], object] | None = None, *, decisions: bool = False
    ) -> Callable[[], None]:
        """Have the sink called with each new entry. From any thread.

        Args:
            closed: called if the system stops while the sink is in use.
            decisions: have it called with those of decisions, too.

        Returns:
            A function that removes the sink. A second call does nothing.
        """
        with self._lock:
            self._sinks = {**self._sinks, sink: closed}
            if self._unrecord is None:
                self._unrecord = self._record(self._heard)
            if decisions:
                self._of_decisions = {**self._of_decisions, sink: self._want_decisions()}
        return functools.partial(self._end, sink)

    def _end(self, sink: Sink) -> None:
        with self._lock:
            self._sinks = {other: closed for other, closed in self._sinks.items() if other is not sink}
            if (unwant := self._of_decisions.get(sink)) is not None:
                self._of_decisions = {other: end for other, end in self._of_decisions.items() if other is not sink}
                unwant()
            if not self._sinks and self._unrecord is not None:
                unrecord, self._unrecord = self._unrecord, None
                unrecord()

    def close(self) -> None:
        """End all recordings when the system has stopped, and wait for those that write to a disk.

        Raises:
            Exception, ExceptionGroup: recordings did not end cleanly.
        """
        steps = Steps()
        for sink, closed in self._sinks.items():
            self._end(sink)
            if closed is not None:
                steps.take("ending a recording", closed)
        steps.end("not all recordings have ended cleanly")

    def leave_to_parent(self) -> None:
        """End all recordings in a forked child, without touching the parent's files."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        for sink in self._sinks:
            self._end(sink)

    def _heard(self, event: dict[str, Any]) -> None:
        dropped = 0
        if event["event"] == RECORDED:
            try:
                entries, dropped = entries_of(event), int(event["dropped"])
            except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
                logger.error("what a process has recorded cannot be read: %s", error)
                return
        else:
            entries = [entry_of(Event.of(event))]
        numbered = [msgspec.structs.replace(entry, seq=seq) for seq, entry in enumerate(entries, self.seq + 1)]
        self.seq += len(numbered)
        others = [entry for entry in numbered if entry.event != DECIDED]
        self._counters.take(others)
        for sink in self._sinks:
            sink(numbered if sink in self._of_decisions else others, dropped)


def entry_of(event: Event) -> Entry:
    """Return the entry of an event of the tree or of a resource."""
    facts = event.facts
    is_letter = event.event == DEAD_LETTER
    return Entry(
        event.at,
        event.event,
        process=event.path,
        pid=facts.get("pid") or 0,
        registrar=facts["to"] if is_letter else facts.get("registrar", ""),
        resource=facts.get("resource_id", ""),
        server=facts.get("server", ""),
        detail=readable(f"{facts['message']}: {facts['why']}" if is_letter else facts.get("detail", "")),
        facts=facts,
    )


class Recording:
    """The events and messages of a system. System.record() begins one; a with block ends it, and so does its system.

    In memory it keeps the newest entries. In a file it keeps the entries that the disk takes in time. `missed` counts
    the others.

    Attributes:
        system: the system's name.
        since: when it began, seconds since the epoch.
        missed: how many entries were dropped, as there was no room for them. A file keeps this number, too.
        path: the file that the entries are written to; None for a recording in memory.
        present: what was there when it began, as plain data: mappings with "children", "resources", "left_out" (how
            many resources are not among them), and "notes" (why others are not known).
        is_history: whether it is the history of a state directory, which has events alone.
    """

    def __init__(
        self,
        system: str,
        *,
        limit: int = LIMIT,
        path: Path | None = None,
        recordings: Recordings | None = None,
        decisions: bool = False,
    ) -> None:
        if type(limit) is not int or limit < 1:
            raise UsageError(f"record: limit: expected a whole number above 0, got {shown(limit)}")
        if type(decisions) is not bool:
            raise UsageError(f"record: decisions: expected True or False, got {shown(decisions)}")
        self.system = system
        self.since = time.time()
        self.missed = 0
        self.path = path
        self.present: list[dict[str, Any]] = []
        self.is_history = False
        self._lock = threading.Lock()
        self._entries: deque[Entry] = deque(maxlen=limit)
        self._pid = os.getpid()
        self._writer = None if path is None else _Writer(RecordingFile(path, system, self.since))
        begin = None if recordings is None else recordings.begin
        self._end = None if begin is None else begin(self._take, self._closed, decisions=decisions)

    def _take(self, entries: list[Entry], dropped: int = 0) -> None:
        with self._lock:
            self.missed += dropped
            if self._writer is not None:
                self.missed += self._writer.put(entries, dropped)
            elif self.path is None:
                self.missed += max(0, len(self._entries) + len(entries) - (self._entries.maxlen or 0))
                self._entries.extend(entries)

    def _note_present(self, entries: list[Entry]) -> None:
        """Keep what present_entries() returns: what is there as the recording begins."""
        with self._lock:
            self.present += [entry.facts for entry in entries]
            if self._writer is not None:
                self.missed += self._writer.put(entries, 0)

    def _closed(self) -> None:
        """Finish the file, as the system has stopped. stop() raises an error if not all of it was written."""
        self._end = None
        if (writer := self._writer) is not None:
            writer.finish()

    def stop(self) -> None:
        """End the recording after a tenth of a second, in which processes can send their last entries.

        A second call does nothing, nor does a call in a forked child.

        Raises:
            ConfigError: not all entries were written to the file.
        """
        if os.getpid() != self._pid:
            return
        end, self._end = self._end, None
        try:
            if end is not None:
                time.sleep(_LATE_S)
        finally:
            if end is not None:
                end()
            writer, self._writer = self._writer, None
            if writer is not None:
                writer.close()

    def entries(self) -> list[Entry]:
        """Return the entries, oldest first. Those of the last tenth of a second may be missing.

        If the clock was put back meanwhile, what was recorded before that comes first, with its later times.
        Those of decisions are not among them: replay() reads these.

        Raises:
            ConfigError: the recording's file cannot be read.
        """
        return [entry for entry in self._all() if entry.event != DECIDED]

    def decisions(self) -> list[Entry]:
        """Return the entries of decisions, oldest first; replay() decides them again.

        Raises:
            ConfigError: the recording's file cannot be read.
        """
        return [entry for entry in self._all() if entry.event == DECIDED]

    def _all(self) -> list[Entry]:
        if self.path is not None:
            return read_recording(self.path)._all()
        with self._lock:
            return in_order(self._entries)

    def trace(self, what: Query[Any] | ResourceInfo | str) -> Trace:
        """Return the trace of one load: its messages and answers, its callbacks, and the loads that these made.

        Of a message between actors it is the message, its answer, and the messages that its handler sent.

        Args:
            what: a query, a resource, or the id of either or of a message; its first four characters are enough. A
                name such as 'cameras/camera "front"' stands for all loads of it, and a server's id for all its loads.

        Raises:
            NotFound: the recording has no entry of it.
            UsageError: several ids begin with these characters.
        """
        return trace_of(self.entries(), what if isinstance(what, str) else what.id, of_query=isinstance(what, Query))

    def messages(self, *actors: str) -> Trace:
        """Return the messages, callbacks and ends of these actors and registrars; of all, if none is named.

        Args:
            actors: names, as entries have them: "root/ping", or its last part if that is enough.

        Raises:
            NotFound: the recording has no message of an actor of this name. `.id`, `.known`
        """
        return messages_of(self.entries(), actors)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the entries to a new file, which read_recording() reads. If that fails, there is no such file.

        Raises:
            ConfigError: the file is there already, or cannot be written.
        """
        entries = self._all()
        file = RecordingFile(Path(path), self.system, self.since)
        try:
            file.write([*_lines_of(self.present, self.since), *entries], self.missed)
            file.close()
        except BaseException:
            file.remove()
            raise

    def __len__(self) -> int:
        return len(self._entries) if self.path is None else len(self._all())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        where = f"in {self.path}" if self.path is not None else counted(len(self._entries), "entry")
        return f"<Recording of {self.system}: {where}, {self.missed} missed>"


def add(recording: Recording, entries: list[Entry], dropped: int = 0) -> None:
    """Add entries to a recording that is not connected to a running system."""
    recording._take(entries, dropped)  # pyright: ignore[reportPrivateUsage]  # same file


def present_entries(
    children: Iterable[Mapping[str, Any]],
    resources: Iterable[ResourceRow],
    left_out: int,
    notes: Sequence[str],
    now: float,
) -> list[Entry]:
    """Return entries that say what is there at the time `now`; few enough of it in each for a line of a file.

    Args:
        children: with the path, type, state, pid and up_s of each.
        left_out: how many resources are there beside these.
        notes: why more are not known.
    """
    tree = [
        PresentChild(
            child["path"],
            child["type"],
            child["state"],
            child["pid"],
            None if child["up_s"] is None else now - child["up_s"],
        )
        for child in children
    ]
    served = [
        PresentResource(
            row.id,
            row.server,
            row.text,
            "revoked" if row.condition == "revoked" else row.phase,
            row.state or "OK",
            shortened(row.message),
            time_in(row.id),
        )
        for row in resources
    ]
    parts = [Present(tree[at : at + _TOGETHER]) for at in range(0, len(tree), _TOGETHER)]
    parts += [Present(resources=served[at : at + _TOGETHER]) for at in range(0, len(served), _TOGETHER)]
    last = {"left_out": left_out, "notes": [shortened(note) for note in notes]}  # it is there, whatever there was
    return _lines_of([*map(msgspec.to_builtins, parts), last], now)


def _lines_of(present: list[dict[str, Any]], at: float) -> list[Entry]:
    return [Entry(at, _PRESENT, facts=facts) for facts in present]


def note_present(recording: Recording, entries: list[Entry]) -> None:
    """Have a recording keep what present_entries() returns."""
    recording._note_present(entries)  # pyright: ignore[reportPrivateUsage]  # same file


class RecordingFile:
    """A new file that entries are written to, which only its user can read (0600).

    The first write that fails is logged; close() raises its error.

    Raises:
        ConfigError: the file exists already, or cannot be made.
    """

    def __init__(self, path: Path, system: str, since: float) -> None:
        self.path = path
        self._failure: Exception | None = None
        self._encode = msgspec.json.Encoder(enc_hook=str).encode
        try:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except FileExistsError as error:
            raise ConfigError(f"{path}: there is a file already; remove it, or name another", file=str(path)) from error
        except OSError as error:
            raise ConfigError(f"{path}: cannot be made: {error.strerror}", file=str(path)) from error
        self._file = os.fdopen(fd, "wb", buffering=2**16)
        try:
            self._file.write(self._encode(Header(VERSION, system, since)) + b"\n")
            self._file.flush()
        except OSError as error:
            self.remove()
            text = f"{path}: cannot be written: {error.strerror}; make room, or name a file on another disk"
            raise ConfigError(text, file=str(path)) from error

    def write(self, entries: Iterable[Entry], missed: int = 0) -> None:
        """Write entries, and how many are missing after them, to the operating system's cache."""
        if self._failure is not None or self._file.closed:
            return
        try:
            for entry in entries:
                self._file.write(self._line(entry))
            if missed:
                self._file.write(self._line(Entry(time.time(), _MISSED, facts={"count": missed})))
            self._file.flush()
        except Exception as error:  # a full disk, or a defect of this code
            self._failure = error
            logger.exception("%s: the recording ends here", self.path)

    def _line(self, entry: Entry) -> bytes:
        try:
            line = self._encode(entry) + b"\n"
            if len(line) <= LINE_LIMIT:
                return line
            lost = f"a line of {len(line)} bytes, over the limit of {LINE_LIMIT}"
        except (UnicodeEncodeError, TypeError, ValueError) as error:  # for instance half a character in a file's name
            lost = str(error)
        bare = msgspec.structs.replace(entry, detail=readable(entry.detail), facts={"lost": readable(lost)})
        return self._encode(bare) + b"\n"

    def finish(self) -> None:
        """Close the file; close() raises the error of a failure. A second call does nothing."""
        try:
            self._file.close()
        except OSError as error:
            self._failure = self._failure or error

    def remove(self) -> None:
        """Close the file, and remove it."""
        self.finish()
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file.

        Raises:
            ConfigError: not all entries were written.
        """
        self.finish()
        if (failure := self._failure) is not None:
            text = f"{self.path}: not all of the recording was written: {text_of(failure)}"
            raise ConfigError(text, file=str(self.path)) from failure


class _Writer:
    """Writes entries to a file in a thread of its own, which waits for the disk. Any thread may call its methods."""

    def __init__(self, file: RecordingFile) -> None:
        self._file = file
        self._waiting: list[Entry] = []
        self._missed = 0  # entries that are missing after the waiting ones
        self._changed = threading.Condition()
        self._is_finished = False
        self._thread = threading.Thread(target=self._write, name="rr-recording", daemon=True)
        self._thread.start()

    def put(self, entries: list[Entry], missed: int) -> int:
        """Queue entries, and a number of missing ones, for the file; return how many entries found no room."""
        with self._changed:
            room = 0 if self._is_finished else max(0, WAITING - len(self._waiting))
            self._waiting += entries[:room]
            left_out = max(0, len(entries) - room)
            self._missed += missed + left_out
            self._changed.notify()
        return left_out

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._missed or self._is_finished)
                entries, self._waiting = self._waiting, []
                missed, self._missed = self._missed, 0
            if not entries and not missed:
                break
            self._file.write(entries, missed)
        self._file.finish()

    def finish(self) -> None:
        """Take no more entries, and wait until all waiting ones are written, at most 10 s."""
        with self._changed:
            self._is_finished = True
            self._changed.notify()
        self._thread.join(_WRITTEN_S)

    def close(self) -> None:
        """Finish the file as finish() does, and raise an error if that failed.

        Raises:
            ConfigError: not all entries were written.
        """
        self.finish()
        if self._thread.is_alive():
            text = f"{self._file.path}: not all of the recording was written within {_WRITTEN_S:g} s"
            raise ConfigError(text, file=str(self._file.path))
        self._file.close()


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Return the recording that a file holds; `missed` is the number of entries that the file says are missing.

    A last line that is not whole is left out.

    Raises:
        ConfigError: the file does not exist, or is no recording; the error names the line.
    """
    path = Path(path)
    try:
        with open_plain(path) as file:
            return recording_in(path, file, file.readline(LINE_LIMIT))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}", file=str(path)) from error


def recording_in(path: Path, file: io.BufferedReader, first: bytes) -> Recording:
    """Return the recording in a file that is open, whose first line was read; raise what read_recording() raises."""
    if not first:
        raise ConfigError(f"{path}: expected a recording, got an empty file", file=str(path))
    header = _decoded(path, 1, first, Header)
    if header.recording != VERSION:
        text = f"{path}: a recording of version {header.recording}, expected {VERSION}: use the same rr_actors"
        raise ConfigError(text, file=str(path))
    _check_time(path, 1, header.at)
    lines = list(_lines(path, file))
    entries = [entry for entry in lines if entry.event not in (_MISSED, _PRESENT)]
    recording = Recording(header.system, limit=max(1, len(entries)))
    recording.since = header.at
    recording.present = [entry.facts for entry in lines if entry.event == _PRESENT]
    add(recording, entries, sum(entry.facts["count"] for entry in lines if entry.event == _MISSED))
    return recording


def _lines(path: Path, file: io.BufferedReader) -> Iterator[Entry]:
    number = 1
    while line := file.readline(LINE_LIMIT):
        number += 1
        if not line.endswith(b"\n") and len(line) < LINE_LIMIT:  # cut off
            return
        entry = _decoded(path, number, line, Entry)
        _check_time(path, number, entry.at)
        if entry.event == _PRESENT:
            _check_present(path, number, entry)
        count = entry.facts.get("count")
        if entry.event == _MISSED and not (type(count) is int and count >= 0):
            raise _damaged(path, number, 'a whole number as "count"', shown(entry.facts), '"missed": ')
        yield entry


def _check_present(path: Path, number: int, entry: Entry) -> None:
    """Raise ConfigError if the facts of an entry do not say what was there."""
    try:
        there = msgspec.convert(entry.facts, Present)
    except msgspec.ValidationError as error:
        expected = f"what rr-actors record writes ({error})"
        raise _damaged(path, number, expected, shown(entry.facts), '"present": ') from error
    for one in (*there.children, *there.resources):
        _check_time(path, number, one.since or 0.0)


def _check_time(path: Path, number: int, at: float) -> None:
    """Raise ConfigError if a time cannot be shown."""
    try:
        time.localtime(at)
    except (OverflowError, ValueError, OSError) as error:
        raise _damaged(path, number, "a time, in seconds since the epoch", f"{at:g}") from error


def _damaged(path: Path, number: int, expected: str, got: str, what: str = "") -> ConfigError:
    text = f"{path}: line {number}: {what}expected {expected}, got {got}"
    return ConfigError(text + _whole_part(path, number), file=str(path))


def _decoded(path: Path, number: int, line: bytes, kind: Any) -> Any:
    try:
        return msgspec.json.decode(line, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        got = f"{shown(line[:_TOLD])}: {error}"
        raise _damaged(path, number, "what rr-actors record writes", got) from error


def _whole_part(path: Path, number: int) -> str:
    """Say what can still be read of a file that is damaged in this line."""
    if number < 3:
        return ""
    return (
        f"; the {counted(number - 2, 'entry')} before it can still be read: head -n {number - 1} {path} > whole.jsonl"
    )
