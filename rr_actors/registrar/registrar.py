"""Registrar: the class with which an application loads, unloads and serves resources, from any thread.

Most methods give the registrar's actor a command and wait, with a time limit, for its end. None waits on the event
loop. The docstrings have the promises.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, overload

import pykka

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base import pickling
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import NotSerializable, UnknownQuery, UsageError, exact_text, is_a, shortened, shown
from rr_actors.base.names import ServerId, check_name, new_id, parse_server
from rr_actors.base.notebook import bundle_or_text, table
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.arguments import (
    check_text,
    codec_for,
    resource_target,
    server_target,
    status_callback,
    target_id,
)
from rr_actors.registrar.declarations import Declared
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.server import (
    Current,
    ServerActor,
    ServerSpec,
    check_not_own,
    checked_spec,
    current_or_none,
    log_unread_types,
    serving,
    status_callback_of,
)
from rr_actors.registrar.engine.status import Status, message_text
from rr_actors.registrar.load_groups import Group, Queries, wanted
from rr_actors.registrar.loads import CALL_TIMEOUT_S, Calls, Loads, Unloads, settle
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.messages import FetchedQuery, error_of
from rr_actors.registrar.model.rows import Held, Hold, Phase, Put, Resource, State, StoredServer
from rr_actors.registrar.model.rows import Query as QueryRow
from rr_actors.registrar.pages import Page, Wanted, page_of
from rr_actors.registrar.progress_hearers import ProgressWanted, hearer_of
from rr_actors.registrar.queries import (
    PLAIN,
    Query,
    ResourceInfo,
    StatusCallback,
    Views,
    read_as,
    read_later,
    response_bytes,
)
from rr_actors.registrar.replacements import Replacements, encoded_response
from rr_actors.runtime.time_limits import time_limit

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    Response = TypeVar("Response", default=Any)  # for a server that is named by a str
else:
    from typing import TypeVar

    Response = TypeVar("Response")

Request = TypeVar("Request")

logger = logging.getLogger("rr_actors.registrar")

_KEPT = (
    "%s/%s: a process that has ended had loaded %d of its resources. They are kept as they are. What that process "
    "had in memory for them (open files, objects, threads) is gone. Declare a recover callback, which opens it again "
    "and returns the response, or recovery='reload' or 'lost'. If they live outside the process, say recovery='keep'."
)

_SHOWN = 50  # rows of a picture in a notebook


class Registrar:
    """A registrar of this process. It consumes resources of other registrars, provides its own, or both.

    System.open_registrar() makes one, and every Manager has one. Call its methods from any thread. With ``block=False``
    they return a Pykka future, which can also be awaited.
    """

    def __init__(self, actor: RegistrarActor) -> None:
        self._actor = actor
        self._node = actor.node
        self._calls = Calls(actor)
        self._views = Views(actor, self)
        self._loads = Loads(self._calls, self._views)
        self._unloads = Unloads(self._calls, self._views)
        self._replacements = Replacements(self._loads, self._unloads)
        self._warned_in_event_loop = False
        actor.audience = self._views

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
        recovery: Literal["keep", "reload", "lost"] | None = None,
    ) -> None:
        """Offer resources of a new kind as "<this registrar>/<name>".

        Args:
            load: ``load(request) -> response``. Plain or ``async def``; like all callbacks it runs off the loop.
            unload: ``unload(request, response)`` runs when the last holder has released the resource. After an
                interrupted load that was withdrawn or given up, the response is None and ``rr.current().interrupted``
                is true.
            status: ``status(request, status)`` runs for a status of the resource itself, before the holders hear it
                (``status.resource_id`` is then rr.current().resource_id), and for statuses of its dependencies.
            recover: ``recover(request, response) -> response`` runs after a respawn. It returns the response if the
                resource lives, and raises if it is lost.
            request_type, response_type: by default the annotations of `load`; without these, any plain value.
            linger_s: seconds for which a resource without holders is kept.
            load_timeout_s: seconds after which a running `load` counts as failed.
            recovery: without `recover`: "keep" the resource, "reload" it, or give it up as "lost". None: as
                "keep", and the log has a warning if a process that has ended had loaded kept resources.

        Raises:
            InvalidName: `name` has other characters than ASCII letters, digits, "_", "-" and ".".
            NameTaken: this registrar has a server of this name.
            InvalidSpec: a callback or an option is wrong.
            NotSerializable: a callback cannot travel to the registrar's process.
        """
        callbacks, types = (load, unload, status, recover), (request_type, response_type)
        spec = checked_spec(ServerSpec(name, *callbacks, *types, linger_s, load_timeout_s, recovery))
        self._register_spec(spec)

    def _register_spec(self, spec: ServerSpec, *, stored: bytes | None = None, restored: bool = False) -> None:
        """Register a server from its checked spec. With `stored`, these bytes of the spec are kept in the catalog.

        A `restored` server, which comes from the catalog, is replaced if its name is registered again.
        """
        origin = f"{self.name}/{spec.name}"
        is_declared_here = stored is None and not restored
        if is_declared_here:
            log_unread_types(spec, origin)
        types = pickling.dumps((spec.request_type, spec.response_type), f"{origin}: types")
        server = ServerActor(self._actor, spec, types)
        server.restored = restored
        kept = self._calls.call(self._register, server, stored)
        if kept and is_declared_here and spec.recovery is None and spec.recover is None:
            logger.warning(_KEPT, self.name, spec.name, kept)

    def _register(self, server: ServerActor, stored: bytes | None) -> int:
        """Register a server on the loop, and return how many usable held resources it finds; 0 if it replaces one."""
        name = server.spec.name
        with self._actor.enter():
            catalog = self._actor.whole()
            resources = [catalog.resources[id] for id in catalog.by_server.get(name, ()) if id in catalog.holders]
        kept = sum(found.phase is Phase.LOADED and found.state is not State.FATAL for found in resources)
        known = self._actor.servers.get(name)
        self._actor.servers.register(server)
        if stored is not None:
            self._actor.commit_rows([Put(StoredServer(name, stored))])
        return kept if known is None else 0

    def _register_stored(self, blob: bytes) -> None:
        """Register a server that another process sent by value, and keep it in the catalog. In a worker."""
        self._register_spec(pickling.loads(blob), stored=blob)

    def unregister_server(self, name: str, *, timeout_s: float | None = 30.0) -> None:
        """Remove a server: release all queries on it, send its holders FATAL, unload its resources.

        Raises:
            UnknownServer: this registrar has no server of that name.
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

    def send_status(self, query_or_resource_id: Query | ResourceInfo | str, status: Status) -> None:
        """Send a status of a resource served here to all its holders. Return when it is on disk.

        The status callback of its server runs first, and may stop the status by `status.handled()`. It does not run
        for a status that the callback itself sends.

        Args:
            query_or_resource_id: the resource or its id, or a query on it or the query's id.

        Raises:
            UnknownQuery: this registrar serves no such resource.
        """
        if not is_a(status, Status):
            raise UsageError(f"send_status: expected a Status, got {type(status).__name__} ({shown(status)})")
        resource = resource_target(query_or_resource_id)
        state, text = State(status.state), message_text(status.message)
        own = status_callback_of(self._actor)
        what = f"status for {target_id(query_or_resource_id)}"
        self._calls.command(lambda ticket: c.SetStatus(resource, new_id(), state, text, ticket, own), what)

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
            response: makes the new response of the resource. It gets the spare's Query. None: the response stays.
            timeout_s: seconds that the load may take. None: no limit.

        Returns:
            The Query of the spare. If the part was replaced before for this status, the Query of that spare.

        Raises:
            The errors of load() and `response`: nothing is replaced; the status goes up unless the callback handles it.
            InvalidResponse, NotSerializable: the new response has another type, or cannot travel.
            UnknownQuery: the resource does not hold the part any more.
            UsageError: not called in a status callback, or the status is of the resource itself.
        """
        limit_s = time_limit(timeout_s)
        if response is not None and not callable(response):
            expected = "expected a function that takes the spare's Query and returns the new response"
            raise UsageError(f"replace_part: response: {expected}, got {shown(response)} ({type(response).__name__})")
        target = None if server is None else self._target(server)
        if not is_a(status, Status):
            raise UsageError(f"replace_part: expected the Status of the callback, got {shown(status)}")
        owner, resource_id = self._holder(None)
        if not resource_id:
            where = "expected to be called in a status callback of a server"
            raise UsageError(f"registrar {self.name!r}: replace_part: {where}")
        return owner._replacements.replace(status, request, target, response, limit_s)

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
        progress: ProgressWanted = False,
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
        progress: ProgressWanted = False,
        block: Literal[False],
    ) -> pykka.Future[Query[Response]]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        response_type: type[Response] | None = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
        block: Literal[True] = True,
    ) -> Query[Response]: ...
    @overload
    def load(
        self,
        server: str,
        request: object,
        *,
        response_type: type[Response] | None = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
        block: Literal[False],
    ) -> pykka.Future[Query[Response]]: ...
    @overload
    def load(
        self,
        server: Declared[Request, Any, Any],
        request: Request,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
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
        progress: ProgressWanted = False,
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
        progress: ProgressWanted = False,
        block: bool = True,
    ) -> Any:
        """Load the resource for this request, or share it if somebody holds it already.

        If a callback makes the call, the resource becomes a dependency of the callback's resource.

        Args:
            server: "registrar/server"; or the method that declares it, such as `Cameras.open_camera`, if exactly one
                child of the system has that class. Type checkers then know the response's type.
            request: a value of the server's request type (docs/values.md).
            response_type: the type to read the response as, in place of the type that the server declares.
            on_status: a worker calls it with each Status of this query, in order. For a dependency it runs before the
                status callback of the resource that needs it, and instead of it if it calls `status.handled()`.
            timeout_s: seconds that the whole load may take. After that the load is withdrawn. None: no limit.
            parent: rr.current() of the callback, if another thread makes the call for it.
            progress: a callable that hears each rr.Progress that the load callback reports, while this load waits. Or
                True: draw a bar, if the error output is a terminal (needs `rr-actors[progress]`). The thread that waits
                calls it: the calling thread, with load_async() the task's event loop, with ``block=False`` a worker.
            block: False returns a Pykka future of the query at once.

        Returns:
            The Query, or with ``block=False`` a future of it.

        Raises:
            LoadFailed: the provider could not load it, most often because a load callback raised. `.trace` has the
                places.
            CircularDependency: the request would wait for itself. `.ring` has the servers around the ring; the text
                names the request that closes it.
            LoadTimeout: the provider did not answer in time.
            UnknownServer, UnknownRegistrar, InvalidName: there is no such server.
            InvalidRequest, NotSerializable: the request has another type, or cannot travel.
            UsageError: several children of the system have the class that declares the server; or `progress` is
                neither a callable nor a bool, or is True without rich.
            RegistrarDown: the provider is stopped or gone for good.
            MailboxFull: too many loads are in flight.
        """
        if block and asyncio._get_running_loop() is not None:
            self._warn_in_event_loop("load", "load_async")
        codec = None if response_type is None else codec_for(response_type)
        limit_s = time_limit(timeout_s)
        if on_status is not None:
            on_status = status_callback(on_status, "load")
        owner, parent_id = self._holder(parent)
        loads = owner._loads
        way = loads.wait if block else loads.future
        target = parse_server(server) if type(server) is str and "/" in server else self._target(server)
        hearer = None if progress is False else hearer_of(progress, owner._actor)
        loaded = way(target, encode(request), parent_id, on_status, limit_s, hearer)
        if codec is None:
            return loaded
        return read_as(loaded, codec) if isinstance(loaded, Query) else read_later(loaded, codec)

    @overload
    async def load_async(
        self,
        server: Declared[Request, Any, Response],
        request: Request,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
    ) -> Query[Response]: ...
    @overload
    async def load_async(
        self,
        server: str,
        request: object,
        *,
        response_type: type[Response] | None = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
    ) -> Query[Response]: ...

    async def load_async(
        self,
        server: str | Declared[Any, Any, Any],
        request: Any,
        *,
        response_type: Any = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
    ) -> Query[Any]:
        """Load as load() does, awaited. If it is cancelled, the load is withdrawn."""
        codec = None if response_type is None else codec_for(response_type)
        limit_s = time_limit(timeout_s)
        on_status = status_callback(on_status, "load")
        owner, parent_id = self._holder(parent)
        target = self._target(server)
        hearer = hearer_of(progress, owner._actor)
        query = await owner._loads.result(target, encode(request), parent_id, on_status, limit_s, hearer)
        return query if codec is None else read_as(query, codec)

    def _warn_in_event_loop(self, called: str, instead: str) -> None:
        """Warn once for each registrar that a call blocks the event loop of the calling thread.

        A notebook runs each cell on its kernel's event loop, which has nothing else to do.
        """
        if self._warned_in_event_loop or "ipykernel" in sys.modules:
            return
        if not self._node.dispatcher.may_block():  # a callback that is a coroutine: the call is refused
            return
        self._warned_in_event_loop = True
        text = f"{called}() blocks the event loop that runs in this thread until it returns"
        warnings.warn(f"registrar {self.name!r}: {text}: write `await {instead}(...)`", RuntimeWarning, stacklevel=3)

    def _target(self, server: object) -> ServerId:
        return server_target(server, self._node)

    def load_all(
        self,
        requests: Iterable[tuple[str, Any]],
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Queries:
        """Load several resources at once, and hold all of them or none::

            with app.load_all([("cameras/camera", "front"), ("maps/map", "hall")]) as (camera, map):
                ...

        Args:
            requests: one ("registrar/server", request) for each load.
            on_status, parent: as for load(), for each load.
            timeout_s: seconds that each load may take. None: no limit.

        Returns:
            The queries, in the order of the requests: a tuple, and a context manager that unloads them.

        Raises:
            The first error of a load, with a note that names its request. Everything that was held is released.
        """
        if asyncio._get_running_loop() is not None:
            self._warn_in_event_loop("load_all", "load_all_async")
        return self._group(requests, on_status, timeout_s, parent).wait()

    async def load_all_async(
        self,
        requests: Iterable[tuple[str, Any]],
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Queries:
        """Load as load_all() does, awaited. If it is cancelled, all loads are released or withdrawn."""
        return await self._group(requests, on_status, timeout_s, parent).result()

    def _group(self, requests: Any, on_status: Any, timeout_s: Any, parent: Any) -> Group:
        """Return a group of loads that has not begun, with its arguments checked."""
        asked = wanted(requests, self._target)
        limit_s = time_limit(timeout_s)
        on_status = status_callback(on_status, "load_all")
        owner, parent_id = self._holder(parent)
        return Group(owner._loads, owner._unloads, asked, parent_id, on_status, limit_s)

    def _holder(self, parent: Any) -> tuple[Registrar, str]:
        """Return the registrar that holds the next load, and the id of its resource that needs it; "" for none.

        Without `parent`, in a callback of this system, these are the callback's own.
        """
        context: Any = parent
        if context is None:
            context = current_or_none()
            if context is None or serving(context).node is not self._node:
                return self, ""
        if is_a(context, Current):
            audience = serving(context).audience
            return (self if audience is None else audience.holder), context.resource_id
        if is_a(context, str):
            return self, exact_text(context)
        if is_a(context, ResourceInfo):
            return self, context.id
        if is_a(context, Query):
            return self, context.resource_id
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
            UsageError: with `force`, a callback of that resource made the call, and would wait for itself.
            Unavailable: the provider did not come back in time. The release is owed, on disk, until it does.
        """
        self._calls.check_open()
        limit_s = time_limit(timeout_s)
        query_id = target_id(query_or_id)
        unloads = self._unloads
        if force:
            return unloads.force_wait(query_id, limit_s) if block else unloads.force_future(query_id)
        if is_a(query_or_id, Query) and query_or_id.origin != self.name:
            raise error_of(failures.not_holder(query_id, query_or_id.origin, self.name))
        return unloads.wait(query_id, limit_s) if block else unloads.future(query_id, limit_s)

    async def unload_async(
        self, query_or_id: Query | ResourceInfo | str, *, force: bool = False, timeout_s: float | None = 30.0
    ) -> None:
        """Release a query as unload() does, awaited. If it is cancelled, the unload goes on."""
        await self.unload(query_or_id, force=force, timeout_s=timeout_s, block=False)

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
        """Release everything that this registrar holds at one server ("registrar/server"), newest first.

        Raises:
            InvalidName: `server` does not have that form.
            UnknownServer: this registrar holds nothing there and never did. `.known` has the servers where it does.
            The errors of unload(), after all queries have been tried.
        """
        self._calls.check_open()
        reply = self._unloads.at_server(self._target(server), time_limit(timeout_s))
        return reply.get() if block else reply

    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: Literal[True] = True) -> None: ...
    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: Literal[False]) -> pykka.Future[None]: ...
    @overload
    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool) -> pykka.Future[None] | None: ...

    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Release everything that this registrar holds for itself, newest first. Its resources keep their dependencies.

        Raises:
            The errors of unload(), after all queries have been tried.
        """
        self._calls.check_open()
        reply = self._unloads.many(lambda held: not held.parent, time_limit(timeout_s))
        return reply.get() if block else reply

    # -- looking -------------------------------------------------------------------------------------------------

    def queries(self) -> list[Query]:
        """Return every query that this registrar holds, with the dependencies of its resources, oldest first."""
        return self._calls.call(self._queries_now)

    def _queries_now(self) -> list[Query]:
        held = [row for row in self._held_now() if row.hold is Hold.HELD]
        return [self._views.of(row) for row in sorted(held, key=lambda row: row.seq)]

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

        self._calls.dispatcher.call(lambda: self._actor.client(registrar).fetch(fetched))
        rows = self._calls.finish(future, limit_s, f"fetching from {registrar!r}")
        return [self._fetched_view(registrar, row) for row in rows]

    def _fetched_view(self, registrar: str, row: FetchedQuery) -> Query:
        place = (registrar, row.server, row.request, row.response, row.resource_id, row.parent, row.attempt, row.seq)
        held = Held(row.query_id, *place, Hold.HELD, State(row.state))
        return self._views.seen(held)

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
        target, here = resource_target(query), self._node.registrars.get(provider)
        if here is not None and here.audience is not None:
            return here.audience.holder.children(target)
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
        """Return every resource served here, with its state, response and holders."""
        return [self._info(*row) for row in self._calls.call(self._resources_now)]

    def _resources_now(self) -> list[tuple[Resource, ServerActor | None, list[QueryRow]]]:
        with self._actor.enter():
            catalog, server_of = self._actor.whole(), self._actor.servers.get
            return [(row, server_of(row.server), catalog.queries_of(row.id)) for row in catalog.resources.values()]

    def _info(self, resource: Resource, server: ServerActor | None, queries: list[QueryRow]) -> ResourceInfo:
        """Describe a resource. The calling thread decodes its values, which may run code of users' types."""
        request = (server.request if server else PLAIN).show(resource.request)
        response = None
        if resource.response is not None:
            response = (server.response if server else PLAIN).show(resource.response)
        state = str(resource.state if resource.phase is Phase.LOADED else resource.phase)
        facts = (state, resource.phase, resource.state, resource.message, resource.attempt)
        holders, ids = tuple(query.origin for query in queries), tuple(query.id for query in queries)
        return ResourceInfo(resource.id, resource.server, request, response, *facts, holders, ids)

    def clients(self) -> list[str]:
        """Return the servers ("registrar/server") where this registrar holds something."""
        rows = self._calls.call(self._held_now)
        return sorted({f"{row.registrar}/{row.server}" for row in rows if row.hold is not Hold.OWED})

    def _held_now(self) -> list[Held]:
        with self._actor.enter():
            return list(self._actor.whole().held.values())

    def servers(self) -> list[str]:
        """Return the servers registered here, as "registrar/server"."""
        return sorted(f"{self.name}/{name}" for name in self._calls.call(self._actor.servers.names))

    def owed(self) -> list[str]:
        """Return the ids of released queries whose provider does not know it yet."""
        return [row.id for row in self._calls.call(self._held_now) if row.hold is Hold.OWED]

    def stats(self) -> dict[str, int]:
        """Return counts of the present, and of events since the registrar was opened.

        Present: resources, queries held, releases owed, loads and unloads in flight, notices, and messages that wait
        for a decision ("mailbox"). Events: commits, and status and progress callbacks that raised. While a recording
        runs, commits are timed: "timed_commits" of them took "commit_us" microseconds.
        """
        return self._calls.call(self._stats_now)

    def _stats_now(self) -> dict[str, int]:
        actor = self._actor
        holds = [row.hold for row in self._held_now()]
        return {
            "resources": len(actor.catalog.resources),
            "queries": holds.count(Hold.HELD),
            "owed": holds.count(Hold.OWED),
            "loading": holds.count(Hold.PENDING) + len(actor.catalog.in_flight),
            "unloading": len(actor.unloads),
            "notices": len(actor.catalog.notices),
            "callback_failures": actor.callback_failures,
            "mailbox": len(actor.waiting),
            **actor.commit_counts(),
        }

    def _page(self, wanted: Wanted) -> Page:
        """Return a few of this registrar's resources or queries as text, for tools that show the system."""
        return page_of(self._actor, wanted)

    # -- status --------------------------------------------------------------------------------------------------

    def on_status(self, server: str, callback: StatusCallback) -> None:
        """Call `callback(status)` for every query that this registrar holds at that server, now and later.

        As in a load's `on_status`, `status.handled()` stops the status from going further up.
        """
        key = str(self._target(server))
        own = status_callback(callback, "on_status", "callback")
        if own is None:
            raise UsageError("on_status: callback: expected a callable, got None")
        self._calls.call(self._views.listen_to_server, key, own)

    # -- the catalog ---------------------------------------------------------------------------------------------

    def save_catalog(self) -> None:
        """Write all changes into the catalog's SQLite file.

        Raises:
            CatalogError: the file cannot be written.
        """
        self._calls.call(self._actor.save)

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
        self._calls.dispatcher.run(self._actor.node.settle(self._actor))

    def close(self, *, timeout_s: float | None = 30.0) -> None:
        """Release everything held, unload everything served, and leave the system. A second close does nothing.

        Raises:
            UsageError: timeout_s is no number of seconds, or a callback of this registrar made the call and would wait
                for itself. Nothing is closed.
        """
        limit_s = time_limit(timeout_s)
        node = self._actor.node
        if self._actor.closed:
            return
        instead = "start a thread for it, and let the callback return"
        check_not_own(f"registrar {self.name!r}: close()", lambda me: serving(me) is self._actor, instead)
        node.dispatcher.run(node.dismiss(self.name, limit_s))


# For the package's own modules. As a private method it stays out of an editor's list of names.
register_spec = Registrar._register_spec  # pyright: ignore[reportPrivateUsage]  # same file


def load_bytes(registrar: Registrar, server: str, request: bytes, timeout_s: float | None) -> tuple[Query[Any], bytes]:
    """Load with a request's canonical bytes, and return the query and its response's bytes.

    Raises:
        LoadError: the load failed, as in Registrar.load().
    """
    wait = registrar._loads.wait  # pyright: ignore[reportPrivateUsage]  # same file
    query = wait(parse_server(server), request, "", None, time_limit(timeout_s))
    return query, response_bytes(query)


def page(registrar: Registrar, wanted: Wanted) -> Page:
    """Return a page of what a registrar, of this process or another, serves or holds.

    Raises:
        RegistrarDown: the registrar is closed, or does not run.
    """
    return registrar._page(wanted)  # pyright: ignore[reportPrivateUsage]  # same file
