"""Workers: where user code runs, off the framework's loop.

One thread per running callback, reused when idle. A bounded pool deadlocks on recursion: a callback that loads a
resource blocks its thread until another callback has run, as deep as the dependencies go. So the bound is high, and
reaching it is an error that says so. `async def` callbacks run as tasks on a second loop, the user loop, so that one
that blocks by mistake holds up other user code at most, never the framework.

Waking a thread costs more than most callbacks take. So whoever submits wakes one thread, however much he submits, and
a thread that takes a task and leaves others wakes the next before it begins: quick callbacks are done by a few
threads one after another, and none waits for one that blocks. Who starts a new thread has to wait for its own next
turn, on a busy machine for long: until then what there is to do is left to the new one, which starts no other.
"""

from __future__ import annotations

import asyncio
import enum
import functools
import inspect
import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Hashable
from contextvars import Context
from types import FunctionType
from typing import Any, NamedTuple

from rr_actors.actors.bells import Bell, new_bell
from rr_actors.actors.user_loop import Done, UserLoop, is_coroutine, name_of
from rr_actors.errors import MailboxFull, Unavailable

logger = logging.getLogger("rr_actors")

WORKERS_LIMIT = 4096
IDLE_S = 10.0
_PATIENCE_S = 0.1  # of callbacks that wait for a thread while all are busy and none becomes free
_QUICK = 8  # threads with a bell that takes file descriptors


def is_async(fn: Callable[..., Any]) -> bool:
    """Whether calling `fn` gives a coroutine: functions, methods, partials and objects with an `async def __call__`."""
    while isinstance(fn, functools.partial):
        fn = fn.func
    function = getattr(fn, "__func__", fn)
    if isinstance(function, FunctionType):
        return bool(function.__code__.co_flags & inspect.CO_COROUTINE)
    return inspect.iscoroutinefunction(fn) or inspect.iscoroutinefunction(getattr(type(fn), "__call__", None))  # noqa: B004


class _WhenFull(enum.Enum):
    """What becomes of a task when all threads that there may be are busy."""

    REFUSED = enum.auto()
    WAITS = enum.auto()
    GETS_A_THREAD = enum.auto()


class _Task(NamedTuple):
    fn: Callable[..., Any]
    args: tuple[Any, ...]
    done: Done | None
    context: Context
    when_full: _WhenFull = _WhenFull.REFUSED
    key: Hashable = None  # of the queue it is the first of; None for none


class _Thread:
    """A worker thread. One that is idle waits for its bell."""

    __slots__ = ("bell", "idle", "leaves", "quick", "thread")

    def __init__(self, *, quick: bool) -> None:
        self.quick = quick
        self.bell: Bell = new_bell(quick=quick)
        self.idle = False  # whether it is among the idle ones of Workers; whoever takes it out rings
        self.leaves = False
        self.thread: threading.Thread | None = None


class Workers:
    """Runs callables in threads and coroutines on the user loop.

    Args:
        deliver: called as deliver(done, result, error) from any thread; brings `done` to the loop.
        hand_over: the same, by a thread that has nothing more to do now; `deliver` if None.
        limit: the most threads at a time. More may be submitted at once, as long as they return quickly.
        idle_s: after how many seconds without work a thread ends.
    """

    def __init__(
        self,
        deliver: Callable[..., None],
        hand_over: Callable[..., None] | None = None,
        *,
        limit: int = WORKERS_LIMIT,
        idle_s: float = IDLE_S,
        name: str = "rr",
    ) -> None:
        self.limit = limit
        self._deliver = deliver
        self._hand_over = deliver if hand_over is None else hand_over
        self._idle_s = idle_s
        self._name = name
        self._lock = threading.Lock()
        self._tasks: deque[_Task] = deque()  # not begun; while there are any, a thread is coming, or all are busy
        self._coming = False  # whether one has been woken or started that has not looked for a task yet
        self._starting = False  # whether one that has come is starting another, and will then look for what is left
        self._idle_quick: list[_Thread] = []  # last in, first out: the surplus is what grows old
        self._idle_others: list[_Thread] = []
        self._all: set[_Thread] = set()
        self._quick = 0
        self._taken = 0  # tasks, in all
        self._looking = False  # whether those that wait for a thread, and are not patient, are being watched
        self._numbers = itertools.count(1)
        self._queues: dict[Hashable, deque[_Task] | None] = {}
        self._user_loop: UserLoop | None = None
        self.user_loop_ident: int | None = None
        self._closed = False

    def submit(
        self,
        fn: Callable[..., Any],
        *args: Any,
        done: Done | None = None,
        context: Context | None = None,
        patient: bool = False,
    ) -> None:
        """Run fn(*args): in a worker thread, or as a task on the user loop if it is async. Returns at once.

        Args:
            done: called on the loop, once, with (result, None) or (None, error).
            context: the contextvars fn sees; an empty context if None.
            patient: rather than be refused it waits, until a thread is free.

        Raises:
            MailboxFull: `limit` threads are running; nothing was started. (What was submitted before the last of them
                had begun is told so by `done`.)
            Unavailable: closed.
        """
        when_full = _WhenFull.WAITS if patient else _WhenFull.REFUSED
        task = _Task(fn, args, done, Context() if context is None else context, when_full)
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
        """As submit(), but the calls of one key (not None) run one at a time, in the order they were submitted.

        Raises:
            MailboxFull: `limit` threads are running; nothing was started or queued.
            Unavailable: closed.
        """
        task = _Task(fn, args, done, Context() if context is None else context, key=key)
        with self._lock:
            if key in self._queues:
                queue = self._queues[key]
                if queue is None:
                    queue = self._queues[key] = deque()
                queue.append(task)
                return
            self._queues[key] = None  # a queue only for those that wait
        try:
            if is_async(fn):
                self._start_async(task)
            else:
                self._start(task)
        except Unavailable:
            with self._lock:
                waiting = self._queues.pop(key)
            for other in waiting or ():  # submitted meanwhile from another thread
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
        when_full = _WhenFull.GETS_A_THREAD if beyond_limit else _WhenFull.REFUSED
        self._start(_Task(fn, args, None, Context(), when_full))

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

        Waits for them up to `timeout_s` seconds, not longer: a callback that is stuck keeps its (daemon) thread. One
        that is being started just now ends by itself.
        """
        with self._lock:
            self._closed = True
            idle = [*self._idle_quick, *self._idle_others]
            self._idle_quick.clear()
            self._idle_others.clear()
            threads = [worker.thread for worker in self._all if worker.thread is not None and worker.thread.is_alive()]
            user_loop = self._user_loop
        for worker in idle:
            worker.idle = False
            worker.bell.ring()  # with no task: it ends
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

    def _start(self, task: _Task) -> None:
        with self._lock:
            if self._closed:
                raise Unavailable("the workers are closed: this process is stopping")
            if task.when_full is _WhenFull.GETS_A_THREAD:
                self._tasks.appendleft(task)  # before those that wait for a free one
            elif self._coming or self._starting or self._looking or not self._is_full():
                self._tasks.append(task)
            elif task.when_full is _WhenFull.WAITS:
                self._tasks.append(task)
                return
            else:
                raise self._full()
            worker = self._fetch()
        if worker is None:
            return
        try:
            self._bring(worker)
        except MailboxFull:
            with self._lock:
                if task not in self._tasks or (task.when_full is _WhenFull.WAITS and self._all):
                    return  # a thread has become free, or will be
                self._tasks.remove(task)
            raise

    def _is_full(self) -> bool:
        return len(self._all) >= self.limit and not (self._idle_quick or self._idle_others)

    def _full(self) -> MailboxFull:
        return MailboxFull(
            f"workers: all {self.limit} threads are running callbacks; expected fewer callbacks that block at a time. "
            f"Let them return, make them `async def`, or raise SystemConfig.workers_limit",
            name="workers",
            limit=self.limit,
        )

    def _fetch(self) -> _Thread | None:
        """With the lock: the thread that comes for the first task, idle or new; then bring it, without the lock.

        None if one is coming, or none can: whoever has done what he does takes the task.
        """
        if self._coming or not self._tasks:
            return None
        idle = self._idle_quick or self._idle_others
        if idle:
            worker = idle.pop()
            worker.idle = False
        elif self._starting or (self._is_full() and self._tasks[0].when_full is not _WhenFull.GETS_A_THREAD):
            return None
        else:
            quick = self._quick < _QUICK
            worker = _Thread(quick=quick)
            self._quick += quick
            self._all.add(worker)
        self._coming = True
        return worker

    def _bring(self, worker: _Thread) -> None:
        if worker.thread is not None:
            worker.bell.ring()
            return
        name = f"{self._name}-worker-{next(self._numbers)}"
        worker.thread = threading.Thread(target=self._work, args=(worker,), name=name, daemon=True)
        try:
            worker.thread.start()
        except RuntimeError as error:  # the system's own limit of threads
            with self._lock:
                self._coming = False
            self._left(worker)
            threads = len(self._all)
            text = f"workers: the system gives no more than {threads} threads ({error})"
            raise MailboxFull(text, name="workers", limit=threads) from error

    def _work(self, worker: _Thread) -> None:
        while True:
            task = self._take(worker)
            while task is not None:
                task = self._run(worker, task)
            if worker.leaves or not self._wait(worker):
                break
        self._left(worker)

    def _left(self, worker: _Thread) -> None:
        with self._lock:
            self._all.discard(worker)
            self._quick -= worker.quick
        worker.bell.close()

    def _take(self, worker: _Thread) -> _Task | None:
        """A thread has come: what it is to do, unless another was faster; what is left, others come for.

        While it starts others it has no task of its own: they take what was there first, and it takes what is left.
        """
        other: _Thread | None = None
        failure: MailboxFull | None = None
        look = False
        while True:
            with self._lock:
                if other is None:
                    self._coming = False
                else:
                    self._starting = False
                task = self._next(worker)
                if failure is not None:
                    refused = self._refuse()
                    break
                other = self._fetch()
                if task is None or other is None or other.thread is not None:
                    refused = []
                    if other is None and not (self._coming or self._starting or self._looking):
                        look = self._looking = any(map(_may_be_refused, self._tasks))
                    break
                self._starting = True
                self._tasks.appendleft(task)
            try:
                self._bring(other)
            except MailboxFull as error:
                failure = error
        if failure is not None:
            for each in refused:
                self._tell(each, None, failure)
        elif other is not None:
            self._bring(other)
        elif look:
            try:
                self._deliver(self._look_later, None, None)
            except Unavailable:
                logger.debug("callbacks wait for a thread, and the loop has ended")
        return task

    def _look_later(self, _result: None, _error: None) -> None:
        asyncio.get_running_loop().call_later(_PATIENCE_S, self._look, self._taken)

    def _look(self, taken: int) -> None:
        """Refuse those that wait if no thread has taken anything for a while: then all are blocked, and not quick."""
        refused: list[_Task] = []
        with self._lock:
            self._looking = bool(self._tasks)
            if self._tasks and self._taken == taken and self._is_full():
                refused = self._refuse()
                self._looking = False
        for other in refused:
            self._tell(other, None, self._full())
        if self._looking:
            self._look_later(None, None)

    def _refuse(self) -> list[_Task]:
        """With the lock: what is not to wait, if somebody hears of that; the rest is done by whoever is free first."""
        waiting = list(self._tasks)
        refused = [task for task in waiting if _may_be_refused(task)]
        self._tasks.clear()
        self._tasks.extend(task for task in waiting if not _may_be_refused(task))
        return refused

    def _next(self, worker: _Thread) -> _Task | None:
        """With the lock: the next task; without one the thread is idle from now on."""
        if self._tasks:
            self._taken += 1
            return self._tasks.popleft()
        if self._closed:
            worker.leaves = True
        else:
            worker.idle = True
            (self._idle_quick if worker.quick else self._idle_others).append(worker)
        return None

    def _wait(self, worker: _Thread) -> bool:
        """Wait for the bell; False if the thread has grown old."""
        if worker.bell.wait(self._idle_s):
            return True
        with self._lock:
            if worker.idle:
                worker.idle = False
                (self._idle_quick if worker.quick else self._idle_others).remove(worker)
                return False
        return worker.bell.wait()  # fetched at the last moment

    def _run(self, worker: _Thread, task: _Task) -> _Task | None:
        """Run it, and take the next; the thread is idle if there is none."""
        result, error = _call(task)
        if is_coroutine(result):  # what a plain function returned, say a wrapper
            self._await_result(task, result)
        elif task.key is not None:
            self._tell(task, result, error)
            following = self._following(task.key)
            if following is not None:
                return following
        else:
            with self._lock:  # idle before `done` is told: what it submits next finds this thread
                following = self._next(worker)
            self._tell(task, result, error, self._deliver if following is not None else self._hand_over)
            return following
        with self._lock:
            return self._next(worker)

    def _tell(
        self, task: _Task, result: Any, error: BaseException | None, deliver: Callable[..., None] | None = None
    ) -> None:
        if task.done is not None:
            try:
                (deliver or self._deliver)(task.done, result, error)
            except Unavailable:
                logger.debug("a result came after the loop had ended: %s", name_of(task.done))
        elif error is not None:
            logger.error("%s raised in a worker", name_of(task.fn), exc_info=error)

    # -- the user loop ---------------------------------------------------------------------------------------------

    def _start_async(self, task: _Task) -> None:
        coroutine, error = _call(task)
        if error is None:
            self._await_result(task, coroutine)
        elif task.done is None and task.key is None:  # wrong arguments
            raise error
        else:
            self._ended(task, None, error)

    def _await_result(self, task: _Task, coroutine: Coroutine[Any, Any, Any]) -> None:
        self.start_coroutine(coroutine, functools.partial(self._ended, task), task.context)

    def _ended(self, task: _Task, result: Any, error: BaseException | None) -> None:
        self._tell(task, result, error)
        if task.key is not None and (following := self._following(task.key)) is not None:
            self._start(following._replace(when_full=_WhenFull.GETS_A_THREAD))

    # -- queues ----------------------------------------------------------------------------------------------------

    def _following(self, key: Hashable) -> _Task | None:
        """The next of a queue whose first has ended; the queue is forgotten if there is none."""
        with self._lock:
            queue = self._queues[key]
            if queue:
                return queue.popleft()
            del self._queues[key]
            return None


def _may_be_refused(task: _Task) -> bool:
    """Whether somebody hears that it is refused, and nothing comes after it."""
    return task.done is not None and task.key is None and task.when_full is _WhenFull.REFUSED


def _call(task: _Task) -> tuple[Any, BaseException | None]:
    try:
        return task.context.run(task.fn, *task.args), None
    except BaseException as error:  # SystemExit too: it is the callback's, not this thread's
        return None, error
