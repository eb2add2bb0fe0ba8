"""The commands of `rr-actors` that show streams: which there are, how many frames they have, and what is in these."""

from __future__ import annotations

import io
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from rr_actors.base.errors import NotFound, UsageError, did_you_mean, few, shown, text_of
from rr_actors.base.names import short_id, short_ids
from rr_actors.streams.stream import Stream, StreamFrame, StreamRow
from rr_actors.system.console.console_client import ConsoleClient, find_console
from rr_actors.system.console.console_questions import Find
from rr_actors.tools.cli_commands import JsonOption, StateOption, say, say_json, say_table
from rr_actors.tools.explanations import age_text, bytes_text, rate_text, readers_text
from rr_actors.tools.terminal.stream_frames import frames_of, png

app = typer.Typer()
_LOOK_S = 1.0  # between two looks at a stream's rate, and at whether its resource is still there


@app.command(epilog="Example: rr-actors streams cameras/camera")
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
        ids = short_ids(row.info.resource_id for row in page.rows)
        heads = ("stream", "resource", "rate", "bytes", "age", "missed", "read by", "id")
        table = [
            (
                row.info.name,
                f"{row.info.server} {row.request}",
                rate_text(row),
                bytes_text(row),
                age_text(row),
                str(row.info.missed),
                readers_text(row),
                ids[row.info.resource_id],
            )
            for row in page.rows
        ]
        say_table(heads, table, gives_way=("read by", "resource"), right=("rate", "bytes", "age", "missed"))
    for note in page.notes:
        say(f"not asked: {note}", err=True)


def _facts(row: StreamRow) -> dict[str, Any]:
    info = row.info
    facts = {"name": info.name, "resource_id": info.resource_id, "server": info.server, "request": row.request}
    figures = {"frames": row.frames, "rate": info.rate_hz, "bytes_s": info.bytes_per_s, "age_s": info.age_s}
    return {**facts, **figures, "readers": row.readers, "missed": info.missed}


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
        say_json(None if row is None else _facts(row))
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
