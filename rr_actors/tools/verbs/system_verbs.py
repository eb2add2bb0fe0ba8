"""The commands of `rr-actors` that start a system: `run`, and `doctor`, which tries a small one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from rr_actors.tools.cli_commands import JsonOption, say
from rr_actors.tools.doctor import examine
from rr_actors.tools.tree_runner import run_tree, verified

app = typer.Typer()

TreeArgument = Annotated[
    str,
    typer.Argument(
        metavar="TREE",
        help="A TOML file, as Supervisor.from_toml reads it; or FILE.py[:OBJECT] or MODULE:OBJECT, a Supervisor.",
    ),
]


@app.command(epilog="Example: rr-actors run robot.toml --state /var/lib/robot --log debug")
def run(
    tree: TreeArgument,
    state: Annotated[
        Path, typer.Option("--state", envvar="RR_STATE", metavar="DIR", help="Its state directory.")
    ] = Path("rr_state"),
    config: Annotated[Path | None, typer.Option(help="Its configuration, as SystemConfig.from_toml reads it.")] = None,
    name: Annotated[str, typer.Option(help="Its name, for logs. Default: the id of the tree.")] = "",
    log: Annotated[Literal["debug", "info", "warning", "error"], typer.Option(help="What its log tells.")] = "info",
    as_json: Annotated[bool, typer.Option("--json", help="The log as one object of JSON a line.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Restart a child whose module has changed.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Let rr-actors pause, step and resume its actors.")] = False,
) -> None:
    """Run a system from files alone until SIGTERM or Ctrl-C, which end it cleanly; a second one kills what is left.

    Modules and files that a TOML file names are looked for beside it. Exit code 1 if the tree gave up by itself.
    """
    if not run_tree(tree, state, config, name, log_level=log, log_json=as_json, watch=watch, debug=debug):
        raise typer.Exit(1)


@app.command(epilog="Example: rr-actors verify robot.toml --config robot-config.toml")
def verify(
    tree: TreeArgument,
    config: Annotated[Path | None, typer.Option(help="Its configuration, as SystemConfig.from_toml reads it.")] = None,
) -> None:
    """Say what cannot start of a tree: wrong keys, unknown classes, an on_start that waits for what starts later.

    Exit code 1 if anything cannot. It imports the modules that the tree names, and calls nothing in them: it reads the
    source of on_start, and of the methods that this calls. It finds a load or an ask whose name is written there, and a
    cost at Budgets. It does not find a name that is computed, a declared function in place of a name, a wait in a
    callback of another manager, children that are added at run time, or what needs a device or a file.
    """
    found = verified(tree, config)
    for sentence in found:
        say(sentence)
    if found:
        raise typer.Exit(1)


@app.command(epilog="Example: rr-actors doctor --state /var/lib/robot")
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
