"""Batch: what one wake-up's messages change in a catalog, and cause; it can be taken back.

A Batch applies each change to memory at once, because the next message of the same wake-up must see it, and remembers
how to take all of them back: the registrar commits the batch's changes to the store before anyone can look, and undoes
the batch if that fails.
"""

from __future__ import annotations

from typing import Any

from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.rows import TABLE_OF, Change, Drop, Put, Row, Table

_ABSENT: Any = object()


class Batch:
    """What one wake-up's messages change and cause.

    `changes` must be on disk before any effect is acted upon. `later` are changes of rows that can be rebuilt from
    elsewhere, by table and id: they may reach the disk a moment after, and are written behind `changes`.
    """

    __slots__ = ("_counters", "_undo", "catalog", "changes", "effects", "later")

    def __init__(self, catalog: Catalog) -> None:
        self.catalog = catalog
        self.changes: list[Change] = []
        self.later: dict[tuple[Table, str], Change] = {}
        self.effects: list[Effect] = []
        self._undo: list[tuple[Any, Any, Any]] = []
        self._counters = (catalog.seq, catalog.closings_made)

    def put(self, row: Row) -> None:
        """Insert or replace a row, durably."""
        table = TABLE_OF[type(row)]
        self._undo.append((table, row.id, self.catalog.set(table, row.id, row)))
        self.changes.append(Put(row))
        if self.later:
            self.later.pop((table, row.id), None)  # older than this

    def drop(self, row: Row) -> None:
        """Remove a row, durably."""
        table = TABLE_OF[type(row)]
        self._undo.append((table, row.id, self.catalog.set(table, row.id, None)))
        self.changes.append(Drop(table, row.id))
        if self.later:
            self.later.pop((table, row.id), None)

    def put_later(self, row: Row) -> None:
        """Insert or replace a row that could be rebuilt."""
        table = TABLE_OF[type(row)]
        self._undo.append((table, row.id, self.catalog.set(table, row.id, row)))
        self.later[table, row.id] = Put(row)

    def drop_later(self, row: Row) -> None:
        """Remove a row that would be seen to be gone anyway."""
        table = TABLE_OF[type(row)]
        self._undo.append((table, row.id, self.catalog.set(table, row.id, None)))
        self.later[table, row.id] = Drop(table, row.id)

    def put_here(self, row: Row) -> None:
        """Insert or replace a row in memory alone: it is on disk, or would mean nothing to the next incarnation."""
        table = TABLE_OF[type(row)]
        self._undo.append((table, row.id, self.catalog.set(table, row.id, row)))

    def drop_here(self, row: Row) -> None:
        """Remove a row from memory alone: it is gone from the disk."""
        table = TABLE_OF[type(row)]
        self._undo.append((table, row.id, self.catalog.set(table, row.id, None)))

    def note(self, memory: dict[Any, Any], key: Any, value: Any) -> None:
        """Set an entry of one of the catalog's in-memory dicts."""
        self._undo.append((memory, key, memory.get(key, _ABSENT)))
        memory[key] = value

    def forget(self, memory: dict[Any, Any], key: Any) -> Any:
        """Take an entry out of one of the catalog's in-memory dicts; returns it, or None."""
        if key not in memory:
            return None
        value = memory.pop(key)
        self._undo.append((memory, key, value))
        return value

    def cause(self, effect: Effect) -> None:
        """Have this done once the changes are on disk."""
        self.effects.append(effect)

    def undo(self) -> None:
        """Take back everything: the catalog is as it was before the batch."""
        for where, key, old in reversed(self._undo):
            if isinstance(where, str):
                self.catalog.set(where, key, old)  # type: ignore[arg-type]  # a Table
            elif old is _ABSENT:
                where.pop(key, None)
            else:
                where[key] = old
        self.catalog.seq, self.catalog.closings_made = self._counters
        self._undo.clear()
        self.changes.clear()
        self.later.clear()
        self.effects.clear()
