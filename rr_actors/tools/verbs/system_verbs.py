"""The commands of `rr-actors` about a tree: run, verify or simulate it, `learn` to mend one; and `doctor`."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from rr_actors.base.errors import UsageError, shown
from rr_actors.supervision.core.specs import ChildModel, Exponential, Supervisor
from rr_actors.system.simulated.simulated_runs import path_meant, paths_of
from rr_actors.system.simulated.simulated_runs import simulate as run_simulated
from rr_actors.system.simulated.tree_experiments import experiment
from rr_actors.tools.cli_commands import (
    JsonOption,
    WatchOption,
    say,
    say_json,
    say_lines,
    say_table,
    seconds_of,
    shown_again,
)
from rr_actors.tools.doctor import examine
from rr_actors.tools.learn.check_process import LIMIT_S
from rr_actors.tools.learn.learn_exercises import Exercise, exercise_named
from rr_actors.tools.learn.learn_progress import HEADS, LearnerFolder, class_rows, read_class
from rr_actors.tools.learn.learn_session import Session, check_once, say_wrapped, show_list
from rr_actors.tools.tree_runner import read_tree, run_tree, verified

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


@app.command(epilog="Example: rr-actors simulate robot.toml --life lidar=30s --vary max_restarts=1,3,10")
def simulate(
    tree: TreeArgument,
    lives: Annotated[
        list[str], typer.Option("--life", metavar="CHILD=TIME", help="The mean of a child's lives; several times.")
    ] = [],  # noqa: B006  # typer reads it
    starts: Annotated[
        list[str], typer.Option("--start", metavar="CHILD=TIME", help="How long its start takes. Default: 0.1s.")
    ] = [],  # noqa: B006
    until: Annotated[str, typer.Option("--until", metavar="TIME", help="How long, in virtual time.")] = "1h",
    vary: Annotated[
        list[str], typer.Option("--vary", metavar="SETTING=A,B", help="Compare these values of a setting.")
    ] = [],  # noqa: B006
    runs: Annotated[int, typer.Option("--runs", metavar="N", help="With --vary: how many runs of each.")] = 20,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Of all that is random.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Say what a tree does while children die, in virtual time: who is available, who restarts, when it gives up.

    It imports the modules that the tree names, and starts nothing. `--vary drive.strategy=one_for_one,one_for_all`
    names the setting of a child or supervisor below the root.
    """
    spec, until_s = read_tree(tree), seconds_of(until, "--until")
    mean_s, start_s = _times(lives, "--life", spec), _times(starts, "--start", spec)
    models = {
        child: ChildModel(Exponential(mean_s[child]) if child in mean_s else None, start_s.get(child, 0.1))
        for child in {**mean_s, **start_s}
    }
    if vary:
        settings = {name: [_value(text) for text in values.split(",")] for name, values in _pairs(vary, "--vary")}
        found = experiment(spec, models, vary=settings, runs=runs, until_s=until_s, seed=seed)
        _show(found.rows, str(found), as_json)
    else:
        run = run_simulated(spec, models, until_s=until_s, seed=seed)
        _show([msgspec.to_builtins(child) for child in run.children.values()], str(run), as_json)


def _show(rows: list[dict[str, object]], text: str, as_json: bool) -> None:
    if as_json:
        for row in rows:
            say_json(row)
    else:
        say_lines(text)


def _pairs(texts: list[str], option: str) -> list[tuple[str, str]]:
    pairs = [(name, value) for name, _, value in (text.partition("=") for text in texts)]
    for (name, value), text in zip(pairs, texts, strict=True):
        if not name or not value:
            raise UsageError(f"{option}: expected NAME=VALUE, got {shown(text)}")
    return pairs


def _times(texts: list[str], option: str, tree: Supervisor) -> dict[str, float]:
    """Return the time of each child that the option names, by its path."""
    specs = paths_of(tree)
    return {path_meant(id, specs): seconds_of(value, f"{option} {id}") for id, value in _pairs(texts, option)}


def _value(text: str) -> object:
    """Return a value as TOML would have it; a word that is none is a text."""
    try:
        return json.loads(text)
    except ValueError:
        return text


@app.command(epilog="Example: rr-actors learn exercises")
def learn(
    directories: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[DIR]...", help="The learner's directory; with --class several. Default: rr_learn."),
    ] = None,
    as_list: Annotated[bool, typer.Option("--list", help="List the exercises, and which are done.")] = False,
    check: Annotated[str, typer.Option(metavar="NAME", help="Check one exercise; exit code 1 if it fails.")] = "",
    hint: Annotated[str, typer.Option(metavar="NAME", help="Print the next hint for an exercise.")] = "",
    reset: Annotated[str, typer.Option(metavar="NAME", help="Put the file of an exercise back as it was given.")] = "",
    for_class: Annotated[bool, typer.Option("--class", help="Print where each learner below DIR is.")] = False,
    limit: Annotated[str, typer.Option(metavar="TIME", help="End a check after so long.")] = f"{LIMIT_S:g}s",
    watch: WatchOption = False,
) -> None:
    """Learn supervision and resources by exercises: mend a file, save it, and see what happens.

    The first call makes the directory. Without a terminal, the present exercise is checked once. NAME is the name or
    number of an exercise.
    """
    given = [option for option, on in (("--list", as_list), ("--check", check), ("--hint", hint)) if on]
    given += [option for option, on in (("--reset", reset), ("--class", for_class)) if on]
    if len(given) > 1:
        raise UsageError(f"learn: expected one of {', '.join(given)}, got {len(given)} of them")
    limit_s = seconds_of(limit, "--limit")
    if limit_s == 0:
        raise UsageError("--limit: expected more than 0 s, got 0 s")
    paths = directories or [Path("rr_learn")]
    if for_class:
        shown_again(watch, lambda: _show_class(paths))
        return
    if watch or len(paths) > 1:
        what = "--watch" if watch else f"{len(paths)} directories"
        raise UsageError(f"learn: expected --class with {what}, got none")
    folder = (LearnerFolder.open if given else LearnerFolder.begin)(paths[0])
    if as_list:
        show_list(folder)
    elif hint:
        say_wrapped(folder.take_hint(exercise_named(hint, "--hint")))
    elif reset:
        exercise = exercise_named(reset, "--reset")
        before = folder.reset(exercise)
        say(f"{exercise.file_name} is as it was given" + (f"; your text is in {before.name}" if before else ""))
    elif check:
        _check(folder, exercise_named(check, "--check"), limit_s)
    elif sys.stdin.isatty() and sys.stdout.isatty():
        Session(folder, limit_s).run()
    elif (at := folder.at()) is not None:
        _check(folder, at, limit_s)
    else:
        say("all exercises are done")


def _check(folder: LearnerFolder, exercise: Exercise, limit_s: float) -> None:
    if not check_once(folder, exercise, limit_s):
        raise typer.Exit(1)


def _show_class(paths: list[Path]) -> None:
    learners, broken = read_class(paths)
    say_table(HEADS, class_rows(learners, time.time()), gives_way=("directory", "learner"), right=HEADS[4:])
    for one in broken:
        say(one, err=True)
