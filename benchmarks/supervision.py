"""What a crash costs: SIGKILL to noticed, to restarted and ready; a hundred children; the memory of an idle manager."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import psutil

import rr_actors as rr
from benchmarks.measure import Samples
from benchmarks.table import Row
from benchmarks.workload import Ask, Echo, Empty, load_all, running

_LIMIT_S = 60.0


def crashes(times: int, held: int) -> list[Row]:
    """An empty actor is killed in turns with starts of a bare forkserver child; then a manager with resources."""
    seconds: dict[str, list[float]] = {"noticed": [], "actor": [], "manager": [], "bare": []}
    with _actor() as system, _bare() as start_bare:
        for _ in range(times):
            noticed, ready = _kill(system, "empty")
            seconds["noticed"].append(noticed)
            seconds["actor"].append(ready)
            seconds["bare"].append(start_bare())
    with running("process") as (system, consumer):
        load_all(consumer, (Ask(number) for number in range(held)))
        for _ in range(times):
            seconds["manager"].append(_kill(system, "provider")[1])
    samples = {name: Samples(tuple(taken)) for name, taken in seconds.items()}
    bare = samples["bare"].median
    return [
        _row("SIGKILL to noticed", samples["noticed"], at_most=3.0),
        _row("bare forkserver child, started and ready", samples["bare"]),
        _row("SIGKILL to ready, empty actor", samples["actor"], at_most=30.0),
        Row("  beside the bare child", samples["actor"].median / bare, "times"),
        _row(f"SIGKILL to ready, manager with {held:,} resources", samples["manager"], at_most=60.0),
    ]


def children(count: int, times: int) -> list[Row]:
    """A system with so many children, each in a process of its own, from start() until all are ready."""
    seconds: list[float] = []
    for _ in range(times):
        specs = [rr.ChildSpec(Empty, id=f"child{number}") for number in range(count)]
        with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
            system = rr.System(specs, state_dir=state_dir)
            start = time.perf_counter()
            with system:
                seconds.append(time.perf_counter() - start)
    taken = Samples(tuple(seconds))
    aim = 1.5 * count / 100
    return [Row(f"{count} children started and ready", taken.median, "s", max(taken.seconds), at_most=aim)]


def memory() -> list[Row]:
    """What an idle manager's process has for itself alone, a second after its start."""
    with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
        specs = [rr.ChildSpec(Echo, id=f"manager{number}") for number in range(3)]
        with rr.System(specs, state_dir=state_dir) as system:
            time.sleep(1.0)
            pids = [child.pid for child in system.supervisor().which_children()]
            uss = [psutil.Process(pid).memory_full_info().uss / 2**20 for pid in pids]
    return [Row("private memory of an idle manager", Samples(tuple(uss)).median, "MB", max(uss), at_most=10.0)]


def _row(name: str, samples: Samples, at_most: float | None = None) -> Row:
    return Row(name, samples.median * 1e3, "ms", samples.p99 * 1e3, at_most=at_most)


@contextmanager
def _actor() -> Iterator[rr.System]:
    with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
        root = rr.Supervisor([rr.ChildSpec(Empty, id="empty")], max_restarts=1_000)
        with rr.System(root, state_dir=state_dir) as system:
            yield system


def _kill(system: rr.System, id: str) -> tuple[float, float]:
    """SIGKILL to a child: seconds until its supervisor knew, and until it was ready again."""
    at: dict[str, float] = {}
    back = threading.Event()

    def heard(event: dict[str, Any]) -> None:
        if event["event"] in ("exited", "restarted") and event["path"] == f"root/{id}":
            at[event["event"]] = event["at"]  # the supervisor's own time: waking this thread is not counted
            if event["event"] == "restarted":
                back.set()

    (child,) = system.supervisor().which_children()
    unsubscribe = system.subscribe(heard)
    start = time.time()
    os.kill(child.pid or 0, signal.SIGKILL)
    if not back.wait(_LIMIT_S):
        raise TimeoutError(f"{id} was not restarted within {_LIMIT_S:g} s")
    unsubscribe()
    return at["exited"] - start, at["restarted"] - start


@contextmanager
def _bare() -> Iterator[Any]:
    """A call that starts a child of multiprocessing's own fork server and waits for its first word; seconds."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # with what a child of rr_actors has at hand, too

    def start() -> float:
        here, there = context.Pipe()
        process = context.Process(target=_say_ready, args=(there,))
        began = time.perf_counter()
        process.start()
        here.recv()
        taken = time.perf_counter() - began
        process.join()
        here.close()
        there.close()
        return taken

    start()  # the fork server itself
    yield start


def _say_ready(connection: Connection) -> None:
    connection.send(True)
