"""How actors begin and end, as others hear of it: what on_start may return, and the report of an exit."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

Reason = Literal["normal", "shutdown", "abnormal", "killed"]


class Ignore(enum.Enum):
    """What on_start returns to say: do not start me, and do not mind (OTP: ignore)."""

    IGNORE = "ignore"


IGNORE: Final = Ignore.IGNORE


@dataclass(frozen=True)
class ExitReport:
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


OnExit = Callable[[ExitReport], None]
