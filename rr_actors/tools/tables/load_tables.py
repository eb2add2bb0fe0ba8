"""The tables of loads: those that wait now, and how often and how long the loads of each server waited."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rr_actors.base.errors import counted
from rr_actors.base.names import time_in
from rr_actors.registrar.pages import LoadRow, QueryRow
from rr_actors.system.console import console_questions as questions
from rr_actors.tools.explanations import name_of_resource, seconds_text
from rr_actors.tools.tables.table import Asks, Column, Look, Row, Rows, Table

_NONE_WAITS = "No load waits now."


@dataclass(frozen=True)
class Waiting:
    """A load that waits, the name of the resource of its own that it is for, and how long it has waited."""

    row: QueryRow
    whose: str
    how_long: str


def _waiting(asks: Asks, look: Look) -> Rows[Waiting]:
    found = asks.ask(questions.ListLoads(look.match, look.offset, look.limit, look.registrar))
    rows: list[Waiting] = []
    for row in found.rows:
        whose = name_of_resource(asks.ask, row.parent, row.origin) if row.parent else "itself"
        at = time_in(row.id)
        rows.append(Waiting(row, whose, "" if at is None else seconds_text(max(0.0, time.time() - at))))
    return Rows(found.total, rows, found.notes)


def _servers(asks: Asks, look: Look) -> Rows[LoadRow]:
    found = asks.ask(questions.ListLoads(look.match, 0, 1, look.registrar, look.sort))
    return look.cut(found.servers)


def _count(head: str, width: int, count: Callable[[LoadRow], int]) -> Column[LoadRow]:
    return Column(head, lambda row: f"{count(row):,}", width, sorts=True, right=True)


def _time(head: str, seconds: Callable[[LoadRow], float]) -> Column[LoadRow]:
    """Return a column with a time, which is not known until a load has ended."""
    return Column(head, lambda row: seconds_text(seconds(row)) if row.longest_s else "", 9, sorts=True, right=True)


def _waiting_line(of: Waiting, has_columns: bool) -> Row:
    row = of.row
    text = f"{row.origin} waits for {row.name}, for {of.whose}{row.said and f': {row.said}'}"
    return Row(row.id, text, of.how_long, "yellow", resource=row.resource_id or row.id, query=row.id, name=row.name)


WAITING = Table[Waiting](
    "waiting",
    (
        Column("who waits", lambda of: of.row.origin),
        Column("for what", lambda of: of.row.name, gives_way=True),
        Column("to load", lambda of: of.whose, gives_way=True),
        Column("waits for", lambda of: of.how_long, right=True),
        Column("because", lambda of: of.row.said, gives_way=True),
    ),
    _waiting,
    _waiting_line,
    nothing=_NONE_WAITS,
    caption=lambda total: f"{counted(total, 'load')} in progress" if total else _NONE_WAITS,
    facts=lambda of: of.row,
)
SERVERS = Table[LoadRow](
    "servers",
    (
        Column("server", lambda row: row.server, gives_way=True),
        _count("loads", 10, lambda row: row.loads),
        _count("shared", 10, lambda row: row.shared),
        _count("waited", 10, lambda row: row.waited),
        _count("failed", 8, lambda row: row.failed),
        _count("waiting now", 12, lambda row: row.loading),
        _time("mean", lambda row: row.mean_s),
        _time("p95", lambda row: row.p95_s),
        _time("longest", lambda row: row.longest_s),
        _time("own mean", lambda row: row.own_mean_s),
        _time("own p95", lambda row: row.own_p95_s),
    ),
    _servers,
    lambda row, has_columns: Row(
        f"loads {row.server}",
        row.server,
        "" if has_columns or not row.longest_s else f"p95 {seconds_text(row.p95_s)}",
        "red" if row.failed else "",
    ),
    narrow=("mean", "p95", "loads", "shared", "waited", "failed", "longest", "own mean", "own p95"),
    caption=lambda total: "Loads of each server",
    page_sort="waiting now",
)


def tables() -> tuple[Table[Any], ...]:
    """Return the tables of the sheet."""
    return WAITING, SERVERS
