"""Retries: how long what has failed again and again is left alone, and when it is given up. With a clock and a lock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from rr_actors.managers.planning.setbacks import BACKOFF, Setbacks

K = TypeVar("K")

TRIES = 10
"""How often in a row something may fail before it is given up. What runs well for a while begins anew."""
GIVEN_UP = f"it has failed {TRIES} times in a row or more"
SOON_S = 0.1
"""A wait that is no longer is nothing to tell the holders."""
_FORGOTTEN_S = 600.0


class Retries(Generic[K]):
    """The setbacks of what a manager replaces in its status callbacks. From any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._setbacks = Setbacks[K]()
        self._used_since: dict[K, float] = {}
        self._is_stopped = threading.Event()

    def stop(self) -> None:
        """End all waits, and those that come."""
        self._is_stopped.set()

    def pause(self, wait_s: float) -> bool:
        """Wait for so long, or until stop(). Return whether it goes on after that."""
        return not self._is_stopped.wait(wait_s)

    def used(self, key: K) -> None:
        """Note that it is used from now on."""
        with self._lock:
            self._used_since[key] = time.monotonic()

    def failed(self, key: K, failure_id: str = "") -> None:
        """Note that it has failed by a fault of its own. The same failure counts once."""
        with self._lock:
            now = time.monotonic()
            ran_s = now - self._used_since.pop(key, now)
            self._setbacks.note(key, now, ran_s=ran_s, failure_id=failure_id)
            self._setbacks.keep_only({one for one in self._setbacks if not self._is_over(one, now, _FORGOTTEN_S)})

    def wait_s(self, key: K) -> float | None:
        """Return how long it is to be left alone, also if nothing else is left; None: it is given up."""
        with self._lock:
            now, setback = time.monotonic(), self._setbacks.get(key)
            if setback is None or self._is_over(key, now, BACKOFF.maximum_s):
                return 0.0
            return None if setback.count >= TRIES else max(0.0, setback.retry_at - now)

    def is_ready(self, key: K) -> bool:
        """Return whether it may be tried without a wait of which the holders would hear."""
        wait_s = self.wait_s(key)
        return wait_s is not None and wait_s <= SOON_S

    def rest(self, key: K, what: str, say: Callable[[str], object]) -> float | None:
        """Wait until it may be tried again, or stop(). Return for how many seconds; None: it is given up.

        `say` tells the holders before a wait that is not short; `what` names it for them.
        """
        wait_s = self.wait_s(key)
        if wait_s is not None:
            if wait_s > SOON_S:
                say(f"{what} is tried again in {wait_s:.1f} s, as it has failed repeatedly")
            self.pause(wait_s)
        return wait_s

    def _is_over(self, key: K, now: float, after_s: float) -> bool:
        return now >= self._setbacks[key].retry_at + after_s
