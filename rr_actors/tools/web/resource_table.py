"""The table of all resources. The browser asks for the rows that it shows, and the system searches them."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import json
import time
from collections.abc import Awaitable, Callable
from typing import Any, cast

from nicegui import app, ui

from rr_actors.base.errors import RrError
from rr_actors.base.names import short_ids
from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.tools.web.watch import Watch

_PATH = "/rows/resources"
_BLOCK = 100  # rows that are asked for at once
_REFRESH_S = 1.0
_LOOK_S = 20.0
_COLUMNS = (
    ("resource", 5), ("state", 1.8), ("message", 2), ("priority", 1), ("holders", 1), ("held_by", 2), ("short_id", 1.3),
)  # fmt: skip
_NAME_PX = 320  # a narrower cell would show the same beginning of all names of a server; a narrow table is scrolled
_SIGNS = """({
  "rr-row-bad": (row) => row.data && ["ERROR", "FATAL"].includes(row.data.state),
  "rr-row-warm": (row) => row.data && row.data.state === "WARNING",
})"""
_SOURCE = f"""{{
  getRows: (wanted) => {{
    const match = encodeURIComponent(window.rrMatch || ""), path = `${{window.path_prefix}}{_PATH}`;
    fetch(`${{path}}?match=${{match}}&offset=${{wanted.startRow}}&limit=${{wanted.endRow - wanted.startRow}}`)
      .then((answer) => answer.json())
      .then((page) => wanted.successCallback(page.rows, page.total))
      .catch(() => wanted.failCallback());
  }},
}}"""


class ResourceTable:
    """A table of resources with a search field.

    Args:
        on_choose: called with the id of the resource whose row was clicked, or chosen with the space key.
    """

    def __init__(self, on_choose: Callable[[str], Awaitable[None]]) -> None:
        self._refreshed = time.monotonic()
        self._on_choose = on_choose
        self._grid: ui.aggrid | None = None
        search = ui.input("search in id, server, request and status", on_change=lambda event: self._find(event.value))
        search.props("dense outlined clearable debounce=200").classes("w-full")
        self._place = ui.element("div").classes("w-full").style("height: max(260px, 36vh)")

    def fill(self) -> None:
        """Add the table itself, which asks for its first rows. Its library takes a while to load."""
        columns = [
            {
                "field": name,
                "headerName": name.replace("_", " "),
                "flex": width,
                "minWidth": _NAME_PX if name == "resource" else 65 + 25 * width,
                "tooltipField": name,
            }
            for name, width in _COLUMNS
        ]
        options: dict[str, Any] = {
            "columnDefs": columns,
            "defaultColDef": {"sortable": False, "resizable": True},
            "rowModelType": "infinite",
            "cacheBlockSize": _BLOCK,
            "maxBlocksInCache": 4,
            "rowSelection": {"mode": "singleRow", "checkboxes": False, "enableClickSelection": True},
            ":getRowId": "(row) => row.data.id",
            ":rowClassRules": _SIGNS,
            ":datasource": _SOURCE,
        }
        with self._place:
            self._grid = grid = ui.aggrid(options, auto_size_columns=False).classes("w-full").style("height: 100%")

        async def selected() -> None:  # the event does not say which row is chosen
            answer = grid.run_grid_method("getSelectedRows", timeout=_LOOK_S)
            if rows := cast("list[dict[str, Any]]", await answer):
                await self._on_choose(rows[0]["id"])

        grid.on("selectionChanged", selected, args=[])

    def refresh(self) -> None:
        """Make the browser ask again for the rows that it shows, at most once a second."""
        if self._grid is not None and time.monotonic() > self._refreshed + _REFRESH_S:
            self._refreshed = time.monotonic()
            self._grid.run_grid_method("refreshInfiniteCache")

    def _find(self, text: str | None) -> None:
        purge = "" if self._grid is None else f" getElement({self._grid.id}).api?.purgeInfiniteCache();"
        ui.run_javascript(f"window.rrMatch = {json.dumps(text or '')};{purge}")


def add_rows(watch: Watch) -> None:
    """Add the address to the web server at which the browser's table asks for rows."""

    @app.get(_PATH)
    def _(match: str = "", offset: int = 0, limit: int = _BLOCK) -> dict[str, Any]:
        """Return a page of rows. As it is no coroutine, it runs in a thread."""
        request = questions.ListResources(match[:200], max(0, offset), max(1, min(limit, c.PAGE_LIMIT)))
        try:
            page = watch.link.ask(request, _LOOK_S)
        except RrError as error:
            return {"total": 0, "rows": [], "problem": str(error)}
        ids = short_ids(row.id for row in page.rows)
        rows = [_cells(row) | {"short_id": ids[row.id]} for row in page.rows]
        return {"total": page.total, "rows": rows, "problem": "; ".join(page.notes)}


def _cells(row: ResourceRow) -> dict[str, Any]:
    cells = {"id": row.id, "resource": row.name, "state": row.condition, "message": row.message}
    return cells | {"priority": row.needed, "holders": row.holder_count, "held_by": row.held_by}
