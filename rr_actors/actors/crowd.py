"""Crowd: callbacks of which there may be thousands at once, taken in turn by a few worker threads.

To wake a thread for each costs more than most callbacks do, and there is a limit of threads. But one that waits may be
what a running one waits for: so while they do not return quickly, there are more and more threads, as many as
may be.
"""

from __future__ import annotations

import functools
import logging
from collections import deque
from collections.abc import Callable
from contextvars import Context
from typing import Any, NamedTuple, Protocol

from rr_actors.actors.user_loop import Done, is_coroutine
from rr_actors.actors.workers import Workers, is_async
from rr_actors.errors import MailboxFull, Unavailable

logger = logging.getLogger("rr_actors")

_FEW = 1
_LOOK_S = 0.002


class Loop(Protocol):
    """Where calls are brought to, and timers fire: the dispatcher."""

    loop: Any

    def call(self, fn: Callable[..., object], *args: Any) -> None:
        """Have fn(*args) called on the loop, from any thread."""
        ...


class _Task(NamedTuple):
    fn: Callable[..., Any]
    args: tuple[Any, ...]
    done: Done
    context: Context


class Crowd:
    """Runs callables as Workers.submit() does, but not all at once. On the loop.

    Args:
        workers: whose threads it uses.
        dispatcher: of the loop that `done` is called on.
    """

    def __init__(self, workers: Workers, dispatcher: Loop) -> None:
        self._workers = workers
        self._dispatcher = dispatcher
        self._waiting: deque[_Task] = deque()  # also taken from by the threads
        self._threads = 0
        self._ended = 0  # callbacks, since the last look
        self._looking = False

    def submit(self, fn: Callable[..., Any], *args: Any, done: Done, context: Context) -> None:
        """Run fn(*args) in its turn; `done` is called on the loop, once, with (result, None) or (None, error)."""
        if is_async(fn):
            self._workers.submit(fn, *args, done=done, context=context)
            return
        self._waiting.append(_Task(fn, args, done, context))
        if self._threads < _FEW:
            self._add_thread()
        elif not self._looking:
            self._look_later()

    def _add_thread(self) -> None:
        self._threads += 1
        try:
            self._workers.submit(self._work, done=self._thread_ended)
        except MailboxFull:
            self._threads -= 1
            if not self._looking:
                self._look_later()
        except Unavailable as error:
            self._threads -= 1
            while self._threads == 0 and self._waiting:
                self._waiting.popleft().done(None, error)

    def _work(self) -> None:
        """In a worker thread."""
        while True:
            try:
                task = self._waiting.popleft()
            except IndexError:
                return
            result: Any = None
            failure: BaseException | None = None
            try:
                result = task.context.run(task.fn, *task.args)
            except BaseException as error:  # SystemExit too: it is the callback's, not this thread's
                failure = error
            try:
                if is_coroutine(result):  # a plain function that returned one
                    done = functools.partial(self._tell, task.done)
                    self._workers.start_coroutine(result, done, task.context)
                else:
                    self._tell(task.done, result, failure)
            except Unavailable:
                logger.debug("a result came after the loop had ended: %s", task.fn)

    def _tell(self, done: Done, result: Any, error: BaseException | None) -> None:
        self._ended += 1
        self._dispatcher.call(done, result, error)

    def _thread_ended(self, _result: None, error: BaseException | None) -> None:
        self._threads -= 1
        if self._waiting and self._threads < _FEW:
            self._add_thread()

    # -- are they quick? -----------------------------------------------------------------------------------------

    def _look_later(self) -> None:
        self._looking = True
        self._ended = 0
        self._dispatcher.loop.call_later(_LOOK_S, self._look)

    def _look(self) -> None:
        self._looking = False
        if not self._waiting:
            return
        if self._ended < self._threads or not self._threads:  # not each of them has done one meanwhile
            self._looking = True
            for _ in range(min(max(1, self._threads), len(self._waiting))):
                self._add_thread()
        self._look_later()
