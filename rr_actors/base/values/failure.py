"""Failure: an error as it is sent to another process, and the error that is made of it there."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, cast

import msgspec

from rr_actors.base import errors
from rr_actors.base.errors import readable


class Failure(msgspec.Struct, frozen=True, array_like=True):
    """An error as it is sent: the name of its class in errors.py, its text and attributes, and the frames it passed."""

    kind: str
    message: str
    details: dict[str, Any] = {}
    trace: list[tuple[str, str]] = []


_LONGEST_TRACE = 30_000
_NO_DETAILS = ("self", "details", "trace")  # an error with such details could not be pickled or sent on


def failure_of(error: BaseException, origin: str | None = None) -> Failure:
    """Describe `error` for the wire. With `origin` ("registrar/server") a frame is added to its trace.

    The frames of its cause or context come first, as these errors have come the same way. An error of a user's class
    may be unusual: its `trace` or `details` may be of another kind, say. Then only its text is used. Of a very long
    trace only the first frames are kept, as the message could be too long for a frame of the wire.
    """
    text = readable(errors.text_of(error))
    frames = [] if origin is None else [(origin, text)]
    try:
        trace = [] if origin is None else _trace_of(error)
        if not isinstance(error, errors.RrError):
            return Failure("RrError", text, {}, _first_of(trace + frames))
        trace = trace or _own_trace(error)
        details = {k: _readable(v) for k, v in error.details.items() if k != "trace" and _is_plain(v)}
        return Failure(type(error).__name__, readable(error.message), details, _first_of(trace + frames))
    except Exception:
        return Failure("RrError", text, {}, frames)


def _first_of(frames: list[tuple[str, str]]) -> list[tuple[str, str]]:
    lengths = itertools.accumulate(len(origin) + len(text) for origin, text in frames)
    return [frame for frame, length in zip(frames, lengths, strict=True) if length <= _LONGEST_TRACE]


def _own_trace(error: BaseException) -> list[tuple[str, str]]:
    return [(f.origin, f.message) for f in getattr(error, "trace", ())] if isinstance(error, errors.RrError) else []


def _trace_of(error: BaseException) -> list[tuple[str, str]]:
    """Return the frames of an error, or of the nearest one behind it, in the order in which Python shows them."""
    left: list[BaseException | None] = [error]
    seen: set[int] = set()
    while left:
        error_now = left.pop()
        if error_now is None or id(error_now) in seen:
            continue
        seen.add(id(error_now))
        if trace := _own_trace(error_now):
            return trace
        left.append(None if error_now.__suppress_context__ else error_now.__context__)
        left.append(error_now.__cause__)
        if isinstance(error_now, BaseExceptionGroup):  # from an asyncio.TaskGroup, say
            left.extend(reversed(cast("BaseExceptionGroup[BaseException]", error_now).exceptions))
    return []


def error_of(failure: Failure) -> errors.RrError:
    """Return the error that a Failure describes; one of a class that this version does not know becomes RrError."""
    cls = getattr(errors, failure.kind, errors.RrError)
    if not (isinstance(cls, type) and issubclass(cls, errors.RrError)):
        cls = errors.RrError
    details: dict[str, Any] = {}
    for key, value in failure.details.items():
        if key.isidentifier() and key not in _NO_DETAILS and not hasattr(errors.RrError, key):  # a peer's
            details[key] = tuple(cast("Sequence[object]", value)) if isinstance(value, list) else value
    if failure.trace or issubclass(cls, (errors.LoadFailed, errors.UnloadFailed)):
        details["trace"] = tuple(errors.Frame(origin, message) for origin, message in failure.trace)
    error = cls(failure.message, **details)
    if lines := details.get("traceback"):
        place = failure.trace[0][0] if failure.trace else details.get("actor", "a callback")
        error.add_note(f"raised in {place}:\n{lines}")
    return error


def _readable(value: object) -> object:
    if isinstance(value, (list, tuple)):
        return [_readable(item) for item in cast("Sequence[object]", value)]
    return readable(value) if isinstance(value, str) else value


def _is_plain(value: object) -> bool:
    if isinstance(value, (list, tuple)):
        return all(_is_plain(item) for item in cast("Sequence[object]", value))
    return value is None or isinstance(value, (str, int, float, bool))
