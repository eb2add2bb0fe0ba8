"""Workers: where user code runs, off the framework's loop.

One thread per running callback, reused when idle. A bounded pool deadlocks on recursion: a callback that loads a
resource blocks its thread until another callback has run, as deep as the dependencies go. So the bound is high, and
reaching it is an error that says so. `async def` callbacks run as tasks on a second loop, the user loop, so that one
that blocks by mistake holds up other user code at most, never the framework.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Hashable
from contextvars import Context
from typing import Any, NamedTuple

from rr_actors.actors.user_loop import Done, UserLoop, is_coroutine, name_of
from rr_actors.errors import MailboxFull, Unavailable

logger = logging.getLogger("rr_actors")

WORKERS_LIMIT = 4096
IDLE_S = 10.0


def is_async(fn: Callable[..., Any]) -> bool:
    """Whether calling `fn` gives a coroutine: functions, methods, partials and objects with an `async def __call__`."""
    while isinstance(fn, functools.partial):
        fn = fn.func
    return inspect.iscoroutinefunction(fn) or inspect.iscoroutinefunction(getattr(type(fn), "__call__", None))  # noqa: B004


class _Task(NamedTuple):
    fn: Callable[..., Any]
    args: tuple[Any, ...]
    done: Done | None
    context: Context


class _Thread:
    """A worker thread, and how it is handed its next task: `task` is set, then `wake` released."""

    __slots__ = ("idle", "task", "thread", "wake")

    def __init__(self, task: _Task | None) -> None:
        self.task = task
        self.idle = False  # whether it is in Workers._idle
        self.wake = threading.Lock()
        self.wake.acquire()
        self.thread: threading.Thread | None = None


class Workers:
    """Runs callables in threads and coroutines on the user loop.

    Args:
        deliver: called as deliver(done, result, error) from any thread; brings `done` to the loop.
        limit: the most threads at a time.
        idle_s: after how many seconds without work a thread ends.
    """

    def __init__(
        self, deliver: Callable[..., None], *, limit: int = WORKERS_LIMIT, idle_s: float = IDLE_S, name: str = "rr"
    ) -> None:
        self.limit = limit
        self._deliver = deliver
        self._idle_s = idle_s
        self._name = name
        self._lock = threading.Lock()
        self._idle: list[_Thread] = []  # last in, first out: the surplus is what grows old
        self._all: set[_Thread] = set()
        self._numbers = itertools.count(1)
        self._queues: dict[Hashable, deque[_Task]] = {}
        self._user_loop: UserLoop | None = None
        self.user_loop_ident: int | None = None
        self._closed = False

    def submit(
        self, fn: Callable[..., Any], *args: Any, done: Done | None = None, context: Context | None = None
    ) -> None:
        """Run fn(*args): in a worker thread, or as a task on the user loop if it is async. Returns at once.

        Args:
            done: called on the loop, once, with (result, None) or (None, error).
            context: the contextvars fn sees; an empty context if None.

        Raises:
            MailboxFull: `limit` threads are running; nothing was started.
            Unavailable: closed.
        """
        task = _Task(fn, args, done, Context() if context is None else context)
        if is_async(fn):
            self._start_async(task)
        else:
            self._start(task)

    def serial(
        self,
        key: Hashable,
        fn: Callable[..., Any],
        *args: Any,
        done: Done | None = None,
        context: Context | None = None,
    ) -> None:
        """As submit(), but the calls of one key run one at a time, in the order they were submitted.

        Raises:
            MailboxFull: `limit` threads are running; nothing was started or queued.
            Unavailable: closed.
        """
        task = _Task(fn, args, done, Context() if context is None else context)
        with self._lock:
            queue = self._queues.get(key)
            if queue is not None:
                queue.append(task)
                return
            self._queues[key] = deque()
        try:
            self._start_in_queue(key, task)
        except Unavailable:
            with self._lock:
                waiting = self._queues.pop(key)
            for other in waiting:  # submitted meanwhile from another thread
                self.serial(key, other.fn, *other.args, done=other.done, context=other.context)
            raise

    async def run(self, fn: Callable[..., Any], *args: Any, context: Context | None = None) -> Any:
        """Run fn(*args) as submit() does and wait for its result; for coroutines on the framework's loop.

        Raises:
            BaseException: what fn raised.
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
                failure = RuntimeError(f"{type(error).__name__}: {error}")
                failure.__cause__ = error
                future.set_exception(failure)

        self.submit(fn, *args, done=done, context=context)
        return await future

    def in_thread(self, fn: Callable[..., Any], *args: Any, beyond_limit: bool = False) -> None:
        """As submit() of a plain function without `done`. `beyond_limit`: for work that has begun and must go on.

        Raises:
            MailboxFull: `limit` threads are running, and not `beyond_limit`.
            Unavailable: closed.
        """
        self._start(_Task(fn, args, None, Context()), beyond_limit=beyond_limit)

    def start_coroutine(self, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context) -> None:
        """Run the coroutine as a task on the user loop; `done` is called there, in that loop's thread."""
        with self._lock:
            if self._closed:
                coroutine.close()
                raise Unavailable("the workers are closed: this process is stopping")
            if self._user_loop is None:
                self._user_loop = UserLoop(f"{self._name}-user-loop")
                self.user_loop_ident = self._user_loop.thread.ident
            user_loop = self._user_loop
        user_loop.start(coroutine, done, context)

    @property
    def threads(self) -> int:
        """Worker threads there are now, running or idle."""
        return len(self._all)

    def close(self, timeout_s: float = 1.0) -> None:
        """End the idle threads at once, and the running ones after what they are doing.

        Waits for them up to `timeout_s` seconds, not longer: a callback that is stuck keeps its (daemon) thread.
        """
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
            threads = [worker.thread for worker in self._all if worker.thread is not None]
            user_loop = self._user_loop
        for worker in idle:
            worker.idle = False
            worker.wake.release()  # with no task: it ends
        if user_loop is not None:
            user_loop.stop()
            threads.append(user_loop.thread)
        deadline = time.monotonic() + timeout_s
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))

    def abandon(self) -> None:
        """In a forked child: refuse everything, since the threads are not there."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        self._closed = True

    # -- threads ---------------------------------------------------------------------------------------------------

    def _start(self, task: _Task, *, beyond_limit: bool = False) -> None:
        with self._lock:
            if self._closed:
                raise Unavailable("the workers are closed: this process is stopping")
            if self._idle:
                worker = self._idle.pop()
                worker.idle = False
                worker.task = task
                worker.wake.release()
                return
            if len(self._all) >= self.limit and not beyond_limit:
                raise MailboxFull(
                    f"workers: all {self.limit} threads are running callbacks; expected fewer callbacks that block at "
                    f"a time. Let them return, make them `async def`, or raise SystemConfig.workers_limit",
                    name="workers",
                    limit=self.limit,
                )
            worker = _Thread(task)
            self._all.add(worker)
        worker.thread = threading.Thread(
            target=self._work, args=(worker,), name=f"{self._name}-worker-{next(self._numbers)}", daemon=True
        )
        try:
            worker.thread.start()
        except RuntimeError as error:  # the system's own limit of threads
            with self._lock:
                self._all.discard(worker)
            raise MailboxFull(
                f"workers: the system gives no more than {len(self._all)} threads ({error})",
                name="workers",
                limit=len(self._all),
            ) from error

    def _work(self, worker: _Thread) -> None:
        while (task := worker.task) is not None:
            worker.task = None
            result, error = _call(task)
            if is_coroutine(result):  # a plain function, say a wrapper, that returned a coroutine
                self._await_result(task, result)
            else:
                self._end(task, result, error, worker)
            del task, result, error  # an idle thread must not keep them alive
            if not self._wait_for_task(worker):
                break
        with self._lock:
            self._all.discard(worker)

    def _wait_for_task(self, worker: _Thread) -> bool:
        with self._lock:
            if worker.task is None and not worker.idle:
                if self._closed:
                    return False
                worker.idle = True
                self._idle.append(worker)
        if worker.wake.acquire(timeout=self._idle_s):
            return True
        with self._lock:
            if worker.idle:
                worker.idle = False
                self._idle.remove(worker)
                return False
        worker.wake.acquire()  # handed a task at the last moment
        return True

    def _end(self, task: _Task, result: Any, error: BaseException | None, worker: _Thread) -> None:
        if task.done is not None:
            with self._lock:  # idle before `done` is told: what it submits next finds this thread
                if not self._closed:
                    worker.idle = True
                    self._idle.append(worker)
            self._tell(task.done, result, error)
        elif error is not None:
            logger.error("%s raised in a worker", name_of(task.fn), exc_info=error)

    def _tell(self, done: Done, result: Any, error: BaseException | None) -> None:
        try:
            self._deliver(done, result, error)
        except Unavailable:
            logger.debug("a result came after the loop had ended: %s", name_of(done))

    # -- the user loop ---------------------------------------------------------------------------------------------

    def _start_async(self, task: _Task) -> None:
        coroutine, error = _call(task)
        if error is not None:  # wrong arguments
            if task.done is None:
                raise error
            self._tell(task.done, None, error)
        else:
            self._await_result(task, coroutine)

    def _await_result(self, task: _Task, coroutine: Coroutine[Any, Any, Any]) -> None:
        def done(result: Any, error: BaseException | None) -> None:
            if task.done is not None:
                self._tell(task.done, result, error)
            elif error is not None:
                logger.error("%s raised on the user loop", name_of(task.fn), exc_info=error)

        self.start_coroutine(coroutine, done, task.context)

    # -- queues ----------------------------------------------------------------------------------------------------

    def _start_in_queue(self, key: Hashable, task: _Task) -> None:
        if is_async(task.fn):
            coroutine, error = _call(task)
            if error is not None:
                self._queue_done(key, task, None, error)
            else:
                self.start_coroutine(coroutine, functools.partial(self._queue_done, key, task), task.context)
        else:
            self._start(_Task(self._run_in_queue, (key, task), None, Context()))

    def _run_in_queue(self, key: Hashable, task: _Task) -> None:
        following: _Task | None = task
        while following is not None:
            task = following
            if is_async(task.fn):
                self._start_in_queue(key, task)
                return
            result, error = _call(task)
            if is_coroutine(result):
                self.start_coroutine(result, functools.partial(self._queue_done, key, task), task.context)
                return
            following = self._finish_in_queue(key, task, result, error)

    def _queue_done(self, key: Hashable, task: _Task, result: Any, error: BaseException | None) -> None:
        following = self._finish_in_queue(key, task, result, error)
        if following is not None:
            self.in_thread(self._run_in_queue, key, following, beyond_limit=True)

    def _finish_in_queue(self, key: Hashable, task: _Task, result: Any, error: BaseException | None) -> _Task | None:
        if task.done is not None:
            self._tell(task.done, result, error)
        elif error is not None:
            logger.error("%s raised in a worker", name_of(task.fn), exc_info=error)
        with self._lock:
            queue = self._queues[key]
            if queue:
                return queue.popleft()
            del self._queues[key]
            return None


def _call(task: _Task) -> tuple[Any, BaseException | None]:
    try:
        return task.context.run(task.fn, *task.args), None
    except BaseException as error:  # SystemExit too: it is the callback's, not this thread's
        return None, error
