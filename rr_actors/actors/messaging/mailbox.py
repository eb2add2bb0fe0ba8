"""Mailbox: an actor's inbox. It schedules the actor when the first message comes; control messages overtake others."""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

import msgspec
from pykka import ActorDeadError, ActorRef, Future
from pykka._envelope import Envelope as PykkaEnvelope
from pykka.messages import _ActorStop as PykkaStop  # pyright: ignore[reportPrivateUsage]

from rr_actors.actors.messaging import dead_letters
from rr_actors.actors.messaging.ask_cycles import Chain
from rr_actors.actors.messaging.exit_reports import Down
from rr_actors.actors.messaging.message_notes import Stamp
from rr_actors.base.errors import MailboxFull, Unavailable


class Envelope(PykkaEnvelope[Any]):
    """A message, the future for its reply, the actors that are blocked until it is answered, its stamp, and its time.

    It has a stamp while its system is recorded. `at`: when it was made, by time.monotonic().
    """

    __slots__ = ["at", "chain", "stamp"]

    def __init__(
        self, message: Any, reply_to: Future[Any] | None = None, chain: Chain = (), stamp: Stamp | None = None
    ) -> None:
        self.message = message
        self.reply_to = reply_to
        self.chain = chain
        self.stamp = stamp
        self.at = monotonic()


class DownNotice(Envelope):
    """A Down on its way to the actor that monitors. It goes by the control lane.

    `claim` is its Monitor: the actor drops the Down if the Monitor was cancelled.
    """

    __slots__ = ["claim"]

    def __init__(self, down: Down, claim: object, stamp: Stamp | None = None) -> None:
        super().__init__(down, stamp=stamp)
        self.claim = claim


class StopActor(PykkaStop):
    """Ask an actor to stop.

    "normal" waits for its turn, as Pykka documents; "shutdown", from its supervisor, overtakes queued messages.
    `final`: the actor will not be started again.
    """

    reason: str
    final: bool

    def __new__(cls, reason: str = "normal", *, final: bool = False) -> StopActor:
        self = super().__new__(cls)
        self.reason = reason
        self.final = final
        return self

    def __getnewargs_ex__(self) -> tuple[tuple[str], dict[str, bool]]:
        return (self.reason,), {"final": self.final}


def is_stop(message: object) -> bool:
    """Return whether the message asks the actor to stop: a Stop, or a stop of Pykka's own references or registry."""
    return isinstance(message, PykkaStop)


class Ended(ActorDeadError):
    """The actor `name` has ended. A handler may raise this about another actor, so the name is kept."""

    def __init__(self, text: str, name: str = "") -> None:
        super().__init__(text)
        self.name = name


def has_ended(error: BaseException, name: str) -> bool:
    """Return whether `error` says that the actor `name`, to which a message was sent, is dead."""
    if isinstance(error, Ended):
        return error.name == name
    # An error that an ending Pykka actor sets was never raised; an error from a handler was.
    return isinstance(error, ActorDeadError) and error.__traceback__ is None


class Starting:
    """What an actor handles that is in its on_start."""


class Packed(msgspec.Struct, frozen=True, eq=False):
    """A pickled message, which is unpickled where its actor runs, never on the loop.

    Attributes:
        size: in bytes.
        sender: the name of the process that sent it.
        blob: its pickle, unless that is in shared memory.
    """

    open: Callable[[], Any]
    size: int
    sender: str = ""
    blob: bytes = b""

    def __repr__(self) -> str:
        return f"<{self.size} bytes>"


class Mailbox:
    """The messages of one actor, first in, first out. A message to an actor at rest calls `schedule`.

    Args:
        owner: the actor's name, for errors.
        limit: the number of messages it can hold; the limit does not hold for stop messages and Downs.
        opens_packed: whether it accepts Packed messages: the actor unpickles them off the loop.

    Attributes:
        waiting: the messages that wait for their turn, first in, first out.
        limit: how many of them there may be.
    """

    is_paused = False

    def __init__(self, owner: str, limit: int, *, opens_packed: bool = False) -> None:
        self.opens_packed = opens_packed
        self._owner = owner
        self.limit = limit
        self._lock = threading.Lock()
        self.waiting: deque[PykkaEnvelope[Any]] = deque()
        self._control: deque[PykkaEnvelope[Any]] = deque()
        self._at_rest = False  # until the actor has started
        self._due = False  # whether the actor was scheduled and has not begun that turn
        self._schedule: Callable[[bool], None] | None = None
        self._open = True

    def begin(self, schedule: Callable[[bool], None]) -> None:
        """Set `schedule`: after rest() the next message calls schedule(urgent); stops and Downs are urgent."""
        self._schedule = schedule

    def put(self, envelope: PykkaEnvelope[Any], /) -> None:
        """Queue a message. A supervisor's stop and a Down overtake the queued messages.

        Raises:
            ActorDeadError: the actor has stopped.
            MailboxFull: `limit` messages are queued, or no thread is free for the actor; nothing was queued.
        """
        message = envelope.message
        notice = type(envelope) is DownNotice
        urgent = notice or is_stop(message)
        overtakes = notice or (urgent and getattr(message, "reason", "normal") == "shutdown")
        lane = self._control if overtakes else self.waiting
        schedule: Callable[[bool], None] | None = None
        queued = False
        try:
            with self._lock:
                self._check(urgent=urgent)
                if self._at_rest and self._schedule is not None:
                    schedule = self._schedule
                    self._at_rest, self._due = False, True
                lane.append(envelope)
                queued = True
            if schedule is not None:
                schedule(urgent)  # without the lock: the actor may need it before this returns
        except BaseException as error:
            if schedule is None or self._taken_back(lane, envelope, schedule, queued=queued):
                raise
            if not isinstance(error, Unavailable):
                raise

    def _check(self, *, urgent: bool) -> None:
        if not self._open:
            raise Ended(f"{self._owner} not found", self._owner)
        if not urgent and len(self.waiting) >= self.limit:
            raise MailboxFull(
                f"mailbox of {self._owner}: holds {self.limit} messages, its limit; send less, ask instead of "
                f"telling, or raise the class's mailbox_limit",
                name=self._owner,
                limit=self.limit,
            )

    def first(self, count: int) -> list[PykkaEnvelope[Any]]:
        """Return the first messages, at most `count`; they stay. From any thread."""
        while True:
            try:
                return list(itertools.islice(itertools.chain(self._control, self.waiting), count))
            except RuntimeError:  # another thread has put or taken one meanwhile
                continue

    def take_turn(self) -> bool:
        """Take the turn for which the actor was scheduled; return False if it was taken before."""
        with self._lock:
            due, self._due = self._due, False
        return due

    def _taken_back(
        self,
        lane: deque[PykkaEnvelope[Any]],
        envelope: PykkaEnvelope[Any],
        schedule: Callable[[bool], None],
        *,
        queued: bool,
    ) -> bool:
        """Take a message back after an error of `schedule`; return False if it was refused or taken already."""
        with self._lock:
            if not self._due:
                return False
            if envelope in lane:
                lane.remove(envelope)
            elif queued:
                return False
            self._at_rest = self.empty()
            if self._at_rest:
                self._due = False
                return True
        self._rouse(schedule)  # for messages that have come meanwhile
        return True

    def _rouse(self, schedule: Callable[[bool], None]) -> None:
        """Schedule the actor for messages that wait. If that fails, the next message schedules it for them."""
        try:
            schedule(True)
        except BaseException:
            with self._lock:
                self._at_rest, self._due = True, False
            raise

    def next(self) -> PykkaEnvelope[Any] | None:
        """Take the next message; None if the mailbox is empty."""
        try:
            return self._control.popleft() if self._control else self.waiting.popleft()
        except IndexError:
            return None

    def urgent(self) -> list[PykkaEnvelope[Any]]:
        """Take the stops and Downs that overtake the waiting messages."""
        return [self._control.popleft() for _ in range(len(self._control))]

    def get(self) -> PykkaEnvelope[Any]:
        """Take the next message without waiting (Pykka calls this); raise LookupError if the mailbox is empty."""
        envelope = self.next()
        if envelope is None:
            raise LookupError(f"mailbox of {self._owner}: empty")
        return envelope

    def empty(self) -> bool:
        """Return whether the mailbox is empty."""
        return not self.waiting and not self._control

    def rest(self) -> bool:
        """Note that the actor rests, so that the next put() schedules it; return False if a message came meanwhile."""
        with self._lock:
            self._at_rest = not self.waiting and not self._control
            return self._at_rest

    def rouse_again(self) -> None:
        """Have the next put() schedule the actor, also while messages wait."""
        with self._lock:
            self._at_rest = True

    def close(self) -> list[PykkaEnvelope[Any]]:
        """Refuse messages from now on, and return those that were not handled."""
        with self._lock:
            self._open = False
            self._schedule = None  # it refers to the actor, whose memory may be freed now
            left = [*self._control, *self.waiting]
            self._control.clear()
            self.waiting.clear()
            return left

    def __len__(self) -> int:
        return len(self.waiting) + len(self._control)


def put(ref: ActorRef[Any], envelope: Envelope, name: str) -> None:
    """Put an envelope into the mailbox of the actor `name` of this process, or raise Ended or MailboxFull."""
    if ref.actor_stopped.is_set():
        raise Ended(f"{name} not found", name)
    ref.actor_inbox.put(envelope)


def refuse_all(envelopes: list[PykkaEnvelope[Any]], name: str) -> None:
    """Answer the messages that an ended actor has not handled, and record them as dead letters."""
    for envelope in envelopes:
        reply = envelope.reply_to
        if reply is not None and is_stop(envelope.message):
            reply.set(None)  # as the actor has ended
        elif reply is not None:
            reply.set_exception((Ended, Ended(f"{name} stopped before handling the message", name), None))
    letters = [envelope for envelope in envelopes if type(envelope) is not DownNotice and not is_stop(envelope.message)]
    if letters:
        dead_letters.office.record(
            name,
            [letter.message for letter in letters],
            "stopped before handling it",
            unheard=sum(letter.reply_to is None for letter in letters),
        )
