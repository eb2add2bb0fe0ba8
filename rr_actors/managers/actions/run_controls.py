"""Run controls: how the engine tells a run of an action to stop or to pause, also before its code has begun."""

from __future__ import annotations

import threading
from collections.abc import Callable

from rr_actors.managers.actions.action import Action


class RunControl:
    """The control of one run. From any thread.

    Attributes:
        key: identifies the run in the manager.
        is_stopped: whether the run was told to stop.
    """

    def __init__(self, key: str) -> None:
        self.key = key
        self.is_stopped = False
        self._is_paused = False
        self._lock = threading.Lock()
        self._tell: Callable[[str], object] | None = None

    def tell(self, what: str) -> None:
        """Tell the run to "stop", "pause" or "resume"."""
        with self._lock:
            self.is_stopped = self.is_stopped or what == "stop"
            self._is_paused = what == "pause" or (self._is_paused and what != "resume")
            tell = self._tell
        if tell is not None:
            tell(what)

    def attach(self, tell: Callable[[str], object]) -> None:
        """Pass on what was told, and what will be told, to `tell`."""
        with self._lock:
            self._tell = tell
            told = ["stop"] * self.is_stopped + ["pause"] * self._is_paused
        for what in told:
            tell(what)

    def attach_action(self, action: Action) -> None:
        """Pass it on to an action that runs in this process, by its events."""

        def tell(what: str) -> None:
            match what:
                case "stop":
                    action.stopping.set()
                case "pause":
                    action.pausing.set()
                case _:
                    action.pausing.clear()

        self.attach(tell)
