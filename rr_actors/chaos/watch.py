"""Watch: a run of chaos ends, whatever the system does: each of its phases has a time, and a standstill is named."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable


class Interrupted(Exception):
    """The run is to end; raised in its thread, at its next phase."""


class Standstill(Exception):
    """A phase has not ended in its time. Its text says which, and where each thread of this process stands."""


class Watch:
    """Watches one run, which is in a thread of its own.

    Args:
        patience_s: how long a phase may take.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._interrupted = threading.Event()
        self._phase = "beginning"
        self._until = time.monotonic() + patience_s

    def phase(self, what: str) -> None:
        """Say in the run's thread that the phase before has ended and this one begins; or the next step of the same.

        Raises:
            Interrupted: the run is to end.
        """
        self._phase, self._until = what, time.monotonic() + self._patience_s
        if self._interrupted.is_set():
            raise Interrupted

    def run(self, work: Callable[[], None]) -> None:
        """Run `work` in a thread, and return when it has ended.

        Raises:
            Standstill: a phase took too long; the thread is left to itself.
            KeyboardInterrupt: it came meanwhile; the work has been told, and has ended, if it did within its patience.
            BaseException: what `work` raised.
        """
        failures: list[BaseException] = []

        def guarded() -> None:
            try:
                work()
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=guarded, name="chaos", daemon=True)
        thread.start()
        try:
            self._see_end(thread)
        except KeyboardInterrupt:
            self._interrupted.set()
            self._until = time.monotonic() + self._patience_s
            self._see_end(thread)
            raise
        if failures:
            raise failures[0]

    def _see_end(self, thread: threading.Thread) -> None:
        while thread.is_alive():
            thread.join(0.05)
            if time.monotonic() > self._until and thread.is_alive():
                what = f"standstill: {self._phase}: had not ended after {self._patience_s:g} s; no verdict"
                raise Standstill("\n".join([what, *_stacks()]))


def _stacks() -> list[str]:
    names = {thread.ident: thread.name for thread in threading.enumerate()}
    found: list[str] = []
    for ident, frame in sys._current_frames().items():  # pyright: ignore[reportPrivateUsage]  # documented
        lines = "".join(traceback.format_stack(frame)).rstrip()
        found.append(f"thread {names.get(ident, ident)}:\n{lines}")
    return found
