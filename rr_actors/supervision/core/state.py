"""The state of one supervisor as a value, and the actions that its decisions ask for.

A SupervisorState is never changed: every decision in restarts.py and child_calls.py returns a new one, with the actions
to perform. Nothing here starts, stops or waits for anything; supervision/engine.py does.

The duties of the performer, without which the decisions are wrong:

- It calls the decisions one at a time, keeps the state that each returns, and performs the actions at once, in order.
- Every StartChild has a number of its own, `run`. For each it calls one `decide_started` or `decide_start_failed`
  (after the delay, the start, the time limit). Late reports do no harm: those about an earlier run of the child are
  ignored.
- If a child that was reported as started ends without a StopChild, it calls `decide_exit` once.
- For every StopChild(run) it calls exactly one `decide_stopped`, when nothing of that run can act any more or it is
  abandoned: also if that run was waiting out its delay, was starting, or had ended by itself meanwhile.
"""

from __future__ import annotations

import enum
from collections.abc import Hashable, Mapping
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
        code: exit code of its process, -N for signal N; None without a process, or if the code is unknown.
        traceback: of the exception that ended it, as text.
    """

    reason: Reason
    detail: str = ""
    code: int | None = None
    traceback: str = ""

    def __str__(self) -> str:
        return f"{self.reason} ({self.detail})" if self.detail else self.reason


class ChildPhase(enum.Enum):
    """The phase of a child between start and stop, as the core sees it."""

    STOPPED = enum.auto()  # down, and nothing will start it by itself (OTP: undefined)
    DUE = enum.auto()  # down, to be started when its turn comes
    STARTING = enum.auto()  # a StartChild is out, unanswered (its delay included)
    RUNNING = enum.auto()
    CONDEMNED = enum.auto()  # up or coming up, to be stopped for a group restart when its turn comes
    RECYCLING = enum.auto()  # a StopChild is out, unanswered; then it is DUE
    STOPPING = enum.auto()  # a StopChild is out, unanswered; then it stays down


class Why(enum.Enum):
    """The purpose of a start. It decides what a failed start leads to."""

    INIT = enum.auto()  # the supervisor's own start, which fails, too
    NEW = enum.auto()  # start_child: the specification is dropped, the caller gets the error
    MANUAL = enum.auto()  # restart_child: the child stays stopped, the caller gets the error
    RESTART = enum.auto()  # a restart: the failure counts, and the start is tried again


class Call(Struct, frozen=True):
    """An administrative call. The Reply goes to `caller`; a start adds `child`."""

    kind: Literal["start", "terminate", "restart", "delete"]
    id: str
    caller: Hashable
    child: SupervisedChild | None = None


class SupervisedChild(Struct, frozen=True):
    """One child of a supervisor.

    Attributes:
        id: its name; under simple_one_for_one a generated one.
        spec: its specification. Under simple_one_for_one the template's; `extra` are this child's additional arguments.
        kept: whether it is a dynamic child that start_child() was given an id for. It is on disk, and comes back with
            its supervisor, until it has ended for good.
        lost: of a kept child, why it cannot be started from what is on disk.
        run: number of its present or last start among those of all children; 0 before the first. `previous`: of the
            start before.
        starts: how often it has been started.
        why: the purpose of its present start; RESTART once it is up, since the next start will be a restart.
        up_at: when this run became ready, monotonic seconds; None before.
        attempts: restarts since it last ran for long enough (for the backoff).
        doubted: its last start failed while callbacks of resources ran, and did not count. The present start has to say
            whether one of them ended the process.
        wanting: starts in a row that failed because resources were missing (base/scarcity.py).
        starters, stoppers: callers that get a Reply when it is up (or has failed), or down.
        waiting: calls to be made again when its start or stop has ended.
    """

    id: str
    spec: ChildSpec
    extra: tuple[Any, ...] = ()
    kept: bool = False
    lost: RrError | None = None
    phase: ChildPhase = ChildPhase.STOPPED
    why: Why = Why.INIT
    run: int = 0
    previous: int = 0
    starts: int = 0
    up_at: float | None = None
    attempts: int = 0
    wanting: int = 0
    doubted: bool = False
    starters: tuple[Hashable, ...] = ()
    stoppers: tuple[Hashable, ...] = ()
    waiting: tuple[Call, ...] = ()

    @property
    def state(self) -> ChildState:
        """The state that which_children shows. A child that a caller stops is "running" until it is down."""
        match self.phase:
            case ChildPhase.STOPPED:
                return "stopped"
            case ChildPhase.RUNNING | ChildPhase.STOPPING:
                return "running"
            case _:
                return "restarting" if self.why is Why.RESTART else "starting"

    @property
    def down(self) -> bool:
        """Whether nothing of the child runs."""
        return self.phase in (ChildPhase.STOPPED, ChildPhase.DUE)

    @property
    def start_spec(self) -> ChildSpec:
        """The specification for its next start; of a dynamic child the template with its own id and extra arguments."""
        if self.id == self.spec.id:
            return self.spec
        return replace(self.spec, id=self.id, args=(*self.spec.args, *self.extra))


class KeptChild(Struct, frozen=True):
    """A kept child of an earlier incarnation of its supervisor, as it is on disk: `args`, or why they are `lost`."""

    id: str
    args: tuple[Any, ...] = ()
    lost: RrError | None = None


class Restart(Struct, frozen=True):
    """A restart that counts: when (monotonic seconds), which child, why, and which of its runs had ended."""

    at: float
    id: str
    reason: str
    run: int = 0


class Mode(enum.Enum):
    """The phase of the supervisor itself."""

    NEW = enum.auto()
    STARTING = enum.auto()
    RUNNING = enum.auto()
    STOPPING = enum.auto()
    STOPPED = enum.auto()


class SupervisorState(Struct, frozen=True):
    """The state of one supervisor. Make it with `SupervisorState.of(spec, path)`.

    Attributes:
        spec: its specification as last given (strategy, intensity, auto_shutdown ...; the children are in `children`).
        path: its place in the tree, "root/inner", for messages.
        children: by id, in start order; after the first decision a `Children`.
        restarts: the restarts that count, oldest first.
        excused: restarts that do not count, as callbacks of resources ran: they do, if all of those are found innocent.
        last_run, last_dynamic: the last numbers given out.
        generation: part of the ids of dynamic children (`of`).
        delay_s: backoff still to be waited out before the group's next start.
        error: why it is stopping; None if it was asked to, or by auto_shutdown.
    """

    spec: Supervisor
    path: str
    mode: Mode = Mode.NEW
    children: Mapping[str, SupervisedChild] = field(default_factory=dict[str, SupervisedChild])
    restarts: tuple[Restart, ...] = ()
    excused: tuple[Restart, ...] = ()
    last_run: int = 0
    last_dynamic: int = 0
    generation: str = ""
    delay_s: float = 0.0
    error: RrError | None = None

    @staticmethod
    def of(spec: Supervisor, path: str | None = None, generation: str = "") -> SupervisorState:
        """Return a supervisor before its start: its static children stopped, or a template and no children.

        Dynamic children are called "template-1", "template-2" ...; with a generation "a7", "template-a7.1". Give each
        incarnation of a supervisor another one. A reference to an earlier dynamic child must not reach a new one.
        """
        specs = () if spec.strategy == "simple_one_for_one" else spec.child_specs
        return SupervisorState(
            spec, path or spec.id, children={s.id: SupervisedChild(s.id, s) for s in specs}, generation=generation
        )

    @property
    def dynamic(self) -> bool:
        """Whether the children are made at run time from one template."""
        return self.spec.strategy == "simple_one_for_one"

    @property
    def template(self) -> ChildSpec:
        """The specification from which all dynamic children are made."""
        return as_child_spec(self.spec.children[0])

    def awaited(self, why: Why) -> bool:
        """Return whether the children that are due start only when a child is up that starts for this purpose."""
        return self.grouped or why is Why.INIT

    def dynamic_id(self, number: str) -> str:
        """Return the id of the dynamic child with that number, within the length limit of ids."""
        return f"{self.template.id[:40]}-{self.generation}{'.' if self.generation else ''}{number}"

    @property
    def grouped(self) -> bool:
        """Whether a restart may concern several children."""
        return self.spec.strategy in ("one_for_all", "rest_for_one")


# -- actions -------------------------------------------------------------------------------------------------------


class StartChild(Struct, frozen=True):
    """Wait `delay_s`, then start the child by `spec` (which has a dynamic child's extra arguments already).

    Answer with decide_started or decide_start_failed. If a StopChild of the same run came meanwhile, answer with
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
    """An event to log, to keep in the history and to send to subscribers.

    Attributes:
        event: started, ignored (on_start returned IGNORE), start_failed, exited (by itself), stopped (on request),
            deleted (by hand), gave_up (restart intensity exceeded because of this child), auto_shutdown (because of
            this significant child).
        id, run: the child and the start it is about. `starts`: how often the child had been started by then.
        state: the child's state from now on; None when its specification is gone, so that it never starts again.
        exit: how it ended, for exited and stopped (None if it only waited for a start, which is dropped).
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
    starts: int = 0


class CallReply(Struct, frozen=True):
    """The answer to an administrative call: `error` if set, else the child's `id`, or None if it returned IGNORE.

    start_child, restart_child: the child's id; terminate_child, delete_child, update: None.
    """

    caller: Hashable
    id: str | None = None
    error: RrError | None = None


class SupervisorStarted(Struct, frozen=True):
    """Every child is ready, or returned IGNORE. Comes once."""


class ExitSupervisor(Struct, frozen=True):
    """All children are down: end the supervisor with this reason. Comes once, last.

    `error`: StartFailed, RestartIntensityExceeded, or None (asked to stop, auto_shutdown). If no SupervisorStarted came
    before it, the start has failed: `error` says why, unless decide_stop cut it short.
    """

    reason: Reason
    error: RrError | None = None


Action = StartChild | StopChild | Report | CallReply | SupervisorStarted | ExitSupervisor
Decision = tuple[SupervisorState, list[Action]]
