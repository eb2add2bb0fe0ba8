"""Registrar: what people hold in their hands. Loads, unloads and serves resources, from any thread.

Each method hands a command to the registrar's actor on the process's loop and waits for how it ended: for ever never,
and never on the loop itself. The promises are here; how they are kept is in registrar.py, loads.py, loads.py,
registrar.py and queries.py.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar, cast, overload

import pykka

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base import pickling
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import NotSerializable, UnknownQuery, UsageError, exact_text, is_a, shortened, shown
from rr_actors.base.names import ServerId, check_name, new_id
from rr_actors.base.values.canonical import encode
from rr_actors.registrar import load_groups
from rr_actors.registrar.arguments import (
    check_text,
    codec_for,
    parse_server,
    resource_target,
    server_target,
    status_callback,
    target_id,
)
from rr_actors.registrar.declarations import Declared
from rr_actors.registrar.engine.callback_context import (
    Current,
    check_not_own,
    current_or_none,
    serving,
    status_callback_of,
)
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.server import ServerActor, ServerSpec, log_unread_types, make_spec
from rr_actors.registrar.engine.status import Status, message_text
from rr_actors.registrar.load_groups import Queries
from rr_actors.registrar.loads import Loads, Unloads, not_holder
from rr_actors.registrar.loop_calls import Calls
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import FetchedQuery
from rr_actors.registrar.model.rows import Held, Hold, Phase, Put, Resource, State, StoredServer
from rr_actors.registrar.pages import Page, Wanted, page_of
from rr_actors.registrar.queries import PLAIN, Query, ResourceInfo, StatusCallback, Views, read_as, read_later
from rr_actors.runtime.time_limits import time_limit

Request = TypeVar("Request")
Response = TypeVar("Response")


class Registrar:
    """A registrar of this process: a consumer of other registrars' resources, a provider of its own, or both.

    Made by System.open_registrar(), and as Manager.registrar.  Every method may be called from any thread; those with
    ``block=False`` return a Pykka future, which can also be awaited.
    """

    def __init__(self, actor: RegistrarActor) -> None:
        self._actor = actor
        self._calls = Calls(actor)
        self._views = Views(actor, self)
        self._offers = Offers(actor, self._calls)
        self._loads = Loads(actor, self._calls, self._views)
        self._unloads = Unloads(actor, self._calls, self._views)
        self._listings = Listings(actor, self._calls, self._views)
        actor.audience = self._views

    @property
    def name(self) -> str:
        """The registrar's name, unique in its system."""
        return self._actor.name

    @property
    def config(self) -> RegistrarConfig:
        """How its catalog is kept."""
        return self._actor.config

    @property
    def directory(self) -> Path:
        """Where its catalog is: a private directory, for files of its owner's that belong with the catalog, too."""
        return self.config.catalog_path(self._actor.node.info.state_dir).parent

    def __repr__(self) -> str:
        return f"<Registrar {self.name}{' (closed)' if self._actor.closed else ''}>"

    def __reduce__(self) -> NoReturn:
        raise NotSerializable(f"registrar {self.name!r} is this process's: pass its name instead", path="")

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
        recovery: Literal["keep", "reload", "lost"] = "keep",
    ) -> None:
        """Offer resources of a new kind as "<this registrar>/<name>".

        Args:
            load: ``load(request) -> response``. Plain or ``async def``; like all callbacks it runs off the loop.
            unload: ``unload(request, response)``, when the last holder has let go. The response is None for what is
                left of a load that a crash has interrupted, and that was withdrawn or given up: see
                ``rr.current().interrupted``.
            status: ``status(request, status)``, when its owner says how a resource is (``status.resource_id`` is that
                of rr.current() then), before the holders hear, and when something that the resource depends on does.
            recover: ``recover(request, response) -> response`` after a respawn: it lives; or raises: it is lost.
            request_type, response_type: by default read from the annotations of `load`; any plain value without.
            linger_s: seconds an unheld resource is kept warm.
            load_timeout_s: seconds after which those who wait for `load` are told it failed.
            recovery: without `recover`: "keep" what was loaded, "reload" it, or give it up as "lost".

        Raises:
            InvalidName, NameTaken, InvalidSpec, NotSerializable: nothing was registered.
        """
        spec = make_spec(
            name,
            load,
            unload,
            status=status,
            recover=recover,
            request_type=request_type,
            response_type=response_type,
            linger_s=linger_s,
            load_timeout_s=load_timeout_s,
            recovery=recovery,
        )
        self._register_spec(spec)

    def _register_spec(self, spec: ServerSpec, *, stored: bytes | None = None, restored: bool = False) -> None:
        """Register a server from its checked description; with `stored`, keep it in the catalog by value.

        One that is only `restored` from there gives way to who registers it again.
        """
        self._offers.register(spec, stored, restored=restored)

    def _register_stored(self, blob: bytes) -> None:
        """Register a server that another process sent by value, and keep it in the catalog. In a worker."""
        self._register_spec(pickling.loads(blob), stored=blob)

    def unregister_server(self, name: str, *, timeout_s: float | None = 30.0) -> None:
        """Stop offering it: every query on it is released, its holders told (FATAL), its resources unloaded.

        Raises:
            UnknownServer: there is none of that name.
            UnloadFailed: an unload callback raised; the resource stays in the catalog.
            UsageError: called in a callback that it would wait for, of this server; nothing is changed.
        """
        limit_s = time_limit(timeout_s)
        self._offers.unregister(check_text(name, "unregister_server: expected a server's name"), limit_s)

    def send_status(self, query_or_resource_id: Query | ResourceInfo | str, status: Status) -> None:
        """Tell every holder of a resource served here how it is. Returns when that is on disk.

        The status callback of its server runs first, and may deal with it; not for what that callback itself sends.

        Args:
            query_or_resource_id: the resource's id, or a query on it (or its id).

        Raises:
            UnknownQuery: no such resource or query here.
        """
        self._offers.send_status(query_or_resource_id, status)

    def update_response(
        self, query_or_resource_id: Query | ResourceInfo | str, response: Any, message: str = "late response"
    ) -> None:
        """Replace the stored response of a resource served here; its holders hear UPDATE and have the new one.

        Raises:
            UnknownQuery: no such resource or query here.
            InvalidResponse, NotSerializable: it is not of the server's type, or no plain data; nothing is changed.
            UsageError: it is still loading.
        """
        self._offers.update_response(query_or_resource_id, response, message)

    # -- load ----------------------------------------------------------------------------------------------------

    @overload
    def load(
        self,
        server: Declared[Request, Any, Response],
        request: Request,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: Literal[True] = True,
    ) -> Query[Response]: ...
    @overload
    def load(
        self,
        server: Declared[Request, Any, Response],
        request: Request,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: Literal[False],
    ) -> pykka.Future[Query[Response]]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        response_type: type[Response],
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: Literal[True] = True,
    ) -> Query[Response]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        response_type: type[Response],
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: Literal[False],
    ) -> pykka.Future[Query[Response]]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: Literal[True] = True,
    ) -> Query[Any]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: Literal[False],
    ) -> pykka.Future[Query[Any]]: ...
    @overload
    def load(
        self,
        server: Declared[Request, Any, Any],
        request: Request,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: bool = True,
    ) -> Query[Any] | pykka.Future[Query[Any]]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        response_type: Any = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: bool = True,
    ) -> Query[Any] | pykka.Future[Query[Any]]: ...

    def load(
        self,
        server: str | Declared[Any, Any, Any],
        request: Any,
        *,
        response_type: Any = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: bool = True,
    ) -> Any:
        """Get a query on the resource for this request, loading it if nobody holds it yet.

        In a callback, what is loaded becomes a dependency of the callback's resource.

        Args:
            server: "registrar/server"; or the method that declares it, `Cameras.open_camera`, if exactly one child of
                the system is of that class. Type checkers then know the response's type.
            request: a value of the server's request type; docs/values.md lists what may be in it.
            response_type: the type that the response is read as, whatever the server declares.
            on_status: called in a worker with each Status of this query, in order. Of a part of a callback's resource:
                before that resource's own status callback, and instead of it if this one calls `status.handled()`.
            timeout_s: seconds the whole load may take; it is withdrawn then. None: no limit.
            parent: rr.current() of the callback this is done for, when not called in its own thread or task.
            block: False returns a Pykka future of the query at once.

        Returns:
            The Query; with ``block=False`` a future of it.

        Raises:
            LoadFailed: a load callback raised; `.trace` tells where.
            CircularDependency: the request would wait for itself; `.ring`.
            LoadTimeout: not answered in time.
            UnknownServer, UnknownRegistrar, InvalidName, InvalidRequest, NotSerializable: the call was wrong.
            UsageError: several children of the system are of the class that declares the server.
            RegistrarDown: the provider is stopped or gone for good.
            MailboxFull: too many loads are under way.
        """
        if response_type is not None:
            codec = codec_for(response_type)
            loaded = self.load(server, request, on_status=on_status, timeout_s=timeout_s, parent=parent, block=block)
            return read_as(loaded, codec) if isinstance(loaded, Query) else read_later(loaded, codec)
        limit_s = time_limit(timeout_s)
        if on_status is not None:
            on_status = status_callback(on_status, "load: on_status")
        owner, parent_id = self._holder(parent)
        loads = owner._loads
        way = loads.wait if block else loads.future
        target = parse_server(server) if type(server) is str else self._target(server)
        return way(target, encode(request), parent_id, on_status, limit_s)

    @overload
    async def load_async(
        self,
        server: Declared[Request, Any, Response],
        request: Request,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Query[Response]: ...
    @overload
    async def load_async(
        self,
        server: str,
        request: object,
        *,
        response_type: type[Response],
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Query[Response]: ...
    @overload
    async def load_async(
        self,
        server: str,
        request: object,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Query[Any]: ...

    async def load_async(
        self,
        server: str | Declared[Any, Any, Any],
        request: Any,
        *,
        response_type: Any = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Query[Any]:
        """As load(), awaited. Cancelled, it withdraws the load."""
        codec = None if response_type is None else codec_for(response_type)
        limit_s = time_limit(timeout_s)
        on_status = status_callback(on_status, "load: on_status")
        owner, parent_id = self._holder(parent)
        target = self._target(server)
        query = await owner._loads.result(target, encode(request), parent_id, on_status, limit_s)
        return query if codec is None else read_as(query, codec)

    def _target(self, server: object) -> ServerId:
        return server_target(server, self._actor.node.directory)

    def load_all(
        self,
        requests: Iterable[tuple[str, Any]],
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Queries:
        """Load several at once, and hold all of them or none::

            with app.load_all([("cameras/camera", "front"), ("maps/map", "hall")]) as (camera, map):
                ...

        Args:
            requests: ("registrar/server", request) for each.
            on_status, parent: as of load(), for each.
            timeout_s: seconds each load may take. None: no limit.

        Returns:
            The queries, in the order of the requests: a tuple, and a context manager that unloads them.

        Raises:
            What load() raises: the first error. A note says of which request; what was held by then is released.
        """
        asked = load_groups.wanted(requests)
        limit_s = time_limit(timeout_s)
        on_status = status_callback(on_status, "load_all: on_status")
        owner, parent_id = self._holder(parent)
        return load_groups.wait(owner._loads, owner._unloads, asked, parent_id, on_status, limit_s)

    async def load_all_async(
        self,
        requests: Iterable[tuple[str, Any]],
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Queries:
        """As load_all(), awaited. Cancelled, it releases and withdraws all of them."""
        asked = load_groups.wanted(requests)
        limit_s = time_limit(timeout_s)
        on_status = status_callback(on_status, "load_all: on_status")
        owner, parent_id = self._holder(parent)
        return await load_groups.result(owner._loads, owner._unloads, asked, parent_id, on_status, limit_s)

    def _holder(self, parent: Any) -> tuple[Registrar, str]:
        """Who holds what is loaded now, and for which resource: in a callback of this system, the callback's."""
        context: Any = parent
        if context is None:
            context = current_or_none()
            if context is None or serving(context).node is not self._actor.node:
                return self, ""
        if is_a(context, Current):
            audience = serving(cast("Current", context)).audience
            return (self if audience is None else audience.holder), context.resource_id
        if is_a(context, str):
            return self, exact_text(cast("str", context))
        if is_a(context, ResourceInfo):
            return self, cast("ResourceInfo", context).id
        if is_a(context, Query):
            return self, cast("Query", context).resource_id
        raise UsageError(f"parent: expected rr.current() or a resource id, got {type(context).__name__}")

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
        block: bool,
    ) -> pykka.Future[None] | None: ...

    def unload(
        self,
        query_or_id: Query | ResourceInfo | str,
        *,
        force: bool = False,
        timeout_s: float | None = 30.0,
        block: bool = True,
    ) -> Any:
        """Let a query go. Returns when that is done: the unload callback has run, or others hold the resource.

        Args:
            query_or_id: a query of this registrar, or its id. With `force`: a resource served here, a query on it, or
                the id of either; it is unloaded whoever holds it, and they hear FATAL.
            timeout_s: seconds to wait for a provider that is down.
            block: False returns a Pykka future at once.

        Raises:
            UnknownQuery: never held, or unloaded already. NotHolder: another registrar's.
            UnloadFailed: the unload callback raised; the query is still held and can be unloaded again.
            UsageError: with `force`, called in a callback of that resource that it would wait for.
            Unavailable: the provider did not come back in time; the release is owed, on disk, until it does.
        """
        self._calls.check_open()
        limit_s = time_limit(timeout_s)
        query_id = target_id(query_or_id)
        unloads = self._unloads
        if force:
            return unloads.force_wait(query_id, limit_s) if block else unloads.force_future(query_id)
        if is_a(query_or_id, Query) and cast("Query", query_or_id).origin != self.name:
            raise not_holder(query_id, cast("Query", query_or_id).origin, self.name)
        return unloads.wait(query_id, limit_s) if block else unloads.future(query_id, limit_s)

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

    def unload_client(self, server: str, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Let go of everything this registrar holds at one server ("registrar/server"), newest first.

        Raises:
            InvalidName: it is not of that form.
            UnknownServer: this registrar holds nothing there and never did; `.known` are the servers where it does.
            And what unload() raises, after all have been tried.
        """
        self._calls.check_open()
        reply = self._unloads.at_server(parse_server(server), time_limit(timeout_s))
        return reply.get() if block else reply

    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: Literal[True] = True) -> None: ...
    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: Literal[False]) -> pykka.Future[None]: ...
    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool) -> pykka.Future[None] | None: ...

    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Let go of everything this registrar holds for itself, newest first; what its resources hold goes with them.

        Raises:
            What unload() raises, after all have been tried.
        """
        self._calls.check_open()
        reply = self._unloads.many(lambda held: not held.parent, time_limit(timeout_s))
        return reply.get() if block else reply

    # -- looking -------------------------------------------------------------------------------------------------

    def queries(self) -> list[Query]:
        """Every query this registrar holds, its resources' dependencies included, oldest first."""
        return self._listings.queries()

    def fetch_queries(self, registrar: str, *, timeout_s: float | None = 30.0) -> list[Query]:
        """Ask a provider for the queries this registrar holds there, in full: what its catalog says.

        Raises:
            UnknownRegistrar, RegistrarDown: it is not there. Unavailable: it did not answer in time.
        """
        return self._listings.fetch_queries(registrar, time_limit(timeout_s))

    def children(self, query: Query | ResourceInfo | str) -> list[Query]:
        """The queries that a resource depends on, oldest first: one served here, or one that a query here is on.

        Raises:
            UnknownQuery: no such resource or query here.
            RegistrarDown, UnknownRegistrar: it is another registrar's, and that is not there.
        """
        return self._listings.children(query)

    def resources(self) -> list[ResourceInfo]:
        """Every resource served here, with its state, response and holders."""
        return self._listings.resources()

    def clients(self) -> list[str]:
        """The servers ("registrar/server") this registrar holds something at."""
        return self._listings.clients()

    def servers(self) -> list[str]:
        """The servers registered here, as "registrar/server"."""
        return self._listings.servers()

    def owed(self) -> list[str]:
        """The ids of queries let go whose provider does not know it yet."""
        return self._listings.owed()

    def stats(self) -> dict[str, int]:
        """Counts of this moment: resources, queries held, owed, loads and unloads under way; status callbacks that
        raised since the registrar was opened."""
        return self._listings.stats()

    def _page(self, wanted: Wanted) -> Page:
        """Return a few of its resources or queries as text, for those who look at the system from outside."""
        return page_of(self._actor, self._calls, wanted)

    # -- status --------------------------------------------------------------------------------------------------

    def on_status(self, server: str, callback: StatusCallback) -> None:
        """Have `callback(status)` called for every query this registrar holds at that server, now and later.

        As a load's `on_status`, it may deal with a status: `status.handled()` keeps it from going further up.
        """
        key = str(parse_server(server))
        own = status_callback(callback, "on_status")
        if own is None:
            raise UsageError("on_status: expected a callable, got None")
        self._calls.call(self._views.listen_to_server, key, own)

    # -- the catalog ---------------------------------------------------------------------------------------------

    def save_catalog(self) -> None:
        """Write what has not been written yet.

        Raises:
            CatalogError: it cannot be written.
        """
        self._calls.call(self._actor.save)

    def load_catalog(self) -> None:
        """Take up the catalog as it is on disk, as after a restart.

        With save_on_modify off, what was served here and not saved is forgotten: its holders hear FATAL. What is held
        elsewhere its providers tell again.

        Raises:
            UsageError: a load or unload is under way, or called where waiting would hang.
            CatalogError: it cannot be read, or what is saved on modify could not be written before.
        """
        self._calls.dispatcher.check_may_block("load_catalog()")
        self._calls.call(self._actor.reload_catalog)
        self._calls.dispatcher.run(self._actor.node.settle(self._actor))

    def close(self, *, timeout_s: float | None = 30.0) -> None:
        """Release all that it holds, unload all that it serves, and leave the system. Closing twice is nothing.

        Raises:
            UsageError: timeout_s is no such number, or called in a callback of this registrar that it would wait for;
                nothing is closed.
        """
        limit_s = time_limit(timeout_s)
        node = self._actor.node
        if self._actor.closed:
            return
        instead = "start a thread for it, and let the callback return"
        check_not_own(f"registrar {self.name!r}: close()", lambda me: serving(me) is self._actor, instead)
        node.dispatcher.run(node.dismiss(self.name, limit_s))


# For the package's own modules; people who complete a name see nothing of it.
register_spec = Registrar._register_spec  # pyright: ignore[reportPrivateUsage]  # same file


def page(registrar: Registrar, wanted: Wanted) -> Page:
    """Return a page of what a registrar, of this process or another, serves or holds.

    Raises:
        RegistrarDown: it is not there.
    """
    return registrar._page(wanted)  # pyright: ignore[reportPrivateUsage]  # same file


# Listings: what a registrar holds and serves at one moment, read from its catalog or asked of others.
#
# The rows are picked on the loop; their bytes are decoded, by users' types, in the thread that asks.


class Listings:
    """The listings of one registrar. From any thread; Registrar's methods of the same names have the promises."""

    def __init__(self, actor: RegistrarActor, calls: Calls, views: Views) -> None:
        self._actor = actor
        self._calls = calls
        self._views = views

    # -- what it holds -------------------------------------------------------------------------------------------

    def queries(self) -> list[Query]:
        """Every query it holds, oldest first."""
        return self._calls.call(self._queries_now)

    def _queries_now(self) -> list[Query]:
        held = [row for row in self._actor.catalog.held.values() if row.hold is Hold.HELD]
        return [self._views.of(row) for row in sorted(held, key=lambda row: row.seq)]

    def fetch_queries(self, registrar: str, timeout_s: float | None) -> list[Query]:
        """The queries it holds at a provider, as that one has them."""
        self._calls.check_open()
        check_name(registrar, "registrar name")
        future: Reply[list[FetchedQuery]] = Reply()

        def fetched(queries: list[FetchedQuery] | None, error: Exception | None) -> None:
            if not future.done():
                future.set(queries) if error is None else future.set_exception((type(error), error, None))

        self._calls.dispatcher.call(lambda: self._actor.client(registrar).fetch(fetched))
        rows = self._calls.finish(future, timeout_s, f"fetching from {registrar!r}")
        return [self._fetched_view(registrar, row) for row in rows]

    def _fetched_view(self, registrar: str, row: FetchedQuery) -> Query:
        place = (registrar, row.server, row.request, row.response, row.resource_id, row.parent, row.attempt, row.seq)
        held = Held(row.query_id, *place, Hold.HELD, State(row.state))
        return self._views.seen(held)

    def children(self, target: Query | ResourceInfo | str) -> list[Query]:
        """The queries that a resource depends on, oldest first."""
        id = target_id(target)
        provider = cast("Query", target).registrar if is_a(target, Query) else self._provider_of(id)
        if provider in (None, self._actor.name):
            return self._calls.call(self._children_now, id)
        return self._calls.ask_other(provider, "children", resource_target(target))

    def _provider_of(self, id: str) -> str | None:
        held = self._actor.catalog.held.get(id)
        return None if held is None else held.registrar

    def _children_now(self, target: str) -> list[Query]:
        catalog = self._actor.catalog
        resource_id = target
        if target in catalog.queries and target not in catalog.resources:
            resource_id = catalog.queries[target].resource_id
        if resource_id not in catalog.resources and resource_id not in catalog.parts:
            text = f"{shortened(target)}: {self._actor.name!r} serves no resource and no query of this id"
            raise UnknownQuery(text, query_id=target)
        return [self._views.of(catalog.held[id]) for id in reversed(catalog.parts_of(resource_id))]

    def clients(self) -> list[str]:
        """The servers it holds something at."""
        held = self._calls.call(lambda: list(self._actor.catalog.held.values()))
        return sorted({f"{row.registrar}/{row.server}" for row in held if row.hold is not Hold.OWED})

    def owed(self) -> list[str]:
        """The ids of queries let go whose provider does not know it yet."""
        return self._calls.call(lambda: [id for id, row in self._actor.catalog.held.items() if row.hold is Hold.OWED])

    # -- what it serves ------------------------------------------------------------------------------------------

    def resources(self) -> list[ResourceInfo]:
        """Every resource it serves."""
        rows = self._calls.call(self._resources_now)
        return [self._info(*row) for row in rows]

    def _resources_now(self) -> list[tuple[Resource, ServerActor | None, tuple[str, ...], tuple[str, ...]]]:
        catalog = self._actor.catalog
        rows: list[tuple[Resource, ServerActor | None, tuple[str, ...], tuple[str, ...]]] = []
        for resource in catalog.resources.values():
            query_ids = tuple(catalog.holders.get(resource.id, ()))
            holders = tuple(catalog.queries[id].origin for id in query_ids)
            rows.append((resource, self._actor.servers.get(resource.server), holders, query_ids))
        return rows

    def _info(
        self, resource: Resource, server: ServerActor | None, holders: tuple[str, ...], queries: tuple[str, ...]
    ) -> ResourceInfo:
        request = (server.request if server else PLAIN).show(resource.request)
        response = None
        if resource.response is not None:
            response = (server.response if server else PLAIN).show(resource.response)
        state = str(resource.state if resource.phase is Phase.LOADED else resource.phase)
        facts = (state, resource.phase, resource.state, resource.message, resource.attempt)
        return ResourceInfo(resource.id, resource.server, request, response, *facts, holders, queries)

    def servers(self) -> list[str]:
        """The servers registered here."""
        names = self._calls.call(self._actor.servers.names)
        return sorted(f"{self._actor.name}/{name}" for name in names)

    # -- how much ------------------------------------------------------------------------------------------------

    def stats(self) -> dict[str, int]:
        """Counts of this moment."""
        return self._calls.call(self._stats_now)

    def _stats_now(self) -> dict[str, int]:
        actor = self._actor
        holds = [row.hold for row in actor.catalog.held.values()]
        return {
            "resources": len(actor.catalog.resources),
            "queries": holds.count(Hold.HELD),
            "owed": holds.count(Hold.OWED),
            "loading": holds.count(Hold.PENDING) + actor.under_way.loads,
            "unloading": len(actor.unloads) + actor.under_way.unloads,
            "notices": len(actor.catalog.notices),
            "callback_failures": actor.callback_failures,
        }


# Offers: how a registrar takes up servers and gives them up, and what it says of the resources that they serve.


class Offers:
    """The offers of one registrar. From any thread; Registrar's methods have the promises."""

    def __init__(self, actor: RegistrarActor, calls: Calls) -> None:
        self._actor = actor
        self._calls = calls

    def register(self, spec: ServerSpec, stored: bytes | None, *, restored: bool) -> None:
        """Take up a server, and with `stored` its row in the catalog."""
        origin = f"{self._actor.name}/{spec.name}"
        if stored is None and not restored:
            log_unread_types(spec, origin)
        types = pickling.dumps((spec.request_type, spec.response_type), f"{origin}: types")
        server = ServerActor(self._actor, spec, types)
        server.restored = restored
        self._calls.call(self._register, server, stored)

    def _register(self, server: ServerActor, stored: bytes | None) -> None:
        self._actor.servers.register(server)
        if stored is not None:
            self._actor.commit_rows([Put(StoredServer(server.spec.name, stored))])

    def unregister(self, name: str, timeout_s: float | None) -> None:
        """Give up a server, and all that is held of it."""
        self._calls.check_open()
        whose, instead = (self._actor, name), "start a thread for it, and let the callback return"
        what = f"registrar {self._actor.name!r}: unregister_server({shown(name)})"
        check_not_own(what, lambda me: (serving(me), me.server) == whose, instead)
        start = functools.partial(self._actor.servers.unregister, name)
        self._calls.finish(self._calls.start(start), timeout_s, f"unregistering {self._actor.name}/{name}")

    def send_status(self, target: Query | ResourceInfo | str, status: Status) -> None:
        """Tell the holders of a resource how it is."""
        if not is_a(status, Status):
            raise UsageError(f"send_status: expected a Status, got {type(status).__name__} ({shown(status)})")
        resource = resource_target(target)
        state, text = State(status.state), message_text(status.message)
        own = status_callback_of(self._actor)

        def command(ticket: Any) -> c.SetStatus:
            return c.SetStatus(resource, new_id(), state, text, ticket, own)

        self._calls.command(command, f"status for {target_id(target)}")

    def update_response(self, target: Query | ResourceInfo | str, response: Any, message: str) -> None:
        """Replace the response of a resource."""
        resource, server = self._calls.call(self._served, resource_target(target))
        raw = encode(response, "response") if server is None else server.response.encode(response, server.origin)
        if resource is not None and server is not None and (refusal := server.too_long(resource, raw)) is not None:
            raise refusal
        text = message_text(message)
        own = status_callback_of(self._actor)

        def command(ticket: Any) -> c.SetResponse:
            return c.SetResponse(resource_target(target), new_id(), raw, text, ticket, own)

        self._calls.command(command, f"response for {target_id(target)}")

    def _served(self, target: str) -> tuple[Resource | None, ServerActor | None]:
        catalog = self._actor.catalog
        query = catalog.queries.get(target)
        resource = catalog.resources.get(target if query is None else query.resource_id)
        return resource, None if resource is None else self._actor.servers.get(resource.server)
