"""GatedServer: a server whose callbacks need room: `at_once`, or a serial manager. They wait for it in its mailbox."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from rr_actors.actors.turns import DatedDelivery, Delivery
from rr_actors.base.errors import Unavailable
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import ServerSpec
from rr_actors.registrar.model.roles import BEGUN, UNLOAD
from rr_actors.registrar.servers.server_actor import Message, ServerActor
from rr_actors.registrar.servers.server_base import OnDemandRun
from rr_actors.runtime.thread_rules import any_thread, on_loop
from rr_actors.runtime.workers import Gate


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
        return not (role.in_order or role.on_demand) and (role is not UNLOAD or self.spec.unload is not None)

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
