"""People in a simulated world: consumers who ask, wait, tire and let go, and the owners of what is served."""

from __future__ import annotations

import msgspec

from rr_actors.core import commands as c
from rr_actors.messages import Failure, Load, Loaded, LoadRefused, Unload, UnloadRefused
from rr_actors.records import Hold, State
from rr_actors.testing.links import TO_CONSUMER, TO_PROVIDER, SimLine
from rr_actors.testing.network import DOWN
from rr_actors.testing.shell import SimShell
from rr_actors.testing.trouble import Trouble

TIRED = Failure("LoadTimeout", "tired of waiting")
LATE = Failure("Unavailable", "tired of waiting")


class People(Trouble):
    """Steps: load, line, tire, unload, brief, late; own, reregister."""

    def load(self, query_id: str, name: str, provider: str, server: str, request: bytes, direct: bool = False) -> bool:
        """Somebody asks for something."""
        registrar = self.registrars[name]
        if registrar.state not in ("up", "starting") or query_id in self.ledger.fate:
            return False
        self.asker[query_id] = name
        ask = c.Ask(query_id, provider, server, request, "")
        there = self.registrars[provider]
        if direct and there.state == "up" and registrar.catalog.up.get(provider) == there.epoch:
            ask = msgspec.structs.replace(ask, direct=True, seq=registrar.catalog.seq + 1 + len(registrar.inbox))
            line = self.lines[query_id] = SimLine(ask, name, registrar.epoch)
            line.ways[TO_PROVIDER].append(Load(query_id, server, request, name, "", 0, ask.seq))
            self.todo.add(("line", query_id, TO_PROVIDER))
        registrar.ask(ask, None)
        return True

    def line(self, query_id: str, way: int, fault: str = "") -> bool:
        """Something arrives on a direct line: a message, or that it is broken. `fault`: of the disk, in that case."""
        key = ("line", query_id, way)
        if key not in self.todo:
            return False
        line = self.lines[query_id]
        if self.held_up and self.parted(line.consumer, line.provider):
            return False
        queue = line.ways[way]
        message = queue.popleft() if queue else None
        if not queue:
            self.todo.discard(key)
        if way == TO_PROVIDER:
            if message is not None:
                self.registrars[line.provider].from_line(line, message)
        elif not line.left:
            consumer = self.registrars[line.consumer]
            line.left = message is not None
            if line.unloads:
                self._unloaded_directly(consumer, query_id, message, fault)
            elif message is None:
                self._follow(consumer, query_id, c.SendAgain(query_id), fault)
            elif isinstance(message, Loaded):
                consumer.under_way.got(c.Got(line.ask, message.resource_id, message.response))
                consumer.load_ended(query_id, None)
            else:
                assert isinstance(message, LoadRefused)
                consumer.under_way.refused(line.ask, message.failure)
                consumer.load_ended(query_id, message.failure)
        return True

    def _follow(self, consumer: SimShell, query_id: str, command: c.Command, fault: str) -> None:
        """As LeftLines.load."""
        consumer.under_way.leave(self.lines[query_id].ask)
        if consumer.inbox:
            self.catch_up(consumer.name, fault)
        self.lines[query_id].left = True
        self.todo.discard(("line", query_id, TO_CONSUMER))
        held = consumer.catalog.held.get(query_id)
        hold = held.hold if held is not None else None
        answered = hold is Hold.HELD and not isinstance(command, c.GiveUp)
        noted = any(isinstance(item, c.Ask) and item.query_id == query_id for item, _ in consumer.inbox)
        if isinstance(command, c.GiveUp):
            consumer.given_up.add(query_id)
        consumer.post(command)
        if not answered and (noted or hold in (Hold.PENDING, Hold.HELD)):
            self.catch_up(consumer.name, fault)
        else:
            consumer.load_ended(query_id, None if answered else DOWN)

    def tire(self, name: str, query_id: str, fault: str = "") -> bool:
        """Somebody does not wait for a load any longer. `fault`: of the disk, if it is one by a direct line."""
        key = ("tire", name, query_id)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        line = self.lines.get(query_id)
        if line is None or line.left:
            registrar.post(c.GiveUp(query_id, TIRED))
            return True
        self._follow(registrar, query_id, c.GiveUp(query_id, TIRED, unheard=True), fault)
        return True

    def unload(self, name: str, query_id: str) -> bool:
        """Somebody lets a query go."""
        registrar = self.registrars[name]
        held = registrar.catalog.held.get(query_id)
        if registrar.state not in ("up", "starting") or held is None or held.hold is not Hold.HELD or held.parent:
            return False
        if query_id in self.letting or query_id in registrar.waiters:  # who asked for it has not been told yet
            return False
        if self.ledger.fate.get(query_id) == "failed":
            return False
        self._let_go(name, query_id)
        registrar.post(c.Release(query_id))
        return True

    def brief(self, name: str, query_id: str) -> bool:
        """A thread lets a query go that it has just loaded directly, by a line of its own."""
        registrar = self.registrars[name]
        provider = registrar.under_way.provider_of(query_id)
        if provider is None or query_id not in self.lines or query_id in self.letting:
            return False
        there = self.registrars[provider]
        if there.state != "up" or registrar.catalog.up.get(provider) != there.epoch:
            return False
        ask = self.lines[query_id].ask
        line = self.lines[query_id] = SimLine(ask, name, registrar.epoch, unloads=True)
        self._let_go(name, query_id)
        registrar.under_way.let_go(query_id)
        line.ways[TO_PROVIDER].append(Unload(query_id, name))
        self.todo.add(("line", query_id, TO_PROVIDER))
        return True

    def _let_go(self, name: str, query_id: str) -> None:
        self.letting[query_id] = name
        self.ledger.letting(query_id)
        self.todo.add(("late", name, query_id))

    def _unloaded_directly(self, consumer: SimShell, query_id: str, message: object, fault: str) -> None:
        """As Unloads does: the answer, or that the line is broken."""
        if message is None or isinstance(message, UnloadRefused):
            self._go_on_releasing(consumer, query_id, fault, None if message is None else message.failure)
        else:
            if not consumer.under_way.gone(query_id):
                consumer.receive(message, self.lines[query_id].provider)
            self.unload_ended(consumer, query_id, None)

    def _go_on_releasing(self, consumer: SimShell, query_id: str, fault: str, refusal: Failure | None = None) -> None:
        """As LeftLines.unload."""
        consumer.under_way.own_up(query_id)
        self.lines[query_id].left = True
        self.todo.discard(("line", query_id, TO_CONSUMER))
        if consumer.inbox:
            self.catch_up(consumer.name, fault)
        if query_id not in self.letting:
            return
        held = consumer.catalog.held.get(query_id)
        noted = any(isinstance(item, c.LettingGo) and item.got.ask.query_id == query_id for item, _ in consumer.inbox)
        if noted or (held is not None and held.hold is Hold.OWED):
            if refusal is None:
                consumer.post(c.SendAgain(query_id))
        elif held is not None and refusal is None:
            consumer.post(c.Release(query_id))
        else:
            self.unload_ended(consumer, query_id, None if held is None else refusal)

    def late(self, name: str, query_id: str, fault: str = "") -> bool:
        """Somebody does not wait for an unload any longer. `fault`: of the disk, if it is one by a direct line."""
        key = ("late", name, query_id)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        if self.has_line(query_id):
            self._go_on_releasing(self.registrars[name], query_id, fault)
        self.registrars[name].post(c.ReleaseOverdue(query_id, LATE))
        return True

    def unload_ended(self, registrar: SimShell, query_id: str, failure: Failure | None) -> None:
        """Whoever unloaded is told."""
        if self.letting.pop(query_id, None) is None:
            return
        self.todo.discard(("late", registrar.name, query_id))
        if failure is None:
            provider = self.registrars[self.ledger.provider[query_id]]
            self.ledger.released(query_id, query_id in provider.disk.tables["queries"] and provider.state != "gone")
        elif failure is not LATE:
            self.ledger.kept(query_id)

    # -- owners --------------------------------------------------------------------------------------------------

    def own(self, name: str, what: str, target: str, state: str = "") -> bool:
        """An owner does something to a resource, or takes a server away."""
        registrar = self.registrars[name]
        if registrar.state != "up":
            return False
        if what == "unregister":
            if target not in registrar.registered:
                return False
            registrar.post(c.Unregister(target, self.new_ticket()))
            self.todo.add(("reregister", name, target))
            return True
        if target not in registrar.catalog.resources:
            return False
        match what:
            case "status":
                registrar.post(c.SetStatus(target, self.new_event(), State(state), "", self.new_ticket()))
            case "response":
                event = self.new_event()
                registrar.post(c.SetResponse(target, event, f"late:{event}".encode(), "", self.new_ticket()))
            case _:
                registrar.post(c.ForceUnload(target, self.new_event(), self.new_ticket()))
        return True

    def reregister(self, name: str, server: str) -> bool:
        """A server that has left comes back."""
        key = ("reregister", name, server)
        registrar = self.registrars[name]
        if key not in self.todo or server in registrar.catalog.servers or registrar.inbox:
            return False
        self.todo.discard(key)
        registrar.registered.add(server)
        registrar.post(c.Register(registrar.offers[server]))
        return True

    def catch_up(self, name: str, fault: str) -> None:
        """A registrar handles what came in before it goes on."""
        raise AssertionError(name)
