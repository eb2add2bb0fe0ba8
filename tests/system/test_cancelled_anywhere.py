"""Calls to be awaited, cancelled at random moments: nothing is held by nobody, nothing is pending or not awaited."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import random
import sys
import warnings
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import eventually, serve

Call = Callable[[rr.Registrar, int], Awaitable[object]]


async def load(registrar: rr.Registrar, number: int) -> None:
    query = await registrar.load_async("provider/thing", number)
    await query.unload_async()


async def with_query(registrar: rr.Registrar, number: int) -> None:
    async with await registrar.load_async("provider/thing", number, on_status=nothing):
        await asyncio.sleep(0)


async def with_group(registrar: rr.Registrar, number: int) -> None:
    async with await registrar.load_all_async([("provider/thing", number), ("provider/slow", number)]):
        await asyncio.sleep(0)


async def limited_future(registrar: rr.Registrar, number: int) -> None:
    query = await asyncio.wait_for(registrar.load("provider/slow", number, block=False), 0.001)
    await query.unload_async()


async def plain_future(registrar: rr.Registrar, number: int) -> None:
    query = await registrar.load("provider/slow", number, block=False)
    await query.unload_async()


async def nothing(status: rr.Status) -> None:
    """Hear a status."""


CALLS: list[Call] = [load, with_query, with_group, limited_future, plain_future]


async def cancelled(call: Awaitable[object], chance: random.Random) -> None:
    """Begin a call, and cancel it once or twice a moment later; what it raises otherwise is an error of this test."""
    task = asyncio.ensure_future(call)
    for _ in range(chance.choice((1, 1, 2))):
        for _ in range(chance.choice((0, 1, 2, 3, 5, 8, 20))):
            await asyncio.sleep(0)
        if chance.random() < 0.7:
            await asyncio.sleep(chance.random() * 0.004)
        task.cancel()
    with contextlib.suppress(asyncio.CancelledError, TimeoutError):
        await task


def uvloops() -> asyncio.AbstractEventLoop:
    return pytest.importorskip("uvloop").new_event_loop()


def eager() -> asyncio.AbstractEventLoop:
    if sys.version_info < (3, 12):
        pytest.skip("eager tasks came with Python 3.12")
    loop = asyncio.new_event_loop()
    loop.set_task_factory(asyncio.eager_task_factory)
    return loop


@pytest.mark.parametrize("kind", ["own", "handle", "connection"])
@pytest.mark.parametrize("new_loop", [asyncio.new_event_loop, uvloops, eager])
@pytest.mark.parametrize("count", [100, pytest.param(3400, marks=pytest.mark.slow)])
def test_awaited_calls_that_are_cancelled_at_random_leave_nothing(
    start: Callable[..., rr.System],
    state_dir: Path,
    kind: str,
    new_loop: Callable[[], asyncio.AbstractEventLoop],
    count: int,
    caplog: pytest.LogCaptureFixture,
) -> None:
    chance = random.Random(f"{kind} {count}")
    problems: list[dict[str, Any]] = []

    async def slow(request: int) -> int:
        await asyncio.sleep(request % 3 / 1000)
        return request

    system = start(*([rr.ChildSpec(rr.Manager, id="holder")] if kind == "handle" else []))
    provider = system.open_registrar("provider")
    serve(provider, "thing")
    provider.register_server("slow", slow, lambda request, response: None)

    async def program(registrar: rr.Registrar) -> None:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: problems.append(context))
        for first in range(0, count, 20):
            calls = [chance.choice(CALLS)(registrar, 2 * (first + place)) for place in range(20)]
            await asyncio.gather(*[cancelled(call, chance) for call in calls])
        assert asyncio.all_tasks() == {asyncio.current_task()}

    with warnings.catch_warnings(), rr.connect(state_dir) as connection:
        warnings.simplefilter("error")
        makes = {"own": system.open_registrar, "handle": system.registrar, "connection": connection.open_registrar}
        registrar: Any = makes[kind]("holder")
        with asyncio.Runner(loop_factory=new_loop) as runner:
            runner.run(program(registrar))
        eventually(lambda: not registrar.queries())
        eventually(lambda: provider.resources() == [])
        gc.collect()
    assert problems == []
    assert [record.getMessage() for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []


@pytest.mark.parametrize("count", [5, pytest.param(100, marks=pytest.mark.slow)])
def test_async_with_system_that_is_cancelled_at_random_leaves_no_system(state_dir: Path, count: int) -> None:
    chance = random.Random(count)

    async def use() -> None:
        async with rr.System([], state_dir=state_dir):
            await asyncio.sleep(0)

    async def program() -> None:
        for _ in range(count):
            using = asyncio.create_task(use())
            await asyncio.sleep(chance.random() * 0.1)
            for _ in range(chance.choice((1, 1, 2))):
                using.cancel()
                await asyncio.sleep(0)
            with contextlib.suppress(asyncio.CancelledError):
                await using
            assert rr.System.running(state_dir) is None

    asyncio.run(program())
