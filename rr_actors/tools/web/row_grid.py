"""A table as a grid. The browser asks for the rows that it shows, and the system searches and sorts them."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import Any, cast

from nicegui import app, ui
from nicegui.events import GenericEventArguments

from rr_actors.base.errors import RrError
from rr_actors.base.names import short_ids
from rr_actors.system.console import console_messages as c
from rr_actors.tools.tables.table import Look, Table
from rr_actors.tools.terminal.terminal_rows import Hasty
from rr_actors.tools.web.frame.page_addresses import Address
from rr_actors.tools.web.page_parts import Page
from rr_actors.tools.web.watch import Watch

_BLOCK = 100  # rows that are asked for at once
_REFRESH_S = 1.0
_LOOK_S = 20.0
_NAME_FLEX = 5.0  # of the first column, where others have a tenth of their width in a terminal
_NAME_PX = 320  # a narrower cell would show the same beginning of all names of a server; a narrow table is scrolled
_SIGNS = """({
  "rr-row-bad": (row) => row.data && ["ERROR", "FATAL"].includes(row.data.state),
  "rr-row-warm": (row) => row.data && row.data.state === "WARNING",
})"""
_SORTED = "() => emit(getElement(GRID).api.getColumnState().find((one) => one.sort)?.colId || '')"
_SOURCE = """{
  getRows: (wanted) => {
    const match = encodeURIComponent(window.rrMatch || ""), sort = encodeURIComponent(wanted.sortModel[0]?.colId || "");
    const part = `offset=${wanted.startRow}&limit=${wanted.endRow - wanted.startRow}`;
    fetch(`${window.path_prefix}/rows/NAME?match=${match}&sort=${sort}&${part}`)
      .then((answer) => answer.json())
      .then((page) => wanted.successCallback(page.rows, page.total))
      .catch(() => wanted.failCallback());
  },
}"""


class Grid:
    """A table with a search field; a click on a column's head sorts it. Its search and its order are in the address.

    Args:
        table: the table; add_rows() has added its rows to the server.
        search: the label of the search field.
        sort: the head of the column that sorts it until its reader chooses another one.
        page: the page, which shows in its drawer the resource of the row that was clicked, or chosen with a key.
    """

    def __init__(self, table: Table[Any], search: str, page: Page, sort: str) -> None:
        self._table = table
        self._refreshed = time.monotonic()
        self._page, self._sort = page, sort
        self._grid: ui.aggrid | None = None
        self._field = ui.input(search, value=page.address.match, on_change=lambda event: self._find(event.value))
        self._field.props("dense outlined clearable debounce=200").classes("w-full")
        self._say_match(page.address.match)
        self._place = ui.element("div").classes("w-full").style("height: max(292px, 42vh)")

    def fill(self) -> None:
        """Add the table itself, which asks for its first rows. Its library takes a while to load."""
        sort = self._page.address.sort or self._sort
        columns = [
            {
                "field": column.head,
                "headerName": column.head,
                "sortable": column.sorts,
                "initialSort": "desc" if column.head == sort else None,
                "flex": column.width / 10 if place else _NAME_FLEX,
                "minWidth": 80 + 2.5 * column.width if place else _NAME_PX,
                "tooltipField": column.head,
            }
            for place, column in enumerate(self._table.shown_in("page"))
        ]
        options: dict[str, Any] = {
            "columnDefs": columns,
            "defaultColDef": {"sortingOrder": ["desc", None], "resizable": True},
            "rowHeight": 32,
            "headerHeight": 32,
            ":tabToNextCell": "() => false",
            ":onCellKeyDown": "(cell) => { if (cell.event.key === 'Enter') cell.node.setSelected(true); }",
            "rowModelType": "infinite",
            "cacheBlockSize": _BLOCK,
            "maxBlocksInCache": 4,
            "rowSelection": {"mode": "singleRow", "checkboxes": False, "enableClickSelection": True},
            ":getRowId": "(row) => row.data.key",
            ":rowClassRules": _SIGNS,
            ":datasource": _SOURCE.replace("NAME", self._table.name),
        }
        with self._place:
            self._grid = grid = ui.aggrid(options, auto_size_columns=False).classes("w-full").style("height: 100%")

        async def selected() -> None:  # the event does not say which row is chosen
            answer = grid.run_grid_method("getSelectedRows", timeout=_LOOK_S)
            if rows := cast("list[dict[str, Any]]", await answer):
                await self._page.choose("resource", rows[0]["key"])

        grid.on("selectionChanged", selected, args=[])
        grid.on("sortChanged", self._sorted, js_handler=_SORTED.replace("GRID", str(grid.id)))

    def refresh(self) -> None:
        """Make the browser ask again for the rows that it shows, at most once a second."""
        if self._grid is not None and time.monotonic() > self._refreshed + _REFRESH_S:
            self._refreshed = time.monotonic()
            self._grid.run_grid_method("refreshInfiniteCache")

    def follow(self, address: Address) -> None:
        """Search and sort as an address says, to which the browser has gone back."""
        self._field.value = address.match
        if self._grid is not None:
            sort = address.sort or self._sort
            state = {"state": [{"colId": sort, "sort": "desc"}] if sort else [], "defaultState": {"sort": None}}
            self._grid.run_grid_method("applyColumnState", state)

    def _sorted(self, event: GenericEventArguments) -> None:
        sort = "" if event.args == self._sort else str(event.args or "")
        self._page.now_at(replace(self._page.address, sort=sort))

    def _find(self, text: str | None) -> None:
        self._page.now_at(replace(self._page.address, match=text or ""))
        self._say_match(text or "")

    def _say_match(self, text: str) -> None:
        purge = "" if self._grid is None else f" getElement({self._grid.id}).api?.purgeInfiniteCache();"
        ui.run_javascript(f"window.rrMatch = {json.dumps(text)};{purge}")


def add_rows(watch: Watch, table: Table[Any]) -> None:
    """Add the address to the web server at which the browser's grid asks for rows."""

    @app.get(f"/rows/{table.name}")
    def _(match: str = "", offset: int = 0, limit: int = _BLOCK, sort: str = "") -> dict[str, Any]:
        """Return a page of rows. As it is no coroutine, it runs in a thread."""
        look = Look(match[:200], max(0, offset), max(1, min(limit, c.PAGE_LIMIT)), sort)
        try:
            part = table.look(Hasty(watch.link, _LOOK_S), look)
        except RrError as error:
            return {"total": 0, "rows": [], "problem": str(error)}
        rows = [{"key": table.line(row, True).key} for row in part.rows]
        for column in table.shown_in("page"):
            texts = [column.text(row) for row in part.rows]
            ids = short_ids(texts) if column.is_id else {}
            for cells, text in zip(rows, texts, strict=True):
                cells[column.head] = ids.get(text, text)
        return {"total": part.total, "rows": rows, "problem": "; ".join(part.notes)}
