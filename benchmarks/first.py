"""The first load of a request, whose callback only answers, and the unload by its last holder: some time after, or at
once (a brief hold)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rr_actors as rr
from benchmarks.beside_pipe import cases, placed, provider_processes
from benchmarks.measure import Samples, time_each, time_with
from benchmarks.table import Row
from benchmarks.workload import DURABILITIES, SERVER, Ask

ROUNDS = 10
AIM = 6.0


def first_and_last(times: int) -> list[Row]:
    """One at a time, in turns with the raw pipe, with both sides on one core and on two."""
    rows: list[Row] = []
    for placement, durability in cases():
        pipe, taken = Samples(()), dict[str, Samples]()
        processes = provider_processes(times)
        for _ in range(processes):
            with placed(placement, durability) as (echo, _, consumer):
                one_pipe, one = measured(echo, consumer, times // processes)
            pipe += one_pipe
            taken = {what: taken.get(what, Samples(())) + samples for what, samples in one.items()}
        if durability == DURABILITIES[0]:
            rows.append(Row(f"raw pipe echo, {placement}", pipe.median * 1e6, "µs", pipe.p99 * 1e6))
        for what, samples in taken.items():
            name = f"{what}, durability {durability}"
            ratio = samples.median / pipe.median
            at_most = AIM if durability == "process" else None
            rows.append(Row(name, samples.median * 1e6, "µs", samples.p99 * 1e6, ratio, "pipe", at_most=at_most))
    return rows


def measured(yardstick: Callable[[], Any], consumer: rr.Registrar, times: int) -> tuple[Samples, dict[str, Samples]]:
    """The yardstick, and each of the operations, so many times in turns."""
    a_round = max(1, times // ROUNDS)
    beside: list[float] = []
    first: list[float] = []
    last: list[float] = []
    at_once: list[float] = []
    queries: list[rr.Query] = []

    def load(request: Ask) -> None:
        queries.append(consumer.load(SERVER, request))

    def unload(query: rr.Query) -> None:
        query.unload()

    consumer.load(SERVER, Ask(-1)).unload()  # connects
    for number in range(ROUNDS):
        requests = [Ask(number * a_round + i) for i in range(a_round)]
        beside += time_each(yardstick, a_round)
        first += time_with(load, requests)
        last += time_with(unload, queries)
        queries.clear()
        at_once += time_with(unload, (consumer.load(SERVER, request) for request in requests))
    taken = {"first load": first, "unload of the last holder": last, "the same, at once after the load": at_once}
    return Samples(tuple(beside)), {what: Samples(tuple(seconds)) for what, seconds in taken.items()}
