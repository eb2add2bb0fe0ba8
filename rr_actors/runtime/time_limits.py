"""Time limits: what people may give as one, and many of them on one timer of the event loop."""

from __future__ import annotations

import asyncio
import heapq
import itertools
import logging
import math
import time
from typing import Any, Protocol

from rr_actors.base.errors import UsageError, exact_number, is_a, shown

_LONGEST_S = 2_000_000  # 23 days
_SLICE_S = 0.25  # how long is waited without a look at the clock, at most,
_SLICE = 1 / 16  # and of the limit


def time_limit(timeout_s: float | None, name: str = "timeout_s") -> float | None:
    """The seconds, or None for no limit, which more than clocks and sockets can count comes to.

    Args:
        name: what the caller's parameter is called.

    Raises:
        UsageError: it is no such number.
    """
    if timeout_s is None:
        return None
    number = timeout_s
    if type(timeout_s) is not float:
        number = exact_number(timeout_s) if is_a(timeout_s, (int, float)) and not is_a(timeout_s, bool) else -1.0
    if not number >= 0:  # NaN is not
        raise UsageError(f"{name}: expected seconds, 0 or more, or None for no limit, got {shown(timeout_s)}")
    return number if number < _LONGEST_S else None


def left_of(limit_s: float | None, began: float) -> float | None:
    """What is left now of a time limit that began to run at `began`, as time.monotonic() said then."""
    return None if limit_s is None else max(0.0, limit_s - (time.monotonic() - began))


async def wait_while_running(future: asyncio.Future[Any], limit_s: float | None) -> None:
    """Wait until `future` is done, or this process has run for `limit_s` seconds meanwhile; None is no limit.

    Time in which the process stood still does not count, but for a quarter of a second at most: what it waits for may
    have stood still with it, as when a machine is suspended or a whole process group is stopped.
    """
    loop = asyncio.get_running_loop()
    left_s = math.inf if limit_s is None else limit_s
    while not future.done() and left_s > 0:
        slice_s = None if limit_s is None else min(left_s, limit_s * _SLICE, _SLICE_S)
        began = loop.time()
        await asyncio.wait((future,), timeout=slice_s)
        if slice_s is not None:
            left_s -= min(loop.time() - began, slice_s)


# Deadlines: the time limits of many calls on one timer of the loop.
#
# Nearly every call is done long before its limit. A timer of the loop for each would stay for the whole limit, with all
# that it refers to: at 30 s and 20,000 calls a second more than half a million of them.

logger = logging.getLogger("rr_actors")

_FIRST_CLEARING = 64


class Limited(Protocol):
    """What has a time limit. One object and not two callables: a collector has less to go through, at any rate."""

    @property
    def is_done(self) -> bool:
        """Whether the limit does not matter any more. Quick."""
        ...

    def overdue(self) -> None:
        """The limit has come, and it is not done. Quick."""
        ...


_Entry = tuple[float, int, Limited]


class Deadlines:
    """Time limits, by when they end. Lives on the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._entries: list[_Entry] = []  # a heap
        self._numbers = itertools.count()
        self._clear_at = _FIRST_CLEARING
        self._timer: asyncio.TimerHandle | None = None
        self._rings_at = 0.0

    def add(self, timeout_s: float, limited: Limited) -> None:
        """Have it called overdue after `timeout_s` seconds, unless it is done by then."""
        if len(self._entries) >= self._clear_at:
            self._clear()
        entry = (self._loop.time() + timeout_s, next(self._numbers), limited)
        heapq.heappush(self._entries, entry)
        if self._entries[0] is entry:
            self._arm()

    def close(self) -> None:
        """Forget them all."""
        self._entries.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _clear(self) -> None:
        """Forget what is done, each time there are twice as many as were left the last time."""
        self._entries = [entry for entry in self._entries if not entry[2].is_done]
        heapq.heapify(self._entries)
        self._clear_at = max(_FIRST_CLEARING, 2 * len(self._entries))

    def _arm(self) -> None:
        """Wake up for the first. One that is done meanwhile wakes us for nothing, which is cheaper than to undo it."""
        first = self._entries[0][0]
        if self._timer is not None:
            if self._rings_at <= first:
                return
            self._timer.cancel()
        self._timer, self._rings_at = self._loop.call_at(first, self._ring), first

    def _ring(self) -> None:
        self._timer = None
        now = self._loop.time()
        while self._entries and self._entries[0][0] <= now:
            _, _, limited = heapq.heappop(self._entries)
            try:
                if not limited.is_done:
                    limited.overdue()
            except Exception:
                logger.exception("what is done at a time limit failed")
        if self._entries:
            self._arm()
