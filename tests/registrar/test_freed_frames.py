"""A load or an ask that raises leaves no cycle of references: what its callers' frames have is freed at once."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import gc
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import eventually

Start = Callable[..., rr.System]


class Shop(rr.Manager):
    @rr.server("broken")
    def load_broken(self, request: str) -> str:
        raise OSError("no device")

    @rr.server("slow")
    def load_slow(self, request: str) -> str:
        rr.current().stopping.wait(0.05)
        return request


class Clerk(rr.Actor):
    def on_receive(self, message: object) -> None:
        raise ValueError("no such question")

    def sell(self) -> None:
        raise ValueError("nothing to sell")

    def sum(self, *prices: int) -> int:
        return sum(prices)


class Had:
    """What a frame has."""


LOADS: dict[str, Callable[[Any], Any]] = {
    "load": lambda of: of.load("shop/broken", "x"),
    "load of a thread": lambda of: of.load("near/broken", "x"),
    "load of nobody": lambda of: of.load("none/none", "x"),
    "load without time": lambda of: of.load("shop/slow", "x", timeout_s=0),
    "load without waiting": lambda of: of.load("shop/broken", "x", block=False).get(),
    "result of a load": lambda of: of.load("shop/broken", "x", block=False).result(),
    "exception of a load": lambda of: of.load("shop/broken", "x", block=False).exception(),
    "load_all": lambda of: of.load_all([("shop/broken", "x"), ("near/broken", "y")]),
    "unload": lambda of: of.unload("none"),
    "unload without waiting": lambda of: of.unload("none", block=False).get(),
    "unload_client": lambda of: of.unload_client("none/none"),
    "fetch_state": lambda of: of.fetch_state("none"),
}
CALLS: dict[str, Callable[[rr.System, rr.Registrar], Any]] = {
    "fetch_queries": lambda system, app: app.fetch_queries("none"),
    "children of a handle": lambda system, app: system.registrar("shop").children("none"),
    "ask": lambda system, app: system.ref("clerk").ask("x"),
    "ask a thread": lambda system, app: system.ref("usher").ask("x"),
    "ask without waiting": lambda system, app: system.ref("clerk").ask("x", block=False).get(),
    "ask a thread without waiting": lambda system, app: system.ref("usher").ask("x", block=False).get(),
    "map": lambda system, app: asked(system).map(repr).get(),
    "map, of map": lambda system, app: asked(system).map(repr).map(repr).get(),
    "map that fails": lambda system, app: system.ref("clerk").proxy().sum(1, 2).map(len).get(),
    "filter": lambda system, app: asked(system).filter(repr).get(),
    "reduce": lambda system, app: asked(system).reduce(max, 0).get(),
    "join": lambda system, app: asked(system).join(asked(system)).get(),
    "join of one that fails": lambda system, app: system.ref("clerk").proxy().sum(1, 2).join(asked(system)).get(),
    "result of map": lambda system, app: asked(system).map(repr).result(5.0),
    "exception of map": lambda system, app: asked(system).map(repr).exception(),
    "wait for map": lambda system, app: concurrent.futures.wait([asked(system).map(repr)], 5.0),
    "proxy": lambda system, app: system.ref("clerk").proxy().sell().get(),
    "proxy of a thread": lambda system, app: system.ref("usher").proxy().sell().get(),
    "start_child": lambda system, app: system.start_child(rr.ChildSpec(Clerk, id="clerk")),
}
AWAITED: dict[str, Callable[[Any], Any]] = {
    "load": lambda of: of.load_async("shop/broken", "x"),
    "load without time": lambda of: of.load_async("shop/slow", "x", timeout_s=0),
    "load_all": lambda of: of.load_all_async([("shop/broken", "x"), ("near/broken", "y")]),
    "future": lambda of: load_future(of),
    "unload": lambda of: of.unload_async("none"),
}


def asked(system: rr.System) -> Any:
    """The future of an ask that fails."""
    return system.ref("clerk").ask("x", block=False)


async def load_future(of: Any) -> None:
    await of.load("shop/broken", "x", block=False)  # no frame has the future


@pytest.fixture
def without_collections() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("without_collections", "runtime_dir")
def test_the_frames_of_a_call_that_raises_are_freed_at_once(start: Start, state_dir: Path) -> None:
    system = start(
        rr.ChildSpec(Shop, id="shop"),
        rr.ChildSpec(Shop, id="near", placement="thread"),
        rr.ChildSpec(Clerk, id="clerk", placement="process"),
        rr.ChildSpec(Clerk, id="usher", placement="thread"),
    )
    app = system.open_registrar("app")
    with rr.connect(state_dir) as connection:
        consumers: dict[str, Any] = {
            "app": app,
            "handle": system.registrar("shop"),
            "handle of a thread": system.registrar("near"),
            "connection": connection.open_registrar("mine"),
        }
        calls = {name: functools.partial(call, system, app) for name, call in CALLS.items()}
        for whose, consumer in consumers.items():
            calls |= {f"{whose}: {name}": functools.partial(call, consumer) for name, call in LOADS.items()}
        assert [name for name, call in calls.items() if keeps(call)] == []
        asyncio.run(check_awaited(consumers))


def keeps(call: Callable[[], Any]) -> bool:
    kept: list[weakref.ref[Had]] = []

    def caller() -> None:
        had = Had()
        kept.append(weakref.ref(had))
        call()

    with contextlib.suppress(Exception):
        caller()
    return is_kept(kept[0])


async def check_awaited(consumers: dict[str, Any]) -> None:
    async def caller(kept: list[weakref.ref[Had]], call: Callable[[Any], Any], consumer: Any) -> None:
        had = Had()
        kept.append(weakref.ref(had))
        await call(consumer)

    for whose, consumer in consumers.items():
        for name, call in AWAITED.items():
            kept: list[weakref.ref[Had]] = []
            with contextlib.suppress(Exception):
                await caller(kept, call, consumer)
            assert not await asyncio.to_thread(is_kept, kept[0]), f"{whose}: {name}"


def is_kept(had: weakref.ref[Had]) -> bool:
    """Return whether it is there when threads that end have ended."""
    try:
        eventually(lambda: had() is None, 2.0)
    except AssertionError:
        return True
    return False
