"""The page of a sheet: its tables, which the heads of their columns sort."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from nicegui import background_tasks, ui

from rr_actors.base.errors import RrError
from rr_actors.base.notebook import escape
from rr_actors.tools.tables.sheets import Sheet
from rr_actors.tools.tables.table import Look, Row, Rows, Table, tables_of
from rr_actors.tools.terminal.terminal_rows import LOOK_S, Hasty
from rr_actors.tools.web.frame.detail_html import link_html
from rr_actors.tools.web.frame.details import Link
from rr_actors.tools.web.frame.live_html import LiveHtml
from rr_actors.tools.web.page_parts import Page
from rr_actors.tools.web.watch import Watch

_ROWS = 300  # of each table


class ListPage(Page):
    """The page of a sheet, as its system is now."""

    goes_back = False

    def __init__(self, watch: Watch, sheet: Sheet) -> None:
        self._tables, self._note = tables_of(sheet.module()), sheet.note
        self._sorts = {table.name: table.page_sort for table in self._tables}
        self._is_asking = False
        super().__init__(watch, f"/{sheet.name}")

    def build(self) -> None:
        """Put the search and the tables on the page."""
        self._match = ui.input("only rows with this text", value=self.address.match, on_change=self._search)
        self._match.props("dense outlined clearable debounce=200")
        self.readdressed()
        self._match.classes("w-full")
        self._shown: list[LiveHtml] = []
        for table in self._tables:
            with ui.element("div").classes("rr-panel w-full"):
                shown = LiveHtml(lambda act, head, name=table.name: self._sort(name, head)).classes("w-full")
                self._shown.append(shown)
        ui.label(self._note).classes("rr-note")

    def draw(self, moment: object) -> None:
        """Ask for the rows again, unless an answer is still to come."""
        if not self._is_asking and not self.moment.problem:
            background_tasks.create(self._ask())

    def step(self) -> object:
        """Return the second, as what waits grows older, and what the reader has chosen."""
        return int(time.monotonic()), self._match.value, dict(self._sorts)

    def readdressed(self) -> None:
        """Search and sort as the address says: of the sorts "servers.p95", the table and the head of its column."""
        self._match.value = self.address.match
        table, _, head = self.address.sort.partition(".")
        self._sorts = {one.name: one.page_sort for one in self._tables} | ({table: head} if head else {})

    def _search(self) -> None:
        self.now_at(replace(self.address, match=self._match.value or ""))

    def _sort(self, table: str, head: str) -> None:
        is_back = self._sorts.get(table) == head
        self.now_at(replace(self.address, sort="" if is_back else f"{table}.{head}"))
        self._sorts[table] = "" if is_back else head

    async def _ask(self) -> None:
        self._is_asking = True
        try:
            parts = await asyncio.to_thread(self._asked, self._match.value or "")
        except RrError:  # the next moment says why there is no answer
            return
        finally:
            self._is_asking = False
        for table, shown, part in zip(self._tables, self._shown, parts, strict=True):
            shown.show(_html(table, part, self._sorts[table.name]))

    def _asked(self, match: str) -> list[Rows[Any]]:
        asks = Hasty(self.watch.link, LOOK_S)
        return [table.read(asks, Look(match[:200], sort=self._sorts[table.name]), _ROWS) for table in self._tables]


def _html(table: Table[Any], part: Rows[Any], sort: str) -> str:
    """Return a table as HTML; without rows, its caption alone."""
    columns = table.shown_in("page")
    places = ["" if column.right else 'class="rr-left"' for column in columns]
    heads = "".join(
        f'<th scope="col" {place} {_SORTED * (column.head == sort)}>{_head(column.head, column.sorts)}</th>'
        for column, place in zip(columns, places, strict=True)
    )
    body = "".join(f"<tr>{_cells(table, columns, places, row)}</tr>" for row in part.rows)
    first = f": the first {len(part.rows):,}" if len(part.rows) < part.total else ""
    said = escape("; ".join((f"{table.caption(part.total)}{first}", *(f"not asked: {note}" for note in part.notes))))
    rows = f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody>" if part.rows else ""
    return f'<table class="rr-loads"><caption>{said}</caption>{rows}</table>'


_SORTED = 'aria-sort="descending"'


def _head(head: str, sorts: bool) -> str:
    return (
        f'<button type="button" data-act="sort" data-of="{escape(head)}">{escape(head)}</button>'
        if sorts
        else escape(head)
    )


def _cells(table: Table[Any], columns: Sequence[Any], places: Sequence[str], row: Any) -> str:
    line = table.line(row, True)
    return "".join(
        f'<td data-head="{escape(column.head)}" {place}>{link_html(_link(line, column.head, column.cell(row)))}</td>'
        for column, place in zip(columns, places, strict=True)
    )


def _link(line: Row, head: str, text: str) -> Link:
    """Return the text of a cell, as a link if it is the name of a thing."""
    if line.resource and text and text == line.name:
        return Link(text, "resource", line.resource)
    if line.child is not None and text.strip() in (line.child.path, line.child.id):
        return Link(text, "child", line.child.path)
    return Link(text, "server" if head == "server" and "/" in text else "", text)
