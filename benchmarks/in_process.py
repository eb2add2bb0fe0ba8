"""Loads and unloads at a manager in the application's own process, beside an echo between two threads and a Pykka ask.

Everything runs on one core: the threads of one Python process take turns anyway, and a wake-up of another core would
drown the difference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import rr_actors as rr
from benchmarks import placement as placement_of
from benchmarks.measure import Samples, time_each, time_with
from benchmarks.table import Row
from benchmarks.workload import PAYLOAD, SERVER, Ask, Durability, running
from benchmarks.yardsticks import pykka_ask, thread_echo

ROUNDS = 10
AIMS = {"warm load": 2.5, "unload of a shared hold": 4.0, "first load": 6.0, "unload of the last holder": 9.0}


def in_process(times: int) -> list[Row]:
    """Each operation one at a time, in turns with the echo and the ask."""
    rows: list[Row] = []
    durabilities: tuple[Durability, ...] = ("none", "process")
    for durability in durabilities:
        taken = _measure(durability, max(1, times // ROUNDS))
        echo, ask = taken.pop("echo"), taken.pop("ask")
        rows.append(Row("echo between two threads, on one core", echo.median * 1e6, "µs", echo.p99 * 1e6))
        rows.append(_row("pykka ask", ask, echo, None))
        rows += [_row(f"{what}, durability {durability}", taken[what], echo, AIMS[what]) for what in AIMS]
    return rows


def _row(name: str, samples: Samples, echo: Samples, at_most: float | None) -> Row:
    ratio = samples.median / echo.median
    return Row(name, samples.median * 1e6, "µs", samples.p99 * 1e6, ratio, "echo", at_most=at_most)


def _measure(durability: Durability, a_round: int) -> dict[str, Samples]:
    seconds: dict[str, list[float]] = {what: [] for what in ("echo", "ask", *AIMS)}
    with (
        placement_of.here(placement_of.ONE_CORE),
        thread_echo(PAYLOAD) as echo,
        pykka_ask(PAYLOAD) as ask,
        running(durability, "thread") as (system, consumer),
    ):
        system.open_registrar("holder").load(SERVER, Ask(0))
        for number in range(ROUNDS + 1):
            for what, taken in _round(echo, ask, consumer, 1 + number * a_round, a_round):
                if number:  # the first round warms up
                    seconds[what] += taken
    return {what: Samples(tuple(taken)) for what, taken in seconds.items()}


def _round(
    echo: Callable[[], Any], ask: Callable[[], Any], consumer: rr.Registrar, first: int, count: int
) -> Iterator[tuple[str, list[float]]]:
    queries: list[rr.Query] = []

    def load(request: Ask) -> None:
        queries.append(consumer.load(SERVER, request))

    def unload(query: rr.Query) -> None:
        query.unload()

    yield "echo", time_each(echo, count)
    yield "ask", time_each(ask, count)
    yield "warm load", time_with(load, [Ask(0)] * count)
    yield "unload of a shared hold", time_with(unload, queries)
    queries.clear()
    yield "first load", time_with(load, [Ask(number) for number in range(first, first + count)])
    yield "unload of the last holder", time_with(unload, queries)
