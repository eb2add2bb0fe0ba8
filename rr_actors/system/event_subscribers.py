"""Subscribers: callbacks that hear, in a worker and in order, what happens in a system; and the types of the events.

docs/supervision.md lists the events for people.
"""

from __future__ import annotations

import functools
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any, Literal, TypedDict, TypeVar, get_args, get_type_hints

from rr_actors.base.errors import RrError, UsageError, exact_text, shown
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.links.recorder import RECORDED
from rr_actors.registrar.model.effects import Happening
from rr_actors.runtime.backlogs import Backlog
from rr_actors.runtime.callback_errors import described, log_raised
from rr_actors.runtime.user_loop import name_of
from rr_actors.streams.stream import StreamHappening

logger = Log("rr_actors")

T = TypeVar("T")


class _ChildEvent(TypedDict):
    """The keys that every ChildEvent has."""

    event: Literal[
        "started", "restarted", "ignored", "start_failed", "exited", "stopped", "deleted", "gave_up", "auto_shutdown"
    ]
    path: str
    kind: Literal["manager", "actor", "supervisor"]
    at: float
    state: str | None


class ChildEvent(_ChildEvent, total=False):
    """Something that happened to a child of a supervisor. A key whose value says nothing is left out.

    The keys are the attributes of a record of `SupervisorRef.history()`. `path` is the child's path, `at` the
    time in seconds since the epoch. `state` is the child's state after the event, or None if its supervisor forgets the
    child. `reason` and `detail` say why it ended.
    """

    run: int
    pid: int
    reason: str
    detail: str
    code: int
    signal: str
    traceback: str
    restarts: int
    delay_s: float
    ready_s: float
    up_s: float


class _OfResource(TypedDict):
    """The keys of every event of a resource."""

    at: float
    registrar: str
    server: str
    resource_id: str
    request: str


class _ResourceEvent(_OfResource):
    """The keys that every ResourceEvent has."""

    event: Happening
    detail: str


class ResourceEvent(_ResourceEvent, total=False):
    """Something that happened to a resource.

    `registrar` is its provider, `server` the id of its server, and `request` its request as JSON, cut if it is long.
    `detail` is the status ("FATAL unplugged"), the new priority ("priority 5", "standby"), the error of a load,
    unload or pause that failed, or else "". That of "revoked" is the reason. That of "loaded" is "took 3.2 s" if the
    callback took a second or more.

    Only a "status" has the other keys. `source` is the server where it began. `status_id` is the same for all resources
    that it reaches. `heard_by` names the registrars that hold this resource for themselves, "app, planner".
    """

    status_id: str
    source: str
    heard_by: str


class ProgressEvent(_OfResource):
    """A load callback has reported how far it has come. The keys of the resource are as in a ResourceEvent."""

    event: Literal["progress"]
    fraction: float
    text: str


class _StreamEvent(_OfResource):
    """The keys that every StreamEvent has."""

    event: StreamHappening
    stream: str
    detail: str


class StreamEvent(_StreamEvent, total=False):
    """Something that happened to a stream, called `stream`. The keys of its resource are as in a ResourceEvent.

    A killed manager closes nothing. Only a "stream_rebound" has the other keys: `reader`, a registrar, reads it now
    instead of the stream `before`, "RESOURCE_ID/NAME". `detail` says that for people.
    """

    reader: str
    before: str


class DeadLetterEvent(TypedDict):
    """A message that reached nobody: the attributes of a DeadLetter, and `count`, how many its process has had."""

    event: Literal["dead_letter"]
    to: str
    message: str
    why: str
    at: float
    pid: int
    count: int


class EndedEvent(TypedDict):
    """The root supervisor has ended, and with it all children. `reason` and `detail` say why."""

    event: Literal["ended"]
    at: float
    path: str
    reason: str
    detail: str


class MissedEvent(TypedDict):
    """A notice that this subscriber was too slow and has missed `count` events. Others may have heard them."""

    event: Literal["missed"]
    count: int


Event = ChildEvent | ResourceEvent | ProgressEvent | StreamEvent | DeadLetterEvent | EndedEvent | MissedEvent
"""The argument of a subscriber. A type checker tells the kinds apart by `event["event"]`."""

Facts = dict[str, Any]
"""An event on its way to the subscribers: it may come from another process."""


def kinds_for_all() -> list[str]:
    """Return the kinds of events that every subscriber hears: all but "missed", which goes to one alone."""
    types = (ChildEvent, ResourceEvent, ProgressEvent, StreamEvent, DeadLetterEvent, EndedEvent)
    return [kind for cls in types for kind in get_args(get_type_hints(cls)["event"])]


class Subscribers:
    """The subscribers of one system, also while it does not run. From any thread.

    Args:
        system: the system's name, for logs.
    """

    def __init__(self, system: str) -> None:
        self._system = system
        self._callbacks: dict[int, tuple[str, Callable[..., Any]]] = {}
        self._backlogs: dict[int, Backlog[Facts]] = {}  # filled on the loop; other threads only remove from it
        self._listeners: dict[int, tuple[Callable[[Facts], None], bool]] = {}  # and whether it records
        self._of_decisions: dict[int, int] = {}  # the recordings that want decisions
        self._numbers = itertools.count(1)
        self.listened = False  # whether anybody listens
        self._node: Node | None = None
        self._saying = threading.Lock()  # held to say whether anybody listens

    def attend(self, node: Node) -> None:
        """Take the node of the system's own process, and tell all processes whether anybody listens."""
        self._node = node
        self._say_whether_watched()

    def end(self, wait_s: float) -> None:
        """Leave a system that has stopped. Let the subscribers hear what waits, for `wait_s` seconds; drop the rest."""
        deadline = time.monotonic() + wait_s
        for backlog in list(self._backlogs.values()):
            backlog.close(deadline - time.monotonic())
        self.leave()

    def leave(self) -> None:
        """Forget the node, so that nobody hears any more: the system has stopped, or this is a forked child."""
        self._node = None
        self._backlogs = {}
        self._saying = threading.Lock()  # another thread may have held it at the fork

    def add(self, callback: Callable[..., Any]) -> Callable[[], None]:
        """Have the callback called for each event, and return a function that ends the subscription.

        Raises:
            UsageError: the callback cannot be called.
        """
        if not callable(callback):
            raise UsageError(f"subscribe: expected a callable, got {type(callback).__name__}")
        return self._add(self._callbacks, (_name_of(callback), described(callback, "subscribe")))

    def listen(self, listener: Callable[[Facts], None], *, records: bool = False) -> Callable[[], None]:
        """Have a listener of the package called on the loop (it must be quick); return a function that ends that.

        Args:
            records: have the processes send their entries, too, as "recorded" events.
        """
        return self._add(self._listeners, (listener, records))

    def want_decisions(self) -> Callable[[], None]:
        """Have the registrars note their decisions, for those who listen with `records`; return what ends that."""
        return self._add(self._of_decisions, 0)

    def _add(self, those: dict[int, T], one: T) -> Callable[[], None]:
        number = next(self._numbers)

        def end() -> None:
            those.pop(number, None)
            if (backlog := self._backlogs.pop(number, None)) is not None:
                backlog.close()
            self._say_whether_watched()

        try:
            those[number] = one
            self._say_whether_watched()
        except BaseException:  # KeyboardInterrupt, for instance: nobody could end the subscription
            end()
            raise
        return end

    def tell(self, event: Facts) -> None:
        """Pass an event to the listeners and subscribers, while the system runs."""
        node = self._node
        if node is None:
            return
        is_recorded = event["event"] == RECORDED
        for listener, records in list(self._listeners.values()):
            if records or not is_recorded:
                try:
                    listener(event)
                except Exception:  # a defect of the listener must end no registrar and no supervisor
                    logger.exception("system %s: an event was not delivered", self._system)
        for number in list(self._callbacks) if not is_recorded else ():
            try:
                self._backlog(node, number).put(event)
            except KeyError:
                continue  # the subscription has ended just now
            except RrError:
                logger.exception("system %s: an event was not delivered", self._system)

    def _backlog(self, node: Node, number: int) -> Backlog[Facts]:
        if (backlog := self._backlogs.get(number)) is None:
            who, callback = self._callbacks[number]
            missed = functools.partial(self._say_missed, who, callback)
            raised = functools.partial(self._raised, who)
            backlog = self._backlogs[number] = Backlog(node.dispatcher.workers, callback, missed, raised)
        return backlog

    def _say_missed(self, who: str, callback: Callable[..., Any], count: int) -> Any:
        logger.warning("system %s: subscriber %s is too slow: it has missed %d events", self._system, who, count)
        return callback(MissedEvent(event="missed", count=count))

    def _raised(self, who: str, error: BaseException, event: Facts | None) -> None:
        kind = "missed" if event is None else event["event"]
        log_raised(logger, error, "system %s: subscriber %s raised at the event %r", self._system, who, kind)

    def _say_whether_watched(self) -> None:
        with self._saying:
            self.listened = bool(self._callbacks or self._listeners)
            if (node := self._node) is not None:
                records = any(records for _, records in list(self._listeners.values()))
                node.watched.set(self.listened, records, max(list(self._of_decisions), default=0))


def _name_of(callback: Callable[..., Any]) -> str:
    try:
        return exact_text(name_of(callback))
    except Exception:  # raised by the callback's own code
        return shown(callback)
