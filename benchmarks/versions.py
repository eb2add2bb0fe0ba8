"""Two versions in turns: `python -m benchmarks.versions OTHER_PYTHON [--runs N] [--cores 1|2]`.

OTHER_PYTHON is the interpreter of an environment that has the other version, such as ../before/.venv/bin/python; the
same one shows how much equal code differs. Each run is a system of its own, so that its processes are placed anew: on
one core it matters for the whole life of a process at which address the interpreter is (docs/performance.md). Runs in
which that costs time are counted apart.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import rr_actors as rr

PREDICTOR_BYTES = 1 << 24
"""Branches of two processes that are this far apart, or a multiple of it, are one branch to some processors."""

_WARM_UP = 300
_WARM, _FIRST, _PARTS, _PIPELINED = 3_000, 1_000, 500, 5_000
_IN_FLIGHT = 256


def code_address() -> int:
    """Where this process has the code of its interpreter."""
    return ctypes.cast(ctypes.pythonapi.PyObject_Call, ctypes.c_void_p).value or 0


class Provider(rr.Manager):
    """Answers with the address of its interpreter's code."""

    @rr.server("echo")
    def load_echo(self, number: int) -> int:
        return code_address()


class Whole(rr.Manager):
    """Measures loads from within a callback."""

    @rr.server("whole")
    def load_whole(self, number: int) -> float:
        seconds: list[float] = []
        for _ in range(_PARTS):
            start = time.perf_counter()
            query = self.registrar.load("provider/echo", 0)
            seconds.append(time.perf_counter() - start)
            query.unload()
        return statistics.median(seconds)


def measure(cores: int) -> dict[str, float]:
    """Figures of one system, in seconds; and whether its two processes are one to a branch predictor."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:cores]))
    specs = [rr.ChildSpec(Provider, id="provider"), rr.ChildSpec(Whole, id="whole")]
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as directory,
        rr.System(specs, state_dir=f"{directory}/state") as system,
    ):
        app = system.open_registrar("app")
        address = app.load("provider/echo", 0).response
        _timed(app, lambda number: 0, _WARM_UP)
        began = time.perf_counter()
        warm, unload = _timed(app, lambda number: 0, _WARM)
        pair = (time.perf_counter() - began) / _WARM
        first, last = _timed(app, lambda number: number + 1, _FIRST)
        part = app.load("whole/whole", 0, timeout_s=60.0).response
        pipelined = [_pipelined(app) for _ in range(3)]
    alike = (address - code_address()) % PREDICTOR_BYTES == 0
    return {
        **_figures("warm load", warm),
        **_figures("its unload", unload),
        "both, in the mean": pair,
        **_figures("first load", first),
        **_figures("unload of the last holder", last),
        "warm load in a callback": part,
        "pipelined load": statistics.median(load for load, _ in pipelined),
        "pipelined unload": statistics.median(unload for _, unload in pipelined),
        "alike": alike,
    }


def _figures(name: str, seconds: list[float]) -> dict[str, float]:
    return {name: statistics.median(seconds), f"{name}, p99": statistics.quantiles(seconds, n=100)[-1]}


def _timed(app: rr.Registrar, request: Callable[[int], int], times: int) -> tuple[list[float], list[float]]:
    loads: list[float] = []
    unloads: list[float] = []
    for number in range(times):
        start = time.perf_counter()
        query = app.load("provider/echo", request(number))
        held = time.perf_counter()
        query.unload()
        unloads.append(time.perf_counter() - held)
        loads.append(held - start)
    return loads, unloads


def _pipelined(app: rr.Registrar) -> tuple[float, float]:
    waiting: deque[Any] = deque()
    queries: list[Any] = []
    began = time.perf_counter()
    for _ in range(_PIPELINED):
        if len(waiting) == _IN_FLIGHT:
            queries.append(waiting.popleft().get())
        waiting.append(app.load("provider/echo", 0, block=False))
    queries += [reply.get() for reply in waiting]
    loaded = time.perf_counter()
    for reply in [app.unload(query, block=False) for query in queries]:
        reply.get()
    return (loaded - began) / _PIPELINED, (time.perf_counter() - loaded) / _PIPELINED


def main() -> None:
    """Measure both, and print one line for each figure."""
    parser = argparse.ArgumentParser(prog="benchmarks.versions", description="Two versions of rr_actors in turns.")
    parser.add_argument("other", metavar="OTHER_PYTHON", help="the interpreter that has the version before")
    parser.add_argument("--runs", type=int, default=8, help="systems of each version (default: 8)")
    parser.add_argument("--cores", type=int, choices=(1, 2), default=1, help="for all processes together (default: 1)")
    options = parser.parse_args()
    runs: dict[str, list[dict[str, float]]] = {options.other: [], sys.executable: []}
    for _ in range(options.runs):
        for python, figures in runs.items():
            command = [python, __file__, "--one", str(options.cores)]
            figures.append(json.loads(subprocess.check_output(command)))
    before, now = ([run for run in figures if not run["alike"]] for figures in runs.values())
    alike = [run for figures in runs.values() for run in figures if run["alike"]]
    print(f"{'µs, medians of runs':<32}{'before':>8}{'now':>8}{'ratio':>8}")
    for name in [name for name in now[0] if name != "alike"]:
        theirs, ours = (statistics.median(run[name] for run in figures) * 1e6 for figures in (before, now))
        print(f"{name:<32}{theirs:8.1f}{ours:8.1f}{ours / theirs:8.2f}")
    print(f"\nleft out: {len(alike)} of {2 * options.runs} runs, as the interpreter's addresses in the two processes")
    print("differ by a multiple of 16 MiB; their warm loads took", *(f"{run['warm load'] * 1e6:.1f}" for run in alike))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(measure(int(sys.argv[2]))))
    else:
        main()
