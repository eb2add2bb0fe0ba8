"""The commands of `rr-actors` that list what a running system has, as its sheets declare, and show one stream."""

from __future__ import annotations

import contextlib
import inspect
import json
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import typer

from rr_actors.actors.messaging.dead_letters import DeadLetters
from rr_actors.base.errors import UsageError, shown
from rr_actors.base.names import short_ids
from rr_actors.registrar.pages import CONDITIONS
from rr_actors.system.console.console_messages import PAGE_LIMIT, UsageRow
from rr_actors.system.console.console_questions import ListDeadLetters
from rr_actors.tools.cli_commands import (
    JsonOption,
    StateOption,
    WatchOption,
    say,
    say_json,
    say_lines,
    say_table,
    shown_again,
)
from rr_actors.tools.tables.sheets import Sheet
from rr_actors.tools.tables.table import Column, Look, Table, tables_of
from rr_actors.tools.verbs.console_options import SHOWN, Limit, Output, RowLimit, client_of, completing, list_registrars

app = typer.Typer()

_JSON = {"request", "response"}  # of a row
_MATCH = "Only those with this text in their id, server, request or status."
Registrar = Annotated[str, typer.Option(help="Only this one's.", autocompletion=completing(list_registrars))]
_OPTIONS: dict[str, Any] = {
    "registrar": Registrar,
    "status": Annotated[
        list[str] | None, typer.Option(help="Only those in this state, OK or loading for instance; may be repeated.")
    ],
    "parts": Annotated[
        bool,
        typer.Option("--parts", help="Below each manager its registrar and the servers of that, and what these do."),
    ],
    "holder": Annotated[
        str, typer.Option(help="Only those that this registrar holds.", autocompletion=completing(list_registrars))
    ],
}


class ListVerb:
    """The verb of a sheet, which imports its tables.

    Attributes:
        app: has this verb.
    """

    def __init__(self, sheet: Sheet) -> None:
        self.app = typer.Typer()
        self.app.command(sheet.verb, epilog=f"Example: rr-actors {sheet.example}")(_verb(sheet))


def _verb(sheet: Sheet) -> Callable[..., None]:
    tables = tables_of(sheet.module())[: sheet.in_verb]

    def show(
        match: str = "",
        registrar: str = "",
        limit: int | None = None,
        status: list[str] | None = None,
        holder: str = "",
        parts: bool = False,
        sort_by: str | None = None,
        wide: bool = False,
        output: str | None = None,
        watch: bool = False,
        state: Path | None = None,
        as_json: bool = False,
    ) -> None:
        known = {one.lower() for one in CONDITIONS}
        if wrong := [one for one in status or () if one.lower() not in known]:
            raise UsageError(f"--status: expected one of {', '.join(reversed(CONDITIONS))}, got {shown(wrong[0])}")
        look = Look(
            match, sort=sort_by or "", registrar=registrar, states=tuple(status or ()), holder=holder, parts=parts
        )
        form = "json" if as_json else output or ("wide" if wide else "")
        shown_again(watch, lambda: _show(tables, look, limit, form, state))

    heads = tuple(dict.fromkeys(head for table in tables for head in table.sorts("verb")))
    types = {
        "match": Annotated[str, typer.Argument(help=sheet.match)],
        **{option: _OPTIONS[option] for option in sheet.options},
        "limit": RowLimit,
        "sort_by": Annotated[
            cast("Any", Literal)[heads] | None, typer.Option("--sort-by", help="The most of it, or the worst, first.")
        ],
        "wide": Annotated[bool, typer.Option("--wide", help="Shorten nothing to fit the terminal.")],
        "output": Output,
        "watch": WatchOption,
        "state": StateOption,
        "as_json": JsonOption,
    }
    signature = inspect.signature(show)
    taken = [signature.parameters[option].replace(annotation=kind) for option, kind in types.items()]
    verb = cast("Any", show)
    verb.__signature__, verb.__annotations__, verb.__doc__ = signature.replace(parameters=taken), types, sheet.says
    return show


def _show(tables: Sequence[Table[Any]], look: Look, limit: int | None, form: str, state: Path | None) -> None:
    most = _most(limit, form)
    with client_of(state) as client:
        parts = [table.read(client, look, most) for table in tables]
    if form == "json":
        read = zip(tables, parts, strict=True)
        facts = {table.name: [_nested(table.facts(row)) for row in part.rows] for table, part in read}
        say_json(facts if len(tables) > 1 else facts[tables[0].name])
    for table, part in zip(tables, parts, strict=True) if form != "json" else ():
        if form == "name":
            say_lines("\n".join(map(table.named, part.rows)))
        elif part.rows:
            if table is not tables[0]:
                say("")
            say_rows(table.shown_in("verb"), part.rows, form)
        elif table.nothing:
            chosen = (look.match or look.registrar or look.states or look.holder) and len(tables) == 1
            say(f"no {table.name[:-1]} matches" if chosen else table.nothing, err=len(tables) == 1)
    more = sum(part.total - len(part.rows) for part in parts)
    _say_what_is_missing(more, list(dict.fromkeys(note for part in parts for note in part.notes)))


def _nested(row: object) -> Any:
    """Return a row for JSON: its texts that are JSON themselves are nested, those that were cut stay."""
    found: Any = msgspec.to_builtins(row)
    for name in _JSON & found.keys():
        with contextlib.suppress(ValueError):
            found[name] = json.loads(found[name])
    return found


def say_rows(columns: Sequence[Column[Any]], rows: Sequence[Any], form: str = "") -> None:
    """Print rows as a table; with the form "wide", nothing is shortened."""
    texts: list[list[str]] = []
    for column in columns:
        cells = [column.text(row) for row in rows]
        ids = short_ids(cells) if column.is_id else {}
        texts.append([ids.get(cell, cell) for cell in cells])
    gives_way = [column.head for column in columns if column.gives_way]
    right = [column.head for column in columns if column.right]
    heads = [column.head for column in columns]
    say_table(heads, list(zip(*texts, strict=True)), gives_way=gives_way, right=right, wide=form == "wide")


def _most(limit: int | None, form: str) -> int:
    """Return how many rows are shown at most: all in a form for programs, which would take a part for the whole."""
    return limit or (sys.maxsize if form in ("json", "name") else SHOWN)


def _say_what_is_missing(left_out: int, notes: Sequence[str]) -> None:
    """Say on standard error how many rows are left out, and who was not asked."""
    if left_out > 0:
        say(f"{left_out} more: choose with MATCH, or raise --limit", err=True)
    for note in notes:
        say(f"not asked: {note}", err=True)


@app.command(epilog="Example: rr-actors usage --sort-by memory_bytes --registrar programs")
def usage(
    match: Annotated[str, typer.Argument(help=_MATCH)] = "",
    registrar: Registrar = "",
    sort_by: Annotated[
        str, typer.Option("--sort-by", metavar="NUMBER", help="The most of it first: cpu or memory_bytes, say.")
    ] = "",
    limit: RowLimit = None,
    output: Output = None,
    watch: WatchOption = False,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what each resource uses now, CPU and memory for instance, of servers that can say it."""
    form = "json" if as_json else output or ""
    shown_again(watch, lambda: _show_usages(state, match, registrar, sort_by, limit, form))


def _show_usages(state: Path | None, match: str, registrar: str, sort_by: str, limit: int | None, form: str) -> None:
    """Show usages. Their columns are the numbers that the servers say."""
    with client_of(state) as client:
        page = client.usages(registrar, match)
    rows = [row for row in page.rows if row.usage or row.failure]
    names = list(dict.fromkeys(name for row in rows for name in row.usage))
    if sort_by:
        if sort_by not in names:
            raise UsageError(f"--sort-by: expected one of {', '.join(names) or 'no numbers'}, got {shown(sort_by)}")
        rows.sort(key=lambda row: row.usage.get(sort_by, -math.inf), reverse=True)
    total, rows = len(rows), rows[: _most(limit, form)]
    if form == "json":
        say_json([_nested(msgspec.structs.asdict(row)) for row in rows])
    elif form == "name":
        say_lines("\n".join(map(_full_name, rows)))
    elif not rows:
        say("no resource says what it uses", err=True)
    else:
        numbers = [Column(name.removesuffix("_bytes"), partial(_amount, name), right=True) for name in names]
        name, id = Column[UsageRow]("resource", _full_name, gives_way=True), Column[UsageRow]("id", _id, is_id=True)
        say_rows([name, *numbers, id], [row for row in rows if row.usage], form)
        ids = short_ids(row.id for row in rows)
        for row in rows:
            if row.failure:
                say(f"not known: {row.name} ({ids[row.id]}): {row.failure}", err=True)
    _say_what_is_missing(total - len(rows), page.notes)


def _full_name(row: UsageRow) -> str:
    return f"{row.server} {row.request}"


def _id(row: UsageRow) -> str:
    return row.id


def _amount(name: str, row: UsageRow) -> str:
    """Return the text for one number of a usage."""
    if (number := row.usage.get(name)) is None:
        return ""
    return f"{number / 2**20:.0f} MiB" if name.endswith("_bytes") else f"{number:.6g}"


@app.command("dead-letters", epilog="Example: rr-actors dead-letters --limit 5")
def dead_letters(limit: Limit = 20, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show how many messages could not be delivered, and the newest of them."""
    with client_of(state) as client:
        letters = client.ask(ListDeadLetters(min(limit, PAGE_LIMIT)))
    if as_json:
        say_json({"count": letters.count, "letters": letters.letters})
    else:
        say_lines(str(DeadLetters(letters.count, letters.letters)))
