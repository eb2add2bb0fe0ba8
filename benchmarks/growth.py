"""What the same operations cost while more and more resources are held, beside a system that does not grow."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rr_actors as rr
from benchmarks.bystander import ROUNDS, Measured, beside, compared
from benchmarks.measure import time_each, time_with
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, load_all, running


def growth(sizes: Sequence[int], times: int) -> list[Row]:
    """At each size: warm load, its unload, first load, unload of the last holder; beside the first size's."""
    rows: list[Row] = []
    a_round = times // ROUNDS
    with beside(_growing, a_round, sizes[0]) as ((fill, measure), small):
        for size in sizes:
            start = time.perf_counter()
            added = fill(size)
            rows.append(Row(f"{size:,} held: {added:,} loaded in", time.perf_counter() - start, "s"))
            rows += compared(size, sizes[0], measure, small)
    return rows


@contextmanager
def _growing(times: int) -> Iterator[tuple[Callable[[int], int], Callable[[], Measured]]]:
    with running("process") as (system, consumer):
        filler = system.open_registrar("filler")
        filled = 0

        def fill(size: int) -> int:
            nonlocal filled
            added, filled = size - filled, size
            load_all(filler, (Ask(number) for number in range(size - added, size)))
            for registrar in (filler, system.registrar("provider")):
                registrar.save_catalog()  # what is measured then is what many held cost, not their coming
            return added

        yield fill, lambda: _measure(consumer, times)


def _measure(consumer: rr.Registrar, times: int) -> Measured:
    queries: list[rr.Query] = []
    new = [Ask(-1 - number) for number in range(times)]

    def load(request: Any) -> None:
        queries.append(consumer.load(SERVER, request))

    def unload(query: rr.Query) -> None:
        query.unload()

    time_each(lambda: consumer.load(SERVER, Ask(0)).unload(), max(10, times // 10))
    warm = time_with(load, [Ask(0)] * times)
    release = time_with(unload, queries)
    queries.clear()
    first = time_with(load, new)
    last = time_with(unload, queries)
    return {"warm load": warm, "unload": release, "first load": first, "unload of the last holder": last}
