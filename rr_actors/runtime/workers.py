"""Workers: run user code outside of the framework's loop.

Each running callback has a thread, and idle threads are reused. A small pool deadlocks on recursion: a callback that
loads a resource blocks its thread until another callback has run, as deep as the dependencies go. So the limit is high,
and reaching it is a clear error. `async def` callbacks run as tasks on a second loop, the user loop. If one blocks by
mistake, it delays other user code, never the framework, and the log names it.

A Gate lets so many callbacks in at a time; the others wait outside, first come, first served.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Generator, Hashable
from contextvars import Context, ContextVar
from types import FunctionType
from typing import Any, Generic, TypeVar

import msgspec

from rr_actors.base.errors import Unavailable, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.thread_pool import GETS_A_THREAD, REFUSED, WAITS, Task, Threads
from rr_actors.runtime.user_loop import COROUTINE, Done, UserLoop, closing, name_of

logger = Log("rr_actors")

T = TypeVar("T")


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


# -- gates -------------------------------------------------------------------------------------------------------------
#
# A serial manager has a gate for one, so that its callbacks and messages have `self` for themselves, as those of any
# actor. A callback inside that waits for a load, an unload or a reply lets another one in meanwhile. It comes in again
# before those that wait outside. So managers that load from each other in a ring do not wait for each other for ever.

Begin = Callable[[], bool]
"""Begins what has waited for room, without waiting itself; returns False if that cannot begin any more."""

Enter = Callable[[Begin], None]


class Gate:
    """Lets at most `most` callbacks in at a time. From any thread."""

    def __init__(self, most: int) -> None:
        self._lock = threading.Lock()
        self._free = most
        self._returning: deque[Begin] = deque()  # those that were inside before
        self._outside: deque[Begin] = deque()

    def enter(self, begin: Begin) -> None:
        """Call `begin` when there is room: now, or in the thread that makes room."""
        self._enter(self._outside, begin)

    def come_back(self, begin: Begin) -> None:
        """Call `begin` when there is room, before those that have not been inside yet."""
        self._enter(self._returning, begin)

    def leave(self) -> None:
        """Make room for another one."""
        while True:
            with self._lock:
                waiting = self._returning or self._outside
                if not waiting:
                    self._free += 1
                    return
                begin = waiting.popleft()
            if begin():
                return

    def _enter(self, waiting: deque[Begin], begin: Begin) -> None:
        with self._lock:
            if not self._free:  # while there is room, nobody waits
                waiting.append(begin)
                return
            self._free -= 1
        if not begin():
            self.leave()

    def around(self, fn: Callable[..., Any], *, enters: bool) -> Callable[..., Any]:
        """Return a function that calls `fn` inside, and then leaves. A coroutine that `fn` gives is awaited inside.

        Args:
            enters: whether it enters first, and waits for that; else its caller has entered for it.
        """

        async def run_async(*args: Any, begun: Coroutine[Any, Any, Any] | None = None) -> Any:
            cancelled = await _wait_async(self.enter) if enters and begun is None else None
            visit = _Visit(self, asyncio.current_task())
            token = _visit.set(visit)
            try:
                if cancelled is not None:
                    raise cancelled
                return await (begun or fn(*args))
            finally:
                _visit.reset(token)
                visit.end()

        def run(*args: Any) -> Any:
            if enters:
                _wait(self.enter)
            visit = _Visit(self, threading.get_ident())
            token = _visit.set(visit)
            try:
                answer = fn(*args)
            except BaseException:
                visit.end()
                raise
            finally:
                _visit.reset(token)
            if type(answer) is COROUTINE:
                return closing(answer, run_async(begun=answer))
            visit.end()
            return answer

        return run_async if is_async(fn) else run


class _Visit:
    """A callback that is inside a gate.

    Attributes:
        owner: the task that runs it, or the identifier of its thread. What others do in its context, such as a task
            that it has begun, lets nobody in.
        is_out: whether it waits for something, and has let another one in.
    """

    __slots__ = ("gate", "is_out", "owner")

    def __init__(self, gate: Gate, owner: object) -> None:
        self.gate, self.owner, self.is_out = gate, owner, False

    def end(self) -> None:
        if not self.is_out:  # else it was dropped while it waited, as its process ends
            self.gate.leave()


_visit: ContextVar[_Visit | None] = ContextVar("rr_gate", default=None)


class LettingIn:
    """A block in which the calling callback waits: if it is inside a gate, another one may come in. For threads."""

    __slots__ = ("_visit",)

    def __enter__(self) -> None:
        self._visit = None if _visit.get() is None else _gone_out(threading.get_ident())

    def __exit__(self, *_error: object) -> None:
        if (visit := self._visit) is not None:
            _wait(visit.gate.come_back)
            visit.is_out = False


def letting_in(wait: Generator[Any, Any, T]) -> Generator[Any, Any, T]:
    """Await what a task waits for; if it is inside a gate, another callback may come in meanwhile."""
    visit = None if _visit.get() is None else _gone_out(asyncio.current_task())
    if visit is None:
        return (yield from wait)
    try:
        result = yield from wait
    except GeneratorExit:  # the task is dropped
        raise
    except BaseException:
        yield from _back(visit).__await__()
        raise
    yield from _back(visit).__await__()
    return result


class LetsIn(Generic[T]):
    """A coroutine, awaited as letting_in() does."""

    def __init__(self, coroutine: Coroutine[Any, Any, T]) -> None:
        self._coroutine = coroutine

    def __await__(self) -> Generator[Any, Any, T]:
        return letting_in(self._coroutine.__await__())


def _gone_out(caller: object) -> _Visit | None:
    """Let another callback in, if the caller is the owner of a visit; return that visit."""
    visit = _visit.get()
    if visit is None or visit.is_out or visit.owner != caller:
        return None
    visit.is_out = True
    visit.gate.leave()
    return visit


def _wait(enter: Enter) -> None:
    room = threading.Lock()
    room.acquire()

    def begin() -> bool:
        room.release()
        return True

    enter(begin)
    room.acquire()


async def _back(visit: _Visit) -> None:
    cancelled = await _wait_async(visit.gate.come_back)
    visit.is_out = False
    if cancelled is not None:
        raise cancelled


async def _wait_async(enter: Enter) -> asyncio.CancelledError | None:
    """Enter, and return when that has happened; the error if the task was cancelled meanwhile."""
    loop = asyncio.get_running_loop()
    room: asyncio.Future[None] = loop.create_future()

    def begin() -> bool:
        try:
            loop.call_soon_threadsafe(room.set_result, None)
        except RuntimeError:  # the loop is closed, and its tasks are dropped
            return False
        return True

    enter(begin)
    cancelled: asyncio.CancelledError | None = None
    while not room.done():
        try:
            await asyncio.shield(room)
        except asyncio.CancelledError as error:
            cancelled = error
    return cancelled
