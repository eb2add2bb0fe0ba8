"""Query: one hold on a resource, at its holder. ResourceInfo: one resource, at its provider."""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base import pickling
from rr_actors.base.errors import LoadTimeout, Unavailable, UnknownQuery, shown
from rr_actors.base.names import ServerId, parse_server_id
from rr_actors.base.notebook import bundle_or_text, table
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.status import Status, state_of, status_of
from rr_actors.registrar.model.rows import OK, Held, Notice, Phase, ServerType, State
from rr_actors.runtime.callback_errors import log_raised
from rr_actors.runtime.event_loop import check_may_block
from rr_actors.runtime.shielding import Flag
from rr_actors.runtime.time_limits import time_limit

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    Response = TypeVar("Response", default=Any, covariant=True)  # a Query alone is a Query[Any]
else:
    from typing import TypeVar

    Response = TypeVar("Response", covariant=True)

_KEPT_STATUSES = 256

_lock = threading.Lock()  # guards the list of waiting threads of every query


class Holder(Protocol):
    """The methods of a Registrar that its queries call."""

    def unload(self, query_or_id: Query, /, *, timeout_s: float | None = 30.0) -> object:
        """Release the query, and return when that is done."""

    async def unload_async(self, query_or_id: Query, /, *, timeout_s: float | None = 30.0) -> None:
        """Release the query as unload() does, awaited."""


class Query(Generic[Response]):
    """A registrar's hold on one resource. Registrar.load() makes it. As a context manager it unloads at the end.

    The response of a ``Query[Feed]`` is a Feed; the response of a plain Query has any type. Queries with the same id
    are equal, also in lists and in other processes.

    Attributes:
        id: UUIDv7, 32 hex digits, made by the holder.
        resource_id: the id of the resource, the same for all its holders.
        origin: the registrar that holds the query.
        registrar, server: the registrar and the server that serve the resource.
        parent: the id of the holder's own resource that depends on it; "" for none.
        state: the state of the last status; OK at first.
        released: whether the provider has taken the resource away.
    """

    __slots__ = (
        "_codec",
        "_holder",
        "_is_released",
        "_request",
        "_response",
        "_statuses",
        "_types",
        "_waiters",
        "id",
        "origin",
        "parent",
        "registrar",
        "released",
        "resource_id",
        "server",
        "state",
    )

    def __init__(
        self,
        id: str,
        place: ServerId,
        request: bytes,
        parent: str,
        origin: str,
        holder: Holder | None,
        types: Callable[[str], tuple[Any, Any]],
    ) -> None:
        self.id = id
        self.resource_id = ""
        self.origin = origin
        self.registrar, self.server = place
        self.parent = parent
        self.state = OK
        self.released = False
        self._holder = holder
        self._codec: Codec | None = None  # of the response type that the load was given
        self._is_released = False
        self._request: Any = _Bytes(request)
        self._response: Any = None
        self._types = types
        self._waiters: list[Flag] | None = None
        self._statuses: deque[Status] | None = None  # made for the first: most queries hear of none

    @property
    def server_id(self) -> str:
        """The id of the server, "registrar/server"."""
        return f"{self.registrar}/{self.server}"

    @property
    def request(self) -> Any:
        """The request, decoded as the server's request type."""
        request = self._request
        if type(request) is _Bytes:
            codec = self._types(self.server_id)[0]
            request = codec.decode(request.raw, self.server_id)
            if codec is not PLAIN:  # else the types are not known yet, and the next read tries again
                self._request = request
        return request

    @property
    def response(self) -> Response:
        """The newest response, decoded as the load's `response_type`, or else as the server's response type.

        Raises:
            InvalidResponse: the response has another type than `response_type`; or it needs a declared type, and none
                is known.
        """
        response = self._response
        if type(response) is _Bytes:
            codec = self._codec or self._types(self.server_id)[1]
            value = codec.decode(response.raw, self.server_id, "response")
            if codec is not PLAIN and self._response is response:  # else a newer one has arrived meanwhile
                self._response = value  # no other thread runs between the comparison and this
            return value
        return response

    def unload(self, *, timeout_s: float | None = 30.0) -> None:
        """Release the query. Return when the unload callback has run, or at once if others hold the resource.

        Raises:
            UnknownQuery: the query is unloaded already, or its provider has taken the resource away.
            UnloadFailed: this was the last query, and the unload callback raised. The query is still held.
            Unavailable: the provider did not come back in time. The release stays owed.
        """
        self._asked_to_unload().unload(self, timeout_s=timeout_s)
        self._is_released = True

    async def unload_async(self, *, timeout_s: float | None = 30.0) -> None:
        """Release the query as unload() does, awaited. If it is cancelled, the unload goes on."""
        await self._asked_to_unload().unload_async(self, timeout_s=timeout_s)
        self._is_released = True

    def _asked_to_unload(self) -> Holder:
        if self._holder is None:
            raise UnknownQuery(f"query {self.id}: another process holds it; unload it there", query_id=self.id)
        return self._holder

    def wait_status(self, state: State | str | None = None, timeout_s: float | None = None) -> Status:
        """Wait for a status of `state` (None: of any), and return the oldest that no earlier call has returned.

        Raises:
            LoadTimeout: none came within `timeout_s` seconds.
            UnknownQuery: none will come, because the query is released, or another process holds it.
        """
        check_may_block("Query.wait_status()")
        limit_s = time_limit(timeout_s)
        wanted = None if state is None else state_of(state, "wait_status")
        deadline = None if limit_s is None else time.monotonic() + limit_s
        while True:
            flag = Flag()
            with _lock:  # before it looks at the statuses, so that it misses none
                self._waiters = [*(self._waiters or ()), flag]
            try:
                if (found := self._take(wanted)) is not None:
                    return found
                if self._is_released or self._is_copy():
                    text = f"no status of query {self.id} will come: it is released, or another process holds it"
                    raise UnknownQuery(f"{self.server_id}: {text}", query_id=self.id)
                left_s = None if deadline is None else deadline - time.monotonic()
                if not flag.wait(left_s) and left_s is not None and left_s <= 0:
                    what = "status" if wanted is None else f"status {wanted}"
                    text = f"{self.server_id}: no {what} within {limit_s:g} s; the last state is {self.state}"
                    raise LoadTimeout(text, server=self.server_id, timeout_s=limit_s)
            finally:
                with _lock:
                    self._waiters = [other for other in self._waiters or () if other is not flag] or None

    def _take(self, wanted: State | None) -> Status | None:
        statuses = self._statuses or deque[Status]()
        for status in list(statuses):
            if wanted is None or status.state is wanted:
                with contextlib.suppress(ValueError):  # another thread was faster
                    statuses.remove(status)
                    return status
        return None

    def _hear(self, status: Status, response: bytes | None, *, released: bool) -> None:
        """Note a status that has arrived, and wake the threads that wait for one. On the loop."""
        self.state = status.state
        if response is not None:
            self._response = _Bytes(response)
        self.released = self.released or released
        if self._statuses is None:
            self._statuses = deque(maxlen=_KEPT_STATUSES)
        self._statuses.append(status)
        self._wake()

    def _end(self) -> None:
        """Note that the query is not held any more, and wake the threads that wait for a status. On the loop."""
        self._is_released = True
        self._wake()

    def _wake(self) -> None:
        if self._waiters is not None:
            with _lock:
                waiters = self._waiters
            for flag in waiters or ():
                flag.set()

    def _loaded(self, held: Held) -> None:
        """Note that the load has succeeded, with the values of its row. On the loop."""
        self.resource_id = held.resource_id
        self.state = held.state
        if held.response is not None:
            self._response = _Bytes(held.response)

    def _loaded_directly(self, resource_id: str, response: bytes) -> None:
        """Note that the load has succeeded. In the thread that loads."""
        self.resource_id = resource_id
        if self._response is None:  # otherwise an update arrived before the answer
            self._response = _Bytes(response)

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: the query as it is now. Elsewhere the copy can be read, and names the query."""
        names = ("id", "resource_id", "origin", "registrar", "server", "parent", "state", "released")
        return {name: getattr(self, name) for name in names} | {"_request": self.request, "_response": self.response}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)
        self._holder = self._codec = self._waiters = self._statuses = None
        self._is_released = False
        self._types = _no_types

    def _read_as(self, codec: Codec) -> Self:
        """Decode the response with this codec, and not with that of the server's response type."""
        self._codec = codec
        if type(self._response) is not _Bytes and self._response is not None:
            self._response = _Bytes(codec.encode(self._response, self.server_id))
        return self

    def _response_bytes(self) -> bytes:
        """Return the response's canonical bytes: those that arrived, if the response has not been read yet."""
        return self._response.raw if type(self._response) is _Bytes else encode(self._response, "response")

    def _held_by(self, holder: Holder) -> Self:
        """Make `holder` the registrar that unload() calls."""
        self._holder = holder
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.unload_if_held()

    def unload_if_held(self, *, timeout_s: float | None = 30.0) -> None:
        """Release the query as unload() does; do nothing if it is released already, by its holder or its provider.

        Raises:
            UnloadFailed, Unavailable: as for unload().
        """
        if not self._is_gone():
            try:
                self.unload(timeout_s=timeout_s)
            except UnknownQuery:
                if not self._may_be_gone():
                    raise

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        if not self._is_gone():
            try:
                await self.unload_async()
            except UnknownQuery:
                if not self._may_be_gone():
                    raise

    def _may_be_gone(self) -> bool:
        """Return whether the query is gone, or belongs to a handle: such a query is not notified of its end."""
        return self._is_gone() or (self._is_copy() and self._holder is not None)

    def _is_copy(self) -> bool:
        """Return whether the query is of another process, and so hears of no status here."""
        return self._types is _no_types

    def _is_gone(self) -> bool:
        """Return whether the query is released already, by its holder or its provider."""
        return self.released or self._is_released

    def __eq__(self, other: object) -> bool:
        return self.id == other.id if isinstance(other, Query) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.id)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        def rows() -> str:
            facts = [("query", self.id), ("held by", self.origin), ("server", self.server_id)]
            facts += [("request", shown(self.request)), ("response", shown(self.response)), ("state", str(self.state))]
            facts += [("resource", self.resource_id), ("for", self.parent or "itself")]
            return table(("", ""), [*facts, *([("released", "by its provider")] if self.released else [])])

        return bundle_or_text(repr(self), rows)

    def __repr__(self) -> str:
        return f"<Query {self.id} of {self.origin} on {self.server_id}, {self.state}>"


# For the package's own modules. As private methods they stay out of an editor's list of names.
hear = Query._hear  # pyright: ignore[reportPrivateUsage]  # same file
end = Query._end  # pyright: ignore[reportPrivateUsage]
loaded = Query._loaded  # pyright: ignore[reportPrivateUsage]
loaded_directly = Query._loaded_directly  # pyright: ignore[reportPrivateUsage]
held_by = Query._held_by  # pyright: ignore[reportPrivateUsage]
response_bytes = Query._response_bytes  # pyright: ignore[reportPrivateUsage]
read_as = Query._read_as  # pyright: ignore[reportPrivateUsage]


def read_later(loaded: Any, codec: Codec) -> Reply[Query]:
    """Return a future of a load's query whose response this codec decodes."""
    read: Reply[Query] = Reply()
    read.withdraw = loaded.cancel

    def done(loaded: Reply[Query]) -> None:
        read.set_unopened(lambda: read_as(loaded.get(), codec))

    loaded.add_done_callback(done)
    return read


def _no_types(server_id: str) -> tuple[Any, Any]:
    raise UnknownQuery(f"{server_id}: a query of another process has no types here")


class _Bytes(msgspec.Struct, frozen=True, gc=False):
    """A value that is not decoded yet. The thread that reads the value decodes it, never the loop."""

    raw: bytes


class ResourceInfo(msgspec.Struct, frozen=True):
    """A resource of this registrar at one moment.

    Attributes:
        id, server, request, response: the response is None while the resource is loading.
        state: a str. While the resource is loaded, the state of the last status, "OK" at first. Otherwise its phase:
            "queued", "loading", "unloading" or "unload_failed".
        phase: the phase alone.
        status, message: the state and the message of the last status.
        attempt: how often its load callback has begun.
        holders: the registrars that hold it, one entry for each query.
        queries: their query ids.
    """

    id: str
    server: str
    request: Any
    response: Any
    state: str
    phase: Phase
    status: State
    message: str
    attempt: int
    holders: tuple[str, ...]
    queries: tuple[str, ...]


logger = logging.getLogger("rr_actors.registrar")

StatusCallback = Callable[[Status], Any]

PLAIN = Codec(None)
_TYPES_S = 2.0


class Views:
    """The Query objects that a registrar has given out, and the status callbacks. A status reaches both.

    Attributes:
        holder: the Registrar that the application uses.
    """

    def __init__(self, actor: RegistrarActor, holder: Holder) -> None:
        self._actor = actor
        self.holder = holder
        self._queries: dict[str, Query] = {}
        self._on_query: dict[str, StatusCallback] = {}
        self._on_server: dict[str, list[StatusCallback]] = {}
        self._codecs: dict[str, tuple[bytes, tuple[Codec, Codec]]] = {}
        self._codecs_of = self.codecs_of  # one bound method for all queries
        self._left: set[tuple[str, str]] = set()  # servers where something was held, and released
        self._silent: set[str] = set()  # servers whose types were asked for, and did not come in time

    def new(self, id: str, place: ServerId, request: bytes, parent: str) -> Query:
        """Return a Query that is being loaded. No status reaches it before add()."""
        return Query(id, place, request, parent, self._actor.name, self.holder, self._codecs_of)

    def seen(self, held: Held) -> Query:
        """Return a new Query of a held row."""
        query = self.new(held.id, ServerId(held.registrar, held.server), held.request, held.parent)
        loaded(query, held)
        return query

    def of(self, held: Held) -> Query:
        """Return the Query of a held row, the same object each time."""
        view = self._queries.get(held.id)
        if view is None:
            view = self._queries[held.id] = self.seen(held)
        return view

    def add(self, query: Query) -> None:
        """Have statuses reach a query."""
        self._queries[query.id] = query

    def listen(self, query_id: str, callback: StatusCallback) -> None:
        """Have the callback called with each status of one query."""
        self._on_query[query_id] = callback  # first: an interrupt may come now, and forget() looks here
        self._actor.catalog.listened.add(query_id)

    def listen_to_server(self, server: str, callback: StatusCallback) -> None:
        """Have the callback called with each status of every query at a server."""
        self._actor.catalog.listened.add(server)
        self._on_server.setdefault(server, []).append(callback)

    def forget(self, query_id: str) -> None:
        """Forget a query that is not held any more, and its callback; wake the threads that wait for its statuses."""
        if (view := self._queries.pop(query_id, None)) is not None:
            end(view)
            if view.resource_id:
                self._left.add((view.registrar, view.server))
        if self._on_query.pop(query_id, None) is not None:
            self._actor.catalog.listened.discard(query_id)

    def was_at(self, server: ServerId) -> bool:
        """Return whether the registrar holds something at the server, is loading it, or did once. On the loop.

        The catalog keeps the types of each server where an earlier incarnation held something.
        """
        if server in self._left or str(server) in self._actor.catalog.server_types:
            return True
        with self._actor.lock:
            rows = (*self._queries.values(), *self._actor.whole().held.values())
        return any((row.registrar, row.server) == server for row in rows)

    def hear(self, held: Held, notice: Notice, heard: Callable[[bool], None], *, repeated: bool) -> None:
        """Pass a status that has arrived to its Query and to the callbacks. On the loop.

        `heard` is called when all callbacks have returned, with whether one of them has handled the status. After a
        crash before that, the provider sends the status again.
        """
        status = status_of(notice, repeated=repeated)
        view = self._queries.get(held.id)
        if view is not None:
            hear(view, status, notice.response, released=notice.released)
        callbacks = list(self._on_server.get(f"{held.registrar}/{held.server}", ()))
        if (own := self._on_query.get(held.id)) is not None:
            callbacks.insert(0, own)
        left = itertools.count(len(callbacks) - 1, -1)
        for callback in callbacks:
            self._run(held, callback, status, lambda: None if next(left) else heard(status.is_handled))
        if not callbacks:
            heard(False)

    def _run(self, held: Held, callback: StatusCallback, status: Status, through: Callable[[], None]) -> None:
        def done(_result: Any, error: BaseException | None) -> None:
            through()
            if error is not None:
                self._actor.callback_failures += 1
                log_raised(logger, error, "%s: a status callback for %s raised", self._actor.name, held.server)

        try:
            self._actor.workers.serial(("hear", held.id), callback, status, done=done)
        except Unavailable as error:
            done(None, error)

    def codecs_of(self, server_id: str) -> tuple[Codec, Codec]:
        """Return the codecs of a server's requests and responses, made of the types that it sent. Not on the loop."""
        known = self._actor.catalog.server_types.get(server_id) or self._ask_types(server_id)
        if known is None:
            return PLAIN, PLAIN
        cached = self._codecs.get(server_id)
        if cached is None or cached[0] != known.blob:
            request_type, response_type = pickling.loads(known.blob)
            codecs = Codec(request_type, f"{server_id}: request"), Codec(response_type, f"{server_id}: response")
            cached = self._codecs[server_id] = (known.blob, codecs)
            self._silent.discard(server_id)
        return cached[1]

    def _ask_types(self, server_id: str) -> ServerType | None:
        """Ask the provider for a server's types, which a crash may have lost; None if it does not answer in time.

        After a first wait in vain, reads do not wait any more: the question stays open until the provider is back.
        """
        dispatcher = self._actor.node.dispatcher
        if dispatcher.is_loop_thread() or self._actor.closed or server_id in self._silent:
            return None
        told = Flag()
        dispatcher.call(self._actor.types.tell, parse_server_id(server_id), told.set)
        if not told.wait(_TYPES_S):
            self._silent.add(server_id)
        return self._actor.catalog.server_types.get(server_id)
