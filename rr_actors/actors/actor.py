"""Actor: the two Pykka actor types of rr_actors. LoopActor's handlers run on the loop, Actor's in worker threads."""

from __future__ import annotations

from typing import Any

from rr_actors.actors.lifecycle import BaseActor
from rr_actors.actors.messaging.exit_reports import IGNORE, ExitReport, Ignore, OnExit, Reason
from rr_actors.supervision.core.child_calls import check_for_actor

__all__ = ["IGNORE", "Actor", "BaseActor", "ExitReport", "Ignore", "LoopActor", "OnExit", "Reason"]


class LoopActor(BaseActor):
    """An actor of the framework: its handlers run on the loop and must not block. An `async def` one delays only it."""

    _lives_on_loop = True


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
