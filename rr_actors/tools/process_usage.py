"""Process usage: the CPU time and memory that a process has used, as /proc reports them."""

from __future__ import annotations

import os
import time
from collections import deque
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.system.console.console_messages import ChildRow

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Usage(msgspec.Struct, frozen=True):
    """The usage of one process: the part of one CPU since its start, in percent, and its resident memory."""

    cpu_percent: float
    memory_bytes: int


def usage_of(pid: int) -> Usage | None:
    """Return a process's usage; None if it is gone."""
    if (read := _read(pid)) is None:
        return None
    used_s, lived_s, memory_bytes = read
    return Usage(round(100 * used_s / lived_s, 1), memory_bytes)


def facts_of(row: ChildRow) -> dict[str, Any]:
    """Return a child for programs, with the usage of its process since its start."""
    usage = None if row.pid is None else usage_of(row.pid)
    used = {"cpu_percent": None, "memory_bytes": None} if usage is None else msgspec.to_builtins(usage)
    return {name: getattr(row, name) for name in row.__struct_fields__} | used


def _read(pid: int) -> tuple[float, float, int] | None:
    """Return the seconds of CPU time that a process has used, the seconds that it has lived, and its memory."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        up_s = float(Path("/proc/uptime").read_text().split()[0])
    except (OSError, IndexError):
        return None
    used_s = (int(fields[11]) + int(fields[12])) / _TICKS
    return used_s, max(up_s - int(fields[19]) / _TICKS, 1 / _TICKS), pages * _PAGE_BYTES


_LEAST_S = 0.4  # between two looks of which the difference counts: CPU time comes in ticks of 10 ms
_BUCKET_S = 15.0
BUCKETS = 20
"""Points of a curve, each for 15 s."""
_BARS = "▁▂▃▄▅▆▇█"
_LEAST_PERCENT = 10.0  # the height of a curve: a process that sleeps makes no mountains
_KEPT = 5000  # processes


class _Watched:
    """A process that was looked at: when, the CPU time until then, and the most CPU in each bucket of time."""

    def __init__(self, used_s: float, percent: float) -> None:
        self.at, self.used_s, self.percent = time.monotonic(), used_s, percent
        self.peaks = deque[tuple[int, float]](maxlen=BUCKETS)

    def see(self, used_s: float) -> None:
        """Take a new look, if the last one is old enough."""
        if (past_s := time.monotonic() - self.at) > _LEAST_S:
            self.percent = 100 * (used_s - self.used_s) / past_s
            self.at, self.used_s = time.monotonic(), used_s
        bucket = int(self.at // _BUCKET_S)
        peak = self.peaks.pop()[1] if self.peaks and self.peaks[-1][0] == bucket else 0.0
        self.peaks.append((bucket, max(peak, self.percent)))


class RateWatch:
    """How fast counts grow, from one look to the next. For one thread at a time."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[float, int, float | None]] = {}  # by name: when, the count, the rate until then

    def look(self, name: str, count: int) -> float | None:
        """Return by how much a count grew in a second since the last look; None at the first look at it."""
        now = time.monotonic()
        at, before, rate = self._seen.pop(name, (now, count, None))
        if count < before:  # it began anew
            at, before, rate = now, count, None
        if now - at > _LEAST_S:
            at, before, rate = now, count, (count - before) / (now - at)
        self._seen[name] = at, before, rate
        while len(self._seen) > _KEPT:
            del self._seen[next(iter(self._seen))]
        return rate


class UsageWatch:
    """The usage of processes between two looks, and its course over the last five minutes. For one thread at a time."""

    def __init__(self) -> None:
        self._watched: dict[int, _Watched] = {}

    def look(self, pid: int) -> Usage | None:
        """Return a process's memory, and its CPU since the last look; at the first look, since its start.

        None if it is gone.
        """
        if (read := _read(pid)) is None:
            self._watched.pop(pid, None)
            return None
        used_s, lived_s, memory_bytes = read
        watched = self._watched.pop(pid, None)
        if watched is None or used_s < watched.used_s:  # another process has the number now
            watched = _Watched(used_s, 100 * used_s / lived_s)
        self._watched[pid] = watched
        watched.see(used_s)
        while len(self._watched) > _KEPT:
            del self._watched[next(iter(self._watched))]
        return Usage(round(watched.percent, 1), memory_bytes)

    def curve(self, pid: int) -> str:
        """Return the CPU of the last five minutes as bars, the newest last; a space where nobody looked.

        The highest bar is the most of this process, or 10 % of a core if that is more.
        """
        if (watched := self._watched.get(pid)) is None:
            return ""
        now = int(time.monotonic() // _BUCKET_S)
        peaks = dict(watched.peaks)
        most = max(_LEAST_PERCENT, *peaks.values())
        heights = [peaks.get(bucket) for bucket in range(now - BUCKETS + 1, now + 1)]
        return "".join(
            " " if peak is None else _BARS[min(int(peak / most * len(_BARS)), len(_BARS) - 1)] for peak in heights
        )
