"""Batch: what some messages change in a catalog, and cause. It can be undone.

A Batch applies each change to memory at once, because the next message of the batch must see it. It notes how to undo
a change before it makes it. The registrar commits the batch while it still has the lock, and undoes it if that fails.

An interrupt (Ctrl-C) may come between any two instructions. What is noted then stays in `Catalog.unfinished`, and
whoever has the lock next rolls it back (Catalog.roll_back).
"""

from __future__ import annotations

from typing import Any

from rr_actors.registrar.model.catalog import ABSENT, Catalog, Undo
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.rows import TABLE_OF, Change, Drop, Put, Row, Table


class Batch:
    """What some messages change and cause. After close() or undo() it is over.

    `changes` must be on disk before any effect is acted upon. `later` are changes of rows that can be rebuilt from
    elsewhere, by table and id: they may reach the disk a moment after, and are written behind `changes`.
    """

    __slots__ = ("_counters", "_undo", "catalog", "changes", "effects", "later")

    def __init__(self, catalog: Catalog) -> None:
        self.catalog = catalog
        self.changes: list[Change] = []
        self.later: dict[tuple[Table, str], Change] = {}
        self.effects: list[Effect] = []
        self._undo: Undo = []
        self._counters = (catalog.seq, catalog.closings_made)
        catalog.unfinished = self._undo

    def put(self, row: Row) -> None:
        """Insert or replace a row, durably."""
        table, id, catalog = TABLE_OF[type(row)], row.id, self.catalog
        self._undo.append((table, id, catalog.tables[table].get(id, ABSENT)))
        catalog.set(table, id, row)
        self.changes.append(Put(row))
        if self.later:
            self.later.pop((table, row.id), None)  # older than this

    def drop(self, row: Row) -> None:
        """Remove a row, durably."""
        table = TABLE_OF[type(row)]
        self._set(table, row.id, None)
        self.changes.append(Drop(table, row.id))
        if self.later:
            self.later.pop((table, row.id), None)

    def put_later(self, row: Row) -> None:
        """Insert or replace a row that could be rebuilt."""
        table = TABLE_OF[type(row)]
        self._set(table, row.id, row)
        self.later[table, row.id] = Put(row)

    def drop_later(self, row: Row) -> None:
        """Remove a row that would be seen to be gone anyway."""
        table = TABLE_OF[type(row)]
        self._set(table, row.id, None)
        self.later[table, row.id] = Drop(table, row.id)

    def put_here(self, row: Row) -> None:
        """Insert or replace a row in memory alone: it is on disk, or would mean nothing to the next incarnation."""
        table = TABLE_OF[type(row)]
        self._set(table, row.id, row)

    def _set(self, table: Table, id: str, row: Row | None) -> None:
        self._undo.append((table, id, self.catalog.tables[table].get(id, ABSENT)))
        self.catalog.set(table, id, row)

    def note(self, memory: dict[Any, Any], key: Any, value: Any) -> None:
        """Set an entry of one of the catalog's in-memory dicts."""
        self._undo.append((memory, key, memory.get(key, ABSENT)))
        memory[key] = value

    def forget(self, memory: dict[Any, Any], key: Any) -> Any:
        """Take an entry out of one of the catalog's in-memory dicts; returns it, or None."""
        if key not in memory:
            return None
        self._undo.append((memory, key, memory[key]))
        return memory.pop(key)

    def cause(self, effect: Effect) -> None:
        """Have this done once the changes are on disk."""
        self.effects.append(effect)

    def close(self) -> None:
        """The changes are on disk, or wait to be written: they stay."""
        self.catalog.unfinished = None

    def undo(self) -> None:
        """Take back everything: the catalog is as it was before the batch.

        Only what was applied completely: after an interrupt it is Catalog.roll_back() that does it.
        """
        for where, key, old in reversed(self._undo):
            if isinstance(where, str):
                self.catalog.set(where, key, None if old is ABSENT else old)
            elif old is ABSENT:
                where.pop(key, None)
            else:
                where[key] = old
        self.catalog.seq, self.catalog.closings_made = self._counters
        self.catalog.unfinished = None
        self._undo = []
        self.changes.clear()
        self.later.clear()
        self.effects.clear()
