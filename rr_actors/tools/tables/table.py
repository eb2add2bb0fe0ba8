"""Table: the one declaration of a list. The command line, `top` and the web pages draw it, and know no list by name.

A table has columns, and a source that asks the system for some of its rows, which are searched, sorted and cut where
they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Generic, Protocol, TypeVar, cast

from rr_actors.base.names import short_id
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_view import Verb

_A = TypeVar("_A")
_Row = TypeVar("_Row")
_Shown = TypeVar("_Shown", covariant=True)

STATE_STYLES = {"WARNING": "yellow", "ERROR": "red", "FATAL": "red", "revoked": "red"}
"""Rich's words for the colour of a row by its state."""


class Asks(Protocol):
    """An object that answers questions to the system: a ConsoleLink or a ConsoleConnection."""

    def ask(self, request: Verb[_A], timeout_s: float | None = None) -> _A:
        """Send a question or a command, and return its answer."""
        ...


@dataclass(frozen=True)
class Row:
    """A row as a line of `top`, or of a panel of a page.

    Attributes:
        key: the id of the thing that it shows; the cursor stays on the row of the same key.
        text, note: at the left and the right of the line.
        columns: cells of fixed widths, at the right of the note.
        style: Rich's words for its colour.
        child, registrar, resource: the thing that Enter opens; None or "" for none.
        query: the query that `unload` releases on this row.
        name: the name of the resource that Enter opens.
    """

    key: str
    text: str
    note: str = ""
    style: str = ""
    child: c.ChildRow | None = None
    registrar: str = ""
    resource: str = ""
    query: str = ""
    name: str = ""
    columns: str = ""


@dataclass(frozen=True)
class Column(Generic[_Row]):
    """A column of a table.

    Attributes:
        head, text: its head, and the text of its cell.
        width: its width in cells in `top`.
        sorts: whether the source sorts by it, the most first.
        right: whether it has numbers.
        gives_way: whether a narrow terminal shortens its cells in the middle.
        is_id: whether its texts are ids, which are shown by their ends.
        views: those that have it.
    """

    head: str
    text: Callable[[_Row], str]
    width: int = 10
    sorts: bool = False
    right: bool = False
    gives_way: bool = False
    is_id: bool = False
    views: str = "verb top page"

    def cell(self, row: _Row) -> str:
        """Return the text of its cell in a list of which only a part is known."""
        return short_id(self.text(row)) if self.is_id else self.text(row)


@dataclass(frozen=True)
class Look:
    """The rows that a viewer asks for: `limit` rows from number `offset` on, of those that contain `match`.

    Attributes:
        sort: the head of the column that sorts them; "": as they are there.
        registrar, states, holder: only rows of this registrar, in one of these states, held by this registrar.
        live: whether the figures are wanted that only `top` has.
        parts: whether each manager's parts are wanted below it: its registrar, and the servers of that.
    """

    match: str = ""
    offset: int = 0
    limit: int = c.PAGE_LIMIT
    sort: str = ""
    registrar: str = ""
    states: tuple[str, ...] = ()
    holder: str = ""
    live: bool = False
    parts: bool = False

    def cut(self, rows: Sequence[_Row]) -> Rows[_Row]:
        """Return the part that is asked for, of all rows."""
        return Rows(len(rows), rows[self.offset : self.offset + self.limit])


class Part(Protocol[_Shown]):
    """Some rows of a table, how many there are in all, and notes on registrars that could not be asked."""

    @property
    def total(self) -> int: ...

    @property
    def rows(self) -> Sequence[_Shown]: ...

    @property
    def notes(self) -> Sequence[str]: ...


@dataclass(frozen=True)
class Rows(Generic[_Row]):
    """A part of a table that a source has made."""

    total: int
    rows: Sequence[_Row]
    notes: Sequence[str] = ()


def _none(_row: object) -> tuple[()]:
    return ()


def _itself(row: Any) -> Any:
    return row


@dataclass(frozen=True)
class Table(Generic[_Row]):
    """A list.

    Attributes:
        name: what its rows are, in one word.
        columns: in the order in which a wide view has them.
        source: asks the system for rows.
        line: returns a row as a line; its second argument is whether columns stand beside it.
        narrow: the heads of the columns that stand beside the lines of `top`: the first ones, as many as have room.
        nothing: what is said if there are no rows.
        caption: returns what stands above it on a page, for so many rows.
        named: returns the name of a row that commands take.
        facts: returns a row for programs.
        below: returns the rows that stand below a row where all are read at once, and do not count.
        page_sort: the head of the column that sorts it on a page, until the reader chooses another one.
    """

    name: str
    columns: tuple[Column[_Row], ...]
    source: Callable[[Asks, Look], Part[_Row]]
    line: Callable[[_Row, bool], Row]
    narrow: tuple[str, ...] = ()
    nothing: str = ""
    caption: Callable[[int], str] = str
    named: Callable[[_Row], str] = str
    facts: Callable[[_Row], Any] = _itself
    below: Callable[[_Row], Sequence[_Row]] = _none
    page_sort: str = ""

    def shown_in(self, view: str) -> list[Column[_Row]]:
        """Return the columns that a view has: "verb", "page", or "top" beside its lines."""
        columns = [column for column in self.columns if view in column.views]
        if view == "top":
            return sorted(
                (one for one in columns if one.head in self.narrow), key=lambda one: self.narrow.index(one.head)
            )
        return columns

    def sorts(self, view: str) -> list[str]:
        """Return the heads of the columns that sort it in a view."""
        return [column.head for column in self.shown_in(view) if column.sorts]

    def look(self, asks: Asks, look: Look) -> Part[_Row]:
        """Ask the system for rows; they stay as they are there if no column of this table sorts them.

        Raises:
            RrError: the system did not answer, or refused the question.
        """
        sorts = any(column.sorts and column.head == look.sort for column in self.columns)
        return self.source(asks, look if sorts else replace(look, sort=""))

    def read(self, asks: Asks, look: Look, limit: int) -> Rows[_Row]:
        """Ask for one part after another, until there are `limit` rows or no more."""
        rows, notes, count = list[_Row](), dict[str, None](), 0
        while True:
            part = self.look(asks, replace(look, offset=count, limit=min(limit - count, c.PAGE_LIMIT)))
            count += len(part.rows)
            rows += [shown for row in part.rows for shown in (row, *self.below(row))]
            notes |= dict.fromkeys(part.notes)
            if not part.rows or count >= min(part.total, limit):
                return Rows(part.total + len(rows) - count, rows, list(notes))


def tables_of(module: ModuleType) -> tuple[Table[Any], ...]:
    """Return the tables of a sheet's module, for one viewer. One of them has columns beside its lines in `top`."""
    return cast("tuple[Table[Any], ...]", module.tables())
