"""The table of the resources of all registrars."""

from __future__ import annotations

from typing import Any

from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_messages import UsageRow
from rr_actors.tools.tables.table import STATE_STYLES, Asks, Column, Look, Part, Row, Table


def _source(asks: Asks, look: Look) -> Part[ResourceRow]:
    return asks.ask(
        questions.ListResources(
            look.match, look.offset, look.limit, look.registrar, look.sort, look.states, look.holder
        )
    )


def shown_name(row: ResourceRow | UsageRow) -> str:
    """Return a resource's name for people, whole: with its title, if it has one."""
    return f"{row.server} {row.title or row.request}"


def full_name(row: ResourceRow | UsageRow) -> str:
    """Return a resource's name with the whole request that is known."""
    return f"{row.server} {row.request}"


def _state(row: ResourceRow) -> str:
    """Return the state; unless all is well, with the message: of the last status, or how far the load has come."""
    return row.condition if row.condition == "OK" else f"{row.condition} {row.message}".rstrip()


def _line(row: ResourceRow, has_columns: bool) -> Row:
    note = "" if has_columns or row.condition == "OK" else row.condition
    only = row.holders[0].query_id if row.holder_count == 1 else ""
    style = STATE_STYLES.get(row.condition, "")
    return Row(row.id, row.name, note, style, resource=row.id, query=only, name=row.name)


RESOURCES = Table[ResourceRow](
    "resources",
    (
        Column("resource", shown_name, sorts=True, gives_way=True, views="verb"),
        Column("resource", lambda row: row.name, sorts=True, views="page"),
        Column("state", _state, sorts=True, gives_way=True, views="verb"),
        Column("state", lambda row: row.condition, 11, sorts=True, views="top page"),
        Column("message", lambda row: row.message, views="page"),
        Column("priority", lambda row: row.needed, sorts=True, right=True),
        Column("holders", lambda row: str(row.holder_count), 9, sorts=True, right=True),
        Column("held by", lambda row: row.held_by, 22),
        Column("id", lambda row: row.id, is_id=True),
    ),
    _source,
    _line,
    narrow=("state", "holders", "priority", "id", "held by"),
    nothing="there are no resources",
    named=full_name,
)


def tables() -> tuple[Table[Any], ...]:
    """Return the tables of the sheet."""
    return (RESOURCES,)
