"""The state of one supervisor as a value, and the actions that its decisions ask for.

A Tree is never changed: every decision in restarts.py and child_calls.py returns a new one with the actions to perform.
Nothing here starts, stops or waits for anything; supervision/supervisor.py does.

What the performer owes the core, for the decisions to be right:

- It calls the decisions one at a time, keeps the Tree each returns, and performs the actions in their order, at once.
- Every StartChild has a number of its own, `run`. For each it reports one `decide_started` or `decide_start_failed`
  (after the delay, the start, the time limit). Reports about a run that is no longer the child's are ignored, so late
  ones do no harm.
- A child that was reported started and ends without having been told to: one `decide_exit`.
- Every StopChild(run) is answered by exactly one `decide_stopped`, once nothing of that run can act any more (or it has
  been abandoned): also when that run was still waiting out its delay, was starting, or had ended by itself meanwhile.
"""

from __future__ import annotations

import enum
from collections.abc import Hashable
from dataclasses import replace
from typing import Any, Literal

from msgspec import Struct, field

from rr_actors.base.errors import RrError
from rr_actors.supervision.core.specs import ChildSpec, Shutdown, Supervisor, as_child_spec

Reason = Literal["normal", "shutdown", "abnormal", "killed"]
ChildState = Literal["running", "restarting", "stopped", "starting"]


class Exit(Struct, frozen=True):
    """How a child ended.

    Attributes:
        reason: normal (stopped itself, exit code 0), shutdown (asked to), abnormal (exception, exit code) or killed
            (signal).
        detail: for people: "ValueError: no such device", "exit code 3", "SIGKILL".
        code: exit code of its process, -N for signal N; None without a process or where nobody can tell.
        traceback: of the exception that ended it, as text.
    """

    reason: Reason
    detail: str = ""
    code: int | None = None
    traceback: str = ""

    def __str__(self) -> str:
        return f"{self.reason} ({self.detail})" if self.detail else self.reason


class Phase(enum.Enum):
    """Where a child is between start and stop, as the core sees it."""

    STOPPED = enum.auto()  # down, and nothing will start it by itself (OTP: undefined)
    DUE = enum.auto()  # down, to be started when its turn comes
    STARTING = enum.auto()  # a StartChild is out, unanswered (its delay included)
    RUNNING = enum.auto()
    CONDEMNED = enum.auto()  # up or coming up, to be stopped for a group restart when its turn comes
    RECYCLING = enum.auto()  # a StopChild is out, unanswered; then it is DUE
    STOPPING = enum.auto()  # a StopChild is out, unanswered; then it stays down


class Why(enum.Enum):
    """What a start is for: it decides what a failure of it means."""

    INIT = enum.auto()  # the supervisor's own start: it fails with it
    NEW = enum.auto()  # start_child: the specification is dropped, the caller told
    MANUAL = enum.auto()  # restart_child: the child stays stopped, the caller told
    RESTART = enum.auto()  # counted, and tried again


class Call(Struct, frozen=True):
    """An administrative call. `caller` is whom to Reply to; `child` what a start would add."""

    kind: Literal["start", "terminate", "restart", "delete"]
    id: str
    caller: Hashable
    child: Child | None = None


class Child(Struct, frozen=True):
    """One child of a supervisor.

    Attributes:
        id: its name; under simple_one_for_one a generated one.
        spec: its specification. Under simple_one_for_one the template's; `extra` are this child's additional arguments.
        run: number of its present or last start; 0 before the first.
        why: what its present start is for; RESTART once it is up, as the next one will be that.
        up_at: when this run became ready, monotonic seconds; None before.
        attempts: restarts since it was last up long enough (for the backoff).
        wanting: starts in a row that failed for want of resources (base/scarcity.py).
        starters, stoppers: callers to be told when it is up (or has failed), or down.
        waiting: calls to be made again when its start or stop has ended.
    """

    id: str
    spec: ChildSpec
    extra: tuple[Any, ...] = ()
    phase: Phase = Phase.STOPPED
    why: Why = Why.INIT
    run: int = 0
    up_at: float | None = None
    attempts: int = 0
    wanting: int = 0
    starters: tuple[Hashable, ...] = ()
    stoppers: tuple[Hashable, ...] = ()
    waiting: tuple[Call, ...] = ()

    @property
    def state(self) -> ChildState:
        """What which_children shows. A child on its way down by hand is "running" until it is down."""
        match self.phase:
            case Phase.STOPPED:
                return "stopped"
            case Phase.RUNNING | Phase.STOPPING:
                return "running"
            case _:
                return "restarting" if self.why is Why.RESTART else "starting"

    @property
    def down(self) -> bool:
        """Nothing of it runs."""
        return self.phase in (Phase.STOPPED, Phase.DUE)

    @property
    def start_spec(self) -> ChildSpec:
        """What to start it by: the template with its own id and extra arguments, if it is a dynamic child."""
        if self.id == self.spec.id:
            return self.spec
        return replace(self.spec, id=self.id, args=(*self.spec.args, *self.extra))


class Restart(Struct, frozen=True):
    """A restart that counts: when (monotonic seconds), which child, why."""

    at: float
    id: str
    reason: str


class Mode(enum.Enum):
    """Where the supervisor itself is."""

    NEW = enum.auto()
    STARTING = enum.auto()
    RUNNING = enum.auto()
    STOPPING = enum.auto()
    STOPPED = enum.auto()


class Tree(Struct, frozen=True):
    """One supervisor. Make it with `Tree.of(spec, path)`.

    Attributes:
        spec: its specification as last given (strategy, intensity, auto_shutdown ...; the children are in `children`).
        path: its place in the tree, "root/inner", for messages.
        children: by id, in start order. Not to be changed.
        restarts: those that count, oldest first.
        last_run, last_dynamic: the last numbers given out.
        generation: part of the ids of dynamic children, see `of`.
        delay_s: backoff still to be waited out before the group's next start.
        error: why it is stopping, if not because it was told to.
    """

    spec: Supervisor
    path: str
    mode: Mode = Mode.NEW
    children: dict[str, Child] = field(default_factory=dict[str, Child])
    restarts: tuple[Restart, ...] = ()
    last_run: int = 0
    last_dynamic: int = 0
    generation: str = ""
    delay_s: float = 0.0
    error: RrError | None = None

    @staticmethod
    def of(spec: Supervisor, path: str | None = None, generation: str = "") -> Tree:
        """The supervisor before its start: its static children stopped, or a template and no children.

        Dynamic children are called "template-1", "template-2" ...; with a generation "a7", "template-a7.1". Give each
        incarnation of a supervisor another one: a reference to a dynamic child of the last must not reach one of this.
        """
        specs = () if spec.strategy == "simple_one_for_one" else spec.child_specs
        return Tree(spec, path or spec.id, children={s.id: Child(s.id, s) for s in specs}, generation=generation)

    @property
    def dynamic(self) -> bool:
        """Its children are made at run time from one template."""
        return self.spec.strategy == "simple_one_for_one"

    @property
    def template(self) -> ChildSpec:
        """What all dynamic children are made by."""
        return as_child_spec(self.spec.children[0])

    def dynamic_id(self, number: str) -> str:
        """The id of the dynamic child with that number; not longer than an id may be."""
        return f"{self.template.id[:40]}-{self.generation}{'.' if self.generation else ''}{number}"

    @property
    def grouped(self) -> bool:
        """A restart may concern several children."""
        return self.spec.strategy in ("one_for_all", "rest_for_one")


# -- actions -------------------------------------------------------------------------------------------------------


class StartChild(Struct, frozen=True):
    """Wait `delay_s`, then start it by `spec` (a dynamic child's extra arguments are in it already).

    Answer with decide_started or decide_start_failed, or, if a StopChild of the same run came meanwhile, with
    decide_stopped alone.
    """

    id: str
    run: int
    spec: ChildSpec
    delay_s: float
    why: Why


class StopChild(Struct, frozen=True):
    """End that run: ask, wait `shutdown_s` at most, kill. Cancels a delay or a start. Answer with decide_stopped."""

    id: str
    run: int
    shutdown_s: Shutdown


Event = Literal["started", "ignored", "start_failed", "exited", "stopped", "deleted", "gave_up", "auto_shutdown"]


class Report(Struct, frozen=True):
    """Something to log, keep in the history and tell subscribers.

    Attributes:
        event: started, ignored (on_start returned IGNORE), start_failed, exited (by itself), stopped (it was told to),
            deleted (by hand), gave_up (restart intensity exceeded because of this child), auto_shutdown (because of
            this significant child).
        id, run: the child and the start it is about.
        state: the child's state from now on; None when its specification is gone, and nobody will start it again.
        exit: how it ended, for exited and stopped (None when it was waiting for a start that will not be).
        error: for start_failed and gave_up.
        restarts: restarts within the window, this one included.
        delay_s: the delay before the restart that follows, for exited and start_failed.
    """

    event: Event
    id: str
    run: int
    state: ChildState | None
    exit: Exit | None = None
    error: BaseException | None = None
    restarts: int = 0
    delay_s: float = 0.0


class Reply(Struct, frozen=True):
    """The answer to an administrative call: `error` if set, else `id`: the child's, or None when it said IGNORE.

    start_child, restart_child: the child's id; terminate_child, delete_child, update: None.
    """

    caller: Hashable
    id: str | None = None
    error: RrError | None = None


class SupervisorStarted(Struct, frozen=True):
    """Every child is ready (or said IGNORE). Comes once."""


class ExitSupervisor(Struct, frozen=True):
    """All children are down: end, with this reason. Comes once, last.

    `error`: StartFailed, RestartIntensityExceeded, or None (told to stop, auto_shutdown). If no SupervisorStarted came
    before it, the start has failed: `error` says why, unless decide_stop cut it short.
    """

    reason: Reason
    error: RrError | None = None


Action = StartChild | StopChild | Report | Reply | SupervisorStarted | ExitSupervisor
Decision = tuple[Tree, list[Action]]
