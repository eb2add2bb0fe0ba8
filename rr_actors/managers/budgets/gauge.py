"""Gauge: asks a probe again and again, and says what it reads and what is wrong with it."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable

from rr_actors.base.checks import is_number
from rr_actors.base.errors import shown, text_of
from rr_actors.managers.budgets.measures import Measure, Probe
from rr_actors.runtime.time_limits import RunningLimit


class Gauge:
    """Asks the probe of a measure every `every_s` seconds, from start() to stop().

    Each call of the probe has a thread of its own, as it may hang. The next one begins when it has returned.

    Args:
        heard: called with each reading, in the gauge's thread.
        troubled: called there with what is wrong: the probe raises, returns no finite number, or hangs.
    """

    def __init__(
        self, measure: Measure, probe: Probe, heard: Callable[[float], None], troubled: Callable[[str], None]
    ) -> None:
        self._measure, self._probe = measure, probe
        self._heard, self._troubled = heard, troubled
        self._stopped = threading.Event()
        self._answers: queue.SimpleQueue[float | str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="budgets-gauge", daemon=True)

    def start(self) -> None:
        """Ask for the first time, without waiting for the answer."""
        self._thread.start()

    def stop(self) -> None:
        """Begin no further call, and call nobody any more; return when that is so."""
        self._stopped.set()
        self._answers.put(None)
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        while not self._stopped.is_set():
            threading.Thread(target=self._ask, name="budgets-probe", daemon=True).start()
            answer = self._wait()
            if self._stopped.is_set():
                return
            if isinstance(answer, str):
                self._troubled(answer)
            elif answer is not None:
                self._heard(answer)
            self._stopped.wait(self._measure.every_s)

    def _wait(self) -> float | str | None:
        """Return the probe's answer, however late; None when the gauge is stopped."""
        limit = RunningLimit(self._measure.timeout_s)
        while not limit.is_over():
            with contextlib.suppress(queue.Empty):
                return self._answers.get(timeout=limit.slice_s)
        self._troubled(f"has not returned within {self._measure.timeout_s:g} s")
        return self._answers.get()

    def _ask(self) -> None:
        try:
            reading: object = self._probe()
        except BaseException as error:  # a user's function may raise anything
            self._answers.put(f"raised {text_of(error)}")
            return
        self._answers.put(float(reading) if is_number(reading) else f"returned {shown(reading)}, not a finite number")
