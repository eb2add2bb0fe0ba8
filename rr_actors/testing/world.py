"""World: some registrars, their links and disks, the callbacks they run and the people who use them; one step at a time.

A step is a tuple that says all that happens: which key of the Todo is done and with what outcome, or what somebody does,
or what breaks. `apply` performs it, or refuses it if it cannot happen now; nothing in here is random. Histories are
lists of steps: the same history, the same world.
"""

from __future__ import annotations

from typing import Any

from rr_actors.core import commands as c
from rr_actors.core.catalog import Server
from rr_actors.messages import Failure, Gone, Load, Loaded, LoadRefused, Unload
from rr_actors.records import Held, Hold, Notice, Phase, State
from rr_actors.testing.ledger import Ledger
from rr_actors.testing.links import TO_CONSUMER, TO_PROVIDER, SimLine, SimLink
from rr_actors.testing.registrars import DOWN, Killed, Run, SimRegistrar
from rr_actors.testing.todo import Todo

Step = tuple[Any, ...]

TIRED = Failure("LoadTimeout", "tired of waiting")
LATE = Failure("Unavailable", "tired of waiting")
RAISED = Failure("LoadFailed", "the callback raised")
STUCK = Failure("UnloadFailed", "the callback raised")
OLD = 2  # the way of messages that a consumer sent over the link before the present one


class World:
    """Everything of one simulated run.

    Args:
        layout: the servers of each registrar, by its name.
        factory: makes a registrar; tests put broken ones in.
    """

    def __init__(self, layout: dict[str, tuple[Server, ...]], factory: Any = SimRegistrar) -> None:
        self.layout = layout
        self.todo = Todo()
        self.ledger = Ledger()
        self.lines: dict[str, SimLine] = {}
        self.old: dict[tuple[str, str], SimLink] = {}
        self.events = 0
        self.tickets = 0
        self.trace: list[str] | None = None
        self.retired: set[str] = set()
        self.letting: dict[str, str] = {}  # query -> who waits for its unload
        self.asker: dict[str, str] = {}
        self.registrars: dict[str, SimRegistrar] = {
            name: factory(self, name, servers) for name, servers in layout.items()
        }
        for registrar in self.registrars.values():
            registrar.start()

    def note(self, text: str) -> None:
        """A line for the timeline."""
        if self.trace is not None:
            self.trace.append("        " + text)

    def new_event(self) -> str:
        """A fresh id of a status."""
        self.events += 1
        return f"e{self.events}"

    def new_ticket(self) -> int:
        """What an owner wants back in the Answer."""
        self.tickets += 1
        self.ledger.ticket(self.tickets, given=True)
        return self.tickets

    # -- steps ---------------------------------------------------------------------------------------------------

    def apply(self, step: Step) -> bool:
        """Perform a step; False: it cannot happen in this world now."""
        perform = _PERFORM[step[0]]
        if self.trace is not None:
            self.trace.append(describe(step))
        done = perform(self, *step[1:])
        if self.trace is not None and not done:
            self.trace.pop()
        return done

    def wake(self, name: str, count: int = 1_000_000, fault: str = "", effects: int = 0) -> bool:
        """A registrar handles what came in."""
        if ("wake", name) not in self.todo:
            return False
        registrar = self.registrars[name]
        if self.trace is not None:
            for item, sender in list(registrar.inbox)[:count]:
                self.note(f"{name} <- {sender or 'itself'}: {item!r}"[:220])
        try:
            registrar.wake(count, fault, effects)
        except Killed:
            self.crash(name)
        return True

    def net(self, consumer: str, provider: str, way: int) -> bool:
        """The next message on a link arrives; behind the last on a cut one, that it is cut."""
        key = ("net", consumer, provider, way)
        if key not in self.todo:
            return False
        if way == OLD:
            link = self.old[consumer, provider]
            queue = link.ways[TO_PROVIDER]
        elif way == TO_PROVIDER:
            link = self.registrars[provider].links[consumer]
            queue = link.ways[way]
        else:
            link = self.registrars[consumer].clients[provider].link
            queue = link.ways[way]
        if queue:
            message = queue.popleft()
            if not queue and not link.cut:
                self.todo.discard(key)
            if way == TO_CONSUMER:
                self.registrars[consumer].from_provider(provider, message)
            else:
                self.registrars[provider].from_consumer(consumer, link, message)
            return True
        self.todo.discard(key)
        if way == TO_CONSUMER:
            self.registrars[consumer].unlinked(provider)
        elif way == OLD:
            del self.old[consumer, provider]
        else:
            del self.registrars[provider].links[consumer]
            self.registrars[provider].post(c.ConsumerLost(consumer))
        return True

    def dial(self, consumer: str, provider: str) -> bool:
        """A consumer tries to reach a provider."""
        key = ("dial", consumer, provider)
        if key not in self.todo:
            return False
        here, there = self.registrars[consumer], self.registrars[provider]
        if there.state == "gone" or (there.state == "stopped" and provider in here.asked):
            here.asked.discard(provider)
            here.post(c.PeerGone(provider, DOWN, there.state == "gone", self.new_event()))
        if there.state == "gone":
            self.todo.discard(key)
        if there.state != "up" and not (there is here and there.state == "starting"):
            return there.state in ("gone", "stopped")
        self.todo.discard(key)
        link = SimLink(here.epoch)
        old = there.links.get(consumer)
        there.links[consumer] = link
        if old is not None:
            self._replace_link(consumer, provider, old)
        here.linked(provider, link)
        return True

    def _replace_link(self, consumer: str, provider: str, old: SimLink) -> None:
        self.registrars[provider].post(c.ConsumerLost(consumer))
        self.todo.discard(("net", consumer, provider, TO_PROVIDER))
        old.cut = True
        self.old[consumer, provider] = old
        self.todo.add(("net", consumer, provider, OLD))

    def save(self, name: str) -> bool:
        """What was to be written later is written."""
        if ("save", name) not in self.todo:
            return False
        self.registrars[name].save()
        return True

    def register(self, name: str, server: str) -> bool:
        """A server is registered."""
        key = ("register", name, server)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        registrar.registered.add(server)
        registrar.post(c.Register(registrar.offers[server]))
        return True

    def serve(self, name: str) -> bool:
        """A registrar's on_start has returned."""
        key = ("serve", name)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        for origin in list(registrar.catalog.by_origin):
            if origin in self.retired:
                registrar.receive(Gone(origin), origin)
        registrar.serve()
        return True

    def up(self, name: str) -> bool:
        """A dead registrar is started again."""
        registrar = self.registrars[name]
        if registrar.state not in ("down", "stopped"):
            return False
        self.todo.discard(("up", name))
        registrar.start()
        return True

    def timer(self, name: str, timer: str) -> bool:
        """A timer fires: whenever it likes, as correctness must not depend on it."""
        key = ("timer", name, timer)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        registrar.post(registrar.timers.pop(timer))
        return True

    # -- callbacks -----------------------------------------------------------------------------------------------

    def call(self, name: str, kind: str, id: str, number: Any, how: str, *place: Any) -> bool:
        """A callback goes on: "sub" loads something, "ok" returns, "raise" raises."""
        key = ("call", name, kind, id, number)
        if key not in self.todo:
            return False
        registrar = self.registrars[name]
        run = registrar.runs[key]
        self.todo.discard(key)
        if how == "sub":
            run.subs += 1
            run.waits = f"{id}/{number}.{run.subs}"
            provider, server, request = place
            registrar.ask(c.Ask(run.waits, provider, server, request, run.id), run)
            return True
        del registrar.runs[key]
        registrar.post(self._outcome(registrar, run, ok=how != "raise", with_change=how == "change"))
        return True

    def _outcome(self, registrar: SimRegistrar, run: Run, *, ok: bool, with_change: bool) -> c.Command:
        name, ledger = registrar.name, self.ledger
        match run.kind:
            case "load":
                ledger.run_ended(name, run.id, "loaded" if ok else "gone")
                response = f"{run.id}:{run.number}".encode()
                return c.LoadDone(run.id, run.number, response) if ok else c.LoadErred(run.id, run.number, RAISED)
            case "unload":
                ledger.run_ended(name, run.id, "gone" if ok else "unload_failed")
                return c.UnloadDone(run.id, run.number) if ok else c.UnloadErred(run.id, run.number, STUCK)
            case "hear":
                ledger.dealt_with(run.id, run.number)
                return c.Heard(run.id, run.number)
            case "status":
                assert run.notice is not None
                return c.StatusDone(run.id, run.notice, run.provider, not ok)
            case _:
                event = self.new_event()
                if not ok:
                    return c.RecoverErred(run.id, run.number, RAISED, event)
                new = f"{run.id}:{run.number}:{event}".encode() if with_change or run.kind == "reload" else None
                return c.RecoverDone(run.id, run.number, new, event)

    # -- people --------------------------------------------------------------------------------------------------

    def load(self, query_id: str, name: str, provider: str, server: str, request: bytes, direct: bool = False) -> bool:
        """Somebody asks for something."""
        registrar = self.registrars[name]
        if registrar.state not in ("up", "starting") or query_id in self.ledger.fate:
            return False
        self.asker[query_id] = name
        ask = c.Ask(query_id, provider, server, request, "")
        there = self.registrars[provider]
        if direct and there.state == "up" and registrar.catalog.up.get(provider) == there.epoch:
            ask = ask._replace(direct=True, seq=registrar.catalog.seq + 1 + len(registrar.inbox))
            line = self.lines[query_id] = SimLine(ask, name, registrar.epoch)
            line.ways[TO_PROVIDER].append(Load(query_id, server, request, name, "", 0, ask.seq))
            self.todo.add(("line", query_id, TO_PROVIDER))
        registrar.ask(ask, None)
        return True

    def line(self, query_id: str, way: int) -> bool:
        """Something arrives on a direct line: a message, or that it is broken."""
        key = ("line", query_id, way)
        if key not in self.todo:
            return False
        line = self.lines[query_id]
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
            if message is None:
                self._follow(consumer, query_id, c.SendAgain(query_id))
            elif isinstance(message, Loaded):
                consumer.post(c.Got(line.ask, message.resource_id, message.response))
                consumer.under_way.pop(query_id, None)
                consumer.load_ended(query_id, None)
            else:
                assert isinstance(message, LoadRefused)
                if consumer.under_way.pop(query_id, None) is None:
                    consumer.post(c.Got(line.ask, failure=message.failure))
                consumer.load_ended(query_id, message.failure)
        return True

    def _follow(self, consumer: SimRegistrar, query_id: str, command: c.Command) -> None:
        """As RegistrarActor.follow."""
        ask = consumer.under_way.pop(query_id, None)
        if ask is not None:
            consumer.post(ask)
        if consumer.inbox:
            self.wake(consumer.name)
        self.lines[query_id].left = True
        self.todo.discard(("line", query_id, TO_CONSUMER))
        consumer.post(command)
        held = consumer.catalog.held.get(query_id)
        if held is not None and held.hold is Hold.PENDING:
            return
        gone = held is None or held.hold is not Hold.HELD or isinstance(command, c.GiveUp)
        if held is not None and held.hold is Hold.HELD and gone:
            consumer.post(c.Release(query_id))
        consumer.load_ended(query_id, DOWN if gone else None)

    def tire(self, name: str, query_id: str) -> bool:
        """Somebody does not wait for a load any longer."""
        key = ("tire", name, query_id)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        line = self.lines.get(query_id)
        if line is None or line.left:
            registrar.post(c.GiveUp(query_id, TIRED))
            return True
        if not line.broken:
            line.ways[TO_PROVIDER].append(Unload(query_id, name))
            self.todo.add(("line", query_id, TO_PROVIDER))
        self._follow(registrar, query_id, c.GiveUp(query_id, TIRED))
        return True

    def unload(self, name: str, query_id: str) -> bool:
        """Somebody lets a query go."""
        registrar = self.registrars[name]
        held = registrar.catalog.held.get(query_id)
        if registrar.state not in ("up", "starting") or held is None or held.hold is not Hold.HELD or held.parent:
            return False
        line = self.lines.get(query_id)
        if query_id in self.letting or (line is not None and not line.left):  # its thread has not been told yet
            return False
        if self.ledger.fate.get(query_id) == "failed":
            return False
        self.letting[query_id] = name
        self.ledger.letting(query_id)
        self.todo.add(("late", name, query_id))
        registrar.post(c.Release(query_id))
        return True

    def late(self, name: str, query_id: str) -> bool:
        """Somebody does not wait for an unload any longer."""
        key = ("late", name, query_id)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        self.registrars[name].post(c.ReleaseOverdue(query_id, LATE))
        return True

    def unload_ended(self, registrar: SimRegistrar, query_id: str, failure: Failure | None) -> None:
        """Whoever unloaded is told."""
        if self.letting.pop(query_id, None) is None:
            return
        self.todo.discard(("late", registrar.name, query_id))
        if failure is None:
            provider = self.registrars[self.ledger.provider[query_id]]
            self.ledger.released(query_id, query_id in provider.disk.tables["queries"] and provider.state != "gone")
        elif failure is not LATE:
            self.ledger.kept(query_id)

    def unload_refused(self, registrar: SimRegistrar, query_id: str) -> None:
        """The disk is full: it is held as before."""
        if self.letting.pop(query_id, None) is not None:
            self.todo.discard(("late", registrar.name, query_id))
            self.ledger.kept(query_id)

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

    # -- what breaks ---------------------------------------------------------------------------------------------

    def cut(self, consumer: str, provider: str, kept_there: int, kept_here: int) -> bool:
        """A link breaks."""
        peering = self.registrars[consumer].clients.get(provider)
        if peering is None or peering.link.cut:
            return False
        self._cut(consumer, provider, peering.link, (kept_there, kept_here))
        return True

    def _cut(self, consumer: str, provider: str, link: SimLink, kept: tuple[int, int]) -> None:
        link.lose(kept)
        if self.registrars[provider].links.get(consumer) is link:
            self.todo.add(("net", consumer, provider, TO_PROVIDER))
        peering = self.registrars[consumer].clients.get(provider)
        if peering is not None and peering.link is link:
            self.todo.add(("net", consumer, provider, TO_CONSUMER))

    def crash(self, name: str, becomes: str = "down") -> bool:
        """A process is killed."""
        registrar = self.registrars[name]
        if registrar.state not in ("up", "starting"):
            return False
        registrar.state = becomes
        for key in [key for key in self.todo.keys if key[0] in _OF_A_PROCESS and key[1] == name]:
            self.todo.discard(key)
        for provider, peering in list(registrar.clients.items()):  # what it sent may still arrive
            registrar.clients.pop(provider)
            self.todo.discard(("net", name, provider, TO_CONSUMER))
            self._cut(name, provider, peering.link, (1_000_000, 0))
        for consumer, link in list(registrar.links.items()):
            registrar.links.pop(consumer)
            self.todo.discard(("net", consumer, name, TO_PROVIDER))
            self._cut(consumer, name, link, (0, 1_000_000))
        for consumer, provider in [pair for pair in self.old if pair[1] == name]:
            del self.old[consumer, provider]
            self.todo.discard(("net", consumer, provider, OLD))
        self._break_lines(name)
        on_disk = registrar.disk.tables["held"]
        for query_id, fate in self.ledger.fate.items():
            if fate == "held" and query_id not in on_disk and self.asker.get(query_id) == name:
                self.ledger.forgotten.add(query_id)
        for query_id in [id for id, holder in self.letting.items() if holder == name]:
            del self.letting[query_id]
        registrar.fresh()
        self.ledger.crashed(name)
        if becomes != "gone":
            self.todo.add(("up", name))
        return True

    def break_line(self, line: SimLine) -> None:
        """Its provider closes it."""
        query_id = line.ask.query_id
        line.broken = True
        line.ways[TO_PROVIDER].clear()
        self.todo.discard(("line", query_id, TO_PROVIDER))
        if not line.left:
            self.todo.add(("line", query_id, TO_CONSUMER))

    def _break_lines(self, name: str) -> None:
        for query_id, line in list(self.lines.items()):
            if line.consumer == name:
                line.left = True
                self.todo.discard(("line", query_id, TO_CONSUMER))
            elif line.provider == name:
                self.break_line(line)
            if line.left and not line.ways[TO_PROVIDER]:
                self.todo.discard(("line", query_id, TO_CONSUMER))
                del self.lines[query_id]

    def expel(self, provider: str, consumer: str) -> None:
        """A provider does not listen to a consumer any more that is gone for good."""
        link = self.registrars[provider].links.pop(consumer, None)
        if link is not None:
            self.todo.discard(("net", consumer, provider, TO_PROVIDER))
            self._cut(consumer, provider, link, (0, 1_000_000))
            self.registrars[provider].post(c.ConsumerLost(consumer))

    def retire(self, name: str) -> bool:
        """A process dies for good: all its providers hear of it, those that are down when they are back."""
        if not self.crash(name, "gone"):
            return False
        self.retired.add(name)
        for registrar in self.registrars.values():
            if registrar.state == "up":
                registrar.receive(Gone(name), name)
        return True

    def may_be_lost(self, consumer: SimRegistrar, held: Held) -> bool:
        """Whether a query may be said to be lost though no owner took it away."""
        return held.registrar in self.retired or consumer.name in self.retired or held.id in self.ledger.losses

    def find_notice(self, id: str) -> Notice | None:
        """A notice that was ever on a disk."""
        return self.ledger.noticed.get(id)

    def live(self) -> list[SimRegistrar]:
        """Those that are not gone for good."""
        return [registrar for registrar in self.registrars.values() if registrar.state != "gone"]

    def lingering(self, registrar: SimRegistrar, resource_id: str) -> bool:
        """Whether an unheld resource is kept warm."""
        resource = registrar.catalog.resources[resource_id]
        return resource.phase is Phase.LOADED and ("linger:" + resource_id) in registrar.timers


_OF_A_PROCESS = frozenset(("wake", "save", "register", "serve", "timer", "call", "tire", "late", "dial", "reregister"))

_PERFORM: dict[str, Any] = {
    name: getattr(World, name)
    for name in ["wake", "net", "dial", "save", "register", "serve", "up", "timer", "call", "load", "line", "tire", "unload", "late", "own", "reregister", "cut", "crash", "retire"]
}


def describe(step: Step) -> str:
    """A step, for people."""
    return " ".join(part.decode() if isinstance(part, bytes) else str(part) for part in step)
