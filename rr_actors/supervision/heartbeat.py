"""Heartbeat: checks that the loop of a child's process is alive, and that the process can work.

The loop itself answers, so a user's callback may take any time. A process that is stopped, holds the interpreter or
blocks its loop does not answer. The answer has the trouble that health.py finds in that process.

A supervisor that itself stood still (SIGSTOP for the whole process group, a suspended machine, a debugger) does not
count that time: the child may have stood still with it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rr_actors.runtime.time_limits import wait_while_running

_LAST_LOOK = 1 / 20  # of the limit: how much longer to wait for an answer that has arrived unread


class Heartbeat:
    """Asks twice in each `limit_s`, from now on, whether the child's loop is alive. On the loop.

    Args:
        ping: sends the question.
        hung: called if there was no answer for `limit_s`. That ends the heartbeat.
        ill: called with the trouble if two answers in a row had one: it may pass by itself after the first. That
            ends the heartbeat.
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
        """Note the answer, with the trouble of the process."""
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
