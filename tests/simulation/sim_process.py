"""SimShell: the memory of one simulated process with a registrar, its links, and the callbacks it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core import holding
from rr_actors.registrar.links.consumer_links import Routes
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.catalog import Catalog, Server, Unsaved
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.messages import Fetch, Fetched, Gone, Leased, Load, Loaded, Message, Noticed, Unload
from rr_actors.registrar.model.rows import HIGHEST, Content, Held, Hold, Notice, Phase, Resource, State, content_of
from simulation.oracle import Ledger, Violation
from simulation.pending_steps import Todo
from simulation.sim_links import TO_CONSUMER, TO_PROVIDER, SimLine, SimLink


class Surroundings(Protocol):
    """What a simulated process needs of its world: the rest of the world is behind this."""

    ledger: Ledger
    todo: Todo
    hasty: frozenset[str]
    left: set[str]

    @property
    def registrars(self) -> Mapping[str, SimShell]:
        """All of the world, by name."""
        ...

    def new_event(self) -> str:
        """Return a fresh id of a status."""
        ...

    def note(self, text: str) -> None:
        """Add a line to the timeline."""
        ...

    def wake(self, name: str) -> bool:
        """Have a registrar handle what came in."""
        ...

    def expel(self, provider: str, consumer: str) -> None:
        """Have a provider listen no more to a consumer that is gone for good."""
        ...

    def break_line(self, line: SimLine) -> None:
        """Have a line's provider close it."""
        ...

    def has_line(self, query_id: str) -> bool:
        """Whether a thread's line for this query is open."""
        ...

    def leave_line(self, query_id: str) -> None:
        """Have a thread leave its line for this query, if it has one."""
        ...

    def may_be_lost(self, consumer: SimShell, held: Held) -> bool:
        """Whether a query may be said to be lost though no owner took it away."""
        ...

    def dependent(self) -> dict[str, int]:
        """Return the resources that are loaded and have not dealt with a status, and the attempts of their loads."""
        ...

    def run_of(self, consumer: str, provider: str) -> int:
        """Return the epoch of a provider as a consumer knows it."""
        ...

    def close_fenced(self, provider: str, leased: list[str]) -> None:
        """Have a provider close the links and lines of hosts without a lease."""
        ...

    def released(self, provider: str, number: int) -> None:
        """Have a gateway hear that a registrar has released what hosts without a lease held."""
        ...

    def unload_ended(self, registrar: SimShell, query_id: str, failure: Failure | None) -> None:
        """Note how an unload has ended."""
        ...


class Run:
    """One callback that runs: load, reload, unload, recover or status of a resource, or hear of a query.

    "renew" is an unload before a reload.
    """

    __slots__ = ("id", "key", "kind", "listener", "notice", "number", "resource", "subs", "waits")

    def __init__(self, registrar: str, kind: str, id: str, number: Any, resource: Resource | None) -> None:
        self.kind = kind
        self.id = id
        self.number = number
        self.key = ("call", registrar, kind, id, number)
        self.resource = resource
        self.notice: Notice | None = None
        self.listener = ""  # the resource on whose behalf it listens to a part, if it may deal with the status
        self.subs = 0
        self.waits = ""


class Peering(NamedTuple):
    """A link to a provider, from this side."""

    link: SimLink
    reconciled: bool
    number: int  # of the Fetch that opened it


class SimShell:
    """What registrar/links/provider_link.py, consumers.py and server.py do, one step at a time."""

    def __init__(self, world: Surroundings, name: str, servers: tuple[Server, ...]) -> None:
        self.world = world
        self.name = name
        self.offers = {server.name: server for server in servers}
        self.disk: Content = content_of(())
        self.disk_is_full = False
        self.state = "down"  # down, stopped, starting, up, gone
        self.epoch = 0
        self.open(content_of(()))
        self.fresh()

    def open(self, content: Content) -> None:
        """The catalog in memory. Some registrars have few statuses of one query on their way, so that others wait.

        The parts of some have no high priority.
        """
        self.catalog = Catalog(self.name, content, self.epoch)
        self.catalog.window = (1, 2, 1000)[ord(self.name[-1]) % 3]
        self.catalog.max_priority = (HIGHEST, 5, HIGHEST)[ord(self.name[-1]) % 3]

    def fresh(self) -> None:
        """Nothing of the process's memory."""
        self.inbox: deque[tuple[Any, str | None]] = deque()
        self.unsaved = Unsaved()
        self.sequence = 0  # the last number given to a load
        self.registered: set[str] = set()
        self.links: dict[str, SimLink] = {}  # from consumers
        self.clients: dict[str, Peering] = {}  # to providers
        self.fetches = self.epoch << 32
        self.epochs: dict[int, int] = {}  # of the provider, by the number of the Fetch that opened a link to it
        self.asked: set[str] = set()
        self.stopped: set[str] = set()  # providers that were stopped when it last tried to reach them
        self.gone: set[str] = set()  # providers of which it knows that they are gone for good
        self.closing: Any = None  # lives.Closing, while it is being closed
        self.routes = Routes()
        self.ending: list[SimLine] = []  # lines whose end is read when what has come in is dealt with
        self.runs: dict[tuple[Any, ...], Run] = {}
        self.waiters: dict[str, Run | None] = {}
        self.given_up: set[str] = set()  # by a thread that has left its line: it is not told that they are held
        self.timers: dict[str, c.Command] = {}
        self.begun: set[str] = set()  # queries whose rows came with what is decided now
        self.refusals: set[str] = set()  # queries whose unloads are said to be refused in it
        self.held_back: list[tuple[Any, str]] = []
        self.effects: deque[Effect] = deque()  # decided, and not done yet
        self.acting = False
        self.unwanted: set[str] = set()  # resources that nobody held when they were found loading
        self.reloading: set[str] = set()  # resources of which it has been said that they are reloaded
        self.budget = -1  # effects acted upon until it dies; -1: all

    # -- what comes in -------------------------------------------------------------------------------------------

    def post(self, command: c.Command) -> None:
        """A command of its own process."""
        self.put(command, None)

    def put(self, what: Any, sender: str | None) -> None:
        """Something to be decided: now, or in its turn."""
        first = not self.inbox
        self.inbox.append((what, sender))
        self.world.todo.add(("wake", self.name))
        if first and not self.acting and self.name in self.world.hasty:
            self.world.wake(self.name)

    def receive(self, message: Any, sender: str) -> None:
        """A message of another registrar."""
        if self.state != "up" and type(message) is Noticed:
            self.held_back.append((message, sender))
            return
        if type(message) is Gone:
            self.world.expel(self.name, message.origin)
        elif type(message) is Leased:
            self.world.close_fenced(self.name, message.hosts)
        self.put(message, sender)

    def next_seq(self) -> int:
        """As RegistrarActor.sequence."""
        self.sequence = max(self.sequence, self.catalog.since) + 1
        return self.sequence

    def from_consumer(self, origin: str, link: SimLink, message: Any) -> None:
        """A message on a consumer's link; one that a newer link has replaced brings nothing."""
        if self.links.get(origin) is link:
            if isinstance(message, (Load, Unload)):
                self.routes.asked_by_link(origin, message)
            self.receive(message, origin)

    def consumer_lost(self, origin: str) -> None:
        """A consumer's link is down, or another has taken its place."""
        self.routes.link_lost(origin)
        self.post(c.ConsumerLost(origin))

    def from_line(self, line: SimLine, message: Any, at_once: str | None = None, overtaking: str | None = None) -> None:
        """A message on a direct line.

        Args:
            at_once: of the disk, if a Load may join before all that is waiting is taken up.
            overtaking: of the disk, if a Load or an Unload may be decided before notes that are not about the same.
        """
        link = self.links.get(line.consumer)
        if link is None or link.epoch != line.epoch:  # it may be of a dead incarnation
            self.world.break_line(line)
            return
        if at_once is not None and type(message) is Load:
            joined = self.join_at_once(message, at_once)
            if joined is not None:
                self.answer(line, joined)
                return
        if isinstance(message, (Load, Unload)):
            self.routes.asked_by_line(line, message, self.catalog.refused)
        if overtaking is None or not self.decide_at_once(message, line.consumer, overtaking):
            self.receive(message, line.consumer)

    def join_at_once(self, load: Load, fault: str) -> Loaded | None:
        """As ShortCuts.join_at_once."""
        raise AssertionError(load)

    def decide_at_once(self, message: Message, sender: str, fault: str) -> bool:
        """As RegistrarActor.receive_directly; False: it waits with the rest."""
        raise AssertionError(message)

    def answer(self, line: SimLine, message: Any) -> None:
        """By a direct line; lost if that is."""
        if not line.broken and not line.left:
            line.ways[TO_CONSUMER].append(message)
            self.world.todo.add(("line", message.query_id, TO_CONSUMER))

    def from_provider(self, provider: str, message: Any) -> None:
        """A message on the link to a provider."""
        peering = self.clients[provider]
        if type(message) is not Fetched:
            if type(message) is not Noticed or peering.reconciled:
                self.receive(message, provider)
            return
        if not peering.reconciled and message.number == peering.number:
            self.clients[provider] = peering._replace(reconciled=True)
            event = self.world.new_event()
            run = self.epochs[message.number]
            self.post(c.Reconcile(provider, message.queries, event, message.same, message.number, run, message.notices))

    # -- links ---------------------------------------------------------------------------------------------------

    def send(self, link: SimLink, consumer: str, provider: str, way: int, message: Any) -> None:
        """Put it on its way, unless the link is cut."""
        if way == TO_PROVIDER and type(message) is not Fetch and not self.clients[provider].reconciled:
            raise Violation("links", f"{message} was sent to {provider} before its answer to Fetch")
        if not link.cut:
            link.ways[way].append(message)
            self.world.todo.add(("net", consumer, provider, way))

    def reaches(self, provider: SimShell) -> bool:
        """Whether threads may take direct lines to it."""
        up = self.catalog.up.get(provider.name, 0)
        return provider.state == "up" and self.epochs.get(up) == self.world.run_of(self.name, provider.name)

    def want(self, provider: str) -> None:
        """Have a link made."""
        self.asked.add(provider)
        if provider not in self.clients:
            self.world.todo.add(("dial", self.name, provider))

    def linked(self, provider: str, link: SimLink, epoch: int) -> None:
        """There is a link to that incarnation of a provider: ask what we hold there."""
        self.fetches += 1
        self.clients[provider] = Peering(link, False, self.fetches)
        self.epochs[self.fetches] = epoch
        self.asked.discard(provider)
        rows = [] if self.inbox else digests.held_at(self.catalog, provider)  # else what waits there may change it
        known = digests.known(rows).spans
        self.send(link, self.name, provider, TO_PROVIDER, Fetch(self.name, True, self.fetches, known))

    def unlinked(self, provider: str) -> None:
        """The link is lost: connect again if anything is open there."""
        del self.clients[provider]
        self.post(c.LinkLost(provider))
        if self.catalog.needs(provider):
            asked = provider in self.asked
            self.want(provider)
            if not asked:
                self.asked.discard(provider)

    # -- callbacks, and people who wait --------------------------------------------------------------------------

    def start_run(self, kind: str, id: str, number: Any, resource: Resource | None) -> Run:
        """A callback begins."""
        run = Run(self.name, kind, id, number, resource)
        self.runs[run.key] = run
        self.world.todo.add(run.key)
        if resource is not None:
            self.world.ledger.callback_began(self.name, kind, id)
        if resource is not None and kind in ("load", "unload", "reload", "renew"):
            request = (self.name, resource.server, resource.request)
            if kind == "unload" and resource.response is None:
                if id in self.catalog.holders:
                    raise Violation("callbacks", f"{id} is cleaned up, and somebody holds it")
                self.world.ledger.given_up.add((self.name, id))
            elif kind == "load" and id in self.unwanted:
                raise Violation("callbacks", f"{id} is loaded again after a crash, and nobody wants it")
            if kind == "unload" and id in self.catalog.revocations:
                self.world.ledger.unload_began(id, self.world.dependent())
            self.world.ledger.run_started(self.name, id, kind, number, request, self.excused(resource))
        return run

    def excused(self, resource: Resource) -> set[str]:
        """Resources of the same request that nobody is given any more: FATAL, or not to be unloaded."""
        ids = self.catalog.by_server.get(resource.server, ())
        others = [self.catalog.resources[id] for id in ids]
        if self.catalog.resources[resource.id].state is State.FATAL:  # it was, before it began
            return {r.id for r in others}
        apart = {r.id for r in others if r.state is State.FATAL or r.phase is Phase.UNLOAD_FAILED}
        if self.catalog.servers[resource.server].exclusive:  # its holder is to release it first
            apart -= {r.id for r in others if r.phase is not Phase.UNLOAD_FAILED and r.id in self.catalog.holders}
        return apart

    def ask(self, ask: c.AskProvider, run: Run | None) -> None:
        """Load by the loop, for a callback or for somebody outside."""
        self._asked(ask, run)
        self.post(ask)

    def begin_directly(self, ask: c.AskProvider, run: Run | None) -> Load | None:
        """As RegistrarActor.begin_directly: load by a thread's own connection; None: its parent is gone."""
        resource = self.catalog.resources.get(ask.parent)
        if ask.parent and resource is None:
            return None
        attempt = 0 if resource is None else resource.attempt
        priority = ask.priority if ask.own or resource is None else self.catalog.inherited(resource.id)
        self._asked(ask, run)
        held = self.catalog.in_flight[ask.query_id] = holding.pending(ask, attempt, priority)
        return Load(held.id, held.server, held.request, self.name, held.parent, attempt, held.seq, priority, held.own)

    def _asked(self, ask: c.AskProvider, run: Run | None) -> None:
        query_id = ask.query_id
        self.world.ledger.fate[query_id] = "asked"
        self.world.ledger.provider[query_id] = ask.registrar
        self.world.ledger.wishes[query_id] = [(0, None if ask.parent and not ask.own else ask.priority)]
        self.waiters[query_id] = run
        self.world.todo.add(("tire", self.name, query_id))

    def load_ended(self, query_id: str, failure: Failure | None) -> None:
        """Whoever asked is told, once."""
        if query_id not in self.waiters or (failure is None and query_id in self.given_up):
            return
        self.given_up.discard(query_id)
        run = self.waiters.pop(query_id)
        self.world.todo.discard(("tire", self.name, query_id))
        ledger = self.world.ledger
        if failure is None:
            provider = self.world.registrars[ledger.provider[query_id]]
            # A revoked query may have been taken, or released by its holder, before the thread's own line answers.
            ended = query_id in ledger.taken or query_id in ledger.revoked or provider.name in self.world.left
            ledger.loaded(query_id, ended or query_id in provider.disk["queries"])
        else:
            ledger.failed(query_id)
        if run is not None:
            if run.key in self.runs:
                self.world.todo.add(run.key)
            run.waits = ""
            if failure is None:
                ledger.parts.setdefault((run.id, run.number), []).append(query_id)

    def holds(self) -> list[str]:
        """What people outside hold by it."""
        return [id for id, row in self.catalog.held.items() if row.hold is Hold.HELD and not row.parent]
