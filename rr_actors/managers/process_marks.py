"""Find the processes of an allocation by a variable in their environment.

A program gets ``RR_ALLOCATION=<resource id>.<attempt>``, and every process that it starts inherits the variable. So
the processes of a resource can be found even when no process that knew of them has survived.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import psutil

VARIABLE = "RR_ALLOCATION"


def find_processes(variable: str, prefix: str = "") -> dict[int, str]:
    """Return the pids of the living processes whose `variable` starts with `prefix`, each with its value.

    It looks at the environment that a process was started with, and leaves out the processes of other users.
    """
    return {process.pid: value for process, value in _scan(variable, prefix)}


def kill_allocation(resource_id: str, timeout_s: float = 5.0) -> None:
    """Kill every process of this resource, of any attempt; return when they are gone, or the time is over."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        found = [process for process, _ in _scan(VARIABLE, f"{resource_id}.")]
        if not found:
            return
        for process in found:
            with contextlib.suppress(psutil.Error):
                process.kill()  # psutil compares the start time first: it never kills a reused pid
        time.sleep(0.005)  # then look again, for processes that were started meanwhile


def _scan(variable: str, prefix: str) -> Iterator[tuple[psutil.Process, str]]:
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            value = process.environ().get(variable)
            if value is not None and value.startswith(prefix) and process.status() != psutil.STATUS_ZOMBIE:
                yield process, value
