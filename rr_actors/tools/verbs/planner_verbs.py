"""The commands of `rr-actors` for managers that plan: a Keeper, the pools of Budgets, the choices of Choices."""

from __future__ import annotations

import os
import pwd
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from rr_actors.base.errors import UsageError
from rr_actors.base.names import short_id
from rr_actors.base.toml import read_bytes
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.system.console.console_commands import AskActor
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.tools.cli_commands import JsonOption, StateOption, say, say_json, say_lines
from rr_actors.tools.tables.plan_table import PLANS, columns_of, source
from rr_actors.tools.tables.table import Look
from rr_actors.tools.verbs.console_options import DryRun
from rr_actors.tools.verbs.list_verbs import say_rows

app = typer.Typer()
_ANSWER_S = 60.0
_LOOSE = Codec(None, "answer")

ChoicesOption = Annotated[
    str, typer.Option("--choices", metavar="ID", help="The id or path of the child that has the choices.")
]
KeeperOption = Annotated[str, typer.Option("--keeper", metavar="ID", help="The id or path of the child that keeps.")]


def _asked(state: Path | None, planner: str, message: dict[str, Any]) -> Any:
    command = AskActor(planner, encode(message, f"message to {planner}"), _ANSWER_S)
    with ConsoleConnection(find_console(state), timeout_s=_ANSWER_S + 10) as connection:
        return _LOOSE.show(connection.ask(command).answer)


def _say_table(state: Path | None, planner: str, name: str, none: str, as_json: bool) -> None:
    """Print the table of this name that a child declares."""
    table = replace(PLANS, source=source(name, planner, _ANSWER_S))
    with ConsoleConnection(find_console(state), timeout_s=_ANSWER_S + 10) as connection:
        rows = table.read(connection, Look(), sys.maxsize).rows
    if as_json:
        say_json([row.facts for row in rows])
    elif rows:
        say_rows(columns_of(rows[0]), rows, styles=[table.line(row, True).style for row in rows])
    else:
        say(none, err=True)


def _question(name: str, file: Path) -> dict[str, str | None]:
    """Return the question about a file that is here, and perhaps not where the system runs."""
    path = str(file.absolute())
    try:
        return {name: read_bytes(path).decode(), "file": path}
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: expected a TOML file, got what is not UTF-8 text") from error


def _say_changes(lines: list[str], none: str, as_json: bool) -> None:
    if as_json:
        say_json(lines)
    elif lines:
        say_lines("\n".join(lines))
    else:
        say(none)


@app.command(epilog="Example: rr-actors apply keep.toml --dry-run")
def apply(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="What is to be kept from now on.")],
    keeper: KeeperOption = "keeper",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Change nothing; show what would be changed.")] = False,
) -> None:
    """Have a Keeper keep what another file wants, and show what changes: + is added, - is removed, ~ differs."""
    made: list[str] = _asked(state, keeper, _question("diff" if dry_run else "apply", file))
    _say_changes(made, f"{keeper} keeps all of this already", as_json)


@app.command(epilog="Example: rr-actors keep diff")
def keep(
    what: Annotated[Literal["get", "diff"], typer.Argument(help="get: all that is kept; diff: what is not ready.")],
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE.toml]", help="With diff: what apply would change.")
    ] = None,
    keeper: KeeperOption = "keeper",
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what a Keeper keeps, how many replicas are ready, and why others are not.

    With diff the exit code is 1 if something is not as it is wanted, or FILE would change something.
    """
    if what == "get":
        if file is not None:
            raise UsageError("keep get: expected no file, got one; rr-actors apply FILE gives a Keeper another")
        _say_table(state, keeper, "kept", "nothing is kept", as_json)
        return
    lines: list[str] = _asked(state, keeper, {"diff": None} if file is None else _question("diff", file))
    _say_changes(lines, "all is as it is wanted" if file is None else "no change", as_json)
    if lines:
        raise typer.Exit(1)


@app.command(epilog="Example: rr-actors budgets")
def budgets(
    child: Annotated[
        str, typer.Option("--budgets", metavar="ID", help="The id or path of the child that has the pools.")
    ] = "budgets",
    state: StateOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the pools of a Budgets: how much each has, what is used and free, and how many loads wait for room."""
    _say_table(state, child, "pools", "there are no pools", as_json)


def _me() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())


@app.command(epilog="Example: rr-actors choices")
def choices(child: ChoicesOption = "choices", state: StateOption = None, as_json: JsonOption = False) -> None:
    """Show the choices of a Choices: which alternative each has, and what was chosen by hand, by whom."""
    _say_table(state, child, "choices", "there are no choices", as_json)


@app.command(epilog="Example: rr-actors choose range lidars/lidar")
def choose(
    choice: Annotated[str, typer.Argument(help="The id of a choice, its beginning or end, or its kind.")],
    alternative: Annotated[
        str | None, typer.Argument(help="Its server, or the whole as `choices --json` shows it under `allowed`.")
    ] = None,
    freely: Annotated[bool, typer.Option("--freely", help="Take back what was chosen by hand.")] = False,
    by: Annotated[str, typer.Option(metavar="NAME", help="Who chooses; you, if it is not given.")] = "",
    child: ChoicesOption = "choices",
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Fix which alternative a choice has, until --freely takes that back; while it fails, another one serves."""
    if (alternative is None) is not freely:
        raise UsageError("choose: expected an alternative or --freely, and not both")
    message = {"choose": choice, "alternative": alternative, "dry_run": dry_run}
    (row,) = _asked(state, child, message if freely else message | {"by": by or _me()})
    if as_json:
        say_json(row)
        return
    what = f"choice {short_id(row['id'])} ({row['kind']})"
    would = "would take back" if dry_run else "took back"
    if freely:
        say(f"{would} what was chosen by hand for {what}; it has {row['present']}")
    else:
        fixed = alternative if dry_run else row["by_hand"]
        say(f"{'would choose' if dry_run else 'chose'} {fixed} for {what}, which has {row['present']}")
