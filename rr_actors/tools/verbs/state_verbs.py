"""The commands of `rr-actors` that look into a state directory."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from rr_actors.registrar.model.rows import Held, priority_of
from rr_actors.registrar.pages import priority_text
from rr_actors.system.console.console_client import find_console
from rr_actors.tools.cli_commands import JsonOption, StateOption, WatchOption, say, say_table, shown_again
from rr_actors.tools.inspection import Contents, check_state, read_state, readable
from rr_actors.tools.log_lines import printable

app = typer.Typer()

StateDir = Annotated[Path | None, typer.Argument(help="The system's state directory. Default: that of --state.")]


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


@app.command()
def inspect(state_dir: StateDir = None, state_option: StateOption = None, as_json: JsonOption = False) -> None:
    """Show every registrar's resources, the queries on them, and the queries that it holds elsewhere."""
    state = read_state(_found(state_dir, state_option))
    if as_json:
        typer.echo(json.dumps({name: _plain(contents) for name, contents in state.items()}, indent=2))
        return
    for contents in state.values():
        _show(contents)
    _tell_damage(state)


@app.command()
def tree(state_dir: StateDir = None, state_option: StateOption = None, watch: WatchOption = False) -> None:
    """Show each registrar's own queries, and below them the resources that they depend on."""
    found = _found(state_dir, state_option)
    shown_again(watch, lambda: _show_tree(found))


def _show_tree(found: Path) -> None:
    state = read_state(found)
    for name, contents in state.items():
        roots = [held for held in contents.held.values() if not held.parent]
        if roots:
            roots.sort(key=lambda held: held.seq)
            lines = (typer.style(printable(name), bold=True), *_branches(roots, state, _guides()))
            typer.echo("\n".join(lines))
    _tell_damage(state)
    if not any(contents.held or contents.queries for contents in state.values()):
        typer.echo("nobody holds anything")


@app.command()
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


class _Guides(NamedTuple):
    """What a line of a tree begins with: at a branch, at the last branch, and below each of them."""

    branch: str = "├── "
    last: str = "└── "
    beside: str = "│   "
    below: str = "    "


def _guides() -> _Guides:
    """Return the guides that the output can show."""
    drawn = _Guides()
    try:
        "".join(drawn).encode(sys.stdout.encoding or "utf-8")  # an io.StringIO has none
    except UnicodeEncodeError:
        return _Guides("+-- ", "`-- ", "|   ")
    return drawn


def _branches(
    queries: Sequence[Held],
    state: Mapping[str, Contents],
    guides: _Guides,
    before: str = "",
    way: frozenset[str] = frozenset(),
) -> Iterator[str]:
    """Yield a line for each held query and, below it, for those of its resource.

    Args:
        before: what the lines begin with.
        way: the queries above, in case damage made a ring.
    """
    for number, held in enumerate(queries, 1):
        guide, space = (guides.last, guides.below) if number == len(queries) else (guides.branch, guides.beside)
        what = printable(f"{held.registrar}/{held.server}  {readable(held.request)}")
        yield f"{before}{guide}{what}  {typer.style(held.hold, dim=True)} {held.state}"
        provider = state.get(held.registrar)
        query = provider.queries.get(held.id) if provider else None
        if provider and query and held.id not in way:
            below = provider.parts(query.resource_id)
            yield from _branches(below, state, guides, before + space, way | {held.id})


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
