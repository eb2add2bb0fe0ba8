"""The commands of `rr-actors` about one child or resource: how it is, to wait for that, and the mailbox of an actor."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from rr_actors.base.errors import UnknownQuery, UsageError, counted, did_you_mean, shown
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.asking.waiting import (
    CHILD_STATES,
    GONE,
    RESOURCE_STATES,
    check_state,
    child_of,
    patiently,
    wait_for,
)
from rr_actors.system.console.console_commands import PauseActor, ResumeActor, StepActor
from rr_actors.system.console.console_questions import ListHistory, LookAtMailbox
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.cli_commands import JsonOption, StateOption, WatchOption, say, say_json, say_lines, shown_again
from rr_actors.tools.explanations import explain, mailbox_lines
from rr_actors.tools.process_usage import facts_of
from rr_actors.tools.terminal.event_lines import event_line
from rr_actors.tools.verbs.console_options import (
    DryRun,
    Timeout,
    carry_out,
    complete_child,
    completing,
    connection_of,
    list_children,
    list_children_or_resources,
)

app = typer.Typer()
_ANSWER_S = 30.0
_LATEST = 10  # records of a child that its status shows

ActorArgument = Annotated[
    str,
    typer.Argument(
        metavar="ID",
        help="A child's id or path, a supervisor's, or a registrar: cameras/registrar, app.",
        autocompletion=complete_child,
    ),
]


@app.command(epilog="Example: rr-actors mailbox cameras --watch")
def mailbox(
    actor: ActorArgument, watch: WatchOption = False, state: StateOption = None, as_json: JsonOption = False
) -> None:
    """Show how many messages wait for an actor, since when, of what types, and what it handles, from whom, since when.

    The loop of its process answers, also if the actor is busy or stuck.
    """
    shown_again(watch, lambda: _show(state, actor, as_json))


def _show(state: Path | None, actor: str, as_json: bool) -> None:
    with connection_of(state, _ANSWER_S) as connection:
        found = connection.ask(LookAtMailbox(actor)).mailbox
    if as_json:
        say_json({name: getattr(found, name) for name in found.__struct_fields__})
    else:
        say_lines("\n".join(mailbox_lines(found)))


@app.command(epilog="Example: rr-actors pause cameras")
def pause(actor: ActorArgument, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Keep the messages of an actor in its mailbox, in a system that was started for debugging (--debug).

    What it handles already, it finishes. Its supervisor can stop it. When it is restarted, it is not paused.
    """
    carry_out(state, PauseActor(actor), as_json)


@app.command(epilog="Example: rr-actors step cameras")
def step(
    actor: ActorArgument,
    timeout_s: Annotated[
        float, typer.Option("--timeout", metavar="SECONDS", min=0.0, max=c.TIMEOUT_LIMIT_S, help="For the handler.")
    ] = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Have a paused actor handle one message, and say which."""
    carry_out(state, StepActor(actor, timeout_s), as_json, timeout_s)


@app.command(epilog="Example: rr-actors resume cameras")
def resume(actor: ActorArgument, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Have a paused actor handle its messages again."""
    carry_out(state, ResumeActor(actor), as_json)


@app.command(epilog="Example: rr-actors wait 'cameras/camera \"/dev/video0\"' --for OK --timeout 10")
def wait(
    target: Annotated[
        str,
        typer.Argument(
            help="A child's id or path; or a resource's name, or its id, or the beginning or end of that.",
            autocompletion=completing(list_children_or_resources),
        ),
    ],
    wanted: Annotated[
        str,
        typer.Option(
            "--for",
            metavar="STATE",
            help=f"Of a child: {', '.join(CHILD_STATES)}; of a resource: {', '.join(RESOURCE_STATES)}; or {GONE}. "
            "Default: that the child runs, or the resource is loaded.",
        ),
    ] = "",
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Wait until a child or a resource is in a state; before the system runs, for that, too; exit code 1 if late."""
    check_state(wanted, "--for")
    began = time.monotonic()
    until = began + (0 if wanted.lower() == GONE else timeout_s)
    done, seen = wait_for(lambda: patiently(lambda: connection_of(state), until), target, wanted, timeout_s)
    waited_s = round(time.monotonic() - began, 1)
    if as_json:
        say_json({"target": target, "state": seen, "waited_s": waited_s, "done": done})
    else:
        say(f"{target}: {'' if done else 'still '}{seen} after {waited_s:g} s", err=not done)
    if not done:
        raise typer.Exit(1)


@app.command(epilog="Example: rr-actors status cameras/01a2085d3f7c WARNING 'the lens is dirty'")
def status(
    target: Annotated[
        str,
        typer.Argument(
            metavar="CHILD|SERVER/RESOURCE",
            help="A child's id or path; or a resource's id, its beginning or end, after its server; or its name.",
            autocompletion=completing(list_children_or_resources),
        ),
    ],
    said: Annotated[str, typer.Argument(metavar="[STATE]", help="OK, UPDATE, WARNING, ERROR or FATAL.")] = "",
    message: Annotated[str, typer.Argument(help="For people.")] = "",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Show how a child or a resource is; with STATE, send a resource's status to its holders in its owner's name."""
    if not said:
        _show_status(state, target, as_json)
        return
    states = ("OK", "UPDATE", "WARNING", "ERROR", "FATAL")
    if said.upper() not in states:
        raise UsageError(f"STATE: expected {', '.join(states)}, got {shown(said)}")
    before, _, id = target.rpartition("/") if " " not in target else ("", "", target)
    registrar = before.partition("/")[0]
    carry_out(state, commands.SendStatus(id, cast("Any", said.upper()), message, registrar, dry_run), as_json)


def _show_status(state: Path | None, target: str, as_json: bool) -> None:
    """Show a child with its latest history, or explain a resource; exit code 1 if a child does not run."""
    with connection_of(state) as connection:
        if (row := child_of(connection, target)) is None:
            try:
                lines = explain(connection, target.rpartition("/")[2] if " " not in target else target)
            except UnknownQuery as error:
                hint = did_you_mean(target, list_children(connection, target))
                raise UnknownQuery(f"{error}{hint}", query_id=target) from error
            say_json({"text": lines}) if as_json else say_lines("\n".join(lines))
            return
        served = [one for one in connection.registrars().rows if one.name == row.id]
        happened = connection.ask(ListHistory(row.path, _LATEST)).events
    facts = facts_of(row)
    if as_json:
        say_json(facts | {"registrars": served, "history": [event.flat() for event in happened]})
    else:
        say_lines("\n".join(_child_lines(row, facts, served)))
        say_lines("\n".join(map(event_line, happened)), "    ")
    if row.state != "running":
        raise typer.Exit(1)


def _child_lines(row: c.ChildRow, facts: dict[str, Any], served: list[c.RegistrarRow]) -> Iterator[str]:
    yield f"{row.path}: {row.state}{f', {row.error}' if row.error else ''}"
    if row.pid is not None:
        up = "" if row.up_s is None else f", up for {ago(row.up_s)}"
        yield f"    process {row.pid}{up}, {counted(row.restarts, 'restart')}"
    if facts["memory_bytes"] is not None:
        yield f"    {facts['cpu_percent']:.1f} % of a core, {facts['memory_bytes'] / 2**20:.0f} MiB"
    for text in filter(None, (row.strategy, row.note)):
        yield f"    {text}"
    for one in served:
        counts = ", ".join(f"{count} {name}" for name, count in one.counts.items() if count)
        yield f"    registrar {one.name}: {one.status}, serves {', '.join(one.servers) or 'nothing'}"
        if counts:
            yield f"        {counts}"
