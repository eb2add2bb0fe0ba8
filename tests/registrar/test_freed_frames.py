"""A load or an ask that raises leaves no cycle of references: what its callers' frames have is freed at once."""

from __future__ import annotations

import contextlib
import gc
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import rr_actors as rr

Start = Callable[..., rr.System]


class Shop(rr.Manager):
    @rr.server("broken")
    def load_broken(self, request: str) -> str:
        raise OSError("no device")


class Clerk(rr.Actor):
    def on_receive(self, message: object) -> None:
        raise ValueError("no such question")


class Had:
    """What a frame has."""


CALLS: dict[str, Callable[[rr.System, rr.Registrar], Any]] = {
    "load": lambda system, app: app.load("shop/broken", "x"),
    "load of a thread": lambda system, app: app.load("near/broken", "x"),
    "load of nobody": lambda system, app: app.load("none/none", "x"),
    "load without waiting": lambda system, app: app.load("shop/broken", "x", block=False).get(),
    "load_all": lambda system, app: app.load_all([("shop/broken", "x"), ("near/broken", "y")]),
    "unload": lambda system, app: app.unload("none"),
    "fetch_queries": lambda system, app: app.fetch_queries("none"),
    "ask": lambda system, app: system.ref("clerk").ask("x"),
    "ask a thread": lambda system, app: system.ref("usher").ask("x"),
    "start_child": lambda system, app: system.start_child(rr.ChildSpec(Clerk, id="clerk")),
}


@pytest.fixture
def without_collections() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("without_collections")
def test_the_frames_of_a_call_that_raises_are_freed_at_once(start: Start) -> None:
    system = start(
        rr.ChildSpec(Shop, id="shop"),
        rr.ChildSpec(Shop, id="near", placement="thread"),
        rr.ChildSpec(Clerk, id="clerk", placement="process"),
        rr.ChildSpec(Clerk, id="usher", placement="thread"),
    )
    app = system.open_registrar("app")

    def keeps(call: Callable[[rr.System, rr.Registrar], Any]) -> bool:
        kept: list[weakref.ref[Had]] = []

        def caller() -> None:
            had = Had()
            kept.append(weakref.ref(had))
            call(system, app)

        with contextlib.suppress(Exception):
            caller()
        return kept[0]() is not None

    assert [name for name, call in CALLS.items() if keeps(call)] == []
