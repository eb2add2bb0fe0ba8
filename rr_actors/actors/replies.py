"""Reply: the Pykka future of rr_actors. It can be awaited without blocking a loop, and calls back when it is set."""

from __future__ import annotations

import asyncio
import logging
import queue
import sys
import threading
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, TypeVar

import pykka
from pykka import ActorDeadError

from rr_actors.actors import asking, dispatcher
from rr_actors.actors.asking import Target
from rr_actors.clock import time_limit
from rr_actors.errors import ActorUnavailable

if TYPE_CHECKING:
    from types import TracebackType

logger = logging.getLogger("rr_actors")

T = TypeVar("T")

ExcInfo = tuple[type[BaseException] | None, BaseException | None, "TracebackType | None"]


class Reply(pykka.Future[T]):
    """A value that will be there. Everything Pykka documents of futures holds: get, set, map, join, reduce, await.

    Args:
        target: the actor that the reply is awaited from; lets get() refuse to wait for itself.
    """

    # most replies are set, read and gone: what few of them need is made when it is needed
    _set = False
    _value: Any = None
    _error: BaseException | None = None
    _open: Callable[[], Any] | None = None
    _callbacks: list[Callable[[], object]] | None = None
    _hook_lock: threading.RLock | None = None

    def __init__(self, target: Target | None = None) -> None:  # pyright: ignore[reportMissingSuperCall] - set_get_hook
        self.target = target
        self._lock = threading.Lock()

    def done(self) -> bool:
        """Whether get() would return, or raise, at once."""
        return self._set

    def get(self, *, timeout: float | None = None) -> T:
        """Wait for the value, or for ever if `timeout` (seconds) is None.

        Raises:
            pykka.Timeout: not there after `timeout` seconds.
            UsageError: waiting here would hang: on the loop's thread, or for an actor that waits for this handler. Or
                `timeout` is no such number.
            BaseException: what was set as exception.
        """
        if self._hook_lock is not None:
            with self._hook_lock:
                return super().get(timeout=timeout)
        if not self._set:
            self._wait(timeout)
        if self._open is not None:
            self._unpack()
        if self._error is not None:
            raise self._error
        return self._value

    def set(self, value: Any = None) -> None:
        """Set the value.

        Raises:
            queue.Full: it is set already, or has a get hook.
        """
        self._settle(value, None, None)

    def set_exception(self, exc_info: ExcInfo | None = None) -> None:
        """Set the exception that get() raises; the one being handled if None.

        Raises:
            queue.Full: it is set already, or has a get hook.
        """
        self._settle(None, error_of(exc_info), None)

    def set_unopened(self, unpack: Callable[[], T]) -> None:
        """Set the value or exception as what `unpack` returns or raises, run once, in the thread that wants it.

        Unpickling imports modules, so it must happen neither on the loop nor for replies that nobody reads.

        Raises:
            queue.Full: it is set already, or has a get hook.
        """
        self._settle(None, None, unpack)

    def set_get_hook(self, func: Callable[[float | None], T]) -> None:
        """Let get() return func(timeout), called once.

        Raises:
            queue.Full: it is set already.
        """
        with self._lock:
            if self._set:
                raise queue.Full
            self._hook_lock = threading.RLock()
            super().__init__()  # Pykka's part of a future is for those that have a hook
            super().set_get_hook(func)

    def add_done_callback(self, callback: Callable[[], object]) -> None:
        """Call `callback` once it is set: in the thread that sets it, or here and now if it is set already."""
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
        except RuntimeError:  # driven by something else than asyncio: what Pykka itself does
            return (yield from super().__await__())
        if self._hook_lock is not None:
            return (yield from loop.run_in_executor(None, self.get).__await__())
        if not self._set:
            yield from self._wait_on(loop).__await__()
        if self._open is not None and (process := dispatcher.current()) is not None and process.is_loop_thread():
            yield from process.workers.run(self._unpack).__await__()
        return self.get()

    __iter__ = __await__

    def _settle(self, value: Any, error: BaseException | None, unpack: Callable[[], Any] | None) -> None:
        with self._lock:
            if self._set or self._hook_lock is not None:
                raise queue.Full
            self._value, self._error, self._open = value, error, unpack
            self._set = True
            callbacks, self._callbacks = self._callbacks, None
        for callback in callbacks or ():
            try:
                callback()
            except Exception:
                logger.exception("a callback of %r raised", self)

    def _wait(self, timeout: float | None) -> None:
        limit_s = time_limit(timeout, "timeout")
        dispatcher.check_may_block(f"waiting for {self._whose()}")
        waiter = threading.Lock()
        waiter.acquire()
        waiting = asking.begin_wait(self)
        try:
            self.add_done_callback(waiter.release)
            if not waiter.acquire(timeout=-1 if limit_s is None else limit_s):
                self._forget(waiter.release)
                if not self._set:
                    raise self.overdue(timeout)
        finally:
            asking.end_wait(waiting, self)

    async def _wait_on(self, loop: asyncio.AbstractEventLoop) -> None:
        waiter: asyncio.Future[None] = loop.create_future()

        def wake() -> None:
            if not waiter.done():
                waiter.set_result(None)

        def call_back() -> None:
            try:
                loop.call_soon_threadsafe(wake)
            except RuntimeError:
                logger.debug("%r was set after the loop that awaited it had closed", self)

        waiting = asking.begin_wait(self)
        try:
            self.add_done_callback(call_back)
            await waiter
        finally:
            self._forget(call_back)
            asking.end_wait(waiting, self)

    def _forget(self, callback: Callable[[], object]) -> None:
        with self._lock:
            if self._callbacks is not None and callback in self._callbacks:
                self._callbacks.remove(callback)

    def _unpack(self) -> None:
        with self._lock:
            if self._open is None:
                return
            try:
                self._value = self._open()
            except BaseException as error:  # kept, and raised by every get()
                self._error = error
            self._open = None

    def overdue(self, timeout_s: float | None) -> pykka.Timeout:
        """The error for who has waited so long in vain."""
        return pykka.Timeout(f"no reply after {timeout_s} seconds: {self._whose()}")

    def _whose(self) -> str:
        return "a future" if self.target is None else f"the reply of {self.target.name}"


class StopReply(Reply[bool]):
    """The future of a stop: True, or False if the actor was dead already."""

    def set(self, value: Any = None) -> None:
        """It has ended."""
        super().set(True)

    def set_unopened(self, unpack: Any) -> None:
        """It has ended, says its process."""
        super().set(True)

    def set_exception(self, exc_info: ExcInfo | None = None) -> None:
        """It was dead already, or could not be asked."""
        error = error_of(exc_info)
        if isinstance(error, (ActorDeadError, ActorUnavailable)):
            super().set(False)
        else:
            super().set_exception((type(error), error, error.__traceback__))


def fail(reply: pykka.Future[Any], error: BaseException) -> None:
    """Set the exception that get() raises, with where it was raised so far."""
    reply.set_exception((type(error), error, error.__traceback__))


def error_of(exc_info: ExcInfo | None) -> BaseException:
    """The exception that Future.set_exception(exc_info) means; the one being handled if None."""
    kind, error, traceback = exc_info or sys.exc_info()
    if error is None:
        error = kind() if kind is not None else RuntimeError("an exception was set without saying which")
    if traceback is not None and error.__traceback__ is not traceback:
        error = error.with_traceback(traceback)
    return error
