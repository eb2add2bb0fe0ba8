"""Run controls: whether a run of an action may begin, and what it hears, in the manager that runs it.

The engine commits a stop or a pause, and then tells it to the run. The load of a run travels on another way, so it may
arrive before that or after it. Therefore a run makes its control first, asks the engine what holds now, and begins
under the lock of the control. What was told, and confirmed, before a run has begun keeps it from beginning.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Literal

from rr_actors.managers.actions.action import Action

Word = Literal["run", "pause", "stop"]
"""What holds for a run: it may run, it is to pause, or it is to stop and is not to begin."""

_LOOK_S = 0.1  # the registrar sets `stopping` itself, and notifies nobody


class RunControl:
    """The control of one run. From any thread.

    Attributes:
        over: is set when the run has ended, or will not begin.
    """

    def __init__(self, action: Action) -> None:
        self.over = threading.Event()
        self._action = action
        self._step = -1
        self._changed = threading.Condition()

    def tell(self, word: Word, step: int) -> None:
        """Take what holds for the run since a step of its graph; what an earlier step said is ignored.

        When it returns, a run that has not begun, and is to stop or to pause, does not begin.
        """
        with self._changed:
            if step < self._step:
                return
            self._step = step
            if word == "stop":
                self._action.stopping.set()
            elif word == "pause":
                self._action.pausing.set()
            else:
                self._action.pausing.clear()
            self._changed.notify_all()

    def begin(self, start: Callable[[], object] = lambda: None) -> bool:
        """Wait while the run is to pause, then call `start`. Return False, and do not call it, if it is to stop."""
        with self._changed:
            while self._action.pausing.is_set() and not self._action.stopping.is_set():
                self._changed.wait(_LOOK_S)
            if self._action.stopping.is_set():
                return False
            start()
            return True
