"""Claims: values that this process has in shared memory, and what becomes of them when it forks.

A claim is on one slot of a segment. The buffers of its value keep it. When nothing uses them any more, the claim sets
the slot's byte in the head of the segment to FREE, and the segment's owner may use the slot again.

A process that is forked has the same memory, and nobody asks it before the slot is used again. So the child makes a
copy of its own of each value that is in use, in the same place, before it runs anything else. The parent waits for
that, and frees no slot meanwhile.
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import os
import select
import threading
from collections.abc import Callable, Sequence
from typing import Any

from rr_actors.base import pickling
from rr_actors.base.errors import text_of
from rr_actors.base.reporting.log import Log
from rr_actors.wire.segment_slots import FREE

logger = Log("rr_actors")

_MAP_FIXED = 0x10
_COPIES_S = 30.0  # the longest wait for a child, which copies gigabytes in a second

_Range = tuple[mmap.mmap, int, int]


_in_use: dict[int, _Range] = {}
"""The memory of the claims of this process, by their keys."""

_later: list[tuple[mmap.mmap, int, object]] = []
"""What was given up while the process forked."""

_forks: dict[int, tuple[int, int] | None] = {}
"""The threads that fork now, each with a pipe from its child."""


class Claim:
    """The right to one slot of a segment, which lasts until nothing uses the memory of the slot.

    It frees the slot only after arm(). So the caller can first put the claim where it is not lost: a signal handler
    may raise between any two steps.

    Args:
        places: where each part of the value begins, and where the last ends.
        lengths: the lengths of the parts: of the pickle, and of each buffer.
        keeps: an object that is to live as long as the claim.
        shared: others have the value, too: it is read-only.
    """

    __slots__ = ("_armed", "_keeps", "_key", "_lengths", "_map", "_pid", "_places", "_range", "_shared", "_slot")

    def __init__(
        self,
        mapped: mmap.mmap,
        slot: int,
        places: Sequence[int],
        lengths: Sequence[int],
        keeps: object,
        *,
        shared: bool,
    ) -> None:
        self._armed = False
        self._map = mapped
        self._slot = slot
        self._places = places
        self._lengths = lengths
        self._keeps = keeps
        self._shared = shared
        self._pid = os.getpid()
        self._key = id(self)
        self._range: _Range = mapped, places[0], places[-1]

    def arm(self) -> None:
        """Free the slot from now on, when nothing uses it any more."""
        _in_use[self._key] = self._range
        self._armed = True

    def memory(self) -> memoryview:
        """Return the bytes of the slot. What uses them keeps the claim."""
        import ctypes  # three modules and 2 ms that most programs do without

        mapped, start, end = self._range
        array: Any = (ctypes.c_ubyte * (end - start)).from_buffer(mapped, start)
        array.claim = self
        view = pickling.raw(array)
        return view.toreadonly() if self._shared else view

    def open(self) -> Any:
        """Make the value of the parts that are in the slot."""
        memory, start = self.memory(), self._places[0]
        places = zip(self._places, self._lengths, strict=False)
        parts = [memory[place - start :][:length] for place, length in places]
        return pickling.loads_large(parts[0], parts[1:])

    def __del__(self) -> None:
        if getattr(self, "_armed", False):  # else it was not all made
            try:
                self._free()
            except BaseException:  # of a signal handler
                if self._armed:
                    self._free()
                raise

    def _free(
        self,
        getpid: Callable[[], int] = os.getpid,
        in_use: dict[int, _Range] = _in_use,
        forks: dict[int, tuple[int, int] | None] = _forks,
        later: list[tuple[mmap.mmap, int, object]] = _later,
    ) -> None:
        """Free the slot. In a finalizer, perhaps when the interpreter has taken the names of this module away."""
        in_use.pop(self._key, None)  # first: a child that is forked after this has no use for the value
        is_here = getpid() == self._pid  # a child of fork has the same map
        if forks:
            later.append((self._map, self._slot, self._keeps))
        elif is_here:
            self._map[self._slot] = FREE
        self._armed = False


# -- fork --------------------------------------------------------------------------------------------------------------


def _before_fork() -> None:
    me = threading.get_ident()
    _forks[me] = None  # from now on nothing is freed
    if _in_use:
        with contextlib.suppress(OSError):  # no descriptor is left: the child copies, and nobody waits
            _forks[me] = os.pipe2(os.O_CLOEXEC)


def _after_fork_in_parent() -> None:
    pipe = _forks.get(threading.get_ident())
    try:
        if pipe is not None:
            os.close(pipe[1])
            poll = select.poll()
            poll.register(pipe[0], select.POLLIN)
            poll.poll(_COPIES_S * 1000)  # the child has written, or has ended
            os.close(pipe[0])
    finally:
        _forks.pop(threading.get_ident(), None)
        while _later and not _forks:
            mapped, slot, _ = _later.pop()
            mapped[slot] = FREE


def _after_fork_in_child() -> None:
    pipe = _forks.get(threading.get_ident())
    _forks.clear()
    _later.clear()
    ranges = list(_in_use.values())
    _in_use.clear()
    for mapped, start, end in ranges:
        try:
            _make_private(mapped, start, end)
        except (OSError, MemoryError) as error:
            logger.error("a value of %d bytes may change in this child of fork: %s", end - start, text_of(error))
    if pipe is not None:
        os.write(pipe[1], b"\0")
        os.close(pipe[0])
        os.close(pipe[1])


def _make_private(mapped: mmap.mmap, start: int, end: int) -> None:
    """Put a copy of a slot, which no other process has, in the place of the slot."""
    import ctypes

    size = -(-(end - start) // mmap.PAGESIZE) * mmap.PAGESIZE  # a slot has whole pages
    address = ctypes.addressof(ctypes.c_char.from_buffer(mapped, start))
    content = ctypes.string_at(address, size)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED
    if _system_mmap()(address, size, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0) != address:
        raise OSError(ctypes.get_errno(), "mmap")
    ctypes.memmove(address, content, size)


@functools.cache
def _system_mmap() -> Callable[[int, int, int, int, int, int], int]:
    import ctypes

    function = ctypes.CDLL(None, use_errno=True).mmap
    function.restype = ctypes.c_size_t
    size, number = ctypes.c_size_t, ctypes.c_int
    function.argtypes = (size, size, number, number, number, ctypes.c_long)
    return function


os.register_at_fork(before=_before_fork, after_in_parent=_after_fork_in_parent, after_in_child=_after_fork_in_child)
