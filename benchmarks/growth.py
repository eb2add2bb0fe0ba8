"""What the same operations cost while more and more resources are held."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import rr_actors as rr
from benchmarks.measure import Samples, time_each, time_with
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, load_all, running

AIM = 1.25


def growth(sizes: Sequence[int], times: int) -> list[Row]:
    """At each size: warm load, its unload, first load, unload of the last holder; beside the first size's."""
    rows: list[Row] = []
    base: dict[str, float] = {}
    with running("process") as (system, consumer):
        filler = system.open_registrar("filler")
        filled = 0
        for size in sizes:
            start = time.perf_counter()
            load_all(filler, (Ask(number) for number in range(filled, size)))
            taken = time.perf_counter() - start
            rows.append(Row(f"{size:,} held: {size - filled:,} loaded in", taken, "s"))
            filled = size
            for what, samples in _measure(consumer, size, times).items():
                base.setdefault(what, samples.median)
                rows.append(
                    Row(
                        f"{size:,} held: {what}",
                        samples.median * 1e6,
                        "µs",
                        samples.p99 * 1e6,
                        samples.median / base[what] if size != sizes[0] else None,
                        f"at {sizes[0]:,}" if size != sizes[0] else "",
                        at_most=AIM if size != sizes[0] else None,
                    )
                )
    return rows


def _measure(consumer: rr.Registrar, size: int, times: int) -> dict[str, Samples]:
    queries: list[rr.Query] = []
    new = [Ask(-1 - number) for number in range(times)]

    def load(request: Any) -> None:
        queries.append(consumer.load(SERVER, request))

    time_each(lambda: consumer.load(SERVER, Ask(0)).unload(), max(10, times // 10))
    warm = time_with(load, [Ask(size // 2)] * times)
    release = time_with(lambda query: query.unload(), queries)
    queries.clear()
    first = time_with(load, new)
    last = time_with(lambda query: query.unload(), queries)
    return {
        "warm load": Samples(tuple(warm)),
        "unload": Samples(tuple(release)),
        "first load": Samples(tuple(first)),
        "unload of the last holder": Samples(tuple(last)),
    }
