"""MemoryStore: a catalog in memory, for durability "none" and for simulations; a MemoryDisk may outlive its stores."""

from __future__ import annotations

import os
from collections.abc import Sequence

from rr_actors.base.errors import CatalogLocked
from rr_actors.registrar.model.rows import Change, Content, apply, content_of


class MemoryDisk:
    """What stays of a MemoryStore when it is closed or its simulated process is killed."""

    def __init__(self) -> None:
        self.tables: Content = content_of(())
        self.epoch = 0
        self.holder: MemoryStore | None = None


class MemoryStore:
    """A Store (store.py) over a MemoryDisk: its own, gone with it, or one that is passed from store to store.

    Raises:
        CatalogLocked: another store has the disk open.
    """

    def __init__(self, disk: MemoryDisk | None = None) -> None:
        self._disk = MemoryDisk() if disk is None else disk
        if self._disk.holder is not None:
            raise CatalogLocked(
                f"catalog in memory: expected it closed, got one that this process (pid {os.getpid()}) has open;"
                " close that store first",
                path=":memory:",
                pid=os.getpid(),
            )
        self._disk.holder = self
        self._disk.epoch += 1
        self.epoch = self._disk.epoch

    def load(self) -> Content:
        return {table: dict(rows) for table, rows in self._disk.tables.items()}

    def commit(self, changes: Sequence[Change]) -> None:
        apply(self._disk.tables, changes)

    def wants_tidying(self) -> bool:
        return False

    def tidy(self) -> None:
        """Nothing to do."""

    def close(self, *, erase: bool = False) -> None:
        """Let the disk be opened again; with `erase`, empty it."""
        if erase:
            for rows in self._disk.tables.values():
                rows.clear()
            self._disk.epoch = 0
        self.kill()

    def kill(self) -> None:
        """Leave the disk as a killed process would: what was committed stays."""
        self._disk.holder = None
