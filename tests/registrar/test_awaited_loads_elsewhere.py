"""Loads and unloads that tasks await, of a provider in another process: on connections of their own."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

import rr_actors as rr
from support import Workshop, connect_threads, eventually, hang, pid_of, wait_respawned
from support_inside import no_loop
from support_managers import Order, Shop

FIRST = Order("first")


@pytest.fixture
def shop(start: Callable[..., rr.System], workshop: Workshop) -> rr.System:
    """A system with a provider in another process."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


@pytest.fixture
def app(shop: rr.System) -> rr.Registrar:
    """A consumer that holds FIRST, and has a connection beside the link."""
    app = shop.open_registrar("app")
    connect_threads(app, "shop/thing", FIRST)
    return app


def agree(app: rr.Registrar, shop: rr.System) -> bool:
    """Whether the shop has exactly the queries that the application holds."""
    held = {query.id for query in app.queries()}
    theirs = {id for resource in shop.registrar("shop").resources() for id in resource.queries}
    return held == theirs and not app.owed() and app.stats()["loading"] == 0


def run(main: Coroutine[Any, Any, None], factory: Callable[[], asyncio.AbstractEventLoop] | None = None) -> None:
    with asyncio.Runner(loop_factory=factory) as runner:
        runner.run(asyncio.wait_for(main, 30))


def loops() -> list[Any]:
    """The event loops that a program may have."""
    uvloop = pytest.importorskip("uvloop")
    return [pytest.param(None, id="asyncio"), pytest.param(uvloop.new_event_loop, id="uvloop")]


@pytest.mark.parametrize("factory", loops())
def test_a_load_and_its_unload_need_no_loop(shop: rr.System, app: rr.Registrar, factory: Any) -> None:
    async def main() -> None:
        with no_loop(app):
            for _ in range(20):
                query = await app.load_async("shop/thing", FIRST)
                assert query.state is rr.State.OK
                await query.unload_async()

    run(main(), factory)
    assert agree(app, shop)
    assert len(app.queries()) == 1


@pytest.mark.parametrize("factory", loops())
def test_a_task_that_waits_for_a_callback_lets_the_others_run(
    shop: rr.System, app: rr.Registrar, workshop: Workshop, factory: Any
) -> None:
    async def main() -> None:
        slow = asyncio.create_task(app.load_async("shop/thing", Order("slow")))
        await asyncio.to_thread(workshop.wait, "load slow")
        held = await app.load_async("shop/thing", FIRST)
        assert not slow.done()
        workshop.open("made slow")
        query = await slow
        assert query.response.name == "slow"
        await asyncio.gather(held.unload_async(), query.unload_async())
        assert workshop.lines("unload slow")

    workshop.shut("made slow")
    run(main(), factory)
    assert agree(app, shop)


@pytest.mark.filterwarnings("ignore:registrar 'app'. load.. blocks the event loop:RuntimeWarning")
def test_a_blocking_load_that_fails_takes_no_connection_from_a_task_of_its_thread(
    shop: rr.System, app: rr.Registrar, workshop: Workshop
) -> None:
    async def main() -> None:
        slow = asyncio.create_task(app.load_async("shop/thing", Order("slow")))
        await asyncio.to_thread(workshop.wait, "load slow")
        with pytest.raises(rr.LoadTimeout):
            app.load("shop/thing", Order("slower"), timeout_s=0.3)
        workshop.open("made slow")
        assert (await slow).response.name == "slow"

    for step in ("made slow", "made slower"):
        workshop.shut(step)
    run(main())
    workshop.open("made slower")
    eventually(lambda: agree(app, shop))


def test_a_task_that_is_cancelled_while_it_waits_holds_nothing(
    shop: rr.System, app: rr.Registrar, workshop: Workshop
) -> None:
    async def main() -> None:
        slow = asyncio.create_task(app.load_async("shop/thing", Order("slow")))
        await asyncio.to_thread(workshop.wait, "load slow")
        slow.cancel()
        with pytest.raises(asyncio.CancelledError):
            await slow
        workshop.open("made slow")
        other = await app.load_async("shop/thing", Order("other"))  # not the answer to the cancelled load
        assert other.response.name == "other"

    workshop.shut("made slow")
    run(main())
    workshop.wait("unload slow")
    eventually(lambda: agree(app, shop))
    assert {query.request.name for query in app.queries()} == {"first", "other"}


@pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning")
def test_a_load_or_an_unload_whose_event_loop_is_closed_ends_with_its_task(
    shop: rr.System, app: rr.Registrar, workshop: Workshop
) -> None:
    def leave(coroutine: Coroutine[Any, Any, Any], line: str) -> None:
        loop = asyncio.new_event_loop()
        loop.set_exception_handler(
            lambda *_: None
        )  # it complains of each task that is left, whenever that is collected
        task = loop.create_task(coroutine)
        loop.run_until_complete(asyncio.to_thread(workshop.wait, line))
        assert not task.done()
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()

    for step in ("made slow", "unload first"):
        workshop.shut(step)
    (held,) = app.queries()
    leave(held.unload_async(), "unload first")
    leave(app.load_async("shop/thing", Order("slow")), "load slow")
    gc.collect()
    for step in ("made slow", "unload first"):
        workshop.open(step)
    workshop.wait("unload slow")
    eventually(lambda: agree(app, shop))
    assert app.queries() == []


def test_an_unload_whose_task_is_cancelled_goes_on(shop: rr.System, app: rr.Registrar, workshop: Workshop) -> None:
    async def main() -> None:
        query = await app.load_async("shop/thing", Order("slow"))
        unloading = asyncio.create_task(query.unload_async())
        await asyncio.to_thread(workshop.wait, "unload slow")
        unloading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await unloading
        workshop.open("unload slow")

    workshop.shut("unload slow")
    run(main())
    eventually(lambda: len(app.queries()) == 1 and agree(app, shop))


def test_a_time_limit_ends_a_load_whose_provider_hangs_and_leaves_the_loop_of_the_task_free(
    shop: rr.System, app: rr.Registrar
) -> None:
    pid = pid_of(shop, "shop")
    turns = 0

    async def main() -> None:
        nonlocal turns
        load = asyncio.create_task(app.load_async("shop/thing", FIRST, timeout_s=0.3))
        while not load.done():
            await asyncio.sleep(0.01)
            turns += 1
        with pytest.raises(rr.LoadTimeout, match=r"shop/thing: not loaded within 0\.3 s"):
            await load

    hang(pid)
    try:
        run(main())
    finally:
        os.kill(pid, signal.SIGCONT)
    assert turns > 5
    eventually(lambda: agree(app, shop))
    assert len(app.queries()) == 1


def test_a_load_whose_provider_is_killed_is_answered_by_the_next_process(
    shop: rr.System, app: rr.Registrar, workshop: Workshop
) -> None:
    pid = pid_of(shop, "shop")

    async def main() -> None:
        load = asyncio.create_task(app.load_async("shop/thing", Order("slow")))
        await asyncio.to_thread(workshop.wait, "load slow")
        os.kill(pid, signal.SIGKILL)
        workshop.open("made slow")
        query = await load
        assert query.response.pid != pid
        await query.unload_async()

    workshop.shut("made slow")
    run(main())
    eventually(lambda: agree(app, shop))


def test_an_unload_whose_provider_is_killed_is_done_by_the_next_process(
    shop: rr.System, app: rr.Registrar, workshop: Workshop
) -> None:
    pid = pid_of(shop, "shop")

    async def main() -> None:
        query = await app.load_async("shop/thing", Order("slow"))
        unloading = asyncio.create_task(query.unload_async())
        await asyncio.to_thread(workshop.wait, "unload slow")
        os.kill(pid, signal.SIGKILL)
        workshop.open("unload slow")
        await unloading

    workshop.shut("unload slow")
    run(main())
    eventually(lambda: len(app.queries()) == 1 and agree(app, shop))


def test_the_error_of_a_load_or_an_unload_is_that_of_its_callback(
    shop: rr.System, app: rr.Registrar, workshop: Workshop
) -> None:
    async def main() -> None:
        workshop.spoil("load bad")
        with pytest.raises(rr.LoadFailed):
            await app.load_async("shop/thing", Order("bad"))
        query = await app.load_async("shop/thing", Order("kept"))
        workshop.spoil("unload kept")
        with pytest.raises(rr.UnloadFailed):
            await query.unload_async()
        workshop.mend("unload kept")
        await query.unload_async()
        with pytest.raises(rr.UnknownQuery):
            await query.unload_async()

    run(main())
    assert agree(app, shop)
    assert len(app.queries()) == 1


def test_many_tasks_that_load_and_unload_while_the_provider_is_killed_agree_with_it(
    shop: rr.System, app: rr.Registrar
) -> None:
    pid = pid_of(shop, "shop")

    async def one(number: int) -> None:
        for turn in range(10):
            query = await app.load_async("shop/thing", FIRST if turn % 3 else Order(f"{number}"))
            if number % 4 or turn:
                await query.unload_async()

    async def main() -> None:
        tasks = [asyncio.create_task(one(number)) for number in range(40)]
        await asyncio.sleep(0.02)
        os.kill(pid, signal.SIGKILL)
        await asyncio.gather(*tasks)

    run(main())
    wait_respawned(shop, "shop", pid)
    eventually(lambda: agree(app, shop))
    assert len(app.queries()) == 11


def test_what_is_held_after_a_ctrl_c_among_awaited_loads_is_what_the_provider_has(
    shop: rr.System, app: rr.Registrar
) -> None:
    async def main() -> None:
        while True:
            query = await app.load_async("shop/thing", FIRST)
            await query.unload_async()

    for delay_s in (0.01, 0.013, 0.017, 0.019, 0.023):
        timer = threading.Timer(delay_s, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            asyncio.run(main())
        timer.join()
        eventually(lambda: agree(app, shop))
    assert len(app.queries()) == 1


def test_a_task_that_loads_again_and_again_leaves_others_their_turns(app: rr.Registrar) -> None:
    async def load_for(s: float) -> int:
        loads, end = 0, time.monotonic() + s
        while time.monotonic() < end:
            await (await app.load_async("shop/thing", FIRST)).unload_async()
            loads += 1
        return loads

    async def main() -> None:
        loading = asyncio.create_task(load_for(0.3))
        turns = 0
        while not loading.done():
            await asyncio.sleep(0)
            turns += 1
        assert turns * 4 > await loading

    run(main())
