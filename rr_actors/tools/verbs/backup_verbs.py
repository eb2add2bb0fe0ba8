"""The commands of `rr-actors` that back a system up, and bring it back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rr_actors.base.errors import NotRunning, UsageError, counted, shown
from rr_actors.system.backups import WRITING_S, back_up_files
from rr_actors.system.console.console_commands import BackUp
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.system import System
from rr_actors.tools.cli_commands import JsonOption, StateOption, say, say_json
from rr_actors.tools.verbs.console_options import DryRun, Timeout

app = typer.Typer()


@app.command(epilog="Example: rr-actors backup /var/backups/robot/$(date +%F) --state /var/lib/robot")
def backup(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A directory that does not exist, or is empty.")],
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Copy all catalogs of a system as they are at one moment, while it runs or not, to a new directory.

    A running system holds still for that moment, and nothing fails. Of one that does not run, name the state directory.
    """
    path = directory.expanduser().absolute()
    try:
        console = find_console(state)
    except NotRunning:
        if state is None or dry_run:
            raise
        made = back_up_files(state, path)
        done, facts = made.told(str(path)), made.facts(str(path))
    else:
        with ConsoleConnection(console, timeout_s=timeout_s + WRITING_S) as connection:
            answer = connection.ask(BackUp(str(path), timeout_s, dry_run))
        done, facts = answer.text, answer.facts
    if as_json:
        say_json({"done": done, **facts})
    else:
        say(done)


@app.command(epilog="Example: rr-actors restore /var/backups/robot/2026-11-29 --state /var/lib/robot")
def restore(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="The backup.")],
    state: Annotated[
        Path,
        typer.Option("--state", envvar="RR_STATE", metavar="NEW", help="A directory that does not exist, or is empty."),
    ] = Path("rr_state"),
    location: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=DIR", help="Another location for a registrar's catalog; may be repeated."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a new state directory from a backup. A system that starts there goes on from the moment of the backup.

    A catalog with a location of its own outside of the state directory is put there again.
    """
    locations: dict[str, str] = {}
    for given in location or ():
        name, equals, place = given.partition("=")
        if not (name and equals and place):
            raise UsageError(f"--location: expected NAME=DIR, got {shown(given)}")
        locations[name] = place
    backup = System.restore(directory, state, locations=locations)
    if as_json:
        say_json({"state": str(state), "system": backup.system, "at": backup.at, "catalogs": len(backup.registrars)})
    else:
        say(f"{state} has {counted(len(backup.registrars), 'catalog')} of system {backup.system} again; start it there")
