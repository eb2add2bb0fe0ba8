"""Reliability: how far the manager trusts each component, on disk.

It survives a restart of the manager, because a restart does not repair a device. Delete the file to begin again with
the registry's values.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec

from rr_actors.base.folder import Folder, make_directories

FALL = 0.5  # a failure halves it
_COUNTED_LIMIT = 100


class _Record(msgspec.Struct):
    reliability: dict[str, Annotated[float, msgspec.Meta(ge=0, le=1)]] = {}
    counted: list[str] = []


class Reliabilities:
    """The present reliability of components by name; the file has only those that have failed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with Folder.at(path.parent) as folder:
                self._record = msgspec.json.decode(folder.read(path.name), type=_Record)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            # There is no file yet; a damaged one costs only the memory of failures.
            self._record = _Record()

    def of(self, name: str, initial: float) -> float:
        """Return how far the component is trusted now, from 0 to 1."""
        return self._record.reliability.get(name, initial)

    def lower(self, name: str, initial: float, failure_id: str) -> float:
        """Halve a component's reliability for a failure, and return it. The same failure counts once."""
        if failure_id not in self._record.counted:
            self._record.counted = [*self._record.counted, failure_id][-_COUNTED_LIMIT:]
            self._record.reliability[name] = self.of(name, initial) * FALL
            self._save()
        return self.of(name, initial)

    def _save(self) -> None:
        make_directories(self._path.parent)
        with Folder.at(self._path.parent) as folder:
            folder.write(self._path.name, msgspec.json.format(msgspec.json.encode(self._record)))
