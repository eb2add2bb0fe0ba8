"""The product, broken on purpose in one place each: chaos must notice every one of them within a minute.

`python -m chaos.breakages NAME SEED STATE_DIR REPORT` runs chaos on a system that is broken so; an empty NAME: as it
is. Each process of the system is broken: its fork server imports this module, which reads the name in the environment.
"""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from chaos import __main__ as program
from chaos import load_threads, monkey, victim_managers, victim_system
from chaos import run as runs
from chaos.mission import mission_managers, mission_threads
from chaos.monkey import Monkey
from rr_actors.base.config import SystemConfig
from rr_actors.managers import Choices, Keeper
from rr_actors.managers.actions.graph_engine import GraphEngine
from rr_actors.managers.actions.graph_runs import OVER, GraphRun, NodeEnded
from rr_actors.managers.choices import choice_manager, trials
from rr_actors.managers.keeper import comparing
from rr_actors.registrar.core import holding, notices, reconciliation, recovery, releasing, status_delivery, unloading
from rr_actors.registrar.model.catalog import Decision, add, discard
from rr_actors.registrar.model.commands import Reconcile, Register
from rr_actors.registrar.model.effects import SendReply
from rr_actors.registrar.model.messages import Noticed, Unload, Unloaded
from rr_actors.registrar.model.rows import Change, Drop, Phase, Put, Resource, ServedQuery
from rr_actors.runtime.processes import lifeline
from rr_actors.storage.journaled_store import JournaledStore, JournalFiles, Segment
from rr_actors.supervision.child_main import ChildProcess
from rr_actors.supervision.child_runs import ProcessRun
from rr_actors.supervision.core import restarts
from rr_actors.system.system import System

VARIABLE = "RR_ACTORS_TEST_BREAKAGE"


class Breakage(msgspec.Struct, frozen=True):
    """One of them.

    Attributes:
        where: the part of the product.
        how: what is wrong then.
        apply: breaks this process.
        caught_by: words of the violations that are expected, any of them; they end in a standstill at times.
    """

    where: str
    how: str
    apply: Callable[[], None]
    caught_by: tuple[str, ...]


def replace(function: Any, by: Any) -> None:
    """Put a function in the place of another in each module of the product and of chaos, and in their tables."""
    found = 0
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("rr_actors", "chaos"):
            tables = [value for value in vars(module).values() if type(value) is dict]
            for table in (vars(module), *tables):
                for key in [key for key, value in table.items() if value is function]:
                    table[key] = by
                    found += 1
    assert found, f"{function} is nowhere"


def override(cls: type, method: str, make: Callable[[Any], Any]) -> None:
    """Put make(the method as it is) in a method's place."""
    setattr(cls, method, make(getattr(cls, method)))


# -- the journal -----------------------------------------------------------------------------------------------------


def _without(kind: Callable[[Change], bool]) -> Callable[[], None]:
    def wrap(append: Any) -> Any:
        def broken(self: Segment, changes: Sequence[Change]) -> None:
            kept = [change for change in changes if not kind(change)]
            if kept:
                append(self, kept)

        return broken

    return lambda: override(Segment, "append", wrap)


def _is_drop_of(table: str) -> Callable[[Change], bool]:
    return lambda change: isinstance(change, Drop) and change.table == table


def _is_put_of(row: type) -> Callable[[Change], bool]:
    return lambda change: isinstance(change, Put) and type(change.row) is row


def _written_with_the_next() -> None:
    waiting: dict[int, list[Change]] = {}

    def wrap(append: Any) -> Any:
        def broken(self: Segment, changes: Sequence[Change]) -> None:
            before, waiting[id(self)] = waiting.get(id(self), []), list(changes)
            append(self, before)

        return broken

    override(Segment, "append", wrap)


def _not_read() -> None:
    _read_up_to(0)


def _read_without_its_newest() -> None:
    _read_up_to(-3)


def _read_up_to(end: int) -> None:
    def wrap(since: Any) -> Any:
        def broken(self: JournalFiles, *args: Any, **options: Any) -> Any:
            found = since(self, *args, **options)
            found.changes = found.changes[:end]
            return found

        return broken

    override(JournalFiles, "since", wrap)


# -- the commit ------------------------------------------------------------------------------------------------------


def _acknowledged_before_it_is_written() -> None:
    def wrap(commit: Any) -> Any:
        def broken(self: JournaledStore, changes: Sequence[Change]) -> None:
            later = threading.Timer(0.05, commit, (self, list(changes)))
            later.daemon = True
            later.start()

        return broken

    override(JournaledStore, "commit", wrap)


def _every_fifth_is_not_written() -> None:
    counts: dict[int, int] = {}

    def wrap(commit: Any) -> Any:
        def broken(self: JournaledStore, changes: Sequence[Change]) -> None:
            count = counts[id(self)] = counts.get(id(self), 0) + 1
            if count % 5:
                commit(self, changes)

        return broken

    override(JournaledStore, "commit", wrap)


# -- recovery --------------------------------------------------------------------------------------------------------


def _same_attempt() -> None:
    replace(recovery.begin_again, holding.begin_again)


def _not_taken_up(phase: Phase) -> Callable[[], None]:
    def apply() -> None:
        register = recovery.register

        def broken(decision: Decision, command: Register) -> None:
            catalog, name = decision.catalog, command.server.name
            hidden = [id for id in catalog.by_server.get(name, ()) if catalog.resources[id].phase is phase]
            for id in hidden:
                discard(catalog.by_server, name, id)
            register(decision, command)
            for id in hidden:
                add(catalog.by_server, name, id)

        replace(register, broken)
        victim_managers.UNLOAD_S = 0.05  # so that kills meet it

    return apply


def _unheld_are_kept() -> None:
    replace(unloading.retire, lambda decision, resource: None)


def _not_taken_back() -> None:
    reconcile: Any = reconciliation.reconcile

    def broken(decision: Decision, command: Reconcile) -> None:
        known = [query for query in command.queries if query.query_id in decision.catalog.held]
        reconcile(decision, msgspec.structs.replace(command, queries=known))

    replace(reconcile, broken)


def _nothing_is_agreed() -> None:
    reconcile: Any = reconciliation.reconcile

    def broken(decision: Decision, command: Reconcile) -> None:
        reconcile(decision, msgspec.structs.replace(command, queries=[], same=[]))

    replace(reconcile, broken)


# -- the protocol ----------------------------------------------------------------------------------------------------


def _released_by(release: Callable[[Decision, ServedQuery], None]) -> None:
    """Release a query by this function when its holder releases it."""
    unload = unloading.unload

    def broken(decision: Decision, message: Unload) -> None:
        query = decision.catalog.queries.get(message.query_id)
        if query is None or query.origin != message.origin or query.resource_id in decision.catalog.recovering:
            unload(decision, message)
        else:
            release(decision, query)

    replace(unload, broken)


def _released_by_the_first() -> None:
    def release(decision: Decision, query: ServedQuery) -> None:
        resource = decision.catalog.resources[query.resource_id]
        if resource.phase is Phase.LOADED:
            unloading.begin_unload(decision, resource)

    _released_by(release)


def _forgotten_without_its_callback() -> None:
    def release(decision: Decision, query: ServedQuery) -> None:
        resource = decision.catalog.resources[query.resource_id]
        last = len(decision.catalog.holders[resource.id]) == 1
        unloading.drop_query(decision, query)
        decision.cause(SendReply(query.origin, Unloaded(query.id)))
        if last:
            decision.drop(resource)

    _released_by(release)


def _parts_are_kept() -> None:
    def broken(decision: Decision, resource_id: str, after: Sequence[Any], keep_attempt: int | None = None) -> None:
        for effect in after:
            decision.cause(effect)

    replace(releasing.release_parts, broken)


def _statuses_are_swallowed() -> None:
    def broken(decision: Decision, provider: str, message: Noticed) -> None:
        notices.acknowledge(decision, provider, message.notice.id)

    replace(status_delivery.noticed, broken)


# -- processes -------------------------------------------------------------------------------------------------------


def _not_swept() -> None:
    replace(lifeline.sweep, lambda family: 0)


def _no_lifeline() -> None:
    replace(lifeline.hold, lambda lifeline, parent_pid: None)
    override(ChildProcess, "terminate", lambda terminate: lambda self: None)
    override(Monkey, "_kill_crew", lambda kill: Monkey._kill_supervisor)  # so that there are such parents


def _deaths_are_not_noticed() -> None:
    override(ProcessRun, "_died", lambda died: lambda self, exited: None)


def _never_restarted() -> None:
    replace(restarts.needs_restart, lambda restart, reason: False)


# -- the ready-made managers ------------------------------------------------------------------------------------------


def _planners_are_killed() -> None:
    monkey.MAKERS = monkey.PLANNERS


def _ends_of_actions_are_not_written() -> None:
    def wrap(commit: Any) -> Any:
        def broken(self: GraphEngine, graph: Any, run: GraphRun, event: Any) -> None:
            if not isinstance(event, NodeEnded) or run.state in OVER:
                commit(self, graph, run, event)

        return broken

    override(GraphEngine, "_commit", wrap)
    _planners_are_killed()


def _loads_of_actions_are_kept() -> None:
    override(GraphEngine, "_release", lambda release: lambda self, query: None)


def _failed_alternatives_stay() -> None:
    def broken(self: Choices, id: str, held: Any, status: Any, part: Any) -> None:
        status.handled()

    override(Choices, "_replace", lambda replace: broken)


def _trials_stay() -> None:
    trials.release_soon = lambda query: None


def _no_reasons() -> None:
    nothing: Any = vars(choice_manager)["nothing_left"]
    replace(nothing, lambda request, why: nothing(request, why[1:]))
    mission_managers.UNLUCKY_ARMS = 200  # so that choices are lost


def _replicas_are_doubled() -> None:
    def wrap(release: Any) -> Any:
        return lambda self, one: threading.Timer(0.3, release, (self, one)).start()  # so that it is seen

    replace(vars(comparing)["_is_in_the_way"], lambda other, one: False)
    override(Keeper, "_release", wrap)


def _held_replicas_are_not_known() -> None:
    override(Keeper, "_is_own", lambda is_own: lambda self, query: False)


def _lost_replicas_stay() -> None:
    def broken(one: Any, found: Any) -> Any:
        return next((other for other in found if other.what == one.what), None)

    replace(vars(comparing)["_right"], broken)


_LOST = (
    "journal:",
    "catalog",
    "is unknown to",
    "does not exist",
    "was told",
    "held by nobody",
    "keeper: ",
    "choices: ",
    "actions: ",
    "standstill",
    "is left",
    "are used of",
    "does not say why of",
)
"""What is lost or held in the core, these checks notice: which of them is first depends on where the kills hit."""

BREAKAGES = {
    "drops of queries are not in the journal": Breakage(
        "journal", "Segment.append leaves them out", _without(_is_drop_of("queries")), _LOST
    ),
    "resources are not in the journal": Breakage(
        "journal", "Segment.append leaves them out", _without(_is_put_of(Resource)), _LOST
    ),
    "a record is written with the next": Breakage(
        "journal", "Segment.append keeps it in memory", _written_with_the_next, _LOST
    ),
    "the journal is not read": Breakage("journal", "Found.since returns nothing", _not_read, _LOST),
    "the newest of the journal is not read": Breakage(
        "journal", "Found.since returns all but three changes", _read_without_its_newest, _LOST
    ),
    "acknowledged before it is written": Breakage(
        "commit order", "JournaledStore.commit returns 50 ms too early", _acknowledged_before_it_is_written, _LOST
    ),
    "every fifth commit is not written": Breakage(
        "commit order", "JournaledStore.commit returns at once", _every_fifth_is_not_written, _LOST
    ),
    "an interrupted load is the same attempt": Breakage(
        "recovery", "begin_again does not count it", _same_attempt, ("without being told so", "standstill")
    ),
    "an interrupted load is not taken up": Breakage(
        "recovery", "register leaves it out", _not_taken_up(Phase.LOADING), ("interrupted", *_LOST)
    ),
    "an interrupted unload is not taken up": Breakage(
        "recovery", "register leaves it out", _not_taken_up(Phase.UNLOADING), ("interrupted", *_LOST)
    ),
    "what nobody holds is kept": Breakage("recovery", "retire does nothing", _unheld_are_kept, _LOST),
    "what a provider has is not taken back": Breakage("recovery", "reconcile leaves it out", _not_taken_back, _LOST),
    "what a provider lists is taken for nothing": Breakage(
        "recovery", "reconcile reads an empty list", _nothing_is_agreed, _LOST
    ),
    "the first release unloads": Breakage("protocol", "_release does not count", _released_by_the_first, _LOST),
    "an unload callback is not run": Breakage(
        "protocol", "_release drops the row", _forgotten_without_its_callback, _LOST
    ),
    "parts are not released": Breakage("protocol", "release_parts does nothing", _parts_are_kept, _LOST),
    "statuses are swallowed": Breakage(
        "protocol", "_hear acknowledges at once", _statuses_are_swallowed, ("never heard of", *_LOST)
    ),
    "nothing is swept": Breakage(
        "sweep", "lifeline.sweep does nothing", _not_swept, ("outlives its manager", "is left")
    ),
    "children outlive their parent": Breakage(
        "fencing",
        "lifeline.hold and ChildProcess.terminate do nothing",
        _no_lifeline,
        ("is left", "standstill", "does not come back", *_LOST),
    ),
    "deaths are not noticed": Breakage(
        "supervision", "ProcessRun._died does nothing", _deaths_are_not_noticed, ("standstill", "does not come back")
    ),
    "nothing is restarted": Breakage(
        "supervision",
        "needs_restart says no",
        _never_restarted,
        ("standstill", "does not come back", "hangs", "it is stopped"),
    ),
    "ends of actions are not written": Breakage(
        "actions",
        "GraphEngine._commit leaves them out",
        _ends_of_actions_are_not_written,
        ("after its end was on disk",),
    ),
    "what actions have loaded is kept": Breakage(
        "actions", "GraphEngine._release does nothing", _loads_of_actions_are_kept, ("is held by nobody",)
    ),
    "an alternative that has failed stays": Breakage(
        "choices", "Choices._replace does nothing", _failed_alternatives_stay, ("no working alternative",)
    ),
    "trials are not released": Breakage(
        "choices", "Trials releases nothing", _trials_stay, ("is held by nobody", "trials of", "is left")
    ),
    "a choice that is lost does not say why": Breakage(
        "choices", "nothing_left leaves out the first reason", _no_reasons, ("does not say why",)
    ),
    "a replica is loaded beside the one before": Breakage(
        "keeper", "_is_in_the_way says no", _replicas_are_doubled, ("replicas of",)
    ),
    "a keeper does not know what it holds": Breakage(
        "keeper", "_is_own says no", _held_replicas_are_not_known, ("is held", "replicas of")
    ),
    "a lost replica is not loaded again": Breakage(
        "keeper",
        "_right takes it for one that is there",
        _lost_replicas_stay,
        (" ready: failing", " ready: all failing"),
    ),
}


def main(name: str, seed: str, state_dir: str, report: str) -> int:
    """Run chaos on the broken product, with less patience than usual: what is whole takes milliseconds."""
    os.environ[VARIABLE] = name
    if name:
        BREAKAGES[name].apply()
    load_threads.PATIENCE_S = victim_managers.PATIENCE_S = mission_threads.LIMIT_S = 6.0
    victim_system.SETTLE_S = 5.0
    victim_system.ABANDON_S = runs.STALLED_S = 7.0
    config = SystemConfig(preload=("chaos.breakages",))
    victim_system.System = functools.partial(System, config=config)
    options = ["--kills", "25", "--seconds", "12", "--seed", seed, "--pace", "0.08", "--patience", "12"]
    sys.argv[1:] = [*options, "--state-dir", state_dir, "--json", report]
    return program.main()


if __name__ == "__main__":
    code = main(*sys.argv[1:])
    sys.stdout.flush()
    os._exit(code)
elif os.environ.get(VARIABLE):
    BREAKAGES[os.environ[VARIABLE]].apply()
