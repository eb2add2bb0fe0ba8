"""Warm loads a second of one provider, with 256 in flight."""

from __future__ import annotations

import time

from benchmarks.table import Row
from benchmarks.workload import DURABILITIES, IN_FLIGHT, SERVER, Ask, load_all, running, unload_all

ROUNDS = 5
AT_LEAST = {"none": None, "process": 40_000, "power": None}


def throughput(times: int) -> list[Row]:
    """The best of some rounds: what the provider can do when the machine lets it."""
    rows: list[Row] = []
    for durability in DURABILITIES:
        with running(durability) as (system, consumer):
            system.open_registrar("holder").load(SERVER, Ask(0))
            best = 0.0
            for _ in range(ROUNDS):
                start = time.perf_counter()
                queries = load_all(consumer, (Ask(0) for _ in range(times)))
                best = max(best, times / (time.perf_counter() - start))
                unload_all(queries, consumer)
        rows.append(
            Row(
                f"pipelined loads ({IN_FLIGHT} in flight), durability {durability}",
                best,
                "/s",
                at_least=AT_LEAST[durability],
            )
        )
    return rows
