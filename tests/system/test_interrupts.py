"""A sample of tests/support_interrupts.py: Ctrl-C between any two steps of a call ends the call, and no more."""

from __future__ import annotations

import asyncio
import gc
import itertools
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.actors.messaging.futures import Reply
from rr_actors.runtime.thread_pool import EventBell
from support import Calls, Workshop, descriptors, eventually, serve
from support_inside import actor_of
from support_interrupts import HANDLERS, interrupted, run_all, scenes, system_scenes
from support_managers import Order, Shop

_QUICK = (
    *("load here", "load elsewhere", "join here", "unload here", "unload elsewhere", "unload_all"),
    *("load_all", "load_all, of which one fails"),
    *("ask near", "ask far", "tell near", "queries"),
)


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("name", _QUICK)
def test_a_call_that_is_interrupted_leaves_nothing_wedged_and_nothing_held_by_nobody(name: str) -> None:
    (result,) = run_all([name], 60, 1).values()
    assert result.found == []
    assert result.tried == 60
    assert result.raised > 30  # on a busy machine a call ends at an earlier point than it did when they were counted


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("name", ["tell near", "load here", "unload elsewhere"])
def test_what_a_signals_handler_raises_may_be_an_exception_like_any(name: str) -> None:
    """A time limit's, say: `except Exception` must not take it for an error of what was called."""
    (result,) = run_all([name], 200, 1, raising="Exception", together=20).values()
    assert result.found == []
    assert result.tried == 200


@pytest.mark.timeout(120)
@pytest.mark.parametrize("raising", HANDLERS)
def test_interrupted_lines_to_another_process_leave_no_descriptor_open(raising: str) -> None:
    results = run_all(["load and unload elsewhere"], 600, 1, raising=raising, together=20)
    assert [found for result in results.values() for found in result.found] == []
    assert results["load and unload elsewhere"].tried == 600


@pytest.mark.timeout(120)
@pytest.mark.parametrize("what", ["start", "stop"])
def test_a_system_whose_start_or_stop_is_interrupted_can_be_started_again(what: str) -> None:
    (result,) = run_all([f"{what} a system of nothing"], 12, 1).values()
    assert result.found == []
    assert result.raised == result.tried == 12


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_flag_that_is_set_before_the_act_that_undoes_it_is_found() -> None:
    results = run_all(["queries"], 0, 1, plant="flag before the act")  # each point once
    assert any("afterwards" in found or "wedged" in found for found in results["queries"].found)


def test_the_interrupt_comes_at_each_point_of_a_call_and_nowhere_else() -> None:
    steps: list[str] = []
    lock = threading.Lock()

    def work() -> None:
        with lock:
            steps.append("in")
        steps.append("out")

    ends: list[list[str]] = []
    for point in range(1, 6):
        steps.clear()
        told = interrupted(work, point)
        assert not lock.locked()
        if told.was_raised:
            ends.append(list(steps))
    assert ends == [["in"], ["in"], ["in", "out"]]


_MOST_TRIES = 2000


def _interrupt_before_it_waits(begin: Callable[[], Any]) -> int:
    """Interrupt a coroutine at each point before it awaits something, and return how many points there are."""

    async def interrupt() -> int:
        point = sys.maxsize  # at first caches are filled
        for _ in range(_MOST_TRIES):
            load = begin()
            told = interrupted(lambda load=load: load.send(None), point)
            load.close()
            if isinstance(told.error, StopIteration):  # held before it waited, as this thread was put aside: again
                async with told.error.value:
                    continue
            if not told.where and point < sys.maxsize:
                return point - 1
            point = 1 if point == sys.maxsize else point + 1
        raise AssertionError(f"after {_MOST_TRIES} loads it is at point {point}")

    loop = asyncio.new_event_loop()  # asyncio.run() has a signal handler of its own
    try:
        return loop.run_until_complete(interrupt())
    finally:
        loop.close()


@pytest.mark.filterwarnings("error:coroutine .* was never awaited")
def test_an_awaited_load_that_is_interrupted_before_it_waits_is_withdrawn(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    heard, numbers = Calls(), itertools.count()
    points = _interrupt_before_it_waits(lambda: app.load_async("provider/thing", next(numbers), on_status=heard))
    assert points > 50
    eventually(lambda: (app.queries(), app.stats()["loading"], provider.resources()) == ([], 0, []))
    assert actor_of(app).catalog.listened == set()


@pytest.mark.filterwarnings("error:coroutine .* was never awaited")
@pytest.mark.parametrize("how", ["load_async", "load_all_async"])
def test_an_awaited_load_through_a_handle_that_is_interrupted_before_it_waits_is_released(
    start: Callable[..., rr.System], workshop: Workshop, how: str
) -> None:
    shop = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))).registrar("shop")
    numbers = itertools.count()

    def begin() -> object:
        order = Order(str(next(numbers)))
        return (
            shop.load_async("shop/thing", order)
            if how == "load_async"
            else shop.load_all_async([("shop/thing", order)])
        )

    assert _interrupt_before_it_waits(begin) > 20
    eventually(lambda: (shop.queries(), shop.resources()) == ([], []))


@pytest.mark.parametrize("how", ["load", "load_all", "future"])
def test_a_load_through_a_handle_that_is_interrupted_is_released(
    start: Callable[..., rr.System], workshop: Workshop, how: str
) -> None:
    shop = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))).registrar("shop")
    ways: dict[str, Callable[[Order], object]] = {
        "load": lambda order: shop.load("shop/thing", order),
        "load_all": lambda order: shop.load_all([("shop/thing", order)]),
        "future": lambda order: shop.load("shop/thing", order, block=False),
    }
    orders = [Order("first")]
    ways[how](orders[0])  # which fills caches
    eventually(shop.queries)
    shop.unload_all()
    where = "at first"
    while where:
        orders.append(Order(str(len(orders))))
        where = interrupted(lambda: ways[how](orders[-1]), len(orders)).where
    eventually(lambda: [query.request for query in shop.queries()] == orders[-1:])
    shop.unload_all()
    eventually(lambda: shop.resources() == [])  # a load that was slower than the last one is released after it


def test_a_cancel_that_is_interrupted_takes_the_request_back_or_does_nothing() -> None:
    point, where = 0, "at first"
    while where:
        point += 1
        reply: Reply[int] = Reply()
        withdrawn, woken = Calls(), Calls()
        reply.withdraw = withdrawn
        reply.add_done_callback(woken)
        where = interrupted(reply.cancel, point).where
        did = (reply.done(), reply.cancelled(), len(withdrawn.items), len(woken.items))
        assert did in ((False, False, 0, 0), (True, True, 1, 1)), where
        assert reply.cancel()
        assert (reply.done(), len(withdrawn.items), len(woken.items)) == (True, 1, 1)
    assert point > 10


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # an interrupt in __del__ goes nowhere
def test_a_bell_whose_making_is_interrupted_leaves_no_descriptor_open() -> None:
    bells: list[EventBell] = []

    def make() -> None:
        bells.append(EventBell())

    points = interrupted(make, sys.maxsize).points
    bells.clear()
    gc.collect()  # of what other tests have left
    before = descriptors()
    raised = [interrupted(make, point).was_raised for point in range(1, points + 1)]
    bells.clear()
    gc.collect()  # errors refer to frames
    assert not descriptors() - before
    assert sum(raised) >= 4


def test_each_scene_has_a_name_of_its_own() -> None:
    names = [*(scene.name for scene in scenes()), *(scene.name for scene in system_scenes())]
    assert len(names) == len(set(names))
