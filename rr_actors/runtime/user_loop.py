"""The user loop: a second event loop, for users' coroutines, so that they never run on the framework's loop."""

from __future__ import annotations

import asyncio
import functools
import logging
import threading
import weakref
from collections.abc import Callable, Coroutine
from contextvars import Context
from types import CoroutineType
from typing import Any, TypeGuard

from rr_actors.base.errors import Unavailable
from rr_actors.base.scarcity import wanted_by

logger = logging.getLogger("rr_actors")

Done = Callable[[Any, BaseException | None], object]
"""A function that is called at the end of a call, with (result, None) or (None, error)."""


def new_loop() -> asyncio.AbstractEventLoop:
    """Return a new event loop: uvloop's, or asyncio's if uvloop cannot be imported. Sets no policy."""
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop()
    return uvloop.new_event_loop()


def log_exception(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an exception, as the exception handler of an event loop."""
    logger.error("on the loop: %s", context.get("message"), exc_info=context.get("exception"))


def is_coroutine(value: object) -> TypeGuard[Coroutine[Any, Any, Any]]:
    """Return whether `value` is the result of calling an `async def` function."""
    return type(value) is CoroutineType


def closing(inner: Coroutine[Any, Any, Any], outer: Coroutine[Any, Any, Any]) -> Coroutine[Any, Any, Any]:
    """Return `outer`, which awaits `inner`. If it is closed before it begins, close `inner` too.

    Otherwise Python would warn that the user's coroutine was never awaited.
    """
    weakref.finalize(outer, inner.close).atexit = False
    return outer


def start_loop_thread(
    begin: Callable[[asyncio.AbstractEventLoop], Coroutine[Any, Any, object]], name: str
) -> threading.Thread:
    """Start a daemon thread that runs an event loop, and return it when the loop exists.

    Args:
        begin: called in that thread with the loop; returns the coroutine with which the loop ends.

    Raises:
        Unavailable: the machine gives no thread, or no descriptors, for it.
    """
    ready = threading.Event()
    failures: list[BaseException] = []

    def work() -> None:
        try:
            with asyncio.Runner(loop_factory=new_loop) as runner:
                life = begin(runner.get_loop())
                ready.set()
                runner.run(life)
        except BaseException as error:
            if ready.is_set():
                raise
            failures.append(error)
            ready.set()

    thread = threading.Thread(target=work, name=name, daemon=True)
    try:
        thread.start()
        ready.wait()
        if failures:
            raise failures[0]
    except (OSError, RuntimeError, MemoryError) as error:
        if wanted := wanted_by(error):
            raise Unavailable(f"{name}: no event loop can be started: {wanted}") from error
        raise
    return thread


class UserLoop:
    """An event loop in a daemon thread, started at once.

    Args:
        elsewhere: calls a function in another thread. Errors of users' tasks are logged there: an exception of a
            user's class may do anything in its __str__.
    """

    def __init__(self, elsewhere: Callable[[Callable[[], object]], None]) -> None:
        self._tasks: set[asyncio.Task[None]] = set()
        self._elsewhere = elsewhere
        self.thread = start_loop_thread(self._begin, "rr-user-loop")

    def start(self, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context) -> None:
        """Run a coroutine as a task in `context`; `done` is called in the loop's thread."""
        try:
            self._loop.call_soon_threadsafe(self._spawn, coroutine, done, context)
        except RuntimeError as error:
            raise Unavailable("the user loop is closed: this process is stopping") from error

    def stop(self) -> None:
        """Cancel the tasks and end the thread, without waiting for it."""
        try:
            self._loop.call_soon_threadsafe(self._stop.set)
        except RuntimeError:
            logger.debug("the user loop had ended already")

    def _spawn(self, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context) -> None:
        task = start_task(self._loop, coroutine, done, context)
        self._tasks.add(task)  # the loop itself keeps only weak references
        task.add_done_callback(self._tasks.discard)

    def _begin(self, loop: asyncio.AbstractEventLoop) -> Coroutine[Any, Any, object]:
        self._loop = loop
        self._stop = asyncio.Event()
        loop.set_exception_handler(self._log_elsewhere)
        return self._stop.wait()

    def _log_elsewhere(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        try:
            self._elsewhere(functools.partial(log_exception, loop, context))
        except Unavailable:
            logger.error("on the loop: %s", context.get("message"))


def start_task(
    loop: asyncio.AbstractEventLoop, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context
) -> asyncio.Task[Any]:
    """Run the coroutine as a task of `loop`, in `context`; then call done(result, error), outside of `context`.

    The caller must keep the task until then: the loop has only weak references.
    """

    def ended(task: asyncio.Task[tuple[Any, BaseException | None]]) -> None:
        if task.cancelled():  # before it began
            coroutine.close()
            done(None, asyncio.CancelledError())
        else:
            done(*task.result())

    task = loop.create_task(_outcome(coroutine), context=context)
    # Not inside the task: `done` may make another thread enter `context`, in which the task would still be.
    task.add_done_callback(ended, context=Context())
    return task


async def _outcome(coroutine: Coroutine[Any, Any, Any]) -> tuple[Any, BaseException | None]:
    try:
        return await coroutine, None
    except BaseException as error:  # SystemExit, too: in a task it would end the loop
        return None, error


def name_of(fn: Callable[..., Any]) -> str:
    """Return a callable's name for logs and errors."""
    return getattr(fn, "__qualname__", None) or repr(fn)
