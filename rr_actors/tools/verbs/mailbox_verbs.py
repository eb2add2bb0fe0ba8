"""The commands of `rr-actors` about the mailbox of an actor: what waits in it, and for debugging to hold it up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_client import ConsoleClient, find_console
from rr_actors.system.console.console_commands import PauseActor, ResumeActor, StepActor
from rr_actors.system.console.console_questions import LookAtMailbox
from rr_actors.system.console.console_view import Command
from rr_actors.tools.cli_commands import JsonOption, StateOption, WatchOption, say, say_json, say_lines, shown_again
from rr_actors.tools.explanations import mailbox_lines
from rr_actors.tools.verbs.console_options import complete_child

app = typer.Typer()
_ANSWER_S = 30.0

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
    with ConsoleClient(find_console(state), timeout_s=_ANSWER_S) as client:
        found = client.ask(LookAtMailbox(actor)).mailbox
    if as_json:
        say_json({name: getattr(found, name) for name in found.__struct_fields__})
    else:
        say_lines("\n".join(mailbox_lines(found)))


@app.command(epilog="Example: rr-actors pause cameras")
def pause(actor: ActorArgument, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Keep the messages of an actor in its mailbox, in a system that was started for debugging (--debug).

    What it handles already, it finishes. Its supervisor can stop it. When it is restarted, it is not paused.
    """
    _carry_out(state, PauseActor(actor), as_json)


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
    _carry_out(state, StepActor(actor, timeout_s), as_json, timeout_s)


@app.command(epilog="Example: rr-actors resume cameras")
def resume(actor: ActorArgument, state: StateOption = None, as_json: JsonOption = False) -> None:
    """Have a paused actor handle its messages again."""
    _carry_out(state, ResumeActor(actor), as_json)


def _carry_out(state: Path | None, command: Command[c.Done], as_json: bool, timeout_s: float = 0.0) -> None:
    with ConsoleClient(find_console(state), timeout_s=timeout_s + _ANSWER_S) as client:
        done = client.ask(command)
    if as_json:
        say_json({"done": done.text, **done.facts})
    else:
        say(done.text)
