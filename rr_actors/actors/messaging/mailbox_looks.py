"""Looks at mailboxes: what waits, since when, and what is handled; and orders: pause, step, resume.

The loop of the actor's process, or any thread of it, carries them out, and not the actor.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from time import monotonic
from typing import Any, cast

import msgspec
import pykka
from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.messaging.ask_cycles import waits_of
from rr_actors.actors.messaging.mailbox import Envelope, Mailbox, Packed, Starting
from rr_actors.actors.messaging.stepped_mailbox import SteppedMailbox
from rr_actors.base.errors import UsageError, name_of_class
from rr_actors.base.pickled_types import type_in

LOOK, PAUSE, STEP, RESUME = "mailbox", "pause", "step", "resume"
ORDERS = frozenset((LOOK, PAUSE, STEP, RESUME))

COUNTED = 256
"""How many of the first messages a look counts by their types."""
ON_START = "on_start"
"""What a starting actor handles."""


class MessageInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """A message that waits in a mailbox, or is being handled.

    Attributes:
        type: the name of its type; "ProxyCall" for a call by a proxy; "" if it is not known before it is opened.
            "on_start" is what a starting actor handles.
        sender: the actor that waits for the answer, or the process that sent it; "" if it is not known.
        since_s: for how many seconds it has waited in this mailbox, or has been handled; None if it is not known.
    """

    type: str
    sender: str = ""
    since_s: float | None = None

    def __str__(self) -> str:
        sender = f" from {self.sender}" if self.sender else ""
        return f"{self.type or 'a message'}{sender}"


class MailboxInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """The mailbox of an actor at one moment, and what the actor does.

    Attributes:
        path: the actor's path.
        limit: how many messages may wait.
        length: how many messages wait.
        types: how many of the first 256 are of each type.
        oldest: the message that is handled next.
        handled: what is being handled; None if the actor rests.
        waits_for: the actors whose answers its handler waits for.
        is_paused: whether pause() keeps its messages in the mailbox.
    """

    path: str
    limit: int
    length: int = 0
    types: dict[str, int] = {}
    oldest: MessageInfo | None = None
    handled: MessageInfo | None = None
    waits_for: list[str] = []
    is_paused: bool = False


def look_at(ref: pykka.ActorRef[Any]) -> MailboxInfo:
    """Look at the mailbox of an actor of this process.

    Raises:
        UsageError: the actor has no mailbox of this package.
    """
    mailbox = ref.actor_inbox
    if not isinstance(mailbox, Mailbox):
        raise UsageError(f"{ref}: expected an actor of rr_actors, got one whose mailbox is {type(mailbox).__name__}")
    actor = ref._actor_weakref()  # pyright: ignore[reportPrivateUsage]  # Pykka's; there is no public way to the actor
    handled = getattr(actor, "_rr_handled", None)
    first: list[Any] = mailbox.first(COUNTED)
    return MailboxInfo(
        str(ref),
        mailbox.limit,
        len(mailbox),
        dict(Counter(type_of(_message(waiting)) for waiting in first)),
        message_info(first[0]) if first else None,
        None if handled is None else message_info(handled, getattr(actor, "_rr_handled_at", 0.0)),
        waits_of(ref.actor_urn),
        mailbox.is_paused,
    )


def type_of(message: object) -> str:
    """Return the name of a message's type. No code of a user runs, and nothing is unpickled."""
    if type(message) is Starting:
        return ON_START
    return type_in(message.blob) if type(message) is Packed else name_of_class(type(message))


def message_info(envelope: Any, at: float = 0.0) -> MessageInfo:
    """Return what is known of a message: an envelope, or a delivery, as of a registrar.

    Args:
        at: since when it is handled, by time.monotonic(); 0: since it came.
    """
    message = _message(envelope)
    if isinstance(envelope, tuple):
        pair = cast("tuple[Any, str | None]", envelope)
        at = getattr(pair, "at", 0.0)
        return MessageInfo(type_of(message), pair[1] or "", monotonic() - at if at else None)
    sender = message.sender if type(message) is Packed else ""
    if isinstance(envelope, Envelope):  # not one of Pykka's own references
        at = at or envelope.at
        if envelope.chain:
            sender = envelope.chain[-1].name
        elif envelope.stamp is not None:
            sender = envelope.stamp.sender
    return MessageInfo(type_of(message), sender, monotonic() - at if at else None)


def _message(envelope: Any) -> object:
    return cast("tuple[Any, str | None]", envelope)[0] if isinstance(envelope, tuple) else envelope.message


def carry_out(ref: pykka.ActorRef[Any], order: str, done: Callable[[Any], None]) -> None:
    """Carry out an order, and call done() with its result: a MailboxInfo; for STEP the MessageInfo, or None.

    Of a step, done() is called by the actor's thread, when it has handled the message. From any thread.

    Raises:
        UsageError: the mailbox cannot be paused, or is not.
    """
    if order == LOOK:
        done(look_at(ref))
        return
    mailbox = _steppable(ref)
    if order == STEP:
        if not mailbox.step(lambda envelope: done(_stepped(envelope))):
            done(None)
        return
    if order == PAUSE:
        mailbox.pause()
    else:
        mailbox.resume()
    done(look_at(ref))


def _steppable(ref: pykka.ActorRef[Any]) -> SteppedMailbox:
    mailbox = ref.actor_inbox
    if isinstance(mailbox, SteppedMailbox):
        return mailbox
    if getattr(ref.actor_class, "_rr_lives_on_loop", False):
        text = "it is an actor of the framework, which other actors need; only your actors and managers can be paused"
        raise UsageError(f"{ref}: {text}")
    start = "start it with System(debug=True), or rr-actors run --debug"
    raise UsageError(f"{ref}: its system was not started for debugging, so it cannot be paused; {start}")


def _stepped(envelope: PykkaEnvelope[Any] | None) -> MessageInfo | None:
    return None if envelope is None else message_info(envelope)
