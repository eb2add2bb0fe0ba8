"""Backlogs: items that wait for one callback of a user, which runs in a worker, one call at a time and in order.

A slow callback fills its own backlog, and slows nothing else. A full backlog is emptied. In the place of the lost items
`missed` is called with their number, and the callback then gets the items that came after them.
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
"""The most items that wait; with one more, all of them are lost."""

_T = TypeVar("_T")


class Backlog(Generic[_T]):
    """The backlog of one callback. Usable from any thread.

    Args:
        workers: the workers that run the callback. While all are busy, the items wait.
        hear: the callback, called with each item; it may be async.
        missed: called in its place with the number of lost items.
        failed: called in the callback's thread with its error and its item (None for `missed`).
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
        self._lock = threading.Lock()  # while it is held, no object is made that could start the garbage collector
        self._waiting: deque[_T] = deque()
        self._missed = 0
        self._is_running = False
        self._closed = False
        self._heard = threading.Event()  # set when the backlog is closed, and all of it has been heard

    def put(self, what: _T) -> None:
        """Queue a call of the callback with this item, after all earlier items. Returns at once.

        Raises:
            Unavailable: the workers are closed.
        """
        with self._lock:
            if self._closed:
                return
            if len(self._waiting) >= KEPT:
                self._missed += len(self._waiting)
                self._waiting.clear()
            self._waiting.append(what)
            begins, self._is_running = not self._is_running, True
        if begins:
            self._begin()

    def close(self, wait_s: float = 0.0) -> None:
        """Take no more items. Wait for those that wait, but not long; drop the others: none of them is heard later."""
        with self._lock:
            self._closed = True
            waits = self._is_running and wait_s > 0
        if waits:
            self._heard.wait(wait_s)
        with self._lock:
            self._waiting.clear()
            self._missed = 0

    def _begin(self) -> None:
        try:
            self._workers.submit(self._hear_all, patient=True)
        except MailboxFull:  # the system gives no thread at all: the next put() tries again
            self._is_running = False
        except BaseException:
            self._is_running = False
            raise

    def _hear_all(self) -> None:
        """Call the callback for each item. If it gives a coroutine, go on when that has ended."""
        while True:
            what: _T | None = None
            with self._lock:
                missed, self._missed = self._missed, 0
                if missed == 0:
                    if not self._waiting:
                        self._is_running = False
                        if self._closed:
                            self._heard.set()
                        return
                    what = self._waiting.popleft()
            try:
                hears = functools.partial(self._hear, cast("_T", what))
                result = Context().run(functools.partial(self._say_missed, missed) if missed else hears)
            except BaseException as error:  # SystemExit, too: it must not end this thread
                self._failed(error, what)
                continue
            if is_coroutine(result):
                self._await(result, what)
                return

    def _await(self, coroutine: Coroutine[Any, Any, Any], what: _T | None) -> None:
        def done(_result: Any, error: BaseException | None) -> None:
            if error is not None:
                self._failed(error, what)
            with contextlib.suppress(Unavailable):  # this process is stopping
                self._begin()

        try:
            self._workers.start_coroutine(coroutine, done, Context())
        except Unavailable as error:  # the next put() tries again
            self._failed(error, what)
            self._is_running = False
