"""The commands of `rr-actors` that record a running system, draw it or a recording, and show its logs and streams."""

from __future__ import annotations

import io
import itertools
import re
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
import typer

from rr_actors.base.errors import NotFound, NotRunning, RrError, UsageError, counted, did_you_mean, few, shown, text_of
from rr_actors.base.names import short_id
from rr_actors.base.values.canonical import encode
from rr_actors.hosting.forwarded_logs import LogLine
from rr_actors.registrar.model.recorded import Entry
from rr_actors.streams.stream import Stream, StreamFrame, StreamRow
from rr_actors.streams.stream_file import StreamHeader, StreamWriter
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_connection import ConsoleConnection, find_console, read_pages
from rr_actors.system.console.console_questions import Find, ListChildren, ListResources, ReadResponse
from rr_actors.system.recording.recordings import Recording, RecordingFile, add, present_entries, read_recording
from rr_actors.system.recording.stream_recordings import LIMIT_BYTES
from rr_actors.system.recording.timelines import read_timeline
from rr_actors.system.recording.traces import Beginning, Trace, beginnings_of
from rr_actors.tools import graphs
from rr_actors.tools.cli_commands import (
    JsonOption,
    StateOption,
    json_text,
    say,
    say_json,
    say_lines,
    say_picture,
    say_table,
)
from rr_actors.tools.explanations import age_text, bytes_text, rate_text, readers_text
from rr_actors.tools.tables.stream_table import stream_facts
from rr_actors.tools.terminal.child_logs import LogText, events_of_child, log_of, new_lines, output_of
from rr_actors.tools.terminal.stream_frames import frames_of, png
from rr_actors.tools.verbs.console_options import SHOWN, ChildArgument, Limit, Timeout, connection_of
from rr_actors.tools.web.timeline_file import html

app = typer.Typer()

_LISTEN_S = 10.0
_PRESENT = 10_000  # resources that a recording has from its beginning on
_BEGIN_S = 5.0  # for an answer about what is there
_ID = re.compile("[0-9a-f]{1,32}")
_SUFFIX = ".jsonl"  # of the name of a file that may be missing


@app.command(epilog="Example: rr-actors record crash.jsonl --seconds 30")
def record(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A new file, for `trace`, `sequence` and rr.read_recording().")
    ],
    seconds: Annotated[
        float | None, typer.Option(min=0.0, max=threading.TIMEOUT_MAX, help="End after this time. Default: at Ctrl-C.")
    ] = None,
    decisions: Annotated[
        bool, typer.Option("--decisions", help="Also all that registrars decide, for `replay`. Loads take longer.")
    ] = False,
    state: StateOption = None,
) -> None:
    """Record the events, exits, callbacks and messages of the system: of its actors and registrars."""
    count = missed = 0
    with ConsoleConnection(find_console(state)) as connection:
        sink = RecordingFile(file, connection.welcome.system, time.time())
        try:
            with _ending(connection, seconds), suppress(KeyboardInterrupt):
                parts = connection.record(decisions=decisions)
                sink.write(_present(state))
                for part in parts:
                    missed += part.dropped
                    count += len(part.entries)
                    sink.write(part.entries, part.dropped)
        finally:
            sink.close()
    lost = f", {missed} missed" if missed else ""
    say(f"recorded {counted(count, 'entry')} in {file}{lost}")


def _present(state: Path | None) -> list[Entry]:
    """Return what is there now, by a connection of its own: that of the recording has no other use.

    A system that hangs is recorded, too: then less is known of its beginning.
    """
    children, pages, notes = list[c.ChildRow](), list[c.Resources](), list[str]()
    try:
        with ConsoleConnection(find_console(state)) as connection:
            ask = partial(connection.ask, timeout_s=_BEGIN_S)
            children += [row for page in read_pages(ask, ListChildren()) for row in page.rows]
            pages += read_pages(ask, ListResources(), _PRESENT)
    except RrError as error:
        notes.append(text_of(error))
    resources = [row for page in pages for row in page.rows]
    notes += dict.fromkeys(note for page in pages for note in page.notes)
    left_out = max((page.total for page in pages), default=0) - len(resources)
    rows = map(msgspec.structs.asdict, children)
    return present_entries(rows, resources, max(0, left_out), notes, time.time())


_What = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[FILE] [WHAT]...",
        help="A recording (else the running system is recorded now), and of it: a name or a server; the id of a query, "
        "resource or message, or its beginning; or actors, root/ping. Default: all.",
    ),
]
_Seconds = Annotated[
    float, typer.Option(min=0.0, max=threading.TIMEOUT_MAX, help="Without a file: record for this time.")
]


@app.command(epilog="Example: rr-actors sequence crash.jsonl 'cameras/camera \"front\"' > load.mmd")
def sequence(what: _What = None, seconds: _Seconds = _LISTEN_S, state: StateOption = None) -> None:
    """Draw loads, a message, or the messages of actors as a Mermaid sequence diagram."""
    recording, of = _recorded(what or [], state, seconds)
    say_lines(_drawn(recording, of).sequence())


@app.command(epilog="Example: rr-actors trace crash.jsonl 'cameras/camera \"front\"'")
def trace(
    what: _What = None, seconds: _Seconds = _LISTEN_S, state: StateOption = None, as_json: JsonOption = False
) -> None:
    """List the loads and messages that a recording has; of a name, id or actor, show what happened, a line each.

    What a callback loads, or a handler sends, is not listed: it is in the trace of what it is for.
    """
    recording, of = _recorded(what or [], state, seconds)
    if of:
        found = _drawn(recording, of)
        for entry in found.entries if as_json else ():
            typer.echo(json_text(_line(entry)))
        if not as_json:
            say_lines(str(found))
        return
    beginnings = beginnings_of(recording.entries())
    if as_json:
        say_json(beginnings)
    elif not beginnings:
        say("nothing was loaded or sent while it was recorded", err=True)
    else:
        say_table(_HEADS, [_row(one) for one in beginnings], gives_way=("what",), right=("took",))


_HEADS = ("time", "id", "by", "took", "what")


def _row(one: Beginning) -> tuple[str, ...]:
    took = "" if one.took_s is None else f"{one.took_s * 1000:.1f} ms"
    what = f"{one.what}: {one.error}" if one.error else one.what
    return time.strftime("%H:%M:%S", time.localtime(one.at)), one.id, one.by, took, what


@app.command(epilog="Example: rr-actors timeline crash.jsonl > crash.svg")
def timeline(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording, or the history.jsonl of a state directory.")
    ],
    format: Annotated[
        Literal["svg", "html"], typer.Option(help="html: one file, in which the picture is zoomed and moved.")
    ] = "svg",
) -> None:
    """Draw what happened: a lane for each child, a bar for each life, marks for events and their reasons."""
    drawn = read_timeline(file)
    if drawn.missed:
        say(f"the recording lacks {counted(drawn.missed, 'entry')}: its reader was too slow", err=True)
    typer.echo(drawn.svg() if format == "svg" else html(drawn))


def _drawn(recording: Recording, of: list[str]) -> Trace:
    """Return the trace of actors, whose names are tried first; or of one name or id."""
    try:
        return recording.messages(*of)
    except NotFound:
        if len(of) != 1 or not (_ID.fullmatch(of[0]) or "/" in of[0]):
            raise
    return recording.trace(of[0])


def _recorded(what: list[str], state: Path | None, seconds: float) -> tuple[Recording, list[str]]:
    """Return the recording of a file if the first word names one, else of the running system; and the other words."""
    if what and (what[0].endswith(_SUFFIX) or Path(what[0]).is_file()):
        recording, what = read_recording(what[0]), what[1:]
    else:
        with ConsoleConnection(find_console(state)) as connection:
            recording = Recording(connection.welcome.system)
            with _ending(connection, seconds), suppress(KeyboardInterrupt):
                for part in connection.record():
                    add(recording, part.entries, part.dropped)
    if recording.missed:
        say(f"the recording lacks {counted(recording.missed, 'entry')}: its reader was too slow", err=True)
    return recording, what


@contextmanager
def _ending(connection: ConsoleConnection, seconds: float | None) -> Generator[None]:
    """Close the connection after so many seconds, which ends its iterators."""
    close: Callable[[], None] = connection.close
    timer = threading.Timer(seconds or 0.0, close)
    if seconds is not None:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _line(entry: Entry) -> str:
    return msgspec.json.encode(entry, enc_hook=str).decode()


@app.command(epilog="Example: rr-actors graph --of dependencies --format svg > system.svg")
def graph(
    what: Annotated[
        Literal["check", "show", "run", "change"] | None,
        typer.Argument(help="Without it the system is drawn. With it, GRAPH is a graph of actions."),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Argument(metavar="[GRAPH]", help="A JSON file; of run and change also a name in the manager's folder."),
    ] = None,
    id: Annotated[str, typer.Argument(metavar="[ID]", help="Of `change`: the resource of a graph that runs.")] = "",
    format: Annotated[
        Literal["mermaid", "dot", "svg", "png"],
        typer.Option("--format", help="dot is for Graphviz; png needs the program rsvg-convert."),
    ] = "mermaid",
    of: Annotated[Literal["tree", "dependencies", "both"], typer.Option("--of", help="What to draw.")] = "both",
    limit: Limit = SHOWN,
    inputs: Annotated[str, typer.Option(metavar="JSON", help="Of `run`: what the first actions are given.")] = "{}",
    start: Annotated[str, typer.Option("--from", metavar="ACTION", help="Of `change`: what runs then.")] = "",
    timeout_s: Timeout = 3600.0,
    state: StateOption = None,
) -> None:
    """Draw the tree, and the resources with their holders: as SVG or PNG, or as text for Mermaid or Graphviz.

    With `check`, `show` or `run` and GRAPH: check a graph of actions, draw it, or have the child `actions` run it. With
    `change`, GRAPH and ID: have a graph that runs go on as another one.
    """
    if format == "png" and sys.stdout.isatty():
        raise UsageError("--format png: expected a file, got a terminal: rr-actors graph --format png > graph.png")
    if what is not None:
        if file is None:
            raise UsageError(f"graph {what}: expected a file with a graph of actions, got none")
        from rr_actors.tools.terminal import action_graphs  # the managers, which the other verbs do without

        if what == "check":
            action_graphs.check(file)
        elif what == "show":
            action_graphs.show(file, format)
        elif what == "change":
            action_graphs.change(file, id, state, start)
        else:
            action_graphs.run(file, state, inputs, timeout_s)
        return
    with connection_of(state) as connection:
        rows = connection.children().rows
        page = c.Resources(0, []) if of == "tree" else connection.resources(limit=limit)
    draw = {"mermaid": graphs.mermaid, "dot": graphs.dot, "svg": graphs.svg, "png": graphs.svg}[format]
    say_picture(draw(rows, page.rows, of), format)
    if page.total > len(page.rows):
        say(f"left out: {counted(page.total - len(page.rows), 'resource')}; raise --limit", err=True)


@app.command(epilog="Example: rr-actors logs cameras --previous --lines 20")
def logs(
    child: ChildArgument,
    lines: Annotated[
        int, typer.Option("--lines", "-n", min=1, help="Show this many of the newest lines.")
    ] = c.PAGE_LIMIT,
    previous: Annotated[
        bool, typer.Option("--previous", "-p", help="Only those of the process before the one that runs.")
    ] = False,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with new lines, until Ctrl-C.")] = False,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the last log lines of a child, also of the processes that it had before; or the output of a program.

    The system keeps 500 lines of each child in memory, and at most 256 KiB of text. An external program is named by its
    resource; its output is in a file.
    """
    if follow and previous:
        raise UsageError("--previous: expected no --follow with it, as a process that has ended logs no more")
    with connection_of(state) as connection:
        try:
            log = log_of(connection, child, lines, previous=previous)
        except NotFound:
            if (output := output_of(connection, child, lines)) is None:
                raise
            if follow or previous:
                raise UsageError(f"{child}: expected a child for --follow and --previous, got a program") from None
            say_json(output) if as_json else say_lines("\n".join(output))
            return
        text = LogText(log.path, [] if as_json else events_of_child(connection, log.path))
        _say_log(log.path, log.lines, text, as_json)
        if not log.lines:
            whose = f"{log.path}, of the process before" if previous else log.path
            say(f"no log lines of {whose}{f': {log.note}' if log.note else ''}", err=True)
        if not follow:
            if not as_json:
                say_lines("\n".join(text.end()))
            return
        with suppress(NotRunning):
            for new in new_lines(connection, log.path, log.lines[-1].seq if log.lines else 0):
                _say_log(log.path, new, text, as_json)
    say("the system has ended", err=True)


def _say_log(path: str, lines: list[LogLine], text: LogText, as_json: bool) -> None:
    if as_json:
        for line in lines:
            say_json({"path": path, **msgspec.structs.asdict(line)})
    else:
        for one in text.of(lines):
            say(one)


# -- a stream ----------------------------------------------------------------------------------------------------------

_LOOK_S = 1.0  # between two looks at a stream's rate, and at whether its resource is still there


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
    record_file: Annotated[
        Path | None,
        typer.Option("--record", metavar="FILE", help="Read the stream into a new file, for rr.read_stream()."),
    ] = None,
    limit: Annotated[
        int, typer.Option("--limit-bytes", min=1, help="With --record: the most that the file may have.")
    ] = LIMIT_BYTES,
    count: Annotated[
        int | None, typer.Option(min=1, help="End after this many lines or frames. Default: at Ctrl-C.")
    ] = None,
    timeout_s: Annotated[
        float, typer.Option("--timeout", metavar="SECONDS", min=0.0, max=86_400.0, help="The longest wait for a frame.")
    ] = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show a stream's rate; or read it as one reader more, and show its frames, save one, or record them.

    Without an option: --rate. To read imports the classes of the values.
    """
    if rate + echo + (save is not None) + (record_file is not None) > 1:
        raise UsageError("stream: expected one of --rate, --echo, --save FILE and --record FILE, got several")
    write = None if save is None else _writer(save)
    with ConsoleConnection(find_console(state)) as connection:
        row = _found(connection, id, name)
        if write is not None and save is not None:
            frame = next(_frames(connection, row, timeout_s), None)
            if frame is None:
                raise NotFound(f"stream {row.info.name!r}: its resource was unloaded", id=row.info.resource_id)
            _save(save, write, frame)
            say(f"saved frame {frame.number} in {save}")
        elif record_file is not None:
            _record(connection, row, record_file, limit, itertools.islice(_frames(connection, row, timeout_s), count))
        elif echo:
            for frame in itertools.islice(_frames(connection, row, timeout_s), count):
                _say_frame(frame, as_json)
        else:
            for one in itertools.islice(_looks(connection, row), count):
                _say_rate(one, as_json)


def _found(connection: ConsoleConnection, id: str, name: str) -> StreamRow:
    """Return the stream of the resource of this id or name.

    Raises:
        NotFound: there is none.
        UsageError: there are several.
    """
    resources = connection.ask(Find(id)).resources
    if not resources:
        raise UsageError(f"{shown(id)}: no resource has this id; rr-actors streams lists the streams that there are")
    if len(resources) > 1:
        several = few(f"{row.name} ({short_id(row.id)})" for row in resources)
        raise UsageError(f"{shown(id)}: several resources have this in their ids: {several}; give more of the id")
    (resource,) = resources
    rows = {row.info.name: row for row in connection.streams(match=resource.id).rows}
    names = few(map(repr, rows)) or "none"
    if name and name not in rows:
        raise UsageError(f"{resource.name} has no stream {shown(name)}; it has: {names}{did_you_mean(name, rows)}")
    if not rows:
        raise UsageError(f"{resource.name} has no stream that is open")
    if not name and len(rows) > 1:
        raise UsageError(f"{resource.name} has several streams: give the name of one after its id, of {names}")
    return rows[name or next(iter(rows))]


# -- its rate --------------------------------------------------------------------------------------------------------


def _looks(connection: ConsoleConnection, row: StreamRow) -> Iterator[StreamRow | None]:
    """Yield the stream's row each second; None while it is not open. It ends when the resource is gone."""
    while connection.ask(Find(row.info.resource_id)).resources:
        found = [one for one in connection.streams(match=row.info.resource_id).rows if one.info.name == row.info.name]
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


def _frames(connection: ConsoleConnection, row: StreamRow, timeout_s: float) -> Iterator[StreamFrame]:
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
        return not connection.ask(Find(row.info.resource_id)).resources

    yield from frames_of(Stream(row.info.resource_id, row.info.name), is_over, timeout_s)
    say(f"stream {row.info.name!r}: its resource was unloaded", err=True)


def _record(
    connection: ConsoleConnection, row: StreamRow, file: Path, limit: int, frames: Iterator[StreamFrame]
) -> None:
    """Write the frames into a new file, as they come."""
    response = connection.ask(ReadResponse(row.info.resource_id, row.info.server.partition("/")[0])).text
    writer = StreamWriter(file, _header(row, response), limit)
    written = missed = 0
    try:
        with suppress(KeyboardInterrupt):
            for frame in frames:
                if not writer.write(frame):
                    say(f"{file} has reached its limit of {limit} bytes", err=True)
                    break
                written += 1
                missed += frame.missed
    finally:
        writer.close()
    lost = f", {missed} missed" if missed else ""
    say(f"recorded {counted(written, 'frame')} in {file}{lost}")


def _header(row: StreamRow, response: str) -> StreamHeader:
    """Return what is known of a stream from outside: requests and responses as JSON has them."""
    info = row.info
    return StreamHeader(
        info.name, info.resource_id, info.server, _encoded(row.request), _encoded(response), time.time()
    )


def _encoded(text: str) -> bytes | None:
    """Return the canonical bytes of a value that is shown as JSON; None if it is cut."""
    try:
        return encode(msgspec.json.decode(text))
    except msgspec.DecodeError:
        return None


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
