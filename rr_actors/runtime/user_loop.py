"""The user loop: a second event loop, for users' coroutines, so that they never run on the framework's loop."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
import weakref
from collections.abc import Callable, Coroutine
from contextvars import Context, copy_context
from types import CoroutineType, FrameType
from typing import Any, TypeGuard

from rr_actors.base.errors import Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import stacks_of_threads
from rr_actors.base.scarcity import wanted_by

logger = Log("rr_actors")

BLOCKED_S = 5.0
"""A coroutine that blocks the user loop for so long is named in the log, at the latest after twice that time."""

_LOOK_AGAIN_S = 1.0  # a loop that is closed says nothing
_NOT_USERS = ("rr_actors", "asyncio", "uvloop", "threading")  # packages of frames that are no user's

COROUTINE: type[Any] = CoroutineType
"""The type of what a call of an `async def` function returns; the code of each call compares with it directly."""

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
    return type(value) is COROUTINE


def closing(inner: Coroutine[Any, Any, Any], outer: Coroutine[Any, Any, Any]) -> Coroutine[Any, Any, Any]:
    """Return `outer`, which awaits `inner`. If it is closed before it begins, close `inner` too.

    Otherwise Python would warn that the user's coroutine was never awaited.
    """
    weakref.finalize(outer, inner.close).atexit = False
    return outer


def start_loop_thread(
    begin: Callable[[asyncio.AbstractEventLoop], asyncio.Future[None]], name: str
) -> threading.Thread:
    """Start a daemon thread that runs an event loop, and return it when the loop exists.

    Only the future ends the loop. A task that calls sys.exit(), or that stops the loop, interrupts it: it runs on.

    Args:
        begin: called in that thread with the loop; returns the future with which the loop ends.

    Raises:
        Unavailable: the machine gives no thread, or no descriptors, for it.
    """
    ready = threading.Event()
    failures: list[BaseException] = []

    def work() -> None:
        try:
            with asyncio.Runner(loop_factory=new_loop) as runner:
                ending = begin(runner.get_loop())
                ready.set()
                _run(runner.get_loop(), ending, name)
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


def _run(loop: asyncio.AbstractEventLoop, ending: asyncio.Future[None], name: str) -> None:
    while not ending.done() and not loop.is_closed():
        try:
            loop.run_until_complete(ending)
        except BaseException as error:
            logger.error("%s: interrupted by one of its tasks or calls; it runs on", name, exc_info=error)
    loop.set_task_factory(None)  # a user's may raise, and the loop makes tasks while it is closed


class UserLoop:
    """An event loop in a daemon thread, started at once.

    Args:
        elsewhere: calls a function in another thread. Errors of users' tasks are logged there: an exception of a
            user's class may do anything in its __str__.
        on_loop: calls a function on the framework's loop, which notices when this one does not turn.
    """

    def __init__(
        self, elsewhere: Callable[[Callable[[], object]], None], on_loop: Callable[[Callable[[], object]], None]
    ) -> None:
        self._tasks: set[asyncio.Task[None]] = set()
        self._order = threading.Lock()  # what is started before the stop becomes a task, which the stop cancels
        self._stopped = False
        self._elsewhere = elsewhere
        self._on_loop = on_loop
        self._watched = False  # the framework's loop will look at this one
        self._started = False  # a coroutine was started since the last look
        self._turned = True  # this loop has turned since the last look
        self._named = False  # the log has said what blocks it now
        self.thread = start_loop_thread(self._begin, "rr-user-loop")

    def start(self, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context) -> None:
        """Run a coroutine as a task in `context`; `done` is called in the loop's thread."""
        with self._order:
            if self._stopped or self._loop.is_closed():
                raise Unavailable("the user loop is closed: this process is stopping")
            if not self._watched:
                self._on_loop(self._look)
                self._watched = True
            self._started = True
            self._loop.call_soon_threadsafe(self._spawn, coroutine, done, context)

    def stop(self) -> None:
        """Cancel the tasks and end the thread, without waiting for it."""
        with self._order:
            if not self._stopped and not self._loop.is_closed():
                self._stopped = True
                self._loop.call_soon_threadsafe(self._ending.set_result, None)

    def _spawn(self, coroutine: Coroutine[Any, Any, Any], done: Done, context: Context) -> None:
        task = start_task(self._loop, coroutine, done, context)
        self._tasks.add(task)  # the loop itself keeps only weak references
        task.add_done_callback(self._tasks.discard)

    def _look(self) -> None:
        """Log once what blocks this loop, if it has not turned since the last look; look again while it has tasks."""
        with self._order:
            self._watched = not self._stopped and (self._started or bool(self._tasks))
            self._started = False
            if not self._watched:
                return
            if self._turned:
                self._turned = self._named = False
                self._loop.call_soon_threadsafe(self._turn)
            elif not self._named:
                self._named = True
                text = "an `async def` callback blocks all others of this process: %s; await, or use asyncio.to_thread"
                logger.warning(text, _place_in(self.thread))
        asyncio.get_running_loop().call_later(BLOCKED_S, self._look)

    def _turn(self) -> None:
        self._turned = True

    def _begin(self, loop: asyncio.AbstractEventLoop) -> asyncio.Future[None]:
        self._loop = loop
        self._ending = loop.create_future()  # not a task: a user may cancel all tasks of the loop
        loop.set_exception_handler(self._log_elsewhere)
        return self._ending

    def _log_elsewhere(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        try:
            self._elsewhere(functools.partial(log_exception, loop, context))
        except Unavailable:
            logger.error("on the loop: %s", context.get("message"))


def _place_in(thread: threading.Thread) -> str:
    """Return the name and place of the user's function that a thread runs, and the place where it is now."""
    frame = stacks_of_threads().get(thread.ident or 0)
    innermost = users = frame
    while frame is not None:  # outwards
        if frame.f_globals.get("__name__", "").partition(".")[0] not in _NOT_USERS:
            users = frame
        frame = frame.f_back
    if users is None or innermost is None:
        return "it has just ended"
    return _place(users) if users is innermost else f"{_place(users)}, now in {_place(innermost)}"


def _place(frame: FrameType) -> str:
    return f"{frame.f_code.co_qualname} ({frame.f_code.co_filename}:{frame.f_lineno})"


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

    # Not by the loop's task factory, which may be a user's and raise.
    task = asyncio.Task(_outcome(coroutine), loop=loop, context=context)
    # Not inside the task: `done` may make another thread enter `context`, in which the task would still be.
    task.add_done_callback(ended, context=Context())
    return task


async def _outcome(coroutine: Coroutine[Any, Any, Any]) -> tuple[Any, BaseException | None]:
    try:
        return await coroutine, None
    except BaseException as error:  # SystemExit, too: in a task it would end the loop
        return None, error


class CallersLoop:
    """The event loop that runs here, with the caller's context: a coroutine function of the caller's runs there."""

    def __init__(self) -> None:
        self._loop, self._context = asyncio.get_running_loop(), copy_context()

    def bring(self, fn: Callable[..., Coroutine[Any, Any, Any]]) -> Callable[..., Coroutine[Any, Any, Any]]:
        """Return a function for any event loop, which runs `fn` on the caller's, and waits for its end.

        When the caller's event loop is closed, `fn` runs where the function is awaited.
        """

        async def call(*args: Any) -> None:
            here = asyncio.get_running_loop()
            ended: asyncio.Future[BaseException | None] = here.create_future()
            tasks: list[asyncio.Task[Any]] = []  # kept here: the loop has only weak references

            def settle(error: BaseException | None) -> None:
                if not ended.done():
                    ended.set_result(error)

            def done(_result: Any, error: BaseException | None) -> None:
                with contextlib.suppress(RuntimeError):  # the loop that waits is closed
                    here.call_soon_threadsafe(settle, error)

            def begin() -> None:
                tasks.append(start_task(self._loop, fn(*args), done, self._context))

            try:
                self._loop.call_soon_threadsafe(begin)
            except RuntimeError:  # it is closed
                await fn(*args)
                return
            while not ended.done() and not self._loop.is_closed():
                await asyncio.wait((ended,), timeout=_LOOK_AGAIN_S)
            error = ended.result() if ended.done() else None
            if error is not None and not isinstance(error, asyncio.CancelledError):  # else its loop was closed
                raise error

        return call


def name_of(fn: Callable[..., Any]) -> str:
    """Return a callable's name for logs and errors."""
    return getattr(fn, "__qualname__", None) or repr(fn)
