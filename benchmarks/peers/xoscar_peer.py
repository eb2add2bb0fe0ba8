"""xoscar: a call of an actor in a worker process of its pool."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Any, TypeVar

import uvloop
import xoscar as xo  # pyright: ignore[reportMissingImports]  # a requirement of this benchmark alone

from benchmarks.peers.contest import IN_FLIGHT, PAYLOAD, Contest

T = TypeVar("T")
_PATIENCE_S = 20.0


class Echo(xo.Actor):
    """Answers with what it is called with."""

    def echo(self, message: bytes) -> bytes:
        return message

    def pid(self) -> int:
        return os.getpid()


async def _calls(actor: Any, times: int) -> list[float]:
    clock = time.perf_counter
    seconds: list[float] = []
    for _ in range(times):
        start = clock()
        await actor.echo(PAYLOAD)
        seconds.append(clock() - start)
    return seconds


async def _pipelined(actor: Any, times: int) -> float:
    start = time.perf_counter()
    left = iter(range(times))

    async def one_of_many() -> None:
        for _ in left:
            await actor.echo(PAYLOAD)

    await asyncio.gather(*(one_of_many() for _ in range(IN_FLIGHT)))
    return time.perf_counter() - start


async def _kill(actor: Any) -> float:
    pid = await actor.pid()
    start = time.perf_counter()
    os.kill(pid, signal.SIGKILL)
    while True:
        try:
            await asyncio.wait_for(actor.echo(PAYLOAD), 1.0)
        except Exception as error:
            if time.perf_counter() - start > _PATIENCE_S:
                raise TimeoutError(f"no answer for {_PATIENCE_S:g} s after SIGKILL: {error!r}") from error
            await asyncio.sleep(0.001)
        else:
            return time.perf_counter() - start


@contextmanager
def contest() -> Iterator[Contest]:
    """A pool with one worker process, which is recovered with its actors; uvloop on both sides."""
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:

        def run(work: Coroutine[Any, Any, T]) -> T:
            return runner.run(work)

        pool: Any = run(xo.create_actor_pool("127.0.0.1:0", n_process=1, auto_recover="actor"))
        strategy = xo.allocate_strategy.ProcessIndex(1)
        place = {"address": pool.external_address, "uid": "echo", "allocate_strategy": strategy}
        actor: Any = run(xo.create_actor(Echo, **place))
        try:
            yield Contest(
                metadata.version("xoscar"),
                lambda times: run(_calls(actor, times)),
                lambda times: run(_pipelined(actor, times)),
                lambda: run(_kill(actor)),
            )
        finally:
            run(pool.stop())
