"""What the verbs of `rr-actors` share: options, and printing."""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.cells import cell_len, set_cell_size

from rr_actors.base.errors import NotRunning, RrError, UsageError, shown
from rr_actors.tools.log_lines import printable

_NARROWEST = 80  # columns of a table: a narrower terminal wraps its lines, as cut cells would show only dots
_LEAST = 16  # columns that stay of the column that gives way

StateOption = Annotated[
    Path | None,
    typer.Option(
        "--state", envvar="RR_STATE", metavar="DIR", help="The system's state directory. Default: the one that runs."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="For programs instead of people.")]
WatchOption = Annotated[bool, typer.Option("--watch", "-w", help="Show it again every two seconds, until Ctrl-C.")]
_WATCH_S = 2.0


def shown_again(watch: bool, show: Callable[[], None]) -> None:
    """Show a list; with `watch` again and again, until the system has ended, on a terminal in the same place."""
    show()
    while watch:
        time.sleep(_WATCH_S)
        try:
            if sys.stdout.isatty():
                typer.echo("\x1b[2J\x1b[H", nl=False)
            show()
        except NotRunning:
            say("the system has ended", err=True)
            return


# -- printing: what users write may contain any character, and controls no terminal ----------------------------------


_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}


def seconds_of(text: str, option: str, most_s: float = math.inf) -> float:
    """Return the seconds of a duration that an option has: "90", "0.5s", "10m", "2h" or "1d".

    Raises:
        UsageError: it is none, or longer than `most_s`.
    """
    number, unit = (text[:-1], _UNITS[text[-1]]) if text[-1:] in _UNITS and text else (text, 1.0)
    with contextlib.suppress(ValueError):
        if 0 <= (seconds := float(number) * unit) <= most_s and math.isfinite(seconds):
            return seconds
    limit = "" if most_s == math.inf else f" of at most {most_s:g} s"
    raise UsageError(f"{option}: expected a time{limit} (90s, 10m, 2h), got {shown(text)}")


def say(text: str, *, err: bool = False) -> None:
    """Print a text as one line."""
    typer.echo(printable(text), err=err)


def say_lines(text: str, before: str = "") -> None:
    """Print each line of a text, with the text `before` in front of it."""
    for line in text.splitlines():
        say(before + line)


def say_picture(drawn: str, format: str) -> None:
    """Write a picture on the standard output: an SVG document, as PNG if that is wanted, or text."""
    if format == "png":
        typer.echo(_png(drawn), nl=False)
    else:
        say_lines(drawn)


def _png(picture: str) -> bytes:
    """Convert an SVG document to PNG with the program rsvg-convert, and return it.

    Raises:
        UsageError: the program is not installed.
        RrError: the program failed.
    """
    try:
        made = subprocess.run(["rsvg-convert", "--format", "png"], input=picture.encode(), capture_output=True)
    except OSError as error:
        text = f"PNG: expected the program rsvg-convert, got: {error.strerror}; install it, as by"
        raise UsageError(f"{text} `apt-get install librsvg2-bin`, or take --format svg") from None
    if made.returncode != 0:
        said = made.stderr.decode(errors="replace").strip()
        raise RrError(f"PNG: rsvg-convert ended with {made.returncode}: {said or 'it said nothing'}; take --format svg")
    return made.stdout


def say_json(value: object) -> None:
    """Print a value as one line of JSON. It has null in the place of numbers that JSON has not: NaN and infinity."""
    plain = msgspec.to_builtins(value)
    try:
        line = json.dumps(plain, ensure_ascii=False, allow_nan=False)
    except ValueError:
        known = json.loads(json.dumps(plain), parse_constant=lambda _: None)
        line = json.dumps(known, ensure_ascii=False)
    typer.echo(json_text(line))


def json_text(line: str) -> str:
    """Return a line of JSON in which escapes replace the characters that could control a terminal."""
    if line.isprintable():
        return line
    return "".join(char if char.isprintable() else json.dumps(char)[1:-1] for char in line)


def say_table(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    gives_way: Sequence[str],
    right: Sequence[str] = (),
    wide: bool = False,
    styles: Sequence[str] = (),
) -> None:
    """Print a table as wide as the terminal, but at least 80 columns; without a terminal, as wide as needed.

    Args:
        gives_way: the heads of the columns whose cells are shortened in the middle where the terminal is too narrow,
            in this order.
        right: the heads of the columns of numbers.
        wide: shorten nothing; the terminal wraps the lines.
        styles: Rich's words for the colour of each row, "red" or "dim" say. Without a terminal there are no colours.
    """
    cells = [[printable(cell) for cell in row] for row in (heads, *rows)]
    widths = [max(map(_width, column)) for column in zip(*cells, strict=True)]
    terminal = sys.stdout.isatty() and not wide
    room = max(os.get_terminal_size(sys.stdout.fileno()).columns, _NARROWEST) if terminal else 0
    for yielding in map(heads.index, gives_way if terminal else ()):
        over = sum(widths) + 2 * (len(widths) - 1) - room
        widths[yielding] = max(min(widths[yielding], _LEAST), widths[yielding] - max(over, 0))
        for row in cells:
            row[yielding] = _shortened(row[yielding], widths[yielding])
    for number, row in enumerate(cells):
        line = "  ".join(
            f"{' ' * (width - _width(cell))}{cell}" if head in right else f"{cell}{' ' * (width - _width(cell))}"
            for head, cell, width in zip(heads, row, widths, strict=True)
        ).rstrip()
        style = styles[number - 1] if number and styles else ""
        colour = style if style and style != "dim" else None
        typer.echo(typer.style(line, colour, bold=number == 0 or None, dim=style == "dim" or None))


def _width(text: str) -> int:
    return len(text) if text.isascii() else cell_len(text)


def _shortened(text: str, width: int) -> str:
    """Return a text of at most `width` cells: its beginning and its end."""
    if _width(text) <= width:
        return text
    ahead = width // 2
    return f"{set_cell_size(text, ahead)}…{set_cell_size(text[::-1], width - 1 - ahead)[::-1]}"
