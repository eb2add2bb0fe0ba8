"""connect(): a connection to a running system, for any other process of the same user, a worker of a pool, a notebook.

It speaks with the system's console, has no key of the system, and opens no pickle but the frames of streams.
Registrars in the application's process hold its queries. Each registrar has a socket of its own, which ends with the
connection.
"""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, wait
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import (
    InvalidRequest,
    LoadTimeout,
    NotRunning,
    NotSerializable,
    RrError,
    Unavailable,
    UnknownQuery,
    UsageError,
    is_a,
)
from rr_actors.base.names import ServerId, parse_server_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.arguments import (
    LoadOptions,
    Parent,
    callers_loop,
    checked_callback,
    checked_priority,
    state_path,
    status_callback,
    target_id,
)
from rr_actors.registrar.declarations import Declared, declaring
from rr_actors.registrar.load_groups import GroupWays, LoadWanted, Queries, note_request
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.pages import QueryRow
from rr_actors.registrar.queries import Holder, Query, StatusCallback, loaded_directly, read_as, was_given
from rr_actors.registrar.registrar import Consumer
from rr_actors.registrar.remote_registrar import RemoteCalls, RemoteGroup, RemoteLoads, RemoteUnloads
from rr_actors.runtime.time_limits import deadline_of, left_until, time_limit
from rr_actors.system.backups import WRITING_S, Backup, read_backup
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.asking.connected_proxies import GRACE_S, ConnectedProxy, in_thread
from rr_actors.system.console.asking.waiting import waited_for
from rr_actors.system.console.connected_queries import (
    ConnectedQuery,
    ConnectedViews,
    Lifeline,
    Load,
    SystemConnections,
    asked_with,
    listen,
)
from rr_actors.system.console.console_commands import AskActor, BackUp, GivePriority, Hold, Release
from rr_actors.system.console.console_connection import GREETING_S, find_console
from rr_actors.system.console.console_messages import TIMEOUT_LIMIT_S, VALUE_LIMIT_BYTES
from rr_actors.system.console.console_questions import Find, FindServer, HasAllStreams

T = TypeVar("T")

logger = Log("rr_actors")

_RETRY_S = 0.05  # between two looks for a system that is awaited


class Connection:
    """A connection to a running system. connect() makes it; a context manager closes it at the end. From any thread.

    When the system ends, each query of its registrars hears FATAL with the reason "ended", and calls raise NotRunning.
    With `reconnect=True` it hears ERROR, and calls raise NotRunning until the system's next run.

    Attributes:
        system: the system's name.
        state_dir: its state directory.
    """

    def __init__(self, run_dir: Path, *, reconnect: bool = False) -> None:
        self._connections = SystemConnections(run_dir, reconnects=reconnect)
        with self._connections.lent() as socket:
            welcome = socket.welcome
        self.system = welcome.system
        self.state_dir = Path(welcome.state_dir)

    @property
    def pid(self) -> int:
        """The id of the system's process, or of the last one that this connection has met."""
        assert self._connections.welcome is not None
        return self._connections.welcome.pid

    @property
    def ended(self) -> NotRunning | None:
        """The error that says that the system has ended; None while it runs, or if this side was closed first."""
        if self._connections.ended is None or self._connections.reconnects:
            try:
                self._connections.open().close()
            except NotRunning:
                pass  # it is noted, unless this connection is closed
            except Unavailable:
                return None  # it runs, and is busy
        return self._connections.ended

    def open_registrar(self, name: str | None = None) -> ConnectedRegistrar:
        """Open a registrar for this connection, whose end closes it and releases its queries.

        Args:
            name: the registrar's name, before which the system puts "connection."; None: "pid-" and this
                process's id.

        Raises:
            NameTaken: another connection has this name.
            InvalidName: the name has characters that no name may have.
            NotRunning: the system has ended.
        """
        return ConnectedRegistrar(self._connections, f"pid-{os.getpid()}" if name is None else name)

    def ask(self, actor: str, message: Any, *, timeout_s: float | None = 30.0) -> Any:
        """Ask an actor of the system, and return its answer. Both are plain data, as requests are (docs/values.md).

        The handler sees who asks as `rr.current().origin`: "connection.pid-" and the number of this process.

        Args:
            actor: its id or its path, as for System.ref().

        Raises:
            NotFound: there is no such actor.
            NotSerializable: the message or the answer is no plain data, or too long (as for load()).
            AskFailed: its handler raised; an error of this package keeps its class.
            Unavailable: it has not answered in time, or is being started again.
        """
        return _asked(self._connections, actor, message, timeout_s)

    def proxy(self, actor: str, *, timeout_s: float | None = 30.0) -> ConnectedProxy:
        """Return an object whose methods are those of an actor of the system; each call returns a future.

        Args:
            actor: its id or its path, as for System.ref().
            timeout_s: how long each call may take. None: a day.
        """
        return ConnectedProxy(self._connections, actor, _limit(timeout_s))

    def wait_for(self, id: str, state: str = "", *, timeout_s: float | None = 30.0) -> str:
        """Wait until a child or a resource is in a state, as System.wait_for() does, with its errors."""
        seen = waited_for(self._connections.open, id, state, timeout_s)
        self._connections.check_open()  # else all seemed gone
        return seen

    def backup(self, directory: str | os.PathLike[str], *, timeout_s: float = 30.0) -> Backup:
        """Have the system back itself up to a directory of its machine, as System.backup() does, with its errors."""
        limit_s = _limit(timeout_s)
        path = Path(os.path.abspath(os.path.expanduser(directory)))
        self._connections.ask(BackUp(str(path), limit_s), limit_s + WRITING_S)
        return read_backup(path)

    def close(self) -> None:
        """Close all registrars. Their queries are released soon after. A second close does nothing."""
        self._connections.close("the connection is closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Connection of {self.system} (pid {self.pid}) in {self.state_dir}>"


class _Given(bytes):
    """The canonical bytes of a request, with the request as the caller gave it."""

    value: Any


NOT_FOR_CONNECTIONS = {
    "force": "only the application takes a resource away from its holders",
    "parent": "a connection serves nothing, so no resource of it can need another",
}
"""The options of a registrar's calls that a connection may not use, and why. It has no methods that serve or look."""


class _ConnectedCalls(RemoteCalls):
    """The calls of a connection's registrar: requests to the system's console, of plain data, never pickles."""

    def __init__(self, lifeline: Lifeline, views: ConnectedViews) -> None:
        super().__init__(lifeline.name)
        self.connections = lifeline.connections
        self.check_here = lifeline.check_here
        self.views = views

    def send(self, reply: Reply[Any], method: str, *args: Any, **options: Any) -> None:
        """Have a thread make the call."""
        in_thread(reply, lambda: self.ask(method, *args, **options))

    def ask(self, method: str, *args: Any, **options: Any) -> Any:
        """Release queries: one, those at a server, or all. In the calling thread."""
        _refuse(self.name, "force", options.get("force", False))
        limit_s = _limit(options["timeout_s"])
        query_id, server = ("", *args, "")[:2] if method == "unload_client" else ("".join(args), "")
        if not self.views.is_away(query_id):  # else the system has released it as it ended
            self.check_here()
            held_as = self.views.held_as(query_id)
            self.connections.ask(Release(self.name, held_as, server, limit_s), limit_s + GRACE_S)
        self.views.forget(query_id, server)

    def overdue(self, timeout_s: float | None) -> RrError:
        """Return the error of a load whose thread has not heard in time how it ended."""
        return _too_late(f"registrar {self.name!r}", timeout_s, "the system has not answered")

    def all_streams(self, query: Query[Any]) -> Callable[[], bool]:
        """Return a function for one reader, which has a thread ask the system once, and returns False until it knows.

        What a crash of the manager has made uncertain stays so.
        """
        asked: list[Reply[c.AllStreams]] = []

        def has_all() -> bool:
            if not asked:
                asked.append(Reply())
                held_as = self.views.held_as(query.id)
                in_thread(asked[0], lambda: self.connections.ask(HasAllStreams(self.name, held_as)))
            return asked[0].done() and asked[0].exception() is None and asked[0].get().are_open

        return has_all


class _ConnectedLoads(RemoteLoads):
    """The loads of a connection's registrar. Each call in flight has a thread and a socket."""

    def __init__(self, calls: _ConnectedCalls, holder: Holder) -> None:
        super().__init__(calls, holder)
        self._calls = calls

    def wait(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Query:
        """Load a resource in the calling thread."""
        self.check(options)
        return self._load(target, request, options)

    def send_load(
        self, reply: Reply[Query], target: ServerId, request: bytes, parent: str, options: LoadOptions
    ) -> None:
        """Have a thread load."""
        in_thread(reply, lambda: self._load(target, request, options))

    def send_all(
        self, reply: Reply[Queries], requests: Sequence[LoadWanted], parent: str, options: LoadOptions
    ) -> None:
        """Have threads load, and release what is held if one load fails."""
        in_thread(reply, lambda: self._load_all(requests, options))

    def own(self, query: Query, options: LoadOptions) -> Query:
        """Return the query, which is of this process."""
        return query

    def _load(self, target: ServerId, request: bytes, options: LoadOptions) -> Query:
        calls, limit_s = self._calls, _limit(options.timeout_s)
        deadline = deadline_of(limit_s + GRACE_S)
        calls.check_here()
        wait_s = None if options.wait_s is None else _limit(options.wait_s)
        command = Hold(calls.name, str(target), bytes(request), limit_s, options.priority, wait_s)
        query: ConnectedQuery | None = None
        try:
            # If the socket ends before keep(), the system releases the query.
            with calls.views.loading(), calls.connections.lent(min(GREETING_S, limit_s + GRACE_S)) as socket:
                held = socket.ask(command, left_until(deadline))
                server = parse_server_id(held.server) if held.server else target
                place = held.query_id, server, request, "", calls.name, self.holder, _shown_types, calls.all_streams
                query = ConnectedQuery(place, bytes(request), options)
                if options.codec is not None:
                    read_as(query, options.codec)
                loaded_directly(query, held.resource_id, held.response, held.state)
                was_given(query, getattr(request, "value", None))
                _ = query.response  # an error of its type is one of the load
                calls.views.add(query, options)
                socket.keep()
            return query
        except BaseException as error:  # also KeyboardInterrupt: the caller never gets the query
            if type(error) is Unavailable and time.monotonic() >= deadline:
                raise _too_late(str(target), options.timeout_s, str(error)) from error
            if query is not None:
                threading.Thread(target=self.release, args=(query,), name="rr-undo").start()
            raise

    def load_again(self, query: ConnectedQuery) -> None:
        """Load the resource of a query in the system's next run, if it is still wanted.

        Raises:
            RrError: it cannot be loaded.
        """
        calls, (request, options) = self._calls, asked_with(query)
        limit_s = _limit(options.timeout_s)
        command = Hold(calls.name, query.server_id, request, limit_s, options.priority)
        with calls.views.loading(), calls.connections.lent() as socket:
            if calls.views.is_away(query.id):
                held = socket.ask(command, limit_s + GRACE_S)
                if calls.views.hold_again(query, held):
                    socket.keep()
        calls.views.pass_on()

    def _load_all(self, requests: Sequence[LoadWanted], options: LoadOptions) -> Queries:
        sent: list[Reply[Query]] = []
        try:
            for target, request, _ in requests:
                sent.append(Reply())
                self.send_load(sent[-1], target, request, "", options)
            wait(sent, return_when=FIRST_EXCEPTION)
            for place, one in enumerate(sent):
                if one.done() and isinstance(one.exception(), RrError):
                    _raise_of(one, requests, place)
            return Queries(one.get() for one in sent)
        except BaseException:
            for one in reversed(sent):
                if one.done() and one.exception() is None:
                    self.release(one.get())
                else:
                    one.add_done_callback(self.release_later)
            raise


def _raise_of(one: Reply[Query], requests: Sequence[LoadWanted], place: int) -> None:
    try:
        one.take()
    except RrError as error:
        note_request(error, requests, place)
        raise


class ConnectedRegistrar(Consumer):
    """A connection's registrar: it loads, holds and releases, as Registrar does. A context manager closes it.

    Call it from any thread. A thread of its own runs the status callbacks, one after the other. A load without a time
    limit takes a day at most. Its calls raise two more errors than those of Registrar. NotRunning: the system has
    ended, or the connection is closed. NotSerializable: a request is over 900,000 bytes, or a response over 4 MiB.

    Attributes:
        name: the registrar's name in the system, "connection.NAME".
    """

    def __init__(self, connections: SystemConnections, name: str) -> None:
        self._connections = connections
        self._lifeline = lifeline = Lifeline(connections, name)
        self._name = lifeline.name
        self._views = ConnectedViews(lambda: not lifeline.is_closed, lifeline.is_open)
        calls = _ConnectedCalls(lifeline, self._views)
        self._connected_loads = _ConnectedLoads(calls, self)
        self._unload_ways = RemoteUnloads(calls)
        weakref.finalize(self, lifeline.close)  # else the thread would keep it open for ever
        listens = lifeline, weakref.ref(self._views), _loader(weakref.ref(self._connected_loads))
        threading.Thread(target=listen, args=listens, name="rr-statuses", daemon=True).start()

    @property
    def _load_ways(self) -> _ConnectedLoads:
        return self._connected_loads

    @property
    def name(self) -> str:
        """The registrar's name in the system, "connection.NAME"."""
        return self._name

    def _target(self, server: object, within_s: float | None = None) -> ServerId:
        if not is_a(server, Declared):
            return parse_server_id(server)
        place = declaring(cast("Declared[Any, Any, Any]", server))
        limit_s = GREETING_S if within_s is None else min(GREETING_S, within_s)
        return parse_server_id(self._connections.ask(FindServer(*place), limit_s).id)

    def _holder(self, parent: Parent | None) -> tuple[Consumer, str]:
        _refuse(self._name, "parent", parent is not None)
        return self, ""

    def _group(self, requests: Sequence[LoadWanted], parent: str, options: LoadOptions) -> GroupWays:
        return RemoteGroup(self._connected_loads, requests, parent, options)

    def _check_open(self) -> None:
        """Do nothing: a call of a closed connection raises NotRunning."""

    def _may_block(self) -> bool:
        return True

    @staticmethod
    def _encode(value: Any) -> bytes:
        given = _Given(_encoded(value, "request"))
        given.value = value
        return given

    def ask(self, actor: str, message: Any, *, timeout_s: float | None = 30.0) -> Any:
        """Ask an actor as Connection.ask() does. Its handler finds this registrar in `rr.current().origin`."""
        self._lifeline.check_here()
        return _asked(self._connections, actor, message, timeout_s, self._name)

    def set_on_status(self, query_or_id: Query | str, callback: StatusCallback | None) -> None:
        """Replace the status callback of a query of this registrar, as `query.on_status(callback)` does.

        Raises:
            UnknownQuery: the query is not held any more.
            UsageError: `callback` cannot be called with a status alone.
        """
        own = status_callback(callback, "on_status", "callback")
        self._views.set_callback(target_id(query_or_id), own, callers_loop(own))

    def _listen(self, server: str, id: str, callback: StatusCallback) -> None:
        self._views.callbacks.listen(server, id, checked_callback(callback))

    def _stop_listening(self, server: str, id: str) -> None:
        self._views.callbacks.stop(server, id)

    def queries(self) -> list[QueryRow]:
        """Return the queries that the registrar holds, each with the state of its last status.

        Raises:
            NotRunning: the system has ended.
            Unavailable: the registrar does not answer.
        """
        self._lifeline.check_here()
        with self._connections.lent() as socket:
            found = socket.queries(self.name)
        if found.notes:
            raise Unavailable(f"{self.name}: its queries are not known: {'; '.join(found.notes)}")
        return found.rows

    def fetch_state(self, query_or_id: Query | str) -> State:
        """Ask the system for the state of the last status of a query.

        Raises:
            UnknownQuery: the query is not held any more.
            NotRunning: the system has ended.
            Unavailable: the registrar does not answer, or the system's next run does not hold the query yet.
        """
        return State(self._row(target_id(query_or_id)).state)

    def fetch_priority(self, query_or_id: Query | str) -> int | None:
        """Ask the system for the priority of a query; None: on standby.

        Raises:
            UnknownQuery, NotRunning, Unavailable: as for fetch_state().
        """
        return self._row(target_id(query_or_id)).priority

    def set_priority(self, query_or_id: Query | str, priority: int | None) -> None:
        """Give a query of this registrar a priority, as `query.priority = 5` does.

        Raises:
            UsageError: as for Registrar.set_priority().
            UnknownQuery, NotRunning, Unavailable: as for fetch_state().
        """
        given, id = checked_priority(priority, "set_priority"), target_id(query_or_id)
        self._connections.ask(GivePriority(self._row(id).id, given))
        self._views.reprioritized(id, given)

    def _row(self, id: str) -> QueryRow:
        self._lifeline.check_here()
        if self._views.is_away(id):
            raise Unavailable(f"query {id}: it is being loaded again, as the system has been started again")
        held_as = self._views.held_as(id)
        found = self._connections.ask(Find(held_as, self.name))
        for row in found.queries:
            if row.id == held_as and row.hold != "owed":
                return row
        if found.notes:
            raise Unavailable(f"query {id}: nothing is known of it: {'; '.join(found.notes)}")
        raise UnknownQuery(f"query {id}: {self.name} does not hold it any more", query_id=id)

    def close(self) -> None:
        """Close the registrar, whose queries are released a moment later. A second close does nothing."""
        self._lifeline.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ConnectedRegistrar {self.name}>"


def _loader(loads_of: Callable[[], _ConnectedLoads | None]) -> Callable[[], Load | None]:
    def load() -> Load | None:
        loads = loads_of()
        return None if loads is None else loads.load_again

    return load


class _ShownPlain(Codec):
    """Decodes as far as the types are known here."""

    def decode(self, raw: bytes, server: str = "", what: str = "request") -> Any:
        """Return the value of these bytes; a class that is not known is read as a dict."""
        return _any.show(raw)


_any = Codec(None, "response")
_plain = _ShownPlain(None, "response")


def _shown_types(_server_id: str) -> tuple[Codec, Codec]:
    return _plain, _plain


def connect(
    state_dir: str | os.PathLike[str] | None = None, *, wait_s: float | None = 0.0, reconnect: bool = False
) -> Connection:
    """Return a connection to a running system of this user, in this process or another.

    Args:
        state_dir: the system's state directory; None: the one that RR_STATE names, or else of the one running system.
        wait_s: how many seconds to wait for a system that does not run yet, or is being started again; None: no limit.
        reconnect: when the system has ended, wait for its next run. The registrars are opened there, and their queries
            load again. Each hears ERROR with the reason "ended". Later it hears a status with the reason "reconnected".
            If it cannot be loaded again, it hears FATAL, with a message that says why.

    Raises:
        NotRunning: no system runs, or it has no console, also not within `wait_s`.
        UsageError: several systems run; the error names them.
        Unavailable: the system is another user's, or of another version.
        ConfigError: state_dir is no path, or cannot be read.
    """
    place = state_dir if state_dir is not None else os.environ.get("RR_STATE")
    limit_s = time_limit(wait_s)
    deadline = None if limit_s is None else time.monotonic() + limit_s
    while True:
        try:
            return Connection(find_console(None if place is None else state_path(place)), reconnect=reconnect)
        except NotRunning:
            if deadline is not None and time.monotonic() >= deadline:
                raise
        time.sleep(_RETRY_S)


def _asked(connections: SystemConnections, actor: str, message: Any, timeout_s: float | None, asker: str = "") -> Any:
    limit_s, what = _limit(timeout_s), f"message to {actor}"
    try:
        data = _encoded(message, what)
        _any.decode(data, what, "message")
    except (NotSerializable, InvalidRequest) as error:
        if "limit" in error.details:
            raise
        got = error.message.rpartition("got ")[2].partition(", which only")[0]
        text = "an actor that is asked from outside knows no classes: send the fields of an object, in a dict, say"
        plain = "numbers, strings, bytes, lists, dicts and the like"
        raise NotSerializable(f"{what}: expected {plain}, got {got}; {text}", path=what) from error
    command = AskActor(actor, data, limit_s, asker)
    return Codec(None, "answer").show(connections.ask(command, limit_s + GRACE_S).answer)


def _limit(timeout_s: float | None) -> float:
    limit_s = time_limit(timeout_s)
    return TIMEOUT_LIMIT_S if limit_s is None else min(limit_s, TIMEOUT_LIMIT_S)


def _too_late(server: str, timeout_s: float | None, why: str) -> LoadTimeout:
    """Return the error of a load of which the system has not said in time how it has ended."""
    text = f"{server}: not loaded within {timeout_s:g} s; {why}; the load is withdrawn"
    return LoadTimeout(text, server=server, timeout_s=timeout_s, status="")


def _encoded(value: Any, what: str) -> bytes:
    data = encode(value, what)
    if len(data) > VALUE_LIMIT_BYTES:
        text = f"{what}: {len(data)} bytes is over a connection's limit of {VALUE_LIMIT_BYTES}"
        raise NotSerializable(f"{text}; give the name of a file, say", path=what, limit=VALUE_LIMIT_BYTES)
    return data


def _refuse(name: str, option: str, is_used: bool) -> None:
    if is_used:
        raise UsageError(f"registrar {name!r}: {option}: {NOT_FOR_CONNECTIONS[option]}")
