"""Which cores the two sides of a round trip run on.

To wake a thread on a core that sleeps takes a few microseconds on some machines, and twenty or more on virtual ones. So
a round trip costs several times as much if the kernel happens to have put its two sides on two cores; and it does not
do the same with everything that is compared: both ends of a raw pipe it keeps on one. Hence like is set beside like.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ONE_CORE = "on one core"
TWO_CORES = "on two cores"
AS_IT_COMES = "as the kernel places them"


def placements() -> list[str]:
    """Those that this machine can do."""
    if sys.platform != "linux":
        return [AS_IT_COMES]
    cores = len(os.sched_getaffinity(0))
    return [ONE_CORE, TWO_CORES, AS_IT_COMES] if cores > 1 else [ONE_CORE]


@contextmanager
def here(placement: str) -> Iterator[None]:
    """What this process starts inside runs on its first core, unless it is left to the kernel."""
    if placement == AS_IT_COMES or sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def part(placement: str) -> None:
    """With two cores, move the processes that this one has started to another."""
    if placement != TWO_CORES or sys.platform != "linux":
        return
    (mine,) = os.sched_getaffinity(0)
    other = next(core for core in range(os.cpu_count() or 1) if core != mine)
    for process in _descendants(os.getpid()):
        for task in Path(f"/proc/{process}/task").iterdir():
            os.sched_setaffinity(int(task.name), {other})


def _descendants(of: int) -> list[int]:
    children: dict[int, list[int]] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            continue
        children.setdefault(int(fields[1]), []).append(int(status.parent.name))
    found = children.get(of, []).copy()
    for process in found:  # which grows
        found += children.get(process, [])
    return found
