"""Servers: the servers of one registrar, by name; and their stored values, read again when they are registered."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec

from rr_actors.base.errors import NameTaken, RrError, readable, text_of
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode, shown_plain
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import Callback
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Described
from rr_actors.registrar.model.rows import Resource
from rr_actors.registrar.servers.server_actor import ServerActor
from rr_actors.runtime.thread_rules import on_loop


class Servers:
    """The servers of one registrar, by name; get() returns None if there is none."""

    def __init__(self, registrar: RegistrarBase, consumers: Consumers) -> None:
        self._registrar = registrar
        self._consumers = consumers
        self._by_name: dict[str, ServerActor] = {}
        self.get: Callable[[str], ServerActor | None] = self._by_name.get

    def names(self) -> list[str]:
        """Return the names of all servers, in the order in which they were registered."""
        return list(self._by_name)

    @on_loop
    def register(self, server: ServerActor, reread: tuple[c.Reread, ...] = ()) -> None:
        """Add a server, and go on with its resources; raise NameTaken if there is a server of that name."""
        registrar, name = self._registrar, server.spec.name
        old = self._by_name.get(name)
        if old is not None and not old.restored:
            text = f"server {server.origin}: registered already; unregister it first, or take another name"
            raise NameTaken(text, name=name)
        registrar.node.directory.put_labels(registrar.name, name, server.spec.labels)
        self._by_name[name] = server
        left = [] if old is None else old.end()
        server.begin()
        for message in left:
            server.deliver(message)
        self._consumers.tell_all(Described(name, server.facts.types))
        if old is None:
            registrar.post(c.Register(server.facts, new_id(), reread, server.digest))
        else:
            registrar.catalog.servers[name] = server.facts
        if registrar.serving:
            server.health.open()

    @on_loop
    def open_probes(self) -> None:
        """Begin to probe, as on_start has returned."""
        for server in self._by_name.values():
            server.health.open()

    @on_loop
    def close(self) -> None:
        """End all servers."""
        for server in self._by_name.values():
            server.end()

    @on_loop
    def register_again(self) -> None:
        """Register all servers again, in a catalog that was read anew."""
        for server in self._by_name.values():
            self._registrar.post(c.Register(server.facts, new_id()))

    @on_loop
    def unregister(self, name: str, done: Callable[[RrError | None], None]) -> None:
        """Remove a server when all its resources are released; `done` hears how that ended."""
        registrar = self._registrar

        def ended(error: RrError | None) -> None:
            if name not in registrar.catalog.servers and (server := self._by_name.pop(name, None)) is not None:
                server.end()
                registrar.node.directory.put_labels(registrar.name, name, "")
            done(error)

        registrar.post(c.Unregister(name, new_id(), ended))

    # -- requests that consumers have sent ----------------------------------------------------------------------------


logger = Log("rr_actors.server")


def reread_values(server: ServerActor, resources: Iterable[Resource], digest: bytes) -> tuple[c.Reread, ...]:
    """Read stored requests and responses by today's types; return what differs. Not on the loop: users' code runs.

    What does not fit goes through the upgrade callback, if there is one. With an unchanged digest of the types only
    users' code, such as a __post_init__, may read a value in another way than before.
    """
    if digest and digest == server.digest:
        resources = (it for it in resources if _runs_code(server, it))
    return tuple(found for resource in resources if (found := _reread(server, resource)) is not None)


def _runs_code(server: ServerActor, resource: Resource) -> bool:
    response = resource.response
    return server.request.runs_code(resource.request) or (response is not None and server.response.runs_code(response))


def _reread(server: ServerActor, resource: Resource) -> c.Reread | None:
    place, response = resource.id, resource.response
    try:
        request = server.request.today(resource.request)
        if response is not None:
            server.response.decode(response, "", "response")
    except RrError as error:
        misfit = f"{error.message}, stored by an earlier version"
    else:
        return None if request == resource.request else c.Reread(place, request, response)
    if server.spec.upgrade is not None:
        try:
            return _upgraded(server, resource, server.spec.upgrade)
        except Exception as error:
            text = readable(text_of(error))
            logger.exception("%s: the upgrade callback raised for resource %s", server.origin, place)
            misfit += f", and the upgrade callback raised {text}"
    logger.error("%s: resource %s is lost: %s", server.origin, place, misfit)
    return c.Reread(place, resource.request, response, misfit)


def _upgraded(server: ServerActor, resource: Resource, upgrade: Callback) -> c.Reread:
    old = None if resource.response is None else shown_plain(resource.response)
    request, response = upgrade(shown_plain(resource.request), old)
    new = server.request.canonical(encode(request), server.origin)
    answer = None if resource.response is None else server.response.encode(response, server.origin)
    if (error := server.too_long(msgspec.structs.replace(resource, request=new), answer)) is not None:
        raise error
    return c.Reread(resource.id, new, answer)
