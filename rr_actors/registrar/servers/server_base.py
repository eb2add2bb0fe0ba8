"""ServerBase: what the parts of a server see of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import ServerSpec
from rr_actors.registrar.model.roles import Role
from rr_actors.registrar.model.rows import Resource
from rr_actors.runtime.user_loop import Done


class ServerBase(Protocol):
    """A server, as its parts see it.

    Attributes:
        origin: its id, "registrar/server".
    """

    registrar: RegistrarBase
    spec: ServerSpec
    origin: str

    def add(self, role: Role, arguments: Callable[[Resource], tuple[Any, ...]], result: Callable[[Any], Any]) -> None:
        """Run callbacks of a role from now on."""
        ...

    def submit(self, role: Role, resource: Resource, number: int, done: Done) -> None:
        """Run the callback of a role for a resource; `done` is called on the loop."""
        ...

    def request_and_response_of(self, resource: Resource) -> tuple[Any, Any]:
        """Return the request and the response, as the arguments of a callback. In a worker."""
        ...


def nothing(*_: Any) -> None:
    """Do nothing: the server has no such callback."""
