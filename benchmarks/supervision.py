"""What a crash costs: SIGKILL to noticed, to restarted and ready; a hundred children; the memory of an idle manager."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import psutil

import rr_actors as rr
from benchmarks.measure import Samples
from benchmarks.table import Row
from benchmarks.workload import Ask, Echo, Empty, load_all, running
from rr_actors.runtime.processes.child_bootstrap import PRELOAD

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
    """Children in processes of their own: started, and killed at once; beside as many bare forkserver children.

    Bare children do nothing, or have an event loop in a thread that listens on a socket.
    """
    seconds: dict[str, list[float]] = {"bare": [], "listening": [], "started": [], "back": [], "managers": []}
    specs = [rr.ChildSpec(Empty, id=f"child{number}") for number in range(count)]
    for _ in range(times):
        with _bare() as start_bare:
            seconds["bare"].append(start_bare(count))
        with _bare("listen") as start_bare:
            seconds["listening"].append(start_bare(count))
        with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
            config = rr.SystemConfig(preload=(Empty.__module__,))  # a bare child imports nothing of its own either
            system = rr.System(rr.Supervisor(specs, max_restarts=2 * count), state_dir=state_dir, config=config)
            start = time.perf_counter()
            with system:
                seconds["started"].append(time.perf_counter() - start)
                seconds["back"].append(_kill_all(system))
        seconds["managers"].append(_start_managers(count))
    bare, listening, started, back, managers = (Samples(tuple(taken)) for taken in seconds.values())
    return [
        Row(f"{count} bare forkserver children started and ready", bare.median, "s", max(bare.seconds)),
        Row(f"{count} that have a loop and listen", listening.median, "s", max(listening.seconds)),
        Row(
            f"{count} children started and ready", started.median, "s", max(started.seconds), at_most=1.5 * count / 100
        ),
        Row("  beside the bare children", started.median / bare.median, "times", at_most=1.2),
        Row("  beside those that listen", started.median / listening.median, "times"),
        Row(f"{count} managers with a server, started and ready", managers.median, "s", max(managers.seconds)),
        Row("  beside the children, which are empty actors", managers.median / started.median, "times", at_most=2.0),
        Row(f"{count} children killed at once, until all are back", back.median, "s", max(back.seconds)),
        Row("  beside the bare children", back.median / bare.median, "times", at_most=1.5),
        Row("  beside those that listen", back.median / listening.median, "times"),
    ]


def _start_managers(count: int) -> float:
    specs = [rr.ChildSpec(Echo, id=f"manager{number}") for number in range(count)]
    with tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir:
        config = rr.SystemConfig(preload=(Echo.__module__,))
        start = time.perf_counter()
        with rr.System(specs, state_dir=state_dir, config=config):
            return time.perf_counter() - start


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
    child.kill()
    if not back.wait(_LIMIT_S):
        raise TimeoutError(f"{id} was not restarted within {_LIMIT_S:g} s")
    unsubscribe()
    return at["exited"] - start, at["restarted"] - start


def _kill_all(system: rr.System) -> float:
    """SIGKILL to all children at once: seconds until the last was ready again."""
    children = system.supervisor().which_children()
    missing = {f"root/{child.id}" for child in children}
    back = threading.Event()

    def heard(event: dict[str, Any]) -> None:
        if event["event"] == "restarted":
            missing.discard(event["path"])
            if not missing:
                back.set()

    unsubscribe = system.subscribe(heard)
    start = time.perf_counter()
    for child in children:
        child.kill()
    if not back.wait(_LIMIT_S):
        raise TimeoutError(f"{len(missing)} of {len(children)} were not restarted within {_LIMIT_S:g} s")
    taken = time.perf_counter() - start
    unsubscribe()
    return taken


_BARE = """
import multiprocessing, sys, time
from benchmarks import bare_child
context = multiprocessing.get_context("forkserver")
context.set_forkserver_preload({preload!r})  # so that a bare child is forked from as large a process
for line in sys.stdin:
    pipes = [context.Pipe() for _ in range(int(line))]
    children = [context.Process(target=bare_child.{target}, args=(there,)) for _, there in pipes]
    began = time.perf_counter()
    for child in children:
        child.start()
    for here, _ in pipes:
        here.recv_bytes()
    print(time.perf_counter() - began, flush=True)
    for child in children:
        child.join()
"""
"""Starts as many children of multiprocessing's own fork server as each line says, and prints the seconds.

It is no file, as each child would import its main program again.
"""


@contextmanager
def _bare(target: str = "say") -> Iterator[Callable[..., float]]:
    """A call that starts so many bare children and waits for the first word of each; seconds.

    Args:
        target: the name of the function of benchmarks/bare_child.py that they run.
    """
    code = _BARE.format(preload=["benchmarks.bare_child", *PRELOAD], target=target)
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin
    assert process.stdout
    asked, answers = process.stdin, process.stdout

    def start(count: int = 1) -> float:
        print(count, file=asked, flush=True)
        return float(answers.readline())

    try:
        start()  # the fork server itself
        yield start
    finally:
        asked.close()
        process.wait()
        answers.close()
