"""Message notes: while a system is recorded, each message between actors is noted where it is sent and handled.

A message carries its stamp, which joins the notes of several processes. An answer has the stamp of its question.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from contextvars import ContextVar
from typing import NamedTuple, Protocol

from pykka.messages import ProxyCall, ProxyGetAttr, ProxySetAttr

from rr_actors.actors.messaging.ask_cycles import activity
from rr_actors.base.checks import SupervisorLook
from rr_actors.base.errors import name_of_class, shortened, shown, text_of
from rr_actors.base.names import new_id
from rr_actors.runtime import event_loop

ASK, TELL, STOP, DOWN, TIMER = "Ask", "Tell", "Stop", "Down", "Timer"
"""The kinds of messages. A timer's is a tell."""
ANSWER, RAISED = "Answer", "Raised"
"""The kinds of answers: what a handler returned, and what it raised."""
MESSAGES = frozenset((ASK, TELL, STOP, DOWN, TIMER))
REPLIES = frozenset((ANSWER, RAISED))


class Stamp(NamedTuple):
    """What a noted message carries: an id that no other message has, its kind, and its sender's name."""

    id: str
    kind: str
    sender: str


class Level(Protocol):
    """Has one item, which is above 1 while a system is recorded."""

    def __getitem__(self, at: int, /) -> int: ...


class Observed(Protocol):
    """Has the level of a system."""

    @property
    def level(self) -> Level: ...


class NoteTaker(Protocol):
    """Takes the notes of one process of a system. From any thread."""

    def actor_message(self, event: str, actor: str, peer: str, stamp: Stamp, cause: str, text: str) -> None:
        """Note that an actor has "sent" a message to its peer, or "received" one from it.

        Args:
            cause: the id of the message that the sender was handling, or of the resource whose callback it ran.
        """

    def sender(self) -> tuple[str, str]:
        """Return the name that code of no handler sends by, and the id of the resource whose callback it is, or ""."""
        ...


class _Nobody:
    """No system: nothing is recorded."""

    level = (0,)


class _Several:
    """Several systems of one process."""

    def __init__(self, systems: Sequence[Observed]) -> None:
        self._systems = systems

    @property
    def level(self) -> Level:
        """The highest level of them."""
        return (max(system.level[0] for system in self._systems),)


class Notes:
    """The notes of this process. From any thread.

    Attributes:
        watched: the first item of its level is above 1 while a system of this process is recorded. Code that runs for
            each message looks there, in some 40 ns.
    """

    def __init__(self) -> None:
        self.watched: Observed = _Nobody()
        self._systems: tuple[tuple[Observed, NoteTaker], ...] = ()

    def begin(self, watched: Observed, taker: NoteTaker) -> None:
        """Have the taker note the messages while the system is recorded."""
        self._set((*self._systems, (watched, taker)))

    def end(self, taker: NoteTaker) -> None:
        """Have the taker note nothing any more."""
        self._set(tuple(known for known in self._systems if known[1] is not taker))

    def _set(self, systems: tuple[tuple[Observed, NoteTaker], ...]) -> None:
        self._systems = systems
        several = [watched for watched, _ in systems]
        self.watched = several[0] if len(several) == 1 else _Several(several) if several else _Nobody()

    def sent(self, kind: str, to: str, message: object) -> Stamp | None:
        """Note a message that this code sends to the actor `to`, and return its stamp; None if it only looks."""
        if isinstance(message, SupervisorLook):
            return None
        sender, cause = self.sender()
        if kind is TELL and (timer := _timer.get()) is not None:
            kind, (sender, cause) = TIMER, timer
        stamp = Stamp(new_id(), kind, sender)
        self._note("sent", stamp.sender, to, stamp, cause, _text(message))
        return stamp

    def down(self, to: str, ended: str, reason: str) -> Stamp:
        """Note the Down of an actor that has ended, to the actor that monitors it."""
        stamp = Stamp(new_id(), DOWN, ended)
        self._note("sent", ended, to, stamp, "", reason)
        return stamp

    def received(self, stamp: Stamp, to: str) -> None:
        """Note that the actor `to` begins to handle a message."""
        self._note("received", to, stamp.sender, stamp, "", "")

    def heard(self, stamp: Stamp, by: str, value: object) -> None:
        """Note that the thread that asks the actor `by` has its answer."""
        self._note("received", stamp.sender, by, stamp._replace(kind=ANSWER), "", _text(value))

    def answered(self, stamp: Stamp, by: str, value: object) -> None:
        """Note what the handler of the actor `by` has returned for a question."""
        self._note("sent", by, stamp.sender, stamp._replace(kind=ANSWER), "", _text(value))

    def raised(self, stamp: Stamp, by: str, error: BaseException) -> None:
        """Note what the handler of the actor `by` has raised for a question."""
        self._note("sent", by, stamp.sender, stamp._replace(kind=RAISED), "", shortened(text_of(error)))

    def sender(self) -> tuple[str, str]:
        """Return the name of the actor or process that runs this code, and for which message or resource."""
        me = activity.get()
        if me is not None and me.active:
            return me.target.name, me.message
        return self._systems[-1][1].sender() if self._systems else ("", "")

    @contextlib.contextmanager
    def as_timer(self, owner: tuple[str, str]) -> Generator[None]:
        """Within this block, a tell is a timer's; `owner` is what sender() returned when it was set."""
        token = _timer.set(owner)
        try:
            yield
        finally:
            _timer.reset(token)

    def _note(self, event: str, actor: str, peer: str, stamp: Stamp, cause: str, text: str) -> None:
        for watched, taker in self._systems:
            if watched.level[0] > 1:
                taker.actor_message(event, actor, peer, stamp, cause, text)


def _text(message: object) -> str:
    """Return what a message says, for people. On the loop only its class: its `__repr__` is users' code."""
    process = event_loop.current()
    if process is not None and process.is_loop_thread():
        return name_of_class(type(message))
    match message:
        case ProxyCall(attr_path=path, args=args, kwargs=kwargs):
            given = [*map(shown, args), *(f"{name}={shown(value)}" for name, value in kwargs.items())]
            return f"{'.'.join(map(str, path))}({', '.join(given)})"
        case ProxyGetAttr(attr_path=path):
            return ".".join(map(str, path))
        case ProxySetAttr(attr_path=path, value=value):
            return f"{'.'.join(map(str, path))} = {shown(value)}"
        case _:
            return shown(message)


_timer: ContextVar[tuple[str, str] | None] = ContextVar("rr_actors_timer", default=None)

notes = Notes()
"""The notes of this process."""
