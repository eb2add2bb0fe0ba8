"""Dispatcher: the process's one asyncio loop, in a thread of its own, and how other threads reach it.

All framework actors of a process run on this loop. User code runs in the dispatcher's workers, never on the loop.
Each holder of the loop calls acquire() and then release(): the thread starts with the first and ends with the last.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Generic, TypeVar

from rr_actors.base.errors import Unavailable, UsageError
from rr_actors.base.reporting import log
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime import interpreter
from rr_actors.runtime.shielding import Flag
from rr_actors.runtime.user_loop import log_exception, start_loop_thread
from rr_actors.runtime.workers import Workers

logger = Log("rr_actors")

T = TypeVar("T")

_BEGINS_S = 1.0
"""After which time a thread looks whether the loop that is to begin its coroutine still runs."""
FORKED = "belongs to the process that this one was forked from; start a System in this one, after the fork"


class Dispatcher:
    """An event loop in a daemon thread. Use acquire(); make one yourself only in tests.

    Attributes:
        loop: the event loop.
        workers: the workers that run user code.
        closed: whether calls are refused: the loop has ended, or belongs to the process that this one was forked from.
        no_loop: the reason for that, once `closed` is true.
        more: on the loop: whether other calls follow the one that runs.
    """

    loop: asyncio.AbstractEventLoop
    workers: Workers

    def __init__(self) -> None:
        self._calls: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._turn = 0  # the number of times that the loop took the calls
        self._woken_for = -1  # the turn for which the loop was woken last
        self.closed = False
        self.more = False
        self.no_loop = "the loop of rr_actors has ended in this process"
        try:
            self._bell: _Bell | None = _Bell()
        except OSError as error:
            raise Unavailable(f"rr-loop: no event loop can be started: {wanted_by(error) or error}") from error
        self.workers = Workers(self.call, self.hand_over)
        log.begin_thread(_may_block)
        try:
            self.thread = start_loop_thread(self._begin, "rr-loop")
        except Unavailable:
            self._bell = None
            raise

    def call(self, fn: Callable[..., object], *args: Any) -> None:
        """Call fn(*args) on the loop, soon. From any thread; in the order of the calls; one wake-up for many.

        An error of fn is logged.

        Raises:
            Unavailable: the dispatcher is closed.
        """
        if self.closed:
            raise Unavailable(self.no_loop)
        self._calls.append((fn, args))
        woken_for = self._woken_for
        turn = self._turn
        if woken_for == turn:  # the turn that the loop was woken for has not begun, and will find this call too
            return
        if threading.get_ident() == self._ident:
            self.loop.call_soon(self._drain)
        else:
            try:
                self.loop.call_soon_threadsafe(self._drain)
            except RuntimeError as error:
                raise Unavailable(self.no_loop) from error
        # Last: if this thread is interrupted before, the next call wakes the loop, perhaps once more than needed.
        self._woken_for = turn

    def hand_over(self, fn: Callable[..., object], *args: Any) -> None:
        """Call fn(*args) on the loop as call() does, for a thread that will sleep next.

        The loop is woken while this thread does not hold Python's lock, so the loop can run at once. A thread that has
        more calls to make uses call(), which keeps the lock: so one wake-up serves many calls.
        """
        if self._woken_for == self._turn or threading.get_ident() == self._ident:
            self.call(fn, *args)
            return
        bell = self._bell
        if self.closed or bell is None:
            raise Unavailable(self.no_loop)
        self._calls.append((fn, args))
        turn = self._turn
        os.eventfd_write(bell.fd, 1)
        self._woken_for = turn

    def run(self, coroutine: Coroutine[Any, Any, T], timeout_s: float | None = None) -> T:
        """Run the coroutine on the loop and wait for its result. For other threads than the loop's.

        A thread that is interrupted (Ctrl-C) cancels the coroutine, and waits until it has ended for that reason.

        Raises:
            UsageError: called on the loop's or the user loop's own thread, where waiting would hang.
            TimeoutError: the coroutine was not done after `timeout_s` seconds, and is cancelled.
            Unavailable: the dispatcher was closed, or belongs to the process that this one was forked from.
        """
        course = self.course(coroutine)
        try:
            return course.wait(timeout_s)
        except BaseException:
            course.end()
            raise

    def course(self, coroutine: Coroutine[Any, Any, T]) -> Course[T]:
        """Return the course of a coroutine, for a thread other than the loop's that waits for its result."""
        try:
            self.check_may_block(f"waiting for {getattr(coroutine, '__qualname__', 'a coroutine')}")
        except UsageError:
            coroutine.close()
            raise
        return Course(self, coroutine)

    def is_behind(self) -> bool:
        """Return whether calls wait, or one runs: what the calling thread asked for may not have been done."""
        return bool(self._calls)

    def is_loop_thread(self) -> bool:
        """Return whether the calling thread is the loop's."""
        return threading.get_ident() == self._ident

    def may_block(self) -> bool:
        """Return whether the calling thread may wait: it is neither the loop's nor the user loop's."""
        ident = threading.get_ident()
        return ident != self._ident and ident != self.workers.user_loop_ident

    def check_may_block(self, what: str) -> None:
        """Raise UsageError on the loop's thread and the user loop's, which must not wait."""
        if self.is_loop_thread():
            raise UsageError(f"{what}: refused on the thread of the rr_actors loop, where it would hang the process")
        if not self.may_block():
            raise UsageError(
                f"{what}: refused in an `async def` callback, where blocking would hold up all others; "
                f"await the form for coroutines (load_async, or ask with block=False), or use asyncio.to_thread"
            )

    def close(self, timeout_s: float = 1.0) -> None:
        """Run the earlier calls, then end the loop, the workers and the user loop.

        Another thread waits up to `timeout_s` seconds for the workers, and then for the loop. The loop's own thread
        does not wait: the threads end by themselves.
        """
        if self.closed:
            return
        on_loop = self.is_loop_thread()
        self.workers.close(0.0 if on_loop else timeout_s)
        with contextlib.suppress(Unavailable):  # the last holder has closed it on the loop meanwhile
            self.call(self._stop.set)
        self.closed = True
        if not on_loop:
            self.thread.join()
            log.flush(timeout_s)

    def _abandon(self) -> None:
        """Refuse everything, in a forked child: it does not have the threads, and must not wait for them."""
        self.closed = True
        self.no_loop = f"the loop of rr_actors {FORKED}"
        self._ident = 0  # a thread of the child may have the same id
        self.workers.abandon()

    def _rung(self, bell: _Bell) -> None:
        os.eventfd_read(bell.fd)
        self._drain()

    def _drain(self) -> None:
        self._turn += 1  # before the first call: a call() from now on wakes the loop again
        for left in range(len(self._calls) - 1, -1, -1):
            fn, args = self._calls[0]
            self.more = left > 0
            try:
                fn(*args)
            except Exception:
                logger.exception("%s raised on the loop", getattr(fn, "__qualname__", fn))
            except BaseException as error:  # SystemExit on the loop would end all actors of the process
                logger.error("%s raised on the loop", getattr(fn, "__qualname__", fn), exc_info=error)
            self._calls.popleft()  # is_behind() counts a call until it has returned

    def _begin(self, loop: asyncio.AbstractEventLoop) -> asyncio.Future[None]:
        self._ident = threading.get_ident()
        self._stop = asyncio.Event()
        self.loop = loop
        loop.set_exception_handler(log_exception)
        return loop.create_task(self._until_closed())

    async def _until_closed(self) -> None:
        bell = self._bell
        assert bell is not None
        self.loop.add_reader(bell.fd, self._rung, bell)
        await self._stop.wait()
        self.loop.remove_reader(bell.fd)
        self._bell = None
        self._drain()


class _Bell:
    """Wakes the loop. Its descriptor is closed when no thread can write to it any more: each has a reference.

    It is not closed at exit, when the loop may still run.
    """

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        weakref.finalize(self, os.close, self.fd).atexit = False


class Course(Generic[T]):
    """A coroutine on the loop, for whose result one thread waits. Any other thread may cancel it."""

    def __init__(self, dispatcher: Dispatcher, coroutine: Coroutine[Any, Any, T]) -> None:
        self._dispatcher = dispatcher
        self._coroutine = coroutine
        self._context = contextvars.copy_context()
        self._task: asyncio.Task[T] | None = None
        self._begun = False
        self._given_up = False
        self._ended = Flag()

    def wait(self, timeout_s: float | None = None) -> T:
        """Run the coroutine and return its result.

        Raises:
            TimeoutError: it was not done after `timeout_s` seconds, and is cancelled.
            Unavailable: it was given up, or the loop has ended.
        """
        try:
            self._dispatcher.hand_over(self._begin)
        except Unavailable:
            self._coroutine.close()
            raise
        if not self._has_ended_within(timeout_s):
            self.give_up()
            raise TimeoutError
        task, self._task = self._task, None
        if task is None or task.cancelled():
            raise Unavailable("it was given up, or the loop of rr_actors ended while this waited for it")
        try:
            return task.result()
        finally:
            del task  # it has the error, whose traceback has this frame

    def _has_ended_within(self, timeout_s: float | None) -> bool:
        """Wait until the coroutine has ended. A loop that has ended before it began the coroutine never will."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._begun:
            left_s = None if deadline is None else deadline - time.monotonic()
            if self._ended.wait(_BEGINS_S if left_s is None else min(left_s, _BEGINS_S)):
                return True
            if left_s is not None and left_s <= _BEGINS_S:
                return False
            if not (self._begun or self._dispatcher.thread.is_alive()):
                raise Unavailable(self._dispatcher.no_loop)
        return self._ended.wait(None if deadline is None else deadline - time.monotonic())

    def give_up(self) -> None:
        """Cancel the coroutine. The waiting thread gets an error when the coroutine has ended."""
        self._given_up = True
        with contextlib.suppress(Unavailable):
            self._dispatcher.call(self._cancel)

    def end(self) -> None:
        """Give up the coroutine, unless it has ended or is given up, and wait until it has ended, if it has begun."""
        if self._ended.is_set or self._given_up:
            return
        self.give_up()
        if self._begun:  # after give_up(): if the loop begins it later, it sees that it is given up
            self._ended.wait()
        else:
            self._coroutine.close()

    def _begin(self) -> None:
        self._begun = True
        if self._given_up:
            self._coroutine.close()
            self._ended.set()
            return
        self._task = task = self._context.run(self._dispatcher.loop.create_task, self._coroutine)
        task.add_done_callback(self._say_ended)

    def _say_ended(self, task: asyncio.Task[T]) -> None:
        if not task.cancelled():
            task.exception()  # its thread may not look at it any more: asyncio would log it
        self._ended.set()

    def _cancel(self) -> None:
        if (task := self._task) is not None:
            task.cancel()


class _Process:
    """The process's dispatcher, and the number of its holders."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.holders = 0
        self.dispatcher: Dispatcher | None = None


_process = _Process()


def acquire(*, workers_limit: int | None = None) -> Dispatcher:
    """Return the process's dispatcher, which the first holder starts. Each caller must call release() once.

    Args:
        workers_limit: the most worker threads from now on; unchanged if None.

    Raises:
        UsageError: gevent or eventlet has patched this process.
    """
    with _process.lock:
        if _process.dispatcher is None:
            interpreter.check_not_patched()
            _process.dispatcher = Dispatcher()
        _process.holders += 1
        if workers_limit is not None:
            _process.dispatcher.workers.threads.limit = workers_limit
        return _process.dispatcher


def release() -> None:
    """Release the dispatcher after acquire(). The last release ends the loop and its threads."""
    with _process.lock:
        if _process.dispatcher is None:
            raise UsageError("release() without acquire(): nobody holds the dispatcher of this process")
        _process.holders -= 1
        if _process.holders:
            return
        dispatcher, _process.dispatcher = _process.dispatcher, None
    dispatcher.close()


def current() -> Dispatcher | None:
    """Return the process's dispatcher if it runs, without holding it."""
    return _process.dispatcher


def aside(work: Callable[[], object]) -> None:
    """Run a user's code in a worker: the calling thread may be the loop's, or that of another user's handler.

    Without a worker, call it here; in a new thread if an event loop runs here.
    """
    process = _process.dispatcher
    if process is not None:
        with contextlib.suppress(Unavailable):  # it is ending, or the machine gives no thread
            process.workers.in_thread(work, beyond_limit=True)
            return
    with contextlib.suppress(RuntimeError):  # no loop runs here, or the machine gives no thread
        asyncio.get_running_loop()
        threading.Thread(target=work, name="rr-aside", daemon=True).start()
        return
    work()


def _may_block() -> bool:
    process = _process.dispatcher
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return process is None or process.may_block()
    return False


def check_asyncio(what: str) -> None:
    """Raise UsageError if no event loop of asyncio runs in this thread, as under trio."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        raise UsageError(f"{what}: needs asyncio; under trio, make the call that blocks in a thread") from None


def check_may_block(what: str) -> None:
    """Call check_may_block() of the process's dispatcher if it runs."""
    if (dispatcher := _process.dispatcher) is not None:
        dispatcher.check_may_block(what)


# A forked process inherits its parent's running systems, and leaves them to the parent. It shares the sockets and the
# epoll of the loop with the parent: closing or freeing them in the child disturbs the parent.

_running: weakref.WeakKeyDictionary[Any, Callable[[Any], object]] = weakref.WeakKeyDictionary()
_left: list[object] = []


def leave_in_children(running: T, leave: Callable[[T], object]) -> None:
    """Call leave(running) in each process that is forked from now on, where its result is never freed."""
    _running[running] = leave


def forget_in_children(running: object) -> None:
    """End leave_in_children() for an object that has ended."""
    _running.pop(running, None)


def _leave_all_in_child() -> None:
    if _process.dispatcher is not None:
        _process.dispatcher._abandon()  # pyright: ignore[reportPrivateUsage]  # same file, of the same process
    _process.__init__()
    if _running:
        _left.extend([leave(running) for running, leave in list(_running.items())])
        _running.clear()


def _close_at_exit() -> None:
    # A daemon thread that is still inside the loop's C code while the interpreter is taken down may crash it.
    if _process.dispatcher is not None:
        _process.dispatcher.close(0.0)  # its holders may still release it


os.register_at_fork(after_in_child=_leave_all_in_child)
interpreter.at_exit(_close_at_exit)
