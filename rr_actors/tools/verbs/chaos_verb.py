"""The command of `rr-actors` that kills children of a running system at random."""

from __future__ import annotations

import random
from collections import defaultdict
from typing import Annotated

import msgspec
import typer

from rr_actors.base.errors import counted
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.tools.cli_commands import JsonOption, StateOption, say, say_json, say_lines, say_table
from rr_actors.tools.random_kills import KillPlan, KillReport, RandomKills
from rr_actors.tools.verbs.console_options import DryRun, Timeout, complete_child

app = typer.Typer()

_SEEDS = 1_000_000
_INTERRUPTED = 130  # as a shell has it


@app.command(epilog="Example: rr-actors chaos --kills 20 --only cameras")
def chaos(
    kills: Annotated[int, typer.Option(metavar="N", min=1, help="End after this many kills.")] = 10,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="Begin no kill after this time, if that is sooner.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHILD",
            help="Only this child, or, of a supervisor, all below it, too; may be repeated.",
            autocompletion=complete_child,
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="The seed of the choices, which repeats their order.")
    ] = None,
    regardless: Annotated[
        bool, typer.Option("--regardless", help="Kill also where a supervisor then has restarted too often, and ends.")
    ] = False,
    timeout_s: Timeout = 30.0,
    state: StateOption = None,
    as_json: JsonOption = False,
    dry_run: DryRun = False,
) -> None:
    """Kill children of the running system at random, and check that it recovers; exit code 1 if it does not.

    Each kill is a SIGKILL. A child must run again within --timeout, and then the catalogs must agree. Before a kill
    the command waits until the child's supervisor may restart it, so that none gives up. Children without a process
    of their own and temporary ones are left alone. What is wrong ends the run.
    """
    chosen = random.SystemRandom().randrange(_SEEDS) if seed is None else seed
    plan = KillPlan(kills, chosen, seconds, tuple(only or ()), regardless, timeout_s)
    with ConsoleConnection(find_console(state)) as connection:
        run = RandomKills(connection, plan, lambda line: say(line, err=True))
        if dry_run:
            _say_plan(run, plan, as_json)
            return
        say(f"seed {plan.seed}, the system in {connection.welcome.state_dir}", err=True)
        report = run.run()
    if as_json:
        say_json(msgspec.to_builtins(report) | {"passed": not report.violations and not report.interrupted})
    else:
        _say_report(report)
    if report.violations or report.interrupted:
        raise typer.Exit(1 if report.violations else _INTERRUPTED)


def _say_plan(run: RandomKills, plan: KillPlan, as_json: bool) -> None:
    victims = run.victims()
    if as_json:
        say_json({"kills": plan.kills, "seed": plan.seed, "children": victims, "left_alone": run.report.left_alone})
        return
    say(f"would send SIGKILL {counted(plan.kills, 'time')}, each time to one of these at random (seed {plan.seed}):")
    say_lines("\n".join(victims), "  ")
    _say_left_alone(run.report)


def _say_left_alone(report: KillReport) -> None:
    for path, why in report.left_alone.items():
        say(f"left alone: {path}: {why}")


def _say_report(report: KillReport) -> None:
    times: defaultdict[str, list[float]] = defaultdict(list)
    for kill in report.kills:
        times[kill.path] += [] if kill.back_s is None else [kill.back_s]
    counts = {path: sum(kill.path == path for kill in report.kills) for path in sorted(times)}
    if counts:
        heads = ("child", "kills", "longest return")
        rows = [
            (path, str(count), f"{max(times[path]):.1f} s" if times[path] else "") for path, count in counts.items()
        ]
        say_table(heads, rows, gives_way=("child",), right=("kills", "longest return"))
    _say_left_alone(report)
    say(f"{len(report.kills)} kills in {report.seconds:.1f} s, seed {report.seed}")
    if report.violations:
        say_lines("\n".join(report.violations), "wrong: ")
    elif report.interrupted:
        say("interrupted: what follows the last kill was not checked")
    else:
        catalogs, queries = counted(report.catalogs, "catalog"), counted(report.queries, "query")
        say(f"each child runs again; {catalogs}, {queries}: no contradiction")
