"""Run the benchmarks: `make bench`, or `python -m benchmarks.run [--quick] [--only NAME] [--json FILE]`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks import (
    asking,
    busy,
    chain,
    exchange,
    first,
    growth,
    health,
    importing,
    in_process,
    in_step,
    large,
    memory,
    pipelined,
    planning,
    recovery,
    simulating,
    stopping,
    streaming,
    supervision,
    synced,
    table,
    upkeep,
    warm,
)

Scenario = Callable[[], list[table.Row]]

FULL: dict[str, Scenario] = {
    "warm": partial(warm.other_process, 3_000),
    "local": partial(warm.same_process, 5_000),
    "handler": partial(warm.with_a_handler, 4_000),
    "awaited": partial(warm.awaited, 5_000),
    "in-process": partial(in_process.in_process, 5_000),
    "first": partial(first.first_and_last, 2_000),
    "synced": partial(synced.first_and_last, 1_000),
    "ask": partial(asking.other_process, 3_000),
    "ask-local": partial(asking.same_process, 5_000),
    "large": partial(large.large, 100),
    "streaming": partial(streaming.streaming, 100, 20_000),
    "pipelined": partial(pipelined.throughput, 20_000),
    "held": partial(growth.growth, (100, 1_000, 10_000, 100_000), 1_000),
    "growth": partial(in_step.in_step, 10, 3),
    "recovery": partial(recovery.recovery, 1_000, 5, 60.0),
    "recovery-100k": partial(recovery.recovery, 100_000, 3, 700.0),
    "recovery-100k-shared": partial(recovery.recovery, 100_000, 3, 500.0, 1_000),
    "stopping": partial(stopping.stopping, 100_000, 1_000, 3.0),
    "stopping-each": partial(stopping.stopping, 100_000, 100_000, 4.0),
    "upkeep": partial(upkeep.upkeep, (100, 10_000, 100_000), 300),
    "queries": partial(memory.memory, (10_000, 100_000)),
    "chain": partial(chain.status_chain, 100, 50),
    "priority": partial(chain.priority_chain, 50),
    "health": partial(health.health, 10_000, 3, 10.0),
    "simulating": partial(simulating.simulating, 20),
    "planning": partial(planning.planning, 500, 10_000, 1_000, 1_000),
    "exchange": partial(exchange.exchange, 50, 160_000),
    "busy": partial(busy.cpu_bound, 2_000),
    "crash": partial(supervision.crashes, 50, 1_000),
    "children": partial(supervision.children, 100, 3),
    "memory": supervision.memory,
    "import": partial(importing.importing, 20),
}
MILLION: dict[str, Scenario] = {
    "held": partial(growth.growth, (100, 10_000, 1_000_000), 1_000),
    "upkeep": partial(upkeep.upkeep, (100, 10_000, 1_000_000), 300),
    "recovery": partial(recovery.recovery, 1_000_000, 2, 3_000.0),
    "recovery-shared": partial(recovery.recovery, 1_000_000, 2, 3_000.0, 1_000),
}
QUICK: dict[str, Scenario] = {
    "warm": partial(warm.other_process, 300),
    "local": partial(warm.same_process, 300),
    "handler": partial(warm.with_a_handler, 400),
    "awaited": partial(warm.awaited, 300),
    "in-process": partial(in_process.in_process, 100),
    "first": partial(first.first_and_last, 100),
    "synced": partial(synced.first_and_last, 100),
    "ask": partial(asking.other_process, 300),
    "ask-local": partial(asking.same_process, 300),
    "large": partial(large.large, 10),
    "streaming": partial(streaming.streaming, 10, 1_000),
    "pipelined": partial(pipelined.throughput, 1_000),
    "held": partial(growth.growth, (100, 1_000), 100),
    "growth": partial(in_step.in_step, 1, 1),
    "recovery": partial(recovery.recovery, 1_000, 1, 60.0),
    "stopping": partial(stopping.stopping, 1_000, 100, None),
    "upkeep": partial(upkeep.upkeep, (100, 1_000), 50),
    "queries": partial(memory.memory, (2_000,)),
    "chain": partial(chain.status_chain, 20, 5),
    "priority": partial(chain.priority_chain, 5),
    "health": partial(health.health, 500, 1, 1.0),
    "simulating": partial(simulating.simulating, 3),
    "planning": partial(planning.planning, 30, 1_000, 20, 1_000),
    "exchange": partial(exchange.exchange, 8, 1_000),
    "busy": partial(busy.cpu_bound, 200),
    "crash": partial(supervision.crashes, 3, 100),
    "children": partial(supervision.children, 10, 1),
    "memory": supervision.memory,
    "import": partial(importing.importing, 1),
}


def main() -> None:
    """Run what was asked for and print one table."""
    parser = argparse.ArgumentParser(prog="benchmarks.run", description="Benchmarks of rr_actors.")
    parser.add_argument("--quick", action="store_true", help="few repetitions: shows that it works, not how fast")
    names = [*FULL, *(name for name in MILLION if name not in FULL)]
    parser.add_argument("--only", action="append", choices=names, metavar="NAME", help=f"one of {', '.join(names)}")
    parser.add_argument("--json", type=Path, default=Path("bench.json"), metavar="FILE", help="default: bench.json")
    parser.add_argument("--million", action="store_true", help="only what grows, up to a million held: takes minutes")
    arguments = parser.parse_args()

    rows: list[table.Row] = []
    for name, scenario in (MILLION if arguments.million else QUICK if arguments.quick else FULL).items():
        if arguments.only and name not in arguments.only:
            continue
        start = time.monotonic()
        rows += scenario()
        print(f"{name}: {time.monotonic() - start:.1f} s", file=sys.stderr)
    print("  ".join(f"{key} {value}" for key, value in table.machine().items()))
    print(table.text(rows))
    if arguments.quick:
        print("\nA few repetitions of each, to show that it works: the aims are for a whole run (make bench).")
    table.write(arguments.json, rows)


if __name__ == "__main__":
    main()
