"""Query: one hold on a resource, at its holder. ResourceInfo: one resource, at its provider."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self

import msgspec

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base import pickling
from rr_actors.base.errors import LoadTimeout, ResourceLost, RrError, Unavailable, UnknownQuery, shown
from rr_actors.base.names import ServerId, check_name, parse_server_id
from rr_actors.base.notebook import bundle_or_text, table
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.status import StatusMessage, state_of, status_of
from rr_actors.registrar.model.rows import OK, REVOKED, Held, Hold, Notice, Phase, ServerType, State
from rr_actors.runtime.callback_errors import log_raised
from rr_actors.runtime.event_loop import check_asyncio, check_may_block
from rr_actors.runtime.shielding import Flag
from rr_actors.runtime.time_limits import time_limit
from rr_actors.runtime.user_loop import CallersLoop
from rr_actors.runtime.workers import LettingIn, is_async
from rr_actors.streams.stream import Keep, Place, Stream, streams_in
from rr_actors.streams.stream_reader import Source, StreamReader
from rr_actors.streams.wake import Wake

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    Response = TypeVar("Response", default=Any, covariant=True)  # a Query alone is a Query[Any]
else:
    from typing import TypeVar

    Response = TypeVar("Response", covariant=True)

_KEPT_STATUSES = 256
_UNLOAD_S = 30.0
_CANCELLED_S = 2.0  # the release goes on, and the provider gets it when it is back

_lock = threading.RLock()  # to make the set of those that wait for a status of a query


class Holder(Protocol):
    """The methods of a Registrar that its queries call."""

    def unload(self, query_or_id: Query, /, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Release the query, and return when that is done; with ``block=False``, a future of the end at once."""

    async def unload_async(self, query_or_id: Query, /, *, timeout_s: float | None = 30.0) -> None:
        """Release the query, awaited."""

    def fetch_state(self, query_or_id: Query, /) -> State:
        """Return the state of the query's last status, as the registrar has it."""
        ...

    def fetch_priority(self, query_or_id: Query, /) -> int | None:
        """Return the query's priority, as the registrar has it."""
        ...

    def set_priority(self, query_or_id: Query, priority: int | None, /) -> None:
        """Give the query a priority."""
        ...

    def set_on_status(self, query_or_id: Query, callback: StatusCallback | None, /) -> None:
        """Replace the status callback of the query."""
        ...


def raise_or_note(refusal: RrError, error: BaseException | None) -> None:
    """Raise the error of an unload at the end of a block; or note it on the block's own exception, which goes on."""
    if error is None:
        raise refusal
    error.add_note(f"and {type(refusal).__name__}: {refusal}")


def patience_s(error: BaseException | None) -> float:
    """Return how long the end of a block waits for a provider that is down: not long if the block was cancelled."""
    return _CANCELLED_S if isinstance(error, asyncio.CancelledError) else _UNLOAD_S


class Status(StatusMessage):
    """A message about the state of a resource (thesis: status message).

    To send one, make it with a state and a message. One that is received also says which resource it is about.

    Attributes:
        state: OK, UPDATE, WARNING, ERROR or FATAL. The name is accepted, too, in any case: Status("fatal").
        message: text for people.
        resource_id: the resource through which the status reached the receiver. The receiver holds it; in a server's
            status callback it is the server's own if its owner has set the status.
        query_id: the receiver's query on that resource; "" if the resource is the receiver's own.
        source: the server where the status began, "registrar/server".
        repeated: whether the status may have been heard before; a crash made that uncertain.
        reason: "revoked" if the resource's owner takes it away; "ended" if a connection's system has ended; "" else.
        deadline_s: of a revoked resource, how many seconds after the status was sent it is unloaded by force: 0.0, if
            that is done. None for any other status.
    """

    __slots__ = ("_find",)

    _find: Callable[[str], Query[Any] | None]  # the receiver's queries, by id; only of a status that was received

    @property
    def query(self) -> Query[Any] | None:
        """The receiver's query that the status is of, as long as the receiver's registrar holds it; None else.

        It is None if the resource is the receiver's own, and in another process, to which a status travels without it.
        """
        find: Callable[[str], Query[Any] | None] | None = getattr(self, "_find", None)
        return None if find is None or not self.query_id else find(self.query_id)


def received(status: Status, find: Callable[[str], Query[Any] | None]) -> Status:
    """Return the status, which finds its query among those of its receiver."""
    status._find = find  # pyright: ignore[reportPrivateUsage]  # same file
    return status


class _Statuses(deque[Status]):
    """The newest statuses of a query that no call of wait_status() has returned yet. A FATAL goes last."""

    missed = 0

    def hear(self, status: Status) -> None:
        if len(self) >= _KEPT_STATUSES:
            heard = list(self)
            with contextlib.suppress(ValueError):  # a thread has returned it meanwhile
                self.remove(next((old for old in heard if old.state is not State.FATAL), heard[0]))
                self.missed += 1
        self.append(status)


AllStreams = Callable[["Query[Any]"], Callable[[], bool]]
"""For each reader of a query, it returns a function: whether nobody will open another stream of the resource."""


class Query(Generic[Response]):
    """A registrar's hold on one resource. Registrar.load() makes it. As a context manager it unloads at the end.

    The response of a ``Query[Feed]`` is a Feed; the response of a plain Query has any type. Queries with the same id
    are equal, also in lists and in other processes.
    """

    __slots__ = (
        "_all_streams",
        "_codec",
        "_holder",
        "_id",
        "_is_released",
        "_is_revoked",
        "_origin",
        "_parent",
        "_registrar",
        "_released",
        "_request",
        "_resource_id",
        "_response",
        "_server",
        "_state",
        "_statuses",
        "_types",
        "_waiters",
    )

    def __init__(
        self,
        id: str,
        place: ServerId,
        request: bytes,
        parent: str,
        origin: str,
        holder: Holder | None,
        types: Callable[[str], tuple[Codec, Codec]],
        all_streams: AllStreams,
    ) -> None:
        self._id = id
        self._resource_id = ""
        self._origin = origin
        self._registrar, self._server = place
        self._parent = parent
        self._state = OK
        self._released = False
        self._holder = holder
        self._codec: Codec | None = None  # of the response type that the load was given
        self._is_released = False
        self._is_revoked = False
        self._request: Any = _Bytes(request)
        self._response: Any = None
        self._types = types
        self._all_streams = all_streams
        self._waiters: dict[Flag | Wake | _Over, None] | None = None  # made for the first
        self._statuses: _Statuses | None = None  # made for the first: most queries hear of none

    @property
    def id(self) -> str:
        """The id of the query: UUIDv7, 32 hex digits, made by the holder; UUIDv8 of what a planner loads for itself."""
        return self._id

    @property
    def resource_id(self) -> str:
        """The id of the resource, the same for all its holders."""
        return self._resource_id

    @property
    def origin(self) -> str:
        """The registrar that holds the query."""
        return self._origin

    @property
    def registrar(self) -> str:
        """The registrar that serves the resource."""
        return self._registrar

    @property
    def server(self) -> str:
        """The server that serves the resource, its name at its registrar."""
        return self._server

    @property
    def parent(self) -> str:
        """The id of the holder's own resource that depends on it; "" for none."""
        return self._parent

    @property
    def state(self) -> State:
        """The state of the last status; OK at first."""
        return self._state

    @property
    def released(self) -> bool:
        """Whether the provider has taken the resource away; after a revocation, when the query is released."""
        return self._released

    @property
    def server_id(self) -> str:
        """The id of the server, "registrar/server"."""
        return f"{self._registrar}/{self._server}"

    @property
    def request(self) -> Any:
        """The request, decoded as the server's request type.

        It is plain data if the query was loaded before an upgrade, and does not fit the type of today.
        """
        request = self._request
        if type(request) is _Bytes:
            codec = self._types(self.server_id)[0]
            request = codec.show_stored(request.raw)
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
        self._at_holder().unload(self, timeout_s=timeout_s)
        self._is_released = True

    async def unload_async(self, *, timeout_s: float | None = 30.0) -> None:
        """Release the query as unload() does, awaited. If it is cancelled, the unload goes on."""
        check_asyncio("unload_async")
        await self._at_holder().unload_async(self, timeout_s=timeout_s)
        self._is_released = True

    def fetch_state(self) -> State:
        """Ask the registrar that holds the query for the state of its last status.

        Raises:
            UnknownQuery: the query is not held any more, or another process holds it.
        """
        return self._at_holder().fetch_state(self)

    @property
    def priority(self) -> int | None:
        """How urgently the holder needs the resource, from -1000 to 1000; None: on standby (docs/planning.md).

        To set it also replaces what a dependency inherits. It is on disk then, and reaches the provider soon, or when
        that is back.

        Raises:
            UnknownQuery: the query is not held any more, or another process holds it.
            UsageError: it is set to something else, or to more than the registrar's `max_priority`.
        """
        return self._at_holder().fetch_priority(self)

    @priority.setter
    def priority(self, priority: int | None) -> None:
        self._at_holder().set_priority(self, priority)

    def standby(self) -> None:
        """Keep the query, and say that the resource is not needed now. A priority ends that."""
        self.priority = None

    def on_status(self, callback: StatusCallback | None) -> None:
        """Call `callback(status)` for each status of this query from now on; None: call nothing.

        It takes the place of the load's `on_status`, and of an earlier call's. When this has returned, the one before
        is not begun again: the new one hears what still waits for it. What a callback has heard is not heard again, and
        `state` has it. An ``async def`` runs on the event loop that runs here, if there is one. A query that a restart
        has restored has no callback.

        Raises:
            UnknownQuery: the query is not held any more, or another process holds it.
            UsageError: `callback` cannot be called with a status alone.
        """
        self._at_holder().set_on_status(self, callback)

    def _at_holder(self) -> Holder:
        if self._holder is None:
            raise UnknownQuery(f"query {self._id}: another process holds it; unload it there", query_id=self._id)
        return self._holder

    def wait_status(self, state: State | str | None = None, timeout_s: float | None = None) -> Status:
        """Wait for a status of `state` (None: of any), and return the oldest that no earlier call has returned.

        The newest 256 are kept for later calls, and a FATAL longer than others. A warning in the log says how many
        older ones are missing.

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
            self._watch(flag)  # before it looks at the statuses, so that it misses none
            try:
                if (found := self._take(wanted)) is not None:
                    return found
                if self._is_released or self._is_copy():
                    raise self._silence()
                left_s = None if deadline is None else deadline - time.monotonic()
                with LettingIn():
                    has_come = flag.wait(left_s)
                if not has_come and left_s is not None and left_s <= 0:
                    what = "status" if wanted is None else f"status {wanted}"
                    text = f"{self.server_id}: no {what} within {limit_s:g} s; the last state is {self._state}"
                    raise LoadTimeout(text, server=self.server_id, timeout_s=limit_s)
            finally:
                self._unwatch(flag)

    def stream(
        self, name: str | Stream | None = None, *, keep: Keep = "latest", depth: int = 4, timeout_s: float | None = None
    ) -> StreamReader:
        """Read a stream that the resource's manager has opened: iterate over it, with ``for`` or ``async for``.

        It is the stream of this name that the response names, which another resource may have opened, or else the
        resource's own. The iteration ends when the query is released. It goes on after a crash of the manager, once
        that has opened the stream again. It goes on with another stream if update_response() or replace_part() names
        that.

        Args:
            name: the stream's name; or an rr.Stream of the response, if others there have the same name; None: the
                only one. The reader goes on with what a new response has in the place of that rr.Stream.
            keep: "latest": a slow reader gets the newest frame. "all": it gets each, and the publisher waits for it.
            depth: with "all", how many frames the reader may be behind until the publisher waits; from 1 to 1000.
            timeout_s: the longest wait for one frame; 0: look once; None: no limit.

        Raises:
            UnknownQuery: the query is released, or another process holds it.
            InvalidName, UsageError: an argument is something else, or there are several streams that are meant.
            NotFound: the resource has no stream of this name. If it has none at all, this is known at once, to a
                connected program a moment later, by the iteration; or, if the manager has crashed since the load, the
                iteration raises it after thirty seconds. `.id`, `.known`
            ResourceLost: by the iteration: the resource was lost.
            Unavailable: by the iteration: the manager has ended, and its server opens the stream in no callback that
                runs then. Or a frame cannot be read now; the next call goes on.
            TimeoutError: by the iteration: no frame has come within `timeout_s`.
        """
        limit_s = time_limit(timeout_s)
        self._at_holder()
        if self._is_released:
            raise UnknownQuery(f"{self.server_id}: query {self._id} is released: it has no streams", query_id=self._id)
        source = Source(
            self._resource_id,
            self._origin,
            self._is_over,
            self._named_streams,
            self._watch,
            self._unwatch,
            self._all_streams(self),
        )
        checked = name if name is None or isinstance(name, Stream) else check_name(name, "stream")
        return StreamReader(source, checked, keep, depth, limit_s)

    def _named_streams(self) -> list[tuple[Place, Stream]]:
        return streams_in(self._response_bytes())

    def _watch(self, waiter: Flag | Wake | _Over) -> None:
        with _lock:
            if self._waiters is None:
                self._waiters = {}
        self._waiters[waiter] = None

    def _unwatch(self, waiter: Flag | Wake | _Over) -> None:
        if self._waiters is not None:  # without the lock: a reader's finalizer calls it
            self._waiters.pop(waiter, None)

    def _is_over(self) -> bool:
        """Return whether the query is released; raise ResourceLost if the resource is lost."""
        if self._released or self._state is State.FATAL:
            text = f"{self.server_id}: resource {self._resource_id} is lost"
            raise ResourceLost(text, query_id=self._id, resource_id=self._resource_id)
        return self._is_released

    def _silence(self) -> RrError:
        """Return the error that says why no status will come any more."""
        text = f"no status of query {self._id} will come: it is released, or another process holds it"
        return UnknownQuery(f"{self.server_id}: {text}", query_id=self._id)

    def _when_over(self, call: Callable[[], object]) -> None:
        """Call `call` once, from any thread, when the query is not held any more; at once if it is not."""
        over = _Over(self, call)
        self._watch(over)
        over.set()

    def _take(self, wanted: State | None) -> Status | None:
        statuses = self._statuses or _Statuses()
        if statuses.missed:
            text = "%s: wait_status() misses %d statuses of query %s: the newest %d are kept"
            logger.warning(text, self.server_id, statuses.missed, self._id, _KEPT_STATUSES)
            statuses.missed = 0
        for status in list(statuses):
            if wanted is None or status.state is wanted:
                with contextlib.suppress(ValueError):  # another thread was faster
                    statuses.remove(status)
                    return status
        return None

    def _hear(self, status: Status, response: bytes | None, *, released: bool) -> None:
        """Note a status that has arrived, and wake the threads that wait for one. On the loop."""
        self._state = State.FATAL if self._state is State.FATAL else status.state
        if response is not None:
            self._response = _Bytes(response)
        self._released = self._released or released
        self._is_revoked = self._is_revoked or status.reason == REVOKED
        if self._statuses is None:
            self._statuses = _Statuses()
        self._statuses.hear(status)
        self._wake()

    def _end(self) -> None:
        """Note that the query is not held any more, and wake the threads that wait for a status. On the loop."""
        self._is_released = True
        self._released = self._released or self._is_revoked
        self._wake()

    def _wake(self) -> None:
        for waiter in list(self._waiters or ()):
            waiter.set()

    def _loaded(self, held: Held) -> None:
        """Note that the load has succeeded, with the values of its row. On the loop."""
        self._resource_id = held.resource_id
        self._state = held.state
        if held.response is not None:
            self._response = _Bytes(held.response)

    def _loaded_directly(self, resource_id: str, response: bytes, state: State) -> None:
        """Note that the load has succeeded. In the thread that loads."""
        self._resource_id = resource_id
        if state is not OK and self._state is OK:  # otherwise a status arrived before the answer
            self._state = state
        if self._response is None:  # otherwise an update arrived before the answer
            self._response = _Bytes(response)

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: the query as it is now. Elsewhere the copy can be read, and names the query."""
        names = ("id", "resource_id", "origin", "registrar", "server", "parent", "state", "released")
        return {name: getattr(self, name) for name in names} | {"_request": self.request, "_response": self.response}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name if name.startswith("_") else f"_{name}", value)
        self._holder = self._codec = self._waiters = self._statuses = None
        self._is_released = self._is_revoked = False
        self._types, self._all_streams = _no_types, _not_known

    def _read_as(self, codec: Codec) -> Self:
        """Decode the response with this codec, and not with that of the server's response type."""
        self._codec = codec
        if type(self._response) is not _Bytes and self._response is not None:
            self._response = _Bytes(codec.encode(self._response, self.server_id))
        return self

    def _response_bytes(self) -> bytes:
        """Return the response's canonical bytes: those that arrived, if the response has not been read yet."""
        return self._response.raw if type(self._response) is _Bytes else encode(self._response, "response")

    def _was_given(self, request: object) -> None:
        """Note the request as the caller has given it. It is not decoded."""
        self._request = request

    def _held_by(self, holder: Holder) -> Self:
        """Make `holder` the registrar that unload() calls."""
        self._holder = holder
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        try:
            self.unload_if_held()
        except RrError as refusal:
            raise_or_note(refusal, error)

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
        check_asyncio("async with Query")
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        try:
            await self._unload_if_held_async(patience_s(error))
        except RrError as refusal:
            raise_or_note(refusal, error)

    async def _unload_if_held_async(self, timeout_s: float | None) -> None:
        """Release the query as unload_if_held() does, awaited. If it is cancelled, the unload goes on."""
        if not self._is_gone():
            try:
                await self.unload_async(timeout_s=timeout_s)
            except UnknownQuery:
                if not self._may_be_gone():
                    raise

    def _begin_unload(self, timeout_s: float | None) -> Reply[None]:
        """Begin to release the query if it is still held, and return the future of the end."""
        ended: Reply[None] = Reply()
        try:
            if not self._is_gone():
                return self._at_holder().unload(self, timeout_s=timeout_s, block=False)
            ended.set()
        except RrError as error:
            fail(ended, error)
        return ended

    def _may_be_gone(self) -> bool:
        """Return whether the query is gone, or belongs to a handle: such a query is not notified of its end."""
        return self._is_gone() or (self._is_copy() and self._holder is not None)

    def _is_copy(self) -> bool:
        """Return whether the query is of another process, and so hears of no status here."""
        return self._types is _no_types

    def _is_gone(self) -> bool:
        """Return whether the query is released already, by its holder or its provider."""
        return self._released or self._is_released

    def __eq__(self, other: object) -> bool:
        return self._id == other._id if isinstance(other, Query) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._id)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        def rows() -> str:
            facts = [("query", self._id), ("held by", self._origin), ("server", self.server_id)]
            facts += [("request", shown(self.request)), ("response", shown(self.response)), ("state", str(self._state))]
            facts += [("resource", self._resource_id), ("for", self._parent or "itself")]
            return table(("", ""), [*facts, *([("released", "by its provider")] if self._released else [])])

        return bundle_or_text(repr(self), rows)

    def __repr__(self) -> str:
        return f"<Query {self._id} of {self._origin} on {self.server_id}, {self._state}>"


for _name in ("id", "resource_id", "origin", "registrar", "server", "parent", "state", "released"):
    # A load reads them nine times. So that no read is a call of Python, the slot itself is read.
    setattr(Query, _name, property(attrgetter(f"_{_name}"), doc=vars(Query)[_name].__doc__))


# For the package's own modules. As private methods they stay out of an editor's list of names.
hear = Query._hear  # pyright: ignore[reportPrivateUsage]  # same file
end = Query._end  # pyright: ignore[reportPrivateUsage]
loaded = Query._loaded  # pyright: ignore[reportPrivateUsage]
loaded_directly = Query._loaded_directly  # pyright: ignore[reportPrivateUsage]
was_given = Query._was_given  # pyright: ignore[reportPrivateUsage]
held_by = Query._held_by  # pyright: ignore[reportPrivateUsage]
response_bytes = Query._response_bytes  # pyright: ignore[reportPrivateUsage]
read_as = Query._read_as  # pyright: ignore[reportPrivateUsage]
begin_unload = Query._begin_unload  # pyright: ignore[reportPrivateUsage]
when_over = Query._when_over  # pyright: ignore[reportPrivateUsage]
unload_if_held_async = Query._unload_if_held_async  # pyright: ignore[reportPrivateUsage]


class _Over:
    """A waiter of a query that hears nothing but the end of it."""

    def __init__(self, query: Query, call: Callable[[], object]) -> None:
        self._query = query
        self._calls = [call]

    def set(self) -> None:
        """Look whether the query is over, as something has happened to it."""
        if self._query._is_gone():  # pyright: ignore[reportPrivateUsage]  # same file
            with contextlib.suppress(IndexError):  # another thread was faster
                self._calls.pop()()


def _not_known(_query: Query[Any]) -> Callable[[], bool]:
    """Return a function that returns False: nobody here knows whether the manager runs that has answered the load."""
    return lambda: False


def _no_types(server_id: str) -> tuple[Codec, Codec]:
    raise UnknownQuery(f"{server_id}: a query of another process has no types here")


class _Bytes(msgspec.Struct, frozen=True, gc=False):
    """A value that is not decoded yet. The thread that reads the value decodes it, never the loop."""

    raw: bytes


class ResourceInfo(msgspec.Struct, frozen=True):
    """A resource of this registrar at one moment.

    Attributes:
        id, server, request, response: the response is None while the resource is loading.
        state: a str. While the resource is loaded, the state of the last status, "OK" at first. Otherwise its phase:
            "queued", "loading", "unloading", "unload_failed", "pausing", "paused" or "resuming".
        phase: the phase alone.
        status, message: the state and the message of the last status.
        attempt: how often its load callback has begun.
        holders: the registrars that hold it, one entry for each query.
        queries: their query ids.
        priority: the highest priority of its holders; None: all of them have it on standby, or nobody holds it.
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
    priority: int | None = 0


logger = Log("rr_actors.registrar")

StatusCallback = Callable[[Status], Any]

PLAIN = Codec(None)
_TYPES_S = 2.0
_AFTER_FATAL = (State.FATAL, State.UPDATE)  # what is heard of a resource that is lost


class Subscription:
    """A callback of on_status(). A context manager stops it at the end."""

    __slots__ = ("_stop",)

    def __init__(self, stop: Callable[[], object]) -> None:
        self._stop = stop

    def stop(self) -> None:
        """Stop it: when this has returned, the callback is not begun again. One that runs goes on.

        What waited for the callback goes its way without it. A second stop does nothing. Call it from any thread, also
        in the callback.

        Raises:
            Unavailable: the process of a handle's registrar does not answer.
        """
        self._stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()


class _Listener:
    """Who hears statuses: a callback, which may be replaced; None: it was stopped."""

    __slots__ = ("callback",)

    def __init__(self) -> None:
        self.callback: StatusCallback | None = None


class StatusCallbacks:
    """The status callbacks of a registrar: those of its queries, and those of servers where it holds some.

    A callback is looked up when it begins: what waits is heard by the one that is there then.

    Args:
        hears: returns whether callbacks for a query may begin now.
        keys: gets the ids of the queries and the servers that have a callback.
    """

    def __init__(self, hears: Callable[[str], bool], keys: set[str]) -> None:
        self._hears, self._keys = hears, keys
        self._on_query: dict[str, _Listener] = {}
        self._on_server: dict[str, dict[str, _Listener]] = {}
        self._lock = threading.RLock()  # for those of servers; a finalizer may stop one

    def set(self, query_id: str, callback: StatusCallback | None, loop: CallersLoop | None = None) -> None:
        """Have the callback called for a query, in the place of the one before; if it is async, on this loop."""
        listener = self._on_query.get(query_id) or _Listener()
        if callback is not None and loop is not None:
            callback = self._brought(query_id, listener, callback, loop)
        listener.callback = callback
        if callback is None:
            self.drop(query_id)
        else:
            self._on_query[query_id] = listener  # first: an interrupt may come now, and drop() looks here
            self._keys.add(query_id)

    def drop(self, query_id: str) -> None:
        """Drop the callback of a query that is not held any more."""
        if self._on_query.pop(query_id, None) is not None:
            self._keys.discard(query_id)

    def listen(self, server: str, id: str, callback: StatusCallback) -> None:
        """Have the callback called for every query at a server, until stop() gets the same id."""
        with self._lock:
            listener = self._on_server.setdefault(server, {})[id] = _Listener()
            listener.callback = callback
            self._keys.add(server)

    def stop(self, server: str, id: str) -> None:
        """Begin a callback of listen() no more; do nothing if it is stopped."""
        with self._lock:
            listeners = self._on_server.get(server, {})
            if (listener := listeners.pop(id, None)) is not None:
                listener.callback = None
                if not listeners:
                    del self._on_server[server]
                    self._keys.discard(server)

    def of(self, query_id: str, server: str) -> list[_Listener]:
        """Return those that hear a status of a query: its own callback first."""
        own = self._on_query.get(query_id)
        listeners = [] if own is None else [own]
        if server in self._on_server:
            with self._lock:
                listeners += self._on_server.get(server, {}).values()
        return listeners

    def beginning(self, query_id: str, listener: _Listener) -> StatusCallback:
        """Return a function that calls the callback that is there when it begins, if it may begin then."""

        def begin(status: Status) -> Any:
            callback = listener.callback
            return callback(status) if callback is not None and self._hears(query_id) else None

        if (callback := listener.callback) is not None and is_async(callback):
            return functools.partial(self._begin_async, query_id, listener)
        return begin

    async def _begin_async(self, query_id: str, listener: _Listener, status: Status) -> None:
        if (callback := listener.callback) is not None and self._hears(query_id):
            await (callback(status) if is_async(callback) else asyncio.to_thread(callback, status))

    def _brought(
        self, query_id: str, listener: _Listener, callback: StatusCallback, loop: CallersLoop
    ) -> StatusCallback:
        """Return an async callback for any loop, which runs on this one; if it was replaced meanwhile, the new one."""

        async def begin(status: Status) -> None:
            if listener.callback is not brought:
                await self._begin_async(query_id, listener, status)
            elif self._hears(query_id):
                await callback(status)

        brought = loop.bring(begin)
        return brought


class Views:
    """The Query objects that a registrar has given out, and the status callbacks. A status reaches both.

    Attributes:
        holder: the Registrar that the application uses.
    """

    def __init__(self, actor: RegistrarActor, holder: Holder) -> None:
        self._actor = actor
        self.holder = holder
        self._queries: dict[str, Query] = {}
        self._taken: dict[str, Query] = {}  # queries that were taken away, until their callbacks have heard of that
        self._lost: set[str] = set()  # queries whose resource has said FATAL
        self.callbacks = StatusCallbacks(self.hears, actor.catalog.listened)
        self._codecs: dict[str, tuple[bytes, tuple[Codec, Codec]]] = {}
        self._of_all = self.codecs_of, self._all_streams  # the same bound methods for all queries
        self._left: set[tuple[str, str]] = set()  # servers where something was held, and released
        self._silent: set[str] = set()  # servers whose types were asked for, and did not come in time

    def new(self, id: str, place: ServerId, request: bytes, parent: str, codec: Codec | None = None) -> Query:
        """Return a Query that is being loaded. No status reaches it before add().

        Args:
            codec: decodes the response; None: that of the server's response type.
        """
        query = Query(id, place, request, parent, self._actor.name, self.holder, *self._of_all)
        return query if codec is None else read_as(query, codec)

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

    def received(self, notice: Notice, *, repeated: bool) -> Status:
        """Return the status that a notice carries, for a callback of this registrar."""
        return received(status_of(notice, Status, repeated=repeated), self.find)

    def find(self, query_id: str) -> Query | None:
        """Return the Query of this id that is held, also while callbacks hear that it was taken away; None else."""
        if self._actor.closed:
            return None
        view = self._queries.get(query_id) or self._taken.get(query_id)
        if view is None:
            with self._actor.lock:
                catalog = self._actor.whole()
                held = catalog.held.get(query_id)
                if held is None or held.hold is Hold.OWED:
                    return None
                if query_id in catalog.ending:  # the status callback of its whole hears that it was taken away
                    view = self.seen(held)
                    view._released = True  # pyright: ignore[reportPrivateUsage]  # same file
                    end(view)
                else:
                    view = self.of(held)
        return view

    def known(self, query_id: str) -> Query | None:
        """Return the Query of this id that was given out, or is being loaded; None once it is not held any more."""
        return self._queries.get(query_id)

    def add(self, query: Query) -> None:
        """Have statuses reach a query."""
        self._queries[query.id] = query

    def forget(self, query_id: str) -> None:
        """Forget a query that its holder has released: no callback begins for it from now on."""
        self._taken.pop(query_id, None)
        self._drop(query_id)

    def forget_taken(self, wanted: Callable[[Held | Query], bool]) -> None:
        """Forget the wanted ones of the queries that were taken away, and whose callbacks have not heard all of it."""
        for query in list(self._taken.values()):
            if wanted(query):
                self.forget(query.id)

    def hears(self, query_id: str) -> bool:
        """Return whether callbacks for a query may begin now: it is not released, nor is the registrar closed."""
        return (query_id in self._queries or query_id in self._taken) and not self._actor.closed

    def _drop(self, query_id: str) -> None:
        """Drop a query that is not held any more, and its callback; wake the threads that wait for its statuses."""
        if (view := self._queries.pop(query_id, None)) is not None:
            end(view)
            if view.resource_id:
                self._left.add((view.registrar, view.server))
        self._lost.discard(query_id)
        self.callbacks.drop(query_id)

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
        server = f"{held.registrar}/{held.server}"
        if held.id in self._lost and notice.state not in _AFTER_FATAL:
            heard(False)
            return
        if notice.state is State.FATAL and notice.source == server:  # else a part of the resource is lost
            self._lost.add(held.id)
        status = self.received(notice, repeated=repeated)
        listeners = self.callbacks.of(held.id, server)
        view = self.of(held) if listeners else self._queries.get(held.id)
        if view is not None:
            hear(view, status, notice.response, released=notice.released)
            if notice.released:
                self._taken[held.id] = view
        if notice.released:
            self._drop(held.id)
        left = itertools.count(len(listeners) - 1, -1)

        def through() -> None:
            if next(left) <= 0:
                if notice.released:
                    self._taken.pop(held.id, None)
                heard(status.is_handled)

        for listener in listeners:
            self._run(held, listener, status, through)
        if not listeners:
            through()

    def _run(self, held: Held, listener: _Listener, status: Status, through: Callable[[], None]) -> None:
        def done(_result: Any, error: BaseException | None) -> None:
            through()
            if error is not None:
                self._actor.callback_failures += 1
                log_raised(logger, error, "%s: a status callback for %s raised", self._actor.name, held.server)

        try:
            run, gate = self.callbacks.beginning(held.id, listener), self._actor.gate
            run = run if gate is None else gate.around(run, enters=True)
            self._actor.workers.serial(("hear", held.id), run, status, done=done)
        except Unavailable as error:
            done(None, error)

    def _all_streams(self, query: Query[Any]) -> Callable[[], bool]:
        return functools.partial(self.has_all_streams, query)

    def has_all_streams(self, query: Query[Any]) -> bool:
        """Return whether the callbacks that open streams of the resource have ended: its provider runs, and ran then.

        They end before a load is answered. After a crash of the provider this is not known.
        """
        catalog = self._actor.catalog
        held, client = catalog.held.get(query.id), self._actor.clients.get(query.registrar)
        return held is not None and held.seq > catalog.since and client is not None and client.has_run_since(held.seq)

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

        After a first wait without an answer, reads wait no more: the question stays open until the provider is back.
        """
        dispatcher = self._actor.node.dispatcher
        if dispatcher.is_loop_thread() or self._actor.closed or server_id in self._silent:
            return None
        told = Flag()
        dispatcher.call(self._actor.types.tell, parse_server_id(server_id), told.set)
        if not told.wait(_TYPES_S):
            self._silent.add(server_id)
        return self._actor.catalog.server_types.get(server_id)
