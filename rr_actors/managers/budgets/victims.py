"""The choice of what makes room: the lowest priority first, then the fewest, then the newest. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol, TypeVar


class Sized(Protocol):
    """Something that makes room by its amount."""

    @property
    def amount(self) -> float:
        """How much room it makes."""
        ...


_S = TypeVar("_S", bound=Sized)


def total(things: Sequence[Sized]) -> float:
    """Return the sum of the amounts."""
    return math.fsum(thing.amount for thing in things)


def first_that_do(things: Sequence[_S], need: float) -> list[_S]:
    """Return the first of the things that give `need` together, without those of them that are not needed."""
    chosen: list[_S] = []
    for thing in things:
        if need <= 0:
            break
        chosen.append(thing)
        need -= thing.amount
    for thing in list(chosen):  # need is 0 or less now: what is over may cover one of them
        if need + thing.amount <= 0:
            chosen.remove(thing)
            need += thing.amount
    return chosen


def fewest_newest(things: Sequence[_S], need: float) -> list[_S]:
    """Return the fewest of the things that give `need` together; of all such sets the newest. The last is the newest.

    The largest ones tell how many are needed. Then each thing, the newest first, is taken if enough is left when the
    largest of the others fill the other places. Only the smallest of the largest makes room for one that is not among
    them, so each thing is looked at once.
    """
    by_amount = sorted(range(len(things)), key=lambda index: -things[index].amount)
    largest: list[int] = []
    spare = -need
    for index in by_amount:
        if spare >= 0:
            break
        largest.append(index)
        spare += things[index].amount
    places, among = len(largest), set(largest)
    taken: list[int] = []
    for index in range(len(things) - 1, -1, -1):
        if len(taken) == places:
            break
        if index in among:
            among.remove(index)
            taken.append(index)
            continue
        while largest and largest[-1] not in among:
            largest.pop()
        cost = things[largest[-1]].amount - things[index].amount
        if cost <= spare:
            spare -= cost
            among.remove(largest.pop())
            taken.append(index)
    return [things[index] for index in taken]
