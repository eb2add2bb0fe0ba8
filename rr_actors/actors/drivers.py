"""Driver: what lets an actor's life go on. The life is one coroutine; a driver sends it on by hand, where it belongs.

So the life reads from top to bottom and still holds no thread while the mailbox is empty. It awaits REST, PAUSE and
Await, nothing else, and does not know where it goes on.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Generator
from contextvars import Context
from typing import Any, cast

from rr_actors.actors.messaging.mailbox import Mailbox
from rr_actors.base.errors import Unavailable
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.user_loop import start_task

logger = logging.getLogger("rr_actors")


class Request:
    """What a life awaits from its driver."""

    def __await__(self) -> Generator[Request, Any, Any]:
        return (yield self)


class Await(Request):
    """Run a coroutine: a user's where the user's coroutines run, a hook on the framework's loop."""

    def __init__(self, coroutine: Coroutine[Any, Any, Any], *, on_loop: bool = False) -> None:
        self.coroutine = coroutine
        self.on_loop = on_loop


REST = Request()
"""There is nothing to do until the next message comes."""

PAUSE = Request()
"""Let others have their turn on the loop. In worker threads they have it anyway."""


class Driver:
    """Drives one life, in one context from its beginning to its end, as a thread of its own would have.

    To schedule or start it raises MailboxFull if there is no thread for it and it is not urgent, and Unavailable if the
    loop has ended.

    Args:
        life: what is driven; it begins with start().
        mailbox: the actor's; its `schedule` should be the driver's.
        name: the actor's, for the log.
        on_loop: whether the life goes on on the framework's loop, and must not block there. Otherwise it goes on in
            worker threads, whichever is free.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        life: Coroutine[Request, Any, None],
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
        self._task: asyncio.Task[Any] | None = None  # on the loop, that is, which keeps only a weak reference

    def schedule(self, urgent: bool) -> None:
        """Have the life go on, soon: what its mailbox calls. `urgent`: whatever limits there are. Twice is as once."""
        self._submit(self._turn, urgent=urgent)

    def start(self) -> None:
        """Have the life begin, soon."""
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
        """Let the life go on, with the outcome of what it waited for, until it waits again."""
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
        """Give up a life that has not begun."""
        self._life.close()

    def _resume(self, result: Any, error: BaseException | None) -> None:
        if self._on_loop:
            self.drive(result, error)
            return
        try:
            self._dispatcher.workers.in_thread(self.drive, result, error, beyond_limit=True)
        except Unavailable:
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
