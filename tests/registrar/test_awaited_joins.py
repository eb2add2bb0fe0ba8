"""Loads that tasks await, of what others hold in the same process: at once, as by a thread."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from collections import Counter
from typing import Any

import pytest

import rr_actors as rr
from support import Served, eventually, serve
from support_inside import no_loop


def agree(app: rr.Registrar, provider: rr.Registrar) -> bool:
    held = {query.id for query in app.queries()}
    theirs = {id for resource in provider.resources() for id in resource.queries}
    return held == theirs and not app.owed() and app.stats()["loading"] == 0


def test_a_load_of_what_others_hold_needs_no_loop(app: rr.Registrar, provider: rr.Registrar, served: Served) -> None:
    async def main() -> None:
        with no_loop(app):
            query = await asyncio.wait_for(app.load_async("provider/thing", "x"), 10)
            assert query.state is rr.State.OK
        await query.unload_async()

    app.load("provider/thing", "x").unload()  # over the link: the next ones are beside it
    asyncio.run(main())
    assert agree(app, provider)
    assert len(app.queries()) == 1


def test_what_nobody_holds_is_loaded_by_the_loop_and_unloaded_with_its_last_holder(
    app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    async def main() -> None:
        for number in range(20):
            async with await app.load_async("provider/thing", number) as query:
                assert query.request == number
        one, other = await asyncio.gather(*(app.load_async("provider/thing", "y") for _ in range(2)))
        await one.unload_async()
        assert len(provider.resources()) == 2
        await other.unload_async()

    asyncio.run(main())
    eventually(lambda: len(provider.resources()) == 1)
    assert agree(app, provider)


def test_tasks_that_load_at_once_leave_others_their_turns(app: rr.Registrar, served: Served) -> None:
    async def load(done: list[int], number: int) -> None:
        for _ in range(200):
            await app.load_async("provider/thing", "x")
            done.append(number)

    async def main() -> list[int]:
        done: list[int] = []
        await asyncio.gather(*(load(done, number) for number in range(5)))
        return done

    app.load("provider/thing", "x").unload()
    done = asyncio.run(main())
    first_half = Counter(done[: len(done) // 2])
    assert sorted(first_half) == [0, 1, 2, 3, 4]
    assert max(first_half.values()) < 200


def test_a_load_that_is_cancelled_between_two_tasks_is_held_by_nobody(
    app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    async def load_for_ever() -> None:
        while True:
            query = await app.load_async("provider/thing", "x")
            await query.unload_async()

    async def main() -> None:
        for turns in range(60):
            task = asyncio.create_task(load_for_ever())
            for _ in range(turns % 7 + 1):
                await asyncio.sleep(0)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    asyncio.run(main())
    eventually(lambda: agree(app, provider))
    eventually(lambda: len(app.queries()) == 1)


@pytest.mark.parametrize("options", [{}, {"durability": "none"}, {"durability": "power"}, {"save_on_modify": False}])
def test_tasks_threads_and_futures_agree_on_what_is_held(system: rr.System, options: dict[str, Any]) -> None:
    app, provider = (
        system.open_registrar(name, rr.RegistrarConfig(name, **options)) for name in ("consumer", "provider")
    )
    serve(provider, "thing")
    held = app.load("provider/thing", "x")

    async def tasks() -> None:
        async def one(number: int) -> None:
            query = await app.load_async("provider/thing", "x", priority=number)
            if number % 3:
                await query.unload_async()

        await asyncio.gather(*(one(number) for number in range(100)))

    def threads() -> None:
        for number in range(100):
            query = app.load("provider/thing", "x")
            if number % 3:
                app.unload(query, block=False).get(timeout=30)

    others = [threading.Thread(target=threads) for _ in range(2)]
    for thread in others:
        thread.start()
    asyncio.run(tasks())
    for thread in others:
        thread.join()
    eventually(lambda: agree(app, provider))
    assert len(app.queries()) == 1 + 3 * 34
    held.unload()
    app.unload_all()
    assert provider.resources() == []


def test_what_is_held_after_a_ctrl_c_among_awaited_loads_is_what_the_provider_has(
    app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    async def main(timer: threading.Timer) -> None:
        timer.start()
        while True:
            query = await app.load_async("provider/thing", "x")
            await query.unload_async()

    app.load("provider/thing", "x").unload()
    for delay_s in (0.01, 0.013, 0.017, 0.019, 0.023):
        timer = threading.Timer(delay_s, os.kill, (os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            asyncio.run(main(timer))
        timer.join()
        eventually(lambda: agree(app, provider))
    assert len(app.queries()) == 1


def test_a_provider_that_closes_is_heard_by_the_next_awaited_load(
    app: rr.Registrar, provider: rr.Registrar, served: Served
) -> None:
    async def main() -> None:
        query = await app.load_async("provider/thing", "x")
        provider.close()
        with pytest.raises(rr.RrError):
            await app.load_async("provider/thing", "x", timeout_s=1.0)
        assert query.state is rr.State.FATAL

    app.load("provider/thing", "x").unload()
    asyncio.run(main())
