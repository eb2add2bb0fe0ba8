"""Traces: the traceback of any exception as text, and the stacks of all threads.

They are made without fail, and have an end.
"""

from __future__ import annotations

import linecache
import os
import sys
import threading
import traceback
from types import FrameType, TracebackType
from typing import cast

import msgspec

from rr_actors.base.errors import DescribedError, is_a, name_of_class, readable, text_of

_LONGEST = 50_000  # characters
_FRAMES = 100  # of a traceback or of a thread
_ALL_STACKS = 1_000_000  # characters of the stacks of all threads
_LONGEST_LINE = 300

_traceback: property = BaseException.__dict__["__traceback__"]


def traceback_of(error: BaseException) -> TracebackType | None:
    """Return the traceback of an exception, without asking its class."""
    return _traceback.__get__(error)


def trace_of(error: BaseException, since: TracebackType | None = None) -> str:
    """Return the exception's traceback as Python prints it, from `since` on; of a very long one beginning and end.

    If Python cannot print it, because a method of its class raises, say, return its frames and its text.
    """
    if is_a(error, DescribedError):
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


_RAISED_BY = "raised by "


def note_raised(error: BaseException, origin: str, trace: str) -> None:
    """Note where an exception was raised, and how, that has come from another process."""
    add_note(error, f"{_RAISED_BY}{origin}:\n{trace.rstrip()}")


def raised_elsewhere(error: BaseException) -> str:
    """Return the trace that note_raised() has noted last; "" if the exception is of this process."""
    notes: object = getattr(error, "__notes__", None)
    for note in reversed(cast("list[object]", notes)) if is_a(notes, list) else ():
        if is_a(note, str) and note.startswith(_RAISED_BY):
            return note.partition("\n")[2]
    return ""


def stacks_of_threads() -> dict[int, FrameType]:
    """Return the innermost frame of each thread of this process, by the thread's ident."""
    return sys._current_frames()  # pyright: ignore[reportPrivateUsage]  # documented


class ThreadStack(msgspec.Struct, frozen=True):
    """The stack of one thread: its frames, the innermost one last, each with its line of source if that is known."""

    thread: str
    frames: list[str]


class ProcessStacks(msgspec.Struct, frozen=True):
    """The stacks of the threads of a process. `left_out`: of how many threads there was no room."""

    pid: int
    threads: list[ThreadStack]
    left_out: int = 0


def stacks_here() -> ProcessStacks:
    """Return the stacks of this process's threads. It runs no code of users."""
    frames = stacks_of_threads()
    names = {thread.ident: thread.name for thread in threading.enumerate()}
    found: list[ThreadStack] = []
    size = 0
    for ident, frame in sorted(frames.items(), key=lambda item: item[0] not in names):
        lines = _lines_of(frame)
        size += sum(map(len, lines))
        if size > _ALL_STACKS:
            break
        found.append(ThreadStack(readable(names.get(ident, f"thread {ident}"), _LONGEST_LINE), lines))
    return ProcessStacks(os.getpid(), found, len(frames) - len(found))


def _lines_of(innermost: FrameType) -> list[str]:
    lines: list[str] = []
    frame: FrameType | None = innermost
    while frame is not None and len(lines) < _FRAMES:
        code, number = frame.f_code, frame.f_lineno
        source = _source_of(code.co_filename, number)
        place = f'File "{code.co_filename}", line {number}, in {code.co_qualname}'
        lines.append(readable(place + source, 2 * _LONGEST_LINE))
        frame = frame.f_back
    if frame is not None:
        lines.append("... further frames above are left out")
    return lines[::-1]


def _source_of(file: str, number: int | None) -> str:
    """Return a line of a file, without its module: that may have a loader of its own, which is a user's code."""
    try:
        line = linecache.getline(file, number or 0).strip()
    except Exception as error:
        line = f"({name_of_class(type(error))}: {text_of(error)})"
    return f"\n{line[:_LONGEST_LINE]}" if line else ""
