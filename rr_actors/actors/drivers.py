"""Driver: runs the life of an actor. The life is one coroutine; a driver resumes it, on the loop or in a worker.

So the life reads from top to bottom, and still needs no thread while the mailbox is empty. It awaits only REST, PAUSE
and Await, and does not know in which thread it is resumed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Generator
from contextvars import Context
from typing import Any, cast

import msgspec

from rr_actors.actors.messaging.mailbox import Mailbox
from rr_actors.base.errors import Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.user_loop import start_task

logger = Log("rr_actors")

RETRY_S = 0.1
"""How long a life that can go on waits if the machine gives no thread for it."""


class DriverRequest(msgspec.Struct, frozen=True, eq=False):
    """A request that a life awaits from its driver."""

    def __await__(self) -> Generator[DriverRequest, Any, Any]:
        return (yield self)


class Await(DriverRequest, frozen=True, eq=False):
    """The request to run a coroutine: on the framework's loop for hooks and LoopActors, else on the users' loop."""

    coroutine: Coroutine[Any, Any, Any]
    on_loop: bool = False


REST = DriverRequest()
"""The request to rest until the next message comes."""

PAUSE = DriverRequest()
"""The request to let other callbacks run on the loop. In worker threads it has no effect."""


class Driver:
    """Drives one life in one context from its beginning to its end, like the context of a thread.

    schedule() and start() raise MailboxFull if no thread is free and the call is not urgent, and Unavailable if the
    loop has ended.

    Args:
        mailbox: the actor's mailbox; its `schedule` should be the driver's.
        on_loop: whether the life runs on the framework's loop, and must not block. Otherwise it runs in whichever
            worker thread is free.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        life: Coroutine[DriverRequest, Any, None],
        mailbox: Mailbox,
        name: str,
        *,
        on_loop: bool,
    ) -> None:
        self._dispatcher = dispatcher
        self._life = life
        self._mailbox = mailbox
        self._name = name
        self._on_loop = on_loop
        self._context = Context()
        self._task: asyncio.Task[Any] | None = None  # kept here: the loop has only a weak reference to it

    def schedule(self, urgent: bool) -> None:
        """Resume the life soon; the mailbox calls this. `urgent`: ignore the limit of threads. Twice acts as once."""
        self._submit(self._turn, urgent=urgent)

    def start(self) -> None:
        """Begin the life soon."""
        self._submit(self.drive, urgent=False)

    def _submit(self, fn: Callable[[], None], *, urgent: bool) -> None:
        if self._on_loop:
            self._dispatcher.call(fn)
        else:
            self._dispatcher.workers.in_thread(fn, beyond_limit=urgent)

    def _turn(self) -> None:
        if self._mailbox.take_turn():
            self.drive()

    def drive(self, result: Any = None, error: BaseException | None = None) -> None:
        """Resume the life with the result or error that it waited for, and run it until it waits again."""
        while True:
            try:
                if error is None:
                    request = self._context.run(self._life.send, result)
                else:
                    request = self._context.run(self._life.throw, error)
            except StopIteration:
                return
            result = error = None
            if request is REST:
                if self._mailbox.rest():
                    return
            elif request is PAUSE:
                if self._on_loop:
                    self._submit(self.drive, urgent=True)
                    return
            else:
                self._await(cast("Await", request))
                return

    def close(self) -> None:
        """Close a life that has not begun."""
        self._life.close()

    def _resume(self, result: Any, error: BaseException | None) -> None:
        if self._on_loop:
            self.drive(result, error)
            return
        try:
            self._dispatcher.workers.in_thread(self.drive, result, error, beyond_limit=True)
        except Unavailable as refusal:
            if wanted_by(refusal):
                loop = self._dispatcher.loop
                self._dispatcher.call(lambda: loop.call_later(RETRY_S, self._resume, result, error))
            else:
                self._cut_off()

    def _await(self, request: Await) -> None:
        try:
            if request.on_loop or self._on_loop:
                self._dispatcher.call(self._start_task, request.coroutine)
            else:
                self._dispatcher.workers.start_coroutine(request.coroutine, self._resume, self._context)
        except Unavailable as error:
            request.coroutine.close()
            if wanted_by(error):
                self._resume(None, error)
            else:  # the loops are closed; the process is ending
                self._cut_off()

    def _start_task(self, coroutine: Coroutine[Any, Any, Any]) -> None:
        self._task = start_task(self._dispatcher.loop, coroutine, self._resume, self._context)

    def _cut_off(self) -> None:
        logger.debug("%s did not end before its process", self._name)
