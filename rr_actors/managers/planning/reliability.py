"""Reliability: how far the manager trusts each component, on disk.

It survives a restart of the manager, because a restart does not repair a device. Each failure halves it. Each hour
without another failure doubles it, up to the value of the registry: what has been repaired is found so by being used.
Delete the file to begin again with the registry's values.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec

from rr_actors.managers.planning.kept_record import KeptRecord

FALL = 0.5  # a failure halves it
RISE_S = 3600.0  # so long without a failure doubles it
LEAST = FALL**10  # times the registry's value: a night of failures is forgotten within ten hours
_COUNTED_LIMIT = 100


class _Record(msgspec.Struct):
    reliability: dict[str, Annotated[float, msgspec.Meta(ge=0, le=1)]] = {}
    counted: list[str] = []
    failed_at: dict[str, float] = {}


def risen(value: float, initial: float, well_s: float) -> float:
    """Return the reliability that was `value` after the last failure, `well_s` seconds ago."""
    hours = max(0, min(int(well_s // RISE_S), 1000))
    return min(initial, max(value, initial * LEAST) / FALL**hours)


class Reliabilities:
    """The present reliability of components by name; the file has only those that have failed. From any thread."""

    def __init__(self, path: Path, now: Callable[[], float] = time.time) -> None:
        self._record = KeptRecord(path, _Record)  # a damaged file costs only the memory of failures
        self._now = now
        self._lock = threading.Lock()

    def of(self, name: str, initial: float) -> float:
        """Return how far the component is trusted now, from 0 to 1."""
        with self._lock:
            return self._of(name, initial)

    def lower(self, name: str, initial: float, failure_id: str) -> float:
        """Halve a component's reliability for a failure, and return it. The same failure counts once."""
        with self._lock:
            record = self._record.now
            if failure_id not in record.counted:
                record.counted = [*record.counted, failure_id][-_COUNTED_LIMIT:]
                record.reliability[name] = max(self._of(name, initial) * FALL, initial * LEAST)
                record.failed_at[name] = self._now()
                self._record.save()
            return self._of(name, initial)

    def _of(self, name: str, initial: float) -> float:
        record = self._record.now
        if name not in record.reliability:
            return initial
        return risen(record.reliability[name], initial, self._now() - record.failed_at.get(name, self._now()))
