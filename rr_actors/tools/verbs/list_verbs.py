"""The commands of `rr-actors` that list what a running system has, as its sheets declare, and show one stream."""

from __future__ import annotations

import inspect
import io
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import typer

from rr_actors.actors.messaging.dead_letters import DeadLetters
from rr_actors.base.errors import NotFound, UsageError, did_you_mean, few, shown, text_of
from rr_actors.base.names import short_id, short_ids
from rr_actors.registrar.pages import CONDITIONS
from rr_actors.streams.stream import Stream, StreamFrame, StreamRow
from rr_actors.system.console.console_client import ConsoleClient, find_console
from rr_actors.system.console.console_messages import PAGE_LIMIT, UsageRow
from rr_actors.system.console.console_questions import Find, ListDeadLetters
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
from rr_actors.tools.explanations import age_text, bytes_text, rate_text, readers_text
from rr_actors.tools.tables.resource_table import full_name
from rr_actors.tools.tables.sheet import Sheet
from rr_actors.tools.tables.sheets import SHEETS
from rr_actors.tools.tables.stream_table import stream_facts
from rr_actors.tools.tables.table import Column, Look, Table, tables_of
from rr_actors.tools.terminal.stream_frames import frames_of, png
from rr_actors.tools.verbs.console_options import SHOWN, Limit, Output, RowLimit, client_of, completing, list_registrars

app = typer.Typer()
_LOOK_S = 1.0  # between two looks at a stream's rate, and at whether its resource is still there

_MATCH = "Only those with this text in their id, server, request or status."
Registrar = Annotated[str, typer.Option(help="Only this one's.", autocompletion=completing(list_registrars))]
_OPTIONS: dict[str, Any] = {
    "registrar": Registrar,
    "status": Annotated[
        list[str] | None, typer.Option(help="Only those in this state, OK or loading for instance; may be repeated.")
    ],
    "holder": Annotated[
        str, typer.Option(help="Only those that this registrar holds.", autocompletion=completing(list_registrars))
    ],
}


def _add_verb(sheet: Sheet) -> None:
    tables = tables_of(sheet)[: sheet.in_verb]

    def show(
        match: str = "",
        registrar: str = "",
        limit: int | None = None,
        status: list[str] | None = None,
        holder: str = "",
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
        look = Look(match, sort=sort_by or "", registrar=registrar, states=tuple(status or ()), holder=holder)
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
    app.command(sheet.verb, epilog=f"Example: rr-actors {sheet.example}")(verb)


def _show(tables: Sequence[Table[Any]], look: Look, limit: int | None, form: str, state: Path | None) -> None:
    most = _most(limit, form)
    with client_of(state) as client:
        parts = [table.read(client, look, most) for table in tables]
    if form == "json":
        facts = {table.name: [table.facts(row) for row in part.rows] for table, part in zip(tables, parts, strict=True)}
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
    """Say on the error output how many rows are left out, and who was not asked."""
    if left_out > 0:
        say(f"{left_out} more: choose with MATCH, or raise --limit", err=True)
    for note in notes:
        say(f"not asked: {note}", err=True)


for _sheet in SHEETS:
    _add_verb(_sheet)


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
        say_json([msgspec.structs.asdict(row) for row in rows])
    elif form == "name":
        say_lines("\n".join(f"{row.server} {row.request}" for row in rows))
    elif not rows:
        say("no resource says what it uses", err=True)
    else:
        numbers = [Column(name.removesuffix("_bytes"), partial(_amount, name), right=True) for name in names]
        name, id = Column[UsageRow]("resource", full_name, gives_way=True), Column[UsageRow]("id", _id, is_id=True)
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


@app.command("dead-letters", epilog="Example: rr-actors dead-letters --limit 5")
def dead_letters(limit: Limit = 20, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show how many messages could not be delivered, and the newest of them."""
    with client_of(state) as client:
        letters = client.ask(ListDeadLetters(min(limit, PAGE_LIMIT)))
    if as_json:
        say_json({"count": letters.count, "letters": letters.letters})
    else:
        say_lines(str(DeadLetters(letters.count, letters.letters)))


# -- one stream --------------------------------------------------------------------------------------------------------


@app.command(epilog="Example: rr-actors stream 'cameras/camera \"front\"' images --save front.png")
def stream(
    id: Annotated[str, typer.Argument(help="A resource's name, or its id, or the beginning or end of that.")],
    name: Annotated[str, typer.Argument(help="The stream's name, if the resource has several.")] = "",
    rate: Annotated[bool, typer.Option("--rate", help="Show frames and bytes a second. This reads no frame.")] = False,
    echo: Annotated[bool, typer.Option("--echo", help="Read the stream, and show each frame as a line.")] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE", help="Read one frame into a new file: .png, .npy (numpy's), or .bin."),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="End after so many lines. Default: at Ctrl-C.")] = None,
    timeout_s: Annotated[
        float, typer.Option("--timeout", metavar="SECONDS", min=0.0, max=86_400.0, help="The longest wait for a frame.")
    ] = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show a stream's rate; or read it as one reader more, and show its frames or save one.

    Without an option: --rate. To read imports the classes of the values.
    """
    if rate + echo + (save is not None) > 1:
        raise UsageError("stream: expected one of --rate, --echo and --save FILE, got several")
    write = None if save is None else _writer(save)
    with ConsoleClient(find_console(state)) as client:
        row = _found(client, id, name)
        if write is not None and save is not None:
            frame = next(_frames(client, row, timeout_s), None)
            if frame is None:
                raise NotFound(f"stream {row.info.name!r}: its resource was unloaded", id=row.info.resource_id)
            _save(save, write, frame)
            say(f"saved frame {frame.number} in {save}")
        elif echo:
            for frame in itertools.islice(_frames(client, row, timeout_s), count):
                _say_frame(frame, as_json)
        else:
            for one in itertools.islice(_looks(client, row), count):
                _say_rate(one, as_json)


def _found(client: ConsoleClient, id: str, name: str) -> StreamRow:
    """Return the stream of the resource of this id or name.

    Raises:
        NotFound: there is none.
        UsageError: there are several.
    """
    resources = client.ask(Find(id)).resources
    if not resources:
        raise UsageError(f"{shown(id)}: no resource has this id; rr-actors streams lists the streams that there are")
    if len(resources) > 1:
        several = few(f"{row.name} ({short_id(row.id)})" for row in resources)
        raise UsageError(f"{shown(id)}: several resources have this in their ids: {several}; give more of the id")
    (resource,) = resources
    rows = {row.info.name: row for row in client.streams(match=resource.id).rows}
    names = few(map(repr, rows)) or "none"
    if name and name not in rows:
        raise UsageError(f"{resource.name} has no stream {shown(name)}; it has: {names}{did_you_mean(name, rows)}")
    if not rows:
        raise UsageError(f"{resource.name} has no stream that is open")
    if not name and len(rows) > 1:
        raise UsageError(f"{resource.name} has several streams: give the name of one after its id, of {names}")
    return rows[name or next(iter(rows))]


# -- its rate --------------------------------------------------------------------------------------------------------


def _looks(client: ConsoleClient, row: StreamRow) -> Iterator[StreamRow | None]:
    """Yield the stream's row each second; None while it is not open. It ends when the resource is gone."""
    while client.ask(Find(row.info.resource_id)).resources:
        found = [one for one in client.streams(match=row.info.resource_id).rows if one.info.name == row.info.name]
        yield found[0] if found else None
        time.sleep(_LOOK_S)
    say(f"stream {row.info.name!r}: its resource was unloaded", err=True)


def _say_rate(row: StreamRow | None, as_json: bool) -> None:
    if as_json:
        say_json(None if row is None else stream_facts(row))
    elif row is None:
        say("the stream is not open: its manager is being respawned, or a callback of its resource runs")
    else:
        size = f", {bytes_text(row)}" if row.readers else ""
        by = f", read by {readers_text(row)}" if row.readers else ", nobody reads it"
        say(f"{rate_text(row)}{size}, newest {age_text(row)}{by}")


# -- its frames ------------------------------------------------------------------------------------------------------


def _frames(client: ConsoleClient, row: StreamRow, timeout_s: float) -> Iterator[StreamFrame]:
    """Yield the newest frames, until the resource is gone.

    Raises:
        Unavailable: no frame came in time.
        RrError: a frame cannot be read here.
    """
    looked_at = time.monotonic()

    def is_over() -> bool:
        nonlocal looked_at
        if (now := time.monotonic()) - looked_at < _LOOK_S:
            return False
        looked_at = now
        return not client.ask(Find(row.info.resource_id)).resources

    yield from frames_of(Stream(row.info.resource_id, row.info.name), is_over, timeout_s)
    say(f"stream {row.info.name!r}: its resource was unloaded", err=True)


def _say_frame(frame: StreamFrame, as_json: bool) -> None:
    if as_json:
        facts = {"number": frame.number, "published_at": frame.published_at, "missed": frame.missed}
        say_json({**facts, "value": _value_text(frame.value)})
    else:
        missed = f", missed {frame.missed}" if frame.missed else ""
        say(f"{frame.number}  {frame.age_s * 1000:.1f} ms old{missed}  {_value_text(frame.value)}")


def _value_text(value: Any) -> str:
    """Return a text for a value: of an array, its shape and type."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"array of shape {cast('object', shape)} and type {dtype}"
    return shown(value)


def _save(path: Path, write: Callable[[Any], bytes], frame: StreamFrame) -> None:
    try:
        data = write(frame.value)
    except (TypeError, ValueError) as error:
        what = f"frame {frame.number} of stream {frame.stream.name!r}, {_value_text(frame.value)}"
        raise UsageError(f"--save {path}: {what}, cannot be saved: {text_of(error)}") from error
    with path.open("xb") as file:
        file.write(data)


def _writer(path: Path) -> Callable[[Any], bytes]:
    """Return the function that makes the bytes of such a file of a value; raise UsageError if there is none."""
    writers = {".png": png, ".npy": _npy, ".bin": _raw}
    if (write := writers.get(path.suffix)) is None:
        raise UsageError(f"--save: expected a file that ends with .png, .npy or .bin, got {shown(str(path))}")
    if path.exists():
        raise UsageError(f"--save: expected a new file, got {path}, which is there already")
    return write


def _raw(value: Any) -> bytes:
    return memoryview(value).tobytes()


def _npy(value: Any) -> bytes:
    import numpy  # most programs do without; it is not among the package's requirements

    file = io.BytesIO()
    numpy.save(file, value, allow_pickle=False)
    return file.getvalue()
