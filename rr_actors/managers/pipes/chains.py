"""Chains: which components make a pipe, which chain is the best, and what can stand in a place of one. Without IO.

A chain begins with a component that takes nothing. Each other one takes something, and all of that is given by the one
before. The best chain has the greatest product of reliabilities; of equal ones the shorter, then the first described.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import pairwise

import msgspec

LEAST_TRUST = 1e-9  # what counts less counts as this: else all chains with one that is not trusted would be equal


class ChainComponent(msgspec.Struct, frozen=True):
    """A component as the planner sees it: what it takes and gives, and how far it is trusted now, from 0 to 1."""

    name: str
    type: str
    inputs: frozenset[str]
    outputs: frozenset[str]
    trust: float = 1.0


class PipeStep(msgspec.Struct, frozen=True):
    """One segment of a pipe that a file describes: any component of the type that takes and gives at least this."""

    type: str
    inputs: frozenset[str] = frozenset()
    outputs: frozenset[str] = frozenset()

    def allows(self, link: ChainComponent) -> bool:
        """Return whether the component can be this segment."""
        return link.type == self.type and self.inputs <= link.inputs and self.outputs <= link.outputs


Way = tuple[PipeStep, ...]


class Goal(msgspec.Struct, frozen=True):
    """What a pipe is to be: one of the ways, or without any, a chain whose last component gives `of_type`."""

    of_type: str
    ways: tuple[Way, ...] = ()

    def is_met_by(self, chain: Sequence[ChainComponent]) -> bool:
        """Return whether the chain is one, and ends in what is asked for."""
        joined = all(_follows(one, after) for one, after in pairwise(chain))
        if not chain or chain[0].inputs or not joined:
            return False
        return any(_goes(way, chain) for way in self.ways) if self.ways else self.of_type in chain[-1].outputs


def best_chain(links: Sequence[ChainComponent], goal: Goal) -> tuple[ChainComponent, ...] | None:
    """Return the best chain that meets the goal; None if there is none.

    This is Dijkstra's search. A longer chain is never more reliable, so the first that is found is the best. For the
    same reason the first that comes to a component is the best one up to there.
    """
    return _Search(links, goal).run()


def substitutes(
    links: Iterable[ChainComponent], before: Sequence[ChainComponent], after: Sequence[ChainComponent], goal: Goal
) -> list[ChainComponent]:
    """Return the components that can stand between two parts of a chain, the most reliable first.

    None that is in one of the parts: it may be a device that cannot run twice.
    """
    others = {link.name for link in (*before, *after)}
    found = [one for one in links if one.name not in others and goal.is_met_by((*before, one, *after))]
    return sorted(found, key=lambda link: -link.trust)


def why_none(links: Sequence[ChainComponent], goal: Goal) -> list[str]:
    """Return, for a goal that no chain meets, what is missing for each way to it."""
    if goal.ways:
        return [_missing_on(way, links) for way in goal.ways]
    givers = [link for link in links if goal.of_type in link.outputs]
    return [f"{one.name} takes {_listed(one.inputs)}: no chain of components gives that" for one in givers]


def _missing_on(way: Way, links: Sequence[ChainComponent]) -> str:
    for i, step in enumerate(way):
        if not any(step.allows(link) for link in links):
            needs = f"takes {_listed(step.inputs)} and gives {_listed(step.outputs)}"
            return f"segment {i}: there is no component of type {step.type!r} that {needs}"
    return f"{', '.join(step.type for step in way)}: no components of these types fit each other"


def _listed(types: Iterable[str]) -> str:
    return ", ".join(sorted(types)) or "nothing"


def _follows(one: ChainComponent, after: ChainComponent) -> bool:
    return bool(after.inputs) and after.inputs <= one.outputs


def _goes(way: Way, chain: Sequence[ChainComponent]) -> bool:
    return len(way) == len(chain) and all(step.allows(link) for step, link in zip(way, chain, strict=True))


_Found = tuple[Fraction, int, tuple[int, ...], int]
"""A chain in the order of the search: its reliability, negative; its length; places in the list; the way's number."""


class _Search:
    def __init__(self, links: Sequence[ChainComponent], goal: Goal) -> None:
        self._links, self._goal = links, goal
        # Fractions are exact: rounded products of different chains might be equal, and the order would be lost.
        self._weights = [Fraction(max(link.trust, LEAST_TRUST)) for link in links]
        self._reached: dict[tuple[int, int], set[int]] = {}
        self._takers: dict[str, list[int]] = {}
        for i, link in enumerate(links):
            if link.inputs:
                self._takers.setdefault(min(link.inputs), []).append(i)

    def run(self) -> tuple[ChainComponent, ...] | None:
        queue = list(self._begun())
        heapq.heapify(queue)
        while queue:
            found = heapq.heappop(queue)
            if self._is_end(found):
                return tuple(self._links[i] for i in found[2])
            for longer in self._longer(found):
                heapq.heappush(queue, longer)
        return None

    def _begun(self) -> Iterator[_Found]:
        for way in range(len(self._goal.ways) or 1):
            for i, link in enumerate(self._links):
                if not link.inputs and self._allows(way, 0, link):
                    yield -self._weights[i], 1, (i,), way

    def _longer(self, found: _Found) -> Iterator[_Found]:
        """Continue a chain by each component that no better one has come to in this place."""
        cost, length, path, way = found
        last = self._links[path[-1]]
        reached = self._reached.setdefault((way, length if self._goal.ways else 0), set())
        for i in (i for type in last.outputs for i in self._takers.get(type, ()) if i not in reached):
            if _follows(last, self._links[i]) and self._allows(way, length, self._links[i]):
                reached.add(i)
                yield cost * self._weights[i], length + 1, (*path, i), way

    def _allows(self, way: int, place: int, link: ChainComponent) -> bool:
        ways = self._goal.ways
        return not ways or (place < len(ways[way]) and ways[way][place].allows(link))

    def _is_end(self, found: _Found) -> bool:
        _, length, path, way = found
        if self._goal.ways:
            return length == len(self._goal.ways[way])
        return self._goal.of_type in self._links[path[-1]].outputs
