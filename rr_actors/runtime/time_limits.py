"""Time limits: the check of a user's limit, waits with a limit, and one timer for many limits."""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from collections.abc import Callable
from typing import Any

from rr_actors.base.errors import UsageError, exact_number, is_a, shown

_LONGEST_S = 2_000_000  # 23 days
_SLICE_S = 0.25  # the longest wait before the clock is read again,
_SLICE = 1 / 16  # and the same as a part of the limit


def time_limit(timeout_s: float | None, name: str = "timeout_s") -> float | None:
    """Return the limit in seconds; None for no limit, or for one that is longer than clocks and sockets can count.

    Args:
        name: the name of the caller's parameter.

    Raises:
        UsageError: the limit is not a number of 0 or more.
    """
    if timeout_s is None:
        return None
    if type(timeout_s) is float and 0 <= timeout_s < _LONGEST_S:
        return timeout_s
    number = exact_number(timeout_s) if is_a(timeout_s, (int, float)) and not is_a(timeout_s, bool) else -1.0
    if not number >= 0:  # NaN is not
        raise UsageError(f"{name}: expected seconds, 0 or more, or None for no limit, got {shown(timeout_s)}")
    return number if number < _LONGEST_S else None


def deadline_of(limit_s: float | None) -> float:
    """Return when a time limit that begins now ends, as a value of time.monotonic(); infinity for None."""
    return math.inf if limit_s is None else time.monotonic() + limit_s


def left_until(deadline: float) -> float | None:
    """Return the seconds that are left until a deadline of deadline_of(); None for infinity."""
    return None if deadline == math.inf else max(0.0, deadline - time.monotonic())


async def wait_while_running(future: asyncio.Future[Any], limit_s: float | None) -> None:
    """Wait until `future` is done, or this process has run for `limit_s` seconds meanwhile; None is no limit.

    Time in which the process stood still counts as a quarter of a second at most. The other side may have stood still
    with it, as when a machine is suspended or a whole process group is stopped.
    """
    loop = asyncio.get_running_loop()
    left_s = math.inf if limit_s is None else limit_s
    while not future.done() and left_s > 0:
        slice_s = None if limit_s is None else min(left_s, limit_s * _SLICE, _SLICE_S)
        began = loop.time()
        await asyncio.wait((future,), timeout=slice_s)
        if slice_s is not None:
            left_s -= min(loop.time() - began, slice_s)


class TimeLimits:
    """The time limits of the running calls of one loop. A timer for each would cost more than the call.

    Calls that have the same limit share one timer: they reach it in the order in which they have begun. On the loop.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._calls: dict[float, dict[Callable[[], object], float]] = {}  # limit -> what to call -> when
        self._timers: dict[float, asyncio.TimerHandle] = {}

    def begin(self, limit_s: float, overdue: Callable[[], object]) -> None:
        """Call `overdue` after `limit_s` seconds, unless end() is called with the same arguments before."""
        calls = self._calls.get(limit_s)
        if calls is None:
            calls = self._calls[limit_s] = {}
            self._timers[limit_s] = self._loop.call_later(limit_s, self._look, limit_s)
        calls[overdue] = self._loop.time() + limit_s

    def end(self, limit_s: float, overdue: Callable[[], object]) -> None:
        """End a call's limit. Do nothing if the call has reached its limit, or has not begun."""
        calls = self._calls.get(limit_s)
        if calls is not None and calls.pop(overdue, None) is not None and not calls:
            del self._calls[limit_s]
            self._timers.pop(limit_s).cancel()

    def _look(self, limit_s: float) -> None:
        calls, now = self._calls[limit_s], self._loop.time()
        over = list(itertools.takewhile(lambda call: calls[call] <= now, calls))
        for call in over:
            del calls[call]
            self._loop.call_soon(call)  # so an error of one call does not stop the others
        if calls:
            self._timers[limit_s] = self._loop.call_at(next(iter(calls.values())), self._look, limit_s)
        else:
            del self._calls[limit_s], self._timers[limit_s]
