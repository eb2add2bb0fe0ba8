"""The record of a Budgets manager, on disk.

It has the capacities that were set or measured while the manager ran, and the reserves that it holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import msgspec

from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.planning.last_good import still_standing


class _Record(msgspec.Struct):
    capacities: dict[str, tuple[float, float]] = {}  # of the pool: the file's, and the one that was set in its place
    measured: dict[str, float] = {}  # the last measured capacity of the pool
    reserves: dict[str, str] = {}  # "pool/number": the id of the query that holds it


class BudgetRecord:
    """What is known after a restart beside the catalog."""

    def __init__(self, path: Path, configured: Mapping[str, float]) -> None:
        """Read the record. Forget each capacity that was set in place of another one than the configured."""
        self._record = KeptRecord(path, _Record)  # after damage the configured capacities hold, reserves start again
        standing = still_standing(self._record.now.capacities, configured)
        if standing != self._record.now.capacities:
            self._record.now.capacities = standing
            self._record.save()

    def capacity(self, pool: str, configured: float) -> float:
        """Return the capacity that was set, or else the configured one."""
        return self._record.now.capacities.get(pool, (configured, configured))[1]

    def set_capacity(self, pool: str, configured: float, capacity: float) -> None:
        """Keep a capacity that was set."""
        self._record.now.capacities[pool] = (configured, capacity)
        self._record.save()

    def measured(self, pool: str) -> float:
        """Return the capacity that was measured last; infinite: none was."""
        return self._record.now.measured.get(pool, math.inf)

    def keep_measured(self, pool: str, capacity: float) -> None:
        """Keep a capacity that was measured."""
        self._record.now.measured[pool] = capacity
        self._record.save()

    def reserves(self) -> dict[str, str]:
        """Return the query ids of the reserves that are held."""
        return dict(self._record.now.reserves)

    def keep_reserve(self, key: str, query_id: str) -> None:
        """Keep that a query holds this reserve."""
        self._record.now.reserves[key] = query_id
        self._record.save()

    def drop_reserve(self, key: str) -> None:
        """Keep that this reserve is not held."""
        if self._record.now.reserves.pop(key, None) is not None:
            self._record.save()
