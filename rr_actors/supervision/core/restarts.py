"""Decides what a supervisor does when a child starts, fails to start, ends or has been stopped.

Every function takes the state of a supervisor, and returns the next state with the actions to perform. (state.py has
them, and the duties of the performer.) `now` is monotonic seconds, `chance` a random number in [0, 1] for the jitter.
Administrative calls (start_child, terminate_child ...) are in child_calls.py.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from msgspec.structs import replace

from rr_actors.base.errors import InvalidSpec, StartFailed, UsageError, text_of
from rr_actors.base.scarcity import wanted_by
from rr_actors.supervision.core.child_calls import check_kept_id, replay
from rr_actors.supervision.core.children import Children
from rr_actors.supervision.core.specs import Backoff, RestartType
from rr_actors.supervision.core.state import (
    ChildPhase,
    Decision,
    Event,
    Exit,
    ExitSupervisor,
    KeptChild,
    Mode,
    Reason,
    Restart,
    SupervisedChild,
    SupervisorState,
    Why,
)
from rr_actors.supervision.core.transition import Draft, within

PAUSE = Backoff(delay_s=2.0, factor=2.0, maximum_s=30.0, jitter=0.1)
"""The least wait after a start that failed because something outside was missing (base/scarcity.py).

More starts would make it worse. Such a failure does not count: the want ends no supervisor."""


def needs_restart(restart: RestartType, reason: Reason) -> bool:
    """Return whether a child is restarted after this reason, as OTP's manual says under "restart type"."""
    match restart:
        case "permanent":
            return True
        case "transient":
            return reason in ("abnormal", "killed")
        case "temporary":
            return False


# -- the supervisor ------------------------------------------------------------------------------------------------


def decide_start(tree: SupervisorState, now: float, kept: Iterable[KeptChild] = ()) -> Decision:
    """Start the supervisor: start each child when the child before it is ready.

    SupervisorStarted follows when all children are ready. If one fails, the children before it are stopped in reverse
    order, and ExitSupervisor has StartFailed. A child that ends meanwhile is restarted as usual.

    Of the `kept` children, which come after the others, those that do not start stay stopped. Only if one fails for
    want of something outside, which its supervisor's start may have the next time, the start fails.
    """
    if tree.mode is not Mode.NEW:
        raise UsageError(f"supervisor {tree.path}: started twice (it is {tree.mode.name.lower()})")
    draft = Draft(replace(tree, mode=Mode.STARTING), now)
    for each in kept:
        draft.put(_come_back(tree, each))
    for child in list(draft.children.values()):
        child = draft.put(child, phase=ChildPhase.DUE, why=Why.INIT)
        if child.lost is not None:
            draft.down(child, "start_failed", error=child.lost, keep=True)
    draft.advance()
    return draft.done()


def _come_back(tree: SupervisorState, kept: KeptChild) -> SupervisedChild:
    """Return a kept child that has not started; it is lost if the present template cannot be its template."""
    child = SupervisedChild(kept.id, tree.template, kept.args, kept=True, lost=kept.lost)
    try:
        check_kept_id(kept.id, tree)
        _ = child.start_spec
    except InvalidSpec as error:
        return replace(child, extra=(), lost=child.lost or error)
    return child


def decide_stop(tree: SupervisorState, now: float) -> Decision:
    """Stop the children in reverse order (under simple_one_for_one all at once), then the supervisor.

    Starts and backoffs in progress are cut short. A second call changes nothing.
    """
    if tree.mode is Mode.NEW:
        return replace(tree, mode=Mode.STOPPED), [ExitSupervisor("shutdown")]
    draft = Draft(tree, now)
    if draft.alive:
        draft.give_up(None)
        draft.advance()
    return draft.done()


# -- starts --------------------------------------------------------------------------------------------------------


def decide_started(tree: SupervisorState, id: str, run: int, now: float, *, ignored: bool = False) -> Decision:
    """Note that this run is ready, or, with `ignored`, that its on_start returned IGNORE and nothing of it runs."""
    draft = Draft(tree, now)
    child = draft.find(id, run)
    match child:
        case SupervisedChild(phase=ChildPhase.STARTING):
            if ignored:
                draft.down(replace(child, why=Why.RESTART), "ignored", keep=child.why is Why.MANUAL)
            else:
                draft.report("started", child, "running")
                draft.put(
                    child,
                    phase=ChildPhase.RUNNING,
                    why=Why.RESTART,
                    up_at=now,
                    starters=(),
                    waiting=(),
                    wanting=0,
                    doubted=False,
                )
            draft.reply(child.starters, id=None if ignored else id)
            if child.waiting:
                replay(draft, child.waiting)
        case SupervisedChild(phase=ChildPhase.CONDEMNED) if ignored:
            draft.put(child, phase=ChildPhase.DUE)
        case SupervisedChild(phase=ChildPhase.CONDEMNED):
            draft.put(child, up_at=now)
        case _:
            return tree, []  # the child is being stopped: decide_stopped follows
    draft.advance()
    return draft.done()


def decide_start_failed(
    tree: SupervisorState, id: str, run: int, reason: BaseException, now: float, chance: float = 0.0
) -> Decision:
    """Decide on a run that did not become ready and has ended. `reason` is the error of its on_start or of its end."""
    draft = Draft(tree, now)
    child = draft.find(id, run)
    match child:
        case SupervisedChild(phase=ChildPhase.STARTING):
            _start_failed(draft, child, reason, chance)
        case SupervisedChild(phase=ChildPhase.CONDEMNED):  # a group restart was to stop it: the failure does not count
            draft.report("start_failed", child, child.state, error=reason)
            draft.put(child, phase=ChildPhase.DUE)
        case _:
            return tree, []
    draft.advance()
    return draft.done()


def _start_failed(draft: Draft, child: SupervisedChild, reason: BaseException, chance: float) -> None:
    if is_resources(reason) and not child.doubted:
        draft.report("start_failed", child, child.state, error=reason)
        excused = Restart(draft.now, child.id, f"start failed: {text_of(reason)}", child.run)
        draft.tree = replace(draft.tree, excused=(*draft.tree.excused, excused))
        draft.start(draft.put(child, doubted=True))
        return
    error = draft.start_error(child, reason)
    draft.reply(child.starters, error=error)
    match child.why:
        case Why.INIT:
            draft.down(child, "start_failed", error=reason, keep=child.kept)
            replay(draft, child.waiting)
            if wanted_by(reason) or not child.kept:
                draft.give_up(error)
        case Why.NEW | Why.MANUAL:
            draft.down(child, "start_failed", error=reason, keep=child.why is Why.MANUAL)
            replay(draft, child.waiting)
        case Why.RESTART:
            if wanted_by(reason):
                _wait_for_want(draft, child, reason, chance)
            else:
                child = draft.put(child, wanting=0)
                _restart(draft, child, "start_failed", f"start failed: {text_of(reason)}", chance, error=reason)


def _wait_for_want(draft: Draft, child: SupervisedChild, reason: BaseException, chance: float) -> None:
    """Start the child or its group again after a pause, and count no restart."""
    delay_s = PAUSE.delay(child.wanting, chance)
    if child.spec.backoff:
        delay_s = max(delay_s, child.spec.backoff.delay(child.attempts, chance))
    child = draft.put(child, wanting=child.wanting + 1)
    draft.report("start_failed", child, "restarting", delay_s=delay_s, error=reason)
    draft.restart(child, delay_s)


def is_resources(reason: BaseException) -> bool:
    """Return whether a start failed because the process died while callbacks of resources ran.

    Such a start is made again, and does not count: the child's registrar counts the deaths of each callback, and runs
    none of them for a fourth time. If the next start does not say that it was so (decide_uncounted), that one counts.
    """
    return isinstance(reason, StartFailed) and "callback" in reason.details


# -- ends ----------------------------------------------------------------------------------------------------------


def decide_exit(tree: SupervisorState, id: str, run: int, exit: Exit, now: float, chance: float = 0.0) -> Decision:
    """Decide on a run that had been ready and has ended without a StopChild."""
    draft = Draft(tree, now)
    child = draft.find(id, run)
    match child:
        case SupervisedChild(phase=ChildPhase.RUNNING):
            _exited(draft, child, exit, chance)
        case SupervisedChild(phase=ChildPhase.CONDEMNED):  # a group restart was to stop it: its end does not count
            if child.spec.restart == "temporary" and child.why is Why.RESTART:
                draft.down(child, "exited", exit)
            else:
                draft.report("exited", child, child.state, exit=exit)
                draft.put(child, phase=ChildPhase.DUE)
        case SupervisedChild(phase=ChildPhase.STARTING):
            return decide_start_failed(tree, id, run, StartFailed(f"ended before it was ready: {exit}"), now, chance)
        case _:
            return tree, []
    draft.advance()
    return draft.done()


def decide_uncounted(tree: SupervisorState, id: str, run: int, *, is_proven: bool = False) -> Decision:
    """Note that the run before this one ended while callbacks of resources ran: its restart does not count.

    With `is_proven`, processes have died in each of several runs of one of them, which is not run again. Otherwise the
    restart counts after all if decide_acquitted() says so.
    """
    child = tree.children.get(id)
    if child is None or child.run != run:
        return tree, []
    counted = tuple(restart for restart in tree.restarts if (restart.id, restart.run) != (id, child.previous))
    if is_proven:
        excused = tuple(restart for restart in tree.excused if restart.id != id)
    else:
        excused = (*tree.excused, *(restart for restart in tree.restarts if restart not in counted))
    children = Children.of(tree.children).put(id, replace(child, doubted=False))
    return replace(tree, restarts=counted, excused=excused, children=children), []


def decide_acquitted(tree: SupervisorState, id: str, run: int, now: float) -> Decision:
    """Note that the callbacks which ran at the earlier ends of this child have not ended its present run.

    The restarts count that were excused because of them. Give up if these are too many.
    """
    draft = Draft(tree, now)
    child = draft.find(id, run)
    guilty = [restart for restart in tree.excused if restart.id == id]
    if child is None or not guilty or not draft.alive:
        return tree, []
    restarts = tuple(sorted((*tree.restarts, *guilty), key=lambda restart: restart.at))
    excused = tuple(restart for restart in tree.excused if restart.id != id)
    draft.tree = replace(tree, restarts=within(restarts, now, tree.spec.max_seconds), excused=excused)
    if (count := len(draft.tree.restarts)) > tree.spec.max_restarts:
        error = draft.too_many_restarts()
        draft.report("gave_up", child, child.state, error=error, restarts=count)
        draft.give_up(error)
        draft.advance()
    return draft.done()


def decide_stopped(tree: SupervisorState, id: str, run: int, exit: Exit, now: float) -> Decision:
    """Note that the StopChild of this run is done. `exit` is normal or shutdown, or killed after the time limit."""
    draft = Draft(tree, now)
    child = draft.find(id, run)
    match child:
        case SupervisedChild(phase=ChildPhase.RECYCLING):
            draft.report("stopped", child, child.state, exit=exit)
            draft.put(child, phase=ChildPhase.DUE, stoppers=())
        case SupervisedChild(phase=ChildPhase.STOPPING):
            draft.down(child, "stopped", exit)
        case _:
            return tree, []
    draft.reply(child.stoppers)
    if child.phase is ChildPhase.STOPPING:
        replay(draft, child.waiting)
    draft.advance()
    return draft.done()


def _exited(draft: Draft, child: SupervisedChild, exit: Exit, chance: float) -> None:
    backoff = child.spec.backoff
    if backoff and child.up_at is not None and draft.now - child.up_at >= backoff.maximum_s:
        child = draft.put(child, attempts=0)
    if draft.alive and needs_restart(child.spec.restart, exit.reason):
        _restart(draft, child, "exited", str(exit), chance, exit=exit)
        return
    draft.down(child, "exited", exit)
    if draft.alive:
        _auto_shutdown(draft, child)


def _restart(draft: Draft, child: SupervisedChild, event: Event, reason: str, chance: float, **details: Any) -> None:
    """Count a restart of a child that is down, and start it or its group; give up if that restart is one too many."""
    count = draft.count_restart(child, reason)
    if count > draft.tree.spec.max_restarts:
        error = draft.too_many_restarts()
        draft.down(child, event, restarts=count, keep=child.kept, **details)
        replay(draft, child.waiting)
        state = None if draft.forgets(child) and not child.kept else "stopped"
        draft.report("gave_up", child, state, error=error, restarts=count)
        draft.give_up(error)
    else:
        delay_s = child.spec.backoff.delay(child.attempts, chance) if child.spec.backoff else 0.0
        draft.report(event, child, "restarting", restarts=count, delay_s=delay_s, **details)
        draft.restart(replace(child, attempts=child.attempts + 1), delay_s)


def _auto_shutdown(draft: Draft, child: SupervisedChild) -> None:
    """Stop the supervisor if this child's own end demands it (OTP: any_significant, all_significant)."""
    when = draft.tree.spec.auto_shutdown
    if when == "never" or not child.spec.significant:
        return
    if when == "any" or not draft.children.any_significant():
        draft.report("auto_shutdown", child, None if draft.forgets(child) else "stopped")
        starting = draft.tree.mode is Mode.STARTING
        draft.give_up(draft.start_error(child, "it ended before its supervisor was ready") if starting else None)
