"""WorldState: what there is in a simulated world."""

from __future__ import annotations

from typing import Any

from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.rows import Held, Phase, Resource, State
from simulation.oracle import Ledger
from simulation.pending_steps import Todo
from simulation.sim_links import TO_CONSUMER, SimLine, SimLink
from simulation.sim_process import SimShell
from simulation.sim_registrar import SimRegistrar


class WorldState:
    """Registrars, links, what can happen next, and what the outside has seen.

    Args:
        layout: the servers of each registrar, by its name.
        factory: makes a registrar; tests put broken ones in.
        hasty: registrars that decide everything as it comes in; the others when they are woken.
        rates: how fast the clock of each host goes, if there are hosts.
    """

    def __init__(
        self,
        layout: dict[str, tuple[Server, ...]],
        factory: Any = SimRegistrar,
        hasty: frozenset[str] = frozenset(),
        rates: dict[str, float] | None = None,
    ) -> None:
        self.layout = layout
        self.hasty = hasty
        self.todo = Todo()
        self.ledger = Ledger()
        self.lines: dict[str, SimLine] = {}
        self.old: dict[tuple[str, str], SimLink] = {}
        self.apart: frozenset[str] = frozenset()  # those on one side of a partition
        self.held_up = False  # what crosses it is not lost, but does not arrive before it heals
        self.events = 0
        self.tickets = 0
        self.trace: list[str] | None = None
        self.retired: set[str] = set()
        self.given_back: set[str] = set()  # released by closing, also parts of what could not be unloaded
        self.unheard: set[str] = set()  # queries whose provider has closed before their holder had heard that it does
        self.left: set[str] = set()  # those that were closed for good, or deleted, and may come back
        self.letting: dict[str, str] = {}  # query -> who waits for its unload
        self.asker: dict[str, str] = {}
        self.registrars: dict[str, SimRegistrar] = {
            name: factory(self, name, servers) for name, servers in layout.items()
        }
        self.begin_hosts(rates or {})
        for registrar in self.registrars.values():
            registrar.start()

    def begin_hosts(self, rates: dict[str, float]) -> None:
        """Give each host its gateway."""
        raise AssertionError(rates)

    def run_of(self, consumer: str, provider: str) -> int:
        """Return the epoch of a provider as a consumer knows it."""
        raise AssertionError(consumer, provider)

    def wake(self, name: str, count: int = 1_000_000, fault: str = "", effects: int = 0) -> bool:
        """A registrar handles what came in."""
        raise AssertionError(name, count, fault, effects)

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

    def parted(self, one: str, other: str) -> bool:
        """Whether a partition lies between two registrars."""
        return (one in self.apart) is not (other in self.apart)

    def has_line(self, query_id: str) -> bool:
        """Whether a thread waits for an answer about it on a line of its own."""
        line = self.lines.get(query_id)
        return line is not None and not line.left

    def leave_line(self, query_id: str) -> None:
        """Its thread does not wait for its answer any more."""
        if self.has_line(query_id):
            self.lines[query_id].left = True
            self.todo.discard(("line", query_id, TO_CONSUMER))

    def live(self) -> list[SimRegistrar]:
        """Those that are not gone for good."""
        return [registrar for registrar in self.registrars.values() if registrar.state != "gone"]

    def dependent(self) -> dict[str, int]:
        """The resources that are loaded and have not dealt with a status, and the attempts of their loads.

        One that is FATAL does not depend on its parts any more.
        """
        dealt = {id for id, _ in self.ledger.handled}
        rows = [
            (registrar.name, row)
            for registrar in self.live()
            if registrar.name not in self.left
            for row in registrar.disk["resources"].values()
            if isinstance(row, Resource) and row.id not in dealt and row.state is not State.FATAL
        ]
        lives = self.ledger.lives
        return {
            row.id: row.attempt
            for name, row in rows
            if (name, row.id) in lives and lives[name, row.id].stage == "loaded"
        }

    def lingering(self, registrar: SimShell, resource_id: str) -> bool:
        """Whether an unheld resource is kept warm."""
        resource = registrar.catalog.resources[resource_id]
        return resource.phase is Phase.LOADED and ("linger:" + resource_id) in registrar.timers

    def may_be_lost(self, consumer: SimShell, held: Held) -> bool:
        """Whether a query may be said to be lost though no owner took it away."""
        gone = self.retired | self.left
        return held.registrar in gone or consumer.name in gone or held.id in self.ledger.losses
