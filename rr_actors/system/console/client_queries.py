"""The queries of a client: the news of them that the system sends, and how they end with it."""

from __future__ import annotations

import asyncio
import inspect
import threading
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rr_actors.base.errors import NotRunning, RrError, UnknownQuery, shortened
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.arguments import LoadOptions
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Response, Status, StatusCallback, StatusCallbacks, end, hear, received
from rr_actors.runtime.callback_errors import described, log_raised
from rr_actors.runtime.user_loop import CallersLoop
from rr_actors.system.console.console_client import GREETING_S, Connections, ConsoleClient
from rr_actors.system.console.console_messages import Dropped, Heard

logger = Log("rr_actors")

ENDED = "ended"
"""The reason of the last status of a client's query, when the system has ended."""

_ANSWER_S = 60.0  # for a request that has no time limit of its own


class SystemConnections(Connections):
    """The connections to one run of a system. When it has ended, each call says so in the same words.

    Attributes:
        ended: the error that says that the system has ended, once that is known.
    """

    def __init__(self, run_dir: Path) -> None:
        super().__init__(lambda: run_dir, _ANSWER_S)
        self._state_dir = run_dir.parent.parent
        self._was_there = False
        self.ended: NotRunning | None = None

    def open(self, greeting_s: float = GREETING_S) -> ConsoleClient:
        """Return a new connection, as Connections.open() does."""
        if self.ended is not None and not self.is_closed:
            raise self.has_ended()
        try:
            opened = super().open(greeting_s)
        except NotRunning as error:
            if not self._was_there or self.is_closed:
                raise
            raise self.has_ended() from error
        self._was_there = True
        return opened

    @contextmanager
    def lent(self, greeting_s: float = GREETING_S) -> Generator[ConsoleClient]:
        """Lend a connection, as Connections.lent() does."""
        try:
            with super().lent(greeting_s) as client:
                yield client
        except NotRunning as error:
            if self.is_closed or error is self.ended:
                raise
            raise self.has_ended() from error

    def has_ended(self) -> NotRunning:
        """Return the error that says that the system has ended, and note that it has."""
        self.ended = NotRunning(f"the system in {self._state_dir} has ended: connect to its next run")
        return self.ended


class ClientQuery(Query[Response]):
    """A client's hold on one resource: a Query. As a context manager it is released at the end.

    Statuses reach it a moment later than a query of the application. A class in a response of which no type is known
    is read as a dict.
    """

    __slots__ = ("_lost",)

    _lost: NotRunning | None

    def __init__(self, *place: Any) -> None:
        super().__init__(*place)
        self._lost = None

    def _lose(self, error: NotRunning) -> None:
        """Note that the system has ended: what waits for a status or a frame raises the error."""
        self._lost = error

    def _silence(self) -> RrError:
        return super()._silence() if self._lost is None else self._lost

    def _is_over(self) -> bool:
        """Return whether it is released; raise NotRunning if the system has ended, ResourceLost if it is lost."""
        if self._lost is not None:
            raise self._lost
        return super()._is_over()

    def _may_be_gone(self) -> bool:
        """Return True: that the provider has taken the resource away may be known in the system first."""
        return True

    def __repr__(self) -> str:
        return f"<ClientQuery {self.id} of {self.origin} on {self.server_id}>"


_EARLY = 1000


# For this package's own modules. As private names they stay out of an editor's list of names.
lose = ClientQuery._lose  # pyright: ignore[reportPrivateUsage]  # same file


def is_lost(query: ClientQuery) -> bool:
    """Return whether the system has ended while the query was held."""
    return query._lost is not None  # pyright: ignore[reportPrivateUsage]  # same file


class ClientViews:
    """The queries that a client's registrar holds, and the status callbacks. One thread passes the statuses on.

    Args:
        is_open: returns whether the client has the registrar open. When it has not, no callback begins any more.
        is_connected: returns whether the system's side is open, too. When it is not, the one status that a callback
            still hears is that the system has ended.
    """

    def __init__(self, is_open: Callable[[], bool], is_connected: Callable[[], bool]) -> None:
        self.is_open = is_open
        self._is_connected = is_connected
        self._lock = threading.Lock()
        self._held: dict[str, ClientQuery] = {}
        self.callbacks = StatusCallbacks(self._hears, set())
        self._loads = 0  # in flight
        self._early: dict[str, list[Heard | Dropped]] = {}  # of loads whose answers have not been read yet

    @contextmanager
    def loading(self) -> Generator[None]:
        """Keep news of unknown queries within the `with` block: they may be of the load that it makes."""
        with self._lock:
            self._loads += 1
        try:
            yield
        finally:
            with self._lock:
                self._loads -= 1
                if not self._loads:
                    self._early.clear()

    def add(self, query: ClientQuery, options: LoadOptions) -> None:
        """Have statuses reach a query and its callback."""
        own = None if options.on_status is None else described(options.on_status, "load: on_status")
        with self._lock:
            self._held[query.id] = query
            self.callbacks.set(query.id, own, options.loop)
            early = self._early.pop(query.id, [])
        for heard in early:
            self.hear(heard)

    def find(self, query_id: str) -> ClientQuery | None:
        """Return the query of this id that is held; None else."""
        return self._held.get(query_id)

    def set_callback(self, query_id: str, callback: StatusCallback | None, loop: CallersLoop | None) -> None:
        """Replace the status callback of a query.

        Raises:
            UnknownQuery: the query is not held any more.
        """
        with self._lock:
            if query_id not in self._held:
                text = f"query {shortened(query_id)}: this registrar does not hold it any more"
                raise UnknownQuery(text, query_id=query_id)
            self.callbacks.set(query_id, callback, loop)

    def forget(self, query_id: str, server: str) -> None:
        """Forget a query that is released; or all at a server; or all."""
        with self._lock:
            held = self._held.values()
            gone = [one for one in held if query_id in ("", one.id) and server in ("", one.server_id)]
            for query in gone:
                del self._held[query.id]
                self.callbacks.drop(query.id)
        for query in gone:
            end(query)

    def hear(self, heard: Heard | Dropped) -> None:
        """Pass a status on to its query, and to the callbacks; or end a query that its registrar has released."""
        with self._lock:
            held = self._held.get(heard.query_id)
            if held is None:
                if self._loads:
                    self._early.setdefault(heard.query_id, []).append(heard)
                    if len(self._early) > _EARLY:  # the oldest is of a query that was released meanwhile
                        del self._early[next(iter(self._early))]
                return
        if isinstance(heard, Dropped):
            self.forget(heard.query_id, "")
        else:
            self._tell(held, status_heard(heard), heard.response, released=heard.released)

    def lost(self, error: NotRunning) -> None:
        """End all queries, as the system has ended: each hears FATAL, and its calls raise the error."""
        with self._lock:
            held = list(self._held.values())
        for query in held:
            place = {"resource_id": query.resource_id, "query_id": query.id, "source": query.server_id}
            status = Status(State.FATAL, error.message, repeated=False, **place)
            status.reason = ENDED
            lose(query, error)
            self._tell(query, status, None, released=True)
        self.forget("", "")

    def _tell(self, query: ClientQuery, status: Status, response: bytes | None, *, released: bool) -> None:
        hear(query, received(status, self.find), response, released=released)
        for listener in self.callbacks.of(query.id, query.server_id):
            try:
                if inspect.isawaitable(answer := self.callbacks.beginning(query.id, listener)(status)):
                    asyncio.run(_await(answer))
            except Exception as error:
                log_raised(logger, error, "a status callback for %s raised", query.server_id)

    def _hears(self, query_id: str) -> bool:
        if (held := self._held.get(query_id)) is None or not self.is_open():
            return False
        return is_lost(held) or self._is_connected()


def status_heard(heard: Heard) -> Status:
    """Return the status that has reached a client's query."""
    place = {"resource_id": heard.resource_id, "query_id": heard.query_id, "source": heard.source}
    status = Status(heard.state, heard.message, repeated=heard.repeated, **place)
    status.reason, status.deadline_s = heard.reason, heard.deadline_s
    return status


def listen(
    lifeline: ConsoleClient, name: str, connections: SystemConnections, views_of: Callable[[], ClientViews | None]
) -> None:
    """Pass on the statuses of a registrar, until it is closed or nobody has it any more. In a thread of its own."""
    ended = False
    try:
        while True:
            statuses = lifeline.wait_statuses(name)
            views = views_of()
            if views is None:
                return
            for heard in statuses:
                views.hear(heard)
            del views  # while it waits, the registrar may be collected
    except NotRunning as error:
        ended = not connections.is_closed
        logger.debug("registrar %s hears no more statuses: %s", name, error)
    except RrError as error:  # the registrar was closed in the system
        logger.debug("registrar %s hears no more statuses: %s", name, error)
    if (views := views_of()) is not None:
        if ended and views.is_open():
            views.lost(connections.has_ended())
        views.forget("", "")


async def _await(answer: Awaitable[object]) -> None:
    await answer
