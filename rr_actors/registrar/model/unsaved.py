"""Unsaved: changes that are in memory, and are written with the next commit, or a moment later."""

from __future__ import annotations

from collections.abc import Iterable

from rr_actors.registrar.model.rows import TABLE_OF, Change, Drop, Held, Put, Row, Table

Key = tuple[Table, str]


class Unsaved:
    """The last change of each row that waits to be written, by table and id.

    What was never written need not be owed on disk: after a crash nobody here knows of it, and its provider says
    whether it is held. So a query that its holder lets go within that time leaves nothing in the catalog. "Never
    written" is more than "waits to be written": a row that waits may be newer than one on disk.

    Attributes:
        some: the changes that wait, by table and id.
        new: the ids of held queries of which no commit has written anything.
    """

    __slots__ = ("new", "some")

    def __init__(self) -> None:
        self.some: dict[Key, Change] = {}
        self.new: set[str] = set()

    def add(self, changes: Iterable[Change]) -> None:
        """These wait, in place of older ones of the same rows."""
        for change in changes:
            self.some[key_of(change)] = change

    def written(self, changes: Iterable[Change]) -> None:
        """These have been written; what waits of the same rows is older."""
        for change in changes:
            table, id = key_of(change)
            self.some.pop((table, id), None)
            if table == "held":
                self.new.discard(id)

    def row_written(self, row: Row) -> None:
        """As written(), of one row."""
        if self.some or self.new:
            self.some.pop((TABLE_OF[type(row)], row.id), None)
            self.new.discard(row.id)

    def all_written(self) -> None:
        """Nothing waits any more."""
        if self.new:
            self.new.difference_update(id for table, id in self.some if table == "held")
        self.some.clear()

    def forget(self) -> None:
        """What waits is never written."""
        self.some.clear()
        self.new.clear()

    # -- queries of the registrar's own ------------------------------------------------------------------------------

    def hold(self, row: Held) -> None:
        """A query that is held, and of which nothing is on disk, waits to be written."""
        self.new.add(row.id)
        self.some["held", row.id] = Put(row)

    def owe(self, query_id: str) -> None:
        """A query that is new is let go: it is not written any more, unless something else becomes of it."""
        self.some.pop(("held", query_id), None)

    def drop(self, query_id: str) -> None:
        """A query is gone."""
        if query_id in self.new:
            self.some.pop(("held", query_id), None)
            self.new.discard(query_id)
        else:
            self.some["held", query_id] = Drop("held", query_id)


def key_of(change: Change) -> Key:
    """The table and the id of the row that a change is of."""
    if isinstance(change, Put):
        return TABLE_OF[type(change.row)], change.row.id
    return change.table, change.id
