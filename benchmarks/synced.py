"""Durability "power": a first load and the unload of the last holder, beside one fdatasync of as many bytes."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from benchmarks.first import measured
from benchmarks.measure import Samples
from benchmarks.table import Row
from benchmarks.workload import PAYLOAD, running

AT_MOST = 3.0
RECORD = PAYLOAD + PAYLOAD + bytes(200)  # of a first load: the request, the response, and who has it
PROCESSES = 3


def first_and_last(times: int) -> list[Row]:
    """One at a time, in turns with the fdatasync, on the disk of the state directory."""
    synced, taken = Samples(()), dict[str, Samples]()
    for _ in range(PROCESSES):
        with fdatasync() as append, running("power") as (_, consumer):
            one_synced, one = measured(append, consumer, times // PROCESSES)
        synced += one_synced
        taken = {what: taken.get(what, Samples(())) + samples for what, samples in one.items()}
    rows = [Row(f"append of {len(RECORD)} bytes and fdatasync", synced.median * 1e6, "µs", synced.p99 * 1e6)]
    for what, samples in taken.items():
        ratio = samples.median / synced.median
        name = f"{what}, beside one fdatasync"
        rows.append(Row(name, samples.median * 1e6, "µs", samples.p99 * 1e6, ratio, "fdatasync", at_most=AT_MOST))
    return rows


@contextmanager
def fdatasync() -> Iterator[Callable[[], object]]:
    """A call that appends RECORD to a file, and waits until the disk has it."""
    with tempfile.TemporaryFile(prefix="rr-bench-", buffering=0) as file:
        fd = file.fileno()

        def append() -> None:
            os.write(fd, RECORD)
            os.fdatasync(fd)

        yield append
