"""Reliability: how far the manager trusts each component, on disk.

It survives a restart of the manager, because a restart does not repair a device. Delete the file to begin again with
the registry's values.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from rr_actors.managers.planning.kept_record import KeptRecord

FALL = 0.5  # a failure halves it
_COUNTED_LIMIT = 100


class _Record(msgspec.Struct):
    reliability: dict[str, Annotated[float, msgspec.Meta(ge=0, le=1)]] = {}
    counted: list[str] = []


class Reliabilities:
    """The present reliability of components by name; the file has only those that have failed."""

    def __init__(self, path: Path) -> None:
        self._record = KeptRecord(path, _Record)  # a damaged file costs only the memory of failures

    def of(self, name: str, initial: float) -> float:
        """Return how far the component is trusted now, from 0 to 1."""
        return self._record.now.reliability.get(name, initial)

    def lower(self, name: str, initial: float, failure_id: str) -> float:
        """Halve a component's reliability for a failure, and return it. The same failure counts once."""
        record = self._record.now
        if failure_id not in record.counted:
            record.counted = [*record.counted, failure_id][-_COUNTED_LIMIT:]
            record.reliability[name] = self.of(name, initial) * FALL
            self._record.save()
        return self.of(name, initial)
