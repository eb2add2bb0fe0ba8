"""The commands of `rr-actors` that list what a running system has, as its sheets declare, and show one stream."""

from __future__ import annotations

import contextlib
import inspect
import json
import math
import sys
import time
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
from rr_actors.system.console.attention.attention_items import AttentionItem, counts_text
from rr_actors.system.console.attention.attention_questions import Attention, ListAttention, Silence
from rr_actors.system.console.console_messages import PAGE_LIMIT, TIMEOUT_LIMIT_S, UsageRow
from rr_actors.system.console.console_questions import ListDeadLetters, ListHosts
from rr_actors.system.recording.event_texts import ago, clock
from rr_actors.tools.cli_commands import (
    JsonOption,
    StateOption,
    WatchOption,
    say,
    say_json,
    say_lines,
    say_table,
    seconds_of,
    shown_again,
)
from rr_actors.tools.tables.resource_table import full_name, shown_name
from rr_actors.tools.tables.sheets import Sheet
from rr_actors.tools.tables.table import Column, Look, Table, tables_of
from rr_actors.tools.verbs.console_options import (
    SHOWN,
    Limit,
    Output,
    RowLimit,
    carry_out,
    completing,
    connection_of,
    list_registrars,
)
from rr_actors.wire.name_service import HostInfo

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
    with connection_of(state) as connection:
        parts = [table.read(connection, look, most) for table in tables]
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
            styles = [table.line(row, True).style for row in part.rows]
            say_rows(table.shown_in("verb"), part.rows, form, styles)
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


def say_rows(columns: Sequence[Column[Any]], rows: Sequence[Any], form: str = "", styles: Sequence[str] = ()) -> None:
    """Print rows as a table, each in its style; with the form "wide", nothing is shortened."""
    texts: list[list[str]] = []
    for column in columns:
        cells = [column.text(row) for row in rows]
        ids = short_ids(cells) if column.is_id else {}
        texts.append([ids.get(cell, cell) for cell in cells])
    gives_way = [column.head for column in columns if column.gives_way]
    right = [column.head for column in columns if column.right]
    heads = [column.head for column in columns]
    say_table(
        heads, list(zip(*texts, strict=True)), gives_way=gives_way, right=right, wide=form == "wide", styles=styles
    )


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
    with connection_of(state) as connection:
        page = connection.usages(registrar, match)
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
        say_lines("\n".join(map(full_name, rows)))
    elif not rows:
        say("no resource says what it uses", err=True)
    else:
        numbers = [Column(name.removesuffix("_bytes"), partial(_amount, name), right=True) for name in names]
        name, id = Column[UsageRow]("resource", shown_name, gives_way=True), Column[UsageRow]("id", _id, is_id=True)
        say_rows([name, *numbers, id], [row for row in rows if row.usage], form)
        ids = short_ids(row.id for row in rows)
        for row in rows:
            if row.failure:
                say(f"not known: {row.name} ({ids[row.id]}): {row.failure}", err=True)
    _say_what_is_missing(total - len(rows), page.notes)


def _id(row: UsageRow) -> str:
    return row.id


def _amount(name: str, row: UsageRow) -> str:
    """Return the text for one number of a usage."""
    if (number := row.usage.get(name)) is None:
        return ""
    return f"{number / 2**20:.0f} MiB" if name.endswith("_bytes") else f"{number:.6g}"


@app.command(epilog="Example: rr-actors attention --silence pool:root/budgets:watts --for 30m")
def attention(
    silence: Annotated[
        str, typer.Option("--silence", metavar="ITEM", help="Do not show this item for a while: its id, or a part.")
    ] = "",
    for_: Annotated[
        str, typer.Option("--for", metavar="TIME", help="How long: 90s, 10m, 2h; 0 shows it again.")
    ] = "1h",
    watch: WatchOption = False,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what needs attention, the worst first: what, since when, whom it touches, and the command that leads on.

    The exit code is 1 if there is something, and 0 if all is well. What is silenced does not count; it is listed with
    its time. The system's process keeps what is silenced until it ends.
    """
    if silence:
        carry_out(state, Silence(silence, seconds_of(for_, "--for", TIMEOUT_LIMIT_S)), as_json)
        return
    found = list[AttentionItem]()

    def show() -> None:
        with connection_of(state) as connection:
            answer = connection.ask(ListAttention())
        found[:] = answer.items
        _say_attention(answer, as_json)

    shown_again(watch, show)
    if found:
        raise typer.Exit(1)


def _say_attention(answer: Attention, as_json: bool) -> None:
    if as_json:
        say_json(answer)
        return
    say(counts_text(answer.items, answer.silenced))
    for item in answer.items:
        say("")
        since = "" if item.since is None else f"  since {clock(item.since)} ({ago(max(0.0, time.time() - item.since))})"
        say(f"{item.severity:<7}  {item.what}")
        if item.touches:
            more = item.touched - len(item.touches)
            say(f"         touches {', '.join(item.touches)}{f' and {more} more' if more > 0 else ''}")
        leads = f"rr-actors {item.command}" if item.command else ""
        say(f"         {'  '.join(filter(None, (leads, item.id)))}{since}")
    for id, until in answer.silenced.items():
        say(f"silenced until {clock(until)}: {id}")
    _say_what_is_missing(answer.total - len(answer.items), answer.notes)


@app.command("dead-letters", epilog="Example: rr-actors dead-letters --limit 5")
def dead_letters(limit: Limit = 20, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show how many messages could not be delivered, and the newest of them."""
    with connection_of(state) as connection:
        letters = connection.ask(ListDeadLetters(min(limit, PAGE_LIMIT)))
    if as_json:
        say_json({"count": letters.count, "letters": letters.letters})
    else:
        say_lines(str(DeadLetters(letters.count, letters.letters)))


@app.command("hosts", epilog="Example: rr-actors hosts")
def hosts(state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show the other hosts that the system knows: whether each is reachable, since when, and what it exports."""
    with connection_of(state) as connection:
        found = connection.ask(ListHosts())
    if as_json:
        say_json({"host": found.host, "hosts": found.rows})
    elif not found.rows:
        say(f"host {found.host}: no other host has been seen, and the settings name none")
    else:
        now = time.time()
        say_lines("\n".join(_host_line(row, now) for row in found.rows))


def _host_line(row: HostInfo, now: float) -> str:
    exports = ", ".join(f"{name} ({status})" for name, status in row.exports.items()) or "nothing"
    why = f" ({row.why})" if row.why else ""
    return f"{row.name}  {row.state} for {now - row.since:.0f} s{why}; exports {exports}"
