"""Raised: the error of a user's callback, described by the thread that ran the callback.

An exception of a user's class may do anything in its __str__, even wait for ever. So the callback's thread makes its
text and its trace, and only text reaches the loop. For a coroutine a worker thread makes them, within a time limit: on
the user loop they would hold up all other coroutines.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from rr_actors.base.errors import DescribedError, Unavailable, UsageError, name_of_class, text_of
from rr_actors.base.reporting import tracebacks
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import trace_of
from rr_actors.runtime import event_loop
from rr_actors.runtime.user_loop import COROUTINE, closing
from rr_actors.runtime.workers import is_async

_PACKAGE = f"{Path(__file__).parents[1]}{os.sep}"
_LONGEST_TRACEBACK = 8_000  # characters
TEXT_LIMIT_S = 5.0
"""The longest wait for the text of a coroutine's exception."""


def _nothing_more(_error: BaseException) -> None:
    return None


class Raised(DescribedError):
    """A callback raised.

    Attributes:
        details: the result of `describe`.
    """

    def __init__(self, error: BaseException, describe: Callable[[BaseException], Any] = _nothing_more) -> None:
        super().__init__(error, text_of(error), trace_of(error))
        self.details = describe(error)


def described(
    fn: Callable[..., Any], what: str, describe: Callable[[BaseException], Any] = _nothing_more
) -> Callable[..., Any]:
    """Return a function that calls a user's callable, and raises Raised for each error of it.

    The callable is examined here, in the caller's thread, and never again.

    Args:
        what: the callable's name for the error.
        describe: returns the details of the exception, in the thread that ran the callable.

    Raises:
        UsageError: the callable cannot be examined, because its attributes raise.
    """
    try:
        awaits = is_async(fn)
    except Exception as error:
        text = f"{what}: expected a callable, got one of {name_of_class(type(fn))} whose attributes cannot be read"
        raise UsageError(f"{text}: {text_of(error)}") from None

    async def run_async(*args: Any, begin: Callable[..., Any] = fn) -> Any:
        try:
            return await begin(*args)
        except BaseException as error:  # of any class: it is the callback's error
            raised = await described_error(error, describe)
        raise raised from None

    def run(*args: Any) -> Any:
        try:
            answer = fn(*args)
        except BaseException as error:
            raise Raised(error, describe) from None
        if type(answer) is COROUTINE:  # `fn` is a wrapper of an async function
            return closing(answer, run_async(begin=lambda: answer))
        return answer

    return run_async if awaits else run


async def described_error(error: BaseException, describe: Callable[[BaseException], Any] = _nothing_more) -> Raised:
    """Describe an exception in a worker, for a coroutine; by its class alone if its text hangs."""
    coming = _described_elsewhere(error, describe)
    await asyncio.wait((asyncio.wrap_future(coming),), timeout=TEXT_LIMIT_S)
    return coming.result() if coming.done() else Raised(_unspoken(error), describe)


def raised_by(error: BaseException) -> Raised:
    """Describe an exception within a time limit; by its class alone if its text hangs.

    On a loop, which must not wait, it is described at once: exceptions there are of this package's own classes.
    """
    process = event_loop.current()
    if process is None or not process.may_block():
        return Raised(error)
    try:
        return _described_elsewhere(error, _nothing_more).result(TEXT_LIMIT_S)
    except TimeoutError:
        return Raised(_unspoken(error))


def _described_elsewhere(error: BaseException, describe: Callable[[BaseException], Any]) -> Future[Raised]:
    """Let a worker describe the error, and return a future for the result; describe it here if no worker is left."""
    coming: Future[Raised] = Future()

    def work() -> None:
        coming.set_result(Raised(error, describe))

    with contextlib.suppress(Unavailable):
        if (process := event_loop.current()) is not None:
            process.workers.in_thread(work, beyond_limit=True)
            return coming
    work()
    return coming


def _unspoken(error: BaseException) -> TimeoutError:
    cls = name_of_class(type(error))
    return TimeoutError(f"{cls} was raised; its str() had not returned after {TEXT_LIMIT_S:g} s")


def log_raised(logger: Log, error: BaseException, message: str, *args: object) -> None:
    """Log the error of a callback, or this package's error about why the callback did not run."""
    if type(error) is Raised:
        logger.error(message, *args, exc_info=error.error, trace=error.trace)
    else:
        logger.error(message, *args, exc_info=error)


def traceback_of(error: BaseException) -> str:
    """Return the traceback of a callback's exception from the callback's first line on; "" if none of its lines raised.

    Of a long one the end is kept, which says most.
    """
    found = tracebacks.traceback_of(error)
    while found is not None and found.tb_frame.f_code.co_filename.startswith(_PACKAGE):
        found = found.tb_next
    return "" if found is None else trace_of(error, found)[-_LONGEST_TRACEBACK:]
