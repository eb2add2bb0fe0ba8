"""Servers: the servers of one registrar, by name."""

from __future__ import annotations

from collections.abc import Callable

from rr_actors.base.errors import NameTaken, RrError
from rr_actors.base.names import new_id
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Described
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
        if old is not None:
            old.health.probes.close()
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
        """Probe nothing more."""
        for server in self._by_name.values():
            server.health.probes.close()

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
                server.health.probes.close()
                registrar.node.directory.put_labels(registrar.name, name, "")
            done(error)

        registrar.post(c.Unregister(name, new_id(), ended))

    # -- requests that consumers have sent ----------------------------------------------------------------------------
