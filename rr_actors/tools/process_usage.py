"""Process usage: the CPU time and memory that a process has used, as /proc reports them."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Usage(msgspec.Struct, frozen=True):
    """The usage of one process: the part of one CPU since its start, in percent, and its resident memory."""

    cpu_percent: float
    memory_bytes: int


def usage_of(pid: int) -> Usage | None:
    """Return a process's usage; None if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        up_s = float(Path("/proc/uptime").read_text().split()[0])
    except (OSError, IndexError):
        return None
    used_s = (int(fields[11]) + int(fields[12])) / _TICKS
    lived_s = max(up_s - int(fields[19]) / _TICKS, 1 / _TICKS)
    return Usage(round(100 * used_s / lived_s, 1), pages * _PAGE_BYTES)
