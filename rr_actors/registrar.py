"""Registrar: what people hold in their hands. Loads, unloads and serves resources, from any thread.

Each method hands a command to the registrar's actor on the process's loop and waits for how it ended: for ever never,
and never on the loop itself.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import pykka

from rr_actors import pickling
from rr_actors.actors.callbacks import Current, current_or_none
from rr_actors.actors.direct import Line
from rr_actors.actors.registrar import RegistrarActor
from rr_actors.actors.replies import Reply
from rr_actors.actors.server import ServerActor, ServerSpec, make_spec
from rr_actors.config import RegistrarConfig
from rr_actors.core import commands as c
from rr_actors.core.canonical import Codec, encode
from rr_actors.directory import Status as Presence
from rr_actors.errors import (
    NotHolder,
    RegistrarDown,
    RrError,
    Unavailable,
    UnknownQuery,
    UsageError,
)
from rr_actors.messages import Failure, FetchedQuery, Load, Loaded, LoadRefused, Unload, error_of, failure_of
from rr_actors.names import ServerId, check_name, new_id, parse_server_id
from rr_actors.queries import Query, ResourceInfo
from rr_actors.records import Held, Hold, Notice, Phase, Put, Resource, ServerType, State, StoredServer
from rr_actors.statuses import Status

logger = logging.getLogger("rr_actors.registrar")

T = TypeVar("T")

StatusCallback = Callable[[Status], Any]

_GRACE_S = 5.0
_TYPES_S = 2.0
_CALL_TIMEOUT_S = 30.0
_PLAIN = Codec(None)

_parse = functools.lru_cache(1024)(parse_server_id)


class Registrar:
    """A registrar of this process: a consumer of other registrars' resources, a provider of its own, or both.

    Made by System.open_registrar(), and as Manager.registrar.  Every method may be called from any thread; those with
    ``block=False`` return a Pykka future, which can also be awaited.
    """

    def __init__(self, actor: RegistrarActor) -> None:
        self._actor = actor
        self._views: dict[str, Query] = {}
        self._on_query: dict[str, StatusCallback] = {}
        self._on_server: dict[str, list[StatusCallback]] = {}
        self._codecs: dict[str, tuple[bytes, tuple[Codec, Codec]]] = {}
        actor.audience = self

    @property
    def name(self) -> str:
        """The registrar's name, unique in its system."""
        return self._actor.name

    @property
    def config(self) -> RegistrarConfig:
        """How its catalog is kept."""
        return self._actor.config

    def __repr__(self) -> str:
        return f"<Registrar {self.name}{' (closed)' if self._actor.closed else ''}>"

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
            unload: ``unload(request, response)``, when the last holder has let go.
            status: ``status(request, status)``, when something a resource depends on says how it is.
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
        self.register_spec(spec)

    def register_spec(self, spec: ServerSpec, *, stored: bytes | None = None) -> None:
        """Register a server from its checked description; with `stored`, keep it in the catalog by value."""
        types = pickling.dumps((spec.request_type, spec.response_type), f"{self.name}/{spec.name}: types")
        server = ServerActor(self._actor, spec, types)
        self._call(self._register, server, stored)

    def _register(self, server: ServerActor, stored: bytes | None) -> None:
        self._actor.register(server)
        if stored is not None:
            self._actor.commit_rows([Put(StoredServer(server.spec.name, stored))])

    def register_stored(self, blob: bytes) -> None:
        """Register a server that another process sent by value, and keep it in the catalog. In a worker."""
        self.register_spec(pickling.loads(blob), stored=blob)

    def unregister_server(self, name: str, *, timeout_s: float = 30.0) -> None:
        """Stop offering it: every query on it is released, its holders told (FATAL), its resources unloaded.

        Raises:
            UnknownServer: there is none of that name.
            UnloadFailed: an unload callback raised; the resource stays in the catalog.
        """
        self._check_open()
        start = functools.partial(self._actor.unregister, name)
        self._finish(self._start(start), timeout_s, f"unregistering {self.name}/{name}")

    def send_status(self, target: Query | ResourceInfo | str, status: Status) -> None:
        """Tell every holder of a resource served here how it is. Returns when that is on disk.

        Args:
            target: the resource's id, or a query on it (or its id).

        Raises:
            UnknownQuery: no such resource or query here.
        """
        if not isinstance(status, Status):  # pyright: ignore[reportUnnecessaryIsInstance] - users' own calls
            raise UsageError(f"send_status: expected a Status, got {type(status).__name__} ({status!r})")
        resource = _resource_target(target)
        command = functools.partial(c.SetStatus, resource, new_id(), status.state, status.message)
        self._command(command, f"status for {_target(target)}")

    def update_response(
        self, target: Query | ResourceInfo | str, response: Any, message: str = "late response"
    ) -> None:
        """Replace the stored response of a resource served here; its holders hear UPDATE and have the new one.

        Raises:
            UnknownQuery: no such resource or query here.
            UsageError: it is still loading.
        """
        raw = encode(response, "response")
        command = functools.partial(c.SetResponse, _resource_target(target), new_id(), raw, message)
        self._command(command, f"response for {_target(target)}")

    # -- load ----------------------------------------------------------------------------------------------------

    def load(
        self,
        server: str,
        request: Any,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        block: bool = True,
    ) -> Any:
        """Get a query on the resource for this request, loading it if nobody holds it yet.

        In a callback, what is loaded becomes a dependency of the callback's resource.

        Args:
            server: "registrar/server".
            request: plain data of the server's request type.
            on_status: called in a worker with each Status of this query, in order.
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
            RegistrarDown: the provider is stopped or gone for good.
            MailboxFull: too many loads are under way.
        """
        owner, query, ask = self._prepare(server, request, on_status, parent)
        if not block:
            future: Reply[Query] = Reply()
            owner._begin_load(query, ask, functools.partial(_settle, future, query))
            owner._limit_load(ask, timeout_s, future.done)
            return future
        owner._actor.node.dispatcher.check_may_block(f"{self.name}.load({server!r})")
        if not ask.parent and (line := owner._actor.direct.take(ask.registrar)) is not None:
            owner._load_directly(line, query, ask, timeout_s)
            return query
        wait = _Wait()
        owner._begin_load(query, ask, wait.load_ended)
        owner._await_load(wait, ask, timeout_s)
        return query

    def _await_load(self, wait: _Wait, ask: c.Ask, timeout_s: float | None) -> None:
        if not wait.done_within(timeout_s):
            self._post(c.GiveUp(ask.query_id, _too_late(ask, timeout_s)))
            wait.done_within(_GRACE_S)
        if wait.error is not None:
            raise wait.error
        if not wait.done:
            raise error_of(_too_late(ask, timeout_s))

    def _load_directly(self, line: Line, query: Query, ask: c.Ask, timeout_s: float | None) -> None:
        """Load by the caller's own line to the provider; see actors/direct.py."""
        actor = self._actor
        ask = ask._replace(seq=next(actor.direct.sequence), direct=True)
        began = time.monotonic()
        self._views[ask.query_id] = query
        actor.under_way[ask.query_id] = ask
        load = Load(ask.query_id, ask.server, ask.request, actor.name, "", 0, ask.seq)
        try:
            answer = line.exchange(load, timeout_s)
        except TimeoutError:
            line.say(Unload(ask.query_id, actor.name))  # behind the load, whenever that is read
            line.close()
            self._go_on(query, ask, 0.0, c.GiveUp(ask.query_id, _too_late(ask, timeout_s)))
            raise error_of(_too_late(ask, timeout_s)) from None
        except OSError:
            line.close()
            left_s = None if timeout_s is None else max(0.0, timeout_s - (time.monotonic() - began))
            self._go_on(query, ask, left_s, c.SendAgain(ask.query_id))
            return
        except RrError as error:
            line.close()
            self._go_on(query, ask, 0.0, c.GiveUp(ask.query_id, failure_of(error)))
            raise
        actor.direct.give_back(ask.registrar, line)
        known = actor.under_way.pop(ask.query_id, None) is None
        if known:
            actor.note(answer, ask.registrar)
        if isinstance(answer, Loaded):
            query.loaded_directly(answer.resource_id, answer.response)
            if not known:
                actor.note(c.Got(ask, answer.resource_id, answer.response))
        else:
            assert isinstance(answer, LoadRefused)
            self.forget(ask.query_id)
            raise error_of(answer.failure)

    def _go_on(self, query: Query, ask: c.Ask, timeout_s: float | None, command: Any) -> None:
        """The direct line is no more: the registrar's actor goes on with the load."""
        wait = _Wait()

        def ended(held: Held | None, error: RrError | None) -> None:
            if error is None and held is not None:
                query.loaded(held)
            wait.load_ended(held, error)

        if self._actor.under_way.pop(ask.query_id, None) is not None:
            self._actor.note(ask)
        self._actor.node.dispatcher.call(self._actor.follow, ask.query_id, ended, command)
        self._await_load(wait, ask, _GRACE_S if timeout_s == 0.0 else timeout_s)

    async def load_async(
        self,
        server: str,
        request: Any,
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Query:
        """As load(), awaited. Cancelled, it withdraws the load."""
        owner, query, ask = self._prepare(server, request, on_status, parent)
        loop = asyncio.get_running_loop()
        future: asyncio.Future[None] = loop.create_future()

        def settle(error: RrError | None) -> None:
            if not future.done():
                future.set_result(None) if error is None else future.set_exception(error)

        def ended(_held: Held | None, error: RrError | None) -> None:
            loop.call_soon_threadsafe(settle, error)

        owner._begin_load(query, ask, ended)
        owner._limit_load(ask, timeout_s, future.done)
        try:
            await future
        except asyncio.CancelledError:
            text = f"{server}: the load was cancelled"
            owner._post(c.GiveUp(ask.query_id, Failure("LoadError", text, {"server": server})))
            raise
        return query

    def _prepare(
        self, server: str, request: Any, on_status: StatusCallback | None, parent: Any
    ) -> tuple[Registrar, Query, c.Ask]:
        target = _parse_server(server)
        raw = encode(request, "request")
        owner, parent_id = self._holder(parent)
        owner._check_open()
        ask = c.Ask(new_id(), target.registrar, target.server, raw, parent_id)
        place = (ask.registrar, ask.server, raw, None, "", parent_id, 0, 0)
        query = Query(Held(ask.query_id, *place, Hold.PENDING, State.OK), owner.name, owner, owner.codecs_of)
        if on_status is not None:
            owner._on_query[ask.query_id] = on_status
        return owner, query, ask

    def _holder(self, parent: Any) -> tuple[Registrar, str]:
        """Who holds what is loaded now, and for which resource: in a callback, the callback's."""
        context = current_or_none() if parent is None else parent
        if context is None:
            return self, ""
        if isinstance(context, Current):
            owner = context.registrar.audience
            return (owner if isinstance(owner, Registrar) else self), context.resource_id
        if isinstance(context, ResourceInfo):
            context = context.id
        if isinstance(context, Query):
            context = context.resource_id
        if not isinstance(context, str):
            raise UsageError(f"parent: expected rr.current() or a resource id, got {type(context).__name__}")
        return self, context

    def _begin_load(self, query: Query, ask: c.Ask, ended: Callable[[Held | None, RrError | None], None]) -> None:
        def resolved(held: Held | None, error: RrError | None) -> None:
            if error is None and held is not None:
                query.loaded(held)
            else:
                self.forget(ask.query_id)
            ended(held, error)

        def begin() -> None:
            self._views[ask.query_id] = query
            self._actor.ask(ask, resolved)

        self._actor.node.dispatcher.call(begin)

    def _limit_load(self, ask: c.Ask, timeout_s: float | None, done: Callable[[], bool]) -> None:
        if timeout_s is None:
            return

        def expired() -> None:
            if not done() and not self._actor.closed:
                self._actor.post(c.GiveUp(ask.query_id, _too_late(ask, timeout_s)))

        dispatcher = self._actor.node.dispatcher
        dispatcher.call(dispatcher.loop.call_later, timeout_s, expired)

    # -- unload --------------------------------------------------------------------------------------------------

    def unload(
        self,
        target: Query | ResourceInfo | str,
        *,
        force: bool = False,
        timeout_s: float | None = 30.0,
        block: bool = True,
    ) -> Any:
        """Let a query go. Returns when that is done: the unload callback has run, or others hold the resource.

        Args:
            target: a query of this registrar, or its id. With `force`: a resource served here, a query on it, or
                the id of either; it is unloaded whoever holds it, and they hear FATAL.
            timeout_s: seconds to wait for a provider that is down.
            block: False returns a Pykka future at once.

        Raises:
            UnknownQuery: never held, or unloaded already. NotHolder: another registrar's.
            UnloadFailed: the unload callback raised; the query is still held and can be unloaded again.
            Unavailable: the provider did not come back in time; the release is owed, on disk, until it does.
        """
        self._check_open()
        query_id = _target(target)
        if force:
            start = functools.partial(self._actor.force, query_id)
            overdue = None
        else:
            if isinstance(target, Query) and target.origin != self.name:
                raise _not_holder(query_id, target.origin, self.name)
            start = functools.partial(self._release, query_id)
            overdue = functools.partial(self._release_overdue, query_id, timeout_s)
        future = self._start(start)
        if not block:
            self._limit(future, timeout_s, overdue)
            return future
        self._finish(future, timeout_s, f"unloading {query_id}", overdue)
        return None

    def _release(self, query_id: str, done: Callable[[RrError | None], None]) -> None:
        theirs = self._actor.catalog.queries.get(query_id)
        if query_id not in self._actor.catalog.held and theirs is not None and theirs.origin != self.name:
            done(_not_holder(query_id, theirs.origin, self.name))
        else:
            self._actor.release(query_id, done)

    def _release_overdue(self, query_id: str, timeout_s: float | None) -> None:
        held = self._actor.catalog.held.get(query_id)
        where = "its provider" if held is None else f"{held.registrar!r}"
        text = f"query {query_id}: {where} did not answer within {timeout_s:g} s; the release is owed and will be sent"
        details = {"registrar": "" if held is None else held.registrar, "timeout_s": timeout_s}
        if not self._actor.closed:
            self._actor.post(c.ReleaseOverdue(query_id, Failure("Unavailable", text, details)))

    def unload_client(self, server: str, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Let go of everything this registrar holds at one server ("registrar/server"), newest first.

        Raises:
            InvalidName; and what unload() raises, after all have been tried.
        """
        target = _parse_server(server)
        return self._unload_many(lambda held: (held.registrar, held.server) == target, timeout_s, block)

    def unload_all(self, *, timeout_s: float | None = 30.0, block: bool = True) -> Any:
        """Let go of everything this registrar holds for itself, newest first; what its resources hold goes with them.

        Raises:
            What unload() raises, after all have been tried.
        """
        return self._unload_many(lambda held: not held.parent, timeout_s, block)

    def _unload_many(self, wanted: Callable[[Held], bool], timeout_s: float | None, block: bool) -> Any:
        self._check_open()
        futures = self._call(self._release_many, wanted, timeout_s)
        together: Reply[None] = Reply()
        together.set_get_hook(functools.partial(_all_done, futures))
        return together.get() if block else together

    def _release_many(self, wanted: Callable[[Held], bool], timeout_s: float | None) -> list[Reply[None]]:
        held = self._actor.catalog.held
        futures: list[Reply[None]] = []
        for query_id in self._actor.newest_first():
            if wanted(held[query_id]) and held[query_id].hold is Hold.HELD:
                future: Reply[None] = Reply()
                self._actor.release(query_id, functools.partial(_settle_none, future))
                self._limit(future, timeout_s, functools.partial(self._release_overdue, query_id, timeout_s))
                futures.append(future)
        return futures

    # -- looking -------------------------------------------------------------------------------------------------

    def queries(self) -> list[Query]:
        """Every query this registrar holds, its resources' dependencies included, oldest first."""
        return self._call(self._queries_now)

    def _queries_now(self) -> list[Query]:
        held = [row for row in self._actor.catalog.held.values() if row.hold is Hold.HELD]
        return [self._view(row) for row in sorted(held, key=lambda row: row.seq)]

    def _view(self, held: Held) -> Query:
        view = self._views.get(held.id)
        if view is None:
            view = self._views[held.id] = Query(held, self.name, self, self.codecs_of)
        return view

    def fetch_queries(self, registrar: str, *, timeout_s: float = 30.0) -> list[Query]:
        """Ask a provider for the queries this registrar holds there, in full: what its catalog says.

        Raises:
            UnknownRegistrar, RegistrarDown: it is not there. Unavailable: it did not answer in time.
        """
        self._check_open()
        check_name(registrar, "registrar name")
        future: Reply[list[FetchedQuery]] = Reply()

        def fetched(queries: list[FetchedQuery] | None, error: Exception | None) -> None:
            if not future.done():
                future.set(queries) if error is None else future.set_exception((type(error), error, None))

        self._actor.node.dispatcher.call(lambda: self._actor.client(registrar).fetch(fetched))
        rows = self._finish(future, timeout_s, f"fetching from {registrar!r}")
        return [self._fetched_view(registrar, row) for row in rows]

    def _fetched_view(self, registrar: str, row: FetchedQuery) -> Query:
        place = (registrar, row.server, row.request, row.response, row.resource_id, row.parent, row.attempt, row.seq)
        held = Held(row.query_id, *place, Hold.HELD, State(row.state))
        return Query(held, self.name, self, self.codecs_of)

    def children(self, target: Query | ResourceInfo | str) -> list[Query]:
        """The queries that a resource served here depends on, oldest first.

        Raises:
            UnknownQuery: no such resource or query here.
        """
        return self._call(self._children_now, _target(target))

    def _children_now(self, target: str) -> list[Query]:
        catalog = self._actor.catalog
        resource_id = target
        if target in catalog.queries and target not in catalog.resources:
            resource_id = catalog.queries[target].resource_id
        if resource_id not in catalog.resources and resource_id not in catalog.parts:
            text = f"{target}: {self.name!r} serves no resource and no query of this id"
            raise UnknownQuery(text, query_id=target)
        return [self._view(catalog.held[id]) for id in reversed(catalog.parts_of(resource_id))]

    def resources(self) -> list[ResourceInfo]:
        """Every resource served here, with its state, response and holders."""
        rows = self._call(self._resources_now)
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
        request = (server.request if server else _PLAIN).decode(resource.request, f"{self.name}/{resource.server}")
        response = None
        if resource.response is not None:
            codec = server.response if server else _PLAIN
            response = codec.decode(resource.response, f"{self.name}/{resource.server}", "response")
        state = resource.state if resource.phase is Phase.LOADED else resource.phase
        facts = (state, resource.phase, resource.state, resource.message, resource.attempt)
        return ResourceInfo(resource.id, resource.server, request, response, *facts, holders, queries)

    def clients(self) -> list[str]:
        """The servers ("registrar/server") this registrar holds something at."""
        held = self._call(lambda: list(self._actor.catalog.held.values()))
        return sorted({f"{row.registrar}/{row.server}" for row in held if row.hold is not Hold.OWED})

    def servers(self) -> list[str]:
        """The servers registered here, as "registrar/server"."""
        return sorted(f"{self.name}/{name}" for name in self._call(lambda: list(self._actor.servers)))

    def owed(self) -> list[str]:
        """The ids of queries let go whose provider does not know it yet."""
        return self._call(lambda: [id for id, row in self._actor.catalog.held.items() if row.hold is Hold.OWED])

    # -- status --------------------------------------------------------------------------------------------------

    def on_status(self, server: str, callback: StatusCallback) -> None:
        """Have `callback(status)` called for every query this registrar holds at that server, now and later."""
        key = str(_parse_server(server))
        if not callable(callback):
            raise UsageError(f"on_status: expected a callable, got {type(callback).__name__}")
        self._call(lambda: self._on_server.setdefault(key, []).append(callback))

    def hear(self, held: Held, notice: Notice, heard: Callable[[], None], *, repeated: bool) -> None:
        """A status has arrived for a query. Called by the registrar's actor, on the loop.

        `heard` is called when all callbacks have returned: until then a crash has the provider say it again.
        """
        status = Status.of(notice, repeated=repeated)
        view = self._views.get(held.id)
        if view is not None:
            view.hear(status, notice.response, released=notice.released)
        callbacks = list(self._on_server.get(f"{held.registrar}/{held.server}", ()))
        if (own := self._on_query.get(held.id)) is not None:
            callbacks.insert(0, own)
        left = itertools.count(len(callbacks) - 1, -1)
        for callback in callbacks:
            self._run_callback(held, callback, status, lambda: None if next(left) else heard())
        if not callbacks:
            heard()

    def _run_callback(self, held: Held, callback: StatusCallback, status: Status, through: Callable[[], None]) -> None:
        def done(_result: Any, error: BaseException | None) -> None:
            through()
            if error is not None:
                self._actor.callback_failures += 1
                logger.error("%s: a status callback for %s raised", self.name, held.server, exc_info=error)

        try:
            self._actor.workers.serial(("hear", held.id), callback, status, done=done)
        except Unavailable as error:
            done(None, error)

    def forget(self, query_id: str) -> None:
        """A query is held no more. Called by the registrar's actor, on the loop."""
        self._views.pop(query_id, None)
        self._on_query.pop(query_id, None)

    # -- the catalog ---------------------------------------------------------------------------------------------

    def save_catalog(self) -> None:
        """Write what has not been written yet.

        Raises:
            CatalogError: it cannot be written.
        """
        self._call(self._actor.save)

    def load_catalog(self) -> None:
        """Take up the catalog as it is on disk, as after a restart: what was not saved is forgotten.

        Raises:
            UsageError: a load or unload is under way.
        """
        self._call(self._reload)

    def _reload(self) -> None:
        if self._actor.busy():
            raise UsageError(f"{self.name}: load_catalog() while a load or unload is under way; wait for it")
        self._actor.reload_catalog()

    def close(self, *, timeout_s: float = 30.0) -> None:
        """Release all that it holds, unload all that it serves, and leave the system. Closing twice is nothing."""
        node = self._actor.node
        if self._actor.closed:
            return
        node.dispatcher.run(self._close(timeout_s))

    async def _close(self, timeout_s: float) -> None:
        node = self._actor.node
        await node.wind_down(self.name, timeout_s)
        node.close_registrar(self.name, Presence.GONE, erase=self.config.erase_on_destruct)

    # -- reaching the loop ---------------------------------------------------------------------------------------

    def codecs_of(self, server_id: str) -> tuple[Codec, Codec]:
        """How to read the requests and responses of a server: its types, as it told them."""
        known = self._actor.catalog.server_types.get(server_id) or self._ask_types(server_id)
        if known is None:
            return _PLAIN, _PLAIN
        cached = self._codecs.get(server_id)
        if cached is None or cached[0] != known.blob:
            request_type, response_type = pickling.loads(known.blob)
            codecs = Codec(request_type, f"{server_id}: request"), Codec(response_type, f"{server_id}: response")
            cached = self._codecs[server_id] = (known.blob, codecs)
        return cached[1]

    def _ask_types(self, server_id: str) -> ServerType | None:
        """After a crash its types may not be in the catalog: ask the provider, and do without if it is down."""
        dispatcher = self._actor.node.dispatcher
        if dispatcher.is_loop_thread() or self._actor.closed:
            return None
        told = threading.Event()
        dispatcher.call(self._actor.tell_types, parse_server_id(server_id), told.set)
        told.wait(_TYPES_S)
        return self._actor.catalog.server_types.get(server_id)

    def _check_open(self) -> None:
        if self._actor.closed:
            text = f"registrar {self.name!r}: closed"
            raise RegistrarDown(text, registrar=self.name, status="stopped")

    def _post(self, command: Any) -> None:
        self._actor.node.dispatcher.call(self._actor.post, command)

    def _call(self, fn: Callable[..., T], *args: Any) -> T:
        """Run fn on the loop and return what it returns."""
        self._check_open()
        dispatcher = self._actor.node.dispatcher
        if dispatcher.is_loop_thread():
            return fn(*args)
        wait = _Wait()
        dispatcher.call(self._actor.catch_up)
        dispatcher.call(wait.run, fn, args)
        if not wait.done_within(_CALL_TIMEOUT_S):
            raise Unavailable(f"registrar {self.name!r}: its loop has not answered for {_CALL_TIMEOUT_S:g} s")
        if wait.error is not None:
            raise wait.error
        return wait.value

    def _start(self, start: Callable[[Callable[[RrError | None], None]], None]) -> Reply[None]:
        future: Reply[None] = Reply()
        self._actor.node.dispatcher.call(start, functools.partial(_settle_none, future))
        return future

    def _command(self, command: Callable[..., Any], what: str) -> None:
        self._check_open()
        self._finish(self._start(lambda done: self._actor.post(command(done))), _CALL_TIMEOUT_S, what)

    def _finish(
        self,
        future: Reply[Any],
        timeout_s: float | None,
        what: str,
        overdue: Callable[[], None] | None = None,
    ) -> Any:
        try:
            return future.get(timeout=timeout_s)
        except pykka.Timeout:
            if overdue is not None:
                self._actor.node.dispatcher.call(overdue)
                try:
                    return future.get(timeout=_GRACE_S)
                except pykka.Timeout:
                    pass
            raise Unavailable(f"registrar {self.name!r}: {what} took longer than {timeout_s:g} s") from None

    def _limit(self, future: Reply[Any], timeout_s: float | None, overdue: Callable[[], None] | None) -> None:
        if timeout_s is None or overdue is None:
            return

        def expired() -> None:
            if not future.done():
                overdue()

        dispatcher = self._actor.node.dispatcher
        dispatcher.call(dispatcher.loop.call_later, timeout_s, expired)


class _Wait:
    """One thread waiting for one thing that the loop does."""

    __slots__ = ("_lock", "done", "error", "value")

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()
        self.done = False
        self.value: Any = None
        self.error: BaseException | None = None

    def load_ended(self, _held: Held | None, error: RrError | None) -> None:
        """How a load ended."""
        self.error = error
        self.done = True
        self._lock.release()

    def run(self, fn: Callable[..., Any], args: tuple[Any, ...]) -> None:
        """Run fn on the loop, for the thread that waits."""
        try:
            self.value = fn(*args)
        except Exception as error:
            self.error = error
        self.done = True
        self._lock.release()

    def done_within(self, timeout_s: float | None) -> bool:
        """Wait; whether it is done."""
        return self._lock.acquire(timeout=-1 if timeout_s is None else max(0.0, timeout_s))


def _settle(future: Reply[Query], query: Query, _held: Held | None, error: RrError | None) -> None:
    future.set(query) if error is None else future.set_exception((type(error), error, None))


def _settle_none(future: Reply[None], error: RrError | None) -> None:
    future.set(None) if error is None else future.set_exception((type(error), error, None))


def _all_done(futures: list[Reply[None]], timeout: float | None) -> None:
    errors: list[Exception] = []
    for future in futures:
        try:
            future.get(timeout=timeout)
        except RrError as error:
            errors.append(error)
    if errors:
        for other in errors[1:]:
            errors[0].add_note(f"and {type(other).__name__}: {other}")
        raise errors[0]


def _too_late(ask: c.Ask, timeout_s: float | None) -> Failure:
    server = f"{ask.registrar}/{ask.server}"
    text = f"{server}: not loaded within {timeout_s:g} s; the load is withdrawn"
    return Failure("LoadTimeout", text, {"server": server, "timeout_s": timeout_s})


def _not_holder(query_id: str, origin: str, caller: str) -> NotHolder:
    text = f"query {query_id}: held by {origin!r}, not by {caller!r}; unload it there"
    return NotHolder(text, query_id=query_id, origin=origin, caller=caller)


def _parse_server(server: object) -> ServerId:
    return _parse(server) if isinstance(server, str) else parse_server_id(server)


def _target(target: object) -> str:
    if isinstance(target, Query):
        return target.id
    if isinstance(target, ResourceInfo):
        return target.id
    if isinstance(target, str):
        return target
    raise UsageError(f"expected a Query or an id, got {type(target).__name__} ({target!r})")


def _resource_target(target: object) -> str:
    """A query stands for its resource also when its own holder has left."""
    return target.resource_id if isinstance(target, Query) else _target(target)
