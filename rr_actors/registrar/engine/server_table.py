"""Servers: the servers registered at one registrar, and how they are added and removed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from rr_actors.base.errors import CatalogError, NameTaken, RrError
from rr_actors.base.names import ServerId, new_id
from rr_actors.registrar.engine.server import ServerActor
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Described
from rr_actors.registrar.model.rows import Put, ServerType

_RETRY_S = 0.25

logger = logging.getLogger("rr_actors.registrar")


class Servers:
    """The servers of one registrar, by name. On the loop.

    Attributes:
        get: the server of a name, or None if there is none.
    """

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._by_name: dict[str, ServerActor] = {}
        self.get: Callable[[str], ServerActor | None] = self._by_name.get

    def names(self) -> list[str]:
        """Return the names of all servers, in the order in which they were registered."""
        return list(self._by_name)

    def register(self, server: ServerActor) -> None:
        """Add a server, and go on with its resources.

        Raises:
            NameTaken: there is a server of that name.
        """
        registrar, name = self._registrar, server.spec.name
        old = self._by_name.get(name)
        if old is not None and old.restored:
            self._by_name[name] = server
            registrar.catalog.servers[name] = server.facts
            registrar.consumers.tell_all(Described(name, server.types))
            return
        if old is not None:
            text = f"server {server.origin}: registered already; unregister it first, or take another name"
            raise NameTaken(text, name=name)
        self._by_name[name] = server
        registrar.consumers.tell_all(Described(name, server.types))
        registrar.post(c.Register(server.facts, new_id()))

    def register_again(self) -> None:
        """Register all servers again, in a catalog that was read anew."""
        for server in self._by_name.values():
            self._registrar.post(c.Register(server.facts, new_id()))

    def unregister(self, name: str, done: Callable[[RrError | None], None]) -> None:
        """Remove a server when all its resources are released; `done` hears how that ended."""
        registrar = self._registrar

        def ended(error: RrError | None) -> None:
            if name not in registrar.catalog.servers:
                self._by_name.pop(name, None)
            done(error)

        registrar.post(c.Unregister(name, new_id(), ended))


# ServerTypes: the types of providers' servers, and the callers that wait for them.


class ServerTypes:
    """The types of the servers of one registrar's providers; its catalog keeps them. On the loop."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._wanting: dict[str, list[Callable[[], None]]] = {}

    def tell(self, server: ServerId, told: Callable[[], None]) -> None:
        """Call `told` when the types of a provider's server are known."""
        if str(server) in self._registrar.catalog.server_types:
            told()
            return
        self._wanting.setdefault(str(server), []).append(told)
        self._registrar.client(server.registrar).describe(server.server, at_once=True)

    def described(self, server: str, blob: bytes) -> None:
        """Keep the types that a provider has sent, and call the callers that wait for them."""
        registrar = self._registrar
        known = registrar.catalog.server_types.get(server)
        if known is None or known.blob != blob:
            row = ServerType(server, blob)  # written now: after a respawn, on_start reads queries before a link is up
            try:
                registrar.commit_rows([Put(row)])
            except CatalogError as error:  # a full disk, for instance: the callers wait, within their time limits
                logger.warning("%s: the types of %s are written later: %s", registrar.name, server, error)
                registrar.node.dispatcher.loop.call_later(_RETRY_S, self._described_again, server, blob)
                return
        for told in self._wanting.pop(server, ()):
            told()

    def _described_again(self, server: str, blob: bytes) -> None:
        if not self._registrar.closed:
            self.described(server, blob)
