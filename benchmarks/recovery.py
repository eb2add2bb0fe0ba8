"""From SIGKILL of the provider to its next answer."""

from __future__ import annotations

import os
import signal
import time

from benchmarks.measure import Samples
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, load_all, running


def recovery(held: int, times: int, at_most_ms: float | None) -> list[Row]:
    """A load sent right after the kill is answered by the respawned provider, which has all that was held."""
    seconds: list[float] = []
    with running("process") as (system, consumer):
        load_all(consumer, (Ask(number) for number in range(held)))
        for _ in range(times):
            (child,) = system.supervisor().which_children()
            assert child.pid is not None
            start = time.perf_counter()
            os.kill(child.pid, signal.SIGKILL)
            query = consumer.load(SERVER, Ask(0))
            seconds.append(time.perf_counter() - start)
            query.unload()
    taken = Samples(tuple(seconds))
    return [
        Row(
            f"SIGKILL to serving again, {held:,} held",
            taken.median * 1e3,
            "ms",
            max(taken.seconds) * 1e3,
            at_most=at_most_ms,
        )
    ]
