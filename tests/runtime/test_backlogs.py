"""Backlogs: a callback that is slow grows no memory, misses in order, and hears all the rest."""

from __future__ import annotations

import inspect
import threading
import weakref
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from rr_actors.base.errors import Unavailable
from rr_actors.runtime import backlogs
from rr_actors.runtime.backlogs import Backlog
from rr_actors.runtime.event_loop import Dispatcher
from support import Calls, Gate, eventually


class Thing:
    pass


def of(dispatcher: Dispatcher, hear: Callable[[Any], Any], heard: Calls, failed: Calls | None = None) -> Backlog[Any]:
    failures = Calls() if failed is None else failed
    return Backlog(dispatcher.workers, hear, lambda count: heard(("missed", count)), failures)


def put_one(backlog: Backlog[Any], alive: weakref.WeakSet[Thing]) -> None:
    thing = Thing()
    alive.add(thing)
    backlog.put(thing)


def test_a_callback_that_blocks_keeps_no_more_than_the_bound(dispatcher: Dispatcher) -> None:
    gate, heard = Gate(), Calls()
    alive: weakref.WeakSet[Thing] = weakref.WeakSet()
    backlog = of(dispatcher, gate, heard)
    most = 0
    for _ in range(10 * backlogs.KEPT):
        put_one(backlog, alive)
        most = max(most, len(alive))
    gate.open()

    assert most <= backlogs.KEPT + 1  # and the one that is heard
    eventually(lambda: len(heard) == 1)
    ((_, count),) = heard
    assert count == 9 * backlogs.KEPT


@pytest.mark.parametrize("is_async", [False, True])
def test_what_is_put_is_heard_once_and_in_order(dispatcher: Dispatcher, is_async: bool) -> None:
    heard = Calls()

    async def hear(what: int) -> None:
        heard(what)

    backlog = of(dispatcher, hear if is_async else heard, heard)
    for number in range(2000):
        backlog.put(number)

    assert heard.wait(2000) == list(range(2000))


@pytest.mark.parametrize("is_async", [False, True])
def test_what_one_call_raises_keeps_the_next_from_nothing(dispatcher: Dispatcher, is_async: bool) -> None:
    heard, failed = Calls(), Calls()

    def hear(what: int) -> None:
        if what == 1:
            raise SystemExit("one")
        heard(what)

    async def hear_async(what: int) -> None:
        hear(what)

    backlog = of(dispatcher, hear_async if is_async else hear, heard, failed)
    for number in range(3):
        backlog.put(number)

    assert heard.wait(2) == [0, 2]
    ((error, what),) = failed.wait()
    assert (str(error), what) == ("one", 1)


def test_calls_of_one_backlog_never_overlap(dispatcher: Dispatcher) -> None:
    busy, overlaps, heard = threading.Lock(), Calls(), Calls()

    def hear(what: int) -> None:
        if not busy.acquire(blocking=False):
            overlaps(what)
            return
        busy.release()
        heard(what)

    backlog = of(dispatcher, hear, heard)
    putting = [threading.Thread(target=lambda: [backlog.put(number) for number in range(500)]) for _ in range(4)]
    for thread in putting:
        thread.start()
    for thread in putting:
        thread.join()

    assert len(heard.wait(2000)) == 2000
    assert not len(overlaps)


def test_after_the_workers_are_closed_it_says_so(dispatcher: Dispatcher) -> None:
    dispatcher.workers.close()
    backlog = of(dispatcher, Calls(), Calls())
    for _ in range(2):
        with pytest.raises(Unavailable):
            backlog.put("what")


@pytest.mark.parametrize("is_async", [False, True])
def test_the_workers_are_closed_while_it_waits_and_nothing_breaks(dispatcher: Dispatcher, is_async: bool) -> None:
    gate, failed = Gate(), Calls()

    async def hear(_what: int) -> None:
        gate()

    backlog = of(dispatcher, hear if is_async else gate, Calls(), failed)
    backlog.put(1)
    backlog.put(2)
    gate.wait_arrived()
    dispatcher.workers.close(timeout_s=0.0)
    gate.open()

    eventually(lambda: len(dispatcher.workers.threads) == 0)
    assert list(failed) == []


def test_a_coroutine_that_comes_after_the_end_is_closed(dispatcher: Dispatcher) -> None:
    gate, failed = Gate(), Calls()
    given: list[Coroutine[Any, Any, None]] = []

    async def too_late() -> None: ...

    def hear(_what: int) -> Any:
        gate()
        given.append(too_late())
        return given[0]

    of(dispatcher, hear, Calls(), failed).put(1)
    gate.wait_arrived()
    dispatcher.workers.close(timeout_s=0.0)
    gate.open()

    eventually(lambda: len(dispatcher.workers.threads) == 0)
    assert inspect.getcoroutinestate(given[0]) == inspect.CORO_CLOSED
    ((error, what),) = failed.wait()
    assert isinstance(error, Unavailable)
    assert what == 1
