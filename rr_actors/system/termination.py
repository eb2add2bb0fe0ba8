"""Termination: the signals by which an operating system, a container or a terminal tells a program to end."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

from rr_actors.base.errors import UsageError
from rr_actors.runtime.shielding import is_interruptible

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Told(BaseException):
    """Raised in the main thread by the first signal, out of the call that waits."""


class Termination:
    """A context manager for the main thread. Within it, SIGTERM and SIGINT mean: stop in order.

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
        for number in SIGNALS:
            self._before[number] = signal.signal(number, self._hear)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not set from Python

    def _hear(self, number: int, _frame: FrameType | None) -> None:
        if self.told is not None:
            self.again = True
            self._hurry()
            return
        self.told = signal.Signals(number)
        if self.awaited:
            raise Told
