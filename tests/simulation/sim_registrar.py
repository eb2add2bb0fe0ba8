"""SimRegistrar: a registrar's decide, commit, apply, act over a made-up disk. The core that decides is the real one."""

from __future__ import annotations

from typing import Any, cast

from rr_actors.base.errors import CatalogError
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core import holding
from rr_actors.registrar.core.callback_runs import ATTEMPTS, is_given_up
from rr_actors.registrar.core.decide import decide, refuse_uncommitted
from rr_actors.registrar.core.loads import loading
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Decision, loaded
from rr_actors.registrar.model.effects import Happened, SendReply
from rr_actors.registrar.model.messages import Load, Loaded, Message, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import (
    TABLE_OF,
    CallbackRun,
    Change,
    Content,
    Held,
    Hold,
    Notice,
    Phase,
    Put,
    Resource,
    ServedQuery,
    is_own,
)
from simulation.oracle import Violation
from simulation.sim_effects import ACT
from simulation.sim_process import SimShell

DISK_FULL = Failure("CatalogError", "disk full")


class Killed(Exception):
    """The simulated process dies here."""


class SimRegistrar(SimShell):
    """One registrar in a process of its own, over a disk that outlives it; see registrar/engine/registrar_actor.py."""

    def start(self) -> None:
        """Open the catalog; servers are registered, and others let in, by later steps."""
        self.epoch += 1
        self.fetches = self.epoch << 32
        self.state = "starting"
        content: Content = {table: dict(rows) for table, rows in self.disk.items()}
        self.open(content)
        decision = decide(self.catalog, [(c.BeginAgain(), None)])
        loading = [row.id for row in self.catalog.resources.values() if row.phase is Phase.LOADING]
        self.unwanted.update(id for id in loading if id not in self.catalog.holders)
        self.finish(decision, "")
        for provider in list(self.catalog.peers):
            self.want(provider)
        for server in self.offers:
            self.world.todo.add(("register", self.name, server))
        self.world.todo.add(("serve", self.name))

    def serve(self) -> None:
        """Others are let in, and statuses are heard."""
        self.state = "up"
        if self.inbox:
            self.post(c.BeginServing("serving"))
        else:
            self.take_up([(c.BeginServing("serving"), None)], "", 0)
        held_back, self.held_back = self.held_back, []
        for message, sender in held_back:
            self.receive(message, sender)

    def wake(self, count: int, fault: str, effects: int) -> None:
        """Handle that many of what came in. `fault`: "", error, before, after, or during (after so many effects)."""
        inbox = [self.inbox.popleft() for _ in range(min(count, len(self.inbox)))]
        if not self.inbox:
            self.world.todo.discard(("wake", self.name))
        self.take_up(inbox, fault, effects)
        while self.ending and not self.inbox:
            self.routes.line_lost(self.ending.pop())

    def take_up(self, inbox: list[tuple[Any, str | None]], fault: str, effects: int) -> None:
        """Decide these together, commit, act."""
        decision = decide(self.catalog, inbox)
        if self.disk_is_full and fault != "before":
            fault = "error"
        self.refusals = {item.query_id for item, _ in inbox if type(item) is UnloadRefused}
        self.budget = effects if fault == "during" else -1
        try:
            self.finish(decision, fault)
        except CatalogError:
            self.not_committed(inbox)
        else:
            self.world.ledger.withdrawn(item.query_id for item, _ in inbox if type(item) is c.GiveUp)

    def finish(self, decision: Decision, fault: str) -> None:
        """Commit, then act; nothing has happened if the commit fails."""
        try:
            self.commit(decision, fault)
        except CatalogError:
            decision.undo()
            raise
        decision.close()
        self._check_alone()
        if fault == "after":
            raise Killed
        self.effects.extend(decision.effects)
        if not self.acting:
            self.act()
        if fault == "during":
            raise Killed

    def _check_alone(self) -> None:
        """Of a request of an exclusive server, one resource has a holder, and this has one; the others wait."""
        catalog = self.catalog
        for server in (server for server in catalog.servers.values() if server.exclusive):
            had: dict[bytes, list[str]] = {}
            for id in catalog.by_server.get(server.name, ()):
                resource = catalog.resources[id]
                if resource.phase not in (Phase.QUEUED, Phase.UNLOADING, Phase.UNLOAD_FAILED):  # these are released
                    had.setdefault(resource.request, []).extend(catalog.holders.get(id, ()))
            if crowd := [ids for ids in had.values() if len(ids) > 1]:
                raise Violation("two holders", f"{self.name}/{server.name} is held by {crowd[0]} at the same time")

    def act(self) -> None:
        """Do what has been decided, in the order of the decisions."""
        self.world.todo.discard(("act", self.name))
        self.acting = True
        while self.effects:
            if self.budget == 0:
                raise Killed
            self.budget -= 1
            effect = self.effects.popleft()
            ACT[type(effect)](self, effect)
        self.acting = False

    def commit(self, decision: Decision, fault: str) -> None:
        """Durable changes now, with all that were to follow later; those alone may wait."""
        self.begun.clear()
        if decision.changes:
            if fault == "before":
                raise Killed
            if fault == "error":
                raise CatalogError("disk full")
            self.write([*self.unsaved.changes(), *decision.changes, *decision.later.values()])
            self.unsaved.clear()
            self.world.todo.discard(("save", self.name))
        elif decision.later:
            self.unsaved.add(decision.later.values())
            self.world.todo.add(("save", self.name))

    def write(self, changes: list[Change]) -> None:
        """All of them, or the process would have died before."""
        tables = self.disk
        ledger = self.world.ledger
        own: list[Notice] = []  # those that leave the disk
        given_up: set[str] = set()
        for change in changes:
            if type(change) is Put:
                row = change.row
                table = tables[TABLE_OF[type(row)]]
                old = table.get(row.id)
                table[row.id] = row
                if type(row) is Held:
                    owed = old is None or cast("Held", old).hold is Hold.OWED  # or was never written
                    again = row.hold is Hold.HELD and owed
                    if again and row.id in self.refusals:
                        ledger.refused.add(row.id)
                elif type(row) is Resource and row.phase is Phase.UNLOAD_FAILED:
                    ledger.given_up_unload(self.name, row.id, died=is_given_up(self.catalog, "unload", row.id))
                elif type(row) is ServedQuery:
                    ledger.begun(row.id)
                    ledger.on[row.id] = row.resource_id
                    self.begun.add(row.id)
                elif type(row) is Notice and is_own(row):
                    ledger.own_notice(row)
                elif type(row) is Notice:
                    ledger.notice(row)
            else:
                old = tables[change.table].pop(change.id, None)
                if type(old) is Notice and is_own(old):
                    own.append(old)
                if change.table == "resources":
                    was = cast("Resource | None", old)
                    failed = change.id in given_up or (was is not None and was.phase is Phase.UNLOAD_FAILED)
                    unserved = was is not None and was.server not in self.catalog.servers  # its owner clears all of it
                    ledger.settled(self.name, change.id, cleared=failed or unserved)
                elif change.table == "queries":
                    ledger.dropped(change.id)
                elif type(old) is CallbackRun and old.deaths >= ATTEMPTS and old.id.startswith("unload:"):
                    given_up.add(old.id.removeprefix("unload:"))  # its resource goes, without its server
                    ledger.given_up_unload(self.name, old.id.removeprefix("unload:"), died=True)
        self._check_told_in_turn(changes, own)

    def _check_told_in_turn(self, changes: list[Change], own: list[Notice]) -> None:
        """A server hears of its own resource before the holders, and they hear in the commit that says it has."""
        tables = self.disk
        for change in changes:
            row = change.row if type(change) is Put else None
            if type(row) is Notice and not is_own(row) and f"{row.event}:" in tables["notices"]:
                raise Violation("statuses", f"{row} is on its way, and its own server has not dealt with it")
        for notice in own:
            if notice.resource_id in tables["resources"]:
                queries = [cast("ServedQuery", row) for row in tables["queries"].values()]
                on_it = [q.id for q in queries if q.resource_id == notice.resource_id and q.id not in self.begun]
                passed_over = is_given_up(self.catalog, "status", notice.resource_id)
                self.world.ledger.own_dealt_with(notice, on_it, passed_over)

    def owe(self, query_id: str, fault: str) -> bool:
        """As RegistrarState.owe."""
        if self.inbox:
            return False

        def write(row: Held) -> bool:
            if fault == "before":
                raise Killed
            if self.disk_is_full or fault == "error":
                return False
            self.write([Put(row)])
            self.unsaved.row_written(row)
            if fault == "after":
                raise Killed
            return True

        return holding.owe(self.catalog, self.unsaved, query_id, write)

    def hold(self, got: c.Got) -> bool:
        """As RegistrarState.hold: what a thread has loaded by a line of its own."""
        if self.inbox or not holding.hold(self.catalog, self.unsaved, got):
            return False
        self.world.todo.add(("save", self.name))
        return True

    def let_go(self, message: Unloaded, provider: str) -> None:
        """As Unloads does: what a provider has let go that a thread has asked by a line of its own."""
        if self.inbox or not holding.forget_released(self.catalog, self.unsaved, message.query_id):
            self.receive(message, provider)
        else:
            self.world.todo.add(("save", self.name))

    def join(self, load: Load, fault: str) -> Loaded | None:
        """As RegistrarActor.join_here, for a thread of this process."""
        link = self.links.get(load.origin)
        if link is None or link.epoch != self.epoch or (query := self._joined(load, fault)) is None:
            return None
        self.catalog.set("queries", query.id, query)
        return loaded(self.catalog, query.id, self.catalog.resources[query.resource_id])

    def join_at_once(self, load: Load, fault: str) -> Loaded | None:
        """As RegistrarState.join, for a direct line."""
        query = self._joined(load, fault)
        if query is None:
            return None
        self.catalog.set("queries", query.id, query)
        return loaded(self.catalog, query.id, self.catalog.resources[query.resource_id])

    def _joined(self, load: Load, fault: str) -> ServedQuery | None:
        """The row, on disk; None if it is to be decided as any load."""
        query = loading.join(self.catalog, load)
        if query is None or self.inbox:
            return None
        if fault == "before":
            raise Killed
        if self.disk_is_full or fault == "error":
            return None
        self.write([Put(query)])
        self.begun.discard(query.id)  # not one of those
        if fault == "after":
            raise Killed
        return query

    def decide_at_once(self, message: Message, sender: str, fault: str) -> bool:
        """As RegistrarBase.put, of what a direct line brings."""
        if self.inbox or self.state not in ("starting", "up"):
            return False
        self.take_up([(message, sender)], fault, 0)
        return True

    def tell(self, done: c.Command, fault: str) -> bool:
        """As RegistrarBase.decide_here, for the thread that ran a callback; False: it is the loop's to decide."""
        if self.inbox:
            return False
        decision = decide(self.catalog, [(done, None)])
        try:
            self.commit(decision, "error" if self.disk_is_full and fault != "before" else fault)
        except CatalogError:
            decision.undo()
            return False
        decision.close()
        if fault == "after":
            raise Killed
        self.act_by_thread(decision)
        return True

    def act_by_thread(self, decision: Decision) -> None:
        """As Acting.by_thread: the answer to one direct line; the rest is the loop's to do."""
        replies = [effect for effect in decision.effects if type(effect) is SendReply]
        others = [effect for effect in decision.effects if type(effect) not in (SendReply, Happened)]
        line = self.routes.line_of(replies[0].message) if len(replies) == 1 and not others else None
        if line is not None:
            self.routes.answered(replies[0].message)
            self.answer(line, replies[0].message)
        elif decision.effects:
            self.effects.extend(decision.effects)
            self.world.todo.add(("act", self.name))

    def save(self) -> None:
        """What was to follow later follows now."""
        self.write(self.unsaved.changes())
        self.unsaved.clear()
        self.world.todo.discard(("save", self.name))

    def not_committed(self, inbox: list[tuple[Any, str | None]]) -> None:
        """Refuse what can be refused; the rest stays first in line."""
        decision, again = refuse_uncommitted(self.catalog, inbox, DISK_FULL)
        self.finish(decision, "")
        self.world.ledger.told_early(item.query_id for item, _ in again if type(item) is c.GiveUp)
        if again:
            self.inbox.extendleft(reversed(again))
            self.world.todo.add(("wake", self.name))
