"""Slots: which bytes of a segment of shared memory are in use, without any I/O.

A slot is a run of whole pages that holds one value. A page is cold until it is written for the first time, and again
after it was given back to the machine. Only pages that are not cold take memory.
"""

from __future__ import annotations

import mmap
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from typing import Protocol, overload

import msgspec

PAGE_BYTES = mmap.PAGESIZE  # 16 KiB or 64 KiB on some ARM machines

FREE, USED = 0, 1
"""The marks of a slot's number in the head of its segment."""

_BLOCK = 256  # numbers that are compared at a time


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

    @overload
    def __getitem__(self, number: int, /) -> int: ...

    @overload
    def __getitem__(self, numbers: slice, /) -> bytes | bytearray: ...

    def __setitem__(self, number: int, mark: int, /) -> None: ...


class Holding(msgspec.Struct):
    """The numbers that one holder has, and how many bytes their slots have together."""

    numbers: set[int]
    size: int = 0


class Slots:
    """The slots of one segment, as its owner knows them.

    A slot has the number that take() gave it, and one more for each holder that share() lets have it. The one who has a
    number sets its byte in the head to FREE. The slot is free when all of its numbers are.

    Attributes:
        used: the slots that hold a value, by each of their numbers.

    Args:
        head: the bytes that both ends set.
        start, end: the bytes of the segment that slots may have; multiples of PAGE_BYTES.
        numbers: the numbers that slots may have.
    """

    def __init__(self, head: Head, start: int, end: int, numbers: range) -> None:
        self.used: dict[int, Slot] = {}
        self._head = head
        self._marks = bytearray(numbers.stop)
        self._top = numbers.start  # all numbers that were ever used are less than this
        self._holders: dict[int, object] = {}
        self._holdings: dict[object, Holding] = {}
        self._shares: dict[int, int] = {}
        self._size = end - start
        self._free = Intervals(start, end)
        self._cold = Intervals(start, end)
        self._first = numbers.start
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
        slot = Slot(self._numbers[-1], start, start + size, fresh)
        self._use(slot)
        return slot

    def _use(self, slot: Slot) -> int:
        """Give a slot the next number, and return that."""
        number = self._numbers.pop()
        self.used[number] = slot
        self._top = max(self._top, number + 1)
        self._head[number] = self._marks[number] = USED
        return number

    def may_share(self, holder: object, most_bytes: int) -> bool:
        """Return whether a holder may have one more number.

        A holder may have two values. It may have more while those that it has are less than `most_bytes`, and have no
        more numbers than are left for all others.
        """
        self.collect()
        has = self._holdings.get(holder)
        if has is None or len(has.numbers) < 2:
            return bool(self._numbers)
        return has.size < most_bytes and len(has.numbers) < len(self._numbers)

    def share(self, number: int, holder: object, most_bytes: int) -> int | None:
        """Return another number of a slot, for a holder of its own; None if that is one too many: see may_share()."""
        if not self.may_share(holder, most_bytes):
            return None
        slot = self.used[number]
        other = self._use(slot)
        self._holders[other] = holder
        has = self._holdings.setdefault(holder, Holding(set()))
        has.numbers.add(other)
        has.size += slot.end - slot.start
        self._shares[slot.start] = self._shares.get(slot.start, 0) + 1
        return other

    def numbers_of(self, holder: object) -> list[int]:
        """Return the numbers that a holder has."""
        return sorted(has.numbers) if (has := self._holdings.get(holder)) else []

    def free(self, number: int) -> None:
        """Set a number free for the one that has it."""
        self._head[number] = FREE

    def take_back(self, holder: object) -> None:
        """Set free all that a holder has: it has ended."""
        for number in self.numbers_of(holder):
            self.free(number)

    def collect(self) -> None:
        """Make the slots free of which all numbers have been set free. Their pages stay warm."""
        first, top = self._first, self._top
        theirs = self._head[first:top]
        if theirs == self._marks[first:top]:  # the usual case, which costs little, however many numbers are in use
            return
        for start in range(0, len(theirs), _BLOCK):
            block = theirs[start : start + _BLOCK]
            if block != self._marks[first + start : first + start + _BLOCK]:
                for number, mark in enumerate(block, first + start):
                    if mark == FREE and self._marks[number] == USED:
                        self._give_back(number)

    def _give_back(self, number: int) -> None:
        slot = self.used.pop(number)
        self._marks[number] = FREE
        self._numbers.append(number)
        if (holder := self._holders.pop(number, None)) is not None:
            has = self._holdings[holder]
            has.numbers.discard(number)
            has.size -= slot.end - slot.start
            if not has.numbers:
                del self._holdings[holder]
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
