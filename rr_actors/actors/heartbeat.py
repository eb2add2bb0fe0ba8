"""Heartbeat: whether the loop of a child's process is alive, and the process able to work.

The answer is the loop's own: a user's callback may take as long as it likes, and a process that is stopped, holds
the interpreter or blocks its loop is found out. With it comes what health.py finds there.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable


class Heartbeat:
    """Asks twice in `limit_s` whether the child's loop is alive, from now on.

    Args:
        ping: sends the question of that number.
        hung: called once there was no answer for `limit_s`, with the seconds since.
        ill: called with the trouble that two answers in a row told of: what passes by itself is no reason.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        limit_s: float,
        ping: Callable[[int], None],
        hung: Callable[[float], None],
        ill: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._limit_s = limit_s
        self._ping = ping
        self._hung = hung
        self._ill = ill
        self._was_ill = False
        self._number = 0
        self._unanswered_since: float | None = None
        self._timer = loop.call_later(limit_s / 2, self._beat)

    def heard(self, number: int, trouble: str = "") -> None:
        """The answer to ping `number` has come, with the trouble that the process is in."""
        if number != self._number:
            return
        self._unanswered_since = None
        if trouble and self._was_ill:
            self._ill(trouble)
        self._was_ill = bool(trouble)

    def stop(self) -> None:
        """Ask no more."""
        self._timer.cancel()

    def _beat(self) -> None:
        now = time.monotonic()
        if self._unanswered_since is None:
            self._number += 1
            self._unanswered_since = now
            self._ping(self._number)
            self._timer = self._loop.call_later(self._limit_s / 2, self._beat)
        elif now - self._unanswered_since < self._limit_s:
            self._timer = self._loop.call_later(self._unanswered_since + self._limit_s - now, self._beat)
        else:  # if it was this loop that was held up, the answer is read before the verdict
            self._timer = self._loop.call_later(self._limit_s / 20, self._judge)

    def _judge(self) -> None:
        if self._unanswered_since is None:
            self._timer = self._loop.call_later(self._limit_s / 2, self._beat)
        else:
            self._hung(time.monotonic() - self._unanswered_since)
