"""The commands of `rr-actors` that read a state directory or run chaos, and their output."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table
from rich.tree import Tree
from typer.core import TyperGroup

from rr_actors.base.errors import UsageError
from rr_actors.registrar.model.rows import Held
from rr_actors.system.console.console_client import find_console
from rr_actors.testing.run import Options
from rr_actors.testing.run import run as run_chaos
from rr_actors.tools.inspection import Contents, check_state, read_state, readable


class _Commands(TyperGroup):
    """The commands. An option before the command is an error that says where options stand."""

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

StateDir = Annotated[Path | None, typer.Argument(help="The system's state directory. Default: that of --state.")]
StateOption = Annotated[
    Path | None,
    typer.Option(
        "--state", envvar="RR_STATE", metavar="DIR", help="The system's state directory. Default: the one that runs."
    ),
]


@app.command()
def version() -> None:
    """Print the version."""
    Console().print(metadata.version("rr-actors"), highlight=False)


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
        typer.echo(f"{name}: cannot be read: {damage}", err=True)
    if damaged:
        raise typer.Exit(1)


@app.command()
def inspect(
    state_dir: StateDir = None,
    state_option: StateOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show every registrar's resources, the queries on them, and the queries that it holds elsewhere."""
    state = read_state(_found(state_dir, state_option))
    if as_json:
        typer.echo(json.dumps({name: _plain(contents) for name, contents in state.items()}, indent=2))
        return
    console = _console()
    for contents in state.values():
        _show(console, contents)
    _tell_damage(state)


@app.command()
def tree(state_dir: StateDir = None, state_option: StateOption = None) -> None:
    """Show each registrar's own queries, and below them the resources that they depend on."""
    state = read_state(_found(state_dir, state_option))
    console = _console()
    holders = {name: [held for held in contents.held.values() if not held.parent] for name, contents in state.items()}
    for name, roots in holders.items():
        if roots:
            shown = Tree(f"[bold]{escape(name)}[/]")
            for held in sorted(roots, key=lambda held: held.seq):
                _grow(shown, held, state)
            console.print(shown)
    _tell_damage(state)
    if not any(contents.held or contents.queries for contents in state.values()):
        typer.echo("nobody holds anything")


@app.command()
def check(state_dir: StateDir = None, state_option: StateOption = None) -> None:
    """Check the catalogs against each other; exit code 1 if they disagree."""
    found = _found(state_dir, state_option)
    violations = check_state(found)
    for violation in violations:
        typer.echo(violation)
    if violations:
        raise typer.Exit(1)
    state = read_state(found)
    queries = sum(len(contents.queries) for contents in state.values())
    typer.echo(f"{len(state)} catalogs, {queries} queries: they agree")


@app.command()
def chaos(
    kills: Annotated[int, typer.Option(help="End after this number of SIGKILLs.")] = Options.kills,
    seconds: Annotated[float | None, typer.Option(help="End after this number of seconds, if that is sooner.")] = None,
    seed: Annotated[int | None, typer.Option(help="The seed of the faults. Default: a new one.")] = None,
    state_dir: Annotated[Path | None, typer.Option(help="Keep the state here. Default: a temporary directory.")] = None,
    report_file: Annotated[Path | None, typer.Option("--json", help="Also write the report to this file.")] = None,
    soak: Annotated[float | None, typer.Option(help="Do no harm: watch this many seconds of load for growth.")] = None,
    churn: Annotated[float | None, typer.Option(help="Of a soak: the mean seconds between replaced managers.")] = None,
    pace: Annotated[float, typer.Option(help="The mean number of seconds between two faults.")] = Options.pace_s,
    patience: Annotated[float, typer.Option(help="Seconds that one fault or one check may take.")] = Options.patience_s,
) -> None:
    """Run a system of its own, kill and harm its processes at random, and check every promise in the end."""
    options = Options.of(
        kills=kills,
        seconds=seconds,
        seed=seed,
        state_dir=state_dir,
        soak_s=soak,
        churn_s=churn,
        pace_s=pace,
        patience_s=patience,
    )
    console = Console(stderr=True)
    if console.is_terminal:
        with console.status("starting") as status:
            report = run_chaos(options, show=lambda line: status.update(escape(line)))
    else:
        report = run_chaos(options, show=typer.echo)
    typer.echo(report.text())
    if report_file is not None:
        report_file.write_text(report.json())
    if not report.passed:
        raise typer.Exit(1)


def _show(console: Console, contents: Contents) -> None:
    console.print(f"[bold]{escape(contents.name)}[/]  [dim]{escape(str(contents.path))}[/]", highlight=False)
    if contents.damage:
        console.print(f"  [red]{escape(contents.damage)}[/]")
    if contents.stored_servers:
        console.print(f"  servers kept by value: {escape(', '.join(sorted(contents.stored_servers)))}")
    if contents.resources:
        console.print(_resources(contents))
    if contents.held:
        console.print(_held(contents))
    if contents.notices:
        console.print(f"  {len(contents.notices)} status notices on their way")
    console.print()


def _resources(contents: Contents) -> Table:
    table = Table(_id("resource"), "server", "request", "response", "phase", "state", "held by")
    for resource in sorted(contents.resources.values(), key=lambda resource: resource.id):
        holders = ", ".join(query.origin for query in contents.holders(resource.id))
        table.add_row(
            resource.id,
            escape(resource.server),
            escape(readable(resource.request)),
            escape(readable(resource.response)),
            resource.phase,
            resource.state,
            escape(holders) or "[dim]nobody[/]",
        )
    return table


def _held(contents: Contents) -> Table:
    table = Table(_id("query"), "at", "request", _id("for resource"), "hold", "state")
    for held in sorted(contents.held.values(), key=lambda held: held.seq):
        table.add_row(
            held.id,
            escape(f"{held.registrar}/{held.server}"),
            escape(readable(held.request)),
            held.parent or "[dim]itself[/]",
            held.hold,
            held.state,
        )
    return table


def _id(header: str) -> Column:
    """Return a column of ids, which is never cut: a part of an id is of no use."""
    return Column(header, overflow="fold", min_width=16)


def _grow(above: Tree, held: Held, state: dict[str, Contents], way: frozenset[str] = frozenset()) -> None:
    """Add a held query and, below it, its resource's queries. `way`: the queries above, in case damage made a ring."""
    what = f"{held.registrar}/{held.server}  {readable(held.request)}"
    branch = above.add(f"{escape(what)}  [dim]{held.hold}[/] {held.state}")
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
                    {"id": q.id, "origin": q.origin, "parent": q.parent} for q in contents.holders(resource.id)
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
            }
            for held in contents.held.values()
        ],
        "stored_servers": sorted(contents.stored_servers),
        "notices": len(contents.notices),
    }
