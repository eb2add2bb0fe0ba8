"""Monitors: hear once of the end of any actor, in this process or another (OTP: monitor, demonitor, 'DOWN')."""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
from collections.abc import Callable
from contextvars import Context
from typing import Any, cast

from pykka import ActorDeadError

from rr_actors.actors.messaging import death_watch
from rr_actors.actors.messaging.exit_reports import Down
from rr_actors.actors.refs import DistantRef, local_of, ref_in, watch
from rr_actors.base.errors import RrError, Unavailable, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.callback_errors import described, log_raised
from rr_actors.runtime.event_loop import Dispatcher, acquire, check_may_block, release
from rr_actors.runtime.shielding import Flag
from rr_actors.runtime.time_limits import time_limit
from rr_actors.runtime.user_loop import is_coroutine

logger = Log("rr_actors")

_numbers = itertools.count(1)

Deliver = Callable[["Monitor", Down], None]
"""Delivers the Down to the receiver; may raise ActorDeadError or Unavailable if the receiver has ended."""


class Monitor:
    """A monitor of one actor. It reports the actor's end once, and is over then.

    Attributes:
        ref: the reference to the actor.
        number: a number that no other monitor of this process has; the Down has it too.
    """

    def __init__(self, ref: Any, deliver: Deliver, over: Callable[[Monitor], object]) -> None:
        found = ref_in(ref)
        if found is None:
            raise UsageError(f"monitor: expected a reference to an actor, got {type(ref).__name__}")
        self.ref = found
        self.number = next(_numbers)
        self._deliver = deliver
        self._called_off = over
        self._lock = threading.Lock()
        self._down: Down | None = None
        self._over = False  # delivered, or cancelled
        self._told = Flag()
        self._unwatch: Callable[[], None] | None = None

    @property
    def down(self) -> Down | None:
        """The Down; None while the actor runs."""
        return self._down

    def demonitor(self) -> bool:
        """Cancel the monitor. No Down is delivered after this, even if it was in flight.

        Returns:
            False if the Down was delivered, or the monitor was cancelled before.
        """
        with self._lock:
            if self._over:
                return False
            self._over = True
        if self._unwatch is not None:
            self._unwatch()
        self._called_off(self)
        return True

    def wait(self, timeout_s: float | None = None) -> Down | None:
        """Wait until the actor has ended, and return the Down; None after `timeout_s` seconds.

        Raises:
            UsageError: the call would hang, as in an `async def` handler; or timeout_s is no number of seconds.
        """
        limit_s = time_limit(timeout_s)
        if not self._told.is_set:
            check_may_block(f"waiting for the end of {self.ref}")
        self._told.wait(limit_s)
        return self._down

    def _take(self) -> Down | None:
        """Return the Down, which the caller must handle; None if the monitor is over already."""
        with self._lock:
            if self._over:
                return None
            self._over = True
        return self._down

    def _begin(self) -> None:
        local = local_of(self.ref)
        if local is not None:
            self._unwatch = death_watch.watch(local, lambda report: self._fire(report.reason, report.detail))
            if self._unwatch is None:
                self._fire("noproc", f"{self.ref} has ended")
            return
        try:
            self._unwatch = watch(cast("DistantRef[Any]", self.ref), self._fire)
        except (ActorDeadError, RrError) as error:
            self._fire("noproc", str(error))

    def _fire(self, reason: Any, detail: str) -> None:
        with self._lock:
            if self._over or self._down is not None:
                return
            self._down = down = Down(self.ref, reason, detail, self.number)
        self._told.set()
        try:
            self._deliver(self, down)
        except (ActorDeadError, Unavailable) as error:
            level = logging.ERROR if wanted_by(error) else logging.DEBUG  # without a reason like that nobody is left
            logger.log(level, "a monitor could not report that %s: %s", down, error)
            self.demonitor()

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.demonitor()

    def __repr__(self) -> str:
        return f"<Monitor {self.number} of {self.ref}: {self._down or ('called off' if self._over else 'watching')}>"


take = Monitor._take  # pyright: ignore[reportPrivateUsage]  # same file
begin = Monitor._begin  # pyright: ignore[reportPrivateUsage]  # same file


def monitor(ref: Any, callback: Callable[[Down], Any] | None = None) -> Monitor:
    """Call callback(Down) once, in a worker, when an actor has ended. In an actor use `self.monitor` instead.

    An actor that is dead, or is being restarted, is down at once ("noproc"). The callback may be `async def`. Without a
    callback use the Monitor's `wait()` and `down`.

    Args:
        ref: a reference, a proxy or a SupervisorRef, to an actor in any process of the system.

    Raises:
        UsageError: `ref` is no reference, or `callback` cannot be called.
    """
    if callback is not None and not callable(cast(object, callback)):
        raise UsageError(f"monitor: callback: expected a callable, got {type(callback).__name__}")
    call_back = None if callback is None else described(callback, "monitor: callback")

    def over(_monitor: Monitor) -> None:
        with contextlib.suppress(Unavailable):  # the loop has ended
            dispatcher.call(release)  # on the loop: a worker would wait for itself

    def deliver(monitor: Monitor, _down: Down) -> None:
        if call_back is None:
            take(monitor)
            over(monitor)
        else:
            dispatcher.workers.in_thread(_call_back, monitor, call_back, dispatcher, over, beyond_limit=True)

    made = Monitor(ref, deliver, over)
    dispatcher = acquire()  # released when the monitor is over
    begin(made)
    return made


def _call_back(
    monitor: Monitor, callback: Callable[[Down], Any], dispatcher: Dispatcher, over: Callable[[Monitor], object]
) -> None:
    def done(_result: Any, error: BaseException | None) -> None:
        if error is not None:
            log_raised(logger, error, "the callback of %r raised", monitor)
        over(monitor)

    down = take(monitor)
    if down is None:
        return
    try:
        result = callback(down)
        if is_coroutine(result):
            dispatcher.workers.start_coroutine(result, done, Context())
            return
    except Exception as error:
        done(None, error)
    else:
        done(None, None)
