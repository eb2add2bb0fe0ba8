"""Heartbeat: whether the loop of a child's process is alive, and the process able to work.

The answer is the loop's own: a user's callback may take as long as it likes, and a process that is stopped, holds
the interpreter or blocks its loop is found out. With it comes what health.py finds there.

A supervisor that itself stood still (SIGSTOP for the whole process group, a suspended machine, a debugger) does not
count that time: the child may have stood still with it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rr_actors.runtime.time_limits import wait_while_running

_LAST_LOOK = 1 / 20  # of the limit: how much longer an answer is waited for that has come and is not read yet


class Heartbeat:
    """Asks twice in `limit_s` whether the child's loop is alive, from now on. On the loop.

    Args:
        ping: sends the question.
        hung: called once there was no answer for `limit_s`; then no more is asked.
        ill: called with the trouble that two answers in a row told of: what passes by itself is no reason. Then no more
            is asked.
    """

    def __init__(
        self, limit_s: float, ping: Callable[[], None], hung: Callable[[], None], ill: Callable[[str], None]
    ) -> None:
        self._limit_s = limit_s
        self._ping = ping
        self._hung = hung
        self._ill = ill
        self._answer: asyncio.Future[str] | None = None
        self._asking = asyncio.get_running_loop().create_task(self._ask())

    def heard(self, trouble: str) -> None:
        """The answer has come, with the trouble that the process is in."""
        if self._answer is not None and not self._answer.done():
            self._answer.set_result(trouble)

    def stop(self) -> None:
        """Ask no more."""
        self._asking.cancel()

    async def _ask(self) -> None:
        was_ill = False
        while True:
            await asyncio.sleep(self._limit_s / 2)
            answer = self._answer = asyncio.get_running_loop().create_future()
            self._ping()
            await wait_while_running(answer, self._limit_s)
            if not answer.done():  # uvloop runs timers before it reads: an answer may be there, unread
                await asyncio.sleep(self._limit_s * _LAST_LOOK)
            if not answer.done():
                self._hung()
                return
            trouble = answer.result()
            if trouble and was_ill:
                self._ill(trouble)
                return
            was_ill = bool(trouble)
