"""Publisher: the manager's end of a stream.

What is to be done with readers and frames is a task. The thread that has the turn does the tasks, one after another.
A thread that publishes takes the turn if it is free, and else leaves its task to the thread that has it. So no thread
waits for a lock, and a finalizer or a signal handler may publish while its own thread does. The main thread takes no
turn: a signal handler may raise between any two of its steps. It leaves its tasks to the stream's own thread.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TypeVar

from rr_actors.base import pickling
from rr_actors.base.errors import MailboxFull, Unavailable, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.shielding import Flag
from rr_actors.runtime.time_limits import deadline_of, time_limit
from rr_actors.streams.known_reader import KnownReader, PublishedFrame
from rr_actors.streams.loan import Loan
from rr_actors.streams.stream import Stream, StreamInfo, StreamRow, Tell
from rr_actors.streams.stream_sockets import (
    IN_BAND_BYTES,
    LARGE_FRAME_BYTES,
    OPENED,
    Packet,
    ReaderSocket,
    address_of,
    check_process,
    close_in_children,
)
from rr_actors.wire.segments import Parcel, Segments

logger = Log("rr_actors")

T = TypeVar("T")

_LOOK_S = 0.05  # a thread that waits for readers looks as often whether they have freed memory
_KEEPS_S = 0.1  # a reader that has read all is waited for so long to drop a value
_ACCEPT_S = 0.5  # after which readers are let in again, if there was no descriptor for one
_SCARCE = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS)
_MARK_S = 0.1  # a stream's rate is known of so long ...
_MARKS = 100  # ... times so many


class _Inside(threading.local):
    """Whether this thread does tasks of a stream, so a finalizer that runs in it must not wait for one."""

    now = False


_inside = _Inside()


class _Meter:
    """Counts frames and their bytes, and how many there were in the last seconds. One thread at a time calls note()."""

    def __init__(self) -> None:
        self.frames = self._bytes = 0
        self._at = self._due = self.best_hz = 0.0
        self._marks: deque[tuple[float, int, int]] = deque(maxlen=_MARKS)

    def note(self, size: int) -> int:
        """Count a frame, and return its number."""
        self.frames += 1
        self._bytes += size
        self._at = now = time.monotonic()
        if now >= self._due:
            self._due = now + _MARK_S
            if len(self._marks) == _MARKS:
                began, frames, _ = self._marks[0]
                self.best_hz = max(self.best_hz, (self.frames - frames) / (now - began))
            self._marks.append((now, self.frames, self._bytes))
        return self.frames

    def read(self) -> tuple[float, float, float | None]:
        """Return frames a second, bytes a second, and the age of the last frame."""
        if not self.frames:
            return 0.0, 0.0, None
        now = time.monotonic()
        recent = (mark for mark in tuple(self._marks) if now - mark[0] <= _MARK_S * _MARKS)
        began, frames, size = next(recent, (now, self.frames, self._bytes))
        age_s, count, took_s = now - self._at, self.frames - frames, self._at - began
        if count and age_s > 2 * took_s / count:  # it publishes no more, or less often
            took_s = now - began
        rate, bytes_s = (count / took_s, (self._bytes - size) / took_s) if count and took_s else (0.0, 0.0)
        return rate, bytes_s, age_s


class _Publishing:
    """One call that publishes. Only the thread that has the turn changes it, but for `given_up`.

    Attributes:
        readers: who read the stream when it was called.
        lent: where the value is already, if a loan is published.
        waits: whether it waits for readers that are behind.
        given_up: the caller has been interrupted, and may change the value.
        behind: the readers of all frames that have still to get it.
        sent: to how many readers it went.
        done: set when no reader has still to get it.
    """

    __slots__ = ("behind", "done", "error", "frame", "given_up", "lent", "readers", "sent", "value", "waits")

    def __init__(
        self, readers: list[KnownReader], value: bytes | pickling.Large, lent: Parcel | None, *, waits: bool
    ) -> None:
        self.readers = readers
        self.value = value
        self.lent = lent
        self.waits = waits
        self.given_up = False
        self.frame: PublishedFrame | None = None
        self.behind: list[KnownReader] = []
        self.sent = 0
        self.error: BaseException | None = None
        self.done = Flag()


def _copied(value: pickling.Large) -> pickling.Large:
    buffers = [memoryview(bytes(buffer)) for buffer in value.buffers]
    return pickling.Large(value.value, value.what, [bytes(part) for part in value.parts], buffers)


def _part_of(deadline: float) -> float:
    """Return how long a thread waits until it looks again."""
    left_s = deadline - time.monotonic()
    return min(_LOOK_S, left_s) if left_s > 0 else _LOOK_S


def _frees_memory(reader: KnownReader) -> bool:
    """Return whether the publisher waits for a reader that has still to read, and then drops, earlier frames."""
    return reader.keep == "all" and not reader.stuck and reader.has_unread()


def _is_main_thread() -> bool:
    return threading.get_ident() == threading.main_thread().ident


class Publisher:
    """The manager's end of a stream. From any thread.

    Attributes:
        stream: names the stream; a response may contain it.
    """

    stream: Stream

    def __init__(self, stream: Stream, segments: Segments, greeting: str = OPENED) -> None:
        self.stream = stream
        self._what = f"stream {stream.name!r} of resource {stream.resource_id}"
        self._pid = os.getpid()
        self._limit_bytes = segments.limit_bytes
        self._parcels = segments.parcels(self._pid)
        self._greeting = Packet(0, time.time(), b"", greeting)
        self._turn = threading.Lock()
        self._tasks: deque[Callable[[], None]] = deque()
        self._consumers: dict[int, KnownReader] = {}
        self._due: deque[_Publishing] = deque()  # there is no memory for them yet
        self._queues: dict[KnownReader, deque[_Publishing]] = {}  # what readers of all frames have still to get
        self._meter = _Meter()
        self._tell: Tell | None = None  # when readers are let in
        self._closed = self._ended = self._logged = False
        self._accepts_at: float | None = None  # there was no descriptor for a reader
        self._door = threading.RLock()  # no reader is taken in while the listener is closed
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        ends: tuple[socket.socket, ...] = ()
        try:
            self._listener.bind(address_of(stream))
            self._wake, self._woken = ends = socket.socketpair()
            for end in ends:
                end.setblocking(False)
            self._ready = select.epoll()
            threading.Thread(target=self._serve, name=f"rr_actors-stream-{stream.name}", daemon=True).start()
        except (OSError, RuntimeError) as error:  # RuntimeError: the system has no more threads
            for end in (self._listener, *ends):
                end.close()
            raise Unavailable(f"{self._what}: {error}") from error
        close_in_children(self)

    @property
    def name(self) -> str:
        """The stream's name."""
        return self.stream.name

    @property
    def wanted(self) -> bool:
        """Whether somebody reads the stream."""
        return bool(self._readers())

    def row(self, server: str, request: str) -> StreamRow:
        """Return what is seen of the stream from outside. It waits for nobody: it may be one frame late."""
        readers = [reader.row() for reader in self._readers()]
        missed = sum(reader.missed for reader in readers)
        frames, (rate_hz, bytes_per_s, age_s) = self._meter.frames, self._meter.read()
        place = (f"{self.stream.resource_id}/{self.name}", self.name, server, self.stream.resource_id)
        info = StreamInfo(*place, rate_hz, bytes_per_s, len(readers), missed, age_s, self._meter.best_hz)
        return StreamRow(info, request, frames, readers)

    def _readers(self) -> list[KnownReader]:
        return [reader for reader in list(self._consumers.values()) if reader.keep is not None and not reader.left]

    # -- to publish ----------------------------------------------------------------------------------------------------

    def publish(self, value: object, *, timeout_s: float | None = None) -> int:
        """Send a value to all readers, and return to how many; 0 after the stream is closed.

        It waits for readers with ``keep="all"`` that are `depth` frames behind, after all others have the value.
        Afterwards the value may be changed. A call in a finalizer that interrupts another call of the same thread does
        not wait: the value is sent when that call goes on.

        Args:
            timeout_s: the longest wait; a reader that is still behind then misses the frame, and is not waited for
                again until it has read something. None: no limit.

        Raises:
            NotSerializable: the value cannot be pickled.
            UsageError: `timeout_s` is no time limit, or this process is a child of the one that opened the stream.
        """
        limit_s = time_limit(timeout_s)
        check_process(self._pid, self._what)
        readers = [] if self._closed else self._readers()
        packed = pickling.dumps_large(value, f"a frame of stream {self.name!r}", LARGE_FRAME_BYTES) if readers else b""
        return self._publish(readers, packed, None, limit_s)

    def loan(self, shape: int | Sequence[int], dtype: object, *, timeout_s: float | None = None) -> Loan:
        """Return a context manager whose value is a numpy array to fill, which is published when the block ends.

        The array is in the memory that all readers share, so it is not copied. It contains anything at first. After the
        block it is read-only; do not write through other views of it. If the block raises, nothing is published.

        Args:
            shape, dtype: of the array, as numpy has them.
            timeout_s: the longest wait for readers when the block ends, as for publish().

        Raises:
            UsageError: there is no numpy, or no such array, or it has Python objects; or as for publish().
        """
        limit_s = time_limit(timeout_s)
        check_process(self._pid, self._what)
        return Loan(self, shape, dtype, limit_s)

    def lend(self, value: pickling.Large) -> tuple[Parcel, memoryview] | None:
        """Return memory that the readers share, for a value with one buffer; None: nobody reads, or there is none."""
        check_process(self._pid, self._what)
        if not self.wanted:
            return None

        def lend() -> tuple[Parcel, memoryview] | None:
            with contextlib.suppress(OSError):
                return self._parcels.lend(value)
            return None

        return self._have_done(lend) if _is_main_thread() else lend()

    def publish_lent(self, value: pickling.Large, parcel: Parcel, limit_s: float | None) -> int:
        """Send a value whose memory has been filled."""
        check_process(self._pid, self._what)
        return self._publish(self._readers(), value, parcel, limit_s)

    def _publish(
        self, readers: list[KnownReader], value: bytes | pickling.Large, lent: Parcel | None, limit_s: float | None
    ) -> int:
        waits = not _inside.now
        if not waits and isinstance(value, pickling.Large) and lent is None:
            value = _copied(value)  # it may change before it is sent
        publishing = _Publishing(readers, value, lent, waits=waits and limit_s != 0)
        deadline = deadline_of(limit_s)
        try:
            self._do(functools.partial(self._begin, publishing))
            while waits and not publishing.done.wait(_part_of(deadline)):
                late = time.monotonic() >= deadline
                self._do(functools.partial(self._end_wait, publishing) if late else self._go_on)
        except BaseException:
            publishing.given_up = True
            self._do(functools.partial(self._end_wait, publishing))
            raise
        if publishing.error is not None:
            raise publishing.error
        return publishing.sent if publishing.done.is_set else len(readers)

    # -- the turn ------------------------------------------------------------------------------------------------------

    def _do(self, task: Callable[[], None]) -> None:
        """Have a task done: by this thread, or by the one that has the turn, soon."""
        self._tasks.append(task)
        if _is_main_thread() and not self._ended:
            with contextlib.suppress(OSError):  # its thread is awake, or has ended: it has seen the task
                self._wake.send(b"\0")
            if not self._ended:
                return
        self._work()

    def _have_done(self, function: Callable[[], T]) -> T | None:
        """Return what a function returns that the stream's own thread calls; None if the stream is closed."""
        results: list[T] = []
        done = Flag()

        def call() -> None:
            try:
                results.append(function())
            finally:
                done.set()

        self._do(call)
        while not done.wait(_LOOK_S) and not self._ended:
            pass
        return results[0] if results else None

    def _work(self, *, waits: bool = False) -> None:
        """Do what is to be done while the turn is free, or after another thread has had it."""
        before, _inside.now = _inside.now, True
        try:
            while self._tasks and self._turn.acquire(blocking=waits):
                try:
                    while self._tasks:
                        self._do_next()
                finally:
                    self._turn.release()
        finally:
            _inside.now = before

    # -- tasks: with the turn ------------------------------------------------------------------------------------------

    def _do_next(self) -> None:
        try:
            self._tasks.popleft()()
        except Exception as error:  # the other tasks are of other threads, which wait for them
            logger.error("%s: %s", self._what, text_of(error), exc_info=error)

    def _begin(self, publishing: _Publishing) -> None:
        self._due.append(publishing)
        self._go_on()

    def _go_on(self) -> None:
        """Give readers what they can take."""
        while self._due:
            publishing = self._due[0]
            try:
                if not self._start(publishing):
                    break
            except Exception as error:
                self._fail(publishing, error)
            self._due.popleft()
        for reader in list(self._queues):
            self._give_next(reader)

    def _fail(self, publishing: _Publishing, error: Exception) -> None:
        """End a call with an error, which its thread raises."""
        publishing.error = error
        for reader in publishing.behind:
            with contextlib.suppress(KeyError, ValueError):
                self._queues[reader].remove(publishing)
        publishing.behind.clear()
        self._settle(publishing)

    def _start(self, publishing: _Publishing) -> bool:
        """Give a frame its number, and to those who do not have to wait; return False if it has to wait for memory."""
        ended = self._closed or publishing.given_up
        readers = [] if ended else [reader for reader in publishing.readers if not reader.left]
        body: bytes | Parcel = publishing.lent or b""
        why = ""
        if readers and not body:
            body, why = self._body_of(publishing.value)
            fits = len(publishing.value) <= self._limit_bytes  # else no reader can free enough for it
            if not body and fits and publishing.waits and any(map(_frees_memory, readers)):
                return False
        if publishing.given_up:  # the value may have changed while it was copied
            if isinstance(body, Parcel) and publishing.lent is None:
                self._parcels.discard(body)
        elif not self._closed:
            self._number(publishing, readers, body, why)
        self._settle(publishing)
        return True

    def _number(self, publishing: _Publishing, readers: list[KnownReader], body: bytes | Parcel, why: str) -> None:
        number = self._meter.note(len(publishing.value))
        most_bytes = self._limit_bytes // (2 * len(readers) or 1)
        frame = publishing.frame = PublishedFrame(number, time.time(), publishing.value, body, most_bytes, why)
        if why and not self._logged:
            self._logged = True
            logger.warning("%s: its readers miss frames: %s", self._what, why)
        publishing.behind = [reader for reader in readers if reader.keep == "all"]
        publishing.sent += sum(reader.give(frame) for reader in readers if reader.keep == "latest")
        for reader in publishing.behind.copy():
            self._queues.setdefault(reader, deque()).append(publishing)
            self._give_next(reader)

    def _body_of(self, packed: bytes | pickling.Large) -> tuple[bytes | Parcel, str]:
        """Return what a packet carries for a value; or nothing, and why."""
        try:
            body = self._parcels.pack(packed)
        except (MailboxFull, Unavailable) as error:
            return b"", str(error)
        if isinstance(body, bytes) and len(body) > IN_BAND_BYTES:
            return b"", f"there is no shared memory, and a frame of {len(body)} bytes is too long for a socket"
        return body, ""

    def _give_next(self, reader: KnownReader) -> None:
        """Give a reader of all frames what it can take now."""
        queue = self._queues.get(reader)
        while queue:
            publishing = queue[0]
            if not reader.left and not self._gives(reader, publishing):
                return
            queue.popleft()
            publishing.behind.remove(reader)
            self._settle(publishing)
        self._queues.pop(reader, None)

    def _gives(self, reader: KnownReader, publishing: _Publishing) -> bool:
        """Return whether a reader has got a frame, or is not waited for and has missed it."""
        assert publishing.frame is not None
        readiness = reader.readiness(publishing.frame)
        if readiness == "ready":
            publishing.sent += reader.give(publishing.frame)
            reader.keeps_since = None
            return True
        if publishing.waits and not reader.stuck and readiness == "keeps":
            now = time.monotonic()
            reader.keeps_since = reader.keeps_since or now
            reader.stuck = now >= reader.keeps_since + _KEEPS_S
        if publishing.waits and not reader.stuck:
            return False
        if readiness == "keeps":
            reader.give(publishing.frame)  # which tells it why it gets none
        else:
            reader.miss()
        return True

    def _settle(self, publishing: _Publishing) -> None:
        """End a call whose frame no reader has still to get."""
        if publishing.behind or publishing.done.is_set:
            return
        frame = publishing.frame
        if frame is not None and isinstance(frame.body, Parcel) and publishing.lent is None:
            self._parcels.discard(frame.body)
        publishing.done.set()

    def _end_wait(self, publishing: _Publishing) -> None:
        """Have the readers that are behind miss a frame. They are not waited for again until they say something."""
        publishing.waits = False
        for reader in publishing.behind.copy():
            reader.stuck = True
        self._go_on()

    # -- readers -------------------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        """Take readers in and hear what they want, until the stream is closed. In its own thread."""
        _inside.now = True
        self._ready.register(self._woken, select.EPOLLIN)
        with self._door:
            if not self._closed:
                self._ready.register(self._listener, select.EPOLLIN)
        while not self._closed:
            self._ready.poll(None if self._accepts_at is None else _ACCEPT_S)
            self._tasks.append(self._hear)
            self._work(waits=True)
        self._tasks.append(self._end)
        self._work(waits=True)

    def _hear(self) -> None:
        """Take in and hear the readers that are ready now. What was ready before the turn may be another one now."""
        if self._accepts_at is not None and time.monotonic() >= self._accepts_at:
            self._accepts_at = None
            with self._door:
                if not self._closed:
                    self._ready.register(self._listener, select.EPOLLIN)
        for fd, events in self._ready.poll(0):
            consumer = self._consumers.get(fd)
            if fd == self._woken.fileno():
                with contextlib.suppress(BlockingIOError):
                    self._woken.recv(4096)
            elif consumer is None:
                self._accept()
            elif events & select.EPOLLHUP:
                del self._consumers[fd]
                consumer.close()
            else:
                consumer.receive()
        self._go_on()

    def _accept(self) -> None:
        try:
            with self._door:
                if self._closed or self._accepts_at is not None:
                    return
                connected, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:  # it is gone again
            if error.errno in _SCARCE:
                logger.warning("%s: a reader waits: %s", self._what, error)
                self._ready.unregister(self._listener)
                self._accepts_at = time.monotonic() + _ACCEPT_S
            return
        try:
            end = ReaderSocket(connected)
            reader = KnownReader(end, end.pid, self._parcels, self._ready, self._rebound, self._greeting)
        except OSError:  # of another user, or gone
            connected.close()
            return
        self._consumers[connected.fileno()] = reader

    def _rebound(self, reader: str, before: Stream) -> None:
        if self._tell is not None:
            self._tell("stream_rebound", self.stream, reader, before)

    def let_in(self, tell: Tell) -> None:
        """Let readers in: the callback that opened the stream has returned.

        Args:
            tell: hears what happens to the stream, in any thread.
        """
        with self._door:
            if self._closed or self._tell is not None:
                return
            self._tell = tell
            self._listener.listen(128)
        tell("stream_opened", self.stream, "", None)

    def close(self) -> None:
        """End the stream, at once: readers wait for it to be opened again, as long as they hold the resource.

        Raises:
            UsageError: this process is a child of the one that opened the stream.
        """
        check_process(self._pid, self._what)
        with self._door:
            self._closed = True
            self._listener.close()
            tell, self._tell = self._tell, None
        with contextlib.suppress(OSError):
            self._wake.send(b"\0")  # the stream's thread closes the rest
        if tell is not None:
            tell("stream_closed", self.stream, "", None)

    def _end(self) -> None:
        self._ended = True
        for reader in list(self._consumers.values()):
            reader.close()
        self._consumers.clear()
        self._go_on()
        self._parcels.close()
        for descriptor in (self._ready, self._wake, self._woken):
            descriptor.close()

    def close_in_child(self) -> None:
        """Close the descriptors that a child of fork has of the stream."""
        for reader in self._consumers.values():
            reader.close_in_child()
        for descriptor in (self._listener, self._ready, self._wake, self._woken):
            descriptor.close()
