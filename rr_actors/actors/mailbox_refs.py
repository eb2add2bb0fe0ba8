"""MailboxRef: the mailbox of an actor in any process, to look at it, or to hold it up."""

from __future__ import annotations

from typing import Any

import pykka

from rr_actors.actors.messaging.futures import Reply
from rr_actors.actors.messaging.mailbox import Ended
from rr_actors.actors.messaging.mailbox_looks import LOOK, PAUSE, RESUME, STEP, MailboxInfo, MessageInfo, carry_out
from rr_actors.actors.refs import ActorRef, inquire, local_of, why_silent
from rr_actors.base.errors import Unavailable
from rr_actors.runtime.event_loop import check_may_block
from rr_actors.runtime.time_limits import time_limit

_ANSWER_S = 5.0


class MailboxRef:
    """The mailbox of an actor, from system.mailbox(id).

    The loop of the actor's process answers, and not the actor: it may be busy, or wait for ever. Each method raises
    ActorDeadError or ActorUnavailable if the actor does not run, and Unavailable if its process does not answer.

    Pausing is for debugging: a system that was not started with debug=True refuses it. What comes for a paused actor
    waits in its mailbox, up to the mailbox's limit. What it handles already, it finishes. Its supervisor can stop it.
    Timers, monitors and stop() send messages, which wait with the others. When it is restarted, it is not paused.
    """

    def __init__(self, ref: ActorRef[Any]) -> None:
        self._ref = ref

    def look(self) -> MailboxInfo:
        """Return what waits in the mailbox, and what the actor handles."""
        return self._order(LOOK, _ANSWER_S)

    def pause(self) -> MailboxInfo:
        """Keep the messages in the mailbox from now on, and return what is there.

        Raises:
            UsageError: the system was not started with debug=True, or the actor is one of the framework.
        """
        return self._order(PAUSE, _ANSWER_S)

    def resume(self) -> MailboxInfo:
        """Have the actor handle its messages again. It does nothing if the actor is not paused.

        Raises:
            UsageError: as pause().
        """
        return self._order(RESUME, _ANSWER_S)

    def step(self, timeout_s: float | None = 30.0) -> MessageInfo | None:
        """Have a paused actor handle one message, and return which when it has; None if no message waits.

        Args:
            timeout_s: seconds; None: no limit.

        Raises:
            UsageError: as pause(); or it is not paused, or the last step has not ended.
            Unavailable: the handler has not returned in time. It goes on.
        """
        return self._order(STEP, time_limit(timeout_s, "timeout_s"))

    def _order(self, order: str, limit_s: float | None) -> Any:
        check_may_block(f"looking at the mailbox of {self._ref}")
        local = local_of(self._ref)
        if local is None:
            reply = inquire(self._ref, order)
        elif local.is_alive():
            reply = Reply[Any]()
            carry_out(local, order, reply.set)
        else:
            raise Ended(f"{self._ref} not found", str(self._ref))
        try:
            return reply.get(timeout=limit_s)
        except pykka.Timeout:
            what = "its handler has not returned" if order == STEP else "its process has not answered"
            why = "" if local is not None else why_silent(self._ref)
            raise Unavailable(f"{self._ref}: {what} within {limit_s:g} s{why}") from None
