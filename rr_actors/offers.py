"""Offers: how a registrar takes up servers and gives them up, and what it says of the resources that they serve."""

from __future__ import annotations

import functools
from typing import Any

from rr_actors import pickling
from rr_actors.actors.callbacks import check_not_own, serving, status_callback_of
from rr_actors.actors.calls import Calls
from rr_actors.actors.registrar import RegistrarActor
from rr_actors.actors.server import ServerActor, ServerSpec, log_unread_types
from rr_actors.arguments import resource_target, target_id
from rr_actors.core import commands as c
from rr_actors.core.canonical import encode
from rr_actors.errors import UsageError, is_a, shown
from rr_actors.names import new_id
from rr_actors.queries import Query, ResourceInfo
from rr_actors.records import Put, Resource, State, StoredServer
from rr_actors.statuses import Status, message_text


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
        with self._actor.enter():
            resource = self._actor.whole().find(target)
        return resource, None if resource is None else self._actor.servers.get(resource.server)
