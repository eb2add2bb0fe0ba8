"""LateWord: the WARNING that holders hear if it takes long to replace what has failed, and never after that."""

from __future__ import annotations

import contextlib
import contextvars
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TypeVar

from rr_actors.base.errors import RrError
from rr_actors.managers.planning.hedging import HEDGE_S
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar
from rr_actors.registrar.servers.callback_context import current

R = TypeVar("R")


class LateWord(AbstractContextManager["LateWord"]):
    """In a with block of a status callback: the holders hear WARNING if nothing takes the place within `HEDGE_S` s."""

    def __init__(self, registrar: Registrar, what: str, status: Status) -> None:
        """`what` has failed, as `status` says."""
        self._registrar, self._id = registrar, current().resource_id
        self._said = Status(State.WARNING, f"{what} has failed, and another one is being started: {status.message}")
        self._lock = threading.Lock()
        self._is_over = False
        self._timer = threading.Timer(HEDGE_S, contextvars.copy_context().run, (self._say,))  # a part of this callback
        self._timer.daemon = True

    def __enter__(self) -> LateWord:
        self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def before(self, response: Callable[[Query], R]) -> Callable[[Query], R]:
        """Return what makes the same response, for replace_part(). Nothing is said after that."""

        def made(spare: Query) -> R:
            self._end()
            return response(spare)

        return made

    def _end(self) -> None:
        self._timer.cancel()
        with self._lock:  # if it is being said, that comes first
            self._is_over = True

    def _say(self) -> None:
        with self._lock, contextlib.suppress(RrError):  # it is being unloaded
            if not self._is_over:
                self._registrar.send_status(self._id, self._said)
