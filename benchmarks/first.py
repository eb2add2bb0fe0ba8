"""The first load of a request, whose callback only answers, and the unload by its last holder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rr_actors as rr
from benchmarks.beside_pipe import cases, placed
from benchmarks.measure import Samples, time_each, time_with
from benchmarks.table import Row
from benchmarks.workload import DURABILITIES, SERVER, Ask

ROUNDS = 10
AIM = 6.0


def first_and_last(times: int) -> list[Row]:
    """One at a time, in turns with the raw pipe, with both sides on one core and on two."""
    rows: list[Row] = []
    for placement, durability in cases():
        with placed(placement, durability) as (echo, _, consumer):
            pipe, first, last = _measure(echo, consumer, max(1, times // ROUNDS))
        if durability == DURABILITIES[0]:
            rows.append(Row(f"raw pipe echo, {placement}", pipe.median * 1e6, "µs", pipe.p99 * 1e6))
        for what, taken in (("first load", first), ("unload of the last holder", last)):
            name = f"{what}, durability {durability}"
            ratio = taken.median / pipe.median
            at_most = AIM if durability == "process" else None
            rows.append(Row(name, taken.median * 1e6, "µs", taken.p99 * 1e6, ratio, "pipe", at_most=at_most))
    return rows


def _measure(echo: Callable[[], Any], consumer: rr.Registrar, a_round: int) -> tuple[Samples, Samples, Samples]:
    pipe: list[float] = []
    first: list[float] = []
    last: list[float] = []
    queries: list[rr.Query] = []

    def load(request: Ask) -> None:
        queries.append(consumer.load(SERVER, request))

    consumer.load(SERVER, Ask(-1)).unload()  # connects
    for number in range(ROUNDS):
        pipe += time_each(echo, a_round)
        first += time_with(load, [Ask(number * a_round + i) for i in range(a_round)])
        last += time_with(lambda query: query.unload(), queries)
        queries.clear()
    return Samples(tuple(pipe)), Samples(tuple(first)), Samples(tuple(last))
