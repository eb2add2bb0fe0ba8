"""ServerTypes: what providers have told of their servers' types, and who waits to know them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rr_actors.names import ServerId
from rr_actors.records import Put, ServerType


class ServerTypes:
    """Those of one registrar's providers; its catalog keeps them. On the loop."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._wanting: dict[str, list[Callable[[], None]]] = {}

    def tell(self, server: ServerId, told: Callable[[], None]) -> None:
        """Have `told` called when the types of a provider's server are known."""
        if str(server) in self._registrar.catalog.server_types:
            told()
            return
        self._wanting.setdefault(str(server), []).append(told)
        self._registrar.client(server.registrar).describe(server.server, at_once=True)

    def described(self, server: str, blob: bytes) -> None:
        """A provider has told them."""
        known = self._registrar.catalog.server_types.get(server)
        if known is None or known.blob != blob:
            row = ServerType(server, blob)  # at once: a respawned on_start reads its queries before any link is up
            self._registrar.commit_rows([Put(row)])
        for told in self._wanting.pop(server, ()):
            told()
