"""Large values between two processes of one machine: in shared memory, beside their connection.

Each end of a connection that sends large values makes one segment, a memfd. It has no name: the kernel frees it with
the last process that has it. The segment is as long as the limit, but takes memory only where it was written, and
address space as far as it is used. A message carries a Parcel, which says where in the segment its value is. The other
end opens the descriptor by /proc/PID/fd, maps the segment, and makes the value from the bytes there. Buffers are not
copied at that end: the value has the slot until it is collected (rr_actors/wire/shared_values.py).

The owner reads nothing from the segment but the bytes of its head, by which the other end frees slots. A segment lives
as long as its connection, or the last value in it. Where a segment cannot be had, the value goes through the
connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import functools
import mmap
import os
import resource
import stat
import struct
import sys
import threading
import time
import weakref
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec

from rr_actors.base.errors import MailboxFull, Unavailable, few, text_of
from rr_actors.base.pickling import LARGE_BYTES, Bytes, Large
from rr_actors.base.scarcity import memory_bytes, wanted_by
from rr_actors.wire.frames import FRAME_LIMIT_BYTES
from rr_actors.wire.segment_slots import PAGE_BYTES, USED, Head, Slot, Slots
from rr_actors.wire.shared_values import Claim

IDLE_S = 5.0
"""How long a segment is unused until its free pages are given back to the machine."""

HEAD_BYTES = max(PAGE_BYTES, 64 * 1024)
"""The length of a segment's head, which has a byte for each number of a slot."""

_KEY = struct.Struct("<Q")
_NUMBERS = range(_KEY.size, HEAD_BYTES)  # the numbers of slots are the places of their bytes in the head
_ALIGNED = 64
_MAPPED_BYTES = 64 << 20  # of a segment at first; then twice as many
_PIECE_BYTES = 16 << 20  # given back at a time, which takes the loop some milliseconds
_PIECE_S = 0.02
_CHUNK_BYTES = 1 << 20  # copied at a time, so that other threads of this process get their turns
_SEALS = "F_SEAL_SHRINK", "F_SEAL_GROW", "F_SEAL_SEAL"


class Parcel(msgspec.Struct, frozen=True, array_like=True):
    """Where a large value is: a pickle and its buffers, one after the other in a slot of the sender's segment.

    Attributes:
        fd: the segment's descriptor in the sender.
        key: the number in the segment's head, which no other segment has.
        lengths: the lengths of the pickle and of each buffer. Each begins at a multiple of 64 bytes.
    """

    fd: int
    key: int
    segment_bytes: int
    slot: int
    start: int
    lengths: tuple[int, ...]

    def __len__(self) -> int:
        return sum(self.lengths)


class Lie(Exception):
    """A Parcel that cannot be true."""


def _places(start: int, lengths: Sequence[int]) -> list[int]:
    """Return where each part begins, and where the last ends."""
    places = [start]
    for length in lengths:
        places.append(places[-1] + -(-length // _ALIGNED) * _ALIGNED)
    return places


def places_in(parcel: Parcel, head: Head) -> list[int]:
    """Return where each part of a value in a segment begins, and where the last ends; raise Lie if it cannot be there.

    Args:
        head: the bytes of the segment, as far as they are mapped.
    """
    places = _places(parcel.start, parcel.lengths)
    if (
        not parcel.lengths
        or min(parcel.lengths) < 0
        or places[-1] > len(head)
        or parcel.slot not in _NUMBERS
        or head[parcel.slot] != USED
    ):
        raise Lie("it sent a value that is not in its segment")
    return places


def _mapped_bytes(needed: int, before: int, most: int) -> int:
    """Return how much of a segment is mapped when so much is needed, and so much was mapped before."""
    return min(most, max(needed, 2 * before, _MAPPED_BYTES))


class Segments:
    """The segments of one process, which have one limit together. From any thread.

    Args:
        limit_bytes: the memory that they may take; 0: there are none. Default: a quarter of what this process may have.
        frame_limit_bytes: the length of the longest message.

    Attributes:
        large_bytes: the length from which on a value goes through a segment.
    """

    def __init__(self, limit_bytes: int | None = None, frame_limit_bytes: int = FRAME_LIMIT_BYTES) -> None:
        self._given_bytes = limit_bytes
        self.frame_limit_bytes = frame_limit_bytes
        self.large_bytes = min(LARGE_BYTES, frame_limit_bytes // 2)
        self._lock = threading.RLock()
        self._inside = False
        self.loop: asyncio.AbstractEventLoop | None = None  # which gives idle pages back
        self._owned: weakref.WeakSet[_Owned] = weakref.WeakSet()
        self._waiting = False
        self._used_at = 0.0

    @functools.cached_property
    def limit_bytes(self) -> int:
        """The memory that they may take. To find what this process may have takes some 20 reads of files."""
        return memory_bytes() // 4 if self._given_bytes is None else self._given_bytes

    def _is_used(self) -> bool:
        with self.bookkeeping():
            return self.room < self.limit_bytes

    @contextlib.contextmanager
    def bookkeeping(self) -> Generator[None]:
        """Hold the lock for all bookkeeping; raise OSError in a finalizer that runs in the thread that has it."""
        with self._lock:
            if self._inside:
                raise OSError("another value is being sent by this thread")
            self._inside = True
            try:
                yield
            finally:
                self._inside = False

    @property
    def room(self) -> int:
        """How many more bytes segments may take. With the lock."""
        return self.limit_bytes - sum(owned.slots.resident for owned in self._owned)

    def parcels(self, pid: int | None) -> Parcels:
        """Return one end of a connection with the process `pid`; 0 or None: it is not known."""
        return Parcels(self, pid or 0)

    def make(self, pid: int) -> _Owned:
        """Make a segment that the process `pid` can open; raise OSError if that is impossible. With the lock."""
        if not self.limit_bytes or not can_open(pid):
            raise OSError("the other process cannot open segments of this one")
        owned = _Owned(self.limit_bytes, pid)
        self._owned.add(owned)
        return owned

    def in_use(self) -> str:
        """Say how many bytes of values are in use, by which processes."""
        with self.bookkeeping():
            sizes: dict[int, int] = {}
            for owned in self._owned:
                sizes[owned.pid] = sizes.get(owned.pid, 0) + owned.in_use()
        most = sorted(((size, pid) for pid, size in sizes.items() if size), reverse=True)
        return few(f"{size} by process {pid}" for size, pid in most) or "none"

    def give_back(self, most: int = sys.maxsize) -> int:
        """Give the free pages of all segments back to the machine, at most so many bytes; return how many it were."""
        with self.bookkeeping():
            given = 0
            for owned in self._owned:
                given += owned.give_back(most - given)
            return given

    def used(self) -> None:
        """Note that a slot was taken: when none was for IDLE_S, the loop gives free pages back."""
        self._used_at = time.monotonic()
        if self._waiting or self.loop is None:
            return
        self._waiting = True
        try:
            self.loop.call_soon_threadsafe(self._look)
        except RuntimeError:  # the loop has ended
            self._waiting = False

    def _look(self) -> None:
        loop = asyncio.get_running_loop()
        left_s = self._used_at + IDLE_S - time.monotonic()
        if left_s > 0:
            loop.call_later(left_s, self._look)
        elif self.give_back(_PIECE_BYTES) == _PIECE_BYTES:  # the loop has other things to do, too
            loop.call_later(_PIECE_S, self._look)
        elif self._is_used():
            loop.call_later(IDLE_S, self._look)
        else:
            self._waiting = False


class _Owned:
    """A segment of this process, for one connection. Its methods are called with the lock, but for write() and lend().

    Attributes:
        pid: the process at the other end.
        bytes: the length of the segment.
    """

    fd = -1

    def __init__(self, limit_bytes: int, pid: int) -> None:
        longest = resource.getrlimit(resource.RLIMIT_FSIZE)[0]  # of any file, also of a memfd
        limit_bytes = limit_bytes if longest < 0 else min(limit_bytes, longest // PAGE_BYTES * PAGE_BYTES - HEAD_BYTES)
        self.pid = pid
        self.bytes = HEAD_BYTES + -(-limit_bytes // PAGE_BYTES) * PAGE_BYTES
        self.key = int.from_bytes(os.urandom(_KEY.size), "little")
        self.fd = fd = os.memfd_create("rr_actors", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, self.bytes)
        for seal in _SEALS:
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, getattr(fcntl, seal))
        self._map = head = mmap.mmap(fd, _mapped_bytes(HEAD_BYTES, 0, self.bytes))
        _KEY.pack_into(head, 0, self.key)
        self.slots = Slots(head, HEAD_BYTES, self.bytes, _NUMBERS)

    def __del__(self) -> None:
        """Close the descriptor: no thread writes any more."""
        if self.fd >= 0:
            os.close(self.fd)

    def write(self, slot: Slot, part: Bytes, at: int) -> None:
        """Write a part of a value to its place; raise OSError if the machine has no memory for it."""
        rest = memoryview(part)
        mapped = None if slot.fresh else self._map_to(slot.end)
        while rest:
            chunk = rest[:_CHUNK_BYTES]
            if mapped is None:  # a system call reports that there is no memory; a write to the map would kill
                written = os.pwrite(self.fd, chunk, at)
            else:
                written = len(chunk)
                mapped[at : at + written] = chunk
            rest, at = rest[written:], at + written

    def _map_to(self, end: int) -> mmap.mmap | None:
        """Return a map of the segment up to this byte; None if there is no address space for it."""
        mapped = self._map
        if len(mapped) < end:
            try:
                mapped = mmap.mmap(self.fd, _mapped_bytes(end, len(mapped), self.bytes))
            except (OSError, MemoryError):
                return None
            if len(self._map) < len(mapped):  # else another thread was faster
                self._map = mapped  # the map before lives as long as the values that use it
        return mapped

    def lend(self, slot: Slot, places: Sequence[int], lengths: Sequence[int]) -> memoryview:
        """Return the memory of a slot, which is in use until nothing uses the memory any more."""
        if (mapped := self._map_to(slot.end)) is None:
            raise OSError(errno.ENOMEM, "there is no address space for the segment")
        claim = Claim(mapped, slot.number, places, lengths, self, shared=False)
        claim.arm()
        return claim.memory()

    def in_use(self) -> int:
        """Return how many bytes of the segment have values."""
        self.slots.collect()
        return sum(slot.end - slot.start for slot in {slot.start: slot for slot in self.slots.used.values()}.values())

    def discard(self, slot: Slot) -> None:
        """Free a slot that could not be written, and give its pages back."""
        self.slots.free(slot.number)
        self.give_back(sys.maxsize)

    def give_back(self, most: int) -> int:
        """Give free pages back to the machine, at most so many bytes; return how many it were."""
        pieces = self.slots.cool(most)
        for start, end in pieces:
            if end <= len(self._map):
                self._map.madvise(mmap.MADV_REMOVE, start, end - start)
            else:
                with contextlib.suppress(OSError), mmap.mmap(self.fd, end - start, offset=start) as piece:
                    piece.madvise(mmap.MADV_REMOVE)
        return sum(end - start for start, end in pieces)


class Parcels:
    """One end of a connection: puts large values into a segment of its own, and reads them from the other end's."""

    def __init__(self, segments: Segments, pid: int) -> None:
        self.large_bytes = segments.large_bytes
        self._segments = segments
        self._pid = pid
        self._owned: _Owned | None = None
        self._theirs: tuple[int, int, int] | None = None  # the descriptor, key and length of the other end's segment
        self._map: mmap.mmap | None = None  # of that
        self._closed = False

    def pack(self, value: bytes | Large) -> bytes | Parcel:
        """Return what a message carries for a value: all its bytes, or a Parcel. From any thread.

        Raises:
            MailboxFull: the segments are full, and the value is too long for a message.
            NotSerializable, Unavailable: there can be no segment, and the value is too long for a message, or cannot be
                pickled as a whole.
        """
        if type(value) is bytes:
            return value
        large = cast(Large, value)
        try:
            parcel = self._parcel(large)
        except (OSError, AttributeError, ValueError, OverflowError) as error:  # AttributeError: another system
            return self._whole(large, error)
        return parcel if parcel is not None else self._whole(large, None)

    def _whole(self, value: Large, why: Exception | None) -> bytes:
        """Return all bytes of a value for which there is no room in a segment, or there can be none: `why`."""
        body = value.whole()
        if len(body) <= self._segments.frame_limit_bytes or (why is not None and not wanted_by(why)):
            return body
        if why is not None:
            raise Unavailable(f"{len(body)} bytes need a segment of shared memory: {wanted_by(why)}") from why
        limit, segments = self._segments.limit_bytes, self._segments.in_use()
        raise MailboxFull(
            f"no segment of shared memory has room for {len(body)} bytes for process {self._pid}: the limit is {limit} "
            f"(segments_limit_bytes); bytes in use: {segments}",
            name=str(self._pid),
            limit=limit,
        )

    def _parcel(self, value: Large) -> Parcel | None:
        if (found := self._room_for(value)) is None:
            return None
        owned, slot, parcel = found
        with self._discarded_at_errors(owned, slot):
            _write_parts(owned, slot, value)
            for buffer, at in zip(value.buffers, _places(slot.start, parcel.lengths)[1:], strict=False):
                owned.write(slot, buffer, at)
        self._segments.used()
        return parcel

    def lend(self, value: Large) -> tuple[Parcel, memoryview] | None:
        """Return a parcel for a value whose only buffer is still to be written, and the memory of that.

        The slot is in use here until nothing uses the memory any more. None: there is no room.
        Raises OSError if there can be no segment.
        """
        if (found := self._room_for(value)) is None:
            return None
        owned, slot, parcel = found
        with self._discarded_at_errors(owned, slot):
            if slot.fresh:  # a system call reports that there is no memory; a write to the map would kill
                os.posix_fallocate(owned.fd, slot.start, slot.end - slot.start)
            _write_parts(owned, slot, value)
            places = _places(slot.start, parcel.lengths)
            memory = owned.lend(slot, places, parcel.lengths)
        self._segments.used()
        return parcel, memory[places[1] - slot.start :][: parcel.lengths[1]]

    @contextlib.contextmanager
    def _discarded_at_errors(self, owned: _Owned, slot: Slot) -> Generator[None]:
        try:
            yield
        except BaseException:  # such as KeyboardInterrupt
            with self._segments.bookkeeping():
                owned.discard(slot)
            raise

    def _room_for(self, value: Large) -> tuple[_Owned, Slot, Parcel] | None:
        lengths = (sum(map(len, value.parts)), *map(len, value.buffers))
        size = _places(0, lengths)[-1]
        segments = self._segments
        if size > segments.limit_bytes and segments.limit_bytes:
            return None
        owned, slot = self._take(size)
        if slot is None:
            segments.give_back()
            owned, slot = self._take(size)
        if slot is None:
            return None
        return owned, slot, Parcel(owned.fd, owned.key, owned.bytes, slot.number, slot.start, lengths)

    def _take(self, size: int) -> tuple[_Owned, Slot | None]:
        segments = self._segments
        with segments.bookkeeping():
            if self._closed:
                raise OSError("the connection is closed")
            owned = self._owned = self._owned or segments.make(self._pid)
            return owned, owned.slots.take(size, segments.room)

    def discard(self, parcel: Parcel) -> None:
        """Free the slot of a parcel that was not sent."""
        owned = self._owned
        if owned is not None:
            owned.slots.free(parcel.slot)

    def may_share(self, holder: object, most_bytes: int) -> bool:
        """Return whether share() would return a parcel. Raises OSError like take."""
        with self._segments.bookkeeping():
            return self._own().slots.may_share(holder, most_bytes)

    def share(self, parcel: Parcel, holder: object, most_bytes: int) -> Parcel | None:
        """Return a parcel of this end for one more holder, who frees it for itself.

        None: the holder has two values or more already, which are `most_bytes` or more; or has too many.
        Raises OSError like take.
        """
        with self._segments.bookkeeping():
            if (number := self._own().slots.share(parcel.slot, holder, most_bytes)) is None:
                return None
            return msgspec.structs.replace(parcel, slot=number)

    def _own(self) -> _Owned:
        if self._owned is None:
            raise OSError("the connection is closed")
        return self._owned

    def take_back(self, holder: object) -> None:
        """Free all that a holder has: it has ended."""
        with self._segments.bookkeeping():
            if (owned := self._owned) is not None:
                owned.slots.take_back(holder)

    def claim(self, parcel: Parcel) -> Callable[[], Any]:
        """Return a function that makes the value of a parcel that has arrived. Unused, it frees the slot.

        The function raises Unavailable if this process can have no map of the segment.

        Raises:
            Lie: the other end does not tell the truth: close the connection.
        """
        try:
            claim = self.hold(parcel)
        except (OSError, MemoryError) as error:
            why = f"a value of {len(parcel)} bytes cannot be read: {wanted_by(error) or text_of(error)}"
            return lambda: _raise(Unavailable(why))
        claim.arm()
        return claim.open

    def hold(self, parcel: Parcel, shared_by: object = None) -> Claim:
        """Return the claim on the value of a parcel that has arrived, which is not armed yet.

        Args:
            shared_by: the connection, if others have the value, too. The value is read-only then, and keeps this
                object: while the connection is open, the other end knows that the value is in use.

        Raises:
            OSError, MemoryError: this process can have no map of the segment. FileNotFoundError, ProcessLookupError:
                the other end has ended, or has closed the segment.
            Lie: the other end does not tell the truth: close the connection.
        """
        mapped = self._mapped(parcel)
        places = places_in(parcel, mapped)
        return Claim(mapped, parcel.slot, places, parcel.lengths, shared_by, shared=shared_by is not None)

    def _mapped(self, parcel: Parcel) -> mmap.mmap:
        """Return a map of the other end's segment that is long enough for a parcel, unless that lies."""
        if parcel.start < HEAD_BYTES:
            raise Lie("it sent a value that is in the head of its segment")
        needed = max(HEAD_BYTES, min(_places(parcel.start, parcel.lengths)[-1], parcel.segment_bytes))
        segment, before = (parcel.fd, parcel.key, parcel.segment_bytes), 0
        if self._theirs is not None:
            if segment != self._theirs:
                raise Lie("it sent a value in another segment than before")
            assert self._map is not None
            before = len(self._map)
            if needed <= before:
                return self._map
        path = f"/proc/{self._pid}/fd/{parcel.fd}"
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode) or found.st_size != parcel.segment_bytes or found.st_size < HEAD_BYTES:
            raise Lie("what it sent as a segment is none")
        with Path(path).open("r+b", buffering=0) as file:
            _check_sealed(file.fileno())
            mapped = mmap.mmap(file.fileno(), _mapped_bytes(needed, before, parcel.segment_bytes))
        if _KEY.unpack_from(mapped)[0] != parcel.key:
            raise Lie("it sent a value in a segment that it does not have")
        self._map, self._theirs = mapped, segment
        return mapped

    def close(self) -> None:
        """Close the segments: the connection is lost. Values that were received stay as they are."""
        self._closed = True
        self._owned = self._theirs = self._map = None


def _write_parts(owned: _Owned, slot: Slot, value: Large) -> None:
    at = slot.start
    for part in value.parts:
        owned.write(slot, part, at)
        at += len(part)


def _check_sealed(fd: int) -> None:
    """Raise Lie if the owner could make the file shorter, which would kill the reader."""
    try:
        seals = fcntl.fcntl(fd, fcntl.F_GET_SEALS)
    except OSError:
        seals = 0
    if not seals & fcntl.F_SEAL_SHRINK:
        raise Lie("it sent a file that is no segment")


def can_open(pid: int) -> bool:
    """Return whether the process `pid` can open descriptors of this one.

    It can if it is of the same user, sees this process's id, and has each capability that this one has. A process that
    has changed its user, or whose program has capabilities, is not "dumpable": then its descriptors belong to root.
    """
    if not pid or sys.platform != "linux":
        return False
    me = os.geteuid()
    with contextlib.suppress(OSError, ValueError):
        return (
            os.stat("/proc/self/fd").st_uid == me
            and os.stat(f"/proc/{pid}").st_uid == me
            and os.readlink(f"/proc/{pid}/ns/pid") == os.readlink("/proc/self/ns/pid")
            and not _capabilities(os.getpid()) & ~_capabilities(pid)
        )
    return False


def _capabilities(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("CapPrm:")[2].split(None, 1)[0], 16)


def _raise(error: Exception) -> Any:
    raise error
