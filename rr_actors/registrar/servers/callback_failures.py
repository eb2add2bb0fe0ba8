"""What is said of a callback that has raised: its text, and the failure that consumers hear."""

from __future__ import annotations

from typing import cast

from rr_actors.base.errors import CircularDependency, GraphError, LoadFailed, OverCapacity, readable, text_of
from rr_actors.base.values.failure import Failure, failure_of
from rr_actors.runtime.callback_errors import Raised, traceback_of


def said(error: BaseException) -> str:
    """Return the text of an error; that of a callback's is made already."""
    return error.text if type(error) is Raised else text_of(error)


def load_failure(error: BaseException, origin: str) -> Failure:
    """Return the failure that consumers hear if a load callback raises; a group of one error is that error."""
    if type(error) is Raised:
        return error.details[0]
    error = _alone(error)
    described = failure_of(error, origin)
    if isinstance(error, (CircularDependency, GraphError, OverCapacity)):
        return described
    if isinstance(error, LoadFailed):
        text, lines = described.message, error.traceback
    else:
        text, lines = text_of(error), traceback_of(error)
    details = {"server": origin, "traceback": lines}
    return Failure("LoadFailed", readable(f"{origin}: {text}"), details, described.trace)


def _alone(error: BaseException) -> BaseException:
    """Return the only error of a group of errors, however deep; else return the error as it is."""
    if not isinstance(error, BaseExceptionGroup):
        return error
    group = cast("BaseExceptionGroup[BaseException]", error)
    return _alone(group.exceptions[0]) if len(group.exceptions) == 1 else group
