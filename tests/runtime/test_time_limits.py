"""The time limits of many calls: one timer for those that have the same."""

from __future__ import annotations

import asyncio
import heapq
import itertools
from collections.abc import Callable
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.runtime.time_limits import RunningLimit, RunningTimers, TimeLimits


class Timer:
    """A loop's timer, of which TimeLimits uses cancel() alone."""

    def __init__(self, call: Callable[[], object]) -> None:
        self.call: Callable[[], object] | None = call

    def cancel(self) -> None:
        """It does not fire."""
        self.call = None


class Clock:
    """As much of an event loop as TimeLimits needs; time passes when the test says so."""

    def __init__(self) -> None:
        self.now = 0.0
        self._timers: list[tuple[float, int, Timer]] = []
        self._numbers = itertools.count()

    def time(self) -> float:
        """As the loop's."""
        return self.now

    def call_at(self, when: float, fn: Callable[..., object], *args: Any) -> Timer:
        """As the loop's."""
        timer = Timer(lambda: fn(*args))
        heapq.heappush(self._timers, (when, next(self._numbers), timer))
        return timer

    def call_later(self, delay_s: float, fn: Callable[..., object], *args: Any) -> Timer:
        """As the loop's."""
        return self.call_at(self.now + delay_s, fn, *args)

    def call_soon(self, fn: Callable[..., object], *args: Any) -> Timer:
        """As the loop's."""
        return self.call_at(self.now, fn, *args)

    @property
    def timers(self) -> int:
        """How many wait."""
        return sum(timer.call is not None for _, _, timer in self._timers)

    def pass_until(self, now: float) -> None:
        """Let what is due until then happen, each in its time."""
        while self._timers and self._timers[0][0] <= now:
            when, _, timer = heapq.heappop(self._timers)
            self.now = max(self.now, when)
            if timer.call is not None:
                timer.call()
        self.now = now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def limits_of(clock: Clock) -> TimeLimits:
    return TimeLimits(cast("asyncio.AbstractEventLoop", clock))


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("begin"), st.sampled_from((0.0, 0.5, 3.0, 30.0))),
        st.tuples(st.just("end"), st.integers(0, 9)),
        st.tuples(st.just("wait"), st.sampled_from((0.0, 0.25, 1.0, 7.0))),
    ),
    max_size=40,
)


@given(STEPS)
def test_each_call_is_over_at_its_time_if_it_has_not_ended_by_then(steps: list[tuple[str, Any]]) -> None:
    clock = Clock()
    limits = limits_of(clock)
    over: list[tuple[int, float]] = []
    running: dict[int, tuple[float, float, Callable[[], object]]] = {}  # number -> limit, when it is over, what to call
    expected: list[tuple[int, float]] = []
    numbers = itertools.count()
    for what, value in steps:
        if what == "begin":
            number = next(numbers)

            def overdue(number: int = number) -> None:
                over.append((number, clock.now))

            limits.begin(value, overdue)
            running[number] = (value, clock.now + value, overdue)
        elif what == "end" and running:
            number = list(running)[value % len(running)]
            limit_s, _, ended = running.pop(number)
            limits.end(limit_s, ended)
            limits.end(limit_s, ended)  # again is nothing
        elif what == "wait":
            clock.pass_until(clock.now + value)
            due = {number: when for number, (_, when, _) in running.items() if when <= clock.now}
            expected += due.items()
            running = {number: each for number, each in running.items() if number not in due}
        assert clock.timers == len({limit_s for limit_s, _, _ in running.values()})
    clock.pass_until(clock.now + 100)
    expected += [(number, when) for number, (_, when, _) in running.items()]
    assert sorted(over) == sorted(expected)
    assert clock.timers == 0


def test_calls_of_one_limit_share_a_timer_which_goes_with_the_last(clock: Clock) -> None:
    limits = limits_of(clock)
    calls = [lambda number=number: number for number in range(100)]
    for call in calls:
        limits.begin(30.0, call)
    assert clock.timers == 1
    for call in calls:
        limits.end(30.0, call)
    assert clock.timers == 0


def test_one_that_raises_stops_no_other(clock: Clock) -> None:
    limits = limits_of(clock)
    heard: list[str] = []

    def fails() -> None:
        heard.append("raised")
        raise RuntimeError

    limits.begin(1.0, fails)
    limits.begin(1.0, lambda: heard.append("called"))
    with pytest.raises(RuntimeError):
        clock.pass_until(2.0)
    clock.pass_until(2.0)
    assert heard == ["raised", "called"]


def timers_of(clock: Clock) -> RunningTimers:
    return RunningTimers(cast("asyncio.AbstractEventLoop", clock))


@given(st.floats(0.1, 300), st.floats(0, 1), st.floats(0.5, 1e6))
def test_a_timer_leaves_out_a_standstill_but_for_a_sixteenth_of_its_time(
    delay_s: float, part: float, still_s: float
) -> None:
    clock, fired = Clock(), list[float]()
    timers_of(clock).set("one", delay_s, lambda: fired.append(clock.now))
    clock.pass_until(part * delay_s)
    clock.now += still_s
    clock.pass_until(clock.now + 2 * delay_s)
    assert len(fired) == (part < 1 or 1)
    assert fired[0] <= delay_s + still_s + 0.01
    assert part == 1 or fired[0] >= delay_s + (still_s - delay_s / 8 if still_s >= delay_s / 8 else 0) - 0.01
    assert clock.timers == 0


def test_timers_of_many_lengths_fire_in_their_time_and_share_one_ticker(clock: Clock) -> None:
    timers, fired = timers_of(clock), list[tuple[float, float]]()
    lengths = [0.0, 0.5, 1.0, 7.0, 100.0, 3600.0]
    for length_s in lengths:
        timers.set(f"{length_s}", length_s, lambda length_s=length_s: fired.append((length_s, clock.now)))
    assert clock.timers == len(lengths) + 1
    clock.pass_until(4000)
    assert [length_s for length_s, _ in fired] == lengths
    assert [at for _, at in fired] == pytest.approx(lengths)
    assert clock.timers == 0


def test_a_timer_that_is_replaced_or_cancelled_does_not_fire(clock: Clock) -> None:
    timers, fired = timers_of(clock), list[str]()
    timers.set("one", 1.0, lambda: fired.append("first"))
    timers.set("one", 2.0, lambda: fired.append("second"))
    timers.set("two", 1.0, lambda: fired.append("two"))
    timers.cancel("two")
    timers.cancel("three")
    clock.pass_until(10)
    assert fired == ["second"]
    timers.set("one", 1.0, lambda: fired.append("closed"))
    timers.close()
    assert clock.timers == 0


def test_a_limit_is_over_when_the_process_has_run_for_it(clock: Clock) -> None:
    limit = RunningLimit(1.0, clock.time)
    for _ in range(8):
        clock.now += limit.slice_s
        assert not limit.is_over()
    clock.now += 100
    assert not limit.is_over()
    waits = 0
    while not limit.is_over():
        clock.now += limit.slice_s
        waits += 1
    assert waits == 7
    assert RunningLimit(0.0).is_over()
