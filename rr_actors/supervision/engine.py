"""Supervision: performs the decisions of supervision/core/restarts.py on real children. On the loop.

It keeps the state of one supervisor. For each event of a child it takes a decision from the core, and performs the
actions of that in order. Their outcomes are the next events. The supervisor actor around it is in supervisor.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import time
from collections.abc import Callable, Collection, Coroutine, Sequence
from dataclasses import replace
from typing import Any

from rr_actors.base.errors import RrError, StartFailed, Unavailable, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.steps import Steps
from rr_actors.registrar.engine.node import Node
from rr_actors.runtime.callback_errors import described_error
from rr_actors.runtime.processes import lifeline
from rr_actors.supervision.child_runs import Life, LocalRun, ProcessRun, Run, Target
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.child_calls import find_child
from rr_actors.supervision.core.children import Children
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.supervision.core.state import (
    Action,
    CallReply,
    ChildPhase,
    Decision,
    Exit,
    ExitSupervisor,
    Mode,
    Report,
    StartChild,
    StopChild,
    SupervisorStarted,
    SupervisorState,
    Why,
)
from rr_actors.supervision.core.transition import Draft
from rr_actors.supervision.event_history import History, Record, record_of
from rr_actors.supervision.given_up import give_up
from rr_actors.supervision.name_entries import Entries, KeptChildren, manager_of, registrars_of
from rr_actors.wire.name_service import Presence, Turn

logger = Log("rr_actors.supervision")

SWEEP_DELAY_S = 0.05
"""Seconds from a death to the search for processes outside its group. Mostly the successor has started by then."""

LAID_OUT = max(2, len(os.sched_getaffinity(0)))
"""How many processes are made before their turn: one for each processor, as otherwise processors would be idle."""

FENCE_S = 1.0
"""The longest wait for the end of the processes below a dead supervisor. The kernel kills them within milliseconds."""

DEATHS = 3
"""How many deaths of earlier runs a child hears of: as many as a load may cause before it fails."""

_STATUS = {"running": None, "starting": Presence.STARTING, "restarting": Presence.STARTING, "stopped": Presence.STOPPED}


class Supervision:
    """The children of one supervisor.

    Args:
        target_of: returns the class to start for a child in this process, and its arguments.
        on_started: called once when all children are ready.
        on_exit: called once when all children are down and the supervisor must end. If on_started was not called
            before, the start has failed.
    """

    def __init__(
        self,
        spec: Supervisor,
        path: str,
        node: Node,
        *,
        target_of: Callable[[ChildSpec], Target],
        on_started: Callable[[], None],
        on_exit: Callable[[ExitSupervisor], None],
    ) -> None:
        self.path = path
        self.history = History()
        self.tree = SupervisorState.of(spec, path, generation=f"{time.time_ns() // 1_000_000:x}")
        self.final = False
        self.kept = KeptChildren(node, path)
        self.entries = Entries(node.directory, self.kept.records)
        self._node = node
        self._target_of = target_of
        self._on_started = on_started
        self._on_exit = on_exit
        self._lives: dict[int, Life] = {}
        self._specs: dict[str, ChildSpec] = {}  # of the last start of each child
        self._tasks: set[asyncio.Task[Any]] = set()
        self._named: tuple[Supervisor | None, frozenset[str]] = None, frozenset()  # a specification, its children's ids
        self._laid_out: dict[str, ProcessRun] = {}  # processes that wait for their turn to start
        self._giving_up: dict[str, asyncio.Task[Any]] = {}  # registrars that are gone, until their catalogs say so
        self._sweeping: asyncio.TimerHandle | None = None
        self._brutal = False

    # -- requests --------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Start the children, then call on_started or on_exit. Kept children start from what is on disk.

        Raises:
            CatalogError: their records cannot be listed.
        """
        kept = await self.kept.read() if self.tree.dynamic else ()
        if self.tree.mode is not Mode.NEW:  # it was asked to stop
            return
        self._specs.update({each.id: replace(self.tree.template, id=each.id) for each in kept})
        self.apply(restarts.decide_start(self.tree, time.monotonic(), kept))

    def stop(self, *, final: bool) -> None:
        """Stop the children, also in the middle of a start, then call on_exit if that has not been done.

        `final`: they will not be started again.
        """
        self.final = self.final or final
        self.apply(restarts.decide_stop(self.tree, time.monotonic()))

    def kill(self) -> None:
        """Stop without waiting: kill the children's processes, and abandon actors in this process."""
        self._brutal = True
        self.apply(restarts.decide_stop(self.tree, time.monotonic()))
        for life in list(self._lives.values()):
            if life.run is not None:
                life.run.kill()
        for run in self._laid_out.values():
            run.kill()

    def apply(self, decision: Decision) -> None:
        """Keep the decision's SupervisorState and perform its actions."""
        self.tree, actions = decision
        if over := [action.id for action in actions if isinstance(action, Report) and self._is_over(action)]:
            replies = [action for action in actions if isinstance(action, CallReply)]
            actions = [action for action in actions if not isinstance(action, CallReply)]
            self._task(self._forget(over, replies))  # no caller hears of an end that is not on disk
        steps = Steps()
        for action in actions:
            steps.take(f"performing a {type(action).__name__}", self._perform, action)
        steps.report(logger, f"supervisor {self.path}: a defect of rr_actors")
        if self._laid_out or any(isinstance(action, StartChild) and not action.delay_s for action in actions):
            self._lay_out_next()

    def life_of(self, id: str) -> Life | None:
        """Return the present run of a child, or None if it is not running."""
        child = find_child(self.tree, id)
        return self._lives.get(child.run) if child.state == "running" else None

    def path_of(self, id: str) -> str:
        """Return the child's path in the tree."""
        return f"{self.path}/{id}"

    async def finish(self) -> None:
        """Wait, after on_exit, until the clean-up has ended."""
        if self._sweeping is not None:
            self._sweeping.cancel()
            await self._sweep()
        while self._tasks - {asyncio.current_task()}:
            await asyncio.wait(self._tasks - {asyncio.current_task()})

    # -- actions ---------------------------------------------------------------------------------------------------

    def _perform(self, action: Action) -> None:
        match action:
            case StartChild():
                life = Life(action, self.path_of(action.id))
                self._lives[action.run] = life
                self._specs[action.id] = action.spec
                turn = Turn.NOW if self.tree.awaited(action.why) else None
                self.entries.mark(life.spec, life.path, Presence.STARTING, self._deaths(life), turn)
                self._task(self._start(life, action.delay_s))
            case StopChild():
                life = self._lives.get(action.run)
                if life is not None:
                    life.told_to_stop.set()
                self._task(self._stop(action, life))
            case Report():
                self._record(action)
                if action.state is None:
                    self._specs.pop(action.id, None)
            case CallReply():
                action.caller(action)  # pyright: ignore[reportCallIssue]  # callers are functions here
            case SupervisorStarted():
                self._on_started()
            case ExitSupervisor():
                self._on_exit(action)

    def _is_over(self, report: Report) -> bool:
        """Return whether a kept child has ended for good: it is forgotten, or has ended cleanly, with its supervisor.

        One that has not ended cleanly may not have unloaded what it serves. It comes back, and then does.
        """
        if not self.kept.has(report.id):
            return False
        life = self._lives.get(report.run)
        in_order = report.exit is not None and report.exit.reason != "killed"
        return report.state is None or (self.final and in_order and life is not None and life.ready_at is not None)

    async def _forget(self, ids: Sequence[str], replies: Sequence[CallReply]) -> None:
        failure: RrError | None = None
        try:
            await self.kept.remove(ids)
        except RrError as error:
            logger.error("supervisor %s: %s will come back: %s", self.path, ", ".join(ids), error)
            failure = error
        for reply in replies:
            self._perform(reply if reply.error or failure is None else CallReply(reply.caller, error=failure))

    async def _start(self, life: Life, delay_s: float) -> None:
        if delay_s > 0:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(life.told_to_stop.wait(), delay_s)
        names = registrars_of(life.spec, life.path)
        if giving_up := [task for name in names if (task := self._giving_up.get(name)) is not None]:
            await asyncio.wait(giving_up)  # it has their catalogs
        if life.told_to_stop.is_set():
            return
        life.began = time.monotonic()
        try:
            if life.why in (Why.NEW, Why.MANUAL) and (child := self.tree.children[life.id]).kept:
                await self.kept.write(child.id, child.extra)
                if life.told_to_stop.is_set():
                    return
            life.run = self._new_run(life)
            ready = await life.run.start(by_hand=life.why in (Why.NEW, Why.MANUAL))
        except Exception as failure:
            error = failure if type(failure) is StartFailed else await described_error(failure)
            if not life.told_to_stop.is_set():
                now = time.monotonic()
                decision = restarts.decide_start_failed(self.tree, life.id, life.number, error, now, _chance())
                self._apply_and_forget(life, decision)
            return
        if life.told_to_stop.is_set():
            return
        life.ready_at, life.since = time.monotonic(), time.time()
        decision = restarts.decide_started(self.tree, life.id, life.number, life.ready_at, ignored=not ready)
        if ready:
            self.apply(decision)
        else:
            self._apply_and_forget(life, decision)

    def _new_run(self, life: Life) -> Run:
        on_end = functools.partial(self._ended, life)
        if life.spec.placement == "process":
            run = self._laid_out.pop(life.id, None)
            if run is None or run.spec is not life.spec:
                if run is not None:
                    self._task(run.stop("brutal_kill", final=True))
                run = ProcessRun(self._node, life.spec, life.path, self._died)
            run.on_end = on_end
            run.on_death_in_callback = functools.partial(self._died_in_callback, life)
            run.on_acquitted = functools.partial(self._acquitted, life)
            return run
        return LocalRun(self._node, life.spec, life.path, self._target_of(life.spec), on_end)

    def _lay_out_next(self) -> None:
        """Make the processes of the next children while others start, and discard processes that are not needed now."""
        due = Children.of(self.tree.children).first(LAID_OUT, ChildPhase.DUE)
        for child in due:
            spec = child.start_spec
            if spec.placement == "process" and child.id not in self._laid_out:
                run = self._laid_out[child.id] = ProcessRun(self._node, spec, self.path_of(child.id), self._died)
                run.lay_out()
        coming = {child.id for child in due}
        for id in [id for id in self._laid_out if id not in coming and not self._is_to_start(id)]:
            self._task(self._laid_out.pop(id).stop("brutal_kill", final=True))

    def _is_to_start(self, id: str) -> bool:
        """Return whether the child's present start has no Run yet."""
        child = self.tree.children.get(id)
        life = None if child is None else self._lives.get(child.run)
        return life is not None and life.run is None

    async def _stop(self, action: StopChild, life: Life | None) -> None:
        if life is None or life.run is None:
            exit = Exit("shutdown", "was not started")
        else:
            exit = await self._end_of(life, life.run, action)
        decision = restarts.decide_stopped(self.tree, action.id, action.run, exit, time.monotonic())
        self._apply_and_forget(life, decision)

    async def _end_of(self, life: Life, run: Run, action: StopChild) -> Exit:
        """Stop a run, or kill it if stop() raises: its siblings and the supervisor must be stopped all the same."""
        try:
            limit_s = "brutal_kill" if self._brutal else action.shutdown_s
            return await run.stop(limit_s, final=self._is_final(action.id))
        except Exception as error:
            logger.critical("supervisor %s: %s could not be stopped; killed", self.path, life.path, exc_info=error)
            run.kill()
            return Exit("killed", f"could not be stopped: {text_of(error)}")

    def _is_final(self, id: str) -> bool:
        """Return whether a child that is being stopped will not be started again."""
        child = self.tree.children.get(id)
        if child is None or self.tree.dynamic:
            return child is None or self.final or Draft(self.tree).forgets(child)
        forgotten = child.phase is ChildPhase.STOPPING and child.spec.restart == "temporary"
        return forgotten or self._ends_with_supervisor(id)

    def _ends_with_supervisor(self, id: str) -> bool:
        """Return whether the supervisor is stopping and will not have this child at its next start."""
        stopping = self.tree.mode in (Mode.STOPPING, Mode.STOPPED)
        comes_back = id in self._ids_of(self.tree.spec) or self.kept.has(id)
        return self.final or (stopping and not comes_back)

    def _ids_of(self, spec: Supervisor) -> frozenset[str]:
        if self._named[0] is not spec:
            self._named = spec, frozenset(child.id for child in spec.children)
        return self._named[1]

    # -- ends of children ------------------------------------------------------------------------------------------

    def _ended(self, life: Life, exit: Exit) -> None:
        if life.spec.type == "supervisor" and life.spec.placement == "process":
            self._task(self._ended_with_all_below(life, exit))
        else:
            self._has_ended(life, exit)

    async def _ended_with_all_below(self, life: Life, exit: Exit) -> None:
        """Wait until the processes below a dead supervisor are gone: their successors must not meet them."""
        pids = self.entries.pids_below(life.path)
        with contextlib.suppress(Unavailable):  # the machine gives no thread, but the child's end must be decided
            await self._node.dispatcher.workers.run(lifeline.wait_gone, pids, FENCE_S)
        if isinstance(life.run, ProcessRun):
            self._retire(self.entries.forget_dynamic(life.spec, life.path, life.run.managers))
        self._has_ended(life, exit)

    def _died_in_callback(self, life: Life, runs: str, is_proven: bool) -> None:
        logger.warning(
            "supervisor %s: the last process of %s died while callbacks of its resources ran: its restart is taken off"
            " the count again%s. They were: %s",
            self.path,
            life.path,
            "" if is_proven else ", unless they end well now",
            runs,
        )
        self.apply(restarts.decide_uncounted(self.tree, life.id, life.number, is_proven=is_proven))

    def _acquitted(self, life: Life) -> None:
        text = (
            "supervisor %s: the callbacks that ran when the last process of %s died have ended well: its restart counts"
        )
        logger.warning(text, self.path, life.path)
        self.apply(restarts.decide_acquitted(self.tree, life.id, life.number, time.monotonic()))

    def _has_ended(self, life: Life, exit: Exit) -> None:
        decision = restarts.decide_exit(self.tree, life.id, life.number, exit, time.monotonic(), _chance())
        self._apply_and_forget(life, decision)

    def _apply_and_forget(self, life: Life | None, decision: Decision) -> None:
        self.apply(decision)
        if life is not None:
            self._lives.pop(life.number, None)

    def _task(self, coroutine: Coroutine[Any, Any, object]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)  # the loop itself keeps only weak references
        task.add_done_callback(self._task_done)
        return task

    def _task_done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.critical("supervisor %s: a defect of rr_actors", self.path, exc_info=error)

    # -- records and the directory ---------------------------------------------------------------------------------

    def _record(self, report: Report) -> None:
        path, spec = self.path_of(report.id), self._specs.get(report.id)
        kind = "actor"
        if spec is not None and (spec.type == "supervisor" or manager_of(spec) is not None):
            kind = "supervisor" if spec.type == "supervisor" else "manager"
        life = self._lives.get(report.run)
        record = record_of(report, path, kind, time.time(), None if life is None else life.facts)
        self.history.add(record)
        self._node.emit(record.event, **record.facts())
        status = Presence.GONE if report.state is None else _STATUS[report.state]
        if spec is None or status is None:
            return
        if status is Presence.STOPPED and self._ends_with_supervisor(report.id):
            status = Presence.GONE
        closed = {name for name in self.entries.registrars_of(spec, path) if self._is_gone(name)}
        child = self.tree.children.get(report.id)
        if status is Presence.STOPPED:  # else what becomes of it is for the supervisor of this one to say
            is_due = self.tree.mode in (Mode.STOPPING, Mode.STOPPED)
        else:
            is_due = status is Presence.STARTING and child is not None and child.phase is ChildPhase.DUE
        self._retire(self.entries.mark(spec, path, status, _why(record), Turn.DUE if is_due else None), closed)
        if status is Presence.STOPPED and self.kept.has(report.id) and self.tree.mode in (Mode.STARTING, Mode.RUNNING):
            self.entries.mark_dormant(spec, path, _why(record))
        if status is Presence.GONE and report.state is None and spec.type == "supervisor":
            self._task(self.kept.remove_below(path))

    def _is_gone(self, registrar: str) -> bool:
        return self._node.status_of(registrar) is Presence.GONE

    def _deaths(self, life: Life) -> str:
        """Say how earlier runs died. The child's registrar names that in the errors of loads that they interrupted."""
        if life.spec.type == "supervisor":  # the actors below it may have ended in another way
            return ""
        return "; ".join(self.history.deaths(life.path, DEATHS))

    def _retire(self, registrars: list[str], closed: Collection[str] = ()) -> None:
        """Have all providers release what these registrars held, unless the children stop for good anyway.

        Those in `closed` have released it themselves, when they were closed.
        """
        if not self.final:
            for registrar in registrars:
                self._giving_up[registrar] = self._task(self._give_up(registrar, closed=registrar in closed))

    async def _give_up(self, registrar: str, *, closed: bool) -> None:
        try:
            if not closed:
                await give_up(self._node, registrar)
        except RrError as error:
            logger.warning("%s: its catalog still says what it held: %s", registrar, error)
            closed = True
        finally:
            if closed:
                await self._node.bury(registrar)
            self._giving_up.pop(registrar, None)

    # -- leftovers of dead processes -------------------------------------------------------------------------------

    def _died(self) -> None:
        if self._sweeping is None:
            self._sweeping = asyncio.get_running_loop().call_later(SWEEP_DELAY_S, lambda: self._task(self._sweep()))

    async def _sweep(self) -> None:
        self._sweeping = None
        workers = self._node.dispatcher.workers
        try:
            swept = await workers.run(self._node.spawner.sweep)
        except (Unavailable, OSError) as error:  # the next sweep finds them, or the end of the system
            if not workers.closed:
                what = "what dead children left behind is not searched now"
                logger.warning("supervisor %s: %s: %s", self.path, what, error)
            return
        with contextlib.suppress(OSError, Unavailable):  # a file that stays is removed with the run directory
            await workers.run(self._node.transport.sweep)
        if swept:
            logger.warning("supervisor %s: killed %d processes that dead children had left behind", self.path, swept)


def _why(record: Record) -> str:
    """Return the reason of a child's state for the directory; "" if a caller or the child asked for it."""
    if record.event in ("stopped", "deleted", "ignored"):
        return ""
    if record.reason and record.detail:
        return f"{record.reason} ({record.detail})"
    return record.detail or record.reason


def _chance() -> float:
    """Return a random number in [0, 1)."""
    return int.from_bytes(os.urandom(4), "big") / 2**32
