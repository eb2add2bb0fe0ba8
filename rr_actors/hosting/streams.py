"""Streams: a flow of values from the manager of a resource to those who hold it, beside the registrar.

A Publisher listens on a socket whose name is the resource's id and the stream's name. It is in the kernel's abstract
namespace, so nothing is left when the process is killed, and a respawned manager can take the name at once. A reader
connects to it. A reader sends a byte for each frame that it can take; the publisher sends no more frames than that.
Large frames go through shared memory (rr_actors/wire/segments.py).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, Self, cast

import msgspec

from rr_actors.base import pickling
from rr_actors.base.errors import MailboxFull, NameTaken, NotFound, Unavailable, UsageError, did_you_mean, few, shown
from rr_actors.base.names import check_name
from rr_actors.wire.segments import Lie, Parcel, Segments, can_open

IN_BAND_BYTES = 128 * 1024
"""The longest frame that goes over the socket if there is no shared memory for it."""

Keep = Literal["latest", "all"]

StreamHappening = Literal["stream_opened", "stream_rebound", "stream_closed"]
"""What may happen to a stream. "stream_rebound": a reader of another stream goes on with this one."""

_PACKET_BYTES = IN_BAND_BYTES + 4096
_MOST_DEPTH = 1000
_AGAIN_S = 0.01  # a reader tries as often to connect to a manager that is being respawned
_OPENS_S = 30.0  # how long a resource may have no stream at all, as long as a load may take
_LISTENS = 0x10000  # the flag of a listening socket in /proc/net/unix
_CREDENTIALS = struct.Struct("3i")
_MARK_S = 0.1  # a stream's rate is known of so long ...
_MARKS = 100  # ... times so many


class Stream(msgspec.Struct, frozen=True):
    """Names a stream: plain data that a response may contain.

    Attributes:
        resource_id: the resource that the stream belongs to.
        name: its name among the streams of the resource.
    """

    resource_id: str
    name: str


class StreamFrame(msgspec.Struct, frozen=True, eq=False):
    """One value of a stream, as a reader has got it.

    Attributes:
        value: what was published.
        number: from 1, without gaps at the publisher; from 1 again after a crash of the manager.
        published_at: when it was published, as time.time() says it.
        missed: how many frames the reader did not get since the one before.
        stream: the stream.
    """

    value: Any
    number: int
    published_at: float
    missed: int
    stream: Stream

    @property
    def age_s(self) -> float:
        """How long ago the frame was published."""
        return time.time() - self.published_at


class ReaderRow(msgspec.Struct, frozen=True):
    """A reader of a stream, as the publisher knows it.

    Attributes:
        registrar: the registrar that holds its query.
        pid: its process.
        keep: "latest" or "all".
        missed: how many frames it did not get since it came.
    """

    registrar: str
    pid: int
    keep: Keep
    missed: int


class StreamInfo(msgspec.Struct, frozen=True):
    """An open stream at one moment.

    Attributes:
        id: the resource's id, a slash, and the name.
        name: its name among the streams of the resource.
        server: the server of its resource, as "registrar/server".
        resource_id: its resource.
        rate_hz: how many frames were published a second, in the last ten seconds.
        bytes_per_s: how many bytes these had; those that nobody reads are not pickled, and have none.
        consumers: how many readers it has.
        missed: how many frames its readers missed, all together.
        age_s: how many seconds ago the last frame was published; None: there was none.
    """

    id: str
    name: str
    server: str
    resource_id: str
    rate_hz: float
    bytes_per_s: float
    consumers: int
    missed: int
    age_s: float | None


class StreamRow(msgspec.Struct, frozen=True):
    """A stream, as the console shows it.

    Attributes:
        info: what programs see of it.
        request: that of its resource as JSON, cut if it is long.
        frames: how many were published since it was opened.
        readers: those who read it now.
    """

    info: StreamInfo
    request: str
    frames: int
    readers: list[ReaderRow]


class StreamNews(msgspec.Struct, frozen=True):
    """Something that has happened to a stream. `reader`, `before`: the registrar that read another stream before."""

    what: StreamHappening
    stream: Stream
    reader: str = ""
    before: Stream | None = None


class _Meter:
    """Counts frames and their bytes, and how many there were in the last seconds. With the publisher's lock."""

    def __init__(self) -> None:
        self.frames = self._bytes = 0
        self._at = self._due = 0.0
        self._marks: deque[tuple[float, int, int]] = deque(maxlen=_MARKS)

    def note(self, size: int) -> int:
        """Count a frame, and return its number."""
        self.frames += 1
        self._bytes += size
        self._at = now = time.monotonic()
        if now >= self._due:
            self._due = now + _MARK_S
            self._marks.append((now, self.frames, self._bytes))
        return self.frames

    def read(self) -> tuple[float, float, float | None]:
        """Return frames a second, bytes a second, and the age of the last frame."""
        if not self.frames:
            return 0.0, 0.0, None
        now = time.monotonic()
        recent = (mark for mark in self._marks if now - mark[0] <= _MARK_S * _MARKS)
        began, frames, size = next(recent, (now, self.frames, self._bytes))
        age_s, count, took_s = now - self._at, self.frames - frames, self._at - began
        if count and age_s > 2 * took_s / count:  # it publishes no more, or less often
            took_s = now - began
        rate, bytes_s = (count / took_s, (self._bytes - size) / took_s) if count and took_s else (0.0, 0.0)
        return rate, bytes_s, age_s


class _Packet(msgspec.Struct, frozen=True, array_like=True):
    number: int
    published_at: float
    body: bytes | Parcel


class PublishedFrame(NamedTuple):
    """What is published. `body`: the value for all readers that can open segments; b"": there is no memory for it."""

    number: int
    published_at: float
    value: bytes | pickling.Large
    body: bytes | Parcel
    most_bytes: int  # that a reader may keep


class _Hello(msgspec.Struct, frozen=True, array_like=True):
    keep: Keep
    depth: int
    registrar: str = ""
    before: Stream | None = None  # the stream that it read until now


_hello, _packet = msgspec.msgpack.Decoder(_Hello), msgspec.msgpack.Decoder(_Packet)


def _address(stream: Stream) -> str:
    return f"\0rr_actors/{stream.resource_id}/{stream.name}"


def streams_in(plain: object) -> list[Stream]:
    """Return the streams that a response names, given as plain data."""
    if not isinstance(plain, dict | list):
        return []
    if isinstance(plain, dict):
        parts = cast("dict[object, object]", plain)
        if parts.keys() == {"resource_id", "name"}:
            with contextlib.suppress(msgspec.ValidationError):
                return [msgspec.convert(parts, Stream)]
        plain = list(parts.values())
    return [stream for part in cast("list[object]", plain) for stream in streams_in(part)]


def _pid_of(connected: socket.socket) -> int:
    """Return the other end's process; raise PermissionError if it runs as another user."""
    raw = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(raw)
    if uid != os.geteuid():
        raise PermissionError("the other end of the stream runs as another user")
    return pid


def _known(resource_id: str) -> dict[str, bool]:
    """Return the names of the streams that the resource has now, and whether readers are let in."""
    start = f"@rr_actors/{resource_id}/"
    known: dict[str, bool] = {}
    for line in Path("/proc/net/unix").read_text().splitlines():
        fields = line.split()
        if fields[-1].startswith(start):
            name = fields[-1].removeprefix(start)
            known[name] = known.get(name, False) or bool(int(fields[3], 16) & _LISTENS)
    return known


class _Line:
    """A socket that stays open as long as somebody has this object."""

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected

    def __del__(self) -> None:
        self.socket.close()


class Connected(Protocol):
    """The publisher's end of a reader's socket, which does not block."""

    def recv(self, size: int, /) -> bytes: ...

    def send(self, packet: bytes, /) -> int: ...

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class PollSet(Protocol):
    """Tells the publisher's thread of what happens to sockets."""

    def register(self, connected: Connected, events: int, /) -> None: ...

    def modify(self, connected: Connected, events: int, /) -> None: ...


class Shared(Protocol):
    """Lets others have a value that is in shared memory."""

    def share(self, parcel: Parcel, holder: object, most_bytes: int) -> Parcel | None: ...

    def discard(self, parcel: Parcel) -> None: ...

    def take_back(self, holder: object) -> None: ...


class KnownReader:
    """A reader, as its publisher knows it: what it is sent, and when, and how long what it has is in use.

    Args:
        pid: its process.
        rebound: hears of the registrar whose reader goes on with this stream, and of the stream before.

    Attributes:
        lock: for all that follows, and to send, so that no other reader waits for that.
        wanted: how many frames it can take.
        turns: with keep="all", the numbers of the frames that are being published. With the publisher's lock.
        left: it reads no more, but may still have values.
    """

    def __init__(
        self, connected: Connected, pid: int, parcels: Shared, ready: PollSet, rebound: Callable[[str, Stream], None]
    ) -> None:
        self.lock = threading.Lock()
        self._rebound = rebound
        self.keep: Keep | None = None  # until its hello has arrived
        self.wanted = 0
        self.turns: deque[int] = deque()
        self.left = self.gone = False
        self._registrar = ""
        self._offered = self._sent = 0  # frames
        self._socket = connected
        self._pid = pid
        self._shares = can_open(pid)
        self._parcels = parcels
        self._last = 0
        self._waiting: _Packet | None = None  # the newest frame, for when it wants one
        self._ready = ready
        self._hears = True
        ready.register(connected, select.EPOLLIN | select.EPOLLRDHUP)

    def hear(self, hears: bool) -> None:
        """Have the publisher's thread told what it sends, or only that it ends. With the lock."""
        if hears != self._hears and not self.left:
            self._hears = hears
            self._ready.modify(self._socket, select.EPOLLRDHUP | (select.EPOLLIN if hears else 0))

    def receive(self) -> None:
        """Read what it has sent, and send the frame that waits for it. With the lock."""
        try:
            while not self.left:
                raw = self._socket.recv(1024)
                if not raw:
                    self.leave()
                elif self.keep is None:
                    hello = _hello.decode(raw)
                    self.wanted = min(hello.depth, _MOST_DEPTH) if hello.keep == "all" else 0
                    self._registrar = hello.registrar
                    self.keep = hello.keep
                    if hello.before is not None:
                        self._rebound(hello.registrar, hello.before)
                else:
                    self.wanted += len(raw)
        except BlockingIOError:
            self._send()
            self.hear(self.keep != "latest" or self._waiting is not None)  # "all": it may send many bytes
        except (OSError, msgspec.MsgspecError):
            self.leave()

    def give(self, frame: PublishedFrame) -> bool:
        """Give it a frame in place of one that it has not wanted yet; return whether it gets it."""
        with self.lock:
            if not self.wanted:
                self.receive()
            self._offered += 1
            if self.left or frame.number < self._last or not (body := self._body_of(frame)):
                return False  # _last: of another thread, which was later
            self._drop()
            self._last, self._waiting = frame.number, _Packet(frame.number, frame.published_at, body)
            if not self._send():
                self.hear(True)
            return not self.left

    def _body_of(self, frame: PublishedFrame) -> bytes | Parcel | None:
        """Return what its packet carries; nothing: it keeps too many frames, or there is no memory for this one."""
        if self._shares or isinstance(frame.value, bytes):
            if isinstance(frame.body, bytes):
                return frame.body
            with contextlib.suppress(OSError):  # the stream is closed
                return self._parcels.share(frame.body, self, frame.most_bytes)
            return None
        whole = frame.value.whole()
        return whole if len(whole) <= IN_BAND_BYTES else None

    def has_room(self) -> bool:
        """Return whether a frame would be sent at once; if not, the publisher's thread hears when it would."""
        with self.lock:
            if not self.wanted:
                self.receive()
            return self.wanted > 0 and self._waiting is None

    def _send(self) -> bool:
        """Return whether the frame that waits is sent."""
        if self._waiting is None or not self.wanted:
            return False
        try:
            self._socket.send(msgspec.msgpack.encode(self._waiting))
        except BlockingIOError:
            return False
        except OSError:
            self.leave()
            return False
        self._waiting = None
        self.wanted -= 1
        self._sent += 1
        return True

    def miss(self) -> None:
        """Count a frame for which it was too far behind."""
        with self.lock:
            self._offered += 1

    def row(self) -> ReaderRow:
        """Return what is seen of it from outside."""
        with self.lock:
            waits = self._waiting is not None
            return ReaderRow(self._registrar, self._pid, self.keep or "latest", self._offered - self._sent - waits)

    def _drop(self) -> None:
        if self._waiting is not None and isinstance(self._waiting.body, Parcel):
            self._parcels.discard(self._waiting.body)
        self._waiting = None

    def leave(self) -> None:
        """Note that it reads no more. What it has stays in use until its end. With the lock."""
        if not self.left:
            self.left = True
            self._drop()
            self._ready.modify(self._socket, 0)  # its end is heard all the same

    def close(self) -> None:
        """Free all that it has: it has ended."""
        with self.lock:
            self.leave()
            self.gone = True
            self._socket.close()
            self._parcels.take_back(self)


class Publisher:
    """The manager's end of a stream. From any thread.

    Attributes:
        stream: names the stream; a response may contain it.
    """

    stream: Stream

    def __init__(self, stream: Stream, segments: Segments) -> None:
        self.stream = stream
        self._limit_bytes = segments.limit_bytes
        self._parcels = segments.parcels(os.getpid())
        self._changed = threading.Condition()  # a consumer has come, gone, or wants a frame
        self._consumers: dict[int, KnownReader] = {}
        self._meter = _Meter()
        self._tell: Callable[[StreamNews], None] | None = None  # when readers are let in
        self._closed = False
        self._door = threading.Lock()  # no reader is taken in while the listener is closed
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        ends: tuple[socket.socket, ...] = ()
        try:
            self._listener.bind(_address(stream))
            self._wake, self._woken = ends = socket.socketpair()
            self._ready = select.epoll()
            threading.Thread(target=self._serve, name=f"rr_actors-stream-{stream.name}", daemon=True).start()
        except (OSError, RuntimeError) as error:  # RuntimeError: the system has no more threads
            for end in (self._listener, *ends):
                end.close()
            raise Unavailable(f"stream {stream.name!r} of resource {stream.resource_id}: {error}") from error

    @property
    def name(self) -> str:
        """The stream's name."""
        return self.stream.name

    @property
    def wanted(self) -> bool:
        """Whether somebody reads the stream."""
        return bool(self._readers())

    def row(self, server: str, request: str) -> StreamRow:
        """Return what is seen of the stream from outside."""
        readers = [reader.row() for reader in self._readers()]
        missed = sum(reader.missed for reader in readers)
        with self._changed:
            frames, (rate_hz, bytes_per_s, age_s) = self._meter.frames, self._meter.read()
        place = (f"{self.stream.resource_id}/{self.name}", self.name, server, self.stream.resource_id)
        info = StreamInfo(*place, rate_hz, bytes_per_s, len(readers), missed, age_s)
        return StreamRow(info, request, frames, readers)

    def _readers(self) -> list[KnownReader]:
        return [reader for reader in list(self._consumers.values()) if reader.keep is not None and not reader.left]

    def publish(self, value: object, *, timeout_s: float | None = None) -> int:
        """Send a value to all readers, and return to how many; 0 after the stream is closed.

        It waits for readers with ``keep="all"`` that are `depth` frames behind, after all others have the value.
        Afterwards the value may be changed.

        Args:
            timeout_s: the longest wait; a reader that is still behind then misses the frame. None: no limit.

        Raises:
            NotSerializable: the value cannot be pickled.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        readers = [] if self._closed else self._readers()
        packed = pickling.dumps_large(value, f"a frame of stream {self.name!r}") if readers else b""
        body = self._body_of(packed)
        try:
            return self._publish(readers, packed, body, deadline)
        finally:
            if isinstance(body, Parcel):
                self._parcels.discard(body)

    def loan(self, shape: int | Sequence[int], dtype: object) -> Loan:
        """Return a context manager whose value is a numpy array to fill, which is published when the block ends.

        The array is in the memory that all readers share, so it is not copied. It contains anything at first. After the
        block it is read-only; do not write through other views of it. If the block raises, nothing is published.

        Args:
            shape, dtype: of the array, as numpy has them.

        Raises:
            UsageError: there is no numpy, or no such array, or it has Python objects.
        """
        return Loan(self, shape, dtype)

    def lend(self, value: pickling.Large) -> tuple[Parcel, memoryview] | None:
        """Return memory that the readers share, for a value with one buffer; None: nobody reads, or there is none."""
        if self.wanted:
            with contextlib.suppress(OSError):
                return self._parcels.lend(value)
        return None

    def publish_lent(self, value: pickling.Large, parcel: Parcel) -> None:
        """Send a value whose memory has been filled."""
        self._publish(self._readers(), value, parcel, None)

    def _publish(
        self, readers: list[KnownReader], packed: bytes | pickling.Large, body: bytes | Parcel, deadline: float | None
    ) -> int:
        with self._changed:
            if self._closed:
                return 0
            number = self._meter.note(len(packed))
            most_bytes = self._limit_bytes // (2 * len(readers) or 1)
            frame = PublishedFrame(number, time.time(), packed, body, most_bytes)
            behind = [reader for reader in readers if reader.keep == "all"]
            for reader in behind:
                reader.turns.append(frame.number)  # so that the frames of several threads stay in order
        try:
            sent = sum(reader.give(frame) for reader in readers if reader.keep == "latest")
            while ready := self._wait_for(behind, frame.number, deadline):
                sent += sum(reader.give(frame) for reader in ready)
                with self._changed:
                    for reader in ready:
                        reader.turns.popleft()
                        behind.remove(reader)
        finally:
            with self._changed:
                for reader in behind:
                    reader.turns.remove(frame.number)
                    reader.miss()
                self._changed.notify_all()  # those who publish the next frame
        return sent

    def _body_of(self, packed: bytes | pickling.Large) -> bytes | Parcel:
        try:
            return self._parcels.pack(packed)
        except (MailboxFull, Unavailable):
            return b""

    def _wait_for(self, behind: list[KnownReader], number: int, deadline: float | None) -> list[KnownReader]:
        """Wait for readers of all frames; return those that can take this one, or none at the end of the wait."""
        with self._changed:
            while not self._closed:
                behind[:] = [reader for reader in behind if not reader.left]
                if ready := [reader for reader in behind if reader.turns[0] == number and reader.has_room()]:
                    return ready
                left_s = None if deadline is None else deadline - time.monotonic()
                if not behind or not self._changed.wait(left_s and max(0.0, left_s)):
                    break
            return []

    def _serve(self) -> None:
        """Take readers in and hear what they want, until the stream is closed. In its own thread."""
        with self._ready as ready, self._woken:
            ready.register(self._woken, select.EPOLLIN)
            with self._door:
                if not self._closed:
                    ready.register(self._listener, select.EPOLLIN)
            while not self._closed:
                for fd, events in ready.poll():
                    if (consumer := self._consumers.get(fd)) is None:
                        self._accept()
                    elif events & select.EPOLLHUP:
                        del self._consumers[fd]
                        consumer.close()
                    else:
                        with consumer.lock:
                            consumer.receive()
                with self._changed:
                    self._changed.notify_all()
            for consumer in list(self._consumers.values()):
                consumer.close()
            self._consumers.clear()
            self._parcels.close()
        with self._changed:
            self._changed.notify_all()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # there is none, it is gone again, or of another user
            with self._door:
                connected, _ = self._listener.accept()
            try:
                connected.setblocking(False)
                consumer = KnownReader(connected, _pid_of(connected), self._parcels, self._ready, self._rebound)
            except OSError:
                connected.close()
                raise
            self._consumers[connected.fileno()] = consumer

    def _rebound(self, reader: str, before: Stream) -> None:
        if self._tell is not None:
            self._tell(StreamNews("stream_rebound", self.stream, reader, before))

    def let_in(self, tell: Callable[[StreamNews], None]) -> None:
        """Let readers in: the callback that opened the stream has returned.

        Args:
            tell: hears what happens to the stream, in any thread.
        """
        with self._door:
            if self._closed or self._tell is not None:
                return
            self._tell = tell
            self._listener.listen(128)
        tell(StreamNews("stream_opened", self.stream))

    def close(self) -> None:
        """End the stream, at once: readers wait for it to be opened again, as long as they hold the resource."""
        with self._door:
            self._closed = True
            self._listener.close()
            self._wake.close()  # the thread hears it, and closes the rest
            tell, self._tell = self._tell, None
        if tell is not None:
            tell(StreamNews("stream_closed", self.stream))


class Loan:
    """An array to fill, which a stream publishes: see Publisher.loan(). It is a context manager, for one block."""

    def __init__(self, publisher: Publisher, shape: int | Sequence[int], dtype: object) -> None:
        what = f"stream {publisher.name!r}: loan()"
        try:
            import numpy  # most programs do without; it is not among the package's requirements
        except ImportError:
            raise UsageError(f"{what} makes arrays of numpy, which is not installed: pip install numpy") from None
        try:
            array = numpy.empty(shape, cast(Any, dtype))
        except (TypeError, ValueError, MemoryError) as error:
            raise UsageError(f"{what}: no array of shape {shown(shape)} and dtype {shown(dtype)}: {error}") from error
        if array.dtype.hasobject:
            raise UsageError(f"{what}: an array of dtype {shown(dtype)} has Python objects: publish() it")
        self._publisher = publisher
        self._what = what
        self._array: Any = array
        self._lent: tuple[pickling.Large, Parcel] | None = None
        self._entered = False

    def __enter__(self) -> Any:
        if self._entered:
            raise UsageError(f"{self._what}: a loan is for one block: make another for the next frame")
        self._entered = True
        value = pickling.dumps_around(self._array, self._what)
        if len(value.buffers) == 1 and (lent := self._publisher.lend(value)) is not None:
            parcel, memory = lent
            self._array = pickling.loads_large(memoryview(value.parts[0]), [memory])
            self._lent = pickling.Large(self._array, self._what, value.parts, (memory,)), parcel
        return self._array

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        array, lent = self._array, self._lent
        self._array = self._lent = None
        array.flags.writeable = False
        if error is None and lent is not None:
            self._publisher.publish_lent(*lent)
        elif error is None:
            self._publisher.publish(array)


class Publishers:
    """The open streams of one registrar's resources. From any thread.

    Attributes:
        streams: the streams, by the ids of their resources and their names.

    Args:
        loop: gives the memory of frames that nobody has any more back to the machine.
    """

    def __init__(self, segments_limit_bytes: int | None, loop: asyncio.AbstractEventLoop) -> None:
        self._segments = Segments(segments_limit_bytes, IN_BAND_BYTES)
        self._segments.loop = loop
        self._lock = threading.Lock()
        self.streams: dict[str, dict[str, Publisher]] = {}

    def open(self, resource_id: str, name: object) -> Publisher:
        """Open a stream of a resource.

        Raises:
            InvalidName: `name` is none.
            NameTaken: the resource has such a stream.
        """
        stream = Stream(resource_id, check_name(name, "stream"))
        with self._lock:
            streams = self.streams.setdefault(resource_id, {})
            if stream.name in streams:
                raise NameTaken(f"resource {resource_id} has a stream {stream.name!r} already", name=stream.name)
            publisher = streams[stream.name] = Publisher(stream, self._segments)
        return publisher

    def let_in(self, resource_id: str, tell: Callable[[StreamNews], None]) -> None:
        """Let readers in to the streams of a resource: the callback that opens them has returned."""
        with self._lock:
            publishers = list(self.streams.get(resource_id, {}).values())
        for publisher in publishers:
            publisher.let_in(tell)

    def all(self) -> list[Publisher]:
        """Return the open streams."""
        with self._lock:
            return [publisher for streams in self.streams.values() for publisher in streams.values()]

    def close(self, resource_id: str) -> None:
        """Close the streams of a resource that is gone."""
        if self.streams:
            with self._lock:
                streams = self.streams.pop(resource_id, {})
            for publisher in streams.values():
                publisher.close()

    def close_all(self) -> None:
        """Close all streams: the registrar is closed."""
        for resource_id in list(self.streams):
            self.close(resource_id)


class Wake:
    """Wakes a reader that waits for a frame."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a reader's finalizer may run in any thread
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def set(self) -> None:
        """Wake the reader, or the next that waits."""
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)

    def wait(self, connected: socket.socket | None, timeout_s: float | None) -> bool:
        """Wait until there is something to read, or a call of set(); return whether there was such a call."""
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        if connected is not None:
            poll.register(connected, select.POLLIN)
        woken = self._fd in dict(poll.poll(None if timeout_s is None else timeout_s * 1000))
        if woken:
            os.eventfd_read(self._fd)
        return woken

    def close(self) -> None:
        """Close the descriptor. Nobody waits any more."""
        with self._lock:
            fd, self._fd = self._fd, -1
            if fd >= 0:
                os.close(fd)


class Source(NamedTuple):
    """What a reader asks its query.

    Attributes:
        registrar: the one that holds the query.
        is_over: whether the query is released; raises ResourceLost.
        named: returns the streams that the response names.
        watch: has a Wake set for each status, and at the end.
        unwatch: ends that.
    """

    resource_id: str
    registrar: str
    is_over: Callable[[], bool]
    named: Callable[[], list[Stream]]
    watch: Callable[[Wake], None]
    unwatch: Callable[[Wake], None]


class StreamReader:
    """The consumer's end of a stream: an iterator, an async iterator and a context manager of its frames.

    It ends when the query is released, and raises ResourceLost when the resource is lost. While the manager is
    respawned it waits for the stream to be opened again. If a new response names another stream, it goes on with that.

    Raises:
        UsageError: an argument is something else than Query.stream() says, or no name, and there are several streams.
        NotFound: the resource has streams, and none of this name. `.id`, `.known`
        Unavailable: there is no descriptor for it.
    """

    _wake: Wake | None = None

    def __init__(self, source: Source, name: str | None, keep: Keep, depth: int, timeout_s: float | None) -> None:
        what = "stream" if name is None else f"stream {name!r}"
        if keep not in ("latest", "all"):
            raise UsageError(f"{what}: keep: expected 'latest' or 'all', got {shown(keep)}")
        if type(depth) is not int or not 1 <= depth <= _MOST_DEPTH:
            raise UsageError(f"{what}: depth: expected 1 to {_MOST_DEPTH}, got {shown(depth)}")
        self._source = source
        self._name = name
        self._what = what
        self._stream: Stream | None = None
        self._hello = _Hello(keep, depth, source.registrar)
        self._before: Stream | None = None
        self._timeout_s = timeout_s
        self._line: _Line | None = None
        self._parcels = Segments(0).parcels(None)
        self._last = 0
        self._owes = False  # a frame that it has not said that it can take
        self._was_open = False
        self._closed = False
        self._reading = threading.Lock()
        try:
            self._wake = Wake()
        except OSError as error:
            raise Unavailable(f"{what} cannot be read: {error}") from error
        source.watch(self._wake)
        try:
            self._bind()
            if self._connect() is None:
                self._check_known(0)
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> StreamFrame:
        frame = self._receive()
        if frame is None:
            raise StopIteration
        return frame

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> StreamFrame:
        cancelled = threading.Event()
        try:
            frame = await asyncio.to_thread(self._receive, cancelled)
        except asyncio.CancelledError:
            cancelled.set()  # else its thread waits on, and asyncio.run() for that
            if (wake := self._wake) is not None:
                wake.set()
            raise
        if frame is None:
            raise StopAsyncIteration
        return frame

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if self._wake is not None:
            self._disconnect()
            self._wake.close()

    def close(self) -> None:
        """End the iteration, from any thread."""
        self._closed = True
        if self._wake is not None:
            self._wake.set()
        if self._reading.acquire(blocking=False):  # else the thread that reads does it
            try:
                self._end()
            finally:
                self._reading.release()

    def _end(self) -> None:
        """Give everything back. By the thread that reads."""
        self._disconnect()
        if self._wake is not None:
            self._source.unwatch(self._wake)
            self._wake.close()
            self._wake = None

    def _receive(self, cancelled: threading.Event | None = None) -> StreamFrame | None:
        """Wait for the next frame; None: there will be none, or nobody wants it any more."""
        began = time.monotonic()
        with self._reading:
            ended = True
            try:
                while (wake := self._wake) is not None and not (self._closed or self._source.is_over()):
                    waited_s = time.monotonic() - began
                    if cancelled is not None and cancelled.is_set():
                        ended = False
                        return None
                    if (left_s := None if self._timeout_s is None else self._timeout_s - waited_s) is not None:
                        self._check_time(left_s)
                    connected = self._line.socket if self._line is not None else self._connect()
                    if connected is None:
                        self._check_known(waited_s)
                        left_s = _AGAIN_S if left_s is None else min(_AGAIN_S, left_s)
                    self._ask(connected)
                    if wake.wait(connected, left_s) or self._stream is None:
                        self._bind()
                    elif connected is not None and (frame := self._read(connected)) is not None:
                        ended = False
                        return frame
            except TimeoutError:
                ended = False
                raise
            finally:
                if ended or self._closed:
                    self._end()
        return None

    def _check_time(self, left_s: float) -> None:
        if left_s <= 0:
            raise TimeoutError(f"{self._what}: no frame within {self._timeout_s:g} s")

    def _bind(self) -> None:
        """Find the stream that is meant now: one that the response names, or one of the resource's own."""
        own = self._source.resource_id
        named = {stream.name: stream for stream in self._source.named()}
        if self._name is not None:
            stream = named.get(self._name) or Stream(own, self._name)
        else:
            there = named or {name: Stream(own, name) for name, is_open in _known(own).items() if is_open}
            if len(there) > 1:
                names = few(map(repr, sorted(there)))
                raise UsageError(f"resource {own} has several streams: give the name of one, of {names}")
            stream = next(iter(there.values()), self._stream)
        if stream != self._stream:
            self._disconnect()
            if self._was_open:
                self._before = self._stream
            self._stream, self._was_open = stream, False

    def _check_known(self, waited_s: float) -> None:
        """Raise NotFound if the resource has other streams, or none for long, and never had this one."""
        if self._was_open:
            return
        resource_id = self._source.resource_id if self._stream is None else self._stream.resource_id
        known = _known(resource_id)
        name = None if self._stream is None else self._stream.name
        if name not in known and (any(known.values()) or waited_s > _OPENS_S):
            names = few(map(repr, sorted(known))) or "none"
            text = f"resource {resource_id} has no {self._what}; there are: {names}"
            raise NotFound(text + did_you_mean(name, known), id=name or "", known=tuple(sorted(known)))

    def _connect(self) -> socket.socket | None:
        if self._stream is None:
            return None
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connected.connect(_address(self._stream))
            self._parcels = Segments(0).parcels(_pid_of(connected))
            connected.send(msgspec.msgpack.encode(msgspec.structs.replace(self._hello, before=self._before)))
        except OSError:
            connected.close()
            return None
        self._line, self._was_open, self._before = _Line(connected), True, None
        self._last, self._owes = 0, self._hello.keep == "latest"
        return connected

    def _ask(self, connected: socket.socket | None) -> None:
        """Say that it can take one more frame, if it has not said so."""
        if self._owes and connected is not None:
            with contextlib.suppress(OSError):  # to read says that the publisher is gone
                connected.send(b"\0")
            self._owes = False

    def _read(self, connected: socket.socket) -> StreamFrame | None:
        """Return a frame that has arrived; None if there is none, or the publisher is gone."""
        try:
            raw = connected.recv(_PACKET_BYTES, socket.MSG_DONTWAIT)
            packet = _packet.decode(raw) if raw else None
            body = packet and packet.body
            make = None
            if isinstance(body, Parcel):
                claim = self._parcels.hold(body, self._line)
                claim.arm()
                make = claim.open
        except BlockingIOError:
            return None
        except (OSError, msgspec.MsgspecError, Lie):
            packet, body, make = None, None, None
        if packet is None or self._stream is None:
            self._disconnect()
            return None
        self._owes = True
        missed, self._last = packet.number - self._last - 1 if self._last else 0, packet.number
        value = pickling.loads(packet.body) if make is None else make()  # pyright: ignore[reportArgumentType]
        return StreamFrame(value, packet.number, packet.published_at, missed, self._stream)

    def _disconnect(self) -> None:
        line, self._line = self._line, None
        if line is not None:  # it closes with the last value in use
            with contextlib.suppress(OSError):
                line.socket.shutdown(socket.SHUT_WR)
        self._parcels.close()
