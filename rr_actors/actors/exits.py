"""How actors begin and end, as others hear of it: what on_start may return, and the report of an exit."""

from __future__ import annotations

import enum
import traceback
from collections.abc import Callable
from typing import Any, Final, Literal

import msgspec

from rr_actors.errors import text_of

Reason = Literal["normal", "shutdown", "abnormal", "killed"]


class Ignore(enum.Enum):
    """What on_start returns to say: do not start me, and do not mind (OTP: ignore)."""

    IGNORE = "ignore"


IGNORE: Final = Ignore.IGNORE


class ExitReport(msgspec.Struct, frozen=True):
    """How an actor ended.

    Attributes:
        reason: "normal" (stopped itself), "shutdown" (by its supervisor), "abnormal" (an exception), "killed".
        detail: one line for people.
        exception: what ended it, if it was an exception.
        traceback: where it was raised, as text.
    """

    reason: Reason
    detail: str = ""
    exception: BaseException | None = None
    traceback: str = ""


class Down(msgspec.Struct, frozen=True):
    """The message that an actor which was monitored has ended.

    Attributes:
        ref: the reference that was monitored.
        reason: as in ExitReport; or "noproc": it was dead, or being started again, when the monitor was set;
            "noconnection": its process lives, but the way to it is lost, so nobody can tell.
        detail: one line for people.
        monitor: the number of the Monitor.
    """

    ref: Any  # a pykka.ActorRef
    reason: Literal["normal", "shutdown", "abnormal", "killed", "noproc", "noconnection"]
    detail: str = ""
    monitor: int = 0

    def __str__(self) -> str:
        return f"{self.ref} is down: {self.reason}{f' ({self.detail})' if self.detail else ''}"


def abnormal(error: BaseException) -> ExitReport:
    """The report of an actor that an exception has ended."""
    text = "".join(traceback.format_exception(error))
    return ExitReport("abnormal", text_of(error), error, text)


OnExit = Callable[[ExitReport], None]
