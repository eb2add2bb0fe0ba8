"""Large values between two processes of one machine: in shared memory, beside their connection.

Each end of a connection that sends large values makes one segment, a memfd. It has no name: the kernel frees it with
the last process that has it. The segment is as long as the limit, but takes memory only where it was written. A message
carries a Parcel, which says where in the segment its value is. The other end opens the descriptor once, by
/proc/PID/fd, maps the segment, and makes the value from the bytes there. Buffers are not copied at that end: the value
has the slot until it is collected. Then that end sets the slot's byte in the head of the segment to FREE, and the
segment's owner may use the slot again.

The owner reads nothing from the segment but these bytes. A segment lives as long as its connection, or the last value
in it. Where a segment cannot be had, the value goes through the connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import mmap
import os
import stat
import struct
import sys
import threading
import time
import weakref
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

import msgspec

from rr_actors.base import pickling
from rr_actors.base.errors import MailboxFull, Unavailable, text_of
from rr_actors.base.pickling import Bytes, Large
from rr_actors.base.scarcity import wanted_by
from rr_actors.wire.frames import FRAME_LIMIT_BYTES

PAGE_BYTES = mmap.PAGESIZE  # 16 KiB or 64 KiB on some ARM machines
IDLE_S = 5.0
"""How long a segment is unused until its free pages are given back to the machine."""

FREE, USED = 0, 1

_KEY = struct.Struct("<Q")
_SLOTS = range(_KEY.size, PAGE_BYTES)  # the numbers of slots are the places of their bytes in the head
_ALIGNED = 64
_PIECE_BYTES = 16 << 20  # given back at a time, which takes the loop some milliseconds
_PIECE_S = 0.02
_CHUNK_BYTES = 1 << 20  # copied at a time, so that other threads of this process get their turns
_SEALS = "F_SEAL_SHRINK", "F_SEAL_GROW", "F_SEAL_SEAL"


# -- which bytes of a segment are in use, without any I/O --------------------------------------------------------------
#
# A slot is a run of whole pages that holds one value. A page is cold until it is written for the first time, and again
# after it was given back to the machine; only pages that are not cold take memory.


class Intervals:
    """A set of numbers, as sorted intervals with gaps between them."""

    __slots__ = ("_ends", "_starts", "total")

    def __init__(self, start: int, end: int) -> None:
        self._starts = [start]
        self._ends = [end]
        self.total = end - start

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(list(zip(self._starts, self._ends, strict=True)))

    def first_fit(self, size: int) -> int | None:
        """Return the start of the first interval that has `size` numbers."""
        for start, end in zip(self._starts, self._ends, strict=True):
            if end - start >= size:
                return start
        return None

    def count(self, start: int, end: int) -> int:
        """Return how many numbers from `start` to before `end` are in the set."""
        first = bisect_right(self._ends, start)
        last = bisect_left(self._starts, end)
        return sum(min(self._ends[i], end) - max(self._starts[i], start) for i in range(first, last))

    def add(self, start: int, end: int) -> None:
        """Add the numbers from `start` to before `end`."""
        first = bisect_left(self._ends, start)  # the intervals that touch the new one
        last = bisect_right(self._starts, end)
        own = [start, end] if first == last else [min(start, self._starts[first]), max(end, self._ends[last - 1])]
        self._replace(first, last, own)

    def remove(self, start: int, end: int) -> None:
        """Remove the numbers from `start` to before `end`."""
        first = bisect_right(self._ends, start)
        last = bisect_left(self._starts, end)
        if first >= last:
            return
        rest = [self._starts[first], start] if self._starts[first] < start else []
        if self._ends[last - 1] > end:
            rest += [end, self._ends[last - 1]]
        self._replace(first, last, rest)

    def _replace(self, first: int, last: int, bounds: list[int]) -> None:
        self.total -= sum(self._ends[first:last]) - sum(self._starts[first:last])
        self.total += sum(bounds[1::2]) - sum(bounds[::2])
        self._starts[first:last] = bounds[::2]
        self._ends[first:last] = bounds[1::2]


class Slot(msgspec.Struct, frozen=True):
    """A run of pages for one value. `fresh`: how many of its bytes were cold."""

    number: int
    start: int
    end: int
    fresh: int


class Head(Protocol):
    """The bytes at the start of a segment, of which each slot's number has one: FREE or USED."""

    def __len__(self) -> int: ...

    def __getitem__(self, number: int, /) -> int: ...

    def __setitem__(self, number: int, mark: int, /) -> None: ...


class Slots:
    """The slots of one segment, as its owner knows them.

    A slot has the number that take() gave it, and one more for each holder that share() lets have it. The one who has a
    number sets its byte in the head to FREE. The slot is free when all of its numbers are.

    Attributes:
        used: the slots that hold a value, by each of their numbers.
        holders: who has the numbers that share() gave.

    Args:
        head: the bytes that both ends set.
        start, end: the bytes of the segment that slots may have; multiples of PAGE_BYTES.
        numbers: the numbers that slots may have.
    """

    def __init__(self, head: Head, start: int, end: int, numbers: range) -> None:
        self.used: dict[int, Slot] = {}
        self.holders: dict[int, object] = {}
        self._head = head
        self._shares: dict[int, int] = {}
        self._size = end - start
        self._free = Intervals(start, end)
        self._cold = Intervals(start, end)
        self._numbers = [*reversed(numbers)]

    @property
    def resident(self) -> int:
        """How many bytes take memory."""
        return self._size - self._cold.total

    def take(self, size: int, room: int) -> Slot | None:
        """Return a slot of at least `size` bytes, of which at most `room` are cold; None if there is none.

        The first gap that is long enough is used, so the same pages are used again.
        """
        self.collect()
        size = -(-size // PAGE_BYTES) * PAGE_BYTES
        start = self._free.first_fit(size)
        if start is None or not self._numbers:
            return None
        fresh = self._cold.count(start, start + size)
        if fresh > room:
            return None
        self._cold.remove(start, start + size)
        self._free.remove(start, start + size)
        number = self._numbers.pop()
        slot = self.used[number] = Slot(number, start, start + size, fresh)
        self._head[number] = USED
        return slot

    def share(self, number: int, holder: object, most_bytes: int) -> int | None:
        """Return another number of a slot, for a holder of its own; None if that is one too many.

        A holder may have two values, and more while those that it has are less than `most_bytes`.
        """
        self.collect()
        has = self.numbers_of(holder)
        if len(has) >= 2 and sum(self.used[own].end - self.used[own].start for own in has) >= most_bytes:
            return None
        if not self._numbers:
            return None
        slot, other = self.used[number], self._numbers.pop()
        self.used[other], self.holders[other] = slot, holder
        self._shares[slot.start] = self._shares.get(slot.start, 0) + 1
        self._head[other] = USED
        return other

    def numbers_of(self, holder: object) -> list[int]:
        """Return the numbers that a holder has."""
        return [number for number, other in self.holders.items() if other is holder]

    def free(self, number: int) -> None:
        """Set a number free for the one that has it."""
        self._head[number] = FREE

    def take_back(self, holder: object) -> None:
        """Set free all that a holder has: it has ended."""
        for number in self.numbers_of(holder):
            self.free(number)

    def collect(self) -> None:
        """Make the slots free of which all numbers have been set free. Their pages stay warm."""
        for number in [number for number in self.used if self._head[number] == FREE]:
            self._give_back(number)

    def _give_back(self, number: int) -> None:
        slot = self.used.pop(number)
        self.holders.pop(number, None)
        self._numbers.append(number)
        if shares := self._shares.pop(slot.start, 0):
            if shares > 1:
                self._shares[slot.start] = shares - 1
        else:
            self._free.add(slot.start, slot.end)

    def cool(self, most: int) -> list[tuple[int, int]]:
        """Make at most `most` free bytes cold; return those that were not, for the caller to give back."""
        self.collect()
        warm: list[tuple[int, int]] = []
        for start, end in self._free:
            for cold_start, cold_end in self._cold:
                if start < cold_end and cold_start < end:
                    if start < cold_start:
                        warm.append((start, cold_start))
                    start = cold_end
            if start < end:
                warm.append((start, end))
        cooled: list[tuple[int, int]] = []
        for start, end in warm:
            end = min(end, start + most)
            if start < end:
                self._cold.add(start, end)
                cooled.append((start, end))
                most -= end - start
        return cooled


# -- segments ----------------------------------------------------------------------------------------------------------


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
        head: the bytes of the whole segment.
    """
    places = _places(parcel.start, parcel.lengths)
    if (
        not parcel.lengths
        or min(parcel.lengths) < 0
        or parcel.start < PAGE_BYTES
        or places[-1] > len(head)
        or parcel.slot not in _SLOTS
        or head[parcel.slot] != USED
    ):
        raise Lie("it sent a value that is not in its segment")
    return places


class Segments:
    """The segments of one process, which have one limit together. From any thread.

    Args:
        limit_bytes: the memory that they may take; 0: there are none. Default: a quarter of the machine's.
        frame_limit_bytes: the length of the longest message.
    """

    def __init__(self, limit_bytes: int | None = None, frame_limit_bytes: int = FRAME_LIMIT_BYTES) -> None:
        if limit_bytes is None:
            limit_bytes = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4
        self.limit_bytes = limit_bytes
        self.frame_limit_bytes = frame_limit_bytes
        self._lock = threading.RLock()
        self._inside = False
        self.loop: asyncio.AbstractEventLoop | None = None  # which gives idle pages back
        self._owned: weakref.WeakSet[_Owned] = weakref.WeakSet()
        self._waiting = False
        self._used_at = 0.0

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
        owned = _Owned(self.limit_bytes)
        self._owned.add(owned)
        return owned

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
    """A segment of this process, for one connection. Its methods are called with the lock, but for write()."""

    fd = -1

    def __init__(self, limit_bytes: int) -> None:
        self.bytes = PAGE_BYTES + -(-limit_bytes // PAGE_BYTES) * PAGE_BYTES
        self.key = int.from_bytes(os.urandom(_KEY.size), "little")
        self.fd = fd = os.memfd_create("rr_actors", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, self.bytes)
        for seal in _SEALS:
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, getattr(fcntl, seal))
        self.map = mmap.mmap(fd, self.bytes)
        _KEY.pack_into(self.map, 0, self.key)
        self.slots = Slots(self.map, PAGE_BYTES, self.bytes, _SLOTS)

    def __del__(self) -> None:
        """Close the descriptor: no thread writes any more."""
        if self.fd >= 0:
            os.close(self.fd)

    def write(self, slot: Slot, part: Bytes, at: int) -> None:
        """Write a part of a value to its place; raise OSError if the machine has no memory for it."""
        rest = memoryview(part)
        while rest:
            chunk = rest[:_CHUNK_BYTES]
            if slot.fresh:  # a system call reports that there is no memory; a write to the map would kill
                written = os.pwrite(self.fd, chunk, at)
            else:
                written = len(chunk)
                self.map[at : at + written] = chunk
            rest, at = rest[written:], at + written

    def discard(self, slot: Slot) -> None:
        """Free a slot that could not be written, and give its pages back."""
        self.slots.free(slot.number)
        self.give_back(sys.maxsize)

    def give_back(self, most: int) -> int:
        """Give free pages back to the machine, at most so many bytes; return how many it were."""
        pieces = self.slots.cool(most)
        for start, end in pieces:
            self.map.madvise(mmap.MADV_REMOVE, start, end - start)
        return sum(end - start for start, end in pieces)


class Parcels:
    """One end of a connection: puts large values into a segment of its own, and reads them from the other end's."""

    def __init__(self, segments: Segments, pid: int) -> None:
        self._segments = segments
        self._pid = pid
        self._owned: _Owned | None = None
        self._theirs: tuple[int, int, mmap.mmap] | None = None  # descriptor, key, map
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
        try:
            parcel = self._parcel(cast(Large, value))
            why = None
        except (OSError, AttributeError, ValueError, OverflowError) as error:  # AttributeError: another system
            parcel, why = None, error
        if parcel is not None:
            return parcel
        body = cast(Large, value).whole()
        if len(body) <= self._segments.frame_limit_bytes or (why is not None and not wanted_by(why)):
            return body
        if why is not None:
            raise Unavailable(f"{len(body)} bytes need a segment of shared memory: {wanted_by(why)}") from why
        limit = self._segments.limit_bytes
        raise MailboxFull(
            f"no segment of shared memory has room for {len(body)} bytes: the limit is {limit} (segments_limit_bytes), "
            f"and the process {self._pid} has {self._in_use()} bytes of values in use",
            name=str(self._pid),
            limit=limit,
        )

    def _in_use(self) -> int:
        with self._segments.bookkeeping():
            used = () if self._owned is None else self._owned.slots.used.values()
            return sum(slot.end - slot.start for slot in used)

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
            _, start, end = _places(0, parcel.lengths)
            memory = _owner_of(owned.map, slot.number, slot.start, end, owned)
        self._segments.used()
        return parcel, memory[start:][: parcel.lengths[1]]

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

    def share(self, parcel: Parcel, holder: object, most_bytes: int) -> Parcel | None:
        """Return a parcel of this end for one more holder, who frees it for itself.

        None: the holder has two values or more already, which are `most_bytes` or more; or has too many.
        Raises OSError like take.
        """
        with self._segments.bookkeeping():
            if (owned := self._owned) is None:
                raise OSError("the connection is closed")
            if (number := owned.slots.share(parcel.slot, holder, most_bytes)) is None:
                return None
            return msgspec.structs.replace(parcel, slot=number)

    def take_back(self, holder: object) -> None:
        """Free all that a holder has: it has ended."""
        with self._segments.bookkeeping():
            if (owned := self._owned) is not None:
                owned.slots.take_back(holder)

    def claim(self, parcel: Parcel, shared_by: object = None) -> Callable[[], Any]:
        """Return a function that makes the value of a parcel that has arrived. Unused, it frees the slot.

        The function raises Unavailable if this process can have no map of the segment.

        Args:
            shared_by: the connection, if others have the value, too. The value is read-only then, and keeps this
                object: while the connection is open, the other end knows that the value is in use.

        Raises:
            Lie: the other end does not tell the truth: close the connection.
        """
        try:
            mapped = self._map(parcel)
        except (OSError, MemoryError) as error:
            why = f"a value of {len(parcel)} bytes cannot be read: {wanted_by(error) or text_of(error)}"
            return lambda: _raise(Unavailable(why))
        places = places_in(parcel, mapped)
        view = _owner_of(mapped, parcel.slot, parcel.start, places[-1] - parcel.start, shared_by)
        if shared_by is not None:
            view = view.toreadonly()
        parts = [view[start - parcel.start :][:length] for start, length in zip(places, parcel.lengths, strict=False)]
        return lambda: pickling.loads_large(parts[0], parts[1:])

    def _map(self, parcel: Parcel) -> mmap.mmap:
        if self._theirs is not None:
            fd, key, mapped = self._theirs
            if (fd, key, len(mapped)) == (parcel.fd, parcel.key, parcel.segment_bytes):
                return mapped
            raise Lie("it sent a value in another segment than before")
        path = f"/proc/{self._pid}/fd/{parcel.fd}"
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode) or found.st_size != parcel.segment_bytes or found.st_size < PAGE_BYTES:
            raise Lie("what it sent as a segment is none")
        with Path(path).open("r+b", buffering=0) as file:
            _check_sealed(file.fileno())
            mapped = mmap.mmap(file.fileno(), parcel.segment_bytes)
        if _KEY.unpack_from(mapped)[0] != parcel.key:
            raise Lie("it sent a value in a segment that it does not have")
        self._theirs = parcel.fd, parcel.key, mapped
        return mapped

    def close(self) -> None:
        """Close the segments: the connection is lost. Values that were received stay as they are."""
        self._closed = True
        self._owned = self._theirs = None


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


def _owner_of(mapped: mmap.mmap, slot: int, start: int, size: int, keeps: object) -> memoryview:
    """Return the bytes of a slot. When nothing uses them any more, the slot is free."""
    import ctypes  # three modules and 2 ms that most programs do without

    # An object with a buffer, which can have a finalizer, between the map and the value.
    array = (ctypes.c_ubyte * size).from_buffer(mapped, start)
    weakref.finalize(array, _free, mapped, slot, os.getpid(), keeps).atexit = False
    return pickling.raw(array)


def _free(mapped: mmap.mmap, slot: int, pid: int, _: object) -> None:
    if os.getpid() == pid:  # not in a process that was forked from it, which shares the map
        mapped[slot] = FREE


def can_open(pid: int) -> bool:
    """Return whether the process `pid` can open descriptors of this one: it is of the same user, and sees its id."""
    if not pid or sys.platform != "linux":
        return False
    me = os.geteuid()
    with contextlib.suppress(OSError):
        return (
            os.stat("/proc/self").st_uid == me  # else this process is not dumpable
            and os.stat(f"/proc/{pid}").st_uid == me
            and os.readlink(f"/proc/{pid}/ns/pid") == os.readlink("/proc/self/ns/pid")
        )
    return False


def _raise(error: Exception) -> Any:
    raise error
