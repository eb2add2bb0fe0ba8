"""Deadlines: many time limits on one timer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from rr_actors.runtime.time_limits import Deadlines


class ManualLoop:
    """An event loop's clock and timers, moved by hand."""

    def __init__(self) -> None:
        self.now = 100.0
        self.timers: list[ManualTimer] = []

    def time(self) -> float:
        return self.now

    def call_at(self, when: float, callback: Callable[[], None]) -> ManualTimer:
        timer = ManualTimer(self, when, callback)
        self.timers.append(timer)
        return timer

    def pass_time(self, seconds: float) -> None:
        end = self.now + seconds
        while due := [timer for timer in self.timers if timer.when <= end]:
            first = min(due, key=lambda timer: timer.when)
            self.timers.remove(first)
            self.now = max(self.now, first.when)
            first.callback()
        self.now = end


class ManualTimer:
    def __init__(self, loop: ManualLoop, when: float, callback: Callable[[], None]) -> None:
        self.loop, self.when, self.callback = loop, when, callback

    def cancel(self) -> None:
        self.loop.timers.remove(self)


@pytest.fixture
def loop() -> ManualLoop:
    return ManualLoop()


@pytest.fixture
def deadlines(loop: ManualLoop) -> Deadlines:
    return Deadlines(cast(Any, loop))


class Limit:
    """Something with a time limit."""

    def __init__(self, overdue: Callable[[], object], is_done: Callable[[], bool] = lambda: False) -> None:
        self._overdue, self._is_done = overdue, is_done

    @property
    def is_done(self) -> bool:
        return self._is_done()

    def overdue(self) -> None:
        self._overdue()


def test_each_is_called_at_its_time_whatever_the_order_they_came_in(loop: ManualLoop, deadlines: Deadlines) -> None:
    called: list[tuple[str, float]] = []
    for name, timeout_s in (("second", 2.0), ("first", 1.0), ("third", 3.0), ("first too", 1.0)):
        deadlines.add(timeout_s, Limit(lambda name=name: called.append((name, loop.now))))

    loop.pass_time(10.0)

    assert called == [("first", 101.0), ("first too", 101.0), ("second", 102.0), ("third", 103.0)]
    assert loop.timers == []


def test_what_is_done_by_then_is_not_called(loop: ManualLoop, deadlines: Deadlines) -> None:
    called: list[str] = []
    done = {"early": True, "late": False}
    for name in done:
        deadlines.add(1.0, Limit(lambda name=name: called.append(name), lambda name=name: done[name]))

    loop.pass_time(1.0)

    assert called == ["late"]


def test_one_timer_is_enough_for_all(loop: ManualLoop, deadlines: Deadlines) -> None:
    for number in range(1_000):
        deadlines.add(30.0 - number % 7, Limit(lambda: None))

    assert len(loop.timers) == 1


def test_what_is_done_is_forgotten_long_before_its_time(loop: ManualLoop, deadlines: Deadlines) -> None:
    class Done:
        alive = 0
        is_done = True

        def __init__(self) -> None:
            Done.alive += 1

        def overdue(self) -> None:
            pytest.fail("called")

        def __del__(self) -> None:
            Done.alive -= 1

    for _ in range(10_000):
        deadlines.add(30.0, Done())

    assert Done.alive < 200


def test_one_that_raises_does_not_keep_the_others_from_being_called(loop: ManualLoop, deadlines: Deadlines) -> None:
    called: list[str] = []

    def fail() -> None:
        raise ValueError("no")

    deadlines.add(1.0, Limit(fail))
    deadlines.add(1.0, Limit(lambda: called.append("the next")))
    loop.pass_time(1.0)

    assert called == ["the next"]


def test_after_close_nothing_is_called(loop: ManualLoop, deadlines: Deadlines) -> None:
    deadlines.add(1.0, Limit(lambda: pytest.fail("called")))

    deadlines.close()
    loop.pass_time(10.0)

    assert loop.timers == []
