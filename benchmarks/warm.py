"""A load of a resource that exists already: in another process, beside a raw pipe; in this process, beside Pykka."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Literal

import rr_actors as rr
from benchmarks import placement as placement_of
from benchmarks.beside_pipe import cases, placed, provider_processes
from benchmarks.measure import Samples, interleaved
from benchmarks.table import Row
from benchmarks.workload import DURABILITIES, PAYLOAD, SERVER, Ask, running, unload_all
from benchmarks.yardsticks import pykka_ask

AT_MOST = {"none": 2.0, "process": 2.5 if find_spec("uvloop") else 3.0, "power": None}
_P99_AT_MOST = 3.0
_TURNS = 4
_HELD = 100  # at a time
_AWAITED_AT_MOST = {"process": 1.8, "thread": 1.3}
_PLACES: dict[str, Literal["process", "thread"]] = {"another process": "process", "this process": "thread"}


def other_process(times: int) -> list[Row]:
    """One load at a time, each held until its turn is over, with both sides on one core and on two."""
    rows: list[Row] = []
    for placement, durability in cases():
        pipe, load = Samples(()), Samples(())
        processes = provider_processes(times)
        for _ in range(processes):
            with placed(placement, durability) as (echo, system, consumer):
                one_pipe, one_load = _measure(echo, system, consumer, times // processes)
            pipe, load = pipe + one_pipe, load + one_load
        if durability == DURABILITIES[0]:
            rows.append(Row(f"raw pipe echo, {placement}", pipe.median * 1e6, "µs", pipe.p99 * 1e6))
        rows.append(_row(f"warm load, durability {durability}", load, pipe, "pipe", AT_MOST[durability]))
        if durability == "process":
            spread = load.p99 / load.median
            rows.append(Row("  its p99", load.p99 * 1e6, "µs", None, spread, "median", at_most=_P99_AT_MOST))
    return rows


def same_process(times: int) -> list[Row]:
    """Provider and consumer in one process, nothing on disk."""
    rows: list[Row] = []
    for placement in placement_of.placements():
        if placement == placement_of.TWO_CORES:
            continue  # its threads cannot be told apart from outside
        with placement_of.here(placement), pykka_ask(PAYLOAD) as ask, running("none", "thread") as (system, consumer):
            asked, load = _measure(ask, system, consumer, times)
        rows.append(Row(f"pykka ask, this process, {placement}", asked.median * 1e6, "µs", asked.p99 * 1e6))
        rows.append(_row("warm load, this process", load, asked, "ask", 1.5))
    return rows


def with_a_handler(times: int) -> list[Row]:
    """The same in a program that has a signal handler, as services have, beside one without."""
    rows: list[Row] = []
    for name, placement in _PLACES.items():
        without, handled = Samples(()), Samples(())
        for _ in range(_TURNS):
            without += _one_core(placement, times // _TURNS)
            before = signal.signal(signal.SIGTERM, lambda *_: None)
            handled += _one_core(placement, times // _TURNS)
            signal.signal(signal.SIGTERM, before)
        rows.append(_row(f"warm load from {name}, with a signal handler", handled, without, "without one", 1.1))
    return rows


def awaited(times: int) -> list[Row]:
    """A load and its unload that a task of asyncio awaits, beside the blocking calls, on one core."""
    rows: list[Row] = []
    for name, placement in _PLACES.items():
        blocking, load = (Samples(()), Samples(())), (Samples(()), Samples(()))
        with placement_of.here(placement_of.ONE_CORE), running("process", placement) as (system, consumer):
            placement_of.part(placement_of.ONE_CORE)
            system.open_registrar("holder").load(SERVER, Ask(0))
            for _ in range(_TURNS):
                blocking = _added(blocking, _blocking(consumer, times // _TURNS))
                with asyncio.Runner() as runner:
                    load = _added(load, runner.run(_awaited(consumer, times // _TURNS)))
        for what, took, beside in zip(("load", "unload"), load, blocking, strict=True):
            rows.append(_row(f"awaited warm {what}, {name}", took, beside, "blocking", _AWAITED_AT_MOST[placement]))
    return rows


def _added(some: tuple[Samples, Samples], more: tuple[Samples, Samples]) -> tuple[Samples, Samples]:
    return some[0] + more[0], some[1] + more[1]


def _blocking(consumer: rr.Registrar, times: int) -> tuple[Samples, Samples]:
    loads, unloads = list[float](), list[float]()
    while len(loads) < times:
        queries = list[rr.Query]()
        for _ in range(_HELD):
            began = time.perf_counter()
            queries.append(consumer.load(SERVER, Ask(0)))
            loads.append(time.perf_counter() - began)
        for query in queries:
            began = time.perf_counter()
            consumer.unload(query)
            unloads.append(time.perf_counter() - began)
    return Samples(tuple(loads)), Samples(tuple(unloads))


async def _awaited(consumer: rr.Registrar, times: int) -> tuple[Samples, Samples]:
    loads, unloads = list[float](), list[float]()
    while len(loads) < times:
        queries = list[rr.Query]()
        for _ in range(_HELD):
            began = time.perf_counter()
            queries.append(await consumer.load_async(SERVER, Ask(0)))
            loads.append(time.perf_counter() - began)
        for query in queries:
            began = time.perf_counter()
            await consumer.unload_async(query)
            unloads.append(time.perf_counter() - began)
    return Samples(tuple(loads)), Samples(tuple(unloads))


def _one_core(placement: Literal["process", "thread"], times: int) -> Samples:
    with placement_of.here(placement_of.ONE_CORE), running("process", placement) as (system, consumer):
        placement_of.part(placement_of.ONE_CORE)
        return _measure(_nothing, system, consumer, times)[1]


def _nothing() -> None:
    pass


def _measure(
    yardstick: Callable[[], Any], system: rr.System, consumer: rr.Registrar, times: int
) -> tuple[Samples, Samples]:
    system.open_registrar("holder").load(SERVER, Ask(0))
    queries: list[rr.Query] = []

    def load() -> None:
        queries.append(consumer.load(SERVER, Ask(0)))

    def let_go() -> None:
        unload_all(queries, consumer)
        queries.clear()

    measured = interleaved({"yardstick": yardstick, "load": load}, times=times, after_turn=let_go)
    return measured["yardstick"], measured["load"]


def _row(name: str, load: Samples, yardstick: Samples, against: str, at_most: float | None) -> Row:
    ratio = load.median / yardstick.median
    return Row(name, load.median * 1e6, "µs", load.p99 * 1e6, ratio, against, at_most=at_most)
