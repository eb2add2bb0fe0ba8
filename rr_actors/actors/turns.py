"""The turn of an actor: who has it handles the actor's messages. TurnActor: an actor whose sender may take it.

A message is put into the mailbox. One thread at a time takes the turn, and handles the messages in their order. An
actor on the loop or in workers has a Driver that takes its turns. A TurnActor never waits in a handler, so its turn is
a lock that any thread may take:

- **The sender takes the turn**: a thread that finds the mailbox empty and the lock free handles its own message. It
  saves two changes of thread.
- The loop takes the turn for what it reads, and for all messages that wait.

With the lock no user code runs, nothing is pickled and no message is sent. A thread that has the lock never waits, and
never takes the lock of another actor. What follows from a message is done behind the turn, by the loop, in the order of
the turns (follow()).
"""

from __future__ import annotations

import abc
import functools
import itertools
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextvars import Context
from types import FrameType
from typing import Any, ClassVar, NoReturn, Self, cast

import pykka
from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.actor import BaseActor
from rr_actors.actors.messaging import dead_letters, death_watch
from rr_actors.actors.messaging.exit_reports import Birth, ExitReport
from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.actors.messaging.mailbox import is_stop, refuse_all
from rr_actors.actors.remote.hub import ActorHub
from rr_actors.base.errors import Unavailable, UsageError, shortened, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.runtime import event_loop
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.thread_rules import any_thread, on_loop, with_lock

logger = Log("rr_actors")

CLOSED = ExitReport("shutdown", "closed")
"""How a part ends that its owner ends."""

AT_ONCE = 128
"""The most messages of one turn: their senders get the first answers before the last messages are handled."""

_LOCKS = 16
"""The most locks of the actors of one process. More actors share them, so that has_a_turn() looks at few."""


class _Locks:
    """The locks of this process's living actors. Used on the loop, except for `owned`.

    Attributes:
        owned: for each, a function that says whether the calling thread has it. The tuple is replaced as a whole.
    """

    def __init__(self) -> None:
        self.owned: tuple[Callable[[], bool], ...] = ()
        self._users: dict[threading.RLock, int] = {}
        self._turn = itertools.count()

    def choose(self) -> threading.RLock:
        """Return a lock for one actor more: a new one, or one that some share."""
        if len(self._users) < _LOCKS:
            return threading.RLock()
        return list(self._users)[next(self._turn) % _LOCKS]

    def count(self, lock: threading.RLock, change: int) -> None:
        """Note that so many actors more use a lock."""
        users = self._users.get(lock, 0) + change
        if users:
            self._users[lock] = users
        else:
            del self._users[lock]
        if users in (0, change):  # the last has gone, or the first has come
            self.owned = tuple(_owned_of(lock) for lock in self._users)


def _owned_of(lock: threading.RLock) -> Callable[[], bool]:
    return lock._is_owned  # type: ignore[attr-defined]  # as in threading


_locks = _Locks()
os.register_at_fork(after_in_child=_locks.__init__)  # another thread may have had one of them, and is not in the child


def has_a_turn() -> bool:
    """Return whether the calling thread has the turn of any actor of this process.

    A finalizer (__del__) must not wait if so: the garbage collector runs it anywhere, also in the middle of a turn.
    """
    for is_owned in _locks.owned:  # noqa: SIM110 - any() takes longer
        if is_owned():
            return True
    return False


Delivery = tuple[Any, str | None]
"""A message between actors of the framework, with the name of its sender. A pair is made in a tenth of the time of an
envelope, and has nothing that an envelope has: nobody waits for a reply."""


class DatedDelivery(tuple[Any, str | None]):
    """A delivery that may wait long, and knows since when. `at`: when it was made, by time.monotonic()."""

    at: float

    def __new__(cls, message: Any, sender: str) -> Self:
        self = super().__new__(cls, (message, sender))
        self.at = time.monotonic()
        return self


class TurnActor(BaseActor, abc.ABC):
    """An actor of the framework that is a part of another one: its handlers never wait, and its sender may take a turn.

    Its owner makes it with made(), begins its life with begin_life(), and ends it with end_life(). It has no thread.

    Attributes:
        lock: the turn: the thread that has it handles the messages. Actors of one process share locks if there are
            many.
        is_inside: whether the calling thread has the turn; has_a_turn() asks it.
        waiting: the messages in the mailbox. A thread that takes the turn itself must find it empty.
        taken_by_senders: whether threads take its turn, too, and not the loop alone.
        gathers: whether many messages share a turn, so that each waits for the loop's next one.
        takes: how many messages it takes from the mailbox in one turn; 0: they wait until it is raised.
        closed: whether its life has ended; then nothing is handled any more.
    """

    # In a __dict__ of more than 30 attributes, as these have, CPython 3.11 finds each more slowly than in a slot.
    __slots__ = ("_busy", "_count_users", "_hub", "_is_user", "_scheduled", "is_inside", "lock", "waiting")
    _rr_lives_on_loop = True

    taken_by_senders: ClassVar[bool] = False
    lock: threading.RLock
    is_inside: Callable[[], bool]
    waiting: deque[PykkaEnvelope[Any] | Delivery]
    _count_users: Callable[[int], None]
    _hub: ActorHub | None
    gathers = False
    takes = AT_ONCE
    closed = False

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        self = super().__new__(cls, *args, **kwargs)
        self.lock = _locks.choose() if cls.taken_by_senders else threading.RLock()
        self.is_inside = _owned_of(self.lock)
        self._count_users = functools.partial(_locks.count, self.lock)
        self._is_user = False
        self._hub = None  # until its life begins
        self.waiting = cast("deque[PykkaEnvelope[Any] | Delivery]", self._rr_mailbox.waiting)
        self._busy = False  # the loop handles messages, or follows: a new message waits until it has finished
        self._scheduled = False  # a turn of the loop is scheduled
        return self

    @classmethod
    def made(cls, path: str, *args: Any) -> Self:
        """Make the actor that will live at a path of the tree."""
        return Context().run(Birth(path).of, cls, args, {})

    @classmethod
    def start(cls, *_args: Any, **_kwargs: Any) -> NoReturn:
        """Refuse to start: its owner begins its life.

        Raises:
            UsageError: always.
        """
        raise UsageError(f"{cls.__name__}.start(): it is a part of another actor, which begins its life")

    # -- life ----------------------------------------------------------------------------------------------------------

    @on_loop
    def begin_life(self, dispatcher: Dispatcher, hub: ActorHub) -> None:
        """Take messages from now on, and be found at the actor's path."""
        self._rr_dispatcher = dispatcher
        self._hub = hub
        self._rr_mailbox.begin(self._wake)
        self._rr_mailbox.rouse_again()
        death_watch.begin(self.actor_stopped)
        hub.host(self._rr_target.name, self.actor_ref)

    @on_loop
    def lock_in_use(self, *, in_use: bool) -> None:
        """Have has_a_turn() ask this actor's lock from now on, or no longer."""
        if in_use != self._is_user:
            self._is_user = in_use
            self._count_users(1 if in_use else -1)

    @on_loop
    def end_life(self, report: ExitReport) -> None:
        """Take no message any more, and report the end to those that monitor this actor.

        Deliveries that wait are dropped: their senders send them again, to the next incarnation.
        """
        if (hub := self._hub) is not None:  # else it has not begun
            hub.remove(self._rr_target.name, self.actor_ref, report)
        self.actor_stopped.set()
        left = self._rr_mailbox.close()
        refuse_all([envelope for envelope in left if not isinstance(envelope, tuple)], self._rr_target.name)
        death_watch.ended(self.actor_stopped, report)

    # -- handlers ------------------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def handle(self, deliveries: Sequence[Delivery]) -> None:
        """Handle messages of one turn. On the loop; with the lock, if senders may take the turn."""

    def follow(self) -> None:
        """Do what follows from the turns so far, in their order. On the loop, without the lock."""

    def on_receive(self, message: Any) -> Any:
        """Refuse a message that a user sends by tell or ask.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            f"{self._rr_target.name} takes messages of the framework alone, not {shortened(repr(message))}"
        )

    # -- messages ------------------------------------------------------------------------------------------------------

    @on_loop
    def deliver(self, message: Any, sender: str | None = None, *, more: bool = False) -> None:
        """Put a message into the mailbox, and take the turn if nobody has it.

        Args:
            more: others follow, to be handled together with it: all wait for the loop's next turn.
        """
        later = more or self.gathers or (self.taken_by_senders and self.is_inside())
        if self.takes and not (later or self.waiting or self._busy):
            self._busy = True
            try:
                if self.taken_by_senders:
                    with self.lock:
                        self.handle(((message, sender),))
                else:  # the loop has the turn
                    self.handle(((message, sender),))
                self.follow()
            finally:
                self._busy = False
            if self.waiting:
                self.take_turns()
            return
        self.waiting.append((message, sender))
        if self._busy or not self.takes:
            return
        if not later:
            self.take_turns()
        elif not self._scheduled:
            self._schedule()

    @on_loop
    def enqueue(self, message: Any) -> None:
        """Put a message into the mailbox. The caller takes the turn when it has put the last one (take_turns())."""
        self.waiting.append((message, None))

    @on_loop
    def take_turns(self) -> None:
        """Handle the messages that wait and may be taken, and do what follows, unless the loop is doing so."""
        if self._busy:
            return
        self._busy = True
        try:
            while self.waiting and (self.takes or not isinstance(self.waiting[0], tuple)):
                with self.lock:  # no thread takes the turn between taking the messages and handling them
                    count = min(len(self.waiting), self.takes or 1)
                    taken = [self.waiting.popleft() for _ in range(count)]
                    deliveries = [item for item in taken if isinstance(item, tuple)]
                    if deliveries:
                        self.handle(deliveries)
                if len(deliveries) < count:
                    self._take_letters([item for item in taken if not isinstance(item, tuple)])
                self.follow()
                if count == AT_ONCE and self.waiting:
                    self._schedule()
                    return
        finally:
            self._busy = False

    @on_loop
    def act(self) -> None:
        """Do what follows from the turns of other threads, then handle the messages that arrived meanwhile."""
        if self._busy:  # the loop does so after the present ones
            return
        self._busy = True
        try:
            self.follow()
        finally:
            self._busy = False
        self.take_turns()

    @with_lock
    def hold_up(self, again: Sequence[Delivery], retry_s: float) -> None:
        """Put messages back that could not be handled, and handle nothing more before `retry_s` seconds are over."""
        self.waiting.extendleft(reversed(again))
        self.takes = 0
        self._rr_dispatcher.loop.call_later(retry_s, self._resume)

    def _resume(self) -> None:
        self.takes = AT_ONCE
        self._turn()

    def _schedule(self) -> None:
        self._scheduled = True
        self._rr_dispatcher.loop.call_soon(self._turn)

    def _turn(self) -> None:
        self._scheduled = False
        self.take_turns()

    # -- letters: what others tell and ask by the reference ------------------------------------------------------------

    @any_thread
    def _wake(self, _urgent: bool) -> None:
        self._rr_dispatcher.call(self._woken)

    def _woken(self) -> None:
        if self.closed:
            return
        self._rr_mailbox.rouse_again()  # first: a letter that comes from now on has another turn
        self._take_letters(self._rr_mailbox.urgent())
        self.take_turns()

    def _take_letters(self, letters: Sequence[PykkaEnvelope[Any]]) -> None:
        for letter in letters:
            message, reply = letter.message, letter.reply_to
            if isinstance(reply, Reply) and not reply.set_running_or_notify_cancel():
                continue
            try:
                if is_stop(message):
                    raise UsageError(
                        f"{self._rr_target.name} is a part of another actor, and ends with that: stop that"
                    )
                result = self.on_receive(message)
            except Exception as error:
                self._refuse(message, reply, error)
            else:
                if reply is not None:
                    reply.set(result)

    def _refuse(self, message: Any, reply: pykka.Future[Any] | None, error: Exception) -> None:
        if reply is not None:
            fail(reply, error)
        else:
            dead_letters.office.record(self._rr_target.name, [message], shortened(text_of(error)), unheard=1)


# -- interruptions -----------------------------------------------------------------------------------------------------
#
# A Python signal handler may run in the main thread between any two of its instructions. It may stop the system, join a
# thread that loads, or make another call that waits for the loop. So it must not run while the thread has a turn, which
# the loop needs. The handlers of a program are therefore wrapped: one that comes in a turn is called a moment later.

CATCHABLE_SIGNALS = tuple(signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP})
_LOOK_AGAIN_S = 0.05  # asking for all handlers takes some 40 us

_NEVER_WAIT = frozenset({"asyncio", "trio", "unittest"})
"""Packages whose handlers wait for nothing, and are later compared with what is set: they stay as they are."""


class DeferredHandler:
    """A signal handler that is called when its thread has no turn: at once, or when the loop has sent the signal again.

    Args:
        handler: the program's own.
    """

    def __init__(self, handler: Callable[[int, FrameType | None], object]) -> None:
        self.handler = handler

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if not (has_a_turn() and _send_again(number)):
            self.handler(number, frame)


class _Interruptions:
    def __init__(self) -> None:
        self.main = threading.main_thread().ident
        self.look_at = 0.0
        self.found = False


_interruptions = _Interruptions()


def runs_handlers() -> bool:
    """Return whether signal handlers run in the calling thread, at least that of Ctrl-C, which raises."""
    return threading.get_ident() == _interruptions.main


def may_be_interrupted() -> bool:
    """Return whether a handler that waits may interrupt a turn of the calling thread; up to 50 ms old.

    The handlers of the program are wrapped here. That of Ctrl-C, which raises, is not: an interrupted turn is undone.
    """
    if threading.get_ident() != _interruptions.main:
        return False
    now = time.monotonic()
    if now >= _interruptions.look_at:
        _interruptions.found = not all(map(_never_waits_in_a_turn, CATCHABLE_SIGNALS))
        _interruptions.look_at = now + _LOOK_AGAIN_S
    return _interruptions.found


def _never_waits_in_a_turn(number: signal.Signals) -> bool:
    """Wrap the handler of a signal, if there is one that may wait; return False if that is impossible."""
    handler: Any = signal.getsignal(number)
    if not callable(handler) or isinstance(handler, DeferredHandler) or handler is signal.default_int_handler:
        return True
    function: object = getattr(handler, "func", handler)  # asyncio's is a partial
    if str(getattr(function, "__module__", "")).partition(".")[0] in _NEVER_WAIT:
        return True
    try:
        before = signal.signal(number, DeferredHandler(handler))
    except ValueError:  # a sub-interpreter has no signals
        return False
    if before is not handler:  # the handler ran just now, and set another
        signal.signal(number, before)
    return True


def _send_again(number: int) -> bool:
    """Have the loop send a signal to the main thread once more; return False if it has ended."""
    dispatcher, main = event_loop.current(), _interruptions.main
    if dispatcher is None or main is None:
        return False
    try:
        dispatcher.call(signal.pthread_kill, main, number)
    except Unavailable:
        return False
    return True


def _look_who_is_main() -> None:
    _interruptions.main = threading.main_thread().ident  # in a forked child it is the thread that forked


os.register_at_fork(after_in_child=_look_who_is_main)
