"""A program with an event loop of its own: `async with`, unload_async, and a warning where a call would block it."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import contextvars
import gc
import threading
import time
import warnings
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, cast

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, eventually, serve


class Slow(rr.Actor):
    """Begins to start, says so by a file, and does not end that."""

    def __init__(self, begun: Path | None = None) -> None:
        super().__init__()
        self.begun = begun

    def on_start(self) -> None:
        if self.begun is not None:
            self.begun.touch()
        threading.Event().wait(60)


class SlowToStop(rr.Actor):
    """Begins to stop, says so by a file, and does not end that."""

    def __init__(self, begun: Path) -> None:
        super().__init__()
        self.begun = begun

    def on_stop(self) -> None:
        self.begun.touch()
        threading.Event().wait(60)


class Things(rr.Manager):
    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        return request


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
        system = rr.System([rr.ChildSpec(Slow, id="slow", shutdown_s=0.2)], state_dir=state_dir)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0), system:
                raise AssertionError("it cannot have started")

    asyncio.run(program())
    with rr.System([], state_dir=state_dir):
        pass


def test_a_start_that_is_cancelled_as_it_ends_leaves_no_system_that_nobody_owns(state_dir: Path) -> None:
    async def program() -> None:
        system = rr.System([], state_dir=state_dir)

        async def use() -> None:
            async with system:
                raise AssertionError("it is cancelled")

        using = asyncio.create_task(use())
        await asyncio.sleep(0)  # the start has begun
        while rr.System.running(state_dir) is None:  # a busy loop: it hears of the end of the start only later
            time.sleep(0.001)  # noqa: ASYNC251
        using.cancel()
        with pytest.raises(asyncio.CancelledError):
            await using
        assert rr.System.running(state_dir) is None

    asyncio.run(program())
    with rr.System([], state_dir=state_dir):
        pass


def test_a_stop_that_is_cancelled_twice_has_ended_when_it_returns(
    state_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def program() -> None:
        begun, entered = state_dir.parent / "begun", asyncio.Event()

        async def use() -> None:
            async with rr.System([rr.ChildSpec(SlowToStop, args=(begun,), id="slow")], state_dir=state_dir):
                entered.set()

        using = asyncio.create_task(use())
        await entered.wait()
        await asyncio.to_thread(eventually, begun.exists)
        for _ in range(3):
            using.cancel()
            await asyncio.sleep(0)
        with pytest.raises(asyncio.CancelledError):
            await using
        async with rr.System([], state_dir=state_dir):
            pass

    asyncio.run(program())
    gc.collect()
    assert "never retrieved" not in caplog.text


def test_a_start_that_is_cancelled_twice_leaves_nothing(state_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def program() -> None:
        begun = state_dir.parent / "begun"
        system = rr.System([rr.ChildSpec(Slow, args=(begun,), id="slow", shutdown_s=0.2)], state_dir=state_dir)
        starting = asyncio.create_task(system.__aenter__())
        await asyncio.to_thread(eventually, begun.exists)
        for _ in range(3):
            starting.cancel()
            await asyncio.sleep(0)
        with pytest.raises(asyncio.CancelledError):
            await starting
        async with rr.System([], state_dir=state_dir):
            pass

    asyncio.run(program())
    gc.collect()
    assert "never retrieved" not in caplog.text


def test_async_with_needs_no_thread_of_the_applications_executor(state_dir: Path) -> None:
    async def program() -> None:
        full = threading.Event()
        loop = asyncio.get_running_loop()
        loop.set_default_executor(concurrent.futures.ThreadPoolExecutor(1))
        waiting = asyncio.ensure_future(asyncio.to_thread(full.wait, 20))
        await asyncio.sleep(0)
        async with rr.System([], state_dir=state_dir):
            pass
        assert not waiting.done()
        full.set()
        await waiting

    asyncio.run(program())


@contextlib.asynccontextmanager
async def full_executor() -> AsyncIterator[None]:
    """The event loop's executor has one thread, which is busy."""
    ended = threading.Event()
    asyncio.get_running_loop().set_default_executor(concurrent.futures.ThreadPoolExecutor(1))
    busy = asyncio.ensure_future(asyncio.to_thread(ended.wait, 20))
    await asyncio.sleep(0)
    yield
    assert not busy.done()
    ended.set()
    await busy


def test_the_exit_of_a_group_needs_no_thread_of_the_applications_executor(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")

    async def program() -> None:
        async with full_executor(), await app.load_all_async([("provider/thing", n) for n in range(3)]):
            pass
        assert app.queries() == []

    asyncio.run(program())


def test_to_await_a_future_made_of_others_needs_no_thread_of_the_applications_executor(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing", load=lambda request: request)

    async def program() -> None:
        async with full_executor():
            future = app.load("provider/thing", "x", block=False)
            assert await future.map(lambda query: query.response) == "x"
            with pytest.raises(ZeroDivisionError):
                await future.map(lambda query: 1 / 0)

    asyncio.run(program())


def test_a_group_whose_exit_is_cancelled_is_released_all_the_same(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "thing", unload=lambda *_: gate())

    async def use() -> None:
        async with await app.load_all_async([("provider/thing", n) for n in range(3)]):
            pass

    async def program() -> None:
        using = asyncio.create_task(use())
        await asyncio.to_thread(gate.wait_arrived)
        using.cancel()
        with pytest.raises(asyncio.CancelledError):
            await using

    asyncio.run(program())
    gate.wait_arrived(3)
    gate.open()
    eventually(lambda: app.queries() == [] and provider.resources() == [] and app.owed() == [])


@pytest.mark.parametrize("cancelled", ["block", "exit"])
def test_async_with_that_is_cancelled_does_not_wait_long_for_a_provider_that_is_stopped(
    start: Callable[..., rr.System], cancelled: str
) -> None:
    system = start(rr.ChildSpec(Things, id="things", placement="thread"))
    app = system.open_registrar("app")

    async def program() -> None:
        async with asyncio.timeout(60) as limit, await app.load_all_async([("things/thing", str(n)) for n in range(4)]):
            await asyncio.to_thread(system.supervisor().terminate_child, "things")
            limit.reschedule(0 if cancelled == "block" else asyncio.get_running_loop().time() + 0.5)
            if cancelled == "block":
                await asyncio.Event().wait()

    began = time.monotonic()
    with pytest.raises(TimeoutError):
        asyncio.run(program())
    assert time.monotonic() - began < LIMIT_S
    eventually(lambda: len(app.owed()) == 4)
    system.supervisor().restart_child("things")
    eventually(lambda: app.owed() == [])


def test_a_group_that_is_unloaded_waits_once_for_a_provider_that_is_stopped(start: Callable[..., rr.System]) -> None:
    system = start(rr.ChildSpec(Things, id="things", placement="thread"))
    app = system.open_registrar("app")
    queries = app.load_all([("things/thing", str(n)) for n in range(20)])
    system.supervisor().terminate_child("things")
    began = time.monotonic()
    with pytest.raises(rr.Unavailable, match="'things' is stopped") as caught:
        queries.unload(timeout_s=1)
    assert time.monotonic() - began < LIMIT_S
    assert len(caught.value.__notes__) == 19


@pytest.mark.parametrize("kind", ["own", "handle", "connection"])
def test_a_load_whose_future_is_awaited_no_more_is_withdrawn(
    start: Callable[..., rr.System], state_dir: Path, kind: str
) -> None:
    system = start(*([rr.ChildSpec(Things, id="things")] if kind == "handle" else []))
    gate = Gate()
    provider = system.open_registrar("provider")
    served = serve(provider, "slow", load=gate)

    async def program(registrar: Any) -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(registrar.load("provider/slow", "x", block=False), 0.2)

    with rr.connect(state_dir) as connection:
        makes = {"own": system.open_registrar, "handle": system.registrar, "connection": connection.open_registrar}
        asyncio.run(program(makes[kind]("things")))
        gate.wait_arrived()
        gate.open()
        served.unloads.wait()
        eventually(lambda: provider.resources() == [])


def test_a_load_that_succeeds_as_the_await_of_its_future_is_cancelled_is_released(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    served = serve(provider, "thing", load=gate)

    async def program() -> None:
        future = app.load("provider/thing", "x", block=False)
        awaiting = asyncio.ensure_future(future)
        await asyncio.sleep(0)
        gate.open()
        done = cast("concurrent.futures.Future[Any]", future).done
        eventually(done)  # a busy event loop, which hears of the end only later
        awaiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await awaiting

    asyncio.run(program())
    served.unloads.wait()
    eventually(lambda: app.queries() == [])


def test_a_load_whose_future_is_shielded_goes_on(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "slow", load=gate)

    async def program() -> None:
        future = app.load("provider/slow", "x", block=False)
        awaiting = asyncio.ensure_future(future)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.shield(awaiting), 0.1)
        gate.open()
        assert await awaiting in app.queries()

    asyncio.run(program())


WHO = contextvars.ContextVar("WHO", default="nobody")


@pytest.mark.parametrize("kind", ["own", "group", "connection"])
def test_an_async_status_callback_runs_on_the_loop_that_awaited_the_load(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path, kind: str
) -> None:
    serve(provider, "thing")

    async def program(registrar: Any) -> None:
        woken, heard = asyncio.Event(), list[object]()

        async def on_status(status: rr.Status) -> None:
            heard.append((asyncio.get_running_loop(), WHO.get(), status.message))
            woken.set()

        WHO.set("me")
        if kind == "group":
            (query,) = await registrar.load_all_async([("provider/thing", "x")], on_status=on_status)
        else:
            query = await registrar.load_async("provider/thing", "x", on_status=on_status)
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "old"))
        await asyncio.wait_for(woken.wait(), LIMIT_S)
        assert heard == [(asyncio.get_running_loop(), "me", "old")]
        await query.unload_async()

    with rr.connect(state_dir) as connection:
        asyncio.run(program(connection.open_registrar() if kind == "connection" else app))


def test_an_async_status_callback_does_not_begin_after_the_end_of_the_query(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")

    async def program() -> None:
        heard = Calls()

        async def on_status(status: rr.Status) -> None:
            heard(status.message)

        async def wakes(_status: rr.Status) -> None:
            woken.set()

        query = await app.load_async("provider/thing", "x", on_status=on_status)
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "old"))
        query.wait_status(timeout_s=LIMIT_S)  # a busy event loop
        query.unload()
        later, woken = await app.load_async("provider/thing", "y", on_status=wakes), asyncio.Event()
        provider.send_status(later.resource_id, rr.Status(rr.State.WARNING, "new"))
        await asyncio.wait_for(woken.wait(), LIMIT_S)  # what was to be called before it on this loop has been
        assert heard.items == []

    asyncio.run(program())


def test_an_async_status_callback_outlives_the_loop_that_awaited_the_load(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    heard = Calls()

    async def on_status(status: rr.Status) -> None:
        heard(status.message)
        if status.message == "first":
            await asyncio.Event().wait()  # the end of its loop cancels it

    async def program() -> rr.Query:
        query = await app.load_async("provider/thing", "x", on_status=on_status)
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "first"))
        await asyncio.to_thread(heard.wait)
        return query

    query = asyncio.run(program())
    provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "second"))
    assert heard.wait(2) == ["first", "second"]


def test_without_asyncio_an_awaited_call_says_what_it_needs(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    with app.load("provider/thing", "x") as query, app.load_all([("provider/thing", "y")]) as queries:
        for call in (
            rr.System([], state_dir="unused").__aenter__(),
            app.load_async("provider/thing", "z"),
            app.load_all_async([("provider/thing", "z")]),
            app.unload_async(query),
            query.unload_async(),
            query.__aenter__(),
            queries.__aenter__(),
        ):
            with pytest.raises(rr.UsageError, match="needs asyncio"):
                call.send(None)
        assert len(app.queries()) == 2


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


def test_a_load_by_a_handle_or_a_connection_in_an_event_loop_says_so_too(
    start: Callable[..., rr.System], state_dir: Path, runtime_dir: Path
) -> None:
    system = start(rr.ChildSpec(Things, id="things"))

    async def program() -> None:
        with rr.connect(state_dir) as connection:
            for registrar in (system.registrar("things"), connection.open_registrar("worker")):
                with pytest.warns(RuntimeWarning, match=r"load\(\) blocks the event loop") as heard:
                    registrar.load("things/thing", "x")
                assert heard[0].filename == __file__

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
