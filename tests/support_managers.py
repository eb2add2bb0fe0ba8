"""A manager that tests place in any process: what it does, it writes into a Workshop's journal."""

from __future__ import annotations

import asyncio
import os
import time
from dataclasses import dataclass
from pathlib import Path

import rr_actors as rr
from support import Workshop


@dataclass(frozen=True)
class Order:
    """A request of a Shop. `parts` are loaded first: "registrar/server:name" each."""

    name: str
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made:
    """A response of a Shop: who made it in which process."""

    name: str
    shop: str
    pid: int


class Shop(rr.Manager):
    """Serves "thing", and notes in the workshop "load NAME", "made NAME", "unload NAME", "status NAME STATE"."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        self.work.step(f"start {self.registrar.name}")
        self.work.note(f"started {self.registrar.name}", len(self.registrar.queries()))

    def on_stop(self) -> None:
        self.work.note(f"stop {self.registrar.name}")

    @rr.server("thing")
    def load_thing(self, request: Order) -> Made:
        self.work.step(f"load {request.name}", f"attempt={rr.current().attempt}")
        for part in request.parts:
            server, _, name = part.rpartition(":")
            self.registrar.load(server, Order(name))
        self.work.step(f"made {request.name}")
        return Made(request.name, self.registrar.name, os.getpid())

    @load_thing.unload
    def unload_thing(self, request: Order, response: Made) -> None:
        self.work.step(f"unload {request.name}")

    @load_thing.status
    def thing_status(self, request: Order, status: rr.Status) -> None:
        self.work.step(f"status {request.name} {status.state} {status.message}")


def queue_length() -> float:
    """Return the number in the file that RR_TEST_QUEUE names; hang while that says "hang", be cancelled if "cancel"."""
    file = Path(os.environ["RR_TEST_QUEUE"])
    while (text := file.read_text()) == "hang":
        time.sleep(0.01)
    if text == "cancel":
        raise asyncio.CancelledError  # no Exception
    return float(text)
