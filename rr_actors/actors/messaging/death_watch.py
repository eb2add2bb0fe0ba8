"""Watching: the actors of this process and who wants to hear of their end. An entry for each life of an actor.

An actor of rr_actors is entered when it comes alive and leaves when it has ended, or is abandoned. Any other Pykka
actor is entered when somebody first watches it: Pykka tells nobody of an end, so its `actor_stopped` is made to.
"""

from __future__ import annotations

import itertools
import logging
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

import pykka

from rr_actors.actors.messaging.exit_reports import ExitReport
from rr_actors.base.errors import text_of
from rr_actors.runtime import event_loop

logger = logging.getLogger("rr_actors")

Fire = Callable[[ExitReport], None]
"""Called once, from any thread, with how the actor ended; must not block."""

_SECOND_LOOK_S = 0.1

_lock = threading.Lock()
_numbers = itertools.count(1)
_watched: dict[threading.Event, dict[int, Fire]] = {}
"""By the actor's `actor_stopped`, which unlike its URN is another one in each of its lives."""


def begin(stopped: threading.Event) -> None:
    """An actor of rr_actors comes alive; ended() must follow."""
    _watched[stopped] = {}


def watch(ref: pykka.ActorRef[Any], fire: Fire) -> Callable[[], None] | None:
    """Call `fire` when the actor, one of this process, has ended. Returns what ends the watch; None if it is dead."""
    stopped = ref.actor_stopped
    with _lock:
        fires = _watched.get(stopped)
        if fires is None:
            if stopped.is_set():
                return None
            fires = _watched[stopped] = {}
            _make_it_tell(stopped)
        number = next(_numbers)
        fires[number] = fire
    return lambda: _unwatch(stopped, number)


def ended(stopped: threading.Event, report: ExitReport) -> None:
    """The actor has ended, or is abandoned; saying so twice is nothing."""
    with _lock:
        fires = _watched.pop(stopped, {})
    for fire in fires.values():
        try:
            fire(report)
        except Exception:
            logger.exception("telling of the end of an actor")


def _unwatch(stopped: threading.Event, number: int) -> None:
    with _lock:
        _watched.get(stopped, {}).pop(number, None)


def _make_it_tell(stopped: threading.Event) -> None:
    set_it = stopped.set

    def set_and_tell() -> None:
        set_it()
        ended(stopped, _how_it_ends())

    stopped.set = set_and_tell  # pyright: ignore[reportAttributeAccessIssue]
    process = event_loop.current()
    if process is not None:  # it may have been about to be set, in another thread, when it was replaced
        process.call(lambda: process.loop.call_later(_SECOND_LOOK_S, _look_again, stopped))


def _look_again(stopped: threading.Event) -> None:
    if stopped.is_set():
        ended(stopped, ExitReport("normal", "stopped"))


def _how_it_ends() -> ExitReport:
    """Pykka sets `actor_stopped` while it handles the exception that ends an actor, if one does."""
    error = sys.exc_info()[1]
    if error is None or (isinstance(error, SystemExit) and not error.code):
        return ExitReport("normal", "stopped")
    text = "".join(traceback.format_exception(error))
    return ExitReport("abnormal", text_of(error), error, text)
