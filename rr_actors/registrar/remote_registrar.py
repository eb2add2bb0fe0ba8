"""RegistrarHandle: a registrar of another process, to be used like one of this process."""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pykka

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base import pickling
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import RrError, Unavailable, UsageError, is_a
from rr_actors.registrar.arguments import codec_for
from rr_actors.registrar.engine.server import ServerSpec, log_unread_types
from rr_actors.registrar.load_groups import Queries, iterated
from rr_actors.registrar.progress_hearers import ProgressWanted
from rr_actors.registrar.queries import Query, held_by, read_as
from rr_actors.registrar.registrar import Registrar, StatusCallback
from rr_actors.runtime.time_limits import time_limit
from rr_actors.system.hosting.node import Node
from rr_actors.system.hosting.remote_calls import METHODS, HandleLine

_GRACE_S = 10.0


class RegistrarHandle(Registrar):
    """A registrar of another process, from System.registrar(). A worker of that process runs each call.

    A call waits for a registrar that is being started or respawned, within its time limit (30 s if it has none). With
    `patient=False` it raises RegistrarDown at once. If the process dies during a call that changes nothing, the call is
    made again. Any other call then raises RegistrarDown: whether it was done is not known.

    That registrar holds what the handle loads. Callbacks travel to its process by cloudpickle, and run there. Its
    catalog keeps a server that is registered through the handle, so that a respawn restores the server.
    """

    def __init__(  # pyright: ignore[reportMissingSuperCall] - nothing in common
        self, node: Node, name: str, *, patient: bool = True, owner: object = None
    ) -> None:
        self._owner = owner  # kept alive while this handle is in use
        self._node = node
        self._name = name
        self._patient = patient
        self._line: HandleLine = node.handle(name)

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

    def _register_spec(self, spec: ServerSpec, *, stored: bytes | None = None, restored: bool = False) -> None:
        """Register a server in the other process from its checked spec; a respawn restores it."""
        log_unread_types(spec, f"{self.name}/{spec.name}")
        for role in ("load", "unload", "status", "recover"):
            pickling.dumps(getattr(spec, role), f"{role} callback")  # its error names the callback that cannot travel
        self._register_stored(pickling.dumps(spec, f"server {spec.name!r}"))

    def load(  # pyright: ignore[reportIncompatibleMethodOverride] - Registrar's overloads say what it returns
        self,
        server: Any,
        request: Any,
        *,
        response_type: Any = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
        block: bool = True,
    ) -> Any:
        """Load as Registrar.load() does. That registrar holds the resource, and its process runs `on_status`.

        In a callback, the callback's own registrar holds the resource, as with any other registrar.

        Raises:
            UsageError: `progress` is given outside of a callback: only a registrar of this process can hear it.
        """
        limit_s = time_limit(timeout_s)
        target = str(self._target(server))
        owner, parent = self._holder(parent)
        if owner is not self:  # in a callback
            options: dict[str, Any] = {"response_type": response_type, "on_status": on_status, "timeout_s": limit_s}
            return owner.load(target, request, **options, parent=parent, progress=progress, block=block)
        if progress is not False and progress is not None:
            text = "progress is heard only in the process that holds the query: load by a registrar of this process"
            raise UsageError(f"registrar {self.name!r}: {text} (system.open_registrar)")
        codec = None if response_type is None else codec_for(response_type)
        reply: Reply[Query] = Reply()

        def own(query: Query) -> Query:
            return held_by(query, self) if codec is None else read_as(held_by(query, self), codec)

        try:
            self._begin(reply, "load", target, request, on_status=on_status, timeout_s=limit_s, parent=parent)
            if block:
                return own(self._finish(reply, limit_s))
            owned: Reply[Query] = Reply()
            owned.withdraw = lambda: self._withdraw(reply)
            reply.add_done_callback(lambda reply: owned.set_unopened(lambda: own(reply.get())))
            return owned
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the query
            self._withdraw(reply)
            raise

    async def load_async(  # pyright: ignore[reportIncompatibleMethodOverride] - as load()
        self,
        server: Any,
        request: Any,
        *,
        response_type: Any = None,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
        progress: ProgressWanted = False,
    ) -> Any:
        """Load as load() does, awaited. If it is cancelled, the load is withdrawn."""
        options: dict[str, Any] = {"response_type": response_type, "on_status": on_status, "timeout_s": timeout_s}
        owner, parent = self._holder(parent)
        if owner is not self:
            target = str(self._target(server))
            return await owner.load_async(target, request, **options, parent=parent, progress=progress)
        reply: Reply[Query] = self.load(server, request, **options, parent=parent, progress=progress, block=False)
        try:
            return await reply
        except BaseException:  # cancelled, or KeyboardInterrupt: the caller never gets the query
            self._withdraw(reply)
            raise

    def load_all(
        self,
        requests: Iterable[tuple[str, Any]],
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Queries:
        """Load as Registrar.load_all() does. That registrar holds the resources."""
        owner, parent = self._holder(parent)
        if owner is not self:
            return owner.load_all(requests, on_status=on_status, timeout_s=timeout_s, parent=parent)
        requests = list(iterated(requests))
        reply: Reply[Queries] = Reply()
        try:
            options: dict[str, Any] = {"on_status": on_status, "timeout_s": timeout_s, "parent": parent}
            return self._own(self._finish(reply, self._begin(reply, "load_all", requests, **options)))
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the queries
            self._withdraw(reply)
            raise

    async def load_all_async(
        self,
        requests: Iterable[tuple[str, Any]],
        *,
        on_status: StatusCallback | None = None,
        timeout_s: float | None = 30.0,
        parent: Any = None,
    ) -> Queries:
        """Load as load_all() does, awaited. If it is cancelled, all queries are released."""
        owner, parent = self._holder(parent)
        if owner is not self:
            return await owner.load_all_async(requests, on_status=on_status, timeout_s=timeout_s, parent=parent)
        requests = list(iterated(requests))
        reply: Reply[Queries] = Reply()
        try:
            self._begin(reply, "load_all", requests, on_status=on_status, timeout_s=timeout_s, parent=parent)
            return self._own(await reply)
        except BaseException:  # cancelled, or KeyboardInterrupt: the caller never gets the queries
            self._withdraw(reply)
            raise

    def close(self, *, timeout_s: float | None = 30.0) -> None:
        """Refuse to close: a manager's registrar lives as long as its manager.

        Raises:
            UsageError: always.
        """
        raise UsageError(f"registrar {self._name!r}: a handle cannot close it; stop its manager instead")

    # -- calling -------------------------------------------------------------------------------------------------

    def _ask(self, method: str, *args: Any, block: bool = True, **options: Any) -> Any:
        reply: Reply[Any] = Reply()
        limit_s = self._begin(reply, method, *args, **options)
        return self._own(self._finish(reply, limit_s)) if block else reply

    def _begin(self, reply: Reply[Any], method: str, *args: Any, **options: Any) -> float | None:
        """Have the other process call a method, and return for how many seconds the caller may wait for the reply."""
        limit_s: float | None = 30.0
        if "timeout_s" in options:
            limit_s = options["timeout_s"] = time_limit(options["timeout_s"])
        self._line.call(method, args, options, limit_s if self._patient else 0.0, reply)
        return limit_s

    def _finish(self, reply: Reply[Any], timeout_s: float | None) -> Any:
        try:
            return reply.get(timeout=None if timeout_s is None else timeout_s + _GRACE_S)
        except pykka.Timeout:
            raise Unavailable(f"registrar {self._name!r}: no answer within {timeout_s:g} s") from None

    def _withdraw(self, reply: Reply[Any]) -> None:
        """Release the queries of a load if it still succeeds, because its caller has gone."""

        def done(reply: Reply[Query]) -> None:
            with contextlib.suppress(Unavailable):  # the system stops, and that registrar with it
                self._node.dispatcher.workers.submit(self._release, reply, patient=True)

        reply.add_done_callback(done)

    def _release(self, reply: Reply[Any]) -> None:
        try:
            got = reply.get()
        except RrError:
            return  # nothing is held
        for query in got if isinstance(got, Queries) else (got,):
            self.unload(query, block=False)

    def _own(self, got: Any) -> Any:
        """Return the result of a call, and make this handle the holder of the queries in it."""
        several: Iterable[Any] = got if issubclass(type(got), (list, tuple)) else ()
        for one in several:
            if is_a(one, Query):
                held_by(one, self)
        return got


def _called_there(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method for RegistrarHandle that has a method of Registrar called in the registrar's process."""
    signature = inspect.signature(method)

    @functools.wraps(method)
    def call(self: RegistrarHandle, *args: Any, **options: Any) -> Any:
        bound = signature.bind(self, *args, **options)
        bound.apply_defaults()  # sent, too: while a call waits to be sent, its timeout_s gets less
        return self._ask(method.__name__, *bound.args[1:], **bound.kwargs)  # pyright: ignore[reportPrivateUsage]  # same file

    return call


for _name in METHODS - vars(RegistrarHandle).keys():  # the methods that are not defined above
    setattr(RegistrarHandle, _name, _called_there(getattr(Registrar, _name)))
