"""How long load callbacks of a registrar wait for the loads of their parts."""

from __future__ import annotations

import threading
import time


class PartTimes:
    """How long callbacks of one registrar wait for loads of parts, several of which may go on at once. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # of a whole: how many loads of its parts go on, since when, and the seconds before it; mostly empty
        self.waits: dict[str, tuple[int, float, float]] = {}

    def began(self, whole: str) -> None:
        """Note that a load for this resource has begun."""
        with self._lock:
            count, since, before_s = self.waits.get(whole, (0, 0.0, 0.0))
            self.waits[whole] = count + 1, since if count else time.monotonic(), before_s

    def ended(self, whole: str) -> None:
        """Note that a load for this resource has ended. One that take() has counted already is none."""
        with self._lock:
            if (waits := self.waits.get(whole)) is None or not waits[0]:
                return
            count, since, before_s = waits
            spent_s = time.monotonic() - since if count == 1 else 0.0
            self.waits[whole] = count - 1, since, before_s + spent_s

    def take(self, whole: str) -> float:
        """Return for how many seconds at least one load for this resource went on, and forget it."""
        with self._lock:
            count, since, before_s = self.waits.pop(whole, (0, 0.0, 0.0))
        return before_s + (time.monotonic() - since if count else 0.0)
