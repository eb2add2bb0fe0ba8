"""What the scenarios run: a manager that echoes 200 bytes, a system with it, and a consumer."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import rr_actors as rr

Durability = Literal["process", "power", "none"]
DURABILITIES: tuple[Durability, ...] = ("none", "process", "power")
SERVER = "provider/echo"
IN_FLIGHT = 256
PAYLOAD = b"x" * 200


@dataclass(frozen=True)
class Ask:
    """A request: a resource for each number."""

    number: int
    payload: bytes = PAYLOAD


@dataclass(frozen=True)
class Answer:
    """The response: the payload again."""

    payload: bytes


class Echo(rr.Manager):
    """Its load callback does nothing but answer."""

    @rr.server("echo")
    def load_echo(self, request: Ask) -> Answer:
        return Answer(request.payload)

    @load_echo.unload
    def unload_echo(self, request: Ask, response: Answer) -> None:
        pass


class Empty(rr.Actor):
    """Does nothing. Here, as its process imports the module it is in."""


@contextmanager
def running(
    durability: Durability, placement: Literal["process", "thread"] = "process"
) -> Iterator[tuple[rr.System, rr.Registrar]]:
    """A system with the provider in a process of its own, and a consumer in this process, both of this durability."""
    with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
        spec = rr.ChildSpec(Echo, id="provider", placement=placement)
        root = rr.Supervisor([spec], max_restarts=1_000)
        config = rr.SystemConfig(durability=durability)
        with rr.System(root, name="bench", state_dir=state_dir, config=config) as system:
            yield system, system.open_registrar("consumer")


def load_all(registrar: rr.Registrar, requests: Iterable[Ask]) -> list[rr.Query]:
    """Load every request, at most IN_FLIGHT at a time."""
    queries: list[rr.Query] = []
    waiting: deque[Any] = deque()
    for request in requests:
        if len(waiting) == IN_FLIGHT:
            queries.append(waiting.popleft().get())
        waiting.append(registrar.load(SERVER, request, block=False))
    queries.extend(future.get() for future in waiting)
    return queries


def unload_all(queries: Iterable[rr.Query], registrar: rr.Registrar) -> None:
    """Unload every query, at most IN_FLIGHT at a time."""
    waiting: deque[Any] = deque()
    for query in queries:
        if len(waiting) == IN_FLIGHT:
            waiting.popleft().get()
        waiting.append(registrar.unload(query, block=False))
    for future in waiting:
        future.get()
