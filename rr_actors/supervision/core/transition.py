"""Draft: the working copy of a SupervisorState during one decision, and the steps of which all decisions are made.

Nothing remembers what to do next: `advance` derives it from the children's phases, whatever came before.

- Stopping: children that are up are stopped one at a time, the last first; under simple_one_for_one all at once.
- one_for_one, simple_one_for_one: a child that is due is started at once, whatever its siblings do. (OTP's supervisor
  does one thing at a time. Here a child's start may wait for a sibling's restart, which must not wait for the start.)
- one_for_all, rest_for_one: first the condemned children are stopped, the last first. Then the due children are started
  in order, each when the child before it is ready.
- The supervisor's own start: the due children are started in this way with any strategy.
  A kept child that does not start stays stopped, and ends nothing: nobody could end it while its supervisor is down.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Hashable, Iterable
from typing import Any

from msgspec.structs import replace

from rr_actors.base.errors import (
    DescribedError,
    NotFound,
    RestartIntensityExceeded,
    RrError,
    StartFailed,
    counted,
    text_of,
)
from rr_actors.base.scarcity import wanted_by
from rr_actors.supervision.core.children import Children
from rr_actors.supervision.core.state import (
    Action,
    CallReply,
    ChildPhase,
    ChildState,
    Decision,
    Event,
    Exit,
    ExitSupervisor,
    Mode,
    Report,
    Restart,
    StartChild,
    StopChild,
    SupervisedChild,
    SupervisorStarted,
    SupervisorState,
    Why,
)


class Draft:
    """The working copy of one decision. `done()` ends it."""

    def __init__(self, tree: SupervisorState, now: float = 0.0) -> None:
        self.tree = tree
        self.now = now
        self.children = Children.of(tree.children)
        self.actions: list[Action] = []

    def done(self) -> Decision:
        """Return the new SupervisorState and the actions."""
        return replace(self.tree, children=self.children), self.actions

    @property
    def alive(self) -> bool:
        """Whether the supervisor has been started and is not stopping."""
        return self.tree.mode in (Mode.STARTING, Mode.RUNNING)

    # -- one child ---------------------------------------------------------------------------------------------------

    def find(self, id: str, run: int) -> SupervisedChild | None:
        """Return the child if that run is its present one."""
        child = self.children.get(id)
        return child if child is not None and child.run == run else None

    def put(self, child: SupervisedChild, **changes: Any) -> SupervisedChild:
        """Put the child with these changes in its place, and return it."""
        changed = replace(child, **changes)
        self.children = self.children.put(child.id, changed)
        return changed

    def start(self, child: SupervisedChild, delay_s: float = 0.0) -> None:
        """Start the child, as the next run."""
        self.tree = replace(self.tree, last_run=self.tree.last_run + 1)
        run, starts = self.tree.last_run, child.starts + 1
        child = self.put(child, phase=ChildPhase.STARTING, run=run, previous=child.run, starts=starts, up_at=None)
        self.actions.append(StartChild(child.id, child.run, child.start_spec, delay_s, child.why))

    def due(self, child: SupervisedChild, delay_s: float = 0.0) -> None:
        """Start the child now, or, in a group, make it due until its turn comes."""
        if self.tree.grouped:
            self.tree = replace(self.tree, delay_s=max(delay_s, self.tree.delay_s))
            self.put(child, phase=ChildPhase.DUE)
        else:
            self.start(child, delay_s)

    def stop(self, child: SupervisedChild, phase: ChildPhase = ChildPhase.STOPPING) -> SupervisedChild:
        """Stop the child's present run; `phase` is STOPPING or RECYCLING."""
        self.actions.append(StopChild(child.id, child.run, child.spec.shutdown_s))
        return self.put(child, phase=phase)

    def forgets(self, child: SupervisedChild) -> bool:
        """Return whether a child is dropped when down: dynamic, temporary, or its start_child has not succeeded.

        A kept child is not dropped because its supervisor ends. It is if a caller has ended it before.
        """
        if child.kept and self.tree.mode is Mode.STOPPING and child.why is not Why.NEW:
            return bool(child.stoppers)
        return self.tree.dynamic or child.spec.restart == "temporary" or child.why is Why.NEW

    def down(
        self, child: SupervisedChild, event: Event, exit: Exit | None = None, *, keep: bool = False, **details: Any
    ) -> None:
        """Note that a child is down and stays so. The caller answers its callers before, or afterwards from `child`.

        With `keep`, the specification even of a temporary child stays: so it does after a restart_child that failed.
        """
        forgotten = self.forgets(child) and not keep
        self.report(event, child, None if forgotten else "stopped", exit=exit, **details)
        if forgotten:
            self.children = self.children.without(child.id)
        else:
            self.put(child, phase=ChildPhase.STOPPED, why=Why.RESTART, starters=(), stoppers=(), waiting=())

    # -- what to tell ------------------------------------------------------------------------------------------------

    def report(self, event: Event, child: SupervisedChild, state: ChildState | None, **details: Any) -> None:
        """Add a report for the log and the history."""
        self.actions.append(Report(event, child.id, child.run, state, starts=child.starts, **details))

    def reply(self, callers: Iterable[Hashable], id: str | None = None, error: RrError | None = None) -> None:
        """Give all these callers the same answer."""
        self.actions.extend(CallReply(caller, id, error) for caller in callers)

    def start_error(self, child: SupervisedChild, cause: BaseException | str) -> StartFailed:
        """Return the error for a start that failed or was cut short."""
        text = cause if isinstance(cause, str) else text_of(cause)
        wanted = wanted_by(cause) if isinstance(cause, BaseException) else ""
        if isinstance(cause, DescribedError):
            cause = cause.error
        if isinstance(cause, RrError):  # its text says it all
            text = text.partition(": ")[2] or text
        details: dict[str, Any] = {"id": child.id}
        if wanted:
            details["wanted"] = wanted
            text = text if wanted in text else f"{text}: {wanted}"
        error = StartFailed(f"child {self.tree.path}/{child.id} did not start: {text}", **details)
        error.__cause__ = cause if isinstance(cause, BaseException) else None
        return error

    def gone(self) -> NotFound:
        """Return the error for a call on a supervisor that is stopping or has stopped."""
        return NotFound(f"supervisor {self.tree.path} is {self.tree.mode.name.lower()}", id=self.tree.path)

    # -- restarts ----------------------------------------------------------------------------------------------------

    def count_restart(self, child: SupervisedChild, reason: str) -> int:
        """Count one more restart, and return the number of those that count now."""
        counted = within(self.tree.restarts, self.now, self.tree.spec.max_seconds)
        excused = within(self.tree.excused, self.now, self.tree.spec.max_seconds)
        restarts = (*counted, Restart(self.now, child.id, reason, child.run))
        self.tree = replace(self.tree, restarts=restarts, excused=excused)
        return len(self.tree.restarts)

    def too_many_restarts(self) -> RestartIntensityExceeded:
        """Return the error for the restarts that count. It names the child of each, how many seconds ago, and why."""
        spec = self.tree.spec
        listed = [(restart.id, self.now - restart.at, restart.reason) for restart in self.tree.restarts]
        text = "; ".join(f"{id} {ago:.3g} s ago: {reason}" for id, ago, reason in listed)
        needed = counted(len(listed), "restart")
        return RestartIntensityExceeded(
            f"supervisor {self.tree.path}: {needed} needed within {spec.max_seconds:g} s, {spec.max_restarts} allowed: "
            f"{text}",
            supervisor=self.tree.path,
            restarts=listed,
            limit=spec.max_restarts,
            max_seconds=spec.max_seconds,
        )

    def restart(self, child: SupervisedChild, delay_s: float) -> None:
        """Start a child that is down, or its group, again."""
        self.due(replace(child, why=Why.RESTART, starters=()), delay_s)
        if self.tree.grouped:
            self._condemn(child.id)

    def _condemn(self, cause: str) -> None:
        """Take the rest of the group into the restart of `cause`: children that are up will be stopped first."""
        rest = self.tree.spec.strategy == "rest_for_one"
        for child in self.children.after(cause) if rest else list(self.children.values()):
            match child.phase:
                case _ if child.id == cause:
                    pass
                case ChildPhase.RUNNING:
                    self.put(child, phase=ChildPhase.CONDEMNED)
                case ChildPhase.STARTING:  # not up yet: its start is repeated, for the same purpose
                    # A temporary child never becomes a member that is restarted: its caller waits for the second start.
                    joins = child.why is Why.MANUAL and child.spec.restart != "temporary"
                    self.put(child, phase=ChildPhase.CONDEMNED, why=Why.RESTART if joins else child.why)
                case ChildPhase.STOPPED if self.forgets(child):  # an update added it, and it was never started
                    self.down(child, "stopped")
                case ChildPhase.STOPPED:  # OTP: the whole group is started, also children stopped by hand
                    self.put(child, phase=ChildPhase.DUE, why=Why.RESTART)
                case ChildPhase.STOPPING if not self.forgets(child):
                    self.put(child, phase=ChildPhase.RECYCLING, why=Why.RESTART)
                case _:
                    pass

    # -- the supervisor ----------------------------------------------------------------------------------------------

    def give_up(self, error: RrError | None) -> None:
        """Begin to stop the supervisor. Starts are cut short at once; children that are up stop in their turn."""
        self.tree = replace(self.tree, mode=Mode.STOPPING, error=error)
        for child in list(self.children.values()):
            self.reply(child.starters, error=self.start_error(child, f"supervisor {self.tree.path} is stopping"))
            self.reply([call.caller for call in child.waiting], error=self.gone())
            child = self.put(child, starters=(), waiting=())
            starting = child.phase in (ChildPhase.STARTING, ChildPhase.CONDEMNED) and child.up_at is None
            if child.phase is ChildPhase.DUE:
                self.down(child, "stopped")
            elif starting or (child.phase is ChildPhase.RUNNING and self.tree.dynamic):
                self.stop(child)
            elif child.phase is ChildPhase.CONDEMNED:
                self.put(child, phase=ChildPhase.RUNNING)
            elif child.phase is ChildPhase.RECYCLING:
                self.put(child, phase=ChildPhase.STOPPING)

    def advance(self) -> None:
        """Take the next steps that the phases allow."""
        if self.tree.mode is Mode.STOPPING:
            self._stop_next()
        elif self.alive:
            if self.tree.grouped or self._regrouping():
                self._regroup()
            elif self.tree.mode is Mode.STARTING:
                self._start_next((Why.INIT,))
            if self.tree.mode is Mode.STARTING and self._ready():
                self.tree = replace(self.tree, mode=Mode.RUNNING)
                self.actions.append(SupervisorStarted())

    def _regrouping(self) -> bool:
        """Return whether a group restart is in progress. An update of the strategy does not change how it ends."""
        if self.tree.dynamic:
            return False
        again = (Why.NEW, Why.MANUAL, Why.RESTART)
        return self.children.any(ChildPhase.DUE, whys=again) or self.children.any(
            ChildPhase.CONDEMNED, ChildPhase.RECYCLING
        )

    def _regroup(self) -> None:
        if self.children.any(ChildPhase.STOPPING, ChildPhase.RECYCLING):
            return
        condemned = self.children.last(ChildPhase.CONDEMNED)
        if condemned is None:
            self._start_next(tuple(Why))
        elif condemned.spec.restart == "temporary" and condemned.why is Why.RESTART:
            self.stop(condemned)  # a temporary sibling is not started again
        else:
            self.stop(condemned, ChildPhase.RECYCLING)

    def _start_next(self, whys: tuple[Why, ...]) -> None:
        """Start the first child that is due, for one of these purposes, if none is starting for one of them."""
        if self.children.any(ChildPhase.STARTING, whys=whys):
            return
        delay_s, self.tree = self.tree.delay_s, replace(self.tree, delay_s=0.0)
        for due in self.children.first(1, ChildPhase.DUE, whys=whys):
            self.start(due, delay_s)

    def _stop_next(self) -> None:
        last = self.children.last(
            ChildPhase.STARTING, ChildPhase.RUNNING, ChildPhase.CONDEMNED, ChildPhase.RECYCLING, ChildPhase.STOPPING
        )
        if last is None:
            self.tree = replace(self.tree, mode=Mode.STOPPED)
            self.actions.append(ExitSupervisor("shutdown", self.tree.error))
        elif last.phase is ChildPhase.RUNNING:
            self.stop(last)

    def _ready(self) -> bool:
        """Return whether the supervisor's start is complete: no first start and no restart is left; callers' may be."""
        coming = (ChildPhase.DUE, ChildPhase.STARTING, ChildPhase.CONDEMNED, ChildPhase.RECYCLING)
        return not self.children.any(*coming, whys=(Why.INIT, Why.RESTART))


def within(restarts: tuple[Restart, ...], now: float, max_seconds: float) -> tuple[Restart, ...]:
    """Return the restarts that still count at `now`, in a sliding window.

    OTP's manual: more than `intensity` restarts within `period` seconds end the supervisor. Inclusive on both sides: a
    restart exactly max_seconds old still counts, and exactly max_restarts of them are still allowed.
    """
    return restarts[bisect_left(restarts, now, key=lambda restart: restart.at + max_seconds) :]
