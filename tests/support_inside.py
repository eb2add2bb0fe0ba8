"""The one door to the inside, for tests that look at the engine below the public names: its rows, lines and commits."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar

import pytest

import rr_actors as rr
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.links.provider_link import ProviderLink
from rr_actors.streams.publisher import Publisher
from rr_actors.system.console.console_server import Console

T = TypeVar("T")


def actor_of(registrar: rr.Registrar) -> RegistrarActor:
    """Return the actor of a registrar."""
    return registrar._actor  # pyright: ignore[reportPrivateUsage]


def on_loop(registrar: rr.Registrar, fn: Callable[[], T]) -> T:
    """Return what a function returns on the loop of a registrar."""

    async def call() -> T:
        return fn()

    return actor_of(registrar).node.dispatcher.run(call(), 10)


@contextlib.contextmanager
def no_loop(app: rr.Registrar) -> Iterator[None]:
    """Hold the event loop of rr_actors up: nothing that needs it happens meanwhile."""
    entered, release = threading.Event(), threading.Event()

    def wait() -> None:
        entered.set()
        release.wait(30)

    actor_of(app).node.dispatcher.call(wait)
    assert entered.wait(10)
    try:
        yield
    finally:
        release.set()


def node_of(owner: Any) -> Node:
    """Return the node that a system, or a subscriber of it, runs on. It runs."""
    node = owner._node
    assert node is not None
    return node


def console_of(system: rr.System) -> Console:
    """Return the console of a system. It runs."""
    console = system._console  # pyright: ignore[reportPrivateUsage]
    assert console is not None
    return console


def readers_of(publisher: Publisher) -> int:
    """Return how many readers a publisher has taken in."""
    return len(publisher._consumers)  # pyright: ignore[reportPrivateUsage]


class HeldBack:
    """While `on`, keeps back the messages of one kind that links bring from providers: as though not read yet.

    Make it before the links.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, kind: type[Any]) -> None:
        self.on = False
        self.messages: list[Callable[[], None]] = []  # each is to be called on the loop, and is read then
        received = ProviderLink.received

        def receive(client: ProviderLink, link: Any, message: Any) -> None:
            if self.on and type(message) is kind:
                self.messages.append(partial(received, client, link, message))
            else:
                received(client, link, message)

        monkeypatch.setattr(ProviderLink, "received", receive)
