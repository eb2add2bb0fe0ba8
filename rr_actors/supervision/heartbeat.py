"""Heartbeat: whether the loop of a child's process is alive, and the process able to work.

The answer is the loop's own: a user's callback may take as long as it likes, and a process that is stopped, holds
the interpreter or blocks its loop is found out. With it comes what health.py finds there.

A supervisor that itself stood still (SIGSTOP for the whole process group, a suspended machine, a debugger) does not
count that time: the child may have stood still with it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

_LATE = 1 / 20  # of the limit: a look that comes so much too late means that this process stood still


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
        self._due: float
        self._timer: asyncio.TimerHandle
        self._look_in(limit_s / 2)

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

    def _look_in(self, delay_s: float, *, last: bool = False) -> None:
        self._due = self._loop.time() + delay_s
        self._timer = self._loop.call_later(delay_s, self._look, last)

    def _look(self, last: bool) -> None:
        now = self._loop.time()
        late_s = now - self._due
        if self._unanswered_since is None:
            if not last:
                self._number += 1
                self._unanswered_since = now
                self._ping(self._number)
            self._look_in(self._limit_s / 2)
            return
        if late_s > self._limit_s * _LATE:
            self._unanswered_since += late_s
        left_s = self._unanswered_since + self._limit_s - now
        if left_s > 0:
            self._look_in(left_s)
        elif not last:  # the loop may have been busy: an answer that is there is read before the verdict
            self._look_in(self._limit_s * _LATE, last=True)
        else:
            self._hung(now - self._unanswered_since)
