"""Subscribers: who is told, in a worker and in order, what happens in a system."""

from __future__ import annotations

import functools
import itertools
import logging
import threading
from collections.abc import Callable
from typing import Any

from rr_actors.base.errors import RrError, UsageError, exact_text, shown
from rr_actors.runtime.callback_errors import described, log_raised
from rr_actors.runtime.user_loop import name_of
from rr_actors.system.hosting.node import Node

logger = logging.getLogger("rr_actors")

Event = dict[str, Any]


class Subscribers:
    """The subscribers of one system, also while it does not run. From any thread.

    Args:
        system: its name, for logs.
    """

    def __init__(self, system: str) -> None:
        self._system = system
        self._callbacks: dict[int, tuple[str, Callable[[Event], Any]]] = {}
        self._listeners: list[Callable[[Event], None]] = []
        self._numbers = itertools.count(1)
        self._node: Node | None = None
        self._saying = threading.Lock()  # whether there are any

    def attend(self, node: Node) -> None:
        """The system runs, and this is its own process's node: have its processes tell it, if anybody listens."""
        self._node = node
        self._say_whether_watched()

    def leave(self) -> None:
        """The system has stopped: nobody is told any more."""
        self._node = None

    def add(self, callback: Callable[[Event], Any]) -> Callable[[], None]:
        """Have the callback called for each event; returns what ends that.

        Raises:
            UsageError: it cannot be called.
        """
        if not callable(callback):
            raise UsageError(f"subscribe: expected a callable, got {type(callback).__name__}")
        callback, who = described(callback, "subscribe"), _name_of(callback)
        number = next(self._numbers)

        def unsubscribe() -> None:
            self._callbacks.pop(number, None)
            self._say_whether_watched()

        try:
            self._callbacks[number] = who, callback
            self._say_whether_watched()
        except BaseException:  # KeyboardInterrupt, say: nobody could end it
            unsubscribe()
            raise
        return unsubscribe

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        """Have the package's own listener called on the loop, where it must be quick; returns what ends that."""
        self._listeners = [*self._listeners, listener]
        self._say_whether_watched()

        def end() -> None:
            self._listeners = [other for other in self._listeners if other is not listener]
            self._say_whether_watched()

        return end

    def tell(self, event: Event) -> None:
        """This has happened."""
        node = self._node
        if node is None:
            return
        for listener in self._listeners:
            listener(event)
        for number, (who, callback) in list(self._callbacks.items()):
            key, heard = ("subscriber", id(self), number), functools.partial(self._heard, who, event["event"])
            try:
                node.dispatcher.workers.serial(key, callback, event, done=heard)
            except RrError:
                logger.exception("system %s: an event was not delivered", self._system)

    def _heard(self, who: str, event: str, _result: Any, error: BaseException | None) -> None:
        if error is not None:
            log_raised(logger, error, "system %s: subscriber %s raised at the event %r", self._system, who, event)

    def _say_whether_watched(self) -> None:
        with self._saying:
            if (node := self._node) is not None:
                node.watched.set(bool(self._callbacks or self._listeners))


def _name_of(callback: Callable[..., Any]) -> str:
    try:
        return exact_text(name_of(callback))
    except Exception:  # of its own code
        return shown(callback)
