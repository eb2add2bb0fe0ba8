"""Workers: run user code outside of the framework's loop.

Each running callback has a thread, and idle threads are reused. A small pool deadlocks on recursion: a callback that
loads a resource blocks its thread until another callback has run, as deep as the dependencies go. So the limit is high,
and reaching it is a clear error. `async def` callbacks run as tasks on a second loop, the user loop. If one blocks by
mistake, it delays other user code, never the framework, and the log names it.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Hashable
from contextvars import Context
from types import FunctionType
from typing import Any

import msgspec

from rr_actors.base.errors import Unavailable, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.thread_pool import GETS_A_THREAD, REFUSED, WAITS, Task, Threads
from rr_actors.runtime.user_loop import COROUTINE, Done, UserLoop, name_of

logger = Log("rr_actors")


def is_async(fn: Callable[..., Any]) -> bool:
    """Return whether `fn` is async: a function, a method, a partial or an object with an `async def __call__`."""
    if type(fn) is FunctionType:  # nearly always
        return bool(fn.__code__.co_flags & inspect.CO_COROUTINE)
    while isinstance(fn, functools.partial):
        fn = fn.func
    function = getattr(fn, "__func__", fn)
    if isinstance(function, FunctionType):
        return bool(function.__code__.co_flags & inspect.CO_COROUTINE)
    return inspect.iscoroutinefunction(fn) or inspect.iscoroutinefunction(getattr(type(fn), "__call__", None))  # noqa: B004


class Workers:
    """The threads and the user loop that run users' callables and coroutines.

    Args:
        deliver: called as deliver(done, result, error) from any thread; calls `done` on the loop.
        hand_over: the same, for a thread that has no other task now.

    Attributes:
        threads: the worker threads, running or idle.
        closed: whether this process is stopping, and they take no more calls.
    """

    def __init__(self, deliver: Callable[..., None], hand_over: Callable[..., None]) -> None:
        self._deliver = deliver
        self._hand_over = hand_over
        self._lock = threading.Lock()
        self.threads = Threads(self._ran, self._go_on, deliver)
        self._queues: dict[Hashable, deque[Task] | None] = {}
        self._user_loop: UserLoop | None = None
        self.user_loop_ident: int | None = None
        self.closed = False

    def submit(
        self,
        fn: Callable[..., Any],
        *args: Any,
        done: Done | None = None,
        patient: bool = False,
        at_once: Callable[[Any], bool] | None = None,
    ) -> None:
        """Run fn(*args): in a worker thread, or as a task on the user loop if it is async. Returns at once.

        Args:
            done: called on the loop, once, with (result, None) or (None, error).
            patient: the call waits for a free thread instead of a MailboxFull.
            at_once: called with the result by the worker thread that ran fn, if it has no other task; not if fn is
                async. If it returns True it has dealt with the result, and `done` is not called. A thread with another
                task leaves the result to the loop, which gets many results together.

        Raises:
            MailboxFull: `limit` threads are running; nothing was started. (If the system gives fewer threads, the
                calls that were accepted before get this error by `done`.)
            Unavailable: the workers are closed.
        """
        when_full = WAITS if patient else REFUSED
        self._start(Task(fn, args, done, Context(), when_full, None, at_once))

    def serial(
        self,
        key: Hashable,
        fn: Callable[..., Any],
        *args: Any,
        done: Done | None = None,
        context: Context | None = None,
    ) -> None:
        """Run fn(*args) as submit() does, but the calls of one key (not None) one at a time, in their order.

        The contextvars of fn are those of `context`; without it there are none, as in submit().
        If no thread can be started for a call that waited for its turn, it gets that error by `done`.
        """
        task = Task(fn, args, done, Context() if context is None else context, key=key)
        with self._lock:
            if key in self._queues:
                queue = self._queues[key]
                if queue is None:
                    queue = self._queues[key] = deque()
                queue.append(task)
                return
            self._queues[key] = None  # the queue is made when a second call waits
        try:
            self._start(task)
        except Unavailable:
            self._start_following(key)  # other threads may have submitted more calls meanwhile
            raise

    async def run(self, fn: Callable[..., Any], *args: Any) -> Any:
        """Run fn(*args) as submit() does and wait for its result; for coroutines on the framework's loop.

        It gets a thread beyond the limit, too: the framework's own work must go on while callbacks take all threads.
        """
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def done(result: Any, error: BaseException | None) -> None:
            if future.cancelled():
                return
            if error is None:
                future.set_result(result)
            elif isinstance(error, Exception) and not isinstance(error, StopIteration):
                future.set_exception(error)
            else:  # a future cannot carry SystemExit without stopping the loop
                failure = RuntimeError(text_of(error))
                failure.__cause__ = error
                future.set_exception(failure)

        self._start(Task(fn, args, done, Context(), GETS_A_THREAD))
        return await future

    def in_thread(self, fn: Callable[..., Any], *args: Any, beyond_limit: bool = False) -> None:
        """Run a plain function in a thread, without `done`. `beyond_limit`: for work that has begun and must go on."""
        when_full = GETS_A_THREAD if beyond_limit else REFUSED
        self.threads.start(Task(fn, args, None, Context(), when_full))

    def start_coroutine(self, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context) -> None:
        """Run the coroutine as a task on the user loop; `done` is called in that loop's thread."""
        try:
            with self._lock:
                if self.closed:
                    raise Unavailable("the workers are closed: this process is stopping")
                if self._user_loop is None:
                    self._user_loop = UserLoop(functools.partial(self.in_thread, beyond_limit=True), self._deliver)
                    self.user_loop_ident = self._user_loop.thread.ident
                user_loop = self._user_loop
            user_loop.start(coroutine, done, context)
        except Unavailable:
            coroutine.close()
            raise

    def close(self, timeout_s: float = 1.0) -> None:
        """End the idle threads at once, and the running ones after their tasks.

        Wait for them up to `timeout_s` seconds: a callback that is stuck keeps its (daemon) thread. A thread that is
        being started now ends by itself.
        """
        with self._lock:
            self.closed = True
            user_loop = self._user_loop
        threads = self.threads.close()
        if user_loop is not None:
            user_loop.stop()
            threads.append(user_loop.thread)
        deadline = time.monotonic() + timeout_s
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def abandon(self) -> None:
        """Refuse everything, in a forked child: it does not have the threads."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        self.closed = True
        self.threads.abandon()

    def _start(self, task: Task) -> None:
        if not is_async(task.fn):
            self.threads.start(task)
            return
        coroutine, error = task.call()
        if error is None:
            self._await_result(task, coroutine)
        elif task.done is None and task.key is None:  # wrong arguments
            raise error
        else:
            self._ended(task, None, error)

    # -- how calls end ---------------------------------------------------------------------------------------------

    def _ran(self, task: Task, result: Any, error: BaseException | None, idle: bool) -> None:
        try:
            if idle and error is None and task.at_once is not None and task.at_once(result):
                return
        except Exception:  # a defect: `done` gets the result instead
            logger.exception("%s ended, and its thread could not say so", name_of(task.fn))
        self._tell(task, result, error, idle)

    def _tell(self, task: Task, result: Any, error: BaseException | None, idle: bool = False) -> None:
        if task.done is not None:
            try:
                (self._hand_over if idle else self._deliver)(task.done, result, error)
            except Unavailable:
                logger.debug("a result came after the loop had ended: %s", name_of(task.done))
        elif error is not None:
            logger.error("%s raised in a worker", name_of(task.fn), exc_info=error)

    def _go_on(self, task: Task, result: Any, error: BaseException | None) -> Task | None:
        if type(result) is COROUTINE:  # returned by a plain function, such as a wrapper
            try:
                self._await_result(task, result)
                return None
            except Unavailable as unavailable:
                result, error = None, unavailable
        self._tell(task, result, error)
        return None if task.key is None else self._following(task.key)

    # -- the user loop ---------------------------------------------------------------------------------------------

    def _await_result(self, task: Task, coroutine: Coroutine[Any, Any, Any]) -> None:
        self.start_coroutine(coroutine, functools.partial(self._ended, task), task.context)

    def _ended(self, task: Task, result: Any, error: BaseException | None) -> None:
        self._tell(task, result, error)
        if task.key is not None:
            self._start_following(task.key)

    # -- queues ----------------------------------------------------------------------------------------------------

    def _start_following(self, key: Hashable) -> None:
        """Start the next task of a queue whose first has ended. If no thread can be started, end it with that error."""
        while (following := self._following(key)) is not None:
            try:
                self.threads.start(msgspec.structs.replace(following, when_full=GETS_A_THREAD))
                return
            except Unavailable as unavailable:
                self._tell(following, None, unavailable)

    def _following(self, key: Hashable) -> Task | None:
        """Return the next task of a queue whose first has ended; delete the queue if it is empty."""
        with self._lock:
            queue = self._queues[key]
            if queue:
                return queue.popleft()
            del self._queues[key]
            return None
