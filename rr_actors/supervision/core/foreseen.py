"""What would happen if a child died or were stopped: the decisions of the core on a copy of the present state.

Each start succeeds, and each stop ends cleanly. No time passes meanwhile, so that delays change nothing.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from msgspec import Struct

from rr_actors.supervision.core.child_calls import find_child, restart_child, terminate_child
from rr_actors.supervision.core.restarts import decide_exit, decide_started, decide_stopped
from rr_actors.supervision.core.state import (
    Action,
    ChildPhase,
    Decision,
    Exit,
    ExitSupervisor,
    StartChild,
    StopChild,
    SupervisorState,
)
from rr_actors.supervision.core.transition import within

What = Literal["kill", "stop", "restart"]
_MOST = 10_000  # steps


class Step(Struct, frozen=True):
    """A child of the supervisor dies, stops or starts."""

    happens: Literal["dies", "stops", "starts"]
    id: str


class Foreseen(Struct, frozen=True):
    """What would happen in one supervisor.

    Attributes:
        path: the supervisor's.
        steps: what dies, stops and starts, in this order.
        restarts: how many restarts would be in the window then; `before`: how many are in it now.
        max_restarts, max_seconds: how many the window allows, and how long it is.
        ends: whether the supervisor would end. `error`: why, if it would give up.
    """

    path: str
    steps: tuple[Step, ...]
    before: int
    restarts: int
    max_restarts: int
    max_seconds: float
    strategy: str
    ends: bool = False
    error: str = ""


def foresee(tree: SupervisorState, id: str, what: What, now: float) -> Foreseen:
    """Return what would happen if a child was killed, stopped or restarted by hand at the time `now`.

    Raises:
        NotFound: the supervisor has no such child.
    """
    child = find_child(tree, id)
    before = len(within(tree.restarts, now, tree.spec.max_seconds))
    course = _Course(tree, now)
    if child.phase is not ChildPhase.STOPPED and what == "kill":
        course.steps.append(Step("dies", id))
        course.run(decide_exit(tree, id, child.run, Exit("killed", "SIGKILL"), now))
    elif child.phase is not ChildPhase.STOPPED:
        course.run(terminate_child(tree, id, None, now))
    if what == "restart" and not course.ends and id in course.tree.children:
        course.run(restart_child(course.tree, id, None, now))
    spec = tree.spec
    restarts = len(within(course.tree.restarts, now, spec.max_seconds))
    window = before, restarts, spec.max_restarts, spec.max_seconds
    return Foreseen(tree.path, tuple(course.steps), *window, spec.strategy, course.ends, course.error)


class _Course:
    """The actions of decisions, carried out at once, until none is left."""

    def __init__(self, tree: SupervisorState, now: float) -> None:
        self.tree, self.now = tree, now
        self.steps: list[Step] = []
        self.ends, self.error = False, ""

    def run(self, decision: Decision) -> None:
        ahead = deque[Action]()
        self.tree, actions = decision
        ahead.extend(actions)
        while len(self.steps) < _MOST:
            if not ahead and (action := self._under_way()) is not None:
                ahead.append(action)
            if not ahead:
                return
            self.tree, actions = self._answer(ahead.popleft())
            ahead.extend(actions)

    def _answer(self, action: Action) -> Decision:
        match action:
            case StopChild(id, run):
                self.steps.append(Step("stops", id))
                return decide_stopped(self.tree, id, run, Exit("shutdown", "stopped"), self.now)
            case StartChild(id, run):
                self.steps.append(Step("starts", id))
                return decide_started(self.tree, id, run, self.now)
            case ExitSupervisor():
                self.ends = True
                self.error = str(action.error or "")
            case _:
                pass
        return self.tree, []

    def _under_way(self) -> Action | None:
        """Return an action that was asked for before, and has not been answered: a start or a stop in progress."""
        for child in self.tree.children.values():
            if child.phase is ChildPhase.STARTING:
                return StartChild(child.id, child.run, child.start_spec, 0.0, child.why)
            if child.phase in (ChildPhase.STOPPING, ChildPhase.RECYCLING):
                return StopChild(child.id, child.run, child.spec.shutdown_s)
        return None
