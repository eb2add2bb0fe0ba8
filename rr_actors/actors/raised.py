"""Raised: what a user's callback raised, described by the thread that ran it.

An exception of a user's class may do anything in its __str__, even wait for ever. So its text and its trace are made
where the callback ran, and what reaches the loop is text.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Coroutine
from typing import Any

from rr_actors.actors.user_loop import is_coroutine
from rr_actors.actors.workers import is_async
from rr_actors.errors import UsageError, name_of_class, text_of
from rr_actors.messages import readable


class Raised(Exception):
    """A callback raised.

    Attributes:
        error: the exception itself. Not to be looked at on the loop.
        text: the exception, as "ValueError: no such device".
        trace: where it was raised, as Python prints it.
        details: what `describe` has made of it.
    """

    def __init__(self, error: BaseException, describe: Callable[[BaseException], Any]) -> None:
        self.text = readable(text_of(error))
        super().__init__(self.text)
        self.error = error
        self.trace = _trace_of(error)
        self.details = describe(error)


def described(
    fn: Callable[..., Any], what: str, describe: Callable[[BaseException], Any] = lambda _error: None
) -> Callable[..., Any]:
    """Return a function of our own that calls a user's callable, and raises Raised for whatever that raises.

    The callable is examined here, in the thread of whoever hands it over, and never again.

    Args:
        what: what the callable is, for the error.
        describe: makes of the exception what is needed of it, in the thread that ran the callable.

    Raises:
        UsageError: it cannot be examined: its attributes raise.
    """
    try:
        awaits = is_async(fn)
    except Exception as error:
        text = f"{what}: expected a callable, got one of {name_of_class(type(fn))} whose attributes cannot be read"
        raise UsageError(f"{text}: {text_of(error)}") from None

    async def after(coroutine: Coroutine[Any, Any, Any]) -> Any:
        try:
            return await coroutine
        except BaseException as error:  # whatever it is, it is the callback's
            raise Raised(error, describe) from None

    async def run_async(*args: Any) -> Any:
        try:
            return await fn(*args)
        except BaseException as error:
            raise Raised(error, describe) from None

    def run(*args: Any) -> Any:
        try:
            answer = fn(*args)
        except BaseException as error:
            raise Raised(error, describe) from None
        return after(answer) if is_coroutine(answer) else answer  # of a wrapper round an async function

    return run_async if awaits else run


def log_raised(logger: logging.Logger, error: BaseException, message: str, *args: object) -> None:
    """Log an error of a callback, or one of our own why it did not run."""
    if type(error) is not Raised:
        logger.error(message, *args, exc_info=error)
    elif logger.isEnabledFor(logging.ERROR):
        raised = error.error
        found = (type(raised), raised, raised.__traceback__)
        record = logger.makeRecord(logger.name, logging.ERROR, __file__, 0, message, args, found)
        record.exc_text = error.trace  # so that no handler has to make it
        logger.handle(record)


def _trace_of(error: BaseException) -> str:
    try:
        return "".join(traceback.format_exception(error)).rstrip()
    except BaseException as reason:  # its own __str__, __cause__ ...
        return f"(its trace is not known: {name_of_class(type(reason))} was raised while it was made)"
