"""Backlogs: what waits for one callback of a user, which runs in a worker, one call at a time and in order.

A callback that is slow fills its own backlog, and slows nothing else. When the backlog is full it is emptied. The
callback's side hears how many it has missed, where they are missing, and then what came after them.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections import deque
from collections.abc import Callable, Coroutine
from contextvars import Context
from typing import Any, Generic, TypeVar, cast

from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.runtime.user_loop import is_coroutine
from rr_actors.runtime.workers import Workers

KEPT = 10_000
"""How many may wait, before the callback has missed them."""

_T = TypeVar("_T")


class Backlog(Generic[_T]):
    """That of one callback. From any thread.

    Args:
        workers: where the callback runs. While all are busy, what there is waits.
        hear: called with each; it may be async.
        missed: called in its place with the number of those that there was no room for.
        failed: called with what was raised, and what it was called with (of `missed` None); where the callback ran.
    """

    def __init__(
        self,
        workers: Workers,
        hear: Callable[[_T], Any],
        missed: Callable[[int], Any],
        failed: Callable[[BaseException, _T | None], None],
    ) -> None:
        self._workers = workers
        self._hear = hear
        self._say_missed = missed
        self._failed = failed
        self._lock = threading.Lock()  # with it nothing is allocated that the collector counts: it may run anything
        self._waiting: deque[_T] = deque()
        self._missed = 0
        self._is_running = False

    def put(self, what: _T) -> None:
        """Have the callback called with it, after all that was put before. Returns at once.

        Raises:
            Unavailable: the workers are closed.
        """
        with self._lock:
            if len(self._waiting) >= KEPT:
                self._missed += len(self._waiting)
                self._waiting.clear()
            self._waiting.append(what)
            begins, self._is_running = not self._is_running, True
        if begins:
            self._begin()

    def _begin(self) -> None:
        try:
            self._workers.submit(self._hear_all, patient=True)
        except MailboxFull:  # there is no thread at all: the next one that is put tries again
            self._is_running = False
        except BaseException:
            self._is_running = False
            raise

    def _hear_all(self) -> Coroutine[Any, Any, None] | None:
        """Call the callback until nothing waits, or it gives a coroutine; after that one it goes on."""
        while True:
            what: _T | None = None
            with self._lock:
                missed, self._missed = self._missed, 0
                if missed == 0:
                    if not self._waiting:
                        self._is_running = False
                        return None
                    what = self._waiting.popleft()
            try:
                hears = functools.partial(self._hear, cast("_T", what))
                result = Context().run(functools.partial(self._say_missed, missed) if missed else hears)
            except BaseException as error:  # SystemExit too: it is the callback's, not this thread's
                self._failed(error, what)
                continue
            if is_coroutine(result):
                return self._await(result, what)

    async def _await(self, coroutine: Coroutine[Any, Any, Any], what: _T | None) -> None:
        try:
            await coroutine
        except BaseException as error:
            self._failed(error, what)
        with contextlib.suppress(Unavailable):  # this process is stopping
            self._begin()
