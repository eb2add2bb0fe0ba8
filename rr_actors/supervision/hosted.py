"""Hosted: one actor that lives in this process, from its start to its end.

An actor placed as a thread cannot be killed. One that does not stop in time is reported as killed and abandoned: it is
taken out of the directory, and nothing waits for its thread any more.
"""

from __future__ import annotations

import abc
import asyncio
import threading
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, cast

import pykka

from rr_actors.actors.actor import IGNORE, NOT_FROZEN, Actor, BaseActor, ExitReport, Ignore, OnExit, is_frozen
from rr_actors.actors.messaging import exit_reports
from rr_actors.actors.messaging.exit_reports import abnormal
from rr_actors.actors.refs import ref_to
from rr_actors.actors.remote.proxy import as_answer
from rr_actors.base.checks import check_for_actor, invalid
from rr_actors.base.errors import StartFailed, is_a
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.declarations import Declared
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.manager import Manager
from rr_actors.runtime.callback_errors import raised_by
from rr_actors.runtime.time_limits import wait_while_running
from rr_actors.supervision.core.specs import Shutdown
from rr_actors.supervision.import_guard import in_progress

if TYPE_CHECKING:
    from pykka._envelope import Envelope

logger = Log("rr_actors.supervision")


def prepare(node: Node, cls: type[Any], path: str, on_exit: OnExit, *, once: bool = False) -> Hosted:
    """Return an actor of the class `cls` for this process, under `path`, which start() starts. On the loop.

    Args:
        cls: a class that check_hostable() accepts.
        on_exit: called on the loop, once, when the actor has ended by itself. Not called if its start failed, or
            after stop().
        once: the actor is temporary: it is not started again when it has ended.
    """
    kind = HostedActor if issubclass(cls, BaseActor) else HostedThread
    return kind(node, cls, path, on_exit, once=once)


def check_hostable(cls: Any, where: str, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None) -> None:
    """Check that `cls` is a class that can be a child, and that it takes the arguments, if there are any.

    Raises:
        InvalidSpec: of the field actor_class_or_manager, args or kwargs.
    """
    if not (isinstance(cls, type) and issubclass(cls, pykka.Actor)):
        expected = "a subclass of rr_actors.Manager, rr_actors.Actor or pykka.ThreadingActor, or a Supervisor"
        raise invalid(where, "actor_class_or_manager", expected, cast("object", cls))
    if is_frozen(cls):
        raise invalid(where, "actor_class_or_manager", NOT_FROZEN, cast("object", cls))
    if not issubclass(cls, Manager):
        own = [base for base in cls.__mro__ if base not in Actor.__mro__]
        declared = [name for base in own for name, found in vars(base).items() if is_a(found, Declared)]
        if declared:  # nobody would ever reach them
            expected = f"a subclass of rr_actors.Manager, as {declared[0]} is declared with @rr.server"
            raise invalid(where, "actor_class_or_manager", expected, cast("object", cls))
    if cls.__init__ in (BaseActor.__init__, pykka.Actor.__init__):  # they accept any arguments and ignore them
        for field, given in (("args", args), ("kwargs", kwargs)):
            if given:
                raise invalid(where, field, f"none, as {cls.__name__} has no __init__ of its own", given)


BRUTAL_GRACE_S = 0.1
"""The time limit of "brutal_kill" for an actor in this process, which cannot be killed, only asked and abandoned."""


class ActorPlace:
    """The place of an actor in a process, given to its hook _rr_before_start.

    Attributes:
        node: the process's runtime.
        path: the actor's, "root/cameras".
        id: its name among its siblings, "cameras".
        by_hand: start_child or restart_child asks for this start, and not the supervisor.
        cut_short: set by an actor whose start may take long and can be ended at once.
        kill: set by an actor that has processes below it, which can be killed.
        abandoned: set by an actor that holds what its successor needs; called when the actor is abandoned.
    """

    def __init__(self, node: Node, path: str) -> None:
        self.node = node
        self.path = path
        self.id = path.rpartition("/")[2]
        self.by_hand = False
        self.cut_short: Callable[[], None] | None = None
        self.kill: Callable[[], None] | None = None
        self.abandoned: Callable[[], None] | None = None


class Hosted(abc.ABC):
    """One actor in this process, from its start to its end. prepare() makes it; it is used on the loop."""

    def __init__(self, node: Node, cls: type[Any], path: str, on_exit: OnExit, *, once: bool) -> None:
        loop = asyncio.get_running_loop()
        self.path = path
        self.ref: pykka.ActorRef[Any] | None = None
        self._node = node
        self._cls = cls
        self._on_exit = on_exit
        self._once = once
        self._place = ActorPlace(node, path)
        self._starting: asyncio.Future[Any] | None = None
        self._started: asyncio.Future[None] = loop.create_future()  # start() has returned or raised
        self._ended: asyncio.Future[ExitReport] = loop.create_future()
        self._ready = False
        self._stopping = False

    async def start(
        self, args: Sequence[Any], kwargs: Mapping[str, Any], timeout_s: float | None, *, by_hand: bool = False
    ) -> bool:
        """Start the actor. Return True once others can reach it, False if its on_start returned IGNORE.

        Raises:
            StartFailed: it was not ready within `timeout_s`, or killed; it is stopped as soon as that is possible.
            BaseException: the error of `__init__` or on_start.
        """
        self._place.by_hand = by_hand
        starting = self._starting = asyncio.ensure_future(self._start(tuple(args), dict(kwargs)))
        try:
            await wait_while_running(starting, timeout_s)
            if not starting.done():
                await self._end_now(starting, ExitReport("abnormal", "did not start"))
                text = f"{self.path}: expected on_start to return within {timeout_s:g} s (start_timeout_s), it has not"
                if now := in_progress():
                    modules = ", ".join(map(repr, sorted(now)))
                    text += f"; what imports {modules} meanwhile waits, as another thread is doing so"
                raise StartFailed(text, id=self.path)
            if starting.cancelled():
                raise StartFailed(f"{self.path}: killed before it was ready", id=self.path)
            self._ready = starting.result() is not IGNORE
            if not self._ready:
                self._end(ExitReport("normal", "ignored"))
            elif self._ended.done():  # it has ended meanwhile
                self._tell()
            elif self.ref is not None:
                await self._enter(self.ref)
            return self._ready
        except BaseException:
            self._ask_to_stop(final=False)  # in case it runs all the same
            self._end(ExitReport("abnormal", "did not start"))
            raise
        finally:
            self._started.set_result(None)

    async def _enter(self, ref: pykka.ActorRef[Any]) -> None:
        """Let others reach the actor. If that cannot be written, stop it first: processes may run below it."""
        try:
            self._node.hub.add(self.path, ref, once=self._once)
        except BaseException:
            self._stopping = True
            self._ask_to_stop(final=False)
            await wait_while_running(self._ended, self._node.config.stop_timeout_s)
            if not self._ended.done():
                await self._end_now(self._ended, ExitReport("killed", "did not start"))
            raise

    async def stop(self, shutdown_s: Shutdown, *, final: bool) -> ExitReport:
        """Stop the actor and return how it ended. After `shutdown_s` kill or abandon it.

        Args:
            final: the actor will not be started again.
        """
        self._stopping = True
        if not self._started.done():
            self.cut_short()
        stopping = asyncio.ensure_future(self._come_to_end(final=final))
        try:
            await wait_while_running(stopping, _limit_s(shutdown_s))
            if stopping.done():
                stopping.result()
        finally:
            stopping.cancel()
        if not self._ended.done():
            why = f"had not stopped after shutdown_s={shutdown_s}"
            if self._place.kill is None:
                text = "%s %s: it runs in a thread of this process, which cannot be killed; abandoned"
                logger.error(text, self.path, why)
            await self._end_now(self._ended, ExitReport("killed", f"{why}; abandoned"))
        return self._ended.result()

    async def _come_to_end(self, *, final: bool) -> None:
        await asyncio.wait((self._started, self._ended), return_when=asyncio.FIRST_COMPLETED)
        if not self._ended.done():
            self._ask_to_stop(final=final)
            await asyncio.shield(self._ended)

    def cut_short(self) -> None:
        """End a start in progress, if the actor allows that. Then start() raises."""
        if self._place.cut_short is not None:
            self._place.cut_short()

    def kill(self) -> None:
        """Kill the processes below the actor, if it has set Place.kill; else abandon the actor."""
        self._stopping = True
        if self._place.kill is not None:
            self._place.kill()
            return
        if not self._ended.done():
            self._abandon(ExitReport("killed", "killed by its supervisor"))

    @abc.abstractmethod
    async def _start(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Ignore | None:
        """Return when on_start has returned. If cancelled, stop the actor as soon as that is possible."""

    @abc.abstractmethod
    def _ask_to_stop(self, *, final: bool) -> None:
        """Ask the actor to stop. It calls `_end` at its end."""

    async def _end_now(self, end: asyncio.Future[Any], report: ExitReport) -> None:
        """Kill the processes below the actor and wait for `end`; abandon an actor that has none."""
        if self._place.kill is None:
            self._abandon(report)
        else:
            self._place.kill()
            await asyncio.wait((end,))

    def _abandon(self, report: ExitReport) -> None:
        """Take an actor that does not stop out of its place. It ends when its thread returns from the user's code."""
        if self._starting is not None:
            self._starting.cancel()
        if self._place.abandoned is not None:
            self._place.abandoned()
        if self.ref is not None:
            self._ask_to_stop(final=False)  # wakes it, if it is not stuck
            threading.Event.set(self.ref.actor_stopped)  # a Pykka actor's own set() would tell of a normal end
        self._end(report)

    def _end(self, report: ExitReport) -> None:
        if self._ended.done():
            return
        self._ended.set_result(report)
        if self.ref is not None:
            self._node.hub.remove(self.path, self.ref, report)
        if self._ready:
            self._tell()

    def _tell(self) -> None:
        if not self._stopping:
            self._on_exit(self._ended.result())


class HostedActor(Hosted):
    """An actor of rr_actors: a Manager, an Actor, a supervisor."""

    async def _start(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Ignore | None:
        answer = await self._cls.launch(args, kwargs, path=self.path, place=self._place, on_exit=self._end)
        if answer is IGNORE:
            return IGNORE
        self.ref = answer
        return None

    def _ask_to_stop(self, *, final: bool) -> None:
        ref: Any = self.ref  # an ActorRef of ours
        if ref is not None:
            ref.stop(block=False, reason="shutdown", final=final)


class HostedThread(Hosted):
    """Any other Pykka actor, in a thread of its own. Its end is normal or abnormal.

    Pykka has no hook for the start and the end of an actor, so methods of the instance are wrapped.
    """

    _answer: asyncio.Future[Ignore | None]
    _report = ExitReport("normal", "stopped")

    async def _start(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Ignore | None:
        self._answer = asyncio.get_running_loop().create_future()
        await self._node.dispatcher.workers.run(self._make, args, kwargs)
        try:
            return await self._answer
        except asyncio.CancelledError:
            self._ask_to_stop(final=False)
            raise

    def _make(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Make the actor, wrap its methods and start its thread. In a worker, since __init__ is users' code."""
        actor: pykka.ThreadingActor = self._cls(*args, **kwargs)
        _Insides.wrap(actor, self)
        self.ref = actor.actor_ref
        _Insides.run(actor)

    def note(self, report: ExitReport) -> None:
        """Note how the actor ends, before it has. In its thread."""
        self._report = report

    def started(self, answer: object) -> None:
        """Hear that on_start has returned this. In the actor's thread."""
        self._node.dispatcher.call(self._has_started, answer, None)

    def over(self) -> None:
        """Hear that the actor's thread ends. In that thread."""
        self._node.dispatcher.call(self._has_started, None, self._report.exception)
        self._node.dispatcher.call(self._end, self._report)

    def _has_started(self, answer: Any, failure: BaseException | None) -> None:
        if self._answer.done():
            return
        if failure is None:
            self._answer.set_result(IGNORE if answer is IGNORE else None)
        else:
            self._answer.set_exception(exit_reports.as_heard(failure, self.path))

    def _ask_to_stop(self, *, final: bool) -> None:
        if self.ref is not None:
            self.ref.stop(block=False)


class _Insides(pykka.ThreadingActor):
    """The way to the methods that Pykka keeps for subclasses of its actors, as this is one. Nobody starts it."""

    @staticmethod
    def run(actor: pykka.ThreadingActor) -> None:
        """Start the actor's thread."""
        actor._start_actor_loop()

    @staticmethod
    def wrap(actor: pykka.ThreadingActor, hosted: HostedThread) -> None:
        """Wrap the actor's methods, so that `hosted` hears of its start and its end."""
        ref = ref_to(hosted.path)
        on_start, handle, loop, fail = actor.on_start, actor._handle_receive, actor._actor_loop, actor._handle_failure
        take: Callable[..., Envelope[Any]] = actor.actor_inbox.get
        envelope: Envelope[Any] | None = None  # of the message that the actor handles

        def wrapped_take(*args: Any, **kwargs: Any) -> Envelope[Any]:
            nonlocal envelope
            envelope = take(*args, **kwargs)
            return envelope

        def wrapped_on_start() -> None:
            answer = cast("object", on_start())
            if answer is IGNORE:
                actor.actor_stopped.set()
            hosted.started(answer)

        def wrapped_handle(message: Any) -> Any:
            try:
                check_for_actor(message, actor)
                return as_answer(actor, ref, message, handle(message))
            except Exception:
                raise
            except BaseException as error:  # Pykka would stop every actor of the process because of SystemExit in one
                raised = raised_by(error)
                if not (isinstance(error, SystemExit) and not error.code):
                    hosted.note(abnormal(raised))
                if envelope is not None and envelope.reply_to is not None:
                    reply, envelope.reply_to = envelope.reply_to, None  # Pykka would set it to None
                    dead = pykka.ActorDeadError(f"{hosted.path} ended while it handled the message: {raised.text}")
                    dead.__cause__ = error
                    reply.set_exception((pykka.ActorDeadError, dead, None))
                actor._stop()
                return None

        def wrapped_fail(
            exception_type: type[BaseException] | None, exception_value: Any, traceback: TracebackType | None
        ) -> None:
            hosted.note(abnormal(raised_by(exception_value)))
            fail(exception_type, exception_value, traceback)

        def wrapped_loop() -> None:
            try:
                loop()
            except BaseException as error:  # SystemExit in on_start
                hosted.note(abnormal(raised_by(error)))
                actor.actor_stopped.set()
            hosted.over()

        actor.on_start, actor._handle_receive = wrapped_on_start, wrapped_handle
        actor._actor_loop, actor._handle_failure = wrapped_loop, wrapped_fail
        actor.actor_inbox.get = wrapped_take
        vars(actor)["use_daemon_thread"] = True  # of this actor alone


def _limit_s(shutdown_s: Shutdown) -> float | None:
    if shutdown_s == "infinity":
        return None
    return BRUTAL_GRACE_S if shutdown_s == "brutal_kill" else float(shutdown_s)
