"""The commands of `rr-actors` that record a running system, and draw recordings."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from rr_actors.base.errors import NotFound
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.console.console_client import ConsoleClient, find_console
from rr_actors.system.recording.recordings import Recording, RecordingFile, add, read_recording
from rr_actors.system.recording.timelines import read_timeline
from rr_actors.system.recording.traces import Trace
from rr_actors.tools.cli_commands import JsonOption, StateOption, json_text, say, say_lines
from rr_actors.tools.web.timeline_file import html

app = typer.Typer()

_LISTEN_S = 10.0
_ID = re.compile("[0-9a-f]{1,32}")


@app.command(epilog="Example: rr-actors record crash.jsonl --seconds 30")
def record(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A new file, for `sequence` and rr.read_recording().")],
    seconds: Annotated[
        float | None, typer.Option(min=0.0, max=threading.TIMEOUT_MAX, help="End after so many. Default: at Ctrl-C.")
    ] = None,
    state: StateOption = None,
) -> None:
    """Record the events, exits, callbacks and messages of the system: of its actors and registrars."""
    count = missed = 0
    with ConsoleClient(find_console(state)) as client:
        sink = RecordingFile(file, client.welcome.system, time.time())
        try:
            with _ending(client, seconds), suppress(KeyboardInterrupt):
                for part in client.record():
                    missed += part.dropped
                    count += len(part.entries)
                    sink.write(part.entries, part.dropped)
        finally:
            sink.close()
    lost = f", {missed} missed" if missed else ""
    say(f"recorded {count} entries in {file}{lost}")


@app.command(epilog="Example: rr-actors sequence 01a2085d3f7c --file crash.jsonl > load.mmd")
def sequence(
    of: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="WHAT...",
            help="The id of a query, resource or message, or its beginning; or actors, root/ping. Default: all.",
        ),
    ] = None,
    file: Annotated[Path | None, typer.Option(help="A recording. Default: record the running system now.")] = None,
    seconds: Annotated[
        float, typer.Option(min=0.0, max=threading.TIMEOUT_MAX, help="Without a file: for how long.")
    ] = _LISTEN_S,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw a load, a message, or the messages of actors as a Mermaid sequence diagram; with --json, print entries."""
    recording = _recorded(state, seconds) if file is None else read_recording(file)
    if recording.missed:
        say(f"{recording.missed} entries were missed, and are not in it", err=True)
    trace = _drawn(recording, of or [])
    if as_json:
        for entry in trace.entries:
            typer.echo(json_text(_line(entry)))
    else:
        say_lines(trace.sequence())


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
        say(f"{drawn.missed} entries were missed, and are not in it", err=True)
    typer.echo(drawn.svg() if format == "svg" else html(drawn))


def _drawn(recording: Recording, of: list[str]) -> Trace:
    """Return the trace of one id; or the messages of actors, whose names are tried first."""
    try:
        return recording.messages(*of)
    except NotFound:
        if len(of) != 1 or not _ID.fullmatch(of[0]):
            raise
    return recording.trace(of[0])


def _recorded(state: Path | None, seconds: float) -> Recording:
    with ConsoleClient(find_console(state)) as client:
        recording = Recording(client.welcome.system)
        with _ending(client, seconds), suppress(KeyboardInterrupt):
            for part in client.record():
                add(recording, part.entries, part.dropped)
    return recording


@contextmanager
def _ending(client: ConsoleClient, seconds: float | None) -> Generator[None]:
    """Close the client's connection after so many seconds, which ends the client's iterators."""
    close: Callable[[], None] = client.close
    timer = threading.Timer(seconds or 0.0, close)
    if seconds is not None:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _line(entry: Entry) -> str:
    return msgspec.json.encode(entry, enc_hook=str).decode()
