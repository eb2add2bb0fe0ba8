"""The lists on the left of the terminal: each is a sheet, as lines with columns that sort them.

A list asks only for the rows that are visible.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rr_actors.tools.tables.sheets import Sheet
from rr_actors.tools.tables.table import Asks, Column, Look, Table
from rr_actors.tools.terminal.terminal_rows import LOOK_S, Hasty, Listed, Window, joined

_NAME = 26  # cells that stay for a name


@dataclass(frozen=True)
class SheetRows:
    """The tables of a sheet, for one viewer.

    Args:
        sort_by: the head of the column that sorts them; "": they stay as they are there.
    """

    sheet: Sheet
    tables: tuple[Table[Any], ...]
    sort_by: str = ""

    @property
    def _main(self) -> Table[Any]:
        """The table whose columns stand beside the lines, and sort it."""
        return next(table for table in self.tables if table.narrow)

    @property
    def title(self) -> str:
        """The sheet's title; or its name, and the column that sorts it."""
        return f"{self.sheet.name} by {self.sort_by}" if self.sort_by else self.sheet.title or self.sheet.name

    def by_next(self) -> SheetRows:
        """Return the same list, sorted by the next column."""
        sorts = ["", *self._main.sorts("top")]
        return replace(self, sort_by=sorts[(sorts.index(self.sort_by) + 1) % len(sorts)])

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the rows of a window, of one table after the other."""
        columns = _that_fit(self._main.shown_in("top"), window.width)
        look = Look(window.match, sort=self.sort_by, live=bool(columns or self.sort_by))

        def part(table: Table[Any], offset: int, limit: int) -> Listed:
            found = table.look(Hasty(link, LOOK_S), replace(look, offset=offset, limit=limit))
            beside = columns if table.shown_in("top") else []
            rows = [replace(table.line(row, bool(beside)), columns=_cells(beside, row)) for row in found.rows]
            return Listed(found.total, rows, list(found.notes))

        listed = joined(window, *(partial(part, table) for table in self.tables))
        heads = [f"▼{one.head}" if one.head == self.sort_by else one.head for one in columns]
        return replace(listed, heads="".join(f"{head:>{one.width}}" for head, one in zip(heads, columns, strict=True)))


def _cells(columns: Sequence[Column[Any]], row: Any) -> str:
    cells = ((column.cell(row), column.width) for column in columns)
    return "".join(f"{cell if len(cell) < width else f'{cell[: width - 2]}…':>{width}}" for cell, width in cells)


def _that_fit(columns: Sequence[Column[Any]], width: int) -> list[Column[Any]]:
    """Return the first columns, as many as a pane of this width has room for beside a name."""
    ends = itertools.accumulate(column.width for column in columns)
    return [column for column, end in zip(columns, ends, strict=True) if end <= width - _NAME]
