"""Orders to the mailbox of an actor of this process: look at it, pause it, step it, resume it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pykka
from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.messaging.mailbox_looks import MessageInfo, look_at, message_info
from rr_actors.actors.messaging.stepped_mailbox import SteppedMailbox
from rr_actors.base.errors import UsageError

LOOK, PAUSE, STEP, RESUME = "mailbox", "pause", "step", "resume"
ORDERS = frozenset((LOOK, PAUSE, STEP, RESUME))


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
    if getattr(ref.actor_class, "_lives_on_loop", False):
        text = "it is an actor of the framework, which other actors need; only your actors and managers can be paused"
        raise UsageError(f"{ref}: {text}")
    start = "start it with System(debug=True), or rr-actors run --debug"
    raise UsageError(f"{ref}: its system was not started for debugging, so it cannot be paused; {start}")


def _stepped(envelope: PykkaEnvelope[Any] | None) -> MessageInfo | None:
    return None if envelope is None else message_info(envelope)
