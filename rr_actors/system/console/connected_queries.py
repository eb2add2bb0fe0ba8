"""The queries of a connected program: the news of them, how they end with the system, and how they come back.

A thread of each registrar waits for statuses. When the system ends, the thread ends the registrar's queries. With
`rr.connect(reconnect=True)` it opens the registrar in the next run of the system, and has its queries loaded again.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import inspect
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from rr_actors.base.errors import (
    NotRunning,
    ResourceLost,
    RrError,
    Unavailable,
    UnknownQuery,
    UnknownRegistrar,
    UnknownServer,
    shortened,
)
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.arguments import LoadOptions
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Response, Status, StatusCallback, StatusCallbacks, end, hear, received
from rr_actors.runtime.callback_errors import described, log_raised
from rr_actors.runtime.user_loop import CallersLoop
from rr_actors.system.console.console_commands import OpenRegistrar
from rr_actors.system.console.console_connection import GREETING_S, Connections, ConsoleConnection, find_console
from rr_actors.system.console.console_messages import Dropped, Heard, Holding, Welcome

logger = Log("rr_actors")

ENDED, AGAIN = "ended", "reconnected"
"""The reasons of the statuses of a connection's query when the system has ended, and when its next run holds it."""

_ANSWER_S = 60.0  # for a request that has no time limit of its own


class SystemConnections(Connections):
    """The connections to one run of a system. When it has ended, each call says so in the same words.

    Args:
        run_dir: of the run.
        reconnects: connect to the next run when this one has ended.

    Attributes:
        welcome: what the system has said of itself; None before the first connection.
        ended: the error that says that the system has ended, once that is known, and until there is a next run.
    """

    def __init__(self, run_dir: Path, *, reconnects: bool) -> None:
        self._state_dir = run_dir.parent.parent
        super().__init__(functools.partial(find_console, self._state_dir) if reconnects else lambda: run_dir, _ANSWER_S)
        self.reconnects = reconnects
        self.welcome: Welcome | None = None
        self.ended: NotRunning | None = None

    def open(self, greeting_s: float = GREETING_S) -> ConsoleConnection:
        """Return a new connection, as Connections.open() does."""
        if self.ended is not None and not (self.is_closed or self.reconnects):
            raise self.has_ended()
        try:
            opened = super().open(greeting_s)
        except NotRunning as error:
            if self.welcome is None or self.is_closed:
                raise
            raise self.has_ended() from error
        self.welcome, self.ended = opened.welcome, None
        return opened

    @contextmanager
    def lent(self, greeting_s: float = GREETING_S) -> Generator[ConsoleConnection]:
        """Lend a connection, as Connections.lent() does."""
        if self.reconnects:
            self.drop_ended()
        with super().lent(greeting_s) as connection:
            try:
                yield connection
            except NotRunning as error:
                if self.is_closed or not connection.has_ended:  # an actor that was asked may raise it, too
                    raise
                raise self.has_ended() from error

    def has_ended(self) -> NotRunning:
        """Return the error that says that the system has ended, and note that it has."""
        then = "this connection waits for its next run" if self.reconnects else "connect to its next run"
        self.ended = NotRunning(f"the system in {self._state_dir} has ended: {then}")
        return self.ended


class ConnectedQuery(Query[Response]):
    """A connection's hold on one resource: a Query. As a context manager it is released at the end.

    Statuses reach it a moment later than a query of the application. A class in a response of which no type is known
    is read as a dict. After a restart of the system, a connection that reconnects holds the resource again, or one that
    was loaded for the same request: `id` stays, `resource_id` and `response` are the new ones.
    """

    __slots__ = ("_asked", "_given", "_held_as", "_lost")

    _lost: RrError | None

    def __init__(self, place: tuple[Any, ...], given: bytes, asked: LoadOptions) -> None:
        super().__init__(*place)
        self._held_as = self.id
        self._given, self._asked = given, asked
        self._lost = None

    def _lose(self, error: RrError | None) -> None:
        """Note that the system has ended: what waits for a frame raises the error. None: it is held again."""
        self._lost = error

    def _hold_again(self, held: Holding) -> None:
        """Note that the system's next run holds it."""
        self._held_as, self._resource_id = held.query_id, held.resource_id
        self._lose(None)

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
        return f"<ConnectedQuery {self.id} of {self.origin} on {self.server_id}>"


_EARLY = 1000


# For this package's own modules. As private names they stay out of an editor's list of names.
lose = ConnectedQuery._lose  # pyright: ignore[reportPrivateUsage]  # same file
hold_again = ConnectedQuery._hold_again  # pyright: ignore[reportPrivateUsage]


def is_lost(query: ConnectedQuery) -> bool:
    """Return whether the system has ended while the query was held, and its next run does not hold it."""
    return query._lost is not None  # pyright: ignore[reportPrivateUsage]  # same file


def asked_with(query: ConnectedQuery) -> tuple[bytes, LoadOptions]:
    """Return the request's canonical bytes, and the options of the load."""
    return query._given, query._asked  # pyright: ignore[reportPrivateUsage]  # same file


def held_as(query: ConnectedQuery) -> str:
    """Return the id by which the system's present run holds the query."""
    return query._held_as  # pyright: ignore[reportPrivateUsage]  # same file


class ConnectedViews:
    """The queries that a connection's registrar holds, and the status callbacks. Statuses are passed on one by one.

    Args:
        is_open: returns whether the connection has the registrar open. When it has not, no callback begins any more.
        is_connected: returns whether the system's side is open, too. When it is not, the one status that a callback
            still hears is that the system has ended.
    """

    def __init__(self, is_open: Callable[[], bool], is_connected: Callable[[], bool]) -> None:
        self.is_open = is_open
        self._is_connected = is_connected
        self._lock = threading.Lock()
        self._held: dict[str, ConnectedQuery] = {}
        self.callbacks = StatusCallbacks(self._hears, set())
        self._again: dict[str, ConnectedQuery] = {}  # those held after a restart of the system, by their new ids
        self._loads = 0  # in flight
        self._early: dict[str, list[Heard | Dropped]] = {}  # of loads whose answers have not been read yet
        self._news: deque[Callable[[], None]] = deque()  # what is to be passed on
        self._passing_on = threading.Lock()

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

    def add(self, query: ConnectedQuery, options: LoadOptions) -> None:
        """Have statuses reach a query and its callback."""
        own = None if options.on_status is None else described(options.on_status, "load: on_status")
        with self._lock:
            self._held[query.id] = query
            self.callbacks.set(query.id, own, options.loop)
            self._take_early(query, query.id)
        self.pass_on()

    def find(self, query_id: str) -> ConnectedQuery | None:
        """Return the query of this id that is held; None else."""
        return self._held.get(query_id)

    def held_as(self, query_id: str) -> str:
        """Return the id by which the system's present run holds a query."""
        query = self._held.get(query_id)
        return query_id if query is None else held_as(query)

    def reprioritized(self, query_id: str, priority: int | None) -> None:
        """Note the priority of a query, for the load after a restart."""
        if (query := self._held.get(query_id)) is not None:
            query._asked = replace(query._asked, priority=priority)  # pyright: ignore[reportPrivateUsage]  # same file

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
                self._again.pop(held_as(query), None)
                self.callbacks.drop(query.id)
        for query in gone:
            end(query)

    def hear(self, heard: Heard | Dropped) -> None:
        """Pass a status on to its query, and to the callbacks; or end a query that its registrar has released."""
        with self._lock:
            held = self._held.get(heard.query_id) or self._again.get(heard.query_id)
            if held is None:
                if self._loads:
                    self._early.setdefault(heard.query_id, []).append(heard)
                    if len(self._early) > _EARLY:  # the oldest is of a query that was released meanwhile
                        del self._early[next(iter(self._early))]
                return
            self._take(held, heard)
        self.pass_on()

    def pass_on(self) -> None:
        """Pass on what waits for that, unless another thread does it now: callbacks run one after the other."""
        while self._news and self._passing_on.acquire(blocking=False):
            try:
                while self._news:
                    self._news.popleft()()
            finally:
                self._passing_on.release()

    def _take_early(self, query: ConnectedQuery, id: str) -> None:
        for heard in self._early.pop(id, ()):
            self._take(query, heard)

    def _take(self, query: ConnectedQuery, heard: Heard | Dropped) -> None:
        if isinstance(heard, Dropped):
            self._news.append(functools.partial(self.forget, query.id, ""))
        else:
            status = status_heard(replace(heard, query_id=query.id))
            self._news.append(lambda: self._tell(query, status, heard.response, released=heard.released))

    def end(self) -> None:
        """Forget all queries, after what waits to be passed on."""
        self._news.append(lambda: self.forget("", ""))
        self.pass_on()

    def lost(self, error: RrError) -> None:
        """End all queries, as the system has ended: each hears FATAL, and its calls raise the error."""
        for query in self._all():
            self.give_up(query, error)

    def give_up(self, query: ConnectedQuery, error: RrError) -> None:
        """End a query that the system's next run does not hold, if there is one: it hears FATAL."""
        lose(query, error)
        self._say(query, State.FATAL, error.message, ENDED, released=True)
        self._news.append(lambda: self.forget(query.id, ""))
        self.pass_on()

    def away(self, error: NotRunning) -> None:
        """Have all queries wait for the system's next run: each hears ERROR, and its loops raise the error."""
        for query in self._all():
            lose(query, error)
            self._say(query, State.ERROR, error.message, ENDED)
        self.pass_on()

    def all_away(self) -> list[ConnectedQuery]:
        """Return the queries that wait for the system's next run, the oldest first."""
        return list(filter(is_lost, self._all()))

    def is_away(self, query_id: str) -> bool:
        """Return whether a query waits for the system's next run."""
        return (query := self._held.get(query_id)) is not None and is_lost(query)

    def hold_again(self, query: ConnectedQuery, held: Holding) -> bool:
        """Note that the system's next run holds a query, which hears so with the next pass_on().

        Return False if the query was released meanwhile, or is held by an earlier call.
        """
        with self._lock:
            if self._held.get(query.id) is not query or not is_lost(query):
                return False
            self._again.pop(held_as(query), None)
            hold_again(query, held)
            self._again[held.query_id] = query
            self._say(query, held.state, "the system has been started again, and holds it", AGAIN, held.response)
            self._take_early(query, held.query_id)
        return True

    def _all(self) -> list[ConnectedQuery]:
        with self._lock:
            return list(self._held.values())

    def _say(
        self,
        query: ConnectedQuery,
        state: State,
        text: str,
        reason: str,
        response: bytes | None = None,
        *,
        released: bool = False,
    ) -> None:
        place = {"resource_id": query.resource_id, "query_id": query.id, "source": query.server_id}
        status = Status(state, text, repeated=False, **place)
        status.reason = reason
        self._news.append(lambda: self._tell(query, status, response, released=released))

    def _tell(self, query: ConnectedQuery, status: Status, response: bytes | None, *, released: bool) -> None:
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
    """Return the status that has reached a connection's query."""
    place = {"resource_id": heard.resource_id, "query_id": heard.query_id, "source": heard.source}
    status = Status(heard.state, heard.message, repeated=heard.repeated, **place)
    status.reason, status.deadline_s = heard.reason, heard.deadline_s
    return status


async def _await(answer: Awaitable[object]) -> None:
    await answer


# -- the connection of a registrar, and the one after a restart ------------------------------------------------------

_RETRY_S = 0.1  # between two looks for the next run, or for a manager that starts
_AT_ONCE = 8  # loads of one registrar after a restart

Load = Callable[[ConnectedQuery], None]
"""Loads the resource of a query again."""


class Lifeline:
    """The socket by which a registrar is open in the system; another one after each restart.

    Args:
        wanted: the name that the registrar is opened with.

    Attributes:
        name: the registrar's name in the system.
    """

    def __init__(self, connections: SystemConnections, wanted: str) -> None:
        self.connections = connections
        self._wanted = wanted
        self._closed = threading.Event()
        self._is_away = False
        self.name = ""
        self.socket = self._opened()

    @property
    def is_closed(self) -> bool:
        """Whether the registrar was closed here."""
        return self._closed.is_set() or self.connections.is_closed

    def is_open(self) -> bool:
        """Return whether the system's side is open, too."""
        return self.socket.is_open()

    def check_here(self) -> None:
        """Raise NotRunning while the registrar waits for the next run of the system."""
        if self._is_away:
            raise self.connections.has_ended()

    def reopened(self) -> bool:
        """Wait for the next run of the system, and open the registrar there. Return False if it was closed here.

        Raises:
            RrError: the next run refuses it: another connection has the name, say.
        """
        self._is_away = True
        while not self._closed.wait(_RETRY_S) and not self.connections.is_closed:
            try:
                self.socket = self._opened()
            except Unavailable:  # NotRunning is one
                continue
            self._is_away = False
            if self._closed.is_set():
                self.socket.close()
                break
            return True
        return False

    def close(self) -> None:
        """Close the registrar, whose queries are released a moment later. A second close does nothing."""
        self._closed.set()
        self.socket.close()

    def _opened(self) -> ConsoleConnection:
        opened = self.connections.open()
        try:
            self.name = opened.ask(OpenRegistrar(self._wanted)).facts["registrar"]
        except BaseException:
            opened.close()
            raise
        return opened


def listen(
    lifeline: Lifeline, views_of: Callable[[], ConnectedViews | None], load_of: Callable[[], Load | None]
) -> None:
    """Pass on the statuses of a registrar, until it is closed or nobody has it any more. In a thread of its own.

    Args:
        views_of, load_of: return None once nobody has the registrar.
    """
    while (ended := _until_its_end(lifeline, views_of)) is not None:
        if (views := views_of()) is None or not views.is_open():
            break
        if not lifeline.connections.reconnects:
            views.lost(ended)
            break
        views.away(ended)
        del views
        try:
            if not lifeline.reopened():
                break
        except RrError as refused:
            if (views := views_of()) is not None:
                views.lost(refused)
            break
        if (load := load_of()) is not None:
            _load_again(views_of, load)
        del load
    if (views := views_of()) is not None:
        views.end()


def _until_its_end(lifeline: Lifeline, views_of: Callable[[], ConnectedViews | None]) -> NotRunning | None:
    """Pass on statuses until the system ends, and return the error that says so; None: the registrar was closed."""
    try:
        while True:
            statuses = lifeline.socket.wait_statuses(lifeline.name)
            views = views_of()
            if views is None:
                return None
            for heard in statuses:
                views.hear(heard)
            del views  # while it waits, the registrar may be collected
    except NotRunning as error:
        logger.debug("registrar %s hears no more statuses: %s", lifeline.name, error)
        return None if lifeline.is_closed else lifeline.connections.has_ended()
    except RrError as error:  # the registrar was closed in the system
        logger.debug("registrar %s hears no more statuses: %s", lifeline.name, error)
        return None


def _load_again(views_of: Callable[[], ConnectedViews | None], load: Load) -> None:
    """Have threads load all that the registrar held, the oldest first."""
    views = views_of()
    if views is None:
        return

    def one(query: ConnectedQuery) -> None:
        try:
            _patiently(load, query)
        except NotRunning:
            return  # it has ended again: the thread that listens waits for the run after that
        except RrError as error:
            text = f"{query.server_id}: it cannot be loaded again after a restart of the system: {error.message}"
            views.give_up(query, ResourceLost(text, query_id=query.id, resource_id=query.resource_id))

    left = deque(views.all_away())

    def work() -> None:
        with contextlib.suppress(IndexError):  # none is left
            while True:
                one(left.popleft())

    for _ in range(min(_AT_ONCE, len(left))):
        threading.Thread(target=work, name="rr-reconnect", daemon=True).start()


def _patiently(load: Load, query: ConnectedQuery) -> None:
    """Load, also if the manager is not there yet: the system may still be starting."""
    limit_s = asked_with(query)[1].timeout_s
    deadline = None if limit_s is None else time.monotonic() + limit_s
    while True:
        try:
            return load(query)
        except NotRunning:
            raise
        except (UnknownRegistrar, UnknownServer, Unavailable):
            if deadline is not None and time.monotonic() > deadline:
                raise
        time.sleep(_RETRY_S)
