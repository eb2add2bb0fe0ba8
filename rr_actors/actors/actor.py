"""Actor: the two Pykka actor types of rr_actors. LoopActor's handlers run on the loop, Actor's in worker threads."""

from __future__ import annotations

import inspect
from typing import Any, Self

from rr_actors.actors.drivers import LoopDriver, WorkerDriver
from rr_actors.actors.lifecycle import BaseActor
from rr_actors.actors.messaging.exit_reports import IGNORE, ExitReport, Ignore, OnExit, Reason
from rr_actors.actors.refs import ActorRef
from rr_actors.base.errors import UsageError
from rr_actors.runtime.event_loop import current
from rr_actors.supervision.core.supervisor_calls import check_for_actor

__all__ = ["IGNORE", "Actor", "BaseActor", "ExitReport", "Ignore", "LoopActor", "OnExit", "Reason"]


class LoopActor(BaseActor):
    """An actor of the framework: its handlers run on the loop and must not block. `async def` ones hold up only it."""

    _life_driver_type = LoopDriver

    @classmethod
    def start(  # pyright: ignore[reportIncompatibleMethodOverride]  # ActorRef is invariant
        cls, *args: Any, **kwargs: Any
    ) -> ActorRef[Self]:
        """Make an actor and wait for its on_start; on the loop itself on_start has run when this returns.

        Raises:
            UsageError: on the loop, when there is something asynchronous to wait for; use launch() there.
            BaseException: what `__init__` or on_start raised.
        """
        dispatcher = current()
        if dispatcher is None or not dispatcher.is_loop_thread():
            return super().start(*args, **kwargs)
        hooks = (cls._before_start, BaseActor._before_start), (cls._after_start, BaseActor._after_start)
        if inspect.iscoroutinefunction(cls.on_start) or any(mine is not base for mine, base in hooks):
            raise UsageError(f"{cls.__name__}.start(): on_start is asynchronous; use `await {cls.__name__}.launch()`")
        actor = cls(*args, **kwargs)
        actor._come_alive(at_once=True)
        actor._started.get()
        return actor.actor_ref

    def on_drained(self) -> None:
        """Called on the loop after a batch of messages, before the actor rests: what they have in common goes here.

        Also before on_stop. An exception stops the actor, as one in a message that was told.
        """

    async def _end_batch(self) -> None:
        try:
            self.on_drained()
        except Exception as error:
            failure = error
        else:
            return
        await self._fail(failure)


class Actor(BaseActor):
    """A base class for your actors. Worker threads handle its messages, one at a time, in order.

    on_receive handles messages that are sent with ask or tell, and a proxy calls methods. All of them may be
    `async def`: the next message waits until they have ended. An exception under tell ends the actor. Under ask it goes
    to the asker. SystemExit in a handler ends only this actor.

    It differs from pykka.ThreadingActor in three points. start() returns after on_start. Each message may run in
    another thread (contextvars stay, threading.local does not). A running actor does not keep the program from exiting.
    """

    _life_driver_type = WorkerDriver

    def _handle_receive(self, message: Any) -> Any:
        check_for_actor(message, self)
        return super()._handle_receive(message)
