"""SimRegistrar: the shell of a registrar in miniature. The real core decides; disk, links, callbacks and time are made up.

It does what actors/registrar.py, actors/client.py and actors/server.py do, in the same order, one step at a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from rr_actors.core import commands as c
from rr_actors.core import effects as e
from rr_actors.core import recovering
from rr_actors.core.catalog import Batch, Catalog, Server
from rr_actors.core.decide import decide, obey
from rr_actors.core.refusing import refuse
from rr_actors.errors import CatalogError
from rr_actors.messages import (
    Failure,
    Fetch,
    Fetched,
    FetchedQuery,
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Noticed,
)
from rr_actors.records import TABLE_OF, Change, Drop, Hold, Notice, Phase, Put, Query, Resource, State, Table
from rr_actors.stores.memory import MemoryDisk
from rr_actors.testing.ledger import Violation
from rr_actors.testing.links import TO_CONSUMER, TO_PROVIDER, SimLine, SimLink

if TYPE_CHECKING:
    from rr_actors.testing.world import World

DISK_FULL = Failure("CatalogError", "disk full")
DOWN = Failure("RegistrarDown", "stopped")


class Killed(Exception):
    """The simulated process dies here."""


class Run:
    """One callback that runs: of a resource ("load", "reload", "unload", "recover", "status"), or of a query ("hear")."""

    __slots__ = ("id", "key", "kind", "notice", "number", "provider", "resource", "subs", "waits")

    def __init__(self, registrar: str, kind: str, id: str, number: Any, resource: Resource | None) -> None:
        self.kind = kind
        self.id = id
        self.number = number
        self.key = ("call", registrar, kind, id, number)
        self.resource = resource
        self.notice: Notice | None = None
        self.provider = ""
        self.subs = 0
        self.waits = ""


class Peering(NamedTuple):
    """A link to a provider, from this side."""

    link: SimLink
    reconciled: bool
    number: int


class SimRegistrar:
    """One registrar in a process of its own, over a disk that outlives it."""

    def __init__(self, world: World, name: str, servers: tuple[Server, ...]) -> None:
        self.world = world
        self.name = name
        self.offers = {server.name: server for server in servers}
        self.disk = MemoryDisk()
        self.state = "down"  # down, stopped, starting, up, gone
        self.epoch = 0
        self.catalog = Catalog(name)
        self.fresh()

    def fresh(self) -> None:
        """Nothing of the process's memory."""
        self.inbox: deque[tuple[Any, str | None]] = deque()
        self.unsaved: dict[tuple[Table, str], Change] = {}
        self.registered: set[str] = set()
        self.links: dict[str, SimLink] = {}  # from consumers
        self.clients: dict[str, Peering] = {}  # to providers
        self.fetches = self.epoch << 32
        self.asked: set[str] = set()
        self.under_way: dict[str, c.Ask] = {}  # direct loads of which the catalog does not know yet
        self.routes: dict[str, SimLine] = {}
        self.asked_twice: set[str] = set()
        self.runs: dict[tuple[Any, ...], Run] = {}
        self.waiters: dict[str, Run | None] = {}
        self.timers: dict[str, c.Command] = {}
        self.held_back: list[tuple[Any, str]] = []
        self.budget = -1  # effects acted upon until it dies; -1: all

    # -- life ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the catalog; servers are registered, and others let in, by later steps."""
        self.disk.epoch += 1
        self.epoch = self.disk.epoch
        self.fetches = self.epoch << 32
        self.state = "starting"
        rows = [row for rows in self.disk.tables.values() for row in rows.values()]
        self.catalog = Catalog(self.name, rows, self.epoch)
        batch = Batch(self.catalog)
        recovering.begin_again(batch)
        self.finish(batch, "")
        for provider in list(self.catalog.peers):
            self.want(provider)
        for server in self.offers:
            self.world.todo.add(("register", self.name, server))
        self.world.todo.add(("serve", self.name))

    def serve(self) -> None:
        """Others are let in, and statuses are heard."""
        self.state = "up"
        held_back, self.held_back = self.held_back, []
        for message, sender in held_back:
            self.receive(message, sender)

    # -- what comes in -------------------------------------------------------------------------------------------

    def post(self, command: c.Command) -> None:
        """A command of its own process."""
        if self.under_way and type(command) in _SURPRISING:
            self.own_up()
        self.inbox.append((command, None))
        self.world.todo.add(("wake", self.name))

    def receive(self, message: Any, sender: str) -> None:
        """A message of another registrar."""
        if self.state != "up" and type(message) is Noticed:
            self.held_back.append((message, sender))
            return
        if self.under_way and type(message) is Noticed:
            self.own_up()
        if type(message) is Gone:
            self.world.expel(self.name, message.origin)
        self.inbox.append((message, sender))
        self.world.todo.add(("wake", self.name))

    def own_up(self) -> None:
        """Something comes in that may be about a direct load under way: make it known before."""
        self.inbox.extend((ask, None) for ask in self.under_way.values())
        self.under_way.clear()

    def from_consumer(self, origin: str, link: SimLink, message: Any) -> None:
        """A message on a consumer's link; one that a newer link has replaced brings nothing."""
        if self.links.get(origin) is link:
            if self.routes and type(message) is Load and message.query_id in self.routes:
                self.asked_twice.add(message.query_id)
            self.receive(message, origin)

    def from_line(self, line: SimLine, message: Any) -> None:
        """A message on a direct line."""
        link = self.links.get(line.consumer)
        if link is None or link.epoch != line.epoch:  # it may be of a dead incarnation
            self.world.break_line(line)
            return
        if type(message) is Load:
            self.routes[message.query_id] = line
        self.receive(message, line.consumer)

    def from_provider(self, provider: str, message: Any) -> None:
        """A message on the link to a provider."""
        if type(message) is not Fetched:
            self.receive(message, provider)
            return
        peering = self.clients[provider]
        if not peering.reconciled and message.number == peering.number:
            self.clients[provider] = peering._replace(reconciled=True)
            queries = cast("list[FetchedQuery]", message.queries)
            provider_epoch = self.world.registrars[provider].epoch
            self.post(c.Reconcile(provider, provider_epoch, queries, self.world.new_event()))

    # -- decide, commit, apply, act ------------------------------------------------------------------------------

    def wake(self, count: int, fault: str, effects: int) -> None:
        """Handle that many of what came in. `fault`: "", error, before, after, or during (after so many effects)."""
        inbox = [self.inbox.popleft() for _ in range(min(count, len(self.inbox)))]
        if not self.inbox:
            self.world.todo.discard(("wake", self.name))
        batch = Batch(self.catalog)
        for item, sender in inbox:
            if sender is None:
                obey(batch, item, self.world.new_event())
            else:
                decide(batch, item, sender)
        self.budget = effects if fault == "during" else -1
        try:
            self.finish(batch, fault)
        except CatalogError:
            self.not_committed(inbox)

    def finish(self, batch: Batch, fault: str) -> None:
        """Commit, then act; nothing has happened if the commit fails."""
        try:
            self.commit(batch, fault)
        except CatalogError:
            batch.undo()
            raise
        if fault == "after":
            raise Killed
        for effect in batch.effects:
            if self.budget == 0:
                raise Killed
            self.budget -= 1
            _ACT[type(effect)](self, effect)
        if fault == "during":
            raise Killed

    def commit(self, batch: Batch, fault: str) -> None:
        """Durable changes now, with all that were to follow later; those alone may wait."""
        if batch.changes:
            if fault == "before":
                raise Killed
            if fault == "error":
                raise CatalogError("disk full")
            self.write([*self.unsaved.values(), *batch.changes, *batch.later.values()])
            self.unsaved.clear()
            self.world.todo.discard(("save", self.name))
        elif batch.later:
            self.unsaved.update(batch.later)
            self.world.todo.add(("save", self.name))

    def write(self, changes: list[Change]) -> None:
        """All of them, or the process would have died before."""
        tables = self.disk.tables
        ledger = self.world.ledger
        for change in changes:
            if type(change) is Put:
                row = change.row
                tables[TABLE_OF[type(row)]][row.id] = row
                if type(row) is Query:
                    ledger.begun(row.id)
                elif type(row) is Notice:
                    ledger.notice(row)
            else:
                drop = cast("Drop", change)
                tables[drop.table].pop(drop.id, None)
                if drop.table == "resources":
                    ledger.settled(self.name, drop.id)
                elif drop.table == "queries":
                    ledger.dropped(drop.id)

    def save(self) -> None:
        """What was to follow later follows now."""
        self.write(list(self.unsaved.values()))
        self.unsaved.clear()
        self.world.todo.discard(("save", self.name))

    def not_committed(self, inbox: list[tuple[Any, str | None]]) -> None:
        """Refuse what can be refused; the rest stays first in line."""
        again: list[tuple[Any, str | None]] = []
        batch = Batch(self.catalog)
        for item, sender in inbox:
            match item:
                case Load() if item.query_id not in self.catalog.queries:
                    batch.cause(refuse(batch, item.origin, item.query_id, DISK_FULL))
                case c.Ask(direct=False):
                    self.load_ended(item.query_id, DISK_FULL)
                case c.Release():
                    self.world.unload_refused(self, item.query_id)
                case c.SetStatus() | c.SetResponse() | c.ForceUnload() | c.Unregister():
                    batch.cause(e.Answer(item.ticket, DISK_FULL))
                case _:
                    again.append((item, sender))
        self.finish(batch, "")
        if again:
            self.inbox.extendleft(reversed(again))
            self.world.todo.add(("wake", self.name))

    # -- acting --------------------------------------------------------------------------------------------------

    def reply(self, effect: e.Reply) -> None:
        """To a consumer, by the way its request came."""
        message: Any = effect.message
        if type(message) is Loaded and message.query_id not in self.world.ledger.stored:
            raise Violation("acknowledged", f"{message.query_id}: answered as loaded, and it is not on disk")
        line = self.routes.pop(message.query_id, None) if self.routes and type(message) in _ANSWERS else None
        if line is not None:
            if not line.broken and not line.left:  # else it is lost with the line
                line.ways[TO_CONSUMER].append(message)
                self.world.todo.add(("line", message.query_id, TO_CONSUMER))
            if message.query_id not in self.asked_twice:
                return
            self.asked_twice.discard(message.query_id)
        link = self.links.get(effect.origin)
        if link is not None:
            self.send(link, effect.origin, self.name, TO_CONSUMER, message)

    def request(self, effect: e.Request) -> None:
        """To a provider, if there is a link."""
        peering = self.clients.get(effect.registrar)
        if peering is None:
            self.want(effect.registrar)
        else:
            self.send(peering.link, self.name, effect.registrar, TO_PROVIDER, effect.message)

    def send(self, link: SimLink, consumer: str, provider: str, way: int, message: Any) -> None:
        """Put it on its way, unless the link is cut."""
        if not link.cut:
            link.ways[way].append(message)
            self.world.todo.add(("net", consumer, provider, way))

    def want(self, provider: str) -> None:
        """Have a link made."""
        self.asked.add(provider)
        if provider not in self.clients:
            self.world.todo.add(("dial", self.name, provider))

    def linked(self, provider: str, link: SimLink) -> None:
        """There is a link: ask what we hold there."""
        self.fetches += 1
        self.clients[provider] = Peering(link, False, self.fetches)
        self.asked.discard(provider)
        self.send(link, self.name, provider, TO_PROVIDER, Fetch(self.name, True, self.fetches))

    def unlinked(self, provider: str) -> None:
        """The link is lost: connect again if anything is open there."""
        del self.clients[provider]
        self.post(c.LinkLost(provider))
        if self.catalog.needs(provider):
            asked = provider in self.asked
            self.want(provider)
            if not asked:
                self.asked.discard(provider)

    def start_run(self, kind: str, id: str, number: Any, resource: Resource | None) -> Run:
        """A callback begins."""
        run = Run(self.name, kind, id, number, resource)
        self.runs[run.key] = run
        self.world.todo.add(run.key)
        if resource is not None and kind in ("load", "unload", "reload"):
            request = (self.name, resource.server, resource.request)
            self.world.ledger.run_started(self.name, id, kind, number, request, self.excused(resource))
        return run

    def excused(self, resource: Resource) -> set[str]:
        """Resources of the same request that nobody is given any more: FATAL, or not to be unloaded."""
        ids = self.catalog.by_server.get(resource.server, ())
        others = [self.catalog.resources[id] for id in ids]
        return {r.id for r in others if r.state is State.FATAL or r.phase is Phase.UNLOAD_FAILED}

    def ask(self, ask: c.Ask, run: Run | None) -> None:
        """Load, for a callback or for somebody outside."""
        self.world.ledger.fate[ask.query_id] = "asked"
        self.world.ledger.provider[ask.query_id] = ask.registrar
        self.waiters[ask.query_id] = run
        self.world.todo.add(("tire", self.name, ask.query_id))
        if ask.direct:
            self.under_way[ask.query_id] = ask
        else:
            self.post(ask)

    def load_ended(self, query_id: str, failure: Failure | None) -> None:
        """Whoever asked is told, once."""
        if query_id not in self.waiters:
            return
        run = self.waiters.pop(query_id)
        self.world.todo.discard(("tire", self.name, query_id))
        ledger = self.world.ledger
        if failure is None:
            provider = self.world.registrars[ledger.provider[query_id]]
            on_disk = query_id in provider.disk.tables["queries"] or query_id in ledger.evicted
            ledger.loaded(query_id, on_disk)
        else:
            ledger.failed(query_id)
        if run is not None:
            if run.key in self.runs:
                self.world.todo.add(run.key)
            run.waits = ""
            if failure is None:
                ledger.parts.setdefault((run.id, run.number), []).append(query_id)

    def _unload_resolved(self, effect: e.UnloadResolved) -> None:
        self.world.unload_ended(self, effect.query_id, effect.failure)

    def _load_resolved(self, effect: e.LoadResolved) -> None:
        line = self.world.lines.get(effect.held.id)
        if line is None or line.left:  # else its thread waits for the line's own answer
            self.load_ended(effect.held.id, effect.failure)

    def _start_load(self, effect: e.StartLoad) -> None:
        if effect.resource.server in self.registered:
            self.start_run("load", effect.resource.id, effect.resource.attempt, effect.resource)

    def _start_unload(self, effect: e.StartUnload) -> None:
        if effect.resource.server in self.registered:
            self.start_run("unload", effect.resource.id, effect.resource.tries, effect.resource)

    def _start_recover(self, effect: e.StartRecover) -> None:
        kind = "reload" if effect.reload else "recover"
        self.start_run(kind, effect.resource.id, effect.resource.attempt, effect.resource)

    def _start_status(self, effect: e.StartStatus) -> None:
        run = self.start_run("status", effect.resource.id, effect.notice.event, effect.resource)
        run.notice, run.provider = effect.notice, effect.provider

    def _hear(self, effect: e.Hear) -> None:
        excused = self.world.may_be_lost(self, effect.held)
        self.world.ledger.hear(effect.held.id, effect.notice, self.epoch, effect.repeated, excused)
        run = self.start_run("hear", effect.held.id, effect.notice.event, None)
        run.notice = effect.notice

    def _set_timer(self, effect: e.SetTimer) -> None:
        key = ("timer", self.name, effect.key)
        if effect.delay_s is None:
            self.timers.pop(effect.key, None)
            self.world.todo.discard(key)
        else:
            self.timers[effect.key] = effect.command
            self.world.todo.add(key)

    def _receive(self, effect: e.Receive) -> None:
        self.receive(effect.message, effect.sender)

    def _connect(self, effect: e.Connect) -> None:
        self.want(effect.registrar)

    def _answer(self, effect: e.Answer) -> None:
        self.world.ledger.ticket(effect.ticket, given=False)

    def _happened(self, effect: e.Happened) -> None:
        self.world.note(f"{self.name}: {effect.what} {effect.resource_id} {effect.detail}")

    def holds(self) -> list[str]:
        """What people outside hold by it."""
        return [id for id, row in self.catalog.held.items() if row.hold is Hold.HELD and not row.parent]


_ANSWERS = (Loaded, LoadRefused)
_SURPRISING = (c.Reconcile, c.PeerGone, c.LinkLost)
_ACT: dict[type, Callable[[SimRegistrar, Any], None]] = {
    e.Reply: SimRegistrar.reply,
    e.Request: SimRegistrar.request,
    e.Connect: SimRegistrar._connect,
    e.StartLoad: SimRegistrar._start_load,
    e.StartUnload: SimRegistrar._start_unload,
    e.StartRecover: SimRegistrar._start_recover,
    e.StartStatus: SimRegistrar._start_status,
    e.SetTimer: SimRegistrar._set_timer,
    e.LoadResolved: SimRegistrar._load_resolved,
    e.UnloadResolved: SimRegistrar._unload_resolved,
    e.Receive: SimRegistrar._receive,
    e.Hear: SimRegistrar._hear,
    e.Answer: SimRegistrar._answer,
    e.Happened: SimRegistrar._happened,
}
