"""The usage of an external program: of the processes below its shim, or of a control group of its own."""

from __future__ import annotations

import contextlib
import time
from typing import NamedTuple

import psutil

from rr_actors.runtime.processes.control_groups import ControlGroup, group_of, read_number

_LEAST_S = 0.5  # between two samples: a clock tick is 10 ms, so the CPU over this time is known to 2 %


class Sample(NamedTuple):
    """The CPU seconds that a program has used, at a time in seconds since boot."""

    at_s: float
    cpu_s: float


class Used(NamedTuple):
    """What a program has used, and uses."""

    cpu_s: float
    memory_bytes: int
    threads: int


class ProgramUsage:
    """The usage of one program, from its start on. One thread asks at a time.

    Args:
        shim: the pid of the program's shim, which lives, and adopts the program's orphans.
        pid: the program's.
        start_time: its start in seconds since boot.
    """

    def __init__(self, shim: int, pid: int, start_time: float) -> None:
        self._shim = shim
        self.pid = pid
        self._older = self._newer = Sample(start_time, 0.0)

    def now(self) -> dict[str, float]:
        """Return "cpu_s", "cpu", "memory_bytes" and "threads" of the program and of all that it has started.

        "cpu_s": CPU seconds, with those of processes that have ended. "cpu": how many CPUs it kept busy on average
        since an earlier call, at least half a second ago, or since its start. "memory_bytes": memory that several
        processes share counts in parts.

        Raises:
            psutil.Error: the shim has ended.
        """
        used = _of_tree(self._shim, self.pid)
        now = Sample(time.clock_gettime(time.CLOCK_BOOTTIME), used.cpu_s)
        if now.at_s - self._newer.at_s >= _LEAST_S:
            self._older, self._newer = self._newer, now
        passed_s = now.at_s - self._older.at_s
        cpu = max(0.0, now.cpu_s - self._older.cpu_s) / passed_s if passed_s > 0 else 0.0
        return {**used._asdict(), "cpu": round(cpu, 3)}


def _of_tree(shim: int, pid: int) -> Used:
    """Return what all processes below a shim have used, by /proc, or by the control group that the program has.

    The time of a process that has ended is counted by the process that reaped it: its parent, or the shim.
    """
    group = _own_group(shim, pid)
    inside = set[int]() if group is None else group.pids()
    root = psutil.Process(shim)
    reaped = root.cpu_times()
    cpu_s, memory_bytes, threads = reaped.children_user + reaped.children_system, 0, 0
    tree = root.children(recursive=True)
    for process in tree:
        with contextlib.suppress(psutil.Error):  # it has ended meanwhile
            cpu_s += sum(process.cpu_times()[:4])  # its own, and that of the children that it has reaped
            memory_bytes += process.memory_full_info().pss
            threads += process.num_threads()
    if group is not None and {process.pid for process in tree} == inside:
        # Each may miss something: the group what was before it, /proc a child that nobody has reaped.
        cpu_s = max(cpu_s, read_number(group.path / "cpu.stat", "usage_usec") / 1e6)
        memory_bytes = read_number(group.path / "memory.current") or memory_bytes
    return Used(round(cpu_s, 3), memory_bytes, threads)


def _own_group(shim: int, pid: int) -> ControlGroup | None:
    """Return the program's control group; None if that is its shim's, or there are none."""
    own = group_of(pid)
    return None if own is None or own == group_of(shim) else ControlGroup(own)
