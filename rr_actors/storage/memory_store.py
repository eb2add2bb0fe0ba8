"""MemoryStore: a catalog in memory, for durability "none"."""

from __future__ import annotations

from collections.abc import Sequence

from rr_actors.registrar.model.rows import Change, Content, apply, content_of


class MemoryStore:
    """A Store (store.py) of a catalog in memory, which is lost with this object."""

    def __init__(self) -> None:
        self.epoch = 1
        self._content: Content = content_of(())

    def load(self) -> Content:
        return {table: dict(rows) for table, rows in self._content.items()}

    def commit(self, changes: Sequence[Change]) -> None:
        apply(self._content, changes)

    def wants_tidying(self) -> bool:
        return False

    def tidy(self) -> None:
        """Do nothing."""

    def close(self, *, erase: bool = False) -> None:
        """Do nothing."""
