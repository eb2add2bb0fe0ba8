"""An orderly stop of a system that holds much: everything is let go of, and unloaded."""

from __future__ import annotations

import time

from benchmarks.table import Row
from benchmarks.workload import Ask, load_all, running


def stopping(held: int, resources: int, at_most_s: float | None) -> list[Row]:
    """How long System.stop() takes when a registrar of this process holds so many queries on so many resources."""
    with running("process") as (system, consumer):
        load_all(consumer, (Ask(number % resources) for number in range(held)))
        start = time.perf_counter()
        system.stop(timeout_s=600.0)
        taken = time.perf_counter() - start
    return [Row(f"stop with {held:,} held, of {resources:,} resources", taken, "s", at_most=at_most_s)]
