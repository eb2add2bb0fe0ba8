"""Registrar: the class with which an application loads, unloads and serves resources, from any thread.

Most methods give the registrar's actor a command and wait, with a time limit, for its end. None waits on the event
loop. The docstrings have the promises.
"""

from __future__ import annotations

import abc
import asyncio
import functools
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, Unpack, cast, overload

import pykka
from msgspec.structs import replace

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base import pickling
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import NotSerializable, UnknownQuery, UsageError, exact_text, is_a, shortened, shown
from rr_actors.base.names import SERVERS, ServerId, check_name, named, new_id, parse_server, parsed_server, planned_id
from rr_actors.base.notebook import bundle_or_text, table
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode, text_of_value
from rr_actors.base.values.failure import error_of
from rr_actors.registrar.arguments import (
    DEFAULTS,
    GroupKeywords,
    LoadKeywords,
    LoadOptions,
    Parent,
    callers_loop,
    check_allowed,
    check_keywords,
    check_text,
    checked,
    checked_callback,
    checked_priority,
    passed_on,
    resource_target,
    server_target,
    shows,
    status_callback,
    target_id,
)
from rr_actors.registrar.declarations import Declared
from rr_actors.registrar.engine.cut import CatalogCopy, take_part
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import RECOVER_S, ServerSpec, checked_spec, checked_whole, log_unread_types
from rr_actors.registrar.engine.status import message_text
from rr_actors.registrar.links.provider_link import FetchQueries
from rr_actors.registrar.links.remote_calls import for_handles
from rr_actors.registrar.load_groups import Group, GroupWays, LoadWanted, Queries, wanted
from rr_actors.registrar.loads import CALL_TIMEOUT_S, Calls, Loads, LoadWays, Unloads, UnloadWays, settle
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.health import Health
from rr_actors.registrar.model.messages import FetchedQuery
from rr_actors.registrar.model.rows import (
    STANDBY,
    Held,
    Hold,
    Phase,
    Put,
    Resource,
    State,
    StoredServer,
    priority_of,
    types_id,
)
from rr_actors.registrar.model.rows import ServedQuery as QueryRow
from rr_actors.registrar.pages import RowPage, Wanted, counted_loads, load_rows, page_of
from rr_actors.registrar.queries import (
    PLAIN,
    Query,
    ResourceInfo,
    Status,
    StatusCallback,
    Subscription,
    Views,
    response_bytes,
)
from rr_actors.registrar.replacements import Replacements, encoded_response
from rr_actors.registrar.servers.callback_context import (
    Current,
    check_not_measuring,
    check_not_own,
    current_or_none,
    serving,
    status_callback_of,
)
from rr_actors.registrar.servers.on_demand_callbacks import Measured, Usages
from rr_actors.registrar.servers.registered_servers import reread_values, server_of
from rr_actors.registrar.servers.server_actor import ServerActor
from rr_actors.runtime.event_loop import check_asyncio
from rr_actors.runtime.time_limits import RunningLimit, finite_time, time_limit
from rr_actors.runtime.user_loop import CallersLoop
from rr_actors.streams.stream import StreamInfo

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    Response = TypeVar("Response", default=Any)  # for a server that is named by a str
else:
    from typing import TypeVar

    Response = TypeVar("Response")

Request = TypeVar("Request")

logger = Log("rr_actors.registrar")

_KEPT = (
    "%s/%s: a process that has ended had loaded %d of its resources. They are kept as they are. What that process "
    "had in memory for them (open files, objects, threads) is gone. Declare a recover callback, which opens it again "
    "and returns the response, or recovery='reload' or 'lost'. If they live outside the process, say recovery='keep'."
)

NO_FIELDS: Any = {}
"""The request of a load that gives none."""

_ALL_STREAMS = Wanted("streams", limit=sys.maxsize)

_IN_ONE_STEP = 200  # rows: an answer with more holds Python's lock for longer than 5 ms
_SHOWN = 50  # rows of a picture in a notebook
_AT_ONCE = 64  # usage callbacks that begin together
_PATIENCE_S = 0.25  # after that, the next ones begin: some that hang do not hold them up


class Consumer(abc.ABC):
    """The calls that load and unload: the same for every kind of registrar.

    They check the arguments. The ways to load and unload are those of the kind: of a registrar of this process (Loads,
    Unloads), or of one that another process has (RemoteLoads).
    """

    _unload_ways: UnloadWays
    _warned_in_event_loop = False
    _is_alone = True  # the system ends at this host, so a server's id is what it says
    _encode = staticmethod(encode)

    @property
    @abc.abstractmethod
    def _load_ways(self) -> LoadWays:
        """The ways in which this registrar loads."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The registrar's name, unique in its system."""

    @abc.abstractmethod
    def _target(self, server: object, within_s: float | None = None) -> ServerId:
        """Return the id of the server that is meant, within so many seconds if another process has to be asked."""

    @abc.abstractmethod
    def _holder(self, parent: Parent | None) -> tuple[Consumer, str]:
        """Return the registrar that holds the next load, and the id of its resource that needs it; "" for none."""

    @abc.abstractmethod
    def _group(self, requests: Sequence[LoadWanted], parent: str, options: LoadOptions) -> GroupWays:
        """Return a group of loads that has not begun."""

    @abc.abstractmethod
    def _check_open(self) -> None:
        """Raise RegistrarDown if the registrar is closed."""

    @abc.abstractmethod
    def _may_block(self) -> bool:
        """Return whether the calling thread may wait."""

    @abc.abstractmethod
    def _listen(self, server: str, id: str, callback: StatusCallback) -> None:
        """Have the callback called for every query at a server, until _stop_listening() gets the same id."""

    @abc.abstractmethod
    def _stop_listening(self, server: str, id: str) -> None:
        """Begin the callback no more; do nothing if it is stopped."""

    # -- status --------------------------------------------------------------------------------------------------

    def on_status(self, server: str | Declared[Any, Any, Any], callback: StatusCallback) -> Subscription:
        """Call `callback(status)` for every query that this registrar holds at that server, now and later.

        Several callbacks are called side by side, until each is stopped. `status.query` is the query. As in a load's
        `on_status`, `status.handled()` stops the status from going further up.

        Returns:
            A Subscription. Its `stop()` stops the callback, and so does the end of a ``with`` block. It also ends with
            the registrar's process.
        """
        key, id = str(self._target(server)), new_id()
        self._listen(key, id, callback)
        return Subscription(functools.partial(self._stop_listening, key, id))

    # -- load ----------------------------------------------------------------------------------------------------

    # The overloads have bodies for Jedi: see passed_on().

    @overload
    def load(
        self,
        server: str | Declared[Request, Any, Response],
        request: Request = ...,
        *,
        response_type: type[Response] | None = None,
        block: Literal[True] = True,
        **options: Unpack[LoadKeywords],
    ) -> Query[Response]:
        return passed_on(**options)

    @overload
    def load(
        self,
        server: str | Declared[Request, Any, Response],
        request: Request = ...,
        *,
        response_type: type[Response] | None = None,
        block: Literal[False],
        **options: Unpack[LoadKeywords],
    ) -> pykka.Future[Query[Response]]:
        return passed_on(**options)

    @shows(LoadKeywords)
    def load(
        self,
        server: str | Declared[Any, Any, Any],
        request: Any = NO_FIELDS,
        *,
        response_type: Any = None,
        block: bool = True,
        **options: Unpack[LoadKeywords],
    ) -> Any:
        """Load the resource for this request, or share it if somebody holds it already.

        If a callback makes the call, the resource becomes a dependency of the callback's resource.

        Args:
            server: "registrar/server"; or the method that declares it, such as `Cameras.open_camera`, if exactly one
                child of the system has that class. Type checkers then know the response's type.
            request: a value of the server's request type (docs/values.md). By default it has no fields: for a callback
                without parameters, or with defaults for all.
            response_type: the type to read the response as, in place of the type that the server declares.
            on_status: a worker calls it with each Status of this query, in order. With load_async(), an ``async def``
                runs on the event loop that awaits the load, in the caller's context. For a dependency it runs before
                the status callback of the resource that needs it, and instead of it if it calls `status.handled()`.
            timeout_s: seconds that the whole load may take. After that the load is withdrawn. None: no limit.
            parent: rr.current() of the callback, if another thread makes the call for it.
            priority: how urgently the resource is needed, from -1000 to 1000; None: on standby. A dependency for which
                none is given inherits the priority of the resource that needs it (docs/planning.md).
            wait_s: seconds that the load may wait in line for an exclusive resource. With 0 it fails at once while
                somebody has it. None: as long as the whole load may take.
            progress: a callable that hears each rr.Progress that the load callback reports, while this load waits. Or
                True: draw a bar, if standard error is a terminal (needs the extra `progress`). The thread that waits
                calls it: the calling thread, with load_async() the task's event loop, with ``block=False`` a worker.
            block: False returns a Pykka future of the query at once.

        Returns:
            The Query, or with ``block=False`` a future of it.

        Raises:
            LoadFailed: the provider could not load it, most often because a load callback raised. `.trace` has the
                places.
            CircularDependency: the request would wait for itself. `.ring` has the servers around the ring; the text
                names the request that closes it.
            ResourceBusy: somebody else has the exclusive resource, and `wait_s` is over. `.holder`, `.since`
            LoadTimeout: the provider did not answer in time.
            UnknownServer, UnknownRegistrar, InvalidName: there is no such server.
            InvalidRequest, NotSerializable: the request has another type, or cannot travel.
            UsageError: several children of the system have the class that declares the server; `progress` is neither a
                callable nor a bool, or is True without rich; or the priority is wrong, or over `max_priority`.
            RegistrarDown: the provider is stopped or gone for good.
            MailboxFull: too many loads are in flight.
        """
        if block and asyncio._get_running_loop() is not None:
            self._warn_in_event_loop("load", "load_async")
        wanted = checked("load", response_type, **options) if options or response_type is not None else DEFAULTS
        owner, parent = self._holder(wanted.parent)
        is_plain = type(server) is str and "/" in server and self._is_alone
        target = parsed_server(server) if is_plain else self._target(server, wanted.timeout_s)
        loads = owner._load_ways
        return (loads.wait if block else loads.begin)(target, self._encode(request), parent, wanted)

    @shows(LoadKeywords)
    async def load_async(
        self,
        server: str | Declared[Request, Any, Response],
        request: Request = NO_FIELDS,
        *,
        response_type: type[Response] | None = None,
        **options: Unpack[LoadKeywords],
    ) -> Query[Response]:
        """Load as load() does, awaited. If it is cancelled, the load is withdrawn."""
        wanted = checked("load_async", response_type, **options)
        owner, parent = self._holder(wanted.parent)
        target = self._target(server, wanted.timeout_s)
        return await owner._load_ways.awaited(target, self._encode(request), parent, wanted)

    def _warn_in_event_loop(self, called: str, instead: str) -> None:
        """Warn once for each registrar that a call blocks the event loop of the calling thread.

        A notebook runs each cell on its kernel's event loop, which has nothing else to do.
        """
        if self._warned_in_event_loop or "ipykernel" in sys.modules:
            return
        if not self._may_block():  # a callback that is a coroutine: the call is refused
            return
        self._warned_in_event_loop = True
        text = f"{called}() blocks the event loop that runs in this thread until it returns"
        warnings.warn(f"registrar {self.name!r}: {text}: write `await {instead}(...)`", RuntimeWarning, stacklevel=3)

    @shows(GroupKeywords)
    def load_all(self, requests: Iterable[tuple[str, Any]], **options: Unpack[GroupKeywords]) -> Queries:
        """Load several resources at once, and hold all of them or none::

            with app.load_all([("cameras/camera", "front"), ("maps/map", "hall")]) as (camera, map):
                ...

        Args:
            requests: one ("registrar/server", request) for each load.
            on_status, parent, priority, wait_s: as for load(), for each load.
            timeout_s: seconds that each load may take. None: no limit.

        Returns:
            The queries, in the order of the requests: a tuple, and a context manager that unloads them.

        Raises:
            The first error of a load, with a note that names its request. Everything that was held is released.
        """
        if asyncio._get_running_loop() is not None:
            self._warn_in_event_loop("load_all", "load_all_async")
        return self._asked("load_all", requests, options).wait()

    @shows(GroupKeywords)
    async def load_all_async(self, requests: Iterable[tuple[str, Any]], **options: Unpack[GroupKeywords]) -> Queries:
        """Load as load_all() does, awaited. If it is cancelled, all loads are released or withdrawn."""
        return await self._asked("load_all_async", requests, options).awaited()

    def _asked(self, called: str, requests: Iterable[tuple[str, Any]], given: GroupKeywords) -> GroupWays:
        """Return a group of loads that has not begun, with its arguments checked."""
        check_keywords(called, given, GroupKeywords)
        asked = wanted(requests, self._target, self._encode)
        options = checked(called, **given)
        owner, parent = self._holder(options.parent)
        return owner._group(asked, parent, options)

    # -- unload --------------------------------------------------------------------------------------------------

    @overload
    def unload(
        self,
        query_or_id: Query | ResourceInfo | str,
        *,
        force: bool = False,
        timeout_s: float | None = 30.0,
        block: Literal[True] = True,
    ) -> None: ...
    @overload
    def unload(
        self,
        query_or_id: Query | ResourceInfo | str,
        *,
        force: bool = False,
        timeout_s: float | None = 30.0,
        block: Literal[False],
    ) -> pykka.Future[None]: ...
    @overload
    def unload(
        self,
        query_or_id: Query | ResourceInfo | str,
        *,
        force: bool = False,
        timeout_s: float | None = 30.0,
        block: bool = True,
    ) -> pykka.Future[None] | None: ...

    @for_handles(repeatable=False)
    def unload(
        self,
        query_or_id: Query | ResourceInfo | str,
        *,
        force: bool = False,
        timeout_s: float | None = 30.0,
        block: bool = True,
    ) -> Any:
        """Release a query. Return when the unload callback has run, or at once if others hold the resource.

        Args:
            query_or_id: a query of this registrar, or its id. With `force`: a resource served here, a query on it, or
                the id of either.
            force: unload the resource although it is held. Its holders hear FATAL.
            timeout_s: seconds to wait for a provider that is down. None: no limit.
            block: False returns a Pykka future at once.

        Raises:
            UnknownQuery: this registrar never held the query, or has unloaded it already.
            NotHolder: another registrar holds the query.
            UnloadFailed: the unload callback raised. The query is still held, and can be unloaded again.
            UsageError: with `force`, a callback of that resource made the call, and would wait for itself. Or the call
                comes from outside, by a handle, and the query is a part that a resource of this registrar holds.
            Unavailable: the provider did not come back in time. The release is owed, on disk, until it does.
        """
        query_id, limit_s = self._checked_unload(query_or_id, force, timeout_s)
        unloads = self._unload_ways
        if force:
            return (unloads.force_wait if block else unloads.force_begin)(query_id, limit_s)
        return unloads.wait(query_id, limit_s) if block else unloads.begin(query_id, limit_s)

    def _checked_unload(
        self, query_or_id: Query | ResourceInfo | str, force: bool, timeout_s: float | None
    ) -> tuple[str, float | None]:
        self._check_open()
        limit_s = time_limit(timeout_s)
        query_id = target_id(query_or_id)
        if not force and is_a(query_or_id, Query) and query_or_id.origin != self.name:
            raise error_of(failures.not_holder(query_id, query_or_id.origin, self.name))
        return query_id, limit_s

    async def unload_async(
        self, query_or_id: Query | ResourceInfo | str, *, force: bool = False, timeout_s: float | None = 30.0
    ) -> None:
        """Release a query as unload() does, awaited. If it is cancelled, the unload goes on."""
        check_asyncio("unload_async")
        query_id, limit_s = self._checked_unload(query_or_id, force, timeout_s)
        unloads = self._unload_ways
        await (unloads.force_begin if force else unloads.awaited)(query_id, limit_s)

    @overload
    def unload_client(self, server: str, *, timeout_s: float | None = 30.0, block: Literal[True] = True) -> None: ...
    @overload
    def unload_client(
        self, server: str, *, timeout_s: float | None = 30.0, block: Literal[False]
    ) -> pykka.Future[None]: ...
    @overload
    def unload_client(
        self, server: str, *, timeout_s: float | None = 30.0, block: bool
    ) -> pykka.Future[None] | None: ...

    @for_handles(repeatable=False)
    def unload_client(self, server: str, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Release everything that this registrar holds at one server ("registrar/server"), newest first.

        Raises:
            InvalidName: `server` does not have that form.
            UnknownServer: this registrar holds nothing there and never did. `.known` has the servers where it does.
            UsageError: the call comes from outside, by a handle, and a resource of this registrar has a part there.
            The errors of unload(), after all queries have been tried.
        """
        self._check_open()
        unloads = self._unload_ways
        return (unloads.wait_all if block else unloads.begin_all)(self._target(server), time_limit(timeout_s))

    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: Literal[True] = True) -> None: ...
    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: Literal[False]) -> pykka.Future[None]: ...
    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool) -> pykka.Future[None] | None: ...

    @for_handles(repeatable=False)
    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Release everything that this registrar holds for itself, newest first. Its resources keep their dependencies.

        Raises:
            The errors of unload(), after all queries have been tried.
        """
        self._check_open()
        return (self._unload_ways.wait_all if block else self._unload_ways.begin_all)(None, time_limit(timeout_s))


class Registrar(Consumer):
    """A registrar of this process. It consumes resources of other registrars, provides its own, or both.

    System.open_registrar() makes one, and every Manager has one. Call its methods from any thread. With ``block=False``
    they return a Pykka future, which can also be awaited.
    """

    def __init__(self, node: Node, actor: RegistrarActor) -> None:
        self._actor = actor
        self._node = node
        self._is_alone = node.info.hosts is None
        self._calls = Calls(actor)
        self._views = Views(actor, self)
        self._loads = Loads(self._calls, self._views)
        self._unload_ways = self._unloads = Unloads(self._calls, self._views)
        self._replacements = Replacements(self._loads, self._unloads)
        actor.audience = self._views

    @property
    def _load_ways(self) -> LoadWays:
        return self._loads

    @property
    def name(self) -> str:
        """The registrar's name, unique in its system."""
        return self._actor.name

    @property
    def config(self) -> RegistrarConfig:
        """The configuration: where and how the catalog is kept."""
        return self._actor.config

    @property
    def directory(self) -> Path:
        """The private directory of the catalog. The owner may keep files there that belong with it."""
        return self.config.catalog_path(self._node.info.state_dir).parent

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        def tables() -> str:
            served = self._page(Wanted("resources", limit=_SHOWN))
            held = self._page(Wanted("queries", limit=_SHOWN))
            serves = [
                (row.server, row.request, row.response, row.condition, ", ".join(one.origin for one in row.holders))
                for row in served.resources
            ]
            holds = [(row.server, row.request, row.state, row.parent or "itself") for row in held.queries]
            text = ", ".join(self.servers()) or "none"
            return (
                table(("",), [(f"{self.name}: servers: {text}",)])
                + table(("server", "request", "response", "state", "held by"), serves, f"serves {served.total}")
                + table(("server", "request", "state", "for"), holds, f"holds {held.total}")
            )

        return bundle_or_text(repr(self), tables)

    def __repr__(self) -> str:
        return f"<Registrar {self.name}{' (closed)' if self._actor.closed else ''}>"

    def __reduce__(self) -> NoReturn:
        raise NotSerializable(f"registrar {self.name!r} belongs to its process: send its name instead", path="")

    # -- serving -------------------------------------------------------------------------------------------------

    def register_server(
        self,
        name: str,
        load: Callable[..., Any],
        unload: Callable[..., Any] | None = None,
        *,
        status: Callable[..., Any] | None = None,
        recover: Callable[..., Any] | None = None,
        request_type: Any = None,
        response_type: Any = None,
        linger_s: float = 0.0,
        load_timeout_s: float | None = None,
        recover_timeout_s: float | None = RECOVER_S,
        recovery: Literal["keep", "reload", "lost"] | None = None,
        usage: Callable[..., Any] | None = None,
        idle: Literal["unload", "pause"] = "unload",
        paused_s: float | None = None,
        pause: Callable[..., Any] | None = None,
        resume: Callable[..., Any] | None = None,
        health: Health | None = None,
        probe: Callable[..., Any] | None = None,
        provides: Mapping[str, Mapping[str, object]] | None = None,
        at_once: int | None = None,
        exclusive: bool = False,
        grace_s: float | None = None,
        title: Callable[..., str] | None = None,
    ) -> None:
        """Offer resources of a new kind as "<this registrar>/<name>".

        Args:
            load: ``load(request) -> response``. Plain or ``async def``; like all callbacks it runs off the loop. With
                several parameters or none, the callbacks take the fields of the request in its place (docs/values.md).
            unload: ``unload(request, response)`` runs when the last holder has released the resource. After an
                interrupted load that was withdrawn or given up, the response is None and ``rr.current().interrupted``
                is true. Default: None. Give one where something has to be closed.
            status: ``status(request, status)`` runs for a status of the resource itself, before the holders hear it
                (``status.resource_id`` is then rr.current().resource_id), and for statuses of its dependencies.
                Default: None. Give one to replace a part that fails.
            recover: ``recover(request, response) -> response`` runs after a respawn. It returns the response if the
                resource lives, and raises if it is lost. Default: None. Give one where a crash ends what was loaded,
                such as a connection.
            request_type, response_type: the types of both. Default: None, the annotations of `load`; without these, any
                plain value. Set them for a callable without annotations.
            linger_s: seconds for which a resource without holders is kept. Default: 0.0. Raise it where loading takes
                long and the next holder often comes soon.
            load_timeout_s: seconds after which a running `load` counts as failed. Default: None, no limit but that of
                each caller. Set it where a device may hang, and its callers wait for long.
            recover_timeout_s: seconds after which a running `recover` counts as failed, and the resource as lost.
                Default: 30.0. Raise it for a slow device; None sets no limit.
            recovery: without `recover`: "keep" the resource, "reload" it, or give it up as "lost". Default: None, as
                "keep", and the log has a warning if a process that has ended had loaded kept resources. Set "keep" for
                what lives outside the process, "reload" or "lost" for what ends with it.
            usage: ``usage(request, response)`` returns what a loaded resource uses now, as a dict of numbers; usage()
                runs it. Default: None. Give one where a resource takes CPU, memory, power or a like amount.
            idle: what happens after `linger_s` to a resource that nobody holds, or that all its holders have on
                standby: "unload" it if nobody holds it, or "pause" it. Default: unload. Give "pause" where a start
                takes long, and idling costs CPU or power.
            paused_s: seconds after which a paused resource is unloaded that nobody holds. Default: None, never. Give
                them where a paused one keeps memory.
            pause: ``pause(request, response)`` runs when it is paused. Default: None. Give one with idle="pause".
            resume: ``resume(request, response)`` runs when the resource is needed again, and may return a new response.
                Default: None. Give one with idle="pause".
            health: how often `probe` runs, and what follows. Default: None, never. Give one if a resource fails unseen.
            probe: ``probe(request, response)`` says how well a loaded resource is: it returns None (well), a State or a
                Status, or it raises. Default: None. Give one with `health`.
            provides: labels, as `{"range": {"rate_hz": 30}}`. Default: None. Give them where Choices shall find it.
            at_once: how many callbacks of the server run at a time; others wait, in their order. A callback that waits
                for a load, an unload or a reply lets another in meanwhile. Default: None, as many as there are. Give 1
                where a driver is not safe for threads. A serial manager has 1 for all its servers.
            exclusive: each resource has one holder at a time. The other loads of its request wait in line: the most
                urgent first, then the one that came first. Default: False, they share it. Give True for what two
                users must not use at the same time, such as an instrument.
            grace_s: how long the holder of an exclusive resource has to release it when a load with a higher priority
                waits. It hears FATAL, with ``status.reason == "revoked"``. Default: None, 5 seconds. Raise it if
                holders need longer to save their work.
            title: ``title(request)`` returns what lists, pictures and events show in the place of the request. It is
                called from several threads, and must not wait. Default: None, the request's method ``__rr_title__``,
                if it has one. Give one where requests are long.

        Raises:
            InvalidName: `name` has other characters than ASCII letters, digits, "_", "-" and ".".
            NameTaken: this registrar has a server of this name.
            InvalidSpec: a callback or an option is wrong.
            NotSerializable: a callback cannot travel to the registrar's process.
        """
        callbacks, types = (load, unload, status, recover), (request_type, response_type)
        limits = linger_s, load_timeout_s, recovery, recover_timeout_s
        spec = ServerSpec(name, *callbacks, *types, *limits, usage=usage, idle=idle, paused_s=paused_s)
        spec = replace(spec, pause=pause, resume=resume, health=health, probe=probe)
        spec = replace(spec, provides=provides, at_once=at_once, exclusive=exclusive, grace_s=grace_s, title=title)
        self._register_spec(checked_whole(checked_spec(spec)))

    def _register_spec(self, spec: ServerSpec, *, stored: bytes | None = None, restored: bool = False) -> None:
        """Register a server from its checked spec. With `stored`, these bytes of the spec are kept in the catalog.

        A `restored` server, which comes from the catalog, is replaced if its name is registered again.
        """
        origin = f"{self.name}/{spec.name}"
        is_declared_here = stored is None and not restored
        if is_declared_here:
            log_unread_types(spec, origin)
        types = pickling.dumps((spec.request_type, spec.response_type), f"{origin}: types")
        path = f"{self._actor.actor_ref.path}/{SERVERS}/{spec.name}"
        server = server_of(path, self._actor, spec, types)
        server.restored = restored
        with self._actor.enter():
            catalog = self._actor.whole()
            resources = [catalog.resources[id] for id in catalog.by_server.get(spec.name, ())]
            known = catalog.server_types.get(types_id(spec.name))
        reread = reread_values(server, resources, b"" if known is None else known.blob)
        kept = self._calls.call(self._register, server, stored, reread)
        if kept and is_declared_here and spec.recovery is None and spec.recover is None:
            logger.warning(_KEPT, self.name, spec.name, kept)

    def _register(self, server: ServerActor, stored: bytes | None, reread: tuple[c.Reread, ...]) -> int:
        """Register a server on the loop, and return how many usable held resources it finds; 0 if it replaces one."""
        name = server.spec.name
        with self._actor.enter():
            catalog = self._actor.whole()
            lost = {found.resource_id for found in reread if found.misfit}
            ids = [id for id in catalog.by_server.get(name, ()) if id in catalog.holders and id not in lost]
            resources = [catalog.resources[id] for id in ids]
        kept = sum(found.phase is Phase.LOADED and found.state is not State.FATAL for found in resources)
        known = self._actor.servers.get(name)
        self._actor.servers.register(server, reread)
        if stored is not None:
            self._actor.commit_rows([Put(StoredServer(name, stored))])
        return kept if known is None else 0

    @for_handles(repeatable=False)
    def _take_part(self, registrar: str, socket: str, place: str) -> list[CatalogCopy]:
        """Copy the catalogs of this process at the moment that the processes of the system agree on. In a worker."""
        return take_part(self._node, registrar, socket, Path(place))

    @for_handles(repeatable=False)
    def _register_stored(self, blob: bytes) -> None:
        """Register a server that another process sent by value, and keep it in the catalog. In a worker."""
        self._register_spec(pickling.loads(blob), stored=blob)

    @for_handles(repeatable=False)
    def _unload_from_outside(self, query_id: str, *, timeout_s: float | None = 30.0) -> None:
        """Release a query as unload() does, for a handle. A part is its whole's to release: its callbacks may."""
        self._check_no_part(query_id)
        self.unload(query_id, timeout_s=timeout_s)

    @for_handles(repeatable=False)
    def _unload_client_from_outside(self, server: str, *, timeout_s: float | None = 30.0) -> None:
        """Release as unload_client() does, for a handle, unless that would take a part from its whole."""
        for row in self._held_now():
            if f"{row.registrar}/{row.server}" == server:
                self._check_no_part(row.id)
        self.unload_client(server, timeout_s=timeout_s)

    def _check_no_part(self, query_id: str) -> None:
        with self._actor.enter():
            catalog = self._actor.whole()
            held = catalog.held.get(query_id)
            whole = None if held is None or held.hold is Hold.OWED else catalog.resources.get(held.parent)
            failure = None if whole is None else failures.held_by_whole(query_id, _name_of(whole, self._actor))
        if failure is not None:
            raise error_of(failure)

    @for_handles(repeatable=False)
    def unregister_server(self, name: str, *, timeout_s: float | None = 30.0) -> None:
        """Remove a server: release all queries on it, send its holders FATAL, unload its resources.

        Resources that wait for a server of this name, which is not registered, are removed without its callbacks.

        Raises:
            UnknownServer: this registrar has no server of that name, and no resource that waits for one.
            UnloadFailed: an unload callback raised. The resource stays in the catalog.
            UsageError: a callback of this server made the call, and would wait for itself. Nothing has changed.
        """
        limit_s = time_limit(timeout_s)
        name = check_text(name, "unregister_server: expected a server's name")
        self._calls.check_open()
        whose, instead = (self._actor, name), "start a thread for it, and let the callback return"
        what = f"registrar {self.name!r}: unregister_server({shown(name)})"
        check_not_own(what, lambda me: (serving(me), me.server) == whose, instead)
        start = functools.partial(self._actor.servers.unregister, name)
        self._calls.finish(self._calls.start(start), limit_s, f"unregistering {self.name}/{name}")

    @for_handles(repeatable=False)
    def send_status(self, query_or_resource_id: Query | ResourceInfo | str, status: Status) -> None:
        """Send a status of a resource served here to all its holders. Return when it is on disk.

        The status callback of its server runs first, and may stop the status by `status.handled()`. It does not run
        for a status that the callback itself sends.

        Args:
            query_or_resource_id: the resource or its id, or a query on it or the query's id.

        Raises:
            UnknownQuery: this registrar serves no such resource.
        """
        if type(status) is not Status and not is_a(status, Status):
            raise UsageError(f"send_status: expected a Status, got {type(status).__name__} ({shown(status)})")
        resource = resource_target(query_or_resource_id)
        state, text = State(status.state), message_text(status.message)
        own = "" if current_or_none() is None else status_callback_of(self._actor)
        what = f"status for {target_id(query_or_resource_id)}"
        self._calls.command(lambda ticket: c.SetStatus(resource, new_id(), state, text, ticket, own), what)

    @for_handles(repeatable=False)
    def revoke(
        self,
        query_or_resource_id: Query | ResourceInfo | str,
        why: str,
        *,
        grace_s: float = 5.0,
        timeout_s: float | None = None,
    ) -> None:
        """Take a resource served here away from its holders, the highest first. Return when it is unloaded.

        Each holder hears FATAL with `status.reason == "revoked"`, and its query is released when its callbacks have
        heard that. A resource that depends on this one is revoked itself, unless its status callback has put another in
        its place, or says `status.handled()`. New requests wait until the resource is gone.

        Args:
            query_or_resource_id: the resource or its id, or a query on it or the query's id.
            grace_s: seconds after which the resource is unloaded by force.
            timeout_s: seconds to wait. The revocation goes on after them.

        Raises:
            UnknownQuery: this registrar serves no such resource.
            UsageError: the resource is not loaded, or is revoked already; or `grace_s` is no time; or a callback of the
                resource made the call, and would wait for itself.
            UnloadFailed: the unload callback raised.
        """
        self._check_open()
        seconds = finite_time(grace_s, "revoke: grace_s")
        target, limit_s = target_id(query_or_resource_id), time_limit(timeout_s)
        self._unloads.revoke(target, message_text(why), seconds, limit_s)

    @for_handles(repeatable=False)
    def reload(self, query_or_resource_id: Query | ResourceInfo | str, *, timeout_s: float | None = None) -> None:
        """Unload a resource served here and load it again for the same request; return when that is done.

        The unload callback runs, the parts of the resource are released, and the load callback runs, which may load
        them again. The holders keep their queries, and hear UPDATE with the new response. Loads and unloads of the
        resource wait meanwhile. After a crash the reload goes on where it was.

        Args:
            query_or_resource_id: the resource or its id, or a query on it or the query's id.
            timeout_s: seconds to wait. The reload goes on after them.

        Raises:
            UnknownQuery: this registrar serves no such resource.
            UsageError: the resource is not loaded, or is FATAL, revoked or being reloaded already; or a callback of the
                resource made the call, and would wait for itself.
            UnloadFailed: the unload callback raised. The resource is not loaded again, and its holders hear ERROR.
            LoadFailed: the load callback raised. The holders hear FATAL.
        """
        self._check_open()
        self._unloads.reload(target_id(query_or_resource_id), time_limit(timeout_s))

    @for_handles(repeatable=False)
    def update_response(
        self, query_or_resource_id: Query | ResourceInfo | str, response: Any, message: str = "late response"
    ) -> None:
        """Replace the stored response of a resource served here, and send UPDATE to its holders.

        Raises:
            UnknownQuery: this registrar serves no such resource.
            InvalidResponse, NotSerializable: the response has another type, or cannot travel. Nothing has changed.
            UsageError: the load callback of the resource has not returned.
        """
        target = resource_target(query_or_resource_id)
        resource, server = self._calls.call(self._served, target)
        raw = encoded_response(response, resource, server)
        text = message_text(message)
        own = status_callback_of(self._actor)
        what = f"response for {target_id(query_or_resource_id)}"
        self._calls.command(lambda ticket: c.SetResponse(target, new_id(), raw, text, ticket, own), what)

    def _served(self, target: str) -> tuple[Resource | None, ServerActor | None]:
        with self._actor.enter():
            resource = self._actor.whole().find(target)
        return resource, None if resource is None else self._actor.servers.get(resource.server)

    def replace_part(
        self,
        status: Status,
        request: Any,
        server: str | Declared[Any, Any, Any] | None = None,
        *,
        part: Query | str | None = None,
        response: Callable[[Query], Any] | None = None,
        timeout_s: float | None = 30.0,
    ) -> Query:
        """Replace the part that a status is about, in the status callback of the resource that holds it::

            @load_robot.status
            def robot_status(self, request: str, status: rr.Status) -> None:
                if status.query_id and status.state is rr.State.FATAL:
                    self.registrar.replace_part(status, "spare", response=lambda spare: spare.response)

        Load the spare as a part of the same resource. One commit then holds it in the place of the part, owes the
        part's release, and replaces the response of the resource. Its holders hear UPDATE, and the status is handled.
        Before that commit a crash has the callback run again, and the same call uses the spare that is loaded. After
        it, the call is done. In an ``async def`` callback, call it with ``await asyncio.to_thread(...)``.

        Args:
            status: the status that the callback got. `status.query_id` names the part.
            request: the request of the spare. After a crash it must be the same as before.
            server: the server that loads the spare. None: the server of the part.
            part: the part to replace, or the id of its query. None: the part that the status is about. The status of
                the resource itself may be the occasion to replace a part that works by a better one.
            response: makes the new response of the resource. It gets the spare's Query. None: the response stays.
            timeout_s: seconds that the load may take. None: no limit.

        Returns:
            The Query of the spare. If the part was replaced before for this status, the Query of that spare.

        Raises:
            The errors of load() and `response`: nothing is replaced; the status goes up unless the callback handles it.
            InvalidResponse, NotSerializable: the new response has another type, or cannot travel.
            UnknownQuery: the resource does not hold the part any more.
            UsageError: not called in a status callback; or the status is of the resource itself, and no part is named.
        """
        limit_s = time_limit(timeout_s)
        if response is not None and not callable(response):
            expected = "expected a function that takes the spare's Query and returns the new response"
            raise UsageError(f"replace_part: response: {expected}, got {shown(response)} ({type(response).__name__})")
        target = None if server is None else self._target(server)
        if not is_a(status, Status):
            raise UsageError(f"replace_part: expected the Status of the callback, got {shown(status)}")
        owner, resource_id = self._holder(None)
        if not (resource_id and isinstance(owner, Registrar)):
            where = "expected to be called in a status callback of a server"
            raise UsageError(f"registrar {self.name!r}: replace_part: {where}")
        part_id = status.query_id if part is None else target_id(part)
        return owner._replacements.replace(status, part_id, request, target, response, limit_s)

    # -- for the calls that load -----------------------------------------------------------------------------------

    def _target(self, server: object, within_s: float | None = None) -> ServerId:
        return server_target(server, self._node)

    def _check_open(self) -> None:
        if self._actor.closed:
            raise self._actor.down()

    def _may_block(self) -> bool:
        return self._node.dispatcher.may_block()

    def _holder(self, parent: Parent | None) -> tuple[Consumer, str]:
        """Return the registrar that holds the next load, and the id of its resource that needs it; "" for none.

        Without `parent`, in a callback of this system, these are the callback's own.
        """
        context: object = parent
        if context is None:
            current = current_or_none()
            if current is None or serving(current).node is not self._node:
                return self, ""
            context = current
        if is_a(context, Current):
            return registrar_of(serving(context)) or self, context.resource_id
        if is_a(context, str):
            return self, exact_text(context)
        if is_a(context, ResourceInfo):
            return self, context.id
        if is_a(context, Query):
            return self, context.resource_id
        raise UsageError(f"parent: expected rr.current() or a resource id, got {type(context).__name__}")

    @for_handles(repeatable=False)
    def _load(
        self, server: str, request: bytes, parent: str = "", options: LoadOptions = DEFAULTS, *, timeout_s: float | None
    ) -> Query:
        """Load with a request's canonical bytes, for another process. In a worker."""
        limited = replace(options, timeout_s=time_limit(timeout_s))
        return self._loads.wait(parse_server(server), request, parent, limited)

    @for_handles(repeatable=False)
    def _load_all(
        self, requests: Sequence[LoadWanted], parent: str, options: LoadOptions, *, timeout_s: float | None
    ) -> Queries:
        """Load all or none, for another process. In a worker."""
        return self._group(requests, parent, replace(options, timeout_s=time_limit(timeout_s))).wait()

    def _group(self, requests: Sequence[LoadWanted], parent: str, options: LoadOptions) -> GroupWays:
        return Group(self._loads, self._unloads, requests, parent, options)

    # -- looking -------------------------------------------------------------------------------------------------

    def queries(self) -> list[Query]:
        """Return every query that this registrar holds, with the dependencies of its resources, oldest first.

        It reads a few hundred at a time. Each is as it was at one moment; others may be loaded or released meanwhile.
        """
        return [query for ids in _batched(self._query_ids()) for query in self._queries_of(ids)]

    @for_handles(repeatable=True)
    def _query_ids(self) -> list[str]:
        held = [row for row in self._calls.call(self._held_now) if row.hold is Hold.HELD]
        return [row.id for row in sorted(held, key=lambda row: row.seq)]

    @for_handles(repeatable=True)
    def _queries_of(self, ids: list[str]) -> list[Query]:
        return self._calls.call(self._queries_now, ids)

    def _queries_now(self, ids: list[str]) -> list[Query]:
        with self._actor.enter():
            held = self._actor.whole().held
            rows = [row for id in ids if (row := held.get(id)) is not None and row.hold is Hold.HELD]
        return [self._views.of(row) for row in rows]

    @for_handles(repeatable=True)
    def fetch_state(self, query_or_id: Query | str) -> State:
        """Return the state of the last status of a query that this registrar holds.

        Raises:
            UnknownQuery: the query is not held any more.
        """
        return self._calls.call(self._held_row, target_id(query_or_id)).state

    @for_handles(repeatable=True)
    def fetch_priority(self, query_or_id: Query | str) -> int | None:
        """Return the priority of a query that this registrar holds; None: on standby.

        Raises:
            UnknownQuery: the query is not held any more.
        """
        return priority_of(self._calls.call(self._held_row, target_id(query_or_id)).priority)

    @for_handles(repeatable=False)
    def set_priority(self, query_or_id: Query | str, priority: int | None) -> None:
        """Give a query that this registrar holds a priority, as `query.priority = 5` does.

        Raises:
            UnknownQuery: the query is not held any more.
            UsageError: the priority is neither None nor a whole number from -1000 to 1000, or over `max_priority`.
        """
        id, given = target_id(query_or_id), checked_priority(priority, "set_priority")
        check_allowed(given, self._actor.config)
        number = STANDBY if given is None else given
        self._calls.command(lambda ticket: c.SetPriority(id, number, ticket), f"the priority of {shortened(id)}")

    def _held_row(self, id: str) -> Held:
        with self._actor.enter():
            row = self._actor.whole().held.get(id)
        if row is None or row.hold is Hold.OWED:
            raise UnknownQuery(f"query {shortened(id)}: {self.name} does not hold it any more", query_id=id)
        return row

    @for_handles(repeatable=True)
    def fetch_queries(self, registrar: str, *, timeout_s: float | None = 30.0) -> list[Query]:
        """Ask a provider for all queries that this registrar holds there, as the provider's catalog has them.

        Raises:
            UnknownRegistrar, RegistrarDown: there is no such registrar, or it is gone for good.
            Unavailable: the provider did not answer in time.
        """
        limit_s = time_limit(timeout_s)
        self._calls.check_open()
        check_name(registrar, "registrar name")
        future: Reply[list[FetchedQuery]] = Reply()

        def fetched(queries: list[FetchedQuery] | None, error: Exception | None) -> None:
            if not future.done():
                settle(future, error, queries)

        self._calls.dispatcher.call(lambda: self._actor.client(registrar).deliver(FetchQueries(fetched)))
        rows = self._calls.finish(future, limit_s, f"fetching from {registrar!r}")
        return [self._fetched_view(registrar, row) for row in rows]

    def _fetched_view(self, registrar: str, row: FetchedQuery) -> Query:
        place = (registrar, row.server, row.request, row.response, row.resource_id, row.parent, row.attempt, row.seq)
        held = Held(row.query_id, *place, Hold.HELD, State(row.state), row.priority, row.own)
        return self._views.seen(held)

    @for_handles(repeatable=True)
    def children(self, query: Query | ResourceInfo | str) -> list[Query]:
        """Return the queries that a resource depends on, oldest first.

        Args:
            query: a resource served here, a query that is held here, or the id of either.

        Raises:
            UnknownQuery: this registrar serves and holds no such thing.
            RegistrarDown, UnknownRegistrar: the provider does not run.
        """
        id = target_id(query)
        if is_a(query, Query):
            provider = query.registrar
        else:
            held = self._actor.catalog.held.get(id)
            provider = None if held is None else held.registrar
        if provider in (None, self.name):
            return self._calls.call(self._children_now, id)
        target, here = resource_target(query), registrar_of(self._node.registrars.get(provider))
        if here is not None:
            return here.children(target)
        reply = self._node.handle(provider).call("children", (target,), {})
        return self._calls.finish(reply, CALL_TIMEOUT_S, f"children of {provider!r}")

    def _children_now(self, target: str) -> list[Query]:
        self._actor.settle()
        with self._actor.enter():
            catalog = self._actor.whole()
            resource = catalog.find(target)
            if resource is None and target not in catalog.parts:
                text = f"{shortened(target)}: {self.name!r} serves no resource and no query of this id"
                raise UnknownQuery(text, query_id=target)
            parts = catalog.parts_of(target if resource is None else resource.id)
            held = [catalog.held[id] for id in reversed(parts)]
        return [self._views.of(row) for row in held]

    def resources(self) -> list[ResourceInfo]:
        """Return every resource served here, with its state, response and holders.

        It reads a few hundred at a time. Each is as it was at one moment; others may come or go meanwhile.
        """
        return [info for ids in _batched(self._resource_ids()) for info in self._infos(ids)]

    @for_handles(repeatable=True)
    def _resource_ids(self) -> list[str]:
        return self._calls.call(self._resource_ids_now)

    def _resource_ids_now(self) -> list[str]:
        with self._actor.enter():
            return list(self._actor.whole().resources)

    @for_handles(repeatable=True)
    def _infos(self, ids: list[str]) -> list[ResourceInfo]:
        return [self._info(*row) for row in self._calls.call(self._resources_now, ids)]

    def _resources_now(
        self, ids: Iterable[str] | None = None
    ) -> list[tuple[Resource, ServerActor | None, list[QueryRow]]]:
        with self._actor.enter():
            catalog, server_of = self._actor.whole(), self._actor.servers.get
            known = catalog.resources
            rows = known.values() if ids is None else [known[id] for id in ids if id in known]
            return [(row, server_of(row.server), catalog.queries_of(row.id)) for row in rows]

    def _info(self, resource: Resource, server: ServerActor | None, queries: list[QueryRow]) -> ResourceInfo:
        """Describe a resource. The calling thread decodes its values, which may run code of users' types."""
        request = (server.request if server else PLAIN).show_stored(resource.request)
        response = None
        if resource.response is not None:
            response = (server.response if server else PLAIN).show(resource.response)
        state = str(resource.state if resource.phase is Phase.LOADED else resource.phase)
        facts = (state, resource.phase, resource.state, resource.message, resource.attempt)
        holders, ids = tuple(query.origin for query in queries), tuple(query.id for query in queries)
        priority = priority_of(max((query.priority for query in queries), default=STANDBY))
        return ResourceInfo(resource.id, resource.server, request, response, *facts, holders, ids, priority)

    def streams(self) -> list[StreamInfo]:
        """Return every open stream of the resources served here, by server, request and name."""
        return [row.info for row in self._page(_ALL_STREAMS).streams]

    @for_handles(repeatable=False)
    def usage(self, *, of: Iterable[str] | None = None, timeout_s: float = 5.0) -> Usages:
        """Return what each loaded resource served here uses now, as the usage callback of its server says.

        A resource of a server without a usage callback is not in it. Nothing is stored.

        Args:
            of: the ids of the resources to ask; None: all.
            timeout_s: seconds that all callbacks together may take. One that has not returned by then is named in
                `failures`; it goes on, and does not begin again for that resource until it has returned.

        Returns:
            A dict, by resource id, of dicts of numbers. `.failures` says, by resource id, why a usage is not known: a
            callback that raises, hangs, or returns anything other than finite numbers holds up no other.

        Raises:
            UsageError: a usage callback of this registrar made the call, or the call would hang in this thread; or an
                argument is wrong.
        """
        limit_s, wanted = time_limit(timeout_s), _wanted_ids(of)
        if limit_s is None:
            raise UsageError(f"usage: timeout_s: expected seconds, 0 or more, got {shown(timeout_s)}")
        check_not_measuring(self._actor)
        self._calls.dispatcher.check_may_block("usage()")
        ended = self._measured(wanted, limit_s)
        found = {id: numbers for id, numbers in ended.items() if isinstance(numbers, dict)}
        return Usages(found, {id: why for id, why in ended.items() if isinstance(why, str)})

    def _measured(self, wanted: frozenset[str] | None, limit_s: float) -> dict[str, Measured]:
        """Run the usage callbacks, and return what they have said within the limit."""
        limit = RunningLimit(limit_s)
        asked = self._calls.call(self._measured_now, wanted)
        begun: dict[str, Future[Measured]] = {}
        while not limit.is_over() and len(begun) < len(asked):
            some = self._calls.call(_begun, asked[len(begun) : len(begun) + _AT_ONCE])
            begun |= some
            wait(some.values(), min(_PATIENCE_S, limit.slice_s))
        while not limit.is_over() and wait(begun.values(), limit.slice_s).not_done:
            pass  # wait on, by slices
        ended: dict[str, Measured] = {}
        for resource, server in asked:
            future, late = begun.get(resource.id), f"{server.origin}: usage: not returned within {limit_s:g} s"
            ended[resource.id] = late if future is None or not future.done() else future.result()
        return ended

    def _measured_now(self, wanted: frozenset[str] | None) -> list[tuple[Resource, ServerActor]]:
        """Return the loaded resources, with their servers, of which the usage can be asked."""
        with self._actor.enter():
            rows = self._actor.whole().resources
            chosen = rows.values() if wanted is None else [rows[id] for id in wanted if id in rows]
            loaded = [
                row for row in chosen if row.phase in (Phase.LOADED, Phase.PAUSED) and row.state is not State.FATAL
            ]
        served = [(row, self._actor.servers.get(row.server)) for row in loaded]
        return [(row, server) for row, server in served if server is not None and server.spec.usage is not None]

    @for_handles(repeatable=True)
    def clients(self) -> list[str]:
        """Return the servers ("registrar/server") where this registrar holds something."""
        rows = self._calls.call(self._held_now)
        return sorted({f"{row.registrar}/{row.server}" for row in rows if row.hold is not Hold.OWED})

    def _held_now(self) -> list[Held]:
        with self._actor.enter():
            return list(self._actor.whole().held.values())

    def _unsettled_now(self) -> tuple[int, list[Held]]:
        """Return the number of all rows, and the rows that are pending or owed."""
        with self._actor.enter():
            catalog = self._actor.whole()
            return len(catalog.held), [catalog.held[id] for id in catalog.unsettled]

    @for_handles(repeatable=True)
    def servers(self) -> list[str]:
        """Return the servers registered here, as "registrar/server"."""
        return sorted(f"{self.name}/{name}" for name in self._calls.call(self._actor.servers.names))

    @for_handles(repeatable=True)
    def owed(self) -> list[str]:
        """Return the ids of released queries whose provider does not know it yet."""
        return [row.id for row in self._calls.call(self._unsettled_now)[1] if row.hold is Hold.OWED]

    @for_handles(repeatable=True)
    def stats(self) -> dict[str, int]:
        """Return counts of the present, and of events since the registrar was opened.

        Present: resources, queries held, releases owed, loads and unloads in flight, notices, and messages that wait
        for a decision ("mailbox"). "unheard": statuses that this registrar has not dealt with. Events: commits,
        status and progress callbacks that raised, and loads of its servers ("loads"), of which "shared" joined a
        resource. While a recording runs, commits are timed: "timed_commits" of them took "commit_us" microseconds.
        """
        return self._calls.call(self._stats_now)

    def _stats_now(self) -> dict[str, int]:
        actor = self._actor
        rows, unsettled = self._unsettled_now()
        owed = sum(row.hold is Hold.OWED for row in unsettled)
        return {
            "resources": len(actor.catalog.resources),
            "queries": rows - len(unsettled),
            "owed": owed,
            "loading": len(unsettled) - owed + len(actor.catalog.in_flight),
            "unloading": len(actor.unloads),
            "notices": len(actor.catalog.notices),
            "unheard": len(actor.catalog.hearing),
            "callback_failures": actor.callback_failures,
            "mailbox": len(actor.waiting),
            **counted_loads(load_rows(actor)),
            **actor.commit_counts(),
        }

    @for_handles(repeatable=True)
    def _page(self, wanted: Wanted) -> RowPage:
        """Return a few of this registrar's resources or queries as text, for tools that show the system."""
        return page_of(self._actor, wanted)

    # -- status --------------------------------------------------------------------------------------------------

    @for_handles(repeatable=False)
    def set_on_status(self, query_or_id: Query | str, callback: StatusCallback | None) -> None:
        """Replace the status callback of a query that this registrar holds, as `query.on_status(callback)` does.

        Raises:
            UnknownQuery: the query is not held any more.
            UsageError: `callback` cannot be called with a status alone.
        """
        id, own = target_id(query_or_id), status_callback(callback, "on_status", "callback")
        self._calls.call(self._set_on_status, id, own, callers_loop(own))

    def _set_on_status(self, id: str, callback: StatusCallback | None, loop: CallersLoop | None) -> None:
        with self._actor.enter():  # no thread releases the query meanwhile
            self._held_row(id)
            if id in self._actor.whole().ending:
                raise UnknownQuery(f"query {shortened(id)}: its provider has taken the resource away", query_id=id)
            self._views.callbacks.set(id, callback, loop)

    @for_handles(repeatable=False)
    def _listen(self, server: str, id: str, callback: StatusCallback) -> None:
        self._calls.call(self._views.callbacks.listen, server, id, checked_callback(callback))

    @for_handles(repeatable=True)
    def _stop_listening(self, server: str, id: str) -> None:
        self._views.callbacks.stop(server, id)

    # -- the catalog ---------------------------------------------------------------------------------------------

    @for_handles(repeatable=False)
    def save_catalog(self) -> None:
        """Write all changes into the catalog's SQLite file.

        Raises:
            CatalogError: the file cannot be written.
        """
        self._calls.call(self._actor.save)

    @for_handles(repeatable=False)
    def load_catalog(self) -> None:
        """Read the catalog from disk again, as after a restart.

        With save_on_modify off, resources served here that were not saved are lost: their holders hear FATAL. Queries
        held elsewhere come back from their providers.

        Raises:
            UsageError: a load or unload is in flight, or the call would hang in this thread.
            CatalogError: the catalog cannot be read, or its latest changes could not be written before.
        """
        self._calls.dispatcher.check_may_block("load_catalog()")
        self._calls.call(self._actor.reload_catalog)
        self._calls.dispatcher.run(self._node.settle(self._actor))

    def close(self, *, timeout_s: float | None = 30.0) -> None:
        """Release everything held, unload everything served, and leave the system. A second close does nothing.

        Raises:
            UsageError: timeout_s is no number of seconds, or a callback of this registrar made the call and would wait
                for itself. Nothing is closed.
        """
        limit_s = time_limit(timeout_s)
        if self._actor.closed:
            return
        instead = "start a thread for it, and let the callback return"
        check_not_own(f"registrar {self.name!r}: close()", lambda me: serving(me) is self._actor, instead)
        self._calls.dispatcher.run(self._node.dismiss((self.name,), limit_s))


def _begun(some: list[tuple[Resource, ServerActor]]) -> dict[str, Future[Measured]]:
    return {row.id: server.usage.measure(row) for row, server in some}


def _wanted_ids(of: object) -> frozenset[str] | None:
    if of is None:
        return None
    if is_a(of, str) or not is_a(of, Iterable):
        raise UsageError(f"usage: of: expected ids of resources, got {shown(of)} ({type(of).__name__})")
    ids = cast("Iterable[object]", of)
    return frozenset(check_text(id, "usage: of: expected the id of a resource") for id in ids)


# For the package's own modules. As a private method it stays out of an editor's list of names.
register_spec = Registrar._register_spec  # pyright: ignore[reportPrivateUsage]  # same file
load_bytes = Registrar._load  # pyright: ignore[reportPrivateUsage]  # same file


def news(registrar: Registrar, query_id: str) -> tuple[bytes | None, bool]:
    """Return the newest response of a query, as canonical bytes, and whether the query is not held any more."""
    query = registrar._views.known(query_id)  # pyright: ignore[reportPrivateUsage]  # same file
    return (None, True) if query is None else (response_bytes(query), query.released)


def has_all_streams(registrar: Registrar, query_id: str) -> bool:
    """Return whether nobody will open another stream of the resource of a query, as far as the registrar knows."""
    views = registrar._views  # pyright: ignore[reportPrivateUsage]  # same file
    query = views.known(query_id)
    return query is not None and views.has_all_streams(query)


def _batched(ids: list[str]) -> Iterator[list[str]]:
    """Yield the ids in parts so small that a look at the rows of one stops nobody."""
    for begin in range(0, len(ids), _IN_ONE_STEP):
        yield ids[begin : begin + _IN_ONE_STEP]


def page(registrar: Registrar, wanted: Wanted) -> RowPage:
    """Return a page of what a registrar, of this process or another, serves or holds.

    Raises:
        RegistrarDown: the registrar is closed, or does not run.
    """
    return registrar._page(wanted)  # pyright: ignore[reportPrivateUsage]  # same file


def served(registrar: Registrar) -> list[tuple[Resource, list[QueryRow]]]:
    """Return the rows of all resources that a registrar of this process serves, with those of their queries.

    Raises:
        RegistrarDown: the registrar is closed.
    """
    rows = registrar._calls.call(registrar._resources_now)  # pyright: ignore[reportPrivateUsage]  # same file
    return [(resource, queries) for resource, _, queries in rows]


def on_happened(registrar: Registrar, happened: Callable[[], object]) -> None:
    """Have `happened` called on the event loop after each event of a resource that a registrar of this process serves.

    It must not wait. It is called before the answer of the call that has caused the event.
    """
    registrar._actor.on_happened = happened  # pyright: ignore[reportPrivateUsage]  # same file


def begin_planned(registrar: Registrar, server: str, request: Any, **options: Unpack[LoadKeywords]) -> Reply[Query]:
    """Begin a load as no part of anything, by a query that is_planned() knows from those loaded by hand.

    A planner finds by that, in its next process, what it may release. Arguments and errors are those of
    Registrar.load().
    """
    loads, wanted = registrar._loads, checked("load", **options)  # pyright: ignore[reportPrivateUsage]  # same file
    target = registrar._target(server)  # pyright: ignore[reportPrivateUsage]  # same file
    return loads.begin(target, encode(request), "", wanted, planned_id())


def begin_revocation(registrar: Registrar, resource_id: str, why: str, grace_s: float) -> Reply[None]:
    """Begin to revoke a resource, and return a future of its end at once; see Registrar.revoke()."""
    actor, calls = registrar._actor, registrar._calls  # pyright: ignore[reportPrivateUsage]  # same file
    return calls.start(functools.partial(actor.revoke, resource_id, message_text(why), round(grace_s * 1000)))


def registrar_of(actor: RegistrarBase | None) -> Registrar | None:
    """Return the Registrar that users call, for its actor; None if there is none."""
    holder = None if actor is None or actor.audience is None else actor.audience.holder
    return holder if isinstance(holder, Registrar) else None


def _name_of(resource: Resource, actor: RegistrarActor) -> str:
    text = actor.title_of(resource) or text_of_value(resource.request)
    return named(f"{actor.name}/{resource.server}", text)
