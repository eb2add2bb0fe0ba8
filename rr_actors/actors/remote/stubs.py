"""Stand-ins for the parts of an actor in another process: its mailbox, its stopped event, its reply.

Pykka's own code gets these parts from a reference. A DistantRef has stand-ins for them, which send messages.
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
    """The reply of an actor that may be respawned: if it dies first, its entry in the directory decides the error.

    For map() and join(), Pykka calls the class without arguments; such a future itself waits for no actor.
    """

    def __init__(self, where: Whereabouts | None = None) -> None:
        super().__init__(None if where is None else where.target)
        self._where = where

    def set_exception(self, exc_info: ExcInfo | BaseException | None = None) -> None:
        """Set the exception that get() raises; for a dead actor, the error from the directory."""
        error = error_of(exc_info)
        if self._where is not None and has_ended(error, self._where.target.name):
            error = as_directory_says(self._where, error)
        super().set_exception(error)


def as_directory_says(where: Whereabouts, dead: BaseException) -> BaseException:
    """Return the error for an actor that its last process reported `dead`: it may be being respawned."""
    process = hub(where.path)
    return dead if where.path is None or process is None else process.missing(where)


class DistantInbox:
    """The DistantRef.actor_inbox of an actor in another process."""

    def __init__(self, ref: pykka.ActorRef[Any]) -> None:
        self._ref = ref

    def put(self, envelope: PykkaEnvelope[Any], /) -> None:
        """Send the envelope's message; get() of its future returns the reply."""
        wanted = envelope.reply_to
        if wanted is None:
            self._ref.tell(envelope.message)
            return
        reply = self._ref.ask(envelope.message, block=False)
        wanted.set_get_hook(lambda timeout: reply.get(timeout=timeout))

    def get(self) -> PykkaEnvelope[Any]:
        """Raise an error: another process's messages cannot be taken.

        Raises:
            LookupError: always.
        """
        raise LookupError(f"the mailbox of {self._ref} is in another process")

    def empty(self) -> bool:
        """Return True: no message can be taken from here."""
        return True


class DistantStopped:
    """The DistantRef.actor_stopped of an actor in another process."""

    def __init__(self, ref: pykka.ActorRef[Any]) -> None:
        self._ref = ref

    def is_set(self) -> bool:
        """Return whether the actor is not alive."""
        return not self._ref.is_alive()
