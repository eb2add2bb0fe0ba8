"""Watching: the actors of this process, and the callbacks for their end. Each life of an actor has one entry.

An rr_actors actor gets its entry when it comes alive, and loses it when it has ended or is abandoned. Any other Pykka
actor gets it at the first watch. Pykka reports no end: so the actor's `actor_stopped` is changed to do that.
"""

from __future__ import annotations

import itertools
import sys
import threading
from collections.abc import Callable
from typing import Any

import pykka

from rr_actors.actors.messaging.exit_reports import ExitReport
from rr_actors.base.errors import text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import trace_of
from rr_actors.runtime import event_loop

logger = Log("rr_actors")

Fire = Callable[[ExitReport], None]
"""Called once, from any thread, with the report of the actor's end; must not block."""

_SECOND_LOOK_S = 0.1

_lock = threading.Lock()
_numbers = itertools.count(1)
_watched: dict[threading.Event, dict[int, Fire]] = {}
"""The callbacks, by the actor's `actor_stopped`, which differs in each of its lives, unlike its URN."""


def begin(stopped: threading.Event) -> None:
    """Make the entry of an actor of rr_actors that comes alive; the caller must call ended() later."""
    _watched[stopped] = {}


def watch(ref: pykka.ActorRef[Any], fire: Fire) -> Callable[[], None] | None:
    """Call `fire` when an actor of this process has ended; return what ends the watch, or None if it is dead."""
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
    """Call the callbacks of an actor that has ended or is abandoned; a second call does nothing."""
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
    if process is not None:  # another thread may have called the old `set` at this moment: look again later
        process.call(lambda: process.loop.call_later(_SECOND_LOOK_S, _look_again, stopped))


def _look_again(stopped: threading.Event) -> None:
    if stopped.is_set():
        ended(stopped, ExitReport("normal", "stopped"))


def _how_it_ends() -> ExitReport:
    """Return the report of a Pykka actor's end: Pykka sets `actor_stopped` while it handles the exception, if any."""
    error = sys.exc_info()[1]
    if error is None or (isinstance(error, SystemExit) and not error.code):
        return ExitReport("normal", "stopped")
    text = trace_of(error)
    return ExitReport("abnormal", text_of(error), error, text)
