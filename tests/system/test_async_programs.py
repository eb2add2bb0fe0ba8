"""A program with an event loop of its own: `async with`, unload_async, and a warning where a call would block it."""

from __future__ import annotations

import asyncio
import threading
import warnings
from pathlib import Path

import pytest

import rr_actors as rr
from support import Gate, eventually, serve


class Slow(rr.Actor):
    def on_start(self) -> None:
        threading.Event().wait(60)


def test_async_with_starts_and_stops_a_system_while_the_loop_goes_on(state_dir: Path) -> None:
    async def program() -> int:
        turns = 0

        async def turn() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        turning = asyncio.create_task(turn())
        async with rr.System([], state_dir=state_dir) as system:
            assert system.tree()
            during = turns
        turning.cancel()
        with pytest.raises(rr.UsageError, match="not running"):
            system.tree()
        assert turns > during
        return during

    assert asyncio.run(program()) > 2  # a start that blocks the loop leaves it one turn before, and perhaps one after


def test_a_cancelled_async_with_gives_the_start_up_and_leaves_nothing(state_dir: Path) -> None:
    async def program() -> None:
        system = rr.System([rr.ChildSpec(Slow, id="slow")], state_dir=state_dir)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0), system:
                raise AssertionError("it cannot have started")

    asyncio.run(program())
    with rr.System([], state_dir=state_dir):
        pass


def test_async_with_unloads_a_query_once(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")

    async def program() -> None:
        async with await app.load_async("provider/thing", "x") as query:
            assert app.queries() == [query]
        async with await app.load_async("provider/thing", "y") as query:
            await query.unload_async()
            with pytest.raises(rr.UnknownQuery):
                await app.unload_async(query)

    asyncio.run(program())
    assert [request for request, _ in served.unloads] == ["x", "y"]
    assert app.queries() == []


def test_what_unload_async_waits_for_does_not_hold_up_the_loop(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "thing", unload=lambda *_: gate())

    async def program() -> None:
        query = await app.load_async("provider/thing", "x")
        unloading = asyncio.create_task(app.unload_async(query))
        await asyncio.to_thread(gate.wait_arrived)
        assert not unloading.done()
        gate.open()
        await unloading

    asyncio.run(program())


def test_a_query_seen_from_a_handle_is_unloaded_by_await(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    asyncio.run(system.registrar("app").unload_async(query.id))
    eventually(lambda: app.queries() == [])


def test_load_in_an_event_loop_says_once_that_it_blocks_it(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")

    async def program() -> None:
        with pytest.warns(RuntimeWarning, match=r"load\(\) blocks the event loop .*await load_async\(") as heard:
            app.load("provider/thing", "x")
        assert heard[0].filename == __file__
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            app.load("provider/thing", "y")
            await app.load_async("provider/thing", "z")
            app.load("provider/thing", "x", block=False).get(timeout=10)

    asyncio.run(program())


def test_load_in_a_callback_that_is_a_coroutine_is_refused_without_a_warning(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "part")

    async def load_whole(request: str) -> str:
        provider.load("provider/part", request)
        return request

    provider.register_server("whole", load_whole)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        with pytest.raises(rr.LoadFailed, match=r"refused in an `async def` callback.*load_async"):
            app.load("provider/whole", "x")
    assert heard == []


def test_load_outside_of_an_event_loop_warns_of_nothing(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        app.load("provider/thing", "x")
        asyncio.run(asyncio.to_thread(app.load, "provider/thing", "y"))
