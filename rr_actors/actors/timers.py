"""Timers: a message to an actor after some time, which can be cancelled (OTP: send_after, cancel_timer)."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import pykka
from pykka import ActorDeadError

from rr_actors.actors.messaging.message_notes import notes
from rr_actors.actors.refs import ref_in
from rr_actors.base.errors import RrError, Unavailable, UsageError, shown
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.event_loop import acquire, release
from rr_actors.runtime.time_limits import finite_time

logger = Log("rr_actors")


class Timer:
    """A message that an actor gets later. send_after() makes it."""

    def __init__(self, delay_s: float, ref: pykka.ActorRef[Any], message: Any) -> None:
        self._ref = ref
        self._message = message
        self._owner = notes.sender()
        self._due = time.monotonic() + delay_s
        self._lock = threading.Lock()
        self._over = False
        self._dispatcher = acquire()  # released when the timer is over
        self._handle: Any = None
        self._dispatcher.call(self._begin)

    @property
    def left_s(self) -> float | None:
        """The seconds until the message is sent; None if it was sent, or the timer was cancelled."""
        return None if self._over else max(0.0, self._due - time.monotonic())

    def cancel(self) -> float | None:
        """Cancel the timer, so that the message is not sent. Call it from any thread.

        Returns:
            The seconds that were left; None if the message was sent, or the timer was cancelled before.
        """
        left_s = self.left_s
        if not self._end():
            return None
        with contextlib.suppress(Unavailable):  # the loop has ended
            self._dispatcher.call(self._forget)
        return left_s

    def _begin(self) -> None:
        self._handle = self._dispatcher.loop.call_later(max(0.0, self._due - time.monotonic()), self._fire)

    def _forget(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
        release()

    def _fire(self) -> None:
        if not self._end():
            return
        try:
            self._dispatcher.workers.in_thread(self._send, beyond_limit=True)  # pickling runs users' code
        except Unavailable as error:
            logger.warning("the message of a timer was not sent to %s: %s", self._ref, error)
            release()

    def _send(self) -> None:
        try:
            with notes.as_timer(self._owner):
                self._ref.tell(self._message)
        except (ActorDeadError, RrError) as error:
            logger.warning("the message of a timer was not sent to %s: %s", self._ref, error)
        finally:
            with contextlib.suppress(Unavailable):  # the loop has ended
                self._dispatcher.call(release)  # on the loop: a worker would wait for itself

    def _end(self) -> bool:
        with self._lock:
            ended, self._over = self._over, True
        return not ended

    def __repr__(self) -> str:
        left_s = self.left_s
        return f"<Timer for {self._ref}: {'over' if left_s is None else f'in {left_s:.3g} s'}>"


def send_after(delay_s: float, ref: Any, message: Any) -> Timer:
    """Send a message to an actor after `delay_s` seconds. The timer is lost with the calling process.

    If the actor has ended by then, the message is logged and dropped.

    Args:
        ref: a reference or a proxy, to an actor in any process of the system.

    Raises:
        UsageError: `ref` is no reference, or `delay_s` no number of seconds, from 0 to 1,999,999.
    """
    seconds = finite_time(delay_s, "send_after: delay_s")
    if (target := ref_in(ref)) is None:
        raise UsageError(f"send_after: expected a reference to an actor, got {shown(ref)}")
    return Timer(seconds, target, message)
