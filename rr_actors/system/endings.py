"""How a system ends without stop(): a signal tells its program to end, or nothing refers to it any more."""

from __future__ import annotations

import asyncio
import concurrent.futures
import signal
import warnings
import weakref
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from rr_actors.base.errors import UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.runtime import interpreter
from rr_actors.runtime.event_loop import current
from rr_actors.runtime.shielding import is_interruptible

logger = Log("rr_actors")

# Signals: by them an operating system, a container or a terminal tells a program to end.


class Told(BaseException):
    """Raised in the main thread by the first signal, out of the call that waits."""


class Termination:
    """A context manager for the main thread. Within it, SIGTERM and SIGINT mean: stop cleanly.

    The first signal raises Told, if `awaited` is true. Each further signal calls `hurry`. A process with id 1 has no
    default action for SIGTERM: without a handler the signal does nothing to it.

    Args:
        hurry: makes a stop that is in progress end soon.

    Raises:
        UsageError: a thread other than the main one enters it.
    """

    def __init__(self, what: str, hurry: Callable[[], object]) -> None:
        self.told: signal.Signals | None = None
        self.awaited = False
        self._what = what
        self.again = False
        self._hurry = hurry
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if not is_interruptible():
            raise UsageError(
                f"{self._what}: only the main thread hears signals; call it there, or use start() and stop()"
            )
        for number in (signal.SIGTERM, signal.SIGINT):
            self._before[number] = interpreter.handle_signal(number, self._hear)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            interpreter.give_signal_back(number, handler)

    def _hear(self, number: int, _frame: FrameType | None) -> None:
        if self.told is not None:
            self.again = True
            self._hurry()
            return
        self.told = signal.Signals(number)
        if self.awaited:
            raise Told


# Dropped systems: they run, but nothing refers to them any more. They warn, as an open socket does, and are stopped.
#
# A system is dropped where its last reference goes, or where the garbage collector runs. Nothing may wait at such a
# point, so the system's loop stops the system in the background.

_stopping: dict[str, tuple[Future[None], float]] = {}
"""The future that is done when a system has stopped, and its limit in seconds, by the real state directory."""


def weakly(method: Callable[..., object]) -> Callable[..., None]:
    """Return a callback that does not keep the method's object alive; without the object it does nothing."""
    reference = weakref.WeakMethod(method)

    def call(*args: Any) -> None:
        if (found := reference()) is not None:
            found(*args)

    return call


def stop_dropped(
    what: str, state_dir: Path, dropped: object, stopping: Coroutine[Any, Any, None], limit_s: float
) -> None:
    """Warn that `what` was dropped, and run the coroutine `stopping` on the loop. Do not wait for it.

    Args:
        dropped: the dropped object, for the warning.
        limit_s: seconds that `stopping` may take. A program that exits meanwhile waits for so long.
    """
    text = f"{what} was dropped without stop(): call stop(), or use it as a context manager"
    warnings.warn(text, ResourceWarning, source=dropped, stacklevel=3)

    async def stopped() -> None:
        try:
            await stopping
        except Exception:
            logger.exception("%s: stopping it", what)

    dispatcher = current()
    if dispatcher is None or dispatcher.closed:  # the interpreter exits: what the system has started ends with it
        stopping.close()
        return
    logger.warning("%s; it is being stopped", text)
    running = stopped()
    try:
        _stopping[str(state_dir)] = asyncio.run_coroutine_threadsafe(running, dispatcher.loop), limit_s
    except RuntimeError:  # the loop has ended just now
        running.close()
        stopping.close()


def wait_stopped(state_dir: Path, timeout_s: float) -> None:
    """Wait until the dropped system of this state directory has stopped, at most `timeout_s` seconds."""
    if (stopping := _stopping.pop(str(state_dir), None)) is not None:
        concurrent.futures.wait(stopping[:1], timeout_s)


def _wait_at_exit() -> None:
    # This runs before the loop is closed, which would cancel the stops half way.
    for state_dir, (_, limit_s) in list(_stopping.items()):
        wait_stopped(Path(state_dir), limit_s)


interpreter.at_exit(_wait_at_exit)
