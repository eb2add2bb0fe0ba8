"""connect(): a client of a running system, for any other process of the same user: a worker of a pool, a notebook.

The client speaks with the system's console, has no key of the system, and opens no pickle. Registrars in the
application's process hold its queries. Each registrar has a connection of its own, which ends with the client.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Self

from rr_actors.base.errors import NotSerializable, RrError, Unavailable, UnknownQuery
from rr_actors.base.names import parse_server_id
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.arguments import state_path
from rr_actors.registrar.pages import QueryRow
from rr_actors.runtime.time_limits import time_limit
from rr_actors.system.console.console_client import Connections, NotRunning, find_console
from rr_actors.system.console.console_messages import (
    TIMEOUT_LIMIT_S,
    VALUE_LIMIT_BYTES,
    AskActor,
    Done,
    Find,
    Found,
    Hold,
    Holding,
    OpenRegistrar,
    Release,
    Replied,
)

logger = logging.getLogger("rr_actors")

_ANSWER_S = 60.0  # for a request that has no time limit of its own
_GRACE_S = 10.0  # for an answer, in addition to the time limit of its request


class Client:
    """A client of a running system. connect() makes it; as a context manager it is closed at the end. From any thread.

    Attributes:
        system: the system's name.
        state_dir: its state directory.
        pid: the id of the system's process.
    """

    def __init__(self, run_dir: Path) -> None:
        self._connections = Connections(lambda: run_dir, _ANSWER_S)
        with self._connections.lent() as client:
            welcome = client.welcome
        self.system = welcome.system
        self.state_dir = Path(welcome.state_dir)
        self.pid = welcome.pid

    def open_registrar(self, name: str | None = None) -> ClientRegistrar:
        """Open a registrar for this client. When the client ends, it is closed, and its queries are released.

        Args:
            name: the registrar's name, before which the system puts "client."; None: "pid-" and this process's id.

        Raises:
            NameTaken: another client has this name.
            InvalidName: the name has characters that no name may have.
            NotRunning: the system has ended.
        """
        return ClientRegistrar(self._connections, f"pid-{os.getpid()}" if name is None else name)

    def ask(self, actor: str, message: Any, *, timeout_s: float | None = 30.0) -> Any:
        """Ask an actor of the system, and return its answer. Both are plain data, as requests are (docs/values.md).

        Args:
            actor: its id or its path, as for System.ref().

        Raises:
            NotFound: there is no such actor.
            NotSerializable: the message or the answer is no plain data, or too long (as for load()).
            RrError: the actor did not answer, or its handler raised.
        """
        limit_s = _limit(timeout_s)
        command = AskActor(actor, _encoded(message, f"message to {actor}"), limit_s)
        return Codec(None, "answer").show(self._connections.ask(command, Replied, limit_s + _GRACE_S).answer)

    def close(self) -> None:
        """Close all registrars and connections. Their queries are released soon after. A second close does nothing."""
        self._connections.close("the client is closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Client of {self.system} (pid {self.pid}) in {self.state_dir}>"


class ClientRegistrar:
    """A client's registrar: it loads, holds and releases. From any thread; a context manager closes it at the end.

    Attributes:
        name: the registrar's name in the system, "client.NAME".
    """

    def __init__(self, connections: Connections, name: str) -> None:
        self._connections = connections
        self._lifeline = connections.open()
        try:
            done = self._lifeline.ask(OpenRegistrar(name), Done)
        except BaseException:
            self._lifeline.close()
            raise
        self.name: str = done.facts["registrar"]

    def load(
        self, server: str, request: Any, *, response_type: Any = None, timeout_s: float | None = 30.0
    ) -> ClientQuery:
        """Load a resource, or share it if another query holds it already, and return a query of it.

        Args:
            server: "registrar/server".
            request: a value of the server's request type.
            response_type: the type to read the response as. None: classes in it are read as dicts.
            timeout_s: seconds that the load may take; None: a day.

        Raises:
            LoadError: as Registrar.load().
            NotSerializable: the request is no plain data, or longer than 900,000 bytes; or the response than 4 MiB.
            NotRunning: the system has ended, or this client is closed.
        """
        limit_s, target = _limit(timeout_s), str(parse_server_id(server))
        command = Hold(self.name, target, _encoded(request, "request"), limit_s)
        codec = Codec(response_type, f"{target}: response")
        query: ClientQuery | None = None
        try:
            with self._connections.lent() as client:  # if this ends before keep(), the system releases the query
                held = client.ask(command, Holding, limit_s + _GRACE_S)
                data = held.response
                response = codec.show(data) if response_type is None else codec.decode(data, target, "response")
                query = ClientQuery(self, held.query_id, held.resource_id, target, request, response)
                client.keep()
            return query
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the query
            if query is not None:
                _release_later(query)
            raise

    async def load_async(
        self, server: str, request: Any, *, response_type: Any = None, timeout_s: float | None = 30.0
    ) -> ClientQuery:
        """Load as load() does, from any event loop. If cancelled, release the query when the load has ended."""
        return await _awaited(lambda: self.load(server, request, response_type=response_type, timeout_s=timeout_s))

    def unload(self, query_or_id: ClientQuery | str, *, timeout_s: float | None = 30.0) -> None:
        """Release a query.

        Raises:
            UnknownQuery: the query is not held.
            UnloadFailed: it was the last query, and the unload callback raised. The query is still held.
            NotRunning: the system has ended.
        """
        limit_s = _limit(timeout_s)
        self._connections.ask(Release(self.name, _id_of(query_or_id), limit_s), Done, limit_s + _GRACE_S)

    def queries(self) -> list[QueryRow]:
        """Return the queries that the registrar holds, each with the state of its last status.

        Raises:
            NotRunning: the system has ended.
            Unavailable: the registrar does not answer.
        """
        with self._connections.lent() as client:
            found = client.queries(self.name)
        if found.notes:
            raise Unavailable(f"{self.name}: its queries are not known: {'; '.join(found.notes)}")
        return found.rows

    def fetch_state(self, query_or_id: ClientQuery | str) -> str:
        """Ask the system for the state of the last status of a query: "OK", "WARNING" ...

        Raises:
            UnknownQuery: the query is not held any more.
            NotRunning: the system has ended.
            Unavailable: the registrar does not answer.
        """
        id = _id_of(query_or_id)
        found = self._connections.ask(Find(id, self.name), Found)
        for row in found.queries:
            if row.id == id:
                return row.state
        if found.notes:
            raise Unavailable(f"query {id}: its state is not known: {'; '.join(found.notes)}")
        raise UnknownQuery(f"query {id}: {self.name} does not hold it any more", query_id=id)

    def close(self) -> None:
        """Close the registrar, whose queries are released a moment later. A second close does nothing."""
        self._lifeline.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<ClientRegistrar {self.name}>"


class ClientQuery:
    """A client's hold on one resource. As a context manager it is released at the end.

    Attributes:
        id, resource_id: as those of a Query.
        server_id: "registrar/server".
        request, response: the request, and the response that the load returned.
    """

    def __init__(
        self, holder: ClientRegistrar, id: str, resource_id: str, server_id: str, request: Any, response: Any
    ) -> None:
        self._holder = holder
        self.id = id
        self.resource_id = resource_id
        self.server_id = server_id
        self.request = request
        self.response = response

    def fetch_state(self) -> str:
        """Ask the system for the state of the query's last status, as ClientRegistrar.fetch_state() does."""
        return self._holder.fetch_state(self)

    def unload(self, *, timeout_s: float | None = 30.0) -> None:
        """Release the query, as ClientRegistrar.unload() does."""
        self._holder.unload(self, timeout_s=timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.unload()

    def __repr__(self) -> str:
        return f"<ClientQuery {self.id} of {self._holder.name} on {self.server_id}>"


def connect(state_dir: str | os.PathLike[str] | None = None) -> Client:
    """Return a client of a running system of this user, in this process or another.

    Args:
        state_dir: the system's state directory; None: the one that RR_STATE names, or else of the one running system.

    Raises:
        NotRunning: no system runs, or it has no console.
        UsageError: several systems run; the error names them.
        Unavailable: the system is another user's, or of another version.
        ConfigError: state_dir is no path, or cannot be read.
    """
    place = state_dir if state_dir is not None else os.environ.get("RR_STATE")
    return Client(find_console(None if place is None else state_path(place)))


def _limit(timeout_s: float | None) -> float:
    limit_s = time_limit(timeout_s)
    return TIMEOUT_LIMIT_S if limit_s is None else min(limit_s, TIMEOUT_LIMIT_S)


def _encoded(value: Any, what: str) -> bytes:
    data = encode(value, what)
    if len(data) > VALUE_LIMIT_BYTES:
        text = f"{what}: {len(data)} bytes is over a client's limit of {VALUE_LIMIT_BYTES}"
        raise NotSerializable(f"{text}; give the name of a file, say", path=what)
    return data


def _id_of(query_or_id: ClientQuery | str) -> str:
    return query_or_id if isinstance(query_or_id, str) else query_or_id.id


async def _awaited(load: Callable[[], ClientQuery]) -> ClientQuery:
    """Await a load that a thread makes; if cancelled, release its query later, even if the loop has ended by then."""
    loaded: Future[ClientQuery] = Future()

    def make() -> None:
        try:
            loaded.set_result(load())
        except BaseException as error:
            loaded.set_exception(error)

    try:
        asyncio.get_running_loop().run_in_executor(None, make)
        return await asyncio.shield(asyncio.wrap_future(loaded))
    except BaseException:  # cancelled, or KeyboardInterrupt: the caller never gets the query
        loaded.add_done_callback(_undo)
        raise


def _undo(loaded: Future[ClientQuery]) -> None:
    if loaded.exception() is None:
        _release_later(loaded.result())


def _release_later(query: ClientQuery) -> None:
    """Release a query in a thread of its own: the caller was interrupted, or its loop and threads may be ending."""
    threading.Thread(target=_release, args=(query,), name="rr-undo").start()


def _release(query: ClientQuery) -> None:
    try:
        query.unload()
    except (NotRunning, UnknownQuery):
        logger.debug("%r: the system has released it, or has ended, or its client is closed", query)
    except RrError:
        logger.exception("%r: its load was cancelled, and it is not released", query)
