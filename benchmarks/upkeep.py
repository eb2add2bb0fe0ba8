"""What a status and a fetch cost while more and more queries are held, beside a system that does not grow."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import rr_actors as rr
from benchmarks.bystander import ROUNDS, Measured, beside, compared
from benchmarks.measure import time_each
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, Echo, load_all


def upkeep(sizes: Sequence[int], times: int) -> list[Row]:
    """At each size: from a consumer's asking for a status on its one query to its callback, and fetch_queries()."""
    rows: list[Row] = []
    a_round = times // ROUNDS
    with beside(_growing, a_round, sizes[0]) as ((fill, measure), small):
        for size in sizes:
            fill(size)
            rows += compared(size, sizes[0], measure, small)
    return rows


@contextmanager
def _growing(times: int) -> Iterator[tuple[Callable[[int], None], Callable[[], Measured]]]:
    spec = rr.ChildSpec(Echo, id="provider", shutdown_s="brutal_kill")
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([spec], name="bench", state_dir=state_dir) as system,
    ):
        filler, consumer = system.open_registrar("filler"), system.open_registrar("consumer")
        heard = threading.Semaphore(0)
        query = consumer.load(SERVER, Ask(-1), on_status=lambda _status: heard.release())
        provider = system.registrar("provider")

        filled = 0

        def fill(size: int) -> None:
            nonlocal filled
            load_all(filler, (Ask(number) for number in range(filled, size)))
            filled = size
            for registrar in (filler, provider):
                registrar.save_catalog()  # what is measured then is what many held cost, not their coming

        def status() -> None:
            provider.send_status(query, rr.Status(rr.State.WARNING, "look"))
            if not heard.acquire(timeout=10.0):
                raise TimeoutError("the status was not heard within 10 s")

        operations: dict[str, Callable[[], object]] = {
            "status": status,
            "fetch": lambda: consumer.fetch_queries("provider"),
        }

        def measure() -> Measured:
            taken: Measured = {}
            for what, operation in operations.items():
                time_each(operation, max(5, times // 10))
                taken[what] = time_each(operation, times)
            return taken

        yield fill, measure
