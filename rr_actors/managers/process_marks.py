"""Which processes belong to which allocation, told by a variable in their environment. The only user of psutil.

A program gets ``RR_ALLOCATION=<resource id>.<attempt>`` and hands it on to everything it starts: what belongs to a
resource can be found by it, even when nothing else that knew of it has survived.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import psutil

VARIABLE = "RR_ALLOCATION"


def find_processes(variable: str, prefix: str = "") -> dict[int, str]:
    """Pids of the living processes whose environment has `variable`, with its value, if that starts with `prefix`.

    The environment is the one a process was started with. Those of other users are not looked into.
    """
    return {process.pid: value for process, value in _scan(variable, prefix)}


def kill_allocation(resource_id: str, timeout_s: float = 5.0) -> None:
    """SIGKILL every process of this allocation, of any attempt; return when they are gone, or the time is over."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        found = [process for process, _ in _scan(VARIABLE, f"{resource_id}.")]
        if not found:
            return
        for process in found:
            with contextlib.suppress(psutil.Error):
                process.kill()  # psutil compares the start time first: never a reused pid
        time.sleep(0.005)  # and look again, for what they started while we looked


def _scan(variable: str, prefix: str) -> Iterator[tuple[psutil.Process, str]]:
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            value = process.environ().get(variable)
            if value is not None and value.startswith(prefix) and process.status() != psutil.STATUS_ZOMBIE:
                yield process, value
