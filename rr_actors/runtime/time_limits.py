"""Time limits: the check of a user's limit, waits with a limit, one timer for many limits, and probes with a limit.

Two clocks count limits. A caller's own `timeout_s` counts by the monotonic clock. The limits of callbacks, programs and
processes count by RunningTime, which leaves out the time in which this process stood still itself: SIGSTOP, a frozen
control group, a suspended machine, a debugger. What is limited may have stood still with it.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from asyncio import AbstractEventLoop, TimerHandle
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from rr_actors.base.errors import UsageError, exact_number, is_a, shown
from rr_actors.runtime.thread_rules import any_thread, on_loop

_LONGEST_S = 2_000_000  # 23 days
LONGEST_GRACE_S = _LONGEST_S - 1.0
"""The longest time that a timer is set for."""
_SLICE_S = 0.25  # how far apart two readings of a running time are at most,
_SLICE = 1 / 16  # and the same as a part of the limit,
_SLICE_OF_LONG = 1 / 240  # and of a limit of more than a minute


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


def finite_time(seconds: object, name: str) -> float:
    """Return a time that must end, in seconds.

    Raises:
        UsageError: it is not a number of 0 or more, or is longer than LONGEST_GRACE_S.
    """
    number = exact_number(seconds) if is_a(seconds, (int, float)) and not is_a(seconds, bool) else -1.0
    if not 0 <= number <= LONGEST_GRACE_S:  # NaN is not
        raise UsageError(f"{name}: expected seconds, from 0 to {LONGEST_GRACE_S:,.0f}, got {shown(seconds)}")
    return number


def deadline_of(limit_s: float | None) -> float:
    """Return when a time limit that begins now ends, as a value of time.monotonic(); infinity for None."""
    return math.inf if limit_s is None else time.monotonic() + limit_s


def left_until(deadline: float) -> float | None:
    """Return the seconds that are left until a deadline of deadline_of(); None for infinity."""
    return None if deadline == math.inf else max(0.0, deadline - time.monotonic())


class RunningTime:
    """The seconds for which this process has run, for one thread, which reads them again and again.

    Two readings that are further apart than twice `slice_s` have a standstill between them, and count as `slice_s`.

    Attributes:
        slice_s: seconds until the next reading, as the thread plans it. Set it after a reading, and before the wait.
    """

    __slots__ = ("_clock", "_ran_s", "_read_at", "slice_s")

    def __init__(self, slice_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self.slice_s = clock, slice_s
        self._read_at, self._ran_s = clock(), 0.0

    def read(self) -> float:
        """Return the seconds since the beginning, without standstills."""
        now = self._clock()
        passed_s, self._read_at = now - self._read_at, now
        self._ran_s += passed_s if passed_s < 2 * self.slice_s else self.slice_s
        return self._ran_s


class RunningLimit:
    """A time limit that begins now, and counts the time for which this process runs. For one thread.

    Wait at most `slice_s` at a time, and ask is_over() after each wait.
    """

    __slots__ = ("_limit_s", "_ran", "_ran_s")

    def __init__(self, limit_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit_s, self._ran, self._ran_s = limit_s, RunningTime(slice_of(limit_s), clock), 0.0

    def is_over(self) -> bool:
        """Return whether the process has run for the whole limit."""
        self._ran_s = self._ran.read()
        return self._ran_s >= self._limit_s

    @property
    def slice_s(self) -> float:
        """How many seconds the next wait may take."""
        return max(0.0, min(self._ran.slice_s, self._limit_s - self._ran_s))


def slice_of(limit_s: float) -> float:
    """Return how far apart the readings of a running time are for a limit: a standstill counts as so much."""
    return max(min(limit_s * _SLICE, _SLICE_S), limit_s * _SLICE_OF_LONG)


async def wait_while_running(future: asyncio.Future[Any], limit_s: float | None) -> None:
    """Wait until `future` is done, or this process has run for `limit_s` seconds meanwhile; None is no limit."""
    if limit_s is None:
        await asyncio.wait((future,))
        return
    limit = RunningLimit(limit_s, asyncio.get_running_loop().time)
    while not future.done() and not limit.is_over():
        await asyncio.wait((future,), timeout=limit.slice_s)


class RunningTimers:
    """Timers of one loop, by keys, which count the time for which this process runs. On the loop.

    One more timer, the ticker, reads that time while any timer waits.
    """

    def __init__(self, loop: AbstractEventLoop) -> None:
        self._loop = loop
        self._ran = RunningTime(_SLICE_S, loop.time)
        self._timers: dict[str, TimerHandle] = {}
        self._wanted: dict[str, tuple[float, Callable[[], object]]] = {}
        self._slices: dict[str, float] = {}
        self._ticker: TimerHandle | None = None

    def set(self, key: str, delay_s: float, fire: Callable[[], object]) -> None:
        """Call `fire` when the process has run for `delay_s` more seconds. It replaces the timer of the same key."""
        self.cancel(key)
        self._timers[key] = self._loop.call_later(delay_s, self._look, key, self._ran.read() + delay_s, fire)
        self._wanted[key] = delay_s, fire
        if delay_s > 0:
            slice_s = self._slices[key] = max(slice_of(delay_s), _SOON_S)
            if self._ticker is None or slice_s < self._ran.slice_s:
                self._tick_in(slice_s)

    def restart(self, key: str) -> None:
        """Let the time of a key's timer begin again, if there is one."""
        if key in self._wanted:
            self.set(key, *self._wanted[key])

    def cancel(self, key: str) -> None:
        """Cancel the timer of a key, if there is one."""
        timer = self._timers.pop(key, None)
        if timer is not None:
            timer.cancel()
            del self._wanted[key]
            self._slices.pop(key, None)

    def close(self) -> None:
        """Cancel all timers."""
        for key in list(self._timers):
            self.cancel(key)
        if self._ticker is not None:
            self._ticker.cancel()

    def _look(self, key: str, due: float, fire: Callable[[], object]) -> None:
        left_s = due - self._ran.read()
        if left_s > _SOON_S:
            self._timers[key] = self._loop.call_later(left_s, self._look, key, due, fire)
            return
        del self._timers[key], self._wanted[key]
        self._slices.pop(key, None)
        fire()

    def _tick_in(self, slice_s: float) -> None:
        if self._ticker is not None:
            self._ticker.cancel()
        self._ran.slice_s = slice_s
        self._ticker = self._loop.call_later(slice_s, self._tick)

    def _tick(self) -> None:
        self._ticker = None
        self._ran.read()
        if self._slices:
            self._tick_in(min(self._slices.values()))


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


# -- callbacks in rounds, each with a limit ----------------------------------------------------------------------------
#
# A round has all keys of that moment. Its probes are spread over the period, so 10,000 keys do not wake all threads at
# once. Of one key no two probes run at the same time: one that hangs is not started again until it has returned. Each
# key has a period and a limit of its own: a round has the keys that are due.

_PART_S = 0.05  # between the parts of a round
_EARLY = 0.1  # of its period: a key that is due so soon is in this round. Thus few rounds have all keys of one period.
_FEW = 8  # probes that begin together, without being spread
_SOON_S = 0.005


class ProbeTimes(NamedTuple):
    """The seconds from one probe of a key to the next, and its time limit in seconds."""

    every_s: float
    timeout_s: float


class TimedRun(msgspec.Struct, eq=False):
    """One run of a callback.

    Attributes:
        times: those of its key.
        began: when the callback began; None while it waits for a thread. Another thread sets it.
        ran_s: how long it has run, without standstills of this process, as of the last look.
        late_at: when the callback was last found late, by the running time; None: it is not late.
        after: what waits until it has returned, or is late.
    """

    times: ProbeTimes
    began: float | None = None
    ran_s: float = 0.0
    late_at: float | None = None
    after: list[Callable[[], None]] = msgspec.field(default_factory=list[Callable[[], None]])


@on_loop
class Probes:
    """The probes of the resources of one server. Their time limits count the time for which this process runs.

    Args:
        look_s: the longest time from one round to the next: a new key is found within it.
        keys: returns the keys that can be probed, each with its times.
        start: starts the callbacks of keys. Each calls begins(), and ended() is called on the loop for each.
        late: called for a key whose callback is late, and in each later round in which it has not returned.
    """

    def __init__(
        self,
        loop: AbstractEventLoop,
        look_s: float,
        keys: Callable[[], Mapping[str, ProbeTimes]],
        start: Callable[[Sequence[str]], None],
        late: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._look_s = self._round_s = look_s
        self._keys, self._start, self._late = keys, start, late
        self._running: dict[str, TimedRun] = {}
        self._times: Mapping[str, ProbeTimes] = {}
        self._due_at: dict[str, float] = {}
        self._left: deque[str] = deque()
        self._size = 0  # keys of this round
        self._round_began = -math.inf
        self._slice_s = _SLICE_S
        self._ran, self._ran_s = RunningTime(self._slice_s), 0.0  # and the running time at the last look
        self._timer: TimerHandle | None = None
        self._closed = False

    def open(self) -> None:
        """Begin the first round."""
        self._tick()

    def close(self) -> None:
        """Begin no more probes. What waits for one goes on."""
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        for probe in list(self._running.values()):
            _go_on(probe)

    def ran_s(self) -> float:
        """Return the seconds for which this process has run; of a standstill between two rounds, at most a period."""
        return self._ran.read()

    # -- one probe ---------------------------------------------------------------------------------------------------

    def is_waiting(self, key: str) -> bool:
        """Return whether the callback of a key has been told to start, and has not begun."""
        probe = self._running.get(key)
        return probe is not None and probe.began is None

    @any_thread
    def begins(self, key: str, may_begin: Callable[[str], bool]) -> bool:
        """Note that a callback begins now, and return whether it may. In the thread that runs it."""
        probe = self._running[key]
        probe.began = time.monotonic()  # before the question: after a "no", when_free() need not wait
        if may_begin(key):
            return True
        probe.began = None
        return False

    def ended(self, key: str) -> bool:
        """Note that a callback has returned; return whether its result counts: it had begun, and is not late."""
        probe = self._running.pop(key)
        _go_on(probe)
        return probe.began is not None and probe.late_at is None and not self._closed

    def when_free(self, key: str, action: Callable[[], None]) -> None:
        """Call `action` when no callback of the key runs any more; or when the one that runs is late."""
        probe = self._running.get(key)
        if probe is None or probe.began is None or probe.late_at is not None or self._closed:
            action()
        else:
            probe.after.append(action)

    # -- rounds ------------------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        if self._closed:
            return
        now = time.monotonic()
        self._end_late(now)
        if not self._left and now >= self._round_began + self._round_s:
            self._begin_round(now)
        self._probe(self._due(now))
        wait_s = max(self._next_at(now) - now, _SOON_S)
        self._ran.slice_s = max(wait_s, self._slice_s)
        self._timer = self._loop.call_later(wait_s, self._tick)

    def _begin_round(self, now: float) -> None:
        self._times = self._keys()
        early = ((key, now + times.every_s * _EARLY) for key, times in self._times.items())
        due = [key for key, until in early if until >= self._due_at.get(key, now)]
        self._due_at = {key: self._due_at.get(key, now) for key in self._times}
        self._due_at.update((key, now + self._times[key].every_s) for key in due)
        self._round_s = min(self._look_s, min(self._due_at.values(), default=math.inf) - now)
        self._slice_s = min((slice_of(times.timeout_s) for times in set(self._times.values())), default=_SLICE_S)
        self._left, self._size, self._round_began = deque(due), len(due), now

    def _due(self, now: float) -> list[str]:
        """Take the next keys out of the round: as many as belong into the part of the period that is over."""
        part = 1.0 if self._size <= _FEW else (now - self._round_began + _PART_S) / self._round_s
        due = len(self._left) - math.floor(self._size * (1 - min(part, 1.0)))
        return [self._left.popleft() for _ in range(due)]

    def _probe(self, keys: list[str]) -> None:
        free = [key for key in keys if key not in self._running]
        if len(free) < len(keys):
            for key in set(keys) - set(free):
                self._still_late(key, self._running[key])
        if free:
            self._running.update((key, TimedRun(self._times[key])) for key in free)
            self._start(free)

    def _end_late(self, now: float) -> None:
        before_s, self._ran_s = self._ran_s, self._ran.read()
        for key, probe in list(self._running.items()):
            if probe.late_at is None and probe.began is not None:
                probe.ran_s += min(self._ran_s - before_s, now - probe.began)
                if probe.ran_s >= probe.times.timeout_s:
                    probe.late_at = self._ran_s
                    self._late(key)
                    _go_on(probe)

    def _still_late(self, key: str, probe: TimedRun) -> None:
        late_at = probe.late_at
        if late_at is not None and self._ran_s - late_at >= probe.times.every_s / 2:  # else this round has counted it
            probe.late_at = self._ran_s
            self._late(key)

    def _next_at(self, now: float) -> float:
        round_at = now + _PART_S if self._left else self._round_began + self._round_s
        left_s = (probe.times.timeout_s - probe.ran_s for probe in self._running.values() if probe.late_at is None)
        return min(round_at, now + min((min(left, self._slice_s) for left in left_s), default=math.inf))


def _go_on(probe: TimedRun) -> None:
    actions, probe.after = probe.after, []
    for action in actions:
        action()
