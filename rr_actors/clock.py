"""Clock: where time comes from, and how long may be waited.

Durations are always measured on `monotonic`; `wall` is for people to read.
"""

from __future__ import annotations

import time
from typing import Protocol

from rr_actors.errors import UsageError, exact_number, is_a, shown

_LONGEST_S = 2_000_000  # 23 days


class Clock(Protocol):
    """Two readings of time; a manual one for tests is in rr_actors.testing."""

    def monotonic(self) -> float:
        """Seconds that never go backwards."""
        ...

    def wall(self) -> float:
        """Seconds since the epoch; may jump."""
        ...


class SystemClock:
    """The machine's own clocks."""

    def monotonic(self) -> float:
        """Seconds that never go backwards."""
        return time.monotonic()

    def wall(self) -> float:
        """Seconds since the epoch; may jump."""
        return time.time()


def time_limit(timeout_s: float | None, name: str = "timeout_s") -> float | None:
    """The seconds, or None for no limit, which more than clocks and sockets can count comes to.

    Args:
        name: what the caller's parameter is called.

    Raises:
        UsageError: it is no such number.
    """
    if timeout_s is None:
        return None
    number = timeout_s
    if type(timeout_s) is not float:
        number = exact_number(timeout_s) if is_a(timeout_s, (int, float)) and not is_a(timeout_s, bool) else -1.0
    if not number >= 0:  # NaN is not
        raise UsageError(f"{name}: expected seconds, 0 or more, or None for no limit, got {shown(timeout_s)}")
    return number if number < _LONGEST_S else None


def left_of(limit_s: float | None, began: float) -> float | None:
    """What is left now of a time limit that began to run at `began`, as time.monotonic() said then."""
    return None if limit_s is None else max(0.0, limit_s - (time.monotonic() - began))
