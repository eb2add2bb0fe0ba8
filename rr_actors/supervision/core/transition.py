"""A Tree on the drawing board: the working copy of one decision, and the steps all decisions are made of.

What to do next is never remembered but read off the children's phases by `advance`: whatever came in between, the same
phases lead to the same next action.

- Stopping: the last child that is up is stopped, one at a time; under simple_one_for_one all at once.
- one_for_one, simple_one_for_one: a child that is due is started at once, whatever its siblings do. (OTP's supervisor
  does one thing at a time. Here a child's start may wait for a sibling's restart, which must not wait for the start.)
- one_for_all, rest_for_one: first the condemned are stopped, last first; then those due are started, first first, each
  when the one before it is ready.
- The supervisor's own start: the same, in order, with any strategy.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any

from msgspec.structs import replace

from rr_actors.base.errors import NotFound, RestartIntensityExceeded, RrError, StartFailed
from rr_actors.supervision.core.state import (
    Action,
    Child,
    ChildState,
    Decision,
    Event,
    Exit,
    ExitSupervisor,
    Mode,
    Phase,
    Reply,
    Report,
    Restart,
    StartChild,
    StopChild,
    SupervisorStarted,
    Tree,
    Why,
)


class Draft:
    """One decision in the making. `done()` ends it."""

    def __init__(self, tree: Tree, now: float = 0.0) -> None:
        self.tree = tree
        self.now = now
        self.children = dict(tree.children)
        self.actions: list[Action] = []

    def done(self) -> Decision:
        """The new Tree and the actions."""
        return replace(self.tree, children=self.children), self.actions

    @property
    def alive(self) -> bool:
        """It is neither stopping nor stopped, and has been started."""
        return self.tree.mode in (Mode.STARTING, Mode.RUNNING)

    # -- one child ---------------------------------------------------------------------------------------------------

    def find(self, id: str, run: int) -> Child | None:
        """The child, if that run is its present one."""
        child = self.children.get(id)
        return child if child is not None and child.run == run else None

    def put(self, child: Child, **changes: Any) -> Child:
        """The child with these changes, in its place."""
        changed = replace(child, **changes)
        self.children[child.id] = changed
        return changed

    def start(self, child: Child, delay_s: float = 0.0) -> None:
        """Start it, as the next run."""
        self.tree = replace(self.tree, last_run=self.tree.last_run + 1)
        child = self.put(child, phase=Phase.STARTING, run=self.tree.last_run, up_at=None)
        self.actions.append(StartChild(child.id, child.run, child.start_spec, delay_s, child.why))

    def due(self, child: Child, delay_s: float = 0.0) -> None:
        """To be started: now, or when its turn comes."""
        if self.tree.grouped:
            self.tree = replace(self.tree, delay_s=max(delay_s, self.tree.delay_s))
            self.put(child, phase=Phase.DUE)
        else:
            self.start(child, delay_s)

    def stop(self, child: Child, phase: Phase = Phase.STOPPING) -> Child:
        """Stop this run of it; `phase`: STOPPING, or RECYCLING."""
        self.actions.append(StopChild(child.id, child.run, child.spec.shutdown_s))
        return self.put(child, phase=phase)

    def forgets(self, child: Child) -> bool:
        """Whether nothing is kept of it once it is down: dynamic, temporary, or its start_child has not succeeded."""
        return self.tree.dynamic or child.spec.restart == "temporary" or child.why is Why.NEW

    def down(self, child: Child, event: Event, exit: Exit | None = None, *, keep: bool = False, **details: Any) -> None:
        """It is down and stays so. Its callers must have been answered, or be answered from `child`.

        `keep` the specification even of a temporary one: restart_child does, if it did not come up.
        """
        forgotten = self.forgets(child) and not keep
        self.report(event, child, None if forgotten else "stopped", exit=exit, **details)
        if forgotten:
            del self.children[child.id]
        else:
            self.put(child, phase=Phase.STOPPED, why=Why.RESTART, starters=(), stoppers=(), waiting=())

    # -- what to tell ------------------------------------------------------------------------------------------------

    def report(self, event: Event, child: Child, state: ChildState | None, **details: Any) -> None:
        """Something for the log."""
        self.actions.append(Report(event, child.id, child.run, state, **details))

    def reply(self, callers: Iterable[Hashable], id: str | None = None, error: RrError | None = None) -> None:
        """Answer them all alike."""
        self.actions.extend(Reply(caller, id, error) for caller in callers)

    def start_error(self, child: Child, cause: BaseException | str) -> StartFailed:
        """The error for a start that failed, or that was cut short."""
        text = str(cause) if isinstance(cause, str | RrError) else f"{type(cause).__name__}: {cause}"
        error = StartFailed(f"child {self.tree.path}/{child.id} did not start: {text}", id=child.id)
        error.__cause__ = cause if isinstance(cause, BaseException) else None
        return error

    def gone(self) -> NotFound:
        """What a call on a supervisor that cannot take it any more is answered."""
        return NotFound(f"supervisor {self.tree.path} is {self.tree.mode.name.lower()}", id=self.tree.path)

    # -- restarts ----------------------------------------------------------------------------------------------------

    def count_restart(self, child: Child, reason: str) -> int:
        """One more restart that counts; how many do now."""
        counted = within(self.tree.restarts, self.now, self.tree.spec.max_seconds)
        self.tree = replace(self.tree, restarts=(*counted, Restart(self.now, child.id, reason)))
        return len(self.tree.restarts)

    def restart(self, child: Child, delay_s: float) -> None:
        """It is down: start it, or its group, again."""
        child = self.put(child, phase=Phase.DUE, why=Why.RESTART, attempts=child.attempts + 1, starters=())
        self.due(child, delay_s)
        if self.tree.grouped:
            self._condemn(child.id)

    def _condemn(self, cause: str) -> None:
        """Take the others of its group into the restart of `cause`: those that are up will be stopped first."""
        ids = list(self.children)
        if self.tree.spec.strategy == "rest_for_one":
            ids = ids[ids.index(cause) :]
        for child in [self.children[id] for id in ids if id != cause]:
            match child.phase:
                case Phase.RUNNING:
                    self.put(child, phase=Phase.CONDEMNED)
                case Phase.STARTING:  # not a member yet: its start is done again, for what it was
                    self.put(child, phase=Phase.CONDEMNED, why=Why.RESTART if child.why is Why.MANUAL else child.why)
                case Phase.STOPPED if self.forgets(child):  # it came with an update and was never started
                    self.down(child, "stopped")
                case Phase.STOPPED:  # OTP: the whole group is started, also what was stopped by hand before
                    self.put(child, phase=Phase.DUE, why=Why.RESTART)
                case Phase.STOPPING if not self.forgets(child):
                    self.put(child, phase=Phase.RECYCLING, why=Why.RESTART)
                case _:
                    pass

    # -- the supervisor ----------------------------------------------------------------------------------------------

    def give_up(self, error: RrError | None) -> None:
        """Begin to stop. Starts that go on are cut short at once; what is up is stopped in its turn."""
        self.tree = replace(self.tree, mode=Mode.STOPPING, error=error)
        for child in list(self.children.values()):
            self.reply(child.starters, error=self.start_error(child, f"supervisor {self.tree.path} is stopping"))
            self.reply([call.caller for call in child.waiting], error=self.gone())
            child = self.put(child, starters=(), waiting=())
            starting = child.phase in (Phase.STARTING, Phase.CONDEMNED) and child.up_at is None
            if child.phase is Phase.DUE:
                self.down(child, "stopped")
            elif starting or (child.phase is Phase.RUNNING and self.tree.dynamic):
                self.stop(child)
            elif child.phase is Phase.CONDEMNED:
                self.put(child, phase=Phase.RUNNING)
            elif child.phase is Phase.RECYCLING:
                self.put(child, phase=Phase.STOPPING)

    def advance(self) -> None:
        """Do what the phases allow next."""
        if self.tree.mode is Mode.STOPPING:
            self._stop_next()
        elif self.alive:
            if self.tree.grouped or self._regrouping():
                self._regroup()
            elif self.tree.mode is Mode.STARTING:
                self._start_next(self._of(Phase.STARTING, Why.INIT), self._of(Phase.DUE, Why.INIT))
            if self.tree.mode is Mode.STARTING and self._ready():
                self.tree = replace(self.tree, mode=Mode.RUNNING)
                self.actions.append(SupervisorStarted())

    def _of(self, phase: Phase, why: Why | None = None) -> list[Child]:
        return [c for c in self.children.values() if c.phase is phase and (why is None or c.why is why)]

    def _regrouping(self) -> bool:
        """A group restart goes on, though an update has changed the strategy since: it is finished as begun."""
        if self.tree.dynamic:
            return False
        begun = (Phase.CONDEMNED, Phase.RECYCLING)
        return any(c.phase in begun or (c.phase is Phase.DUE and c.why is not Why.INIT) for c in self.children.values())

    def _regroup(self) -> None:
        if self._of(Phase.STOPPING) or self._of(Phase.RECYCLING):
            return
        condemned = self._of(Phase.CONDEMNED)
        if not condemned:
            self._start_next(self._of(Phase.STARTING), self._of(Phase.DUE))
        elif condemned[-1].spec.restart == "temporary" and condemned[-1].why is Why.RESTART:
            self.stop(condemned[-1])  # it had been up: a temporary sibling is not started again
        else:
            self.stop(condemned[-1], Phase.RECYCLING)

    def _start_next(self, starting: list[Child], due: list[Child]) -> None:
        if starting:
            return
        delay_s, self.tree = self.tree.delay_s, replace(self.tree, delay_s=0.0)
        if due:
            self.start(due[0], delay_s)

    def _stop_next(self) -> None:
        last = next((child for child in reversed(self.children.values()) if not child.down), None)
        if last is None:
            self.tree = replace(self.tree, mode=Mode.STOPPED)
            self.actions.append(ExitSupervisor("shutdown", self.tree.error))
        elif last.phase is Phase.RUNNING:
            self.stop(last)

    def _ready(self) -> bool:
        """Nothing of the start is left to do: restarts of what fell meanwhile are waited for, callers' starts not."""
        coming = (Phase.DUE, Phase.STARTING, Phase.CONDEMNED, Phase.RECYCLING)
        return not any(c.phase in coming and c.why in (Why.INIT, Why.RESTART) for c in self.children.values())


# Restart intensity: how many restarts count, over a sliding window, and when they are too many.
#
# OTP's manual: more than `intensity` restarts within `period` seconds end the supervisor. Inclusive on both sides: a
# restart exactly max_seconds old still counts, and exactly max_restarts of them are still allowed.


def within(restarts: tuple[Restart, ...], now: float, max_seconds: float) -> tuple[Restart, ...]:
    """Those that still count at `now`."""
    return tuple(restart for restart in restarts if now <= restart.at + max_seconds)


def exceeded(
    path: str, restarts: tuple[Restart, ...], limit: int, max_seconds: float, now: float
) -> RestartIntensityExceeded:
    """The error for too many, naming each: the child, how many seconds ago, and why."""
    listed = [(restart.id, now - restart.at, restart.reason) for restart in restarts]
    text = "; ".join(f"{id} {ago:.3g} s ago: {reason}" for id, ago, reason in listed)
    needed = f"{len(restarts)} restart{'s' if len(restarts) > 1 else ''}"
    return RestartIntensityExceeded(
        f"supervisor {path}: {needed} needed within {max_seconds:g} s, {limit} allowed: {text}",
        supervisor=path,
        restarts=listed,
        limit=limit,
        max_seconds=max_seconds,
    )
