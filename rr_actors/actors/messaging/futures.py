"""Reply: the future of rr_actors, one of Pykka's and one of concurrent.futures at once.

It can be awaited without blocking a loop. concurrent.futures.wait and as_completed, and asyncio.wrap_future, take it:
they use the attributes `_condition`, `_state` and `_waiters` of a concurrent.futures.Future, which are made here on
first use.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import operator
import queue
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from types import FunctionType
from typing import TYPE_CHECKING, Any, TypeVar

import pykka
from pykka import ActorDeadError

from rr_actors.actors.messaging import ask_cycles
from rr_actors.actors.messaging.ask_cycles import Target
from rr_actors.base.errors import ActorUnavailable, RrError, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import traceback_of
from rr_actors.runtime import event_loop
from rr_actors.runtime.callback_errors import log_raised, raised_by
from rr_actors.runtime.shielding import is_interruptible, shielded
from rr_actors.runtime.time_limits import time_limit
from rr_actors.runtime.workers import LettingIn, letting_in

if TYPE_CHECKING:
    from types import TracebackType

logger = Log("rr_actors")

T = TypeVar("T")

ExcInfo = tuple[type[BaseException] | None, BaseException | None, "TracebackType | None"]


class Reply(pykka.Future[T], concurrent.futures.Future[T]):
    """A value that comes later. It has all that Pykka documents of futures: get, set, map, join, reduce, await.

    It has all that concurrent.futures documents, too: result, exception, cancel, add_done_callback.

    Args:
        target: the actor that replies; with it, get() can refuse a wait that would never end.

    Attributes:
        withdraw: set by the maker of the reply if the request can be taken back; cancel() calls it once.
    """

    withdraw: Callable[[], object] | None = None

    # most replies are only set and read: attributes that few of them need are made on first use
    _set = False
    _value: Any = None
    _error: BaseException | None = None
    _open: Callable[[], Any] | None = None
    _running = False
    _cancelled = False
    _callbacks: list[Callable[[], object]] | None = None  # this package's
    _listeners: list[Callable[[Reply[T]], object]] | None = None  # a user's
    _watchers: list[Any] | None = None
    _gate: threading.Condition | None = None
    _hook_lock: threading.RLock | None = None
    _hook: Callable[[float | None], Any]
    _hook_runs = False

    def __init__(self, target: Target | None = None) -> None:  # pyright: ignore[reportMissingSuperCall]
        self.target = target
        self._lock = threading.RLock()

    def done(self) -> bool:
        """Return whether get() would return, or raise, at once."""
        return self._set

    def running(self) -> bool:
        """Return whether an actor of this process handles the message now: cancel() comes too late."""
        return self._running and not self._set

    def cancelled(self) -> bool:
        """Return whether cancel() has succeeded."""
        return self._cancelled

    def cancel(self) -> bool:
        """Take back the request; get() and result() raise concurrent.futures.CancelledError from then on.

        An rr_actors.Actor of this process does not handle the message then; an actor elsewhere may. A load is
        withdrawn.

        Returns:
            False if the future is done, if its actor handles the message already, or if the request cannot be taken
            back (a stop, an unload).
        """
        if self._set:
            return self._cancelled
        lock: Any = self._lock
        if lock._is_owned():  # a signal handler interrupted this thread at the future: no other thread gets the lock
            return self._cancel()
        return shielded(self._cancel)  # an interrupt half way would leave threads waiting, or the request not withdrawn

    def _cancel(self) -> bool:
        with self._lock:
            withdraw = self.withdraw
            if self._set or self._running or withdraw is None:
                return self._cancelled
            self._cancelled = True
            callbacks = self._put(None, concurrent.futures.CancelledError(f"cancelled: {self._whose()}"), None)
        try:
            withdraw()
        finally:  # it raises Unavailable if the loop has ended
            self._call_back(callbacks)
        return True

    def set_running_or_notify_cancel(self) -> bool:
        """Note that the actor begins to handle the message; return False if cancelled: it must not handle it."""
        with self._lock:
            self._running = not self._cancelled
            return self._running

    def result(self, timeout: float | None = None) -> T:
        """Wait for the value, as get() does, with the errors of concurrent.futures.

        Raises:
            TimeoutError: the value has not come after `timeout` seconds.
            concurrent.futures.CancelledError: the future was cancelled.
            UsageError: waiting here would hang, or `timeout` is no number of seconds.
            BaseException: the exception that was set.
        """
        try:
            if self._hook_lock is None:
                self._wait_done(timeout)
                return self.get()
            try:
                return self.get(timeout=timeout)
            except pykka.Timeout as error:
                raise TimeoutError(str(error)) from None
        finally:
            del self  # the error has a traceback with this frame

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Wait, and return the exception that was set; None if a value was set.

        A future from map(), join() and the like is never cancelled itself. It returns the CancelledError of the future
        from which it was made.

        Raises:
            TimeoutError, concurrent.futures.CancelledError, UsageError: as for result().
        """
        try:
            if self._hook_lock is not None:
                return self._hooked_exception(timeout)
            self._wait_done(timeout)
            if self._open is not None:
                self._unpack()
            if self._cancelled and self._error is not None:
                raise self._error
            return self._error
        finally:
            del self  # the error has a traceback that began in this frame

    def _hooked_exception(self, timeout: float | None) -> BaseException | None:
        limit_s = time_limit(timeout, "timeout")
        try:
            self.get(timeout=timeout)
            return None
        except KeyboardInterrupt:
            raise
        except pykka.Timeout as error:
            if limit_s is None:  # so it was set
                return error
            raise TimeoutError(str(error)) from None
        except UsageError as error:
            event_loop.check_may_block(f"waiting for {self._whose()}")
            if "ring" in error.details:
                raise
            return error
        except BaseException as error:
            return error
        finally:
            del self  # the error has a traceback with this frame

    def get(self, *, timeout: float | None = None) -> T:
        """Wait for the value, or for ever if `timeout` (seconds) is None.

        Raises:
            pykka.Timeout: the value has not come after `timeout` seconds.
            UsageError: waiting here would hang: on the loop's thread, or for an actor that waits for this handler. Or
                `timeout` is no number of seconds.
            BaseException: the exception that was set.
        """
        try:
            hook_lock = self._hook_lock
            if hook_lock is not None:
                with hook_lock:
                    if not self._set:
                        self._end_hook(self._hook(timeout), None)
            if not self._set:
                self._wait(timeout)
            if self._open is not None:
                self._unpack()
            if self._error is not None:
                raise self._error
            return self._value
        finally:
            del self  # the error has a traceback with this frame

    def take(self, *, timeout: float | None = None) -> T:
        """Return what get() does, and forget the error, for a caller that alone has the future.

        Its frames have the future, and the error has its frames: nothing would free what they have but a collection.
        """
        try:
            return self.get(timeout=timeout)
        finally:
            self.forget_error()

    def forget_error(self) -> None:
        """Have a later get() raise another error than the one that has been raised."""
        if self._error is not None:
            self._error = RrError(f"{self._whose()}: its error was raised before")

    def set(self, value: Any = None) -> None:
        """Set the value. After cancel(), this and the other methods that set it do nothing.

        Raises:
            queue.Full: it is set already, or has a get hook; as for the other methods that set it.
        """
        self._settle(value, None, None)

    def set_result(self, result: Any) -> None:
        """Set the value; concurrent.futures' name for set()."""
        self.set(result)

    def set_exception(  # pyright: ignore[reportIncompatibleMethodOverride]  # takes what both bases take
        self, exc_info: ExcInfo | BaseException | None = None
    ) -> None:
        """Set the exception that get() raises; if None, the exception that is being handled."""
        self._settle(None, error_of(exc_info), None)

    def set_unopened(self, unpack: Callable[[], T], *, raises: bool = False) -> None:
        """Set a function that returns the value or raises the exception; the first thread that reads it runs it once.

        Unpickling imports modules, so it must happen neither on the loop nor for replies that nobody reads.

        Args:
            raises: whether `unpack` raises an exception.
        """
        self._settle(None, None, unpack, raises=raises)

    def set_get_hook(self, func: Callable[[float | None], T]) -> None:
        """Make get() return func(timeout), which is called once.

        Raises:
            queue.Full: it is set already.
        """
        with self._lock:
            if self._set:
                raise queue.Full
            self._hook = func
            self._hook_lock = threading.RLock()

    def add_done_callback(self, fn: Callable[[Reply[T]], object]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Call fn(this future) soon after it is set, in a worker thread; if it is set already, call fn now.

        Threads and coroutines that wait for the future do not wait for fn. What fn raises is logged. Without a running
        loop of rr_actors the thread that sets the future calls fn.

        For a future from map(), join() and the like, this computes the value, in a new thread.
        """
        if type(fn) is FunctionType and fn.__module__ == "asyncio.futures":  # of wrap_future(): it only wakes a loop
            self.when_set(functools.partial(fn, self))
        elif not self._listen(fn):
            self._hear((fn,))
        self._run_hook()

    def _listen(self, fn: Callable[[Reply[T]], object]) -> bool:
        """Keep a user's callback; return False if the future is set already."""
        with self._lock:
            if self._set:
                return False
            if self._listeners is None:
                self._listeners = []
            self._listeners.append(fn)
            return True

    def when_set(self, callback: Callable[[], object]) -> None:
        """Call this package's callback, which must not block, in the thread that sets the future; now if it is set."""
        with self._lock:
            if not self._set:
                if self._callbacks is None:
                    self._callbacks = []
                self._callbacks.append(callback)
                return
        callback()

    def __await__(self) -> Generator[Any, None, T]:
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:  # no asyncio loop runs the coroutine: do as Pykka does
            return (yield from super().__await__())
        self._run_hook()
        if not self._set:
            yield from letting_in(self._wait_on(loop))
        if self._open is not None and (process := event_loop.current()) is not None and process.is_loop_thread():
            yield from process.workers.run(self._unpack).__await__()
        try:
            return self.get()
        finally:
            del self  # the error has a traceback with this frame

    __iter__ = __await__

    # -- for concurrent.futures and asyncio ----------------------------------------------------------------------------

    if not TYPE_CHECKING:  # type checkers see the attributes of concurrent.futures.Future

        @property
        def _condition(self) -> threading.Condition:
            self._run_hook()
            with self._lock:
                if self._gate is None:
                    self._gate = threading.Condition(self._lock)
                return self._gate

        @property
        def _state(self) -> str:
            if self._set:
                return "CANCELLED_AND_NOTIFIED" if self._cancelled else "FINISHED"
            return "RUNNING" if self._running else "PENDING"

        @property
        def _waiters(self) -> list[Any]:
            with self._lock:
                if self._watchers is None:
                    self._watchers = []
                return self._watchers

    # -- setting, waiting, unpacking -----------------------------------------------------------------------------------

    def _settle(
        self, value: Any, error: BaseException | None, unpack: Callable[[], Any] | None, *, raises: bool = False
    ) -> None:
        with self._lock:
            if self._cancelled:
                return
            if self._set or self._hook_lock is not None:
                raise queue.Full
            callbacks = self._put(value, error, unpack, raises=raises)
        self._call_back(callbacks)

    def _put(
        self, value: Any, error: BaseException | None, unpack: Callable[[], Any] | None, *, raises: bool = False
    ) -> list[Callable[[], object]] | None:
        """Set the value or the error, and return the callbacks to call. With the lock."""
        self._value, self._error, self._open = value, error, unpack
        self._set = True
        self.withdraw = None
        for waiter in self._watchers or ():
            if self._cancelled:
                waiter.add_cancelled(self)
            elif error is not None or raises:
                waiter.add_exception(self)
            else:
                waiter.add_result(self)
        callbacks, self._callbacks = self._callbacks, None
        return callbacks

    def _call_back(self, callbacks: list[Callable[[], object]] | None) -> None:
        for callback in callbacks or ():
            try:
                callback()
            except Exception:
                logger.exception("a callback of %r raised", self)
        if self._listeners is not None:
            listeners, self._listeners = self._listeners, None
            event_loop.aside(functools.partial(self._hear, listeners))

    def _hear(self, listeners: Iterable[Callable[[Reply[T]], object]]) -> None:
        for listener in listeners:
            try:
                listener(self)
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt) and is_interruptible():
                    raise
                log_raised(logger, raised_by(error), "a callback of %r raised", self)

    def _run_hook(self) -> None:
        """Call get() in a new thread if there is a get hook: a caller waits for the value without get()."""
        with self._lock:
            if self._hook_lock is None or self._hook_runs:
                return
            threading.Thread(target=self._finish_hook, name="rr-future", daemon=True).start()
            self._hook_runs = True  # last: start() raises if the machine gives no thread

    def _finish_hook(self) -> None:
        try:
            self.get()
        except BaseException as error:
            self._end_hook(None, error)
        finally:
            del self  # the error has a traceback with this frame

    def _end_hook(self, value: Any, error: BaseException | None) -> None:
        with self._lock:
            if self._set:
                return
            callbacks = self._put(value, error, None)
            self._hook_lock = None
        self._call_back(callbacks)

    def _wait_done(self, timeout: float | None) -> None:
        if self._set:
            return
        try:
            self._wait(timeout)
        except pykka.Timeout as error:
            raise TimeoutError(str(error)) from None

    def _wait(self, timeout: float | None) -> None:
        limit_s = time_limit(timeout, "timeout")
        event_loop.check_may_block(f"waiting for {self._whose()}")
        waiter = threading.Lock()
        waiter.acquire()
        self.check_wait()
        waiting = ask_cycles.begin_wait(self)
        try:
            self.when_set(waiter.release)
            with LettingIn():
                in_time = waiter.acquire(timeout=-1 if limit_s is None else limit_s)
            if not in_time:
                self._forget(waiter.release)
                if not self._set:
                    raise self.overdue(timeout)
        finally:
            ask_cycles.end_wait(waiting, self)

    def _wait_on(self, loop: asyncio.AbstractEventLoop) -> Generator[Any, None, None]:
        waiter: asyncio.Future[None] = loop.create_future()

        def wake() -> None:
            if not waiter.done():
                waiter.set_result(None)

        def call_back() -> None:
            try:
                loop.call_soon_threadsafe(wake)
            except RuntimeError:
                logger.debug("%r was set after the loop that awaited it had closed", self)
                self.unawaited()

        self.check_wait()
        waiting = ask_cycles.begin_wait(self)
        try:
            self.when_set(call_back)
            yield from waiter
        except BaseException:  # cancelled, perhaps in the moment in which this was set
            self.unawaited()
            raise
        finally:
            self._forget(call_back)
            ask_cycles.end_wait(waiting, self)

    def check_wait(self) -> None:
        """Raise if the calling code must not wait for this future, as it would hang."""

    def unawaited(self) -> None:
        """Note that a task that awaited this future was cancelled, or its loop closed. A load is withdrawn."""

    def _forget(self, callback: Callable[[], object]) -> None:
        with self._lock:
            if self._callbacks is not None and callback in self._callbacks:
                self._callbacks.remove(callback)

    def _unpack(self) -> None:
        try:
            with self._lock:
                if self._open is not None:
                    self._value, self._error = _opened(self._open)
                    self._open = None
        finally:
            del self  # the error has a traceback that began in this frame

    def overdue(self, timeout_s: float | None) -> pykka.Timeout:
        """Return the error for a caller that has waited `timeout_s` seconds without a reply."""
        return pykka.Timeout(f"no reply after {timeout_s} seconds: {self._whose()}")

    def __repr__(self) -> str:
        return f"<Reply: {self._whose()}, {self._state.lower()}>"

    def _whose(self) -> str:
        return "a future" if self.target is None else f"the reply of {self.target.name}"


def _derive(name: str, combine: Callable[..., Any]) -> Any:
    """Return Pykka's method of this name: combine(value, *args) is the value of the future that it returns.

    Pykka's own keep the futures in closures, which an error's traceback has: only a collection would free what the
    frames of its callers have.
    """

    @functools.wraps(getattr(pykka.Future, name))
    def derive(self: Reply[Any], *args: Any) -> Reply[Any]:
        derived: Reply[Any] = Reply()
        derived.set_get_hook(functools.partial(_combined, combine, self, args))
        return derived

    return derive


def _combined(combine: Callable[..., Any], future: Reply[Any], args: tuple[Any, ...], timeout: float | None) -> Any:
    try:
        value = future.get(timeout=timeout)
        if combine is _joined:
            args = tuple(map(operator.methodcaller("get", timeout=timeout), args))
        return combine(value, *args)
    finally:
        del future, args  # the error has a traceback with this frame


def _joined(value: Any, *others: Any) -> list[Any]:
    return [value, *others]


def _filtered(items: Any, func: Callable[[Any], bool]) -> list[Any]:
    return list(filter(func, items))


def _mapped(value: Any, func: Callable[[Any], Any]) -> Any:
    return func(value)


def _reduced(items: Any, func: Callable[[Any, Any], Any], *start: Any) -> Any:
    return functools.reduce(func, items, *start)


for _name, _combine in {"filter": _filtered, "join": _joined, "map": _mapped, "reduce": _reduced}.items():
    setattr(Reply, _name, _derive(_name, _combine))


class StopReply(Reply[bool]):
    """The future of a stop: True, or False if the actor was dead already.

    Attributes:
        ended: called when the actor has ended, before anybody can read True.
    """

    ended: Callable[[], object] | None = None

    def set(self, value: Any = None) -> None:
        """Note that the actor has ended: set True."""
        if self.ended is not None:
            self.ended()
        super().set(True)

    def set_unopened(self, unpack: Any, *, raises: bool = False) -> None:
        """Note that the actor has ended, as its process reports: set True."""
        self.set()

    def set_exception(self, exc_info: ExcInfo | BaseException | None = None) -> None:
        """Set False if the actor was dead already or could not be asked; else set the exception."""
        error = error_of(exc_info)
        if isinstance(error, (ActorDeadError, ActorUnavailable)):
            super().set(False)
        else:
            super().set_exception(error)


def fail(reply: pykka.Future[Any], error: BaseException) -> None:
    """Set the exception that get() raises, with its traceback so far."""
    reply.set_exception((type(error), error, traceback_of(error)))


def error_of(exc_info: ExcInfo | BaseException | None) -> BaseException:
    """Return the exception that Future.set_exception(exc_info) means; if None, the one that is being handled."""
    if isinstance(exc_info, BaseException):
        return exc_info
    kind, error, traceback = exc_info or sys.exc_info()
    if error is None:
        error = kind() if kind is not None else RuntimeError("an exception was set without saying which")
    if traceback is not None and traceback_of(error) is not traceback:
        error = BaseException.with_traceback(error, traceback)
    return error


def _opened(unpack: Callable[[], Any]) -> tuple[Any, BaseException | None]:
    """Return what `unpack` returns or raises. The error's traceback has this frame, which does not have the error."""
    try:
        return unpack(), None
    except BaseException as error:  # kept, and raised by every get()
        if isinstance(error, KeyboardInterrupt) and is_interruptible():
            raise  # the calling thread was interrupted: the next get() opens the reply again
        return None, error
