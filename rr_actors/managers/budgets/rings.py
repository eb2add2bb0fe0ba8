"""Rings: resources that hold a share of one pool each, and wait for one of another. Pure.

X has a share of pool "a" and waits for "b", Y has one of "b" and waits for "a": neither gets on, and neither lets
go. So one of them is refused at once: the least urgent one, and of equals the one that has waited least.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec


class RingHold(msgspec.Struct, frozen=True):
    """A share that `whole`, a resource, has of a pool. `leaving`: it is revoked."""

    pool: str
    whole: str
    amount: float
    leaving: bool = False


class RingWait(msgspec.Struct, frozen=True):
    """A share of a pool that `whole` waits for."""

    id: str
    pool: str
    whole: str
    amount: float
    priority: int | None = 0
    since: float = 0.0


def one_to_refuse(
    most: Mapping[str, float], holds: Sequence[RingHold], waits: Sequence[RingWait]
) -> tuple[RingWait, ...]:
    """Return a ring of waiting, the wait to be refused first; () if there is none.

    A share can be released if the resource that has it waits for nothing, or for what it can get. What cannot be got
    although all these are released is in a ring, or waits for one.

    Args:
        most: what each pool can have, with all of its reserves.
    """
    holding = {hold.whole for hold in holds if hold.whole and not hold.leaving}
    left = list(waits) if any(wait.whole in holding for wait in waits) else []
    while left:
        stuck = {wait.whole for wait in left} & holding
        kept = dict.fromkeys(most, 0.0)
        for hold in holds:
            if hold.whole in stuck and not hold.leaving:
                kept[hold.pool] += hold.amount
        still = [wait for wait in left if wait.amount > (most[wait.pool] - kept[wait.pool]) * (1 + 1e-9)]
        if len(still) == len(left):
            break
        left = still
    in_ring = [wait for wait in left if wait.whole in holding]
    return tuple(sorted(in_ring, key=lambda wait: (_rank(wait.priority), -wait.since)))


def without_ground(holds: Sequence[RingHold], waits: Sequence[RingWait]) -> list[RingWait]:
    """Return the waits of resources that lose a share that they have: they will never get the rest."""
    losing = {hold.whole for hold in holds if hold.leaving and hold.whole}
    return [wait for wait in waits if wait.whole in losing]


def _rank(priority: int | None) -> float:
    return -math.inf if priority is None else priority
