"""The beginning and the end of an actor, as it is reported to others."""

from __future__ import annotations

import enum
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, Final, Literal, TypeVar

import msgspec

from rr_actors.base.errors import StartFailed, text_of
from rr_actors.runtime.callback_errors import Raised

Reason = Literal["normal", "shutdown", "abnormal", "killed"]


class Ignore(enum.Enum):
    """The result of on_start that means: do not start this actor, and do not treat that as an error (OTP: ignore)."""

    IGNORE = "ignore"


IGNORE: Final = Ignore.IGNORE


class ExitReport(msgspec.Struct, frozen=True):
    """How an actor ended.

    Attributes:
        reason: "normal" (stopped itself), "shutdown" (by its supervisor), "abnormal" (an exception), "killed".
        detail: one line that a person can read.
        exception: the exception that ended it, or None.
        traceback: the exception's traceback, as text.
    """

    reason: Reason
    detail: str = ""
    exception: BaseException | None = None
    traceback: str = ""


class Down(msgspec.Struct, frozen=True):
    """The message that a monitored actor has ended.

    Attributes:
        ref: the reference that was monitored.
        reason: as in ExitReport. Or "noproc": the actor was dead, or being restarted, when the monitor was set. Or
            "noconnection": its process lives, but the connection to it is lost.
        detail: one line that a person can read.
        monitor: the number of the Monitor.
    """

    ref: Any  # a pykka.ActorRef
    reason: Literal["normal", "shutdown", "abnormal", "killed", "noproc", "noconnection"]
    detail: str = ""
    monitor: int = 0

    def __str__(self) -> str:
        return f"{self.ref} is down: {self.reason}{f' ({self.detail})' if self.detail else ''}"


def abnormal(raised: Raised) -> ExitReport:
    """Return the report of an actor that an exception has ended."""
    return ExitReport("abnormal", raised.text, raised.error, raised.trace)


OnExit = Callable[[ExitReport], None]


# Birth: the values of an actor's creator that do not go by its __init__, and the creator's error if it fails.

A = TypeVar("A")


class Birth(msgspec.Struct, frozen=True):
    """The values that launch() gives to the actor; none by default, as in an ordinary call of its class."""

    path: str | None = None
    place: Any = None
    on_exit: OnExit | None = None

    def of(self, cls: Callable[..., A], args: tuple[Any, ...], kwargs: dict[str, Any]) -> A:
        """Make the actor cls(*args, **kwargs). Call this in a new context, which is not used again.

        A metaclass may have a `__call__`, so the class itself is called, and the Birth goes by the context.
        """
        _given.set(self)
        return cls(*args, **kwargs)


_ORDINARY = Birth()
_given: ContextVar[Birth] = ContextVar("rr_actors_birth", default=_ORDINARY)


def take() -> Birth:
    """Return the Birth of the actor that is being made now, for its __new__; a second call returns an empty one."""
    birth = _given.get()
    if birth is not _ORDINARY:
        _given.set(_ORDINARY)  # not for an actor that this one's __init__ starts
    return birth


def as_heard(failure: BaseException, name: str) -> Exception:
    """Return the error for the creator of the actor `name`, from the one that on_start raised."""
    if isinstance(failure, Exception):
        return failure
    # SystemExit ends this actor, not its creator.
    heard = StartFailed(f"{name}: on_start raised {text_of(failure)}", id=name)
    heard.__cause__ = failure
    return heard
