"""Traces: the traceback of any exception as text. It is made without fail, and has an end."""

from __future__ import annotations

import sys
import traceback
from types import FrameType, TracebackType

from rr_actors.base.errors import Described, is_a, name_of_class, readable, text_of

_LONGEST = 50_000  # characters
_FRAMES = 100

_traceback: property = BaseException.__dict__["__traceback__"]


def traceback_of(error: BaseException) -> TracebackType | None:
    """Return the traceback of an exception, without asking its class."""
    return _traceback.__get__(error)


def trace_of(error: BaseException, since: TracebackType | None = None) -> str:
    """Return the exception's traceback as Python prints it, from `since` on; of a very long one beginning and end.

    If Python cannot print it, because a method of its class raises, say, return its frames and its text.
    """
    if is_a(error, Described):
        return error.trace
    found = since or traceback_of(error)
    try:
        text = "".join(traceback.format_exception(type(error), error, found))
    except BaseException as reason:
        text = f"{_frames_of(found)}{text_of(error)}\n(its trace raised {name_of_class(type(reason))})"
    text = text.rstrip()
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]}\n... ({len(text) - _LONGEST} characters) ...\n{text[-_LONGEST // 2 :]}"
    return readable(text, _LONGEST + 100)


def _frames_of(found: TracebackType | None) -> str:
    try:
        return "Traceback (most recent call last):\n" + "".join(traceback.format_tb(found, -_FRAMES))
    except BaseException:  # from a module's own loader of its lines
        return ""


def add_note(error: BaseException, note: str) -> None:
    """Add a note to an exception, if its own notes are a list and its class allows it."""
    try:
        BaseException.add_note(error, note)
    except BaseException:
        return  # what the note says is in the log of the process where it was raised


def stacks_of_threads() -> dict[int, FrameType]:
    """Return the innermost frame of each thread of this process, by the thread's ident."""
    return sys._current_frames()  # pyright: ignore[reportPrivateUsage]  # documented
