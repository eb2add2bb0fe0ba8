"""The commands of `rr-actors` that look into a state directory, and into a recording."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import typer

from rr_actors.base.errors import UsageError, counted, shown
from rr_actors.registrar.model.rows import Held, priority_of
from rr_actors.registrar.pages import priority_text
from rr_actors.system.console.console_connection import find_console
from rr_actors.system.rewound.decision_texts import facts_of, step_lines
from rr_actors.system.rewound.replaying import replay as replay_of
from rr_actors.system.rewound.rewind_times import time_meant
from rr_actors.system.rewound.rewinding import Rewound
from rr_actors.system.rewound.rewinding import rewind as rewound_of
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
from rr_actors.tools.inspection import Contents, check_state, read_state, readable
from rr_actors.tools.log_lines import printable
from rr_actors.tools.tables import decision_tables as decided
from rr_actors.tools.tables import moment_tables as then

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
    typer.echo(f"{counted(len(state), 'catalog')}, {counted(queries, 'query')}: no contradiction")


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
        typer.echo(f"  {counted(len(contents.notices), 'status notice')} not delivered yet")
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


# -- a recording -----------------------------------------------------------------------------------------------------


@app.command(epilog="Example: rr-actors rewind crash.jsonl --when 'cameras ERROR'")
def rewind(
    what: Annotated[
        Path,
        typer.Argument(metavar="RECORDING|STATE_DIR", help="A file of `record`, a state directory, or its history."),
    ],
    at: Annotated[
        str | None, typer.Option(metavar="TIME", help="12:46:55.020; or +12.5s from the beginning, -3m before the end.")
    ] = None,
    when: Annotated[
        str | None,
        typer.Option(metavar="WHAT STATE", help="When it became so: 'cameras ERROR', 'root/maps restarting'."),
    ] = None,
    start: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="Show what is different since then.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="With --from: until then. Default: the end.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show the tree and the resources as they were at any moment of a recording; in a terminal, step by step.

    In a terminal, arrows step back and forward, and ? shows all keys. With an option, or without a terminal, it prints
    the moment at a time, or the last one; when something came into a state; or what is different between two times.
    """
    is_between = start is not None or end is not None
    asked = (at is not None) + (when is not None) + is_between
    if asked > 1:
        raise UsageError("rewind: expected one of --at, --when, and --from with --to, got several")
    rewound = rewound_of(what)
    if not (asked or as_json) and all(one.isatty() for one in (sys.stdin, sys.stdout)):
        from rr_actors.tools.terminal import rewind_screen  # textual, which the other verbs do without

        rewind_screen.watch(rewound)
        return
    for caveat in then.caveats(rewound):
        say(caveat, err=True)
    if when is not None:
        _say_when(rewound, when, as_json)
    elif is_between:
        _say_between(rewound, "start" if start is None else start, "end" if end is None else end, as_json)
    else:
        _say_moment(rewound, time_meant("end" if at is None else at, rewound.since, rewound.until), as_json)


@app.command(epilog="Example: rr-actors replay fault.jsonl cameras --step 12")
def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A file of `record --decisions`.")],
    registrar: Annotated[str, typer.Argument(help="List the decisions of this registrar, a line each.")] = "",
    step: Annotated[int | None, typer.Option("--step", "-n", help="Show all of one decision.")] = None,
    different: Annotated[
        bool, typer.Option("--different", help="Show all of each decision that today's code decides in another way.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Decide again what registrars decided in a recording; exit code 1 if today's code decides in another way.

    Without REGISTRAR it counts the decisions of each. With one, it lists them: what was decided, the rows that this
    changed, and what followed. Nothing of the system is started, and no callback runs.
    """
    if step is not None and not registrar:
        raise UsageError("replay: expected the name of a registrar before --step: rr-actors replay FILE cameras -n 12")
    if step is not None and different:
        raise UsageError("replay: expected one of --step and --different, got both")
    found = replay_of(file)
    steps = found.of(registrar) if registrar else [one for ones in found.steps.values() for one in ones]
    if step is not None:
        steps = [found.step(registrar, step)]
    elif different:
        steps = [one for one in steps if one.differences]
    if as_json:
        for one in steps:
            say_json(facts_of(one))
    else:
        for caveat in decided.caveats_of(found):
            say(caveat, err=True)
        if step is not None or different:
            say_lines("\n\n".join("\n".join(step_lines(one)) for one in steps))
        elif registrar:
            rows = [decided.step_cells(one) for one in steps]
            styles = [decided.style_of_step(one) for one in steps]
            say_table(
                decided.STEP_HEADS, rows, gives_way=("effects", "changes", "what"), right=("step",), styles=styles
            )
        else:
            rows = [decided.registrar_cells(name, ones) for name, ones in found.steps.items()]
            say_table(decided.REGISTRAR_HEADS, rows, gives_way=("registrar",), right=decided.REGISTRAR_HEADS[3:])
    if any(one.differences for one in steps):
        raise typer.Exit(1)


def _number(rewound: Rewound, text: str, option: str) -> int:
    return rewound.number_at(time_meant(text, rewound.since, rewound.until, option))


def _say_moment(rewound: Rewound, at: float, as_json: bool) -> None:
    number = rewound.number_at(at)
    moment = rewound.moment(number)
    if as_json:
        say_json(then.facts_of(rewound, number, moment, at))
        return
    say(then.headline(rewound, number, at))
    tree, listed = moment.tree, moment.listed
    heads, styles = then.CHILD_HEADS, then.styles_of(tree)
    rows = [then.child_cells(child) for child in tree]
    say_table(heads, rows, gives_way=("why",), right=("pid", "restarts"), styles=styles)
    if listed:
        say("")
        rows = [then.resource_cells(one) for one in listed]
        say_table(then.RESOURCE_HEADS, rows, gives_way=("message", "resource"), styles=then.styles_of(listed))


def _say_when(rewound: Rewound, when: str, as_json: bool) -> None:
    name, _, state = when.strip().rpartition(" ")
    if not name:
        raise UsageError(f"--when: expected a name and a state, such as 'cameras ERROR', got {shown(when)}")
    found = rewound.when(name.strip(), state)
    if as_json:
        say_json([{"step": step.number, **msgspec.to_builtins(change)} for step, change in found])
        return
    rows = [(str(step.number), *then.change_cells(change)) for step, change in found]
    say_table(("step", *then.CHANGE_HEADS), rows, gives_way=("why", "what"), right=("step",))


def _say_between(rewound: Rewound, start: str, end: str, as_json: bool) -> None:
    first, last = _number(rewound, start, "--from"), _number(rewound, end, "--to")
    if first > last:
        raise UsageError(f"--from: expected a time before --to, got {shown(start)}, after {shown(end)}")
    found = rewound.between(first, last)
    if as_json:
        say_json(found)
    elif not found:
        say("nothing is different", err=True)
    else:
        say_table(then.CHANGE_HEADS, [then.change_cells(one) for one in found], gives_way=("why", "what"))


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
