"""Warm loads while a callback of the same process computes: Python's lock is shared, the loop is not."""

from __future__ import annotations

import tempfile
import threading
import time

import rr_actors as rr
from benchmarks.measure import Samples, time_each
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, Echo

P50_MS = 1.0
P99_MS = 15.0


class Busy(Echo):
    """An Echo with a callback that computes until it is told to stop."""

    def __init__(self) -> None:
        self._told_to_stop = threading.Event()

    @rr.server("compute")
    def compute(self, seconds: float) -> int:
        deadline = time.monotonic() + seconds
        turns = 0
        while time.monotonic() < deadline and not self._told_to_stop.is_set():
            turns += sum(number * number for number in range(1_000)) > 0
        return turns

    @rr.server("stop")
    def stop_computing(self, nonce: int) -> int:
        self._told_to_stop.set()
        return nonce


def cpu_bound(times: int, limit_s: float = 60.0) -> list[Row]:
    """One load at a time from another process, beside the same without the computing."""
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([rr.ChildSpec(Busy, id="provider")], name="bench", state_dir=state_dir) as system,
    ):
        consumer = system.open_registrar("consumer")

        def load() -> None:
            consumer.load(SERVER, Ask(0))

        time_each(load, 100)
        computing = consumer.load("provider/compute", limit_s, timeout_s=2 * limit_s, block=False)
        time_each(load, 10)
        beside = Samples(tuple(time_each(load, times)))
        consumer.load("provider/stop", 0)
        computing.get()
    return [
        Row("warm load beside a callback that computes, p50", beside.median * 1e3, "ms", at_most=P50_MS),
        Row("warm load beside a callback that computes, p99", beside.p99 * 1e3, "ms", at_most=P99_MS),
    ]
