"""Progress: how far a load has come.

A load's callback reports how far it has come, and the consumers that wait for the load hear it. While a load waits in
line for an exclusive resource, they hear its place.

Best effort: reports are not in the catalog and are not sent again, and no callback waits for them. A report is kept,
and the event loop sends the newest one, ten times a second at most. The last report of a load leaves before the answer.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections import deque
from collections.abc import Callable, Iterable
from itertools import chain
from typing import Protocol, cast

import msgspec

from rr_actors.base.errors import Unavailable, UsageError, exact_number, exact_text, is_a, readable, shown
from rr_actors.base.values.canonical import text_of_value
from rr_actors.hosting.process_node import ProcessNode
from rr_actors.registrar.core.notices import parked_on
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.messages import Load, Message, Progressed
from rr_actors.registrar.model.rows import Phase, Resource
from rr_actors.runtime.thread_rules import any_thread, on_loop

INTERVAL_S = 0.1
"""The time between two reports of one load, at least."""
TEXT_LIMIT = 500
"""The number of characters that the text of a report may have."""


class Progress(msgspec.Struct, frozen=True):
    """How far a load has come.

    Attributes:
        fraction: from 0.0 to 1.0.
        text: what the load callback does now, for people; may be "".
        server: the server that loads, "registrar/server".
        resource_id: the resource that is being loaded.
    """

    fraction: float
    text: str
    server: str
    resource_id: str

    def __str__(self) -> str:
        return shown_progress(self.fraction, self.text)


def shown_progress(fraction: float, text: str) -> str:
    """Return a report as text for people: "50% opening"; while nothing is done, the text alone."""
    return f"{fraction:.0%} {text}".rstrip() if fraction or not text else text


def checked(fraction: object, text: object) -> tuple[float, str]:
    """Return the fraction and text of a report in a form that can be sent; raise UsageError if they cannot be."""
    number = math.nan
    if is_a(fraction, (int, float)) and not is_a(fraction, bool):
        number = exact_number(cast("float", fraction))
    if not 0 <= number <= 1:  # NaN is not
        what = f"{shown(fraction)} ({type(fraction).__name__})"
        raise UsageError(f"progress: fraction: expected a number from 0 to 1, got {what}")
    if not is_a(text, str):
        raise UsageError(f"progress: text: expected a str, got {shown(text)} ({type(text).__name__})")
    exact = exact_text(text)
    if len(exact) > TEXT_LIMIT:
        raise UsageError(f"progress: text: expected at most {TEXT_LIMIT} characters, got {len(exact)}")
    return float(number), readable(exact)


class _Reports:
    """The reports of one load.

    Attributes:
        has: while the load waits in line, the registrar that has the resource, and since when.
        newest: the last report, for readers at any time.
        unsent: the last report, until it is sent.
        turn: has an entry while no turn of the loop is planned for these reports. The thread that takes the entry plans
            one.
    """

    __slots__ = ("has", "newest", "turn", "unsent")

    def __init__(self) -> None:
        self.has: tuple[str, float | None] | None = None
        self.newest: tuple[float, str] = (0.0, "")
        self.unsent: deque[tuple[float, str]] = deque(maxlen=1)
        self.turn: deque[None] = deque((None,))


class Hints(Protocol):
    """The links of a registrar's consumers, as they are used for messages that may be lost."""

    def hint(self, origin: str, message: Message) -> None:
        """Send a message when flushed; drop it if the consumer is behind with its reading."""
        ...

    def flush(self) -> None:
        """Flush every link that has unsent messages."""
        ...


class Reporting(Protocol):
    """A registrar, as its reports see it."""

    name: str
    closed: bool
    node: ProcessNode
    lock: threading.RLock

    @property
    def consumers(self) -> Hints: ...

    def whole(self) -> Catalog: ...

    def title_of(self, resource: Resource) -> str: ...


@on_loop
class ProgressReports:
    """The reports of all loads of one registrar.

    Attributes:
        loads: by resource, the reports of each load callback that has made some, and has not returned.
    """

    def __init__(self, registrar: Reporting) -> None:
        self._registrar = registrar
        self.loads: dict[str, _Reports] = {}

    @any_thread
    def report(self, resource_id: str, fraction: float, text: str) -> None:
        """Keep a report, and have it sent soon; does not wait."""
        reports = self.loads.get(resource_id) or self.loads.setdefault(resource_id, _Reports())
        reports.newest = (fraction, text)
        reports.unsent.append(reports.newest)
        self._want_turn(resource_id, reports)

    def place(self, resource_id: str, text: str, holder: str, since: float | None) -> None:
        """Have the place in line sent soon of a load that waits, with who has the resource, since when."""
        reports = self.loads.get(resource_id) or self.loads.setdefault(resource_id, _Reports())
        reports.has = holder, since
        self.report(resource_id, 0.0, text)

    @any_thread
    def newest(self, resource_id: str) -> tuple[float, str] | None:
        """Return the last report of a load that runs; None if it has made none."""
        reports = self.loads.get(resource_id)
        return None if reports is None else reports.newest

    @any_thread
    def said(self) -> dict[str, str]:
        """Return the last reports of all loads that run, as texts, by the queries that wait for them."""
        reports = {id: shown_progress(*one.newest) for id, one in self.loads.copy().items()}
        if not reports:
            return {}
        with self._registrar.lock:
            catalog = self._registrar.whole()
            waiting = {id: chain.from_iterable(_waiting(catalog, id).values()) for id in reports}
            return {query_id: reports[id] for id, query_ids in waiting.items() for query_id in query_ids}

    def greet(self, origin: str, query_id: str) -> None:
        """Send the newest report to a consumer that has just begun to wait for a load."""
        if self.loads:
            self._registrar.node.dispatcher.call(self._greet, origin, query_id)

    def end(self, resource_id: str) -> None:
        """Send the last report of a callback that has returned, and take no more of it."""
        reports = self.loads.pop(resource_id, None)
        if reports is not None and reports.unsent and not self._registrar.closed:
            self._send(resource_id, reports)

    def forget(self, resource_id: str) -> None:
        """Drop the reports of a load that waits in line no longer, and send so to all that wait."""
        self.loads.pop(resource_id, None)
        with self._registrar.lock:
            catalog = self._registrar.whole()
            resource, waiting = catalog.resources.get(resource_id), _waiting(catalog, resource_id)
        if resource is not None:
            for origin, query_ids in waiting.items():
                over = Progressed(query_ids, resource_id, resource.server, 0.0, "", in_line=True)
                self._registrar.consumers.hint(origin, over)
            self._registrar.consumers.flush()

    @any_thread
    def forget_sent(self, resource_id: str) -> bool:
        """Drop the reports of a callback that has returned. Return False if one has to be sent before the answer."""
        reports = self.loads.get(resource_id)
        if reports is not None and reports.unsent:
            return False
        self.loads.pop(resource_id, None)
        return True

    @any_thread
    def _want_turn(self, resource_id: str, reports: _Reports) -> None:
        try:
            reports.turn.pop()
        except IndexError:  # a turn is planned, and will find the report
            return
        with contextlib.suppress(Unavailable):  # the process is ending
            self._registrar.node.dispatcher.call(self._turn, resource_id, reports)

    def _turn(self, resource_id: str, reports: _Reports) -> None:
        if self._registrar.closed or self.loads.get(resource_id) is not reports:
            return
        if reports.unsent:
            if self._send(resource_id, reports):
                self._registrar.node.dispatcher.loop.call_later(INTERVAL_S, self._turn, resource_id, reports)
            else:  # a thread that outlived the callback has reported
                self.loads.pop(resource_id, None)
            return
        reports.turn.append(None)
        if reports.unsent:  # a report came after the check above
            self._want_turn(resource_id, reports)

    def _greet(self, origin: str, query_id: str) -> None:
        registrar = self._registrar
        if registrar.closed:
            return
        with registrar.lock:
            catalog = registrar.whole()
            resource_id = catalog.waiting.get(query_id) or parked_on(catalog, query_id) or ""
            resource = catalog.resources.get(resource_id)
        reports = self.loads.get(resource_id)
        if resource is not None and reports is not None and not reports.unsent:  # an unsent one will go to all
            registrar.consumers.hint(origin, _progressed([query_id], resource, *reports.newest, reports.has))
            registrar.consumers.flush()

    def _send(self, resource_id: str, reports: _Reports) -> bool:
        """Send the unsent report to all that wait, and return whether the load still runs.

        The report is taken under the lock: the callback's thread finds nothing unsent only after that, and then ends
        the load.
        """
        registrar = self._registrar
        with registrar.lock:
            catalog = registrar.whole()
            resource = catalog.resources.get(resource_id)
            loads = resource is not None and resource.phase in (Phase.LOADING, Phase.QUEUED)
            if resource is None or not (loads or resource_id in catalog.recovering):
                return False
            waiting = _waiting(catalog, resource_id)
            fraction, text = reports.unsent.pop()
        for origin, query_ids in waiting.items():
            registrar.consumers.hint(origin, _progressed(query_ids, resource, fraction, text, reports.has))
        registrar.consumers.flush()
        if registrar.node.watched:
            where = {"registrar": registrar.name, "server": catalog.origin_of(resource), "resource_id": resource_id}
            request = text_of_value(resource.request)
            facts = {"request": request, "fraction": fraction, "text": text}
            if title := registrar.title_of(resource):
                facts["title"] = title
            registrar.node.emit("progress", **where, **facts)
        return True


def _progressed(
    query_ids: list[str], resource: Resource, fraction: float, text: str, has: tuple[str, float | None] | None
) -> Progressed:
    facts = query_ids, resource.id, resource.server, fraction, text
    return Progressed(*facts) if has is None else Progressed(*facts, True, *has)


def _waiting(catalog: Catalog, resource_id: str) -> dict[str, list[str]]:
    """Return the queries whose loads wait for a resource, by the registrar that holds them."""
    waiting: dict[str, list[str]] = {}
    for query_id in catalog.holders.get(resource_id, ()):
        if query_id in catalog.waiting:
            waiting.setdefault(catalog.queries[query_id].origin, []).append(query_id)
    for parked in catalog.recovering.get(resource_id, ()):
        if isinstance(parked, Load):
            waiting.setdefault(parked.origin, []).append(parked.query_id)
    return waiting


class ProgressListeners:
    """The listeners of a consumer to the loads that it waits for. add() and forget() from any thread.

    A consumer that begins to wait may get a report twice: as the newest one, and as one that is sent to all. The
    listener hears it once.

    Attributes:
        places: by query whose load waits in line, what was said last of its place. Any thread may take one out.
    """

    def __init__(self) -> None:
        self.places: dict[str, Progressed] = {}
        self._by_query: dict[str, Callable[[Progress], None]] = {}
        self._heard: dict[str, Progress] = {}

    def add(self, query_id: str, listener: Callable[[Progress], None]) -> None:
        """Have the listener called on the loop for each report about a load. It must be quick."""
        self._by_query[query_id] = listener

    def forget(self, query_id: str) -> None:
        """Drop the listener of a load that has ended."""
        self._by_query.pop(query_id, None)
        self._heard.pop(query_id, None)

    def queries(self) -> set[str]:
        """Return the queries whose loads are listened to."""
        return {*self._by_query, *self._heard}

    def place(self, message: Progressed, query_ids: Iterable[str]) -> None:
        """Note the place in line of loads that wait."""
        for query_id in query_ids:
            if message.text:
                self.places[query_id] = message
            else:
                self.places.pop(query_id, None)

    @on_loop
    def hear(self, provider: str, message: Progressed) -> None:
        """Call the listeners for a report that has arrived."""
        if not self._by_query or (message.in_line and not message.text):  # it waits in line no longer
            return
        progress = Progress(message.fraction, message.text, f"{provider}/{message.server}", message.resource_id)
        for query_id in message.query_ids:
            listener = self._by_query.get(query_id)
            if listener is not None and self._heard.get(query_id) != progress:
                self._heard[query_id] = progress
                listener(progress)
                if query_id not in self._by_query:  # another thread has just forgotten it
                    self._heard.pop(query_id, None)
