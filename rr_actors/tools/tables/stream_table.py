"""The table of the open streams of all registrars."""

from __future__ import annotations

from typing import Any

from rr_actors.base.errors import counted
from rr_actors.base.names import named
from rr_actors.streams.stream import StreamRow
from rr_actors.system.console import console_questions as questions
from rr_actors.tools.explanations import age_text, bytes_text, rate_text, readers_text
from rr_actors.tools.tables.table import Asks, Column, Look, Part, Row, Table


def _source(asks: Asks, look: Look) -> Part[StreamRow]:
    return asks.ask(questions.ListStreams(look.match, look.offset, look.limit, look.registrar, look.sort))


def stream_facts(row: StreamRow) -> dict[str, Any]:
    """Return a stream for programs."""
    info = row.info
    facts = {"name": info.name, "resource_id": info.resource_id, "server": info.server, "request": row.request}
    figures = {"frames": row.frames, "rate": info.rate_hz, "bytes_s": info.bytes_per_s, "age_s": info.age_s}
    return {**facts, **figures, "readers": row.readers, "missed": info.missed}


def _line(row: StreamRow, has_columns: bool) -> Row:
    info, of = row.info, named(row.info.server, row.title or row.request)
    note = "" if has_columns else rate_text(row)
    return Row(info.id, f"{info.name}  {of}", note, resource=info.resource_id, name=of)


STREAMS = Table[StreamRow](
    "streams",
    (
        Column("stream", lambda row: row.info.name),
        Column("resource", lambda row: f"{row.info.server} {row.title or row.request}", gives_way=True),
        Column("rate", rate_text, sorts=True, right=True),
        Column("bytes", bytes_text, 13, sorts=True, right=True),
        Column("age", age_text, right=True),
        Column("readers", lambda row: str(row.info.consumers or ""), 9, sorts=True, views="top"),
        Column("missed", lambda row: str(row.info.missed), sorts=True, right=True, views="verb"),
        Column("missed", lambda row: str(row.info.missed or ""), 9, sorts=True, views="top"),
        Column("read by", readers_text, 22, gives_way=True),
        Column("id", lambda row: row.info.resource_id, is_id=True),
    ),
    _source,
    _line,
    narrow=("rate", "bytes", "readers", "missed", "age", "read by"),
    nothing="no stream is open",
    caption=lambda total: counted(total, "open stream") if total else "No stream is open.",
    named=lambda row: f"{row.info.server} {row.request}",
    facts=stream_facts,
)


def tables() -> tuple[Table[Any], ...]:
    """Return the tables of the sheet."""
    return (STREAMS,)
