"""Watch: end a run of chaos even if the system hangs. Each phase has a limit, and an error names a standstill."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable

from rr_actors.base.reporting.tracebacks import stacks_of_threads


class Interrupted(Exception):
    """The run must end; phase() raises this in the run's thread."""


class Standstill(Exception):
    """A phase has not ended in its time. The text names the phase, and has the stack of each thread of this process."""


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
        """Begin a phase, or the next step of the same phase; its time begins now. In the run's thread.

        Raises:
            Interrupted: the run must end.
        """
        self._phase, self._until = what, time.monotonic() + self._patience_s
        if self._interrupted.is_set():
            raise Interrupted

    def run(self, work: Callable[[], None]) -> None:
        """Run `work` in a thread, and return when it has ended.

        Raises:
            Standstill: a phase took too long; the thread still runs.
            KeyboardInterrupt: it came meanwhile; the work was interrupted at its next phase, and has ended.
            BaseException: an exception of `work`.
        """
        failures: list[BaseException] = []
        ended = threading.Event()  # an interrupted Thread.join() may return while the thread runs

        def guarded() -> None:
            try:
                work()
            except BaseException as error:
                failures.append(error)
            finally:
                ended.set()

        threading.Thread(target=guarded, name="chaos", daemon=True).start()
        try:
            self._see_end(ended)
        except KeyboardInterrupt:
            self._interrupted.set()
            self._until = time.monotonic() + self._patience_s
            self._see_end(ended)
            raise
        if failures:
            raise failures[0]

    def _see_end(self, ended: threading.Event) -> None:
        while not ended.wait(0.05):
            if time.monotonic() > self._until:
                what = f"standstill: {self._phase}: had not ended after {self._patience_s:g} s; no verdict"
                raise Standstill("\n".join([what, *_stacks()]))


def _stacks() -> list[str]:
    names = {thread.ident: thread.name for thread in threading.enumerate()}
    found: list[str] = []
    for ident, frame in stacks_of_threads().items():
        lines = "".join(traceback.format_stack(frame)).rstrip()
        found.append(f"thread {names.get(ident, ident)}:\n{lines}")
    return found
