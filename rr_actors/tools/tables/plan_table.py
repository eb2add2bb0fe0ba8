"""The tables that actors declare of their own: pools, what is kept, choices, graphs of actions, and those of users."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from rr_actors.actors.actor_tables import TableColumn
from rr_actors.base.errors import counted
from rr_actors.base.values.canonical import json_of, shown_plain
from rr_actors.system.console.asking.table_questions import ListTables
from rr_actors.tools.tables.table import Asks, Column, Look, Row, Rows, Table

_BAR = 10  # cells of a bar


@dataclass(frozen=True)
class PlanRow:
    """A row of a table that an actor declares: the path of the actor, the table with its columns, and the fields."""

    actor: str
    table: str
    columns: Sequence[TableColumn]
    facts: dict[str, Any]

    @property
    def _named_by(self) -> TableColumn:
        return next((column for column in self.columns if column.kind != "id"), self.columns[0])

    @property
    def name(self) -> str:
        """What its first column shows that is no id."""
        return _cell(self._named_by, self)

    @property
    def key(self) -> str:
        """What tells it from the other rows: its name, and its ids."""
        ids = (_cell(column, self) for column in self.columns if column.kind == "id")
        return " ".join((self.actor, self.table, self.name, *ids))

    @property
    def state(self) -> str:
        """What the other columns show that have a text, each after its head."""
        others = [column for column in columns_of(self) if column.head != self._named_by.title]
        problems = {column.title for column in self.columns if column.kind == "problem"}
        cells = ((column.head, column.cell(self)) for column in others if column.head not in problems)
        return ", ".join(f"{head} {cell}" for head, cell in cells if cell)

    @property
    def problem(self) -> str:
        """What is wrong; "" if nothing is."""
        return "; ".join(filter(None, (_cell(column, self) for column in self.columns if column.kind == "problem")))


def _cell(column: TableColumn, row: PlanRow) -> str:
    value = row.facts.get(column.field)
    if column.kind == "yes":
        return "yes" if value else "no"
    text = _text(value)
    if not column.of or not text:
        return text
    whole = row.facts.get(column.of)
    of = f"{text} of {_text(whole)}"
    return f"{of} {_bar(value, whole)}" if column.kind == "bar" else of


def _text(value: Any) -> str:
    match value:
        case None:
            return ""
        case str():
            return value
        case float():
            return f"{value:g}"
        case list():
            return ", ".join(map(_text, cast("list[Any]", value)))
        case dict():
            return ", ".join(f"{key}: {_text(one)}" for key, one in cast("dict[str, Any]", value).items())
        case _:
            return json_of(value)


def _bar(value: Any, whole: Any) -> str:
    """Return a bar that is as full as a number is of another one."""
    try:
        full = round(_BAR * min(1.0, max(0.0, value / whole)))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        full = _BAR if whole == 0 and value else 0
    return "█" * full + "░" * (_BAR - full)


def columns_of(row: PlanRow) -> list[Column[PlanRow]]:
    """Return the columns of the table that a row is of."""
    return [
        Column(
            column.title,
            partial(_cell, column),
            right=column.kind == "number",
            gives_way=column.kind in ("long", "problem"),
            is_id=column.kind == "id",
        )
        for column in row.columns
    ]


def source(table: str = "", actor: str = "", timeout_s: float = 1.0) -> Callable[[Asks, Look], Rows[PlanRow]]:
    """Return the source of the rows of all tables, or of those of one name, of one actor."""

    def ask(asks: Asks, look: Look) -> Rows[PlanRow]:
        page = asks.ask(ListTables(look.match, look.offset, look.limit, actor, table, timeout_s))
        rows: list[PlanRow] = []
        for row in page.rows:
            of = page.tables[row.table]
            rows.append(PlanRow(of.actor, of.name, of.columns, shown_plain(row.facts)))
        return Rows(page.total, rows, page.notes)

    return ask


def _line(row: PlanRow, has_columns: bool) -> Row:
    note = "" if has_columns else row.problem or row.state
    return Row(row.key, f"{row.table} {row.name}", note, "yellow" if row.problem else "")


PLANS = Table[PlanRow](
    "plans",
    (
        Column("table", lambda row: row.table),
        Column("name", lambda row: row.name, gives_way=True),
        Column("state", lambda row: row.state, 44, gives_way=True),
        Column("problem", lambda row: row.problem, 30, gives_way=True),
        Column("manager", lambda row: row.actor, views="verb page", gives_way=True),
    ),
    source(),
    _line,
    narrow=("state", "problem"),
    nothing="no manager declares a table that has rows",
    caption=lambda total: counted(total, "row") if total else "No manager declares a table that has rows.",
    facts=lambda row: {"table": row.table, "actor": row.actor, "row": row.facts},
)


def tables() -> tuple[Table[Any], ...]:
    """Return the tables of the sheet."""
    return (PLANS,)
