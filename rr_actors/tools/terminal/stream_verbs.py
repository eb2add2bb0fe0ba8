"""The commands of `rr-actors` that show streams: which there are, how many frames they have, and what is in these."""

from __future__ import annotations

import io
import itertools
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from rr_actors.base.errors import NotFound, RrError, Unavailable, UsageError, did_you_mean, few, shown, text_of
from rr_actors.base.names import short_id, short_ids
from rr_actors.hosting.streams import Source, StreamFrame, StreamReader, StreamRow, Wake
from rr_actors.system.console.console_client import ConsoleClient, find_console
from rr_actors.system.console.console_questions import Find
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.cli_commands import LOOK, JsonOption, StateOption, app, say, say_json, say_table
from rr_actors.tools.explanations import readers_text

_LOOK_S = 1.0  # between two looks at a stream's rate, and at whether its resource is still there
_READER = "rr-actors"


def _bytes_text(row: StreamRow) -> str:
    return f"{row.bytes_s / 2**20:.1f} MiB/s" if row.readers else ""


def _rate_text(row: StreamRow) -> str:
    return f"{row.rate:.1f}/s"


def _age_text(row: StreamRow) -> str:
    if row.age_s is None:
        return "no frame"
    return f"{row.age_s * 1000:.0f} ms" if row.age_s < 1 else ago(row.age_s)


@app.command(rich_help_panel=LOOK, epilog="Example: rr-actors streams cameras/camera")
def streams(
    match: Annotated[str, typer.Argument(help="Only those with this text in their name or resource.")] = "",
    registrar: Annotated[str, typer.Option(help="Only this one's.")] = "",
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the open streams: frames and bytes a second, the age of the newest frame, readers, and what they missed."""
    with ConsoleClient(find_console(state)) as client:
        page = client.streams(registrar, match)
    if as_json:
        say_json([_facts(row) for row in page.rows])
        return
    if not page.rows:
        say("no stream matches" if match or registrar else "no stream is open", err=True)
    else:
        ids = short_ids(row.resource_id for row in page.rows)
        heads = ("stream", "resource", "rate", "bytes", "age", "missed", "read by", "id")
        table = [
            (
                row.name,
                f"{row.server} {row.request}",
                _rate_text(row),
                _bytes_text(row),
                _age_text(row),
                str(row.missed),
                readers_text(row),
                ids[row.resource_id],
            )
            for row in page.rows
        ]
        say_table(heads, table, gives_way=("read by", "resource"), right=("rate", "bytes", "age", "missed"))
    for note in page.notes:
        say(f"not asked: {note}", err=True)


def _facts(row: StreamRow) -> dict[str, Any]:
    return {name: getattr(row, name) for name in row.__struct_fields__} | {"missed": row.missed}


@app.command(
    rich_help_panel=LOOK, epilog="Example: rr-actors stream 'cameras/camera \"front\"' images --save front.png"
)
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
                raise NotFound(f"stream {row.name!r}: its resource was unloaded", id=row.resource_id)
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
    rows = {row.name: row for row in client.streams(match=resource.id).rows}
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
    while client.ask(Find(row.resource_id)).resources:
        found = [one for one in client.streams(match=row.resource_id).rows if one.name == row.name]
        yield found[0] if found else None
        time.sleep(_LOOK_S)
    say(f"stream {row.name!r}: its resource was unloaded", err=True)


def _say_rate(row: StreamRow | None, as_json: bool) -> None:
    if as_json:
        say_json(None if row is None else _facts(row))
    elif row is None:
        say("the stream is not open: its manager is being respawned, or a callback of its resource runs")
    else:
        size = f", {_bytes_text(row)}" if row.readers else ""
        by = f", read by {readers_text(row)}" if row.readers else ", nobody reads it"
        say(f"{_rate_text(row)}{size}, newest {_age_text(row)}{by}")


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
        return not client.ask(Find(row.resource_id)).resources

    source = Source(row.resource_id, _READER, is_over, list, _unwatched, _unwatched)
    with StreamReader(source, row.name, "latest", 1, timeout_s) as reader:
        while True:
            try:
                frame = next(reader, None)
            except TimeoutError as error:
                raise Unavailable(str(error)) from error
            except RrError:
                raise
            except Exception as error:  # of the value's own code
                what = f"stream {row.name!r}: a frame cannot be read here: {text_of(error)}"
                raise Unavailable(f"{what}; its classes must be importable: set PYTHONPATH, say") from error
            if frame is None:
                say(f"stream {row.name!r}: its resource was unloaded", err=True)
                return
            yield frame


def _unwatched(wake: Wake) -> None:
    """Do nothing: no status comes here."""


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
    writers = {".png": _png, ".npy": _npy, ".bin": _raw}
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


_COLOURS = {1: 0, 3: 2, 4: 6}
"""The PNG colour types: grey, red-green-blue, and these with a transparency, by the bytes of a pixel."""


def _png(value: Any) -> bytes:
    """Return the PNG of a picture: height by width bytes of grey, or height by width by 3 or 4 of colour."""
    view = memoryview(value)
    shape = (*(view.shape or ()), 1) if view.ndim == 2 else view.shape or ()
    if view.format not in ("B", "<B") or len(shape) != 3 or shape[2] not in _COLOURS or not all(shape):
        raise ValueError("a picture is an array of unsigned bytes, height by width, or height by width by 3 or 4")
    height, width, depth = shape
    data, row = view.tobytes(), width * depth
    lines = b"".join(b"\0" + data[at : at + row] for at in range(0, height * row, row))
    head = struct.pack(">IIBBBBB", width, height, 8, _COLOURS[depth], 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(lines, 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
