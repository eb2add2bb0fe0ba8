"""The servers of one registrar, by name; and their stored values, read again when they are registered.

GatedServer: a server whose callbacks need room: `at_once`, or a serial manager. They wait for it in its mailbox.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence

import msgspec

from rr_actors.actors.turns import DatedDelivery, Delivery
from rr_actors.base.errors import NameTaken, RrError, Unavailable, readable, text_of
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode, shown_plain
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import Callback, ServerSpec
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Described
from rr_actors.registrar.model.roles import BEGUN, RELOAD, UNLOAD
from rr_actors.registrar.model.rows import Resource
from rr_actors.registrar.servers.server_actor import Message, ServerActor
from rr_actors.registrar.servers.server_base import OnDemandRun
from rr_actors.runtime.thread_rules import any_thread, on_loop
from rr_actors.runtime.workers import Gate


class RegisteredServers:
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
        registrar.titles.pop(name, None)
        if server.title is not None:
            registrar.titles[name] = server.title
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
                registrar.titles.pop(name, None)
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


# -- servers whose callbacks need room ---------------------------------------------------------------------------------


class GatedServer(ServerActor):
    """A server that takes a message from its mailbox when there is room for the callback.

    Each message that waits has a place of its own in the gate, so all servers of a serial manager are served in the
    order in which their messages came.

    Args:
        gate: lets so many callbacks in at a time.
    """

    def __init__(self, gate: Gate, registrar: RegistrarBase, spec: ServerSpec, types: bytes) -> None:
        super().__init__(registrar, spec, types)
        self.gate, self._ask_for_room, self._give_back = gate, gate.enter, gate.leave
        self.takes = 0  # until there is room

    @on_loop
    def deliver(self, message: Message, sender: str | None = None, *, more: bool = False) -> None:
        """Put a message into the mailbox, and ask for room for its callback.

        What needs no room passes by those that wait. The statuses of a resource wait in a queue of their own.
        """
        if not self._needs_room(message):
            self.take(message)
        elif BEGUN[message.role].alone:
            self.health.probes.when_free(message.resource.id, functools.partial(self._wait, message))
        else:
            self._wait(message)

    def _needs_room(self, message: Message) -> bool:
        if isinstance(message, OnDemandRun):
            return True
        role = BEGUN[message.role]
        return not (role.in_order or role.on_demand) and (role not in (UNLOAD, RELOAD) or self.spec.unload is not None)

    def _wait(self, message: Message) -> None:
        self.registrar.outside.add(_key_of(message))
        self.waiting.append(DatedDelivery(message, self.registrar.name))
        self._ask_for_room(self._has_room)

    @any_thread
    def _has_room(self) -> bool:
        """Have the loop take the oldest message that waits; return False if the loop has ended."""
        dispatcher = self.registrar.node.dispatcher
        try:
            if dispatcher.is_loop_thread():
                self._let_in()
            else:
                dispatcher.call(self._let_in)
        except Unavailable:
            return False
        return True

    @on_loop
    def _let_in(self) -> None:
        if self.closed:  # another server has its messages, and has asked for room for them
            self._give_back()
            return
        self.takes += 1
        try:
            self.take_turns()
        except Exception as error:
            self.registrar.fail(error)

    @on_loop
    def handle(self, deliveries: Sequence[Delivery]) -> None:
        """Run the callbacks that have room. Their time limits begin now."""
        self.takes -= len(deliveries)
        for message, _ in deliveries:
            key = _key_of(message)
            self.registrar.outside.discard(key)
            self.registrar.runner.let_in(key)
        super().handle(deliveries)


def _key_of(message: Message) -> str:
    """Return the key of the timer that limits a callback."""
    return f"{message.role}:{message.resource.id}"


def server_of(path: str, registrar: RegistrarBase, spec: ServerSpec, types: bytes) -> ServerActor:
    """Make a server, which will live at a path of the tree.

    Raises:
        InvalidSpec, NotSerializable: as ServerActor.
    """
    gate = registrar.gate or (None if spec.at_once is None else Gate(spec.at_once))
    if gate is None:
        return ServerActor.made(path, registrar, spec, types)
    return GatedServer.made(path, gate, registrar, spec, types)
