"""From SIGKILL of the provider to its next answer."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator

import rr_actors as rr
from benchmarks.measure import Samples
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, load_all, running

_SHOWN_EVERY = 100_000
_READY_S = 10.0


def recovery(held: int, times: int, at_most_ms: float, resources: int | None = None) -> list[Row]:
    """A load sent right after the kill is answered by the respawned provider, which has all that was held.

    `resources`: that the queries are on; None: one for each.
    """
    each = held if resources is None else resources
    seconds: list[float] = []
    with running("process") as (system, consumer):
        load_all(consumer, (Ask(number % each) for number in _shown(held)))
        for _ in range(times):
            pid = _provider(system)
            start = time.perf_counter()
            os.kill(pid, signal.SIGKILL)
            query = consumer.load(SERVER, Ask(0))
            seconds.append(time.perf_counter() - start)
            query.unload()
    taken = Samples(tuple(seconds))
    what = "each of a resource of its own" if resources is None else f"of {resources:,} resources"
    return [
        Row(
            f"SIGKILL to serving again, {held:,} held, {what}",
            taken.median * 1e3,
            "ms",
            max(taken.seconds) * 1e3,
            at_most=at_most_ms,
        )
    ]


def _provider(system: rr.System) -> int:
    """The provider's process, once its supervisor knows that it is up; it may answer before that."""
    deadline = time.monotonic() + _READY_S
    while time.monotonic() < deadline:
        (child,) = system.supervisor().which_children()
        if child.pid is not None:
            return child.pid
        time.sleep(0.001)
    raise TimeoutError(f"expected the provider up within {_READY_S:g} s")


def _shown(count: int) -> Iterator[int]:
    """The numbers up to `count`; that it goes on is said on the way."""
    for number in range(count):
        if number and number % _SHOWN_EVERY == 0:
            print(f"recovery: {number:,} of {count:,} loaded", file=sys.stderr, flush=True)
        yield number
