"""Clock: where time comes from. Durations are always measured on `monotonic`; `wall` is for people to read."""

from __future__ import annotations

import time
from typing import Protocol


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
