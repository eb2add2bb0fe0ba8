"""What stands in for the parts of an actor that is in another process: its mailbox, its stopped event, its reply.

Pykka's own code takes a reference for those parts; DistantRef has these in their places, which go by messages.
"""

from __future__ import annotations

from typing import Any

import pykka
from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.messaging.futures import ExcInfo, Reply, error_of
from rr_actors.actors.messaging.mailbox import has_ended
from rr_actors.actors.remote.hub import hub
from rr_actors.actors.remote.peer import Whereabouts


class DistantReply(Reply[Any]):
    """The reply of an actor that may be respawned: when it dies first, the directory says what that means.

    Pykka makes what map() and join() return by calling the class without arguments; that waits for no actor itself.
    """

    def __init__(self, where: Whereabouts | None = None) -> None:
        super().__init__(None if where is None else where.target)
        self._where = where

    def set_exception(self, exc_info: ExcInfo | BaseException | None = None) -> None:
        """Set the exception that get() raises."""
        error = error_of(exc_info)
        if self._where is not None and has_ended(error, self._where.target.name):
            error = as_directory_says(self._where, error)
        super().set_exception(error)


def as_directory_says(where: Whereabouts, dead: BaseException) -> BaseException:
    """What is to be heard of an actor of which its last process says `dead`: it may be on its way back."""
    process = hub(where.path)
    return dead if where.path is None or process is None else process.missing(where)


class DistantInbox:
    """What DistantRef.actor_inbox is for an actor in another process."""

    def __init__(self, ref: pykka.ActorRef[Any]) -> None:
        self._ref = ref

    def put(self, envelope: PykkaEnvelope[Any], /) -> None:
        """Send the envelope's message; its future is set when the reply comes."""
        wanted = envelope.reply_to
        if wanted is None:
            self._ref.tell(envelope.message)
            return
        reply = self._ref.ask(envelope.message, block=False)
        wanted.set_get_hook(lambda timeout: reply.get(timeout=timeout))

    def get(self) -> PykkaEnvelope[Any]:
        """Not possible from here.

        Raises:
            LookupError: always.
        """
        raise LookupError(f"the mailbox of {self._ref} is in another process")

    def empty(self) -> bool:
        """True: there is nothing to be had."""
        return True


class DistantStopped:
    """What DistantRef.actor_stopped is for an actor in another process."""

    def __init__(self, ref: pykka.ActorRef[Any]) -> None:
        self._ref = ref

    def is_set(self) -> bool:
        """Whether the actor is not alive."""
        return not self._ref.is_alive()
