"""The supervisor as an actor, and SupervisorRef, with which an application calls it."""

from __future__ import annotations

import asyncio
import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple, cast

import pykka
from pykka import ActorDeadError
from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.actor import ExitReport, LoopActor
from rr_actors.actors.messaging.ask_cycles import INSTEAD, activity, check_end
from rr_actors.actors.messaging.futures import fail
from rr_actors.actors.messaging.mailbox import is_stop
from rr_actors.actors.refs import ActorRef, local_of, ref_to
from rr_actors.actors.remote.hub import hub, urn_of_path
from rr_actors.base.checks import NoSupervisor, SupervisorCall, check_id, examined, invalid
from rr_actors.base.errors import (
    ActorUnavailable,
    InvalidName,
    NotFound,
    RrError,
    StartFailed,
    UsageError,
    did_you_mean,
    exact_text,
    is_a,
    shown,
    text_of,
)
from rr_actors.base.notebook import note_started
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import trace_of
from rr_actors.registrar.servers.callback_context import check_not_own, serving
from rr_actors.runtime.processes.process import check_descriptors
from rr_actors.supervision.child_runs import Target
from rr_actors.supervision.core import child_calls
from rr_actors.supervision.core.child_calls import Counts
from rr_actors.supervision.core.foreseen import Foreseen, What, foresee
from rr_actors.supervision.core.rendering import describe_settings
from rr_actors.supervision.core.specs import (
    ChildModel,
    ChildSpec,
    EndReason,
    Seconds,
    Supervisor,
    as_child_spec,
    classes_of,
    count_processes,
)
from rr_actors.supervision.core.state import CallReply, ChildState, Decision, ExitSupervisor
from rr_actors.supervision.core.transition import within
from rr_actors.supervision.engine import Supervision
from rr_actors.supervision.event_history import Records
from rr_actors.supervision.hosted import ActorPlace, check_hostable
from rr_actors.supervision.import_guard import check_children_can_import
from rr_actors.wire.name_service import Directory, Presence, actor_key

logger = Log("rr_actors.supervision")

CALL_TIMEOUT_S = 60.0
_LOOK_S = 1.0  # to ask each supervisor that an error names
_SHOWN = 10  # supervisors in an error


class Child(NamedTuple):
    """A child, as which_children() lists it.

    Attributes:
        id: its id, the last part of its path.
        type: "supervisor" or "worker".
        ref: a reference that works whenever the child is running.
        state: "running", "restarting" (also during a backoff), "stopped", or "starting" during its first start.
        pid: the process in which the child runs; None while it does not. A child that has answered a load has one, also
            if its supervisor has not noted the start yet.
    """

    id: str
    ref: ActorRef[Any]
    type: Literal["worker", "supervisor"]
    state: ChildState
    pid: int | None

    def kill(self) -> bool:
        """Kill the child's process (SIGKILL), as `ref.kill()` does: its supervisor then acts as after a crash.

        Returns:
            False if the child does not run now. No process gets a signal then.

        Raises:
            UsageError: the child shares its process with others (placement="thread").
        """
        if self.ref.kill():
            return True
        path, pid = self.ref.path, self.pid
        process = hub(path)
        if path is None or pid is None or process is None:
            return False
        return process.kill_before_up(path, pid)

    @staticmethod
    def fails(
        every_s: Seconds | None = None,
        *,
        start_s: Seconds = 0.1,
        start_fails: float = 0.0,
        hangs: float = 0.0,
        stop_s: Seconds = 0.0,
        reason: EndReason = "killed",
    ) -> ChildModel:
        """Return a model of a child for `rr.simulate()`: how long it starts and lives, and how it ends.

        Args:
            every_s: seconds from when it is ready to its end: a number, `rr.Exponential(mean_s)` or
                `rr.Uniform(least_s, most_s)`, drawn for each life. Default: None, it lives for ever.
            start_s: seconds that a start takes. Default: 0.1. Set it to what you measured.
            start_fails: the part of its starts that fail, from 0 to 1. Default: 0.0. Raise it for a device that is
                not always there.
            hangs: the part of its lives at whose end it hangs instead. Its supervisor replaces it if the ChildSpec has
                a heartbeat_s. Default: 0.0. Raise it to see what a heartbeat is worth.
            stop_s: seconds that a stop takes. Default: 0.0. Set it for a slow on_stop.
            reason: how it ends: "killed", "abnormal" (an exception) or "normal". Default: "killed". Set "abnormal" for
                a child in a thread.

        Raises:
            InvalidSpec: `.field`, `.expected`, `.got`.
        """
        return ChildModel(every_s, start_s, start_fails, hangs, stop_s, reason)


Answer = Callable[[CallReply], None]
"""The `caller` of the core's decisions: a function that is called with the Reply."""


class SupervisorActor(LoopActor):
    """The actor that starts, watches, restarts and stops its children, as supervision/core/restarts.py decides.

    Its on_start returns when all children are ready. It ends with reason "shutdown" when it has restarted too often, or
    by auto_shutdown.
    """

    def __init__(self, spec: Supervisor) -> None:
        self._spec = spec
        self._supervision: Supervision
        self._all_up: asyncio.Future[None]
        self._all_down: asyncio.Future[ExitSupervisor]

    async def _rr_before_start(self, place: ActorPlace) -> None:
        loop = asyncio.get_running_loop()
        self._all_up, self._all_down = loop.create_future(), loop.create_future()
        self._supervision = Supervision(
            self._spec,
            place.path,
            place.node,
            target_of=target_of,
            on_started=lambda: self._all_up.set_result(None),
            on_exit=self._has_ended,
        )
        place.cut_short = lambda: self._supervision.stop(final=False)
        place.kill = self._supervision.kill

    @property
    def is_starting(self) -> bool:
        """Whether some children are not ready yet. Until they are, the supervisor does not answer."""
        return not self._rr_started.done()

    async def on_start(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]  # LoopActor allows async
        if not self._all_down.done():  # it may have been asked to stop
            check_descriptors(count_processes(self._spec), self._supervision.path)
            await self._supervision.start()
        await self._all_up

    async def on_stop(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._supervision.stop(final=self._rr_final)
        ending = await self._all_down
        if ending.error is not None:
            text = trace_of(ending.error)
            self._rr_report = ExitReport("shutdown", text_of(ending.error).partition(": ")[2], ending.error, text)

    async def on_failure(self, *_: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Stop the children after a defect of this class: none must run without a supervisor."""
        self._supervision.stop(final=False)
        await self._all_down

    async def _rr_after_stop(self, final: bool) -> None:
        await self._supervision.finish()

    def _has_ended(self, ending: ExitSupervisor) -> None:
        self._all_down.set_result(ending)
        if not self._all_up.done():
            path = self._supervision.path
            stopped = StartFailed(f"supervisor {path}: stopped before all its children were ready", id=path)
            self._all_up.set_exception(ending.error or stopped)
        elif not self.actor_stopped.is_set():
            self.stop("shutdown")

    # -- calls -----------------------------------------------------------------------------------------------------

    async def _rr_handle(self, envelope: PykkaEnvelope[Any]) -> None:
        message, reply = envelope.message, envelope.reply_to
        if isinstance(message, child_calls.Change):
            self._change(message, reply)  # answered later, so that other messages do not wait
        elif reply is None and not is_stop(message):
            logger.error(
                "supervisor %s: dropped a message that is no supervisor's call: %r", self._supervision.path, message
            )
        else:
            await super()._rr_handle(envelope)

    def on_receive(self, message: Any) -> Any:
        supervision = self._supervision
        match message:
            case child_calls.Question("which_children"):
                return [self._child(child.id) for child in child_calls.which_children(supervision.tree)]
            case child_calls.Question("which_child", id):
                return self._child(id)
            case child_calls.Question("count_children"):
                return child_calls.count_children(supervision.tree)
            case child_calls.Question("get_childspec", id):
                return child_calls.get_childspec(supervision.tree, id)
            case child_calls.Question("history"):
                return supervision.history.records()
            case child_calls.Question("describe"):
                return self._describe()
            case child_calls.Foresee(id, what):
                return foresee(supervision.tree, id, what, time.monotonic())
            case child_calls.ChildUpdated(id, spec):
                supervision.tree = child_calls.update_child(supervision.tree, id, spec)
                return supervision.tree.spec
            case _:
                raise UsageError(f"supervisor {supervision.path}: expected a supervisor's call, got {shown(message)}")

    def _change(self, change: child_calls.Change, reply: pykka.Future[Any] | None) -> None:
        def answer(outcome: CallReply) -> None:
            if reply is None:
                return
            if outcome.error is not None:
                fail(reply, outcome.error)
            else:
                reply.set(None if outcome.id is None else ref_to(self._supervision.path_of(outcome.id)))

        try:
            self._supervision.apply(self._decide(change, answer))
        except Exception as error:
            if reply is None:
                raise
            fail(reply, error)

    def _decide(self, change: child_calls.Change, answer: Answer) -> Decision:
        tree, now, subject = self._supervision.tree, time.monotonic(), change.subject
        match change.name:
            case "start_child":
                if change.id and tree.dynamic and change.id not in tree.children:
                    new = dataclasses.replace(tree.template, id=change.id)
                    self._supervision.entries.check_names(new, self._supervision.path_of(new.id))
                if isinstance(subject, ChildSpec | Supervisor) and subject.id not in tree.children:
                    new = as_child_spec(subject)
                    where = self._supervision.path_of(new.id)
                    if not isinstance(new.actor_class_or_manager, Supervisor):
                        check_hostable(new.actor_class_or_manager, where, new.args, new.kwargs)
                    self._supervision.entries.check_names(new, where)
                return child_calls.start_child(tree, subject, answer, now, change.id)
            case "terminate_child":
                return child_calls.terminate_child(tree, subject, answer, now)
            case "restart_child":
                return child_calls.restart_child(tree, subject, answer, now)
            case "delete_child":
                return child_calls.delete_child(tree, subject, answer, now)
            case "update":
                return child_calls.update(tree, subject, answer, now)

    def _describe(self) -> dict[str, Any]:
        tree, records = self._supervision.tree, self._supervision.history.records()
        restarts = Counter(record.id for record in records if record.event == "restarted")
        children: list[dict[str, Any]] = []
        for id, child in tree.children.items():
            life = self._supervision.life_of(id)
            pid, since, up_s = (None, None, None) if life is None else (life.pid, life.since, life.up_s)
            node = {"id": id, "type": child.spec.type, "state": child.state, "pid": pid}
            children.append(node | {"restarts": restarts[id], "since": since, "up_s": up_s})
        counted, excused = (
            len(within(some, time.monotonic(), tree.spec.max_seconds)) for some in (tree.restarts, tree.excused)
        )
        counts = {"recent_restarts": counted, "excused_restarts": excused}
        return describe_settings(tree.spec) | counts | {"children": children}

    def _child(self, id: str) -> Child:
        child = child_calls.find_child(self._supervision.tree, id)
        ref = ref_to(self._supervision.path_of(id))
        life = self._supervision.life_of(id)
        pid = life.pid if life is not None else self._supervision.entries.pid_of(child.spec, ref.path or "")
        return Child(id, ref, child.spec.type, child.state, pid)


def target_of(spec: ChildSpec) -> Target:
    """Return the class to start for a child in this process, and its arguments.

    Raises:
        InvalidSpec: the class cannot be hosted, or does not take its arguments.
    """
    what = spec.actor_class_or_manager
    if isinstance(what, Supervisor):
        return SupervisorActor, (what,), {}
    check_hostable(what, f"ChildSpec {spec.id!r}", spec.args, spec.kwargs)
    return what, spec.args, spec.kwargs


class SupervisorRef:
    """A reference to a running supervisor in any process of the system. It can be pickled.

    The methods block. Call them from any thread but the event loop's.

    Args:
        path: the ids from the root on, such as "root/inner".
        timeout_s: seconds that a call may take.

    Raises (every method):
        NotFound: there is no such supervisor any more. `.known` has those that exist.
        ActorUnavailable: the supervisor is being respawned.
        pykka.Timeout: the supervisor did not answer in time. It may still do what the call asked for.
        UsageError: the call would hang in this thread.
    """

    def __init__(self, path: str = "root", *, timeout_s: float = CALL_TIMEOUT_S) -> None:
        self.path = path
        self.timeout_s = timeout_s
        self._ref = ref_to(path)

    @property
    def id(self) -> str:
        """The supervisor's id among its siblings."""
        return self.path.rpartition("/")[2]

    @property
    def actor_ref(self) -> ActorRef[Any]:
        """A reference to the supervisor's actor, for a monitor."""
        return self._ref

    def which_children(self) -> list[Child]:
        """Return all children, newest first, as in OTP."""
        return self._ask(child_calls.Question("which_children"))

    def which_child(self, id: str | pykka.ActorRef[Any]) -> Child:
        """Return one child, as which_children() lists it.

        Raises:
            NotFound: there is no such child.
        """
        return self._ask(child_calls.Question("which_child", self._id_of(id)))

    def count_children(self) -> Counts:
        """Return the numbers of specifications, of running children, of supervisors and of workers."""
        return self._ask(child_calls.Question("count_children"))

    def get_childspec(self, id: str | pykka.ActorRef[Any]) -> ChildSpec:
        """Return the specification of a child; under simple_one_for_one also of the template, by its id.

        Raises:
            NotFound: there is no such child.
        """
        return self._ask(child_calls.Question("get_childspec", self._id_of(id)))

    def foresee(self, id: str, what: What) -> Foreseen:
        """Return what would happen here if a child was killed, stopped or restarted by hand now.

        Raises:
            NotFound: the supervisor has no such child.
        """
        return self._ask(child_calls.Foresee(id, what))

    def history(self) -> Records:
        """Return the last 1000 events of the children since the supervisor's own start, oldest first, as a list."""
        return Records(self._ask(child_calls.Question("history")))

    def describe(self) -> dict[str, Any]:
        """Return the supervisor's settings, and its children in their order with restarts and age, as plain data."""
        return self._ask(child_calls.Question("describe"))

    def start_child(
        self, spec: ChildSpec | Supervisor | Sequence[Any], *, id: str | None = None
    ) -> ActorRef[Any] | None:
        """Add a child and start it. Return its reference when it is ready, or None if its on_start returned IGNORE.

        Args:
            spec: the new child; under simple_one_for_one a list of additional arguments.
            id: under simple_one_for_one, the child's id. The child and its arguments are on disk then. They come back
                with their supervisor, also after a crash of the whole system. terminate_child() ends the child, and so
                does a clean stop of the system. A temporary child does not come back. Default: None, an id is made
                up, and the child ends with its supervisor.

        Raises:
            AlreadyStarted: a running child has that id.
            AlreadyPresent: a child that does not run has that id. A stopped one with an id of its own, which did not
                come back, starts with the new arguments instead.
            NameTaken: another manager has the id.
            InvalidSpec: this supervisor cannot have such a child, or no child can have such an id.
            TooManyChildren: the supervisor has max_children already.
            StartFailed: the child did not start, and is not added. `__cause__` has the reason.
            UsageError: a module that the child's process needs is still being imported.
        """
        if not issubclass(type(spec), (ChildSpec, Supervisor, list, tuple)):
            expected = "a ChildSpec or Supervisor, or a list of arguments for simple_one_for_one"
            raise invalid(f"start_child of {self.path}", "spec", expected, spec)
        if is_a(spec, (list, tuple)):
            with examined(f"start_child of {self.path}: arguments"):
                spec = list(cast("Sequence[Any]", spec))
        else:
            child = as_child_spec(cast("ChildSpec | Supervisor", spec))
            check_children_can_import(child, f"{self.path}/{child.id}", f"supervisor {self.path}: start_child()")
            note_started(classes_of(child))
        if id is not None:
            check_id(id, f"start_child of {self.path}")
        return self._ask(child_calls.Change("start_child", spec, id or ""))

    def terminate_child(self, id: str | pykka.ActorRef[Any]) -> None:
        """Stop a child and return when it is down. Its specification stays, unless it is temporary or dynamic.

        A dynamic child with an id of its own does not come back after that: it has unloaded what it serves, and is
        removed from disk.

        Raises:
            NotFound: there is no such child.
            UsageError: code of that child made the call, or of one below it, and would wait for itself.
        """
        child = self._id_of(id)
        path, what = f"{self.path}/{child}", f"supervisor {self.path!r}: terminate_child({child!r})"
        check_end(urn_of_path(path), what)
        check_not_own(what, lambda me: f"{serving(me).path}/".startswith(f"{path}/"), INSTEAD)
        self._ask(child_calls.Change("terminate_child", child))

    def restart_child(self, id: str | pykka.ActorRef[Any]) -> ActorRef[Any] | None:
        """Start a stopped child. Return its reference when it is ready, or None if its on_start returned IGNORE.

        Raises:
            NotFound: there is no such child.
            ChildRunning, ChildRestarting: the child is not stopped.
            StartFailed: the child did not start, and stays stopped. `__cause__` has the reason.
        """
        return self._ask(child_calls.Change("restart_child", self._id_of(id)))

    def delete_child(self, id: str | pykka.ActorRef[Any]) -> None:
        """Remove a stopped child's specification.

        Raises:
            NotFound: there is no such child.
            ChildRunning, ChildRestarting: the child is not stopped.
        """
        self._ask(child_calls.Change("delete_child", self._id_of(id)))

    def update(self, spec: Supervisor) -> None:
        """Give the supervisor a new specification.

        Existing children get their new specification at their next start. New children are added, and not started.

        Raises:
            InvalidSpec: it has another id, or changes from or to simple_one_for_one. Nothing has changed.
        """
        if not is_a(spec, Supervisor):
            raise invalid(f"update of {self.path}", "spec", "a Supervisor", spec)
        self._ask(child_calls.Change("update", spec))
        note_started(classes_of(as_child_spec(spec)))
        path, new = self.path, spec
        while "/" in path:  # the parent must have the new specification for the next start
            path, _, id = path.rpartition("/")
            new = SupervisorRef(path, timeout_s=self.timeout_s)._ask(child_calls.ChildUpdated(id, new))

    def _ask(self, call: SupervisorCall) -> Any:
        asker = _asker_below(self.path)
        if asker is not None and _starts_here(self._ref):
            raise _too_early(self.path, asker)
        try:
            return self._ref.ask(call, timeout=self.timeout_s)
        except ActorUnavailable as error:
            if asker is None:
                raise
            raise _too_early(self.path, asker) from error
        except (ActorDeadError, NoSupervisor) as error:
            known = tuple(_supervisors(self.path.partition("/")[0]))
            raise NotFound(f"supervisor {self.path!r}: {error}{_listed(known)}", id=self.path, known=known) from error

    def _id_of(self, child: str | pykka.ActorRef[Any]) -> str:
        if is_a(child, str):
            return exact_text(child)
        path = getattr(child, "path", None) if issubclass(type(child), pykka.ActorRef) else None
        if path is None or path.rpartition("/")[0] != self.path:
            raise NotFound(f"supervisor {self.path!r}: {shown(child)} is not a child of it", id=shown(child))
        return path.rpartition("/")[2]

    def __repr__(self) -> str:
        return f"<SupervisorRef {self.path}>"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SupervisorRef) and other.path == self.path

    def __hash__(self) -> int:
        return hash(self.path)

    def __reduce__(self) -> tuple[Any, ...]:
        return _supervisor_ref, (self.path, self.timeout_s)


def supervisor_at(path: str, directory: Directory) -> SupervisorRef:
    """Return the supervisor at `path`, also if it is stopped or being respawned.

    Raises:
        NotFound: the directory has no such path, or says that it is gone; `.known`.
    """
    try:
        entry = directory.lookup(actor_key(path))
    except InvalidName:
        entry = None
    if entry is not None and entry.status is not Presence.GONE:
        return SupervisorRef(path)
    known = tuple(_supervisors(path.partition("/")[0]))
    what = "there is none of this path" if entry is None else f"it is gone{entry.because}"
    hint = did_you_mean(path, known[1:])  # the first is the root
    raise NotFound(f"supervisor {shown(path)}: {what}{hint}{_listed(known)}", id=path, known=known)


def _listed(known: Sequence[str]) -> str:
    return f"; there are: {', '.join(known[:_SHOWN])}{', ...' * (len(known) > _SHOWN)}" if known else ""


def _asker_below(path: str) -> str | None:
    """Return the name of the actor whose handler asks, if it is below the supervisor at `path`."""
    me = activity.get()
    if me is None or not me.active or not me.target.urn.startswith(urn_of_path(path) + "/"):
        return None
    return me.target.name


def _starts_here(ref: ActorRef[Any]) -> bool:
    local = local_of(ref)
    actor: object = None if local is None else local._actor_weakref()  # pyright: ignore[reportPrivateUsage]
    return isinstance(actor, SupervisorActor) and actor.is_starting


def _too_early(path: str, asker: str) -> ActorUnavailable:
    return ActorUnavailable(
        f"supervisor {path!r} is starting {asker}, or a supervisor above it. It answers when all its children are "
        f"ready: do not wait for it in on_start; ask later, in the handler of a message that {asker} sends to itself",
        id=path,
    )


def _supervisors(path: str) -> Iterator[str]:
    """Yield the paths of the supervisor at `path` and of the supervisors below it that answer."""
    try:
        children: list[Child] = ref_to(path).ask(child_calls.Question("which_children"), timeout=_LOOK_S)
    except (RrError, ActorDeadError, pykka.Timeout):
        return
    yield path
    for child in reversed(children):
        if child.type == "supervisor":
            yield from _supervisors(f"{path}/{child.id}")


def _supervisor_ref(path: str, timeout_s: float) -> SupervisorRef:
    return SupervisorRef(path, timeout_s=timeout_s)
