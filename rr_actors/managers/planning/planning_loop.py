"""PlanningLoop: the one thread of a manager that looks, compares, and begins steps. All else only wakes it.

A manager writes a function `look`. It reads what is wanted and what is there, has a pure function compare both, and
begins the steps that follow. It returns when to look again. The loop calls it at its start, after each thing that
happens, and at that time; it does not poll.

Steps in flight have one source of truth, `in_flight`, which only this thread changes. A step owns its key from its
begin until the loop has handled its end. So `look` follows one rule: of a key that is in flight, it takes what the
registrar lists as being a part of that step, and never as something besides. Otherwise a load whose answer has arrived,
and whose end has not been handled, would be seen twice: as loading and as loaded.
"""

from __future__ import annotations

import contextlib
import functools
import queue
import threading
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import RegistrarDown, RrError, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.time_limits import RunningLimit

logger = Log("rr_actors.managers")

_LONGEST_S = 3600.0  # a lock takes no longer time limit than some; a look too many does no harm

K = TypeVar("K")
W = TypeVar("W")


class StepEnded(msgspec.Struct, frozen=True):
    """How a step ended: with a `value`, or an `error`, or it was withdrawn."""

    value: Any = None
    error: Exception | None = None
    is_withdrawn: bool = False


class StepInFlight(msgspec.Struct, Generic[W]):
    """A step in flight: what it is about, when it began by the monotonic clock, and the reply that ends it.

    `limit`: what is left of its time; None: it has no limit.
    """

    what: W
    since: float
    reply: Reply[Any] | None = None
    is_withdrawn: bool = False
    limit: RunningLimit | None = None


class PlanningLoop(Generic[K, W]):
    """A thread that looks, and looks again after each thing that happens, until stop().

    Attributes:
        in_flight: the steps in flight by their keys. Read it in `look`, and in what the loop calls.
    """

    def __init__(
        self, name: str, look: Callable[[float], float | None], fail: Callable[[BaseException], object]
    ) -> None:
        """Make the loop; start() starts its thread.

        Args:
            name: of the thread.
            look: called on the thread with the time now, by the monotonic clock. It returns the time at which to look
                again if nothing happens; None: never.
            fail: makes the manager fail with an error that `look`, or something else on the thread, has raised. Its
                supervisor then starts the manager again. Pass the manager's `_rr_failed`.
        """
        self._name, self._look, self._fail = name, look, fail
        self._happened: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._in_flight: dict[K, StepInFlight[W]] = {}
        self.in_flight: Mapping[K, StepInFlight[W]] = MappingProxyType(self._in_flight)
        self._waiting: list[Reply[None]] = []  # callers of look_and_wait() that the next look answers
        self._over = threading.Lock()
        self._is_over = False

    def start(self) -> None:
        """Start the thread, which looks at once."""
        threading.Thread(target=self._run, name=self._name, daemon=True).start()

    def stop(self) -> None:
        """Begin no more steps. Return at once; the thread ends after the look in progress."""
        self._happened.put(None)

    def wake(self) -> None:
        """Look soon: something has happened. From any thread, as are the other methods but begin() and withdraw()."""
        self._happened.put(_nothing)

    def tell(self, note: Callable[[], object]) -> None:
        """Call `note` on the thread, and look after it."""
        self._happened.put(note)

    def look_and_wait(self, timeout_s: float) -> bool:
        """Look, and return when a look that began after this call has ended, or False after `timeout_s` seconds.

        Raises:
            Exception: the loop has failed, with this error.
        """
        looked: Reply[None] = Reply()
        with self._over:
            if self._is_over:
                return False
            self._happened.put(functools.partial(self._await_look, looked))
        try:
            looked.result(timeout_s)
        except TimeoutError:
            return False
        return True

    # -- steps, on the thread --------------------------------------------------------------------------------------

    def begin(
        self,
        key: K,
        what: W,
        start: Callable[[], Any],
        ended: Callable[[StepEnded], object],
        limit_s: float | None = None,
    ) -> None:
        """Begin a step. It is in flight until `ended` is called on the thread, and then the loop looks.

        Args:
            key: what the step owns; nothing else of this key may be in flight.
            start: begins it without waiting, and returns its Reply: ``registrar.load(..., block=False)``. If it raises
                an RrError, the step ends with that.
            ended: called with the outcome when the step is not in flight any more.
            limit_s: seconds after which the step is withdrawn, without the time in which this process stood still.

        Raises:
            RuntimeError: a step of this key is in flight: a defect of the caller.
        """
        step = self._add(key, what)
        try:
            reply: Reply[Any] = start()
        except RrError as error:
            self._happened.put(functools.partial(self._end, key, ended, StepEnded(error=error)))
            return
        step.reply, step.limit = reply, None if limit_s is None else RunningLimit(limit_s)

        def done(reply: Reply[Any]) -> None:  # on another thread
            self._happened.put(lambda: self._end(key, ended, _outcome(reply)))

        reply.add_done_callback(done)

    def begin_call(self, key: K, what: W, call: Callable[[], object], ended: Callable[[StepEnded], object]) -> None:
        """Begin a step that waits: `call` runs in a thread of its own. The rest is as for begin().

        An error of `call` that is no RrError is a defect: the manager fails with it.
        """
        self._add(key, what)

        def run() -> None:
            try:
                outcome = StepEnded(call())
            except RrError as error:
                outcome = StepEnded(error=error)
            except BaseException as error:  # also what is no Exception: the step would be in flight for ever
                self._happened.put(functools.partial(_raise, error))
                return
            self._happened.put(lambda: self._end(key, ended, outcome))

        threading.Thread(target=run, name=f"{self._name}-step", daemon=True).start()

    def withdraw(self, key: K) -> None:
        """Take a step back, if that is possible. It stays in flight until it has ended. Idempotent."""
        step = self._in_flight[key]
        if not step.is_withdrawn and step.reply is not None:
            step.is_withdrawn = True
            step.reply.cancel()

    def _add(self, key: K, what: W) -> StepInFlight[W]:
        if key in self._in_flight:
            raise RuntimeError(f"{self._name}: a step of {key!r} is in flight already")
        step = self._in_flight[key] = StepInFlight(what, time.monotonic())
        return step

    def _end(self, key: K, ended: Callable[[StepEnded], object], outcome: StepEnded) -> None:
        del self._in_flight[key]
        ended(outcome)

    # -- the thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        error: BaseException | None = None
        try:
            next_at = self._once()
            while self._take_all(next_at):
                next_at = self._once()
        except RegistrarDown as raised:  # it is being closed; if it is another one's, the manager starts again
            logger.info("%s: ends: %s", self._name, raised)
            error = raised
        except BaseException as raised:
            logger.exception("%s: its planning loop has failed, and the manager with it", self._name)
            error = raised
        self._close(error)

    def _await_look(self, looked: Reply[None]) -> None:
        self._waiting.append(looked)

    def _once(self) -> float | None:
        waiting, self._waiting = self._waiting, []
        try:
            next_at = self._look(time.monotonic())
        except BaseException as error:
            for looked in waiting:
                looked.set_exception(error)
            raise
        for looked in waiting:
            looked.set(None)
        return next_at

    def _take_all(self, until: float | None) -> bool:
        """Wait until something happens or is due, and handle all that has happened. Return False at the end."""
        with contextlib.suppress(queue.Empty):
            happened = self._next(until)
            while happened is not None:
                happened()
                happened = self._happened.get_nowait()
            return False
        return True

    def _next(self, until: float | None) -> Callable[[], object] | None:
        """Wait, and return what happens next; raise queue.Empty when it is time to look. Withdraw what is overdue."""
        while True:
            limited = [
                (key, step.limit) for key, step in self._in_flight.items() if step.limit and not step.is_withdrawn
            ]
            for key, limit in limited:
                if limit.is_over():
                    self.withdraw(key)
            waits = [
                _LONGEST_S if until is None else until - time.monotonic(),
                *(limit.slice_s for _, limit in limited),
            ]
            try:
                return self._happened.get(timeout=max(0.0, min(waits)))
            except queue.Empty:
                if min(waits) >= waits[0]:
                    raise

    def _close(self, error: BaseException | None) -> None:
        """End what waits for the loop, and make the manager fail if there is an error."""
        with self._over:
            self._is_over = True
        while True:  # what came meanwhile: only those that wait are of interest
            try:
                happened = self._happened.get_nowait()
            except queue.Empty:
                break
            if isinstance(happened, functools.partial) and happened.func == self._await_look:
                happened()
        for looked in self._waiting:
            looked.set(None) if error is None else looked.set_exception(error)
        if error is not None:
            self._fail(error)


def _nothing() -> None:
    """Do nothing: to wake the loop is enough."""


def _raise(error: BaseException) -> None:
    raise error


def _outcome(reply: Reply[Any]) -> StepEnded:
    if reply.cancelled():
        return StepEnded(is_withdrawn=True)
    error = reply.exception()
    if error is None:
        return StepEnded(reply.result())
    return StepEnded(error=error if isinstance(error, Exception) else RrError(text_of(error)))
