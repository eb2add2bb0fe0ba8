"""A budget in a small world: the real planner decides about shares whose rows are in the real core.

A share is a resource of the registrar "budgets". Its request is its amount and a name: b"2 lamp". As in Budgets, its
load ends when the planner admits it, and its room is free when it has been unloaded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from rr_actors.managers.budgets.planner import AskedShare, BudgetPlan, HeldShare, plan
from rr_actors.managers.budgets.pools import POLICY
from rr_actors.registrar.model.rows import STANDBY, Phase, Resource
from simulation.oracle import Violation
from simulation.pending_steps import Key
from simulation.world import Step, World

NAME = "budgets"


class Book(NamedTuple):
    """The shares that were admitted, oldest first, and those of them that were revoked."""

    admitted: tuple[str, ...] = ()
    leaving: frozenset[str] = frozenset()


class Budget(NamedTuple):
    """A pool of this capacity, and the planner: the real one, or one with a defect."""

    capacity: float
    planner: Callable[..., BudgetPlan] = plan

    def decides(self, key: Key) -> bool:
        """Return whether this step is the end of a load of a share."""
        return key[:3] == ("call", NAME, "load")

    def moves(self, world: World, book: Book) -> Iterator[tuple[Step, Book]]:
        """Return what the planner does now: each share that it admits, and each that it revokes."""
        book = _there(world, book)
        made, asking = self._planned(world, book), _asking(world)
        for id in made.admit:
            yield (*asking[id], "ok"), book._replace(admitted=(*book.admitted, id))
        for id in made.revoke:
            if _shares(world)[id].phase is Phase.LOADED:  # else Budgets tries again
                yield ("own", NAME, "revoke", id), book._replace(leaving=book.leaving | {id})

    def check(self, world: World, book: Book) -> None:
        """Check that the shares that are there do not exceed the capacity, and that the planner is right now.

        Raises:
            Violation: they do, or it is not.
        """
        amounts = [_amount(one) for one in _shares(world).values() if one.phase in (Phase.LOADED, Phase.UNLOADING)]
        if sum(amounts) > self.capacity:
            raise Violation("sum", f"{amounts} are more than {self.capacity:g}")
        if world.registrars[NAME].state == "up":
            book = _there(world, book)
            self._check_victims(world, book, self._planned(world, book))

    def _check_victims(self, world: World, book: Book, made: BudgetPlan) -> None:
        """Check that each victim is needed for somebody of higher priority, and that who fits does not wait."""
        shares, ranks = _shares(world), world.registrars[NAME].catalog.priority_of
        gone = book.leaving | {*made.revoke}
        stay = [id for id in (*book.admitted, *made.admit) if id not in gone]
        free = self.capacity - sum(_amount(shares[id]) for id in stay)
        waits = [id for id in made.wait if id in shares]
        for victim in made.revoke:
            above = [id for id in waits if ranks(id) > ranks(victim)]
            if not above:
                raise Violation("victims", f"{victim} gives way to nobody above it")
            if free - sum(_amount(shares[id]) for id in above) >= _amount(shares[victim]):
                raise Violation("victims", f"{victim} is one too many")
        if not gone and any(_amount(shares[id]) <= free for id in waits):
            raise Violation("waiting", f"{waits} wait, and {free:g} is free")

    def _planned(self, world: World, book: Book) -> BudgetPlan:
        shares = _shares(world)
        running = [
            HeldShare(id, _amount(shares[id]), _priority(world, id), at, id in book.leaving)
            for at, id in enumerate(book.admitted)
        ]
        asked = [
            AskedShare(id, _amount(shares[id]), _priority(world, id), at)
            for at, id in enumerate(_asking(world))
            if id in shares
        ]
        return self.planner(self.capacity, POLICY, running, asked)


def _there(world: World, book: Book) -> Book:
    """Return the book without the shares that have gone."""
    shares = _shares(world)
    return Book(tuple(id for id in book.admitted if id in shares), frozenset(book.leaving & shares.keys()))


def _asking(world: World) -> dict[str, Key]:
    """Return the loads of shares that run, by resource."""
    runs = world.registrars[NAME].runs
    return {runs[key].id: key for key in sorted(runs, key=repr) if key[2] == "load"}


def _shares(world: World) -> dict[str, Resource]:
    return world.registrars[NAME].catalog.resources


def _amount(share: Resource) -> float:
    return float(share.request.split()[0])


def _priority(world: World, id: str) -> int | None:
    rank = world.registrars[NAME].catalog.priority_of(id)
    return None if rank <= STANDBY else rank
