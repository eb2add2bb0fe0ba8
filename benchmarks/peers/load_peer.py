"""rr_actors: a load of a resource that exists, on disk in another process before it is answered."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import rr_actors as rr
from benchmarks.measure import time_each
from benchmarks.peers.contest import Contest
from benchmarks.peers.flight import seconds_away, seconds_of
from benchmarks.workload import SERVER, Ask, load_all, running, unload_all


@contextmanager
def contest() -> Iterator[Contest]:
    """A manager in a process of its own, with durability "process"; what is loaded is unloaded after each round."""
    with running("process") as (system, consumer):
        system.open_registrar("holder").load(SERVER, Ask(0))
        queries: list[rr.Query] = []

        def load() -> None:
            queries.append(consumer.load(SERVER, Ask(0)))

        def many(times: int) -> None:
            queries.extend(load_all(consumer, (Ask(0) for _ in range(times))))

        def let_go() -> None:
            unload_all(queries, consumer)
            queries.clear()

        def kill() -> None:
            (child,) = system.supervisor().which_children()
            assert child.pid is not None
            os.kill(child.pid, signal.SIGKILL)

        yield Contest(
            rr.__version__,
            lambda times: time_each(load, times),
            lambda times: seconds_of(many, times),
            lambda: seconds_away(kill, load),
            let_go,
        )
