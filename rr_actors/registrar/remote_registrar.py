"""Registrars that another process has: how they are called from here.

RemoteLoads and RemoteUnloads wait, withdraw and release in one way for all of them. A subclass of RemoteCalls carries
the calls: a handle's to a registrar of the same system, a connection's (system/console/connection.py) to the system
that it has connected to.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import functools
import inspect
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import pykka
from msgspec.structs import replace

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base import pickling
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import RegistrarDown, RrError, Unavailable, UnknownQuery, UnknownRegistrar, UsageError, is_a
from rr_actors.base.names import ServerId
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.arguments import LoadOptions
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.server import ServerSpec, log_unread_types
from rr_actors.registrar.links.remote_calls import GRACE_S, HandleLine, is_for_handles
from rr_actors.registrar.load_groups import GroupWays, LoadWanted, Queries
from rr_actors.registrar.loads import LoadWays, UnloadWays
from rr_actors.registrar.model.roles import ROLES
from rr_actors.registrar.queries import Holder, Query, held_by, read_as
from rr_actors.registrar.registrar import Registrar
from rr_actors.runtime.time_limits import time_limit

logger = Log("rr_actors.registrar")

T = TypeVar("T")

CALL_TIMEOUT_S = 30.0


# -- every registrar of another process --------------------------------------------------------------------------------


class RemoteCalls(abc.ABC):
    """The calls to one registrar of another process. From any thread."""

    def __init__(self, name: str) -> None:
        self.name = name

    @abc.abstractmethod
    def send(self, reply: Reply[Any], method: str, *args: Any, **options: Any) -> None:
        """Have the other process call a method of the registrar. `reply` gets the result, or the error.

        Raises:
            NotSerializable: an argument cannot travel.
        """

    def ask(self, method: str, *args: Any, **options: Any) -> Any:
        """Call a method as send() does, and return its result."""
        reply: Reply[Any] = Reply()
        self.send(reply, method, *args, **options)
        return self.finish(reply, time_limit(options.get("timeout_s", CALL_TIMEOUT_S)))

    def finish(self, reply: Reply[T], timeout_s: float | None) -> T:
        """Return the result of a call. The other process ends an overdue call; the thread waits a little longer."""
        try:
            return reply.take(timeout=None if timeout_s is None else timeout_s + GRACE_S)
        except pykka.Timeout:
            raise self.overdue(timeout_s) from None

    def overdue(self, timeout_s: float | None) -> RrError:
        """Return the error that no answer came within the time limit of a call."""
        return Unavailable(f"registrar {self.name!r}: no answer within {timeout_s:g} s{self.paused()}")

    def paused(self) -> str:
        """Return words, "; it is ...", for an error if a signal has stopped the registrar's process; "" else."""
        return ""


class _Begun(Reply[T]):
    """A load by the other process, or all loads of a group: the future of the queries. cancel() withdraws it.

    Args:
        send: has the other process load. The reply that it is given gets the queries, or the error.
        own: returns what has arrived, made queries of this process's registrar object.
    """

    def __init__(self, loads: RemoteLoads, send: Callable[[Reply[T]], None], own: Callable[[T], T]) -> None:
        super().__init__()
        self._loads = loads
        self._send = send
        self._own = own
        self._sent: Reply[T] = Reply()
        self.withdraw = self.give_up

    def begin(self) -> Reply[T]:
        """Send the call, and return this future."""
        try:
            self._begin()
        except BaseException as error:  # also KeyboardInterrupt: the caller never gets the future
            self._failed(error)
            raise
        return self

    def wait(self, timeout_s: float | None) -> T:
        """Return the queries, within the time limit of the call."""
        try:
            self._begin()
            return self._loads.calls.finish(self, timeout_s)
        except BaseException as error:  # also KeyboardInterrupt: the caller never gets the queries
            self._failed(error)
            raise

    async def awaited(self, timeout_s: float | None) -> T:
        """Return the queries, awaited within the time limit of the call. If that is cancelled, release them."""
        limit = asyncio.timeout(None if timeout_s is None else timeout_s + GRACE_S)
        try:
            self._begin()
            async with limit:
                return await self
        except BaseException as error:  # also KeyboardInterrupt, which may come anywhere
            self._failed(error)
            if limit.expired():
                raise self._loads.calls.overdue(timeout_s) from None
            raise
        finally:
            self.forget_error()

    def unawaited(self) -> None:
        """Withdraw the load, or release the queries, which nobody has got."""
        if not self.cancel():
            self.give_up()

    def give_up(self) -> None:
        """Release what is loaded, now or later, as no caller waits for it any more."""
        self._sent.when_set(lambda: self._loads.release_later(self._sent))

    def _begin(self) -> None:
        self._send(self._sent)
        got = functools.partial(
            _owned, self._own, self._sent
        )  # without this future: the error has the frames that call it
        self._sent.when_set(lambda: self.set_unopened(got))

    def _failed(self, error: BaseException) -> None:
        if not (self.done() and isinstance(error, RrError)):  # else nothing is held
            self.unawaited()


def _owned(own: Callable[[T], T], sent: Reply[T]) -> T:
    return own(sent.take())


class RemoteLoads(LoadWays, abc.ABC):
    """The loads of a registrar that another process has. From any thread."""

    def __init__(self, calls: RemoteCalls, holder: Holder) -> None:
        self.calls = calls
        self.holder = holder

    @abc.abstractmethod
    def send_load(
        self, reply: Reply[Query], target: ServerId, request: bytes, parent: str, options: LoadOptions
    ) -> None:
        """Have the other process load. `reply` gets the query, or the error."""

    @abc.abstractmethod
    def send_all(
        self, reply: Reply[Queries], requests: Sequence[LoadWanted], parent: str, options: LoadOptions
    ) -> None:
        """Have the other process load all requests, or none. `reply` gets the queries, or the error."""

    def own(self, query: Query, options: LoadOptions) -> Query:
        """Make a query that has arrived one of this process's registrar object."""
        return query if options.codec is None else read_as(query, options.codec)

    def begin(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Reply[Query]:
        return self._begun(target, request, parent, options).begin()

    def wait(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Query:
        return self._begun(target, request, parent, options).wait(options.timeout_s)

    async def awaited(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Query:
        return await self._begun(target, request, parent, options).awaited(options.timeout_s)

    def _begun(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> _Begun[Query]:
        self.check(options)
        send = functools.partial(self.send_load, target=target, request=request, parent=parent, options=options)
        return _Begun(self, send, functools.partial(self.own, options=options))

    def check(self, options: LoadOptions) -> None:
        """Raise UsageError for an option that has no meaning in this process."""
        if options.progress is not False and options.progress is not None:
            text = "progress is heard only in the process that holds the query: load by a registrar of this process"
            raise UsageError(f"registrar {self.calls.name!r}: {text} (system.open_registrar)")

    def release_later(self, sent: Reply[Any]) -> None:
        """Release the queries of a call that no caller waits for, in a thread of its own: this one may be the loop."""
        threading.Thread(target=self._release, args=(sent,), name="rr-undo").start()

    def _release(self, sent: Reply[Any]) -> None:
        try:
            got = sent.take()
        except Exception:
            return  # nothing is held
        for query in got if isinstance(got, Queries) else (got,):
            self.release(query)

    def release(self, query: Query) -> None:
        """Release a query for which no caller waits."""
        try:
            self.calls.ask("unload", query.id, timeout_s=CALL_TIMEOUT_S)
        except (Unavailable, RegistrarDown, UnknownQuery):
            logger.debug("%r: it is released already, or its registrar has ended", query)
        except RrError:
            logger.exception("%r: its load was cancelled, and it is not released", query)


class RemoteGroup(GroupWays):
    """The loads of one load_all() by a registrar that another process has."""

    def __init__(self, loads: RemoteLoads, requests: Sequence[LoadWanted], parent: str, options: LoadOptions) -> None:
        self._loads = loads
        self._call = requests, parent, options
        self._options = options

    def _begun(self) -> _Begun[Queries]:
        self._loads.check(self._options)
        return _Begun(self._loads, lambda sent: self._loads.send_all(sent, *self._call), self._own)

    def _own(self, queries: Queries) -> Queries:
        return Queries(self._loads.own(query, self._options) for query in queries)

    def wait(self) -> Queries:
        return self._begun().wait(self._options.timeout_s)

    async def awaited(self) -> Queries:
        return await self._begun().awaited(self._options.timeout_s)


class RemoteUnloads(UnloadWays):
    """The unloads of a registrar that another process has."""

    def __init__(self, calls: RemoteCalls, release: str = "unload", release_client: str = "unload_client") -> None:
        self._calls = calls
        self._release = release  # the method that releases a query
        self._release_client = release_client  # the one that releases all at a server

    def begin(self, query_id: str, timeout_s: float | None) -> Reply[None]:
        return self._begun(self._release, query_id, timeout_s=timeout_s)

    def wait(self, query_id: str, timeout_s: float | None) -> None:
        self._calls.ask(self._release, query_id, timeout_s=timeout_s)

    async def awaited(self, query_id: str, timeout_s: float | None) -> None:
        await self.begin(query_id, timeout_s)

    def force_begin(self, target: str, timeout_s: float | None) -> Reply[None]:
        return self._begun("unload", target, force=True, timeout_s=timeout_s)

    def force_wait(self, target: str, timeout_s: float | None) -> None:
        self._calls.ask("unload", target, force=True, timeout_s=timeout_s)

    def begin_all(self, server: ServerId | None, timeout_s: float | None) -> Reply[None]:
        return self._begun(*self._all_at(server), timeout_s=timeout_s)

    def wait_all(self, server: ServerId | None, timeout_s: float | None) -> None:
        self._calls.ask(*self._all_at(server), timeout_s=timeout_s)

    def _all_at(self, server: ServerId | None) -> tuple[str, ...]:
        return ("unload_all",) if server is None else (self._release_client, str(server))

    def _begun(self, method: str, *args: Any, **options: Any) -> Reply[None]:
        reply: Reply[None] = Reply()
        self._calls.send(reply, method, *args, **options)
        return reply


# -- a registrar of the same system ------------------------------------------------------------------------------------


_LOADS = ("_load", "_load_all")
"""Methods whose late results are heard, too, to be released: their callers wait no longer than their time limits."""


class HandleCalls(RemoteCalls):
    """The calls of a handle. Arguments and results travel by cloudpickle.

    Args:
        patient: whether a call waits for a registrar that is being started or respawned.
    """

    def __init__(self, line: HandleLine, name: str, *, patient: bool) -> None:
        super().__init__(name)
        self._line = line
        self._patient = patient

    def send(self, reply: Reply[Any], method: str, *args: Any, **options: Any) -> None:
        """Have a worker of the other process call the method."""
        limit_s = time_limit(options.get("timeout_s", CALL_TIMEOUT_S))
        patience_s = limit_s if self._patient else 0.0
        self._line.call(method, args, options, patience_s, reply, None if method in _LOADS else limit_s)

    def paused(self) -> str:
        """Return words, "; it is ...", for an error if a signal has stopped the registrar's process; "" else."""
        return self._line.paused()


class HandleLoads(RemoteLoads):
    """The loads of a handle. The other process runs `on_status`."""

    def send_load(
        self, reply: Reply[Query], target: ServerId, request: bytes, parent: str, options: LoadOptions
    ) -> None:
        """Have the other process load."""
        there = _without_own(options)
        self.calls.send(reply, "_load", str(target), request, parent, there, timeout_s=options.timeout_s)

    def send_all(
        self, reply: Reply[Queries], requests: Sequence[LoadWanted], parent: str, options: LoadOptions
    ) -> None:
        """Have the other process load all requests."""
        there = _without_own(options)
        self.calls.send(reply, "_load_all", list(requests), parent, there, timeout_s=options.timeout_s)

    def own(self, query: Query, options: LoadOptions) -> Query:
        """Have the handle unload the query."""
        return super().own(held_by(query, self.holder), options)


def _without_own(options: LoadOptions) -> LoadOptions:
    """Return the options without those that have their effect in this process."""
    return replace(options, codec=None, parent=None, loop=None)


def _called_there(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method for RegistrarHandle that has a method of Registrar called in the registrar's process."""
    signature = inspect.signature(method)

    @functools.wraps(method)
    def call(self: RegistrarHandle, *args: Any, **options: Any) -> Any:
        bound = signature.bind(self, *args, **options)
        bound.apply_defaults()  # sent, too: while a call waits to be sent, its timeout_s gets less
        return self._ask(method.__name__, *bound.args[1:], **bound.kwargs)  # pyright: ignore[reportPrivateUsage]  # same file

    return call


def _calls_there(handle: type[T]) -> type[T]:
    """Have a handle call each method of Registrar there that is declared for handles."""
    for name, method in vars(Registrar).items():
        if is_for_handles(name) and name not in vars(handle):
            setattr(handle, name, _called_there(method))
    return handle


@_calls_there
class RegistrarHandle(Registrar):
    """A registrar of another process, from System.registrar(). A worker of that process runs each call.

    A call waits for a registrar that is being started or respawned, within its time limit (30 s if it has none). With
    `patient=False` it raises RegistrarDown at once. If the process dies during a call that changes nothing, the call is
    made again. Any other call then raises RegistrarDown: whether it was done is not known.

    That registrar holds what the handle loads; in a callback, the callback's own registrar does. Callbacks travel to
    its process by cloudpickle, and run there. Its catalog keeps a server that is registered through the handle, so that
    a respawn restores the server.
    """

    def __init__(  # pyright: ignore[reportMissingSuperCall] - nothing in common
        self, node: Node, name: str, *, patient: bool = True, owner: object = None
    ) -> None:
        self._owner = owner  # kept alive while this handle is in use
        self._node = node
        self._is_alone = node.info.hosts is None
        self._name = name
        self._far = HandleCalls(node.handle(name), name, patient=patient)
        self._unload_ways = RemoteUnloads(self._far, "_unload_from_outside", "_unload_client_from_outside")

    @property
    def _load_ways(self) -> HandleLoads:
        return HandleLoads(self._far, self)  # not kept: it would be a cycle

    @property
    def name(self) -> str:
        """The registrar's name."""
        return self._name

    @property
    def config(self) -> RegistrarConfig:
        """The configuration: where and how the catalog is kept."""
        return self._node.config.registrar(self._name)

    def __repr__(self) -> str:
        return f"<Registrar {self._name} (handle)>"

    def _check_open(self) -> None:
        """Do nothing: the other process knows whether the registrar is open."""

    def _group(self, requests: Sequence[LoadWanted], parent: str, options: LoadOptions) -> GroupWays:
        return RemoteGroup(self._load_ways, requests, parent, options)

    def _register_spec(self, spec: ServerSpec, *, stored: bytes | None = None, restored: bool = False) -> None:
        """Register a server in the other process from its checked spec; a respawn restores it."""
        log_unread_types(spec, f"{self.name}/{spec.name}")
        for role in ROLES:
            pickling.dumps(getattr(spec, role), f"{role} callback")  # its error names the callback that cannot travel
        self._register_stored(pickling.dumps(spec, f"server {spec.name!r}"))

    def _stop_listening(self, server: str, id: str) -> None:
        if not self._node.dispatcher.closed:  # else the system has ended
            with contextlib.suppress(RegistrarDown, UnknownRegistrar):  # its callbacks have ended with its process
                self._ask("_stop_listening", server, id)

    def close(self, *, timeout_s: float | None = 30.0) -> None:
        """Refuse to close: a manager's registrar lives as long as its manager.

        Raises:
            UsageError: always.
        """
        raise UsageError(f"registrar {self._name!r}: a handle cannot close it; stop its manager instead")

    def _ask(self, method: str, *args: Any, **options: Any) -> Any:
        """Call a method there, and make this handle the holder of the queries in its result."""
        got = self._far.ask(method, *args, **options)
        several: Iterable[Any] = got if issubclass(type(got), (list, tuple)) else ()
        for one in several:
            if is_a(one, Query):
                held_by(one, self)
        return got
