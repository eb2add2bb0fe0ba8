"""The commands of `rr-actors` that need no running system, with their output: `inspect`, `doctor` and others."""

from __future__ import annotations

import importlib.util
import json
import keyword
import os
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import typer
from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.markup import escape
from rich.tree import Tree
from typer.core import TyperGroup

from rr_actors.base import __version__
from rr_actors.base.checks import needing
from rr_actors.base.errors import NotRunning, UsageError, shown
from rr_actors.registrar.model.rows import Held, priority_of
from rr_actors.registrar.pages import priority_text
from rr_actors.system.console.console_client import find_console
from rr_actors.tools.doctor import examine
from rr_actors.tools.graphs import png
from rr_actors.tools.inspection import Contents, check_state, read_state, readable
from rr_actors.tools.log_lines import printable

LOOK = "Look at a running system"
CHANGE_RESOURCES = "Change its resources"
CHANGE_TREE = "Run, change and stop it"
RECORD = "Record what happens"
LOOK_LATER = "Look into a state directory, whether its system runs or not"
PROJECT = "This machine, and projects"
_GROUPS = (LOOK, CHANGE_RESOURCES, CHANGE_TREE, RECORD, LOOK_LATER, PROJECT)


class _Commands(TyperGroup):
    """The commands, in groups. An option before the command is an error that says where options stand."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        commands: list[Any] = [self.get_command(ctx, name) for name in self.list_commands(ctx)]
        for group in _GROUPS:
            rows = [
                (command.name, command.help.partition("\n\n")[0].partition(". ")[0].rstrip("."))
                for command in commands
                if command.rich_help_panel == group
            ]
            with formatter.section(group):
                formatter.write_dl(rows)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            if type(error).__name__ != "NoSuchOption":  # click's, of which newer versions of typer have a copy
                raise
            order = "a command's options stand after it: rr-actors ps --state DIR"
            raise UsageError(f"{cast('Any', error).message}; {order}") from error


app = typer.Typer(
    name="rr-actors", cls=_Commands, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)
_PIPED_WIDTH = 200
_NARROWEST = 80  # columns of a table: a narrower terminal wraps its lines, as cut cells would show only dots
_LEAST = 16  # columns that stay of the column that gives way
_PIPED = 40  # columns to which it is padded where there is no terminal

StateDir = Annotated[Path | None, typer.Argument(help="The system's state directory. Default: that of --state.")]
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


@app.command(rich_help_panel=PROJECT)
def version() -> None:
    """Print the version."""
    Console().print(__version__, highlight=False)


def _version_wanted(wanted: bool) -> None:
    if wanted:
        version()
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_version_wanted, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """See and drive a running system of rr_actors; look into the state of one that has ended; run one from files.

    A command finds its system by --state DIR (after the command), by RR_STATE, or takes the one that runs.

    Exit codes: 0 done; 1 the answer is no; 2 the call was wrong, or names something that does not exist; 3 no running
    system was reached; 4 the system tried, and could not do it.
    """


def _console() -> Console:
    """Return a console as wide as the terminal, or without a terminal wide enough for every column."""
    return Console() if sys.stdout.isatty() else Console(width=_PIPED_WIDTH)


def _found(state_dir: Path | None, option: Path | None) -> Path:
    """Return the state directory that a command is about: the one that it names, or that of the system that runs.

    Raises:
        NotRunning: no directory is named, and no system runs.
        UsageError: no directory is named, and several systems run.
    """
    return state_dir or option or find_console().parent.parent


def _tell_damage(state: Mapping[str, Contents]) -> None:
    """Print the catalogs that could not be read, and end with exit code 1 if there are any.

    Raises:
        typer.Exit: there are some.
    """
    damaged = {name: contents.damage for name, contents in state.items() if contents.damage}
    for name, damage in damaged.items():
        say(f"{name}: cannot be read: {damage}", err=True)
    if damaged:
        raise typer.Exit(1)


@app.command(rich_help_panel=LOOK_LATER)
def inspect(state_dir: StateDir = None, state_option: StateOption = None, as_json: JsonOption = False) -> None:
    """Show every registrar's resources, the queries on them, and the queries that it holds elsewhere."""
    state = read_state(_found(state_dir, state_option))
    if as_json:
        typer.echo(json.dumps({name: _plain(contents) for name, contents in state.items()}, indent=2))
        return
    for contents in state.values():
        _show(contents)
    _tell_damage(state)


@app.command(rich_help_panel=LOOK_LATER)
def tree(state_dir: StateDir = None, state_option: StateOption = None, watch: WatchOption = False) -> None:
    """Show each registrar's own queries, and below them the resources that they depend on."""
    found = _found(state_dir, state_option)
    shown_again(watch, lambda: _show_tree(found))


def _show_tree(found: Path) -> None:
    state = read_state(found)
    console = _console()
    holders = {name: [held for held in contents.held.values() if not held.parent] for name, contents in state.items()}
    for name, roots in holders.items():
        if roots:
            shown = Tree(f"[bold]{_text(name)}[/]")
            for held in sorted(roots, key=lambda held: held.seq):
                _grow(shown, held, state)
            console.print(shown)
    _tell_damage(state)
    if not any(contents.held or contents.queries for contents in state.values()):
        typer.echo("nobody holds anything")


@app.command(rich_help_panel=LOOK_LATER)
def check(state_dir: StateDir = None, state_option: StateOption = None) -> None:
    """Check the catalogs against each other; exit code 1 if they disagree."""
    found = _found(state_dir, state_option)
    violations = check_state(found)
    for violation in violations:
        say(violation)
    if violations:
        raise typer.Exit(1)
    state = read_state(found)
    queries = sum(len(contents.queries) for contents in state.values())
    typer.echo(f"{len(state)} catalogs, {queries} queries: they agree")


@app.command(rich_help_panel=PROJECT, epilog="Example: rr-actors doctor --state /var/lib/robot")
def doctor(
    state: Annotated[
        Path, typer.Option("--state", envvar="RR_STATE", metavar="DIR", help="Where a system's state is, or will be.")
    ] = Path("rr_state"),
    as_json: JsonOption = False,
) -> None:
    """Say what this machine lacks or limits of what a system needs, each with what to do; exit code 1 if it lacks any.

    It starts a small system beside the state, and stops it.
    """
    findings = examine(state)
    if as_json:
        typer.echo(json.dumps(msgspec.to_builtins(findings)))
    else:
        for one in findings:
            say(f"{one.level:7}{one.what:24}{one.found}")
            if one.todo:
                say(f"{'':7}-> {one.todo}")
    if any(one.level == "lacks" for one in findings):
        raise typer.Exit(1)


_TEMPLATES = Path(__file__).parent / "new_project"


@app.command(rich_help_panel=PROJECT, epilog="Example: rr-actors new robot")
def new(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="The project's: lower-case letters, digits and single hyphens.")
    ],
) -> None:
    """Make a small project: two managers, an application, a test that kills one, a systemd unit, a Dockerfile."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise UsageError(f"NAME: expected lower-case letters, digits and single hyphens, got {shown(name)}")
    if keyword.iskeyword(module) or importlib.util.find_spec(module) is not None:
        raise UsageError(f"NAME: expected no word of Python and no name of an installed module, got {shown(name)}")
    Path(name).mkdir()
    for template in sorted(_TEMPLATES.rglob("*.txt")):
        path, text = (
            text.replace("_NAME_", name).replace("_MODULE_", module)
            for text in (str(template.relative_to(_TEMPLATES)), template.read_text())
        )
        target = Path(name, path.removesuffix(".txt"))
        target.parent.mkdir(exist_ok=True)
        target.write_text(text)
    typer.echo(f"made {name}: see {name}/README.md, or: cd {name}; python -m pytest; python -m {module}")


@app.command(rich_help_panel=PROJECT, epilog="Example: rr-actors import-temoto components.yaml pipes.yaml > pipes.toml")
def import_temoto(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE.yaml...", help="A components.yaml and a pipes.yaml, or several.")
    ],
) -> None:
    """Print the files of a temoto_component_manager as one TOML file for the manager Pipes."""
    with needing("import-temoto", "temoto"):
        from rr_actors.managers.pipes import temoto_files

    say_lines(temoto_files.import_temoto(files))


@app.command(
    rich_help_panel=PROJECT,
    add_help_option=False,
    context_settings={"ignore_unknown_options": True, "allow_extra_args": True},
)
def chaos(context: typer.Context) -> None:
    """Run a system of its own, kill and harm its processes at random, and check every promise in the end."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-P", "-m", "rr_actors.testing", *context.args])


def _show(contents: Contents) -> None:
    typer.echo(f"{typer.style(printable(contents.name), bold=True)}  {printable(str(contents.path))}")
    if contents.damage:
        say(f"  {contents.damage}")
    if contents.stored_servers:
        say(f"  servers kept by value: {', '.join(sorted(contents.stored_servers))}")
    if contents.resources:
        _say_resources(contents)
    if contents.held:
        _say_held(contents)
    if contents.notices:
        typer.echo(f"  {len(contents.notices)} status notices on their way")
    typer.echo()


def _say_resources(contents: Contents) -> None:
    heads = ("resource", "server", "request", "response", "phase", "state", "held by")
    rows = [
        (
            resource.id,
            resource.server,
            readable(resource.request),
            readable(resource.response),
            resource.phase,
            resource.state,
            ", ".join(query.origin for query in contents.holders(resource.id)) or "nobody",
        )
        for resource in sorted(contents.resources.values(), key=lambda resource: resource.id)
    ]
    say_table(heads, rows, gives_way=("response", "request", "held by"))


def _say_held(contents: Contents) -> None:
    heads = ("query", "at", "request", "for resource", "hold", "state", "priority")
    rows = [
        (
            held.id,
            f"{held.registrar}/{held.server}",
            readable(held.request),
            held.parent or "itself",
            held.hold,
            held.state,
            priority_text(priority_of(held.priority)),
        )
        for held in sorted(contents.held.values(), key=lambda held: held.seq)
    ]
    say_table(heads, rows, gives_way=("request",), right=("priority",))


def _text(text: str) -> str:
    return escape(printable(text))


def _grow(above: Tree, held: Held, state: dict[str, Contents], way: frozenset[str] = frozenset()) -> None:
    """Add a held query and, below it, its resource's queries. `way`: the queries above, in case damage made a ring."""
    what = f"{held.registrar}/{held.server}  {readable(held.request)}"
    branch = above.add(f"{_text(what)}  [dim]{held.hold}[/] {held.state}")
    provider = state.get(held.registrar)
    query = provider.queries.get(held.id) if provider else None
    if provider and query and held.id not in way:
        for part in provider.parts(query.resource_id):
            _grow(branch, part, state, way | {held.id})


def _plain(contents: Contents) -> dict[str, Any]:
    return {
        "path": str(contents.path),
        "damage": contents.damage,
        "resources": [
            {
                "id": resource.id,
                "server": resource.server,
                "request": readable(resource.request, 10_000),
                "response": readable(resource.response, 10_000),
                "phase": resource.phase,
                "state": resource.state,
                "message": resource.message,
                "queries": [
                    {"id": q.id, "origin": q.origin, "parent": q.parent, "priority": priority_of(q.priority)}
                    for q in contents.holders(resource.id)
                ],
                "depends_on": [part.id for part in contents.parts(resource.id)],
            }
            for resource in contents.resources.values()
        ],
        "held": [
            {
                "id": held.id,
                "registrar": held.registrar,
                "server": held.server,
                "request": readable(held.request, 10_000),
                "parent": held.parent,
                "hold": held.hold,
                "state": held.state,
                "priority": priority_of(held.priority),
            }
            for held in contents.held.values()
        ],
        "stored_servers": sorted(contents.stored_servers),
        "notices": len(contents.notices),
    }


# -- printing: what users write may contain any character, and controls no terminal ----------------------------------


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
        typer.echo(png(drawn), nl=False)
    else:
        say_lines(drawn)


def say_json(value: object) -> None:
    """Print a value as one line of JSON."""
    typer.echo(json_text(json.dumps(msgspec.to_builtins(value), ensure_ascii=False)))


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
) -> None:
    """Print a table as wide as the terminal, but at least 80 columns; without a terminal, as wide as needed.

    Args:
        gives_way: the heads of the columns whose cells are shortened in the middle where the terminal is too narrow,
            in this order.
        right: the heads of the columns of numbers.
        wide: shorten nothing; the terminal wraps the lines.
    """
    cells = [[printable(cell) for cell in row] for row in (heads, *rows)]
    widths = [max(map(_width, column)) for column in zip(*cells, strict=True)]
    terminal = sys.stdout.isatty() and not wide
    room = max(os.get_terminal_size(sys.stdout.fileno()).columns, _NARROWEST) if terminal else 0
    for yielding in map(heads.index, gives_way):
        least = min(widths[yielding], _LEAST if terminal else _PIPED)
        over = sum(widths) + 2 * (len(widths) - 1) - room
        widths[yielding] = max(least, widths[yielding] - max(over, 0))
        if terminal:
            for row in cells:
                row[yielding] = _shortened(row[yielding], widths[yielding])
    for number, row in enumerate(cells):
        line = "  ".join(
            f"{' ' * (width - _width(cell))}{cell}" if head in right else f"{cell}{' ' * (width - _width(cell))}"
            for head, cell, width in zip(heads, row, widths, strict=True)
        ).rstrip()
        typer.echo(typer.style(line, bold=True) if number == 0 else line)


def _width(text: str) -> int:
    return len(text) if text.isascii() else cell_len(text)


def _shortened(text: str, width: int) -> str:
    """Return a text of at most `width` cells: its beginning and its end."""
    if _width(text) <= width:
        return text
    ahead = width // 2
    return f"{set_cell_size(text, ahead)}…{set_cell_size(text[::-1], width - 1 - ahead)[::-1]}"
