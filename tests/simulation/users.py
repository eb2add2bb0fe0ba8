"""People in a simulated world: consumers who ask, wait, tire and let go, and the owners of what is served."""

from __future__ import annotations

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import NO_LIMIT, Load, Loaded, LoadRefused, Unload, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import Hold, Phase, State
from simulation.network import DOWN
from simulation.network_faults import Trouble
from simulation.sim_links import TO_PROVIDER, SimLine
from simulation.sim_process import Run, SimShell
from simulation.sim_registrar import Killed, SimRegistrar

TIRED = Failure("LoadTimeout", "tired of waiting")
LATE = Failure("Unavailable", "tired of waiting")
OWED = (LATE.kind, DOWN.kind)  # kinds of failures after which a release is owed still

_ENDED = ("failed", "released")  # its row may still be there, when the registrar has not taken up that it is over


class People(Trouble):
    """Steps: load, join, line, tire, rank, unload, owe, late; own, reregister."""

    def load(
        self,
        query_id: str,
        name: str,
        provider: str,
        server: str,
        request: bytes,
        direct: bool = False,
        priority: int = 0,
        wait_ms: int = NO_LIMIT,
    ) -> bool:
        """Somebody asks for something."""
        registrar = self.registrars[name]
        if registrar.state not in ("up", "starting") or query_id in self.ledger.fate:
            return False
        self.asker[query_id] = name
        if wait_ms != NO_LIMIT:
            registrar.catalog.wait_limits[query_id] = wait_ms
        ask = c.AskProvider(query_id, provider, server, request, "", registrar.next_seq(), priority, own=True)
        if not (direct and self.ask_directly(registrar, ask, None)):
            registrar.ask(ask, None)
        return True

    def ask_directly(self, registrar: SimShell, ask: c.AskProvider, run: Run | None) -> bool:
        """As Loads does, for somebody outside or for a callback; False: the loop is to ask."""
        if registrar.catalog.shut or not registrar.reaches(self.registrars[ask.registrar]):
            return False
        load = registrar.begin_directly(ask, run)
        if load is None:
            return False
        line = self.lines[ask.query_id] = SimLine(ask.query_id, registrar.name, ask.registrar, registrar.epoch)
        line.run = self.run_of(registrar.name, ask.registrar)
        line.ways[TO_PROVIDER].append(load)
        self.todo.add(("line", ask.query_id, TO_PROVIDER))
        return True

    def join(self, query_id: str, name: str, server: str, request: bytes, fault: str = "") -> bool:
        """A thread asks its own process for something that is held. `fault`: when it writes that it holds it, too."""
        registrar = self.registrars[name]
        if registrar.state != "up" or query_id in self.ledger.fate:
            return False
        if registrar.catalog.shut or not registrar.reaches(registrar):
            return False
        ask = c.AskProvider(query_id, name, server, request, "", registrar.next_seq())
        try:
            joined = registrar.join(Load(query_id, server, request, name, "", 0, ask.seq), fault)
        except Killed:
            self.asker[query_id] = self.ledger.provider[query_id] = name
            self.ledger.fate[query_id] = "asked"
            self.crash(name)
            return True
        if joined is None:
            return False
        self.asker[query_id] = name
        registrar.begin_directly(ask, None)
        if not registrar.hold(c.Got(query_id, joined.resource_id, joined.response, joined.state)):
            raise AssertionError(query_id)
        registrar.load_ended(query_id, None)
        return True

    def line(
        self, query_id: str, way: int, fault: str = "", at_once: str | None = None, overtaking: str | None = None
    ) -> bool:
        """Something arrives on a direct line: a message, or that it is broken.

        Args:
            fault: of the consumer's disk, in that case; or that the provider reads the end of a line that was left only
                when it has dealt with what came before it.
            at_once: of the provider's disk, if it lets a Load join before it takes up what waits; None: it does not.
            overtaking: the same, if it decides before it takes up what is noted, and not about the same.
        """
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
                provider = self.registrars[line.provider]
                try:
                    provider.from_line(line, message, at_once, overtaking)
                except Killed:
                    self.crash(line.provider)
                    return True
                if line.left and fault:
                    provider.ending.append(line)
                elif line.left:
                    provider.routes.line_lost(line)
        elif not line.left:
            consumer = self.registrars[line.consumer]
            if line.unloads:
                line.left = message is not None
                self._unloaded_directly(consumer, query_id, message, fault)
            elif message is None:
                self._follow(consumer, query_id, c.SendAgain(query_id), fault)
            elif isinstance(message, Loaded):
                got = c.Got(query_id, message.resource_id, message.response, message.state, line.run)
                if consumer.hold(got):
                    line.left = True
                    consumer.load_ended(query_id, None)
                else:
                    self._follow(consumer, query_id, got, fault)
            else:
                assert isinstance(message, LoadRefused)
                if consumer.catalog.in_flight.pop(query_id, None) is not None:
                    line.left = True
                    consumer.load_ended(query_id, message.failure)
                else:
                    self._follow(consumer, query_id, c.GiveUp(query_id, message.failure, unheard=True), fault)
        return True

    def _follow(self, consumer: SimShell, query_id: str, command: c.Command, fault: str) -> None:
        """As RegistrarActor.go_on_loading."""
        self.leave_line(query_id)
        if isinstance(command, c.GiveUp):
            consumer.given_up.add(query_id)
        consumer.post(command)
        self.catch_up(consumer.name, fault)
        held = consumer.catalog.held.get(query_id)
        if query_id in consumer.waiters and not consumer.inbox and (held is None or held.hold is Hold.OWED):
            consumer.load_ended(query_id, DOWN)

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

    def rank(self, name: str, query_id: str, priority: int) -> bool:
        """Somebody gives a query another priority."""
        registrar = self.registrars[name]
        held = registrar.catalog.held.get(query_id)
        if registrar.state not in ("up", "starting") or held is None or held.hold is not Hold.HELD:
            return False
        ticket = self.new_ticket()
        self.ledger.wished(query_id, ticket, priority)
        registrar.post(c.SetPriority(query_id, priority, ticket))
        return True

    def unload(self, name: str, query_id: str) -> bool:
        """Somebody lets a query go."""
        registrar = self.registrars[name]
        held = registrar.catalog.held.get(query_id)
        if registrar.state not in ("up", "starting") or held is None or held.hold is not Hold.HELD or held.parent:
            return False
        if query_id in self.letting or query_id in registrar.waiters:  # who asked for it has not been told yet
            return False
        if self.ledger.fate.get(query_id) in _ENDED:
            return False
        self._let_go(name, query_id)
        registrar.post(c.Release(query_id))
        return True

    def owe(self, name: str, query_id: str, fault: str = "") -> bool:
        """A thread lets a query go that is held, by a line of its own. `fault`: when it writes that it is owed."""
        registrar = self.registrars[name]
        held = registrar.catalog.held.get(query_id)
        if registrar.state not in ("up", "starting") or held is None or query_id in self.letting:
            return False
        line = self.lines.get(query_id)
        if query_id in registrar.waiters or self.ledger.fate.get(query_id) in _ENDED:
            return False
        if line is not None and (not line.left or line.ways[TO_PROVIDER]):  # that of its load
            return False
        if not registrar.reaches(self.registrars[held.registrar]):
            return False
        try:
            if not registrar.owe(query_id, fault):
                return False
        except Killed:
            self.ledger.letting(query_id)
            self.crash(name)
            return True
        self._let_go(name, query_id)
        line = self.lines[query_id] = SimLine(query_id, name, held.registrar, registrar.epoch, unloads=True)
        line.ways[TO_PROVIDER].append(Unload(query_id, registrar.name))
        self.todo.add(("line", query_id, TO_PROVIDER))
        return True

    def _let_go(self, name: str, query_id: str) -> None:
        self.letting[query_id] = name
        self.ledger.letting(query_id)
        self.todo.add(("late", name, query_id))

    def _unloaded_directly(self, consumer: SimRegistrar, query_id: str, message: object, fault: str) -> None:
        """As Unloads does: the answer, or that the line is broken."""
        if not isinstance(message, Unloaded):
            refusal = message.failure if isinstance(message, UnloadRefused) else None
            self._go_on_releasing(consumer, query_id, fault, refusal)
        else:
            consumer.let_go(message, self.lines[query_id].provider)
            self.unload_ended(consumer, query_id, None)

    def _go_on_releasing(self, consumer: SimShell, query_id: str, fault: str, refusal: Failure | None = None) -> None:
        """As RegistrarActor.go_on_unloading."""
        self.leave_line(query_id)
        if consumer.inbox:
            self.catch_up(consumer.name, fault)
        if query_id not in self.letting:
            return
        held = consumer.catalog.held.get(query_id)
        if held is not None and held.hold is Hold.OWED:
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
        if registrar.closing is not None:
            registrar.closing.open.discard(query_id)
        if self.letting.pop(query_id, None) is None:
            return
        self.todo.discard(("late", registrar.name, query_id))
        if failure is None:
            provider = self.registrars[self.ledger.provider[query_id]]
            self.ledger.released(query_id, query_id in provider.disk["queries"] and provider.state != "gone")
        elif failure.kind not in OWED and not (registrar.closing and failure.kind == "UnknownQuery"):
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
            self.ledger.forced.update(registrar.catalog.by_server.get(target, ()))
            registrar.post(c.Unregister(target, self.new_event(), self.new_ticket()))
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
            case "swap":
                return self._swap(registrar, target)
            case "reload":
                registrar.post(c.Reload(target, self.new_ticket()))
            case "revoke":
                registrar.post(c.Revoke(target, self.new_event(), "revoked", 1000, self.new_ticket()))
            case _:
                self.ledger.forced.add(target)
                registrar.post(c.ForceUnload(target, self.new_event(), self.new_ticket(), clears=True))
        return True

    def _swap(self, registrar: SimRegistrar, resource_id: str) -> bool:
        """A status callback puts the newest part that its resource holds in the place of the oldest."""
        held = registrar.catalog.held
        parts = [id for id in registrar.catalog.parts_of(resource_id) if held[id].hold is Hold.HELD]
        if len(parts) < 2 or registrar.catalog.resources[resource_id].phase is not Phase.LOADED:
            return False  # no status callback runs
        spare, part = parts[0], parts[-1]
        event, ticket = self.new_event(), self.new_ticket()
        self.ledger.swapped.update((part, spare))
        self.ledger.swaps[ticket] = part
        response = f"swap:{event}".encode() if len(parts) % 2 else None
        registrar.post(c.Swap(resource_id, part, spare, (), event, response, "", ticket))
        return True

    def reregister(self, name: str, server: str) -> bool:
        """A server that has left comes back."""
        key = ("reregister", name, server)
        registrar = self.registrars[name]
        if key not in self.todo or server in registrar.catalog.servers or registrar.inbox:
            return False
        self.todo.discard(key)
        registrar.registered.add(server)
        registrar.post(c.Register(registrar.offers[server], self.new_event()))
        return True

    def catch_up(self, name: str, fault: str) -> None:
        """A registrar handles what came in before it goes on."""
        raise AssertionError(name)
