"""Actor: the two Pykka actor types of rr_actors. LoopActor's handlers run on the loop, Actor's in worker threads.

The life of an actor is one coroutine: it begins, handles messages until the actor is stopped, and ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import uuid
from collections.abc import Callable, Coroutine
from contextvars import Context
from time import monotonic
from types import TracebackType
from typing import Any, ClassVar, Literal, Self, cast

import pykka
from pykka import ActorRegistry
from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.drivers import PAUSE, REST, Await, Driver
from rr_actors.actors.messaging import dead_letters, death_watch, exit_reports
from rr_actors.actors.messaging.ask_cycles import Activity, Target, activity, here
from rr_actors.actors.messaging.exit_reports import IGNORE, Down, ExitReport, Ignore, OnExit, abnormal
from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.actors.messaging.mailbox import (
    DownNotice,
    Ended,
    Envelope,
    Mailbox,
    Packed,
    Starting,
    StopActor,
    is_stop,
    refuse_all,
)
from rr_actors.actors.messaging.message_notes import Stamp, notes
from rr_actors.actors.messaging.stepped_mailbox import SteppedMailbox
from rr_actors.actors.monitors import Monitor, begin, take
from rr_actors.actors.refs import ActorRef
from rr_actors.actors.remote.hub import is_debugged, running, urn_of_path
from rr_actors.actors.remote.proxy import as_answer
from rr_actors.base.checks import check_for_actor
from rr_actors.base.errors import Unavailable, UsageError, shortened, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.callback_errors import log_raised, raised_by
from rr_actors.runtime.event_loop import Dispatcher, acquire, check_may_block, release
from rr_actors.runtime.shielding import shielded
from rr_actors.runtime.user_loop import closing, is_coroutine

__all__ = ["IGNORE", "Actor", "BaseActor", "ExitReport", "Ignore", "LoopActor", "OnExit"]

logger = Log("rr_actors")

MAILBOX_LIMIT = 100_000
BATCH = 256
"""How many messages an actor on the loop handles before other callbacks have their turn."""


NOT_FROZEN = "a class whose attributes can be set, as an actor's must be (@dataclass, without frozen=True)"


def is_frozen(cls: type) -> bool:
    """Return whether the class is a frozen dataclass or attrs class."""
    parameters: Any = getattr(cls, "__dataclass_params__", None)
    return (parameters is not None and parameters.frozen) or getattr(
        cls.__setattr__, "__name__", ""
    ) == "_frozen_setattrs"


class BaseActor(pykka.Actor):
    """The base of both actor types: life, mailbox, exit report. Pykka documents how actors behave.

    Its private names, and those of Manager, begin with `_rr_`: a user's class has names such as `_target` and `_handle`
    of its own.
    """

    mailbox_limit: ClassVar[int] = MAILBOX_LIMIT
    """How many messages may wait; the sender of one more gets MailboxFull. Default: 100,000. Lower it, in the class, to
    hear earlier that the actor is too slow."""

    _rr_lives_on_loop: ClassVar[bool] = False
    """Whether its handlers run on the framework's loop, and not in worker threads."""

    _rr_on_exit: OnExit | None
    """Called on the loop, once, when the actor has ended. Not if it never started: the call that starts it raises."""

    _rr_place: Any
    _rr_target: Target
    _rr_mailbox: Mailbox
    _rr_dispatcher: Dispatcher
    _rr_life_driver: Driver
    _rr_started: Reply[Any]
    _rr_begun = False
    _rr_handled: PykkaEnvelope[Any] | None = None  # while a handler runs, for those that look
    _rr_handled_at = 0.0  # since when, by time.monotonic()
    _rr_report = ExitReport("normal")
    _rr_final = False
    _rr_stop_replies: list[pykka.Future[Any]]
    _rr_monitors: set[Monitor]  # the monitors that this actor has set

    def __new__(cls, *_args: Any, **_kwargs: Any) -> Self:
        # In __new__, and not in __init__: so a subclass's __init__ need not call this one.
        if is_frozen(cls):
            raise UsageError(f"{cls.__qualname__}: expected {NOT_FROZEN}, got a frozen class")
        self = super().__new__(cls)
        birth = exit_reports.take()
        self.actor_urn = uuid.uuid4().urn if birth.path is None else urn_of_path(birth.path)
        self._rr_place = birth.place
        self._rr_on_exit = birth.on_exit
        self._rr_target = Target(self.actor_urn, birth.path or f"{cls.__name__} ({self.actor_urn})")
        box = SteppedMailbox if not cls._rr_lives_on_loop and is_debugged(birth.path) else Mailbox
        self._rr_mailbox = box(self._rr_target.name, cls.mailbox_limit, opens_packed=not cls._rr_lives_on_loop)
        self.actor_inbox = self._rr_mailbox
        self.actor_stopped = threading.Event()
        self._actor_ref = ActorRef(self, self._rr_target, birth.path)
        self._rr_started = Reply(self._rr_target)
        self._rr_stop_replies = []
        self._rr_monitors = set()
        return self

    def __init__(self, *_args: Any, **_kwargs: Any) -> None:
        """Accept any arguments and do nothing: a subclass may call this, and need not."""

    @classmethod
    def start(  # pyright: ignore[reportIncompatibleMethodOverride]  # ActorRef is invariant; Pykka's own is no better
        cls, *args: Any, **kwargs: Any
    ) -> ActorRef[Self]:
        """Make an actor and wait until its on_start has returned. `__init__` runs in the calling thread.

        If on_start returns IGNORE, the reference is to an actor that has ended.

        Raises:
            UsageError: called on the loop, or in an `async def` callback, where waiting would delay all others.
            BaseException: the error that `__init__` or on_start raised; the actor has ended then.
        """
        check_may_block(f"{cls.__name__}.start()")
        actor = cls(*args, **kwargs)
        actor._start_actor_loop()
        actor._rr_started.get()
        return actor.actor_ref

    @classmethod
    async def launch(
        cls,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
        *,
        path: str | None = None,
        place: Any = None,
        on_exit: OnExit | None = None,
    ) -> ActorRef[Self] | Ignore:
        """Start an actor from the loop, and wait until its on_start has returned; for code that hosts actors.

        If this call is cancelled, it stops the actor as soon as possible, and on_exit is not called.

        Args:
            path: the actor's path in its tree; its URN follows from it and stays the same after a restart.
            place: handed to the hook _rr_before_start.
            on_exit: called on the loop, once, when the actor has ended.

        Raises:
            Exception: the error that `__init__` or on_start raised.
        """
        dispatcher = acquire()
        try:
            birth = exit_reports.Birth(path, place, on_exit)
            if cls._rr_lives_on_loop:
                actor = Context().run(birth.of, cls, args, kwargs or {})
            else:
                actor = await dispatcher.workers.run(birth.of, cls, args, kwargs or {})
            actor._start_actor_loop()
        finally:
            release()
        try:
            answer = await actor._rr_started
        except asyncio.CancelledError:
            actor._rr_on_exit = None
            actor.actor_ref.stop(block=False, reason="shutdown")
            raise
        return IGNORE if answer is IGNORE else actor.actor_ref

    def on_start(self) -> Any:
        """Override this to act before the first message. It may be `async def`, and may return IGNORE."""

    def on_stop(self) -> Any:
        """Override this to act when the actor has been asked to stop. It may be `async def`."""

    def on_failure(
        self,
        exception_type: type[BaseException] | None,
        exception_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> Any:
        """Override this to act, in place of on_stop, when an exception ends the actor. It may be `async def`."""

    def monitor(self, ref: Any) -> Monitor:
        """Send the message Down to this actor, once, when the actor of `ref` has ended.

        The monitor is of the actor's present life. An actor that is dead, or is being respawned, is down at once
        ("noproc"). Down overtakes the waiting messages; each of several monitors sends one. In an `async def` handler,
        the watch of an actor in another process begins a moment later; if it ends before, it is "noproc", too.

        Args:
            ref: a reference or proxy, or a SupervisorRef, to an actor in any process of the system.
        """
        mailbox, name = self._rr_mailbox, self._rr_target.name  # not self: a monitor does not keep its actor

        def deliver(monitor: Monitor, down: Down) -> None:
            stamp = notes.down(name, str(down.ref), down.reason) if notes.watched.level[0] > 1 else None
            mailbox.put(DownNotice(down, monitor, stamp))

        made = Monitor(ref, deliver, self._rr_monitors.discard)
        self._rr_monitors.add(made)  # first: its Down removes it
        begin(made)
        return made

    def stop(self, reason: Literal["normal", "shutdown"] = "normal") -> None:
        """Stop this actor when it has handled the waiting messages; with "shutdown", before it handles them."""
        self._rr_mailbox.put(Envelope(StopActor(reason)))

    # -- hooks for hosts: a subclass overrides them to do more than the user's on_start and on_stop --------------------

    async def _rr_before_start(self, place: Any) -> None:
        """Prepare the start, on the loop, before on_start."""

    async def _rr_after_start(self) -> None:
        """Complete the start, on the loop, when on_start has succeeded; the creator gets the reference after this."""

    async def _rr_after_stop(self, final: bool) -> None:
        """Clean up, on the loop, after on_stop or on_failure, if _rr_before_start succeeded. `final`: no restart."""

    # -- methods that Pykka calls --------------------------------------------------------------------------------------

    @staticmethod
    def _create_actor_inbox() -> Mailbox:
        return Mailbox("an actor", MAILBOX_LIMIT)

    @staticmethod
    def _create_future() -> Reply[Any]:
        return Reply()

    # -- life ----------------------------------------------------------------------------------------------------------

    @property
    def actor_ref(  # pyright: ignore[reportIncompatibleMethodOverride]  # as start()
        self,
    ) -> ActorRef[Self]:
        """The reference to this actor: for messages to itself, and to give to others in any process."""
        return cast("ActorRef[Self]", self._actor_ref)

    def _start_actor_loop(self) -> None:  # Pykka's name
        shielded(self._rr_enter_life)

    def _rr_enter_life(self) -> None:
        self._rr_dispatcher = acquire()  # released when the actor has ended
        self._rr_life_driver = Driver(
            self._rr_dispatcher, self._rr_live(), self._rr_mailbox, self._rr_target.name, on_loop=self._rr_lives_on_loop
        )
        self._rr_mailbox.begin(self._rr_life_driver.schedule)
        death_watch.begin(self.actor_stopped)
        running[self.actor_urn] = self.actor_ref  # this reference keeps the actor alive while it has no thread
        if self.actor_ref.path is None:  # ActorRegistry.stop_all() must not stop a supervised actor
            ActorRegistry.register(self.actor_ref)
        try:
            self._rr_life_driver.start()
        except BaseException:
            self._rr_life_driver.close()
            self._rr_vanish()
            refuse_all(self._rr_mailbox.close(), self._rr_target.name)
            death_watch.ended(self.actor_stopped, self._rr_report)
            release()
            raise

    async def _rr_live(self) -> None:
        envelope: PykkaEnvelope[Any] | None = None
        try:
            self._rr_handled, self._rr_handled_at = Envelope(Starting()), monotonic()
            if not await self._rr_begin():
                return
            handled = 0
            while not self.actor_stopped.is_set():
                self._rr_handled = envelope = self._rr_mailbox.next()
                if envelope is None:
                    handled = 0
                    await REST
                    continue
                self._rr_handled_at = monotonic()
                await self._rr_handle(envelope)
                handled += 1
                if handled == BATCH:
                    handled = 0
                    self._rr_handled = None
                    await PAUSE
        except GeneratorExit:  # the life is dropped, with its process
            raise
        except BaseException as error:  # nobody would take the next message: end, for the supervisor to restart it
            self._rr_break_off(error, self._rr_started if envelope is None else envelope.reply_to)
        await self._rr_end()

    def _rr_break_off(self, error: BaseException, reply: pykka.Future[Any] | None) -> None:
        """End this actor, as a turn of it has ended by an error that was not expected there."""
        self._rr_vanish()
        self._rr_note_failure(error)
        if reply is not None:
            text = f"{self._rr_target.name} ended, as its turn raised {raised_by(error).text}"
            with contextlib.suppress(queue.Full):  # it is answered already
                fail(reply, Ended(text, self._rr_target.name))

    async def _rr_begin(self) -> bool:
        doing = Activity(self._rr_target, ())
        activity.set(doing)
        failure: BaseException | None = None
        answer: Any = None
        try:
            await self._rr_hook(BaseActor._rr_before_start, self._rr_place)
            self._rr_begun = True
            doing.starts_in = here()
            answer = self.on_start()
            if is_coroutine(answer):
                answer = await Await(closing(answer, _start(answer, doing)))
            if answer is not IGNORE:
                await self._rr_hook(BaseActor._rr_after_start)
        except BaseException as error:
            failure = error
        finally:
            doing.active = False
        if failure is None and answer is not IGNORE:
            self._rr_started.set(None)
            return True
        self._rr_vanish()
        self._rr_on_exit = None
        if failure is not None:
            raised = raised_by(failure)
            self._rr_report = abnormal(raised)
            failure = failure if isinstance(failure, Exception) else raised.error
        await self._rr_end()
        if failure is None:
            self._rr_started.set(IGNORE)
        else:
            fail(self._rr_started, exit_reports.as_heard(failure, self._rr_target.name))
        return False

    async def _rr_handle(self, envelope: PykkaEnvelope[Any]) -> None:
        message, reply = envelope.message, envelope.reply_to
        if isinstance(envelope, DownNotice):
            monitor = cast("Monitor", envelope.claim)
            self._rr_monitors.discard(monitor)
            if take(monitor) is None:
                return
        doing = Activity(self._rr_target, getattr(envelope, "chain", ()))
        activity.set(doing)
        stamp: Stamp | None = getattr(envelope, "stamp", None)
        if stamp is not None:
            doing.message = stamp.id
            notes.received(stamp, self._rr_target.name)
        failure: BaseException | None = None
        try:
            if type(message) is Packed:
                try:
                    message = message.open()
                except BaseException as error:  # an error of the sender, not of this actor
                    self._rr_not_opened(message, error, reply)
                    return
            if is_stop(message):
                await self._rr_stop_now(message, reply)
                return
            if isinstance(reply, Reply) and not reply.set_running_or_notify_cancel():
                return
            result = self._handle_receive(message)
            if is_coroutine(result):
                result = await Await(result)
            if reply is not None:
                if stamp is not None:
                    notes.answered(stamp, self._rr_target.name, result)
                reply.set(as_answer(self, self.actor_ref, message, result))
        except BaseException as error:
            failure = error
        finally:
            doing.active = False
        if failure is None:
            return
        if stamp is not None and reply is not None:
            notes.raised(stamp, self._rr_target.name, failure)
        if not isinstance(failure, Exception):
            await self._rr_leave(failure, reply)
        elif reply is None:
            await self._rr_fail(failure)
        else:
            fail(reply, failure)
            logger.info("Exception returned from %s to caller:", self, exc_info=failure)
        del envelope, reply, failure  # the traceback has this frame

    def _rr_not_opened(self, packed: Packed, error: BaseException, reply: pykka.Future[Any] | None) -> None:
        if reply is None:
            logger.error("a message for %s cannot be opened here, and is dropped", self, exc_info=error)
            why = f"cannot be opened: {shortened(text_of(error))}"
            dead_letters.office.record(self._rr_target.name, [packed], why, unheard=0)  # the log has it
        else:
            fail(reply, error)

    async def _rr_stop_now(self, message: object, reply: pykka.Future[Any] | None) -> None:
        if reply is not None:
            self._rr_stop_replies.append(reply)
        self._rr_final = getattr(message, "final", False)
        await self._rr_stop_gracefully(ExitReport(getattr(message, "reason", "normal"), "stopped"))

    async def _rr_stop_gracefully(self, report: ExitReport) -> None:
        self._rr_vanish()
        self._rr_report = report
        logger.debug("Stopped %s", self)
        try:
            await self._rr_user(self.on_stop)
        except BaseException as error:
            self._rr_note_failure(error)

    async def _rr_leave(self, error: BaseException, reply: pykka.Future[Any] | None) -> None:
        """End this actor, and no other, after SystemExit or the like in a handler."""
        if reply is not None:
            text = f"{self._rr_target.name} ended while it handled the message: {raised_by(error).text}"
            dead = Ended(text, self._rr_target.name)
            dead.__cause__ = error
            reply.set_exception((Ended, dead, None))
        if isinstance(error, SystemExit) and not error.code:
            await self._rr_stop_gracefully(ExitReport("normal", "SystemExit"))
        else:
            await self._rr_fail(error)

    async def _rr_fail(self, error: BaseException) -> None:
        self._rr_vanish()
        self._rr_note_failure(error)
        try:
            await self._rr_user(self.on_failure, type(error), error, error.__traceback__)
        except BaseException as another:
            log_raised(logger, raised_by(another), "on_failure of %s raised:", self)

    async def _rr_end(self) -> None:
        self._rr_handled = None
        left: list[PykkaEnvelope[Any]] = []
        for envelope in self._rr_mailbox.close():
            if envelope.reply_to is not None and is_stop(envelope.message):
                self._rr_stop_replies.append(envelope.reply_to)
            else:
                left.append(envelope)
        refuse_all(left, self._rr_target.name)
        for monitor in list(self._rr_monitors):
            monitor.demonitor()
        if self._rr_begun:
            try:
                await self._rr_hook(BaseActor._rr_after_stop, self._rr_final)
            except BaseException as error:
                self._rr_note_failure(error)
        death_watch.ended(self.actor_stopped, self._rr_report)
        try:
            self._rr_dispatcher.call(self._rr_ended, self._rr_on_exit, self._rr_report, self._rr_stop_replies)
        except Unavailable:  # the loop has ended
            for reply in self._rr_stop_replies:
                reply.set(None)

    @staticmethod
    def _rr_ended(on_exit: OnExit | None, report: ExitReport, stop_replies: list[pykka.Future[Any]]) -> None:
        with contextlib.ExitStack() as steps:  # the last one is the first; each is done, whatever another one raises
            steps.callback(release)
            if on_exit is not None:
                steps.callback(on_exit, report)
            for reply in stop_replies:  # before on_exit: that may end this process, and an answer would be lost
                steps.callback(reply.set, None)

    def _rr_vanish(self) -> None:
        if running.get(self.actor_urn) is self.actor_ref:
            del running[self.actor_urn]
        if self.actor_ref.path is None:
            ActorRegistry.unregister(self.actor_ref)
        self.actor_stopped.set()

    def _rr_note_failure(self, error: BaseException) -> None:
        raised = raised_by(error)
        log_raised(logger, raised, "Unhandled exception in %s:", self)
        self._rr_report = abnormal(raised)

    async def _rr_user(self, fn: Callable[..., Any], *args: Any) -> Any:
        result = fn(*args)
        return await Await(result) if is_coroutine(result) else result

    async def _rr_hook(self, hook: Callable[..., Coroutine[Any, Any, None]], *args: Any) -> None:
        mine = getattr(type(self), hook.__name__)
        if mine is not hook:  # go to the loop only if a subclass has overridden the hook
            await Await(mine(self, *args), on_loop=True)


async def _start(on_start: Coroutine[Any, Any, Any], doing: Activity) -> Any:
    """Run an `async def` on_start, whose task becomes known to `doing`."""
    doing.starts_in = here()
    return await on_start


class LoopActor(BaseActor):
    """An actor of the framework: its handlers run on the loop and must not block. An `async def` one delays only it."""

    _rr_lives_on_loop = True


class Actor(BaseActor):
    """A base class for your actors. Worker threads handle its messages, one at a time, in order.

    on_receive handles messages that are sent with ask or tell, and a proxy calls methods. All of them may be
    `async def`: the next message waits until they have ended. An exception under tell ends the actor. Under ask it goes
    to the asker. SystemExit in a handler ends only this actor.

    It differs from pykka.ThreadingActor in three points. start() returns after on_start. Each message may run in
    another thread (contextvars stay, threading.local does not). A running actor does not keep the program from exiting.
    """

    def _handle_receive(self, message: Any) -> Any:
        check_for_actor(message, self)
        return super()._handle_receive(message)
