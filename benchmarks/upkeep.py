"""What a status and a fetch cost while more and more queries are held."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Sequence

import rr_actors as rr
from benchmarks.measure import Samples, time_each
from benchmarks.table import Row
from benchmarks.workload import SERVER, Ask, Echo, load_all

AIM = 1.25


def upkeep(sizes: Sequence[int], times: int) -> list[Row]:
    """At each size: from a consumer's asking for a status on its one query to its callback, and fetch_queries()."""
    rows: list[Row] = []
    base: dict[str, float] = {}
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(
            [rr.ChildSpec(Echo, id="provider", shutdown_s="brutal_kill")], name="bench", state_dir=state_dir
        ) as system,
    ):
        filler, consumer = system.open_registrar("filler"), system.open_registrar("consumer")
        heard = threading.Semaphore(0)
        query = consumer.load(SERVER, Ask(-1), on_status=lambda _status: heard.release())
        provider = system.registrar("provider")
        filled = 0

        def status() -> None:
            provider.send_status(query, rr.Status(rr.State.WARNING, "look"))
            if not heard.acquire(timeout=10.0):
                raise TimeoutError("the status was not heard within 10 s")

        operations: dict[str, Callable[[], object]] = {
            "status": status,
            "fetch": lambda: consumer.fetch_queries("provider"),
        }
        for size in sizes:
            load_all(filler, (Ask(number) for number in range(filled, size)))
            filled = size
            for what, operation in operations.items():
                time_each(operation, max(5, times // 10))
                taken = Samples(tuple(time_each(operation, times)))
                base.setdefault(what, taken.median)
                first = size == sizes[0]
                rows.append(
                    Row(
                        f"{size:,} held: {what}",
                        taken.median * 1e6,
                        "µs",
                        taken.p99 * 1e6,
                        None if first else taken.median / base[what],
                        "" if first else f"at {sizes[0]:,}",
                        at_most=None if first else AIM,
                    )
                )
    return rows
