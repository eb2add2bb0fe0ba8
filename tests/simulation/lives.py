"""The lives of registrars in a simulated world: they are closed for good, or deleted, are absent from a run of the
system, and come back under the same id, or not before everything is mended.
"""

from __future__ import annotations

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.releasing import forgetting, owing
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Gone
from rr_actors.registrar.model.rows import OWED, Held, Hold, Notice, Peer, Resource
from simulation.network import DOWN
from simulation.sim_links import TO_PROVIDER
from simulation.sim_registrar import SimRegistrar
from simulation.users import People

CLOSING = Failure("RegistrarDown", "it is being closed")


class Closing:
    """How far the closing of a registrar has come, as in Node.wind_down."""

    def __init__(self) -> None:
        self.unloaded: set[str] = set()  # resources
        self.tried: set[str] = set()  # queries
        self.tickets: list[int] = []
        self.open: set[str] = set()  # releases that are not answered
        self.passes = 0  # over all that it holds


class Lives(People):
    """Steps: close, closing, delete, generation."""

    def close(self, name: str) -> bool:
        """A registrar is closed for good: from now on it refuses loads, and step by step gives back everything."""
        registrar = self.registrars[name]
        if registrar.state != "up" or registrar.closing is not None:
            return False
        registrar.closing = Closing()
        registrar.post(c.BeginClosing(CLOSING))
        self._withdraw(registrar)
        self.todo.add(("closing", name))
        return True

    def _withdraw(self, registrar: SimRegistrar) -> None:
        for query_id in list(registrar.waiters):
            if query_id in registrar.catalog.held or query_id in registrar.catalog.in_flight:
                registrar.post(c.GiveUp(query_id, CLOSING))

    def closing(self, name: str, late: bool = False) -> bool:
        """The next step of closing. `late`: the time for it is up."""
        registrar = self.registrars[name]
        closing = registrar.closing
        if ("closing", name) not in self.todo or closing is None or (registrar.inbox and not late):
            return False
        if late:
            self._release(
                registrar, [id for id in registrar.catalog.held if registrar.catalog.held[id].hold is not OWED]
            )
            while registrar.inbox and not registrar.disk_is_full:
                self.wake(name)
            return self._closed(name, late=True)
        if not all(self.ledger.answered[ticket] for ticket in closing.tickets):
            return False
        left = [id for id in registrar.catalog.resources if id not in closing.unloaded]
        if left and not closing.passes:
            closing.unloaded.update(left)
            for id in left:
                self.ledger.forced.add(id)
                ticket = self.new_ticket()
                closing.tickets.append(ticket)
                registrar.post(c.ForceUnload(id, self.new_event(), ticket, "it is being closed"))
            return True
        held = registrar.catalog.held
        if closing.open:
            return False
        closing.passes += 1
        queries = [id for id in held if id not in closing.tried and held[id].hold is Hold.HELD]
        self._release(registrar, queries)
        closing.tried.update(queries)
        if closing.passes == 1:
            registrar.post(c.BeginClosing(CLOSING, own=True))
            registrar.post(c.AddInFlight())
            self._withdraw(registrar)
        elif closing.passes > 2:
            return not self._unheard(registrar) and self._closed(name, late=False)
        return True

    def _unheard(self, registrar: SimRegistrar) -> set[str]:
        """The queries of which consumers with links are to hear something. Node waits for them for a while."""
        catalog = registrar.catalog
        return {
            catalog.notices[id].query_id for origin in catalog.consumers for id in catalog.notices_to.get(origin, ())
        }

    def closing_goes_on(self, name: str) -> bool:
        """Whether the next step of closing could be done now."""
        registrar = self.registrars[name]
        closing = registrar.closing
        if registrar.inbox or not all(self.ledger.answered[ticket] for ticket in closing.tickets):
            return False
        return not closing.open and not (closing.passes > 2 and self._unheard(registrar))

    def _release(self, registrar: SimRegistrar, ids: list[str]) -> None:
        for id in ids:
            if self.ledger.fate.get(id) == "held" and "/" not in id:
                self.ledger.letting(id)
            self.given_back.add(id)
            registrar.closing.open.add(id)
            registrar.post(c.Release(id))

    def _closed(self, name: str, *, late: bool) -> bool:
        registrar = self.registrars[name]
        if registrar.disk_is_full:
            return False
        self.unheard |= self._unheard(registrar)
        registrar.post(c.EndClosing())
        while registrar.inbox and not registrar.disk_is_full and name in self.registrars:
            self.wake(name)
        if registrar.state != "up":
            return True
        if not registrar.disk_is_full:
            registrar.save()
        for provider, peering in registrar.clients.items():
            if peering.reconciled and provider != name:
                registrar.send(peering.link, name, provider, TO_PROVIDER, Gone(name))
        self._leaves(name, late=late)
        return self.crash(name, "away")

    def _leaves(self, name: str, *, late: bool) -> None:
        """Nobody outside holds anything by it any more. `late`: there was no time to release all of it."""
        self.left.add(name)
        for query_id, holder in self.asker.items():
            if holder == name and self.ledger.fate[query_id] in ("asked", "held", "unanswered"):
                self.ledger.fate[query_id] = "unanswered" if late else "released"

    def delete(self, name: str) -> bool:
        """A registrar whose process was stopped is deleted: as given_up.give_up does."""
        registrar = self.registrars[name]
        if registrar.state != "stopped":
            return False
        notices = registrar.disk["notices"]
        self.ledger.deleted |= notices.keys()
        self.ledger.forced |= registrar.disk["resources"].keys()
        self.unheard |= registrar.disk["queries"].keys()  # those who are absent hear it when they are back
        self.unheard |= {notice.query_id for notice in notices.values() if notice.released}  # of these losses, too
        registrar.epoch += 1  # its catalog is opened
        registrar.write(owing(registrar.disk, registrar.epoch))
        self._leaves(name, late=False)
        for id, attempt in [place for place in self.ledger.parts if place[0] in registrar.disk["resources"]]:
            del self.ledger.parts[id, attempt]  # they are released without it
        registrar.state = "away"
        told: set[str] = set()
        for other in self.registrars.values():
            if other.state == "up" and not other.disk_is_full:
                other.receive(Gone(name), name)
                while other.inbox:
                    self.wake(other.name)
                told.add(other.name)
        registrar.epoch += 1
        registrar.write(forgetting(registrar.disk, name, self.registrars.keys() - told))
        self.ledger.deleted -= notices.keys()
        return True

    def generation(self, absent: tuple[str, ...]) -> bool:
        """The whole system is killed and started again, without some registrars."""
        for registrar in self.live():
            self.crash(registrar.name)
        for registrar in self.live():
            registrar.state = "absent" if registrar.name in absent else "down"
        return True

    def unreachable(self, provider: str, asked: bool) -> c.PeerGone | None:
        """What a consumer concludes about a provider, as in ProviderLink._try_once; None: nothing, it may come soon."""
        there = self.registrars[provider]
        rows = [row for table in there.disk.values() for row in table.values()]
        empty = there.state == "gone" or not any(isinstance(row, Held | Peer | Resource | Notice) for row in rows)
        if there.state in ("gone", "away") or (there.state == "absent" and empty):
            return c.PeerGone(provider, DOWN, True, self.new_event(), there.state != "away")
        if there.state in ("stopped", "absent") and asked:
            return c.PeerGone(provider, DOWN, False, self.new_event())
        return None

    def is_gone(self, name: str) -> bool:
        """Whether the directory says that a registrar is gone for good."""
        return name in self.retired or self.registrars[name].state == "away"
