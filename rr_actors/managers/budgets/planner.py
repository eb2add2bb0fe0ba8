"""The planner: decides who may have a share of a pool, and who has to give one back. Pure.

It looks at everybody who asks at once, the highest priority first, then the oldest. Who fits is admitted. For who does
not, the steps of the pool's policy make room, and the room that they make is his: nobody who comes later gets it. The
least priority makes no room for itself: a share that has it takes what is free, or nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import msgspec

from rr_actors.managers.budgets.victims import fewest_newest, first_that_do, total
from rr_actors.registrar.model.rows import LOWEST

Step = Literal["reclaim", "supply", "preempt", "wait"]
LEAST = LOWEST
"""The priority that makes no room for itself, and that a supply needs more than: what has it may be paused soon."""
_IDLE = -math.inf
_TOLERANCE = 1e-9  # of the capacity: 0.1 + 0.2 fits into 0.3


class HeldShare(msgspec.Struct, frozen=True):
    """A share that is held. `since` orders shares by age; `priority` None is idle; `leaving`: it is revoked already."""

    id: str
    amount: float
    priority: int | None = 0
    since: float = 0.0
    leaving: bool = False


class AskedShare(msgspec.Struct, frozen=True):
    """A share that is asked for.

    Attributes:
        patient: it may still wait. The steps of the policy after "wait" are for who may not.
        holds: it has waited so long that nobody who comes after it is admitted before it.
    """

    id: str
    amount: float
    priority: int | None = 0
    since: float = 0.0
    patient: bool = True
    holds: bool = False


class SpareReserve(msgspec.Struct, frozen=True):
    """A reserve that could add to the capacity. What an `on` one adds is in the capacity already.

    A `late` one has been starting for so long that what is over the capacity cannot wait for it. Without `may_stop`, it
    has not been on for long enough.
    """

    id: str
    amount: float
    state: Literal["off", "starting", "late", "on"] = "off"
    may_stop: bool = True


class BudgetPlan(msgspec.Struct):
    """What to do, by ids.

    Attributes:
        admit: who asked and gets a share now.
        start, stop: reserves.
        revoke: shares to revoke.
        wait: who asked and goes on waiting, for room that is being made, or for others to release theirs.
        refuse: who asked and gets nothing.
        free: how much each who asked could have at once: without what others have, or are to get before.
    """

    admit: list[str] = []
    start: list[str] = []
    stop: list[str] = []
    revoke: list[str] = []
    wait: list[str] = []
    refuse: list[str] = []
    free: dict[str, float] = {}


def plan(
    capacity: float,
    policy: Sequence[Step],
    running: Sequence[HeldShare],
    asked: Sequence[AskedShare] = (),
    reserves: Sequence[SpareReserve] = (),
) -> BudgetPlan:
    """Return what is to be done in one pool.

    No victim has the priority of the one that gets its room, or a higher one, unless the capacity has become less than
    what runs. Then the lowest are shed, whatever the policy is. `capacity` includes every supply that is on.

    A reserve may fail to start. So as long as room for somebody depends on one that is starting, the steps after
    "supply" revoke nobody for it: that might not help. Nor is anybody revoked for those who come after him. To shed,
    all is done at once.
    """
    planning = _Planning(capacity, running, reserves)
    planning.shed()
    for one in sorted(asked, key=lambda one: (-_rank(one.priority), one.since)):
        planning.place(one, policy)
    planning.rest()
    return planning.made


def urgencies(
    capacity: float, running: Sequence[HeldShare], asked: Sequence[AskedShare], reserves: Sequence[SpareReserve]
) -> dict[str, int]:
    """Return how urgent each reserve is that is on or starting: as the most urgent share that would not fit without it.

    Without a reserve, those that are preferred to it are still there. A share that does not fit with all of them counts
    for none. A reserve that nobody needs has the priority above the least, as it still gives.

    Args:
        capacity: without the reserves.
        running, asked: the shares that stay, and those that wait.
    """
    used = [spare for spare in reserves if spare.state != "off"]
    slack = (capacity + total(reserves)) * _TOLERANCE
    most = capacity + total(used) + slack
    sums: list[tuple[float, float]] = []  # with each share, the most urgent first: the sum so far, and its rank
    needed = 0.0
    for share in sorted([*running, *asked], key=lambda one: (-_rank(one.priority), one.since)):
        if isinstance(share, AskedShare) and needed + share.amount > most:
            continue
        needed += share.amount
        sums.append((needed, _rank(share.priority)))
    found: dict[str, int] = {}
    for spare in used:
        rank = next((rank for needed, rank in sums if needed > capacity + slack), _IDLE)
        found[spare.id] = int(max(rank, LEAST + 1))
        capacity += spare.amount
    return found


def _rank(priority: int | None) -> float:
    return _IDLE if priority is None else priority


class _Room(NamedTuple):
    """Shares that are to be revoked, by steps of the policy before "supply", and by later ones."""

    first: list[HeldShare]
    later: list[HeldShare]


class _Planning:
    """One run of the planner.

    Attributes:
        free: what is free now.
        ahead: what will be free for those who have not been looked at, when all that is begun has ended.
        coming: the part of `ahead` that depends on reserves that are starting.
        holding: somebody waits for a reserve first.
    """

    def __init__(self, capacity: float, running: Sequence[HeldShare], reserves: Sequence[SpareReserve]) -> None:
        self.made = BudgetPlan()
        self._reserves = reserves
        self._off = [spare for spare in reserves if spare.state == "off"]
        self._slack = (capacity + total(reserves)) * _TOLERANCE
        self._levels: dict[float, list[HeldShare]] = {}  # what may be revoked, by priority
        for share in running:
            if not share.leaving:
                self._levels.setdefault(_rank(share.priority), []).append(share)
        self._amounts = {rank: total(shares) for rank, shares in self._levels.items()}
        self.free = capacity - total(running)
        self._late = total([spare for spare in reserves if spare.state == "late"])
        self.coming = total([spare for spare in reserves if spare.state == "starting"]) + self._late
        self.ahead = capacity - math.fsum(self._amounts.values()) + self.coming

        self.holding = False

    def shed(self) -> None:
        """Make room for what runs already, if the capacity has become less."""
        need = self._late - self.ahead - self._slack
        if need <= 0:
            return
        room = self._make_room(need, math.inf, ("reclaim", "supply", "preempt"))
        if room is None:  # all there is
            room = _Room([], [share for _, level in sorted(self._levels.items()) for share in reversed(level)])
            self.ahead += total(room.later)
            self._levels, self._amounts = {}, {}
            self._start(list(self._off))
        self._revoke(room.first + room.later)

    def place(self, one: AskedShare, policy: Sequence[Step]) -> None:
        """Admit one, or make room for it, or let it wait, or refuse it."""
        self.made.free[one.id] = max(0.0, min(self.free, self.ahead))
        need = one.amount - self.ahead - self._slack
        waits = one.patient and "wait" in policy
        steps = policy[: policy.index("wait")] if waits else policy
        room = self._make_room(need, _rank(one.priority), steps) if need > 0 else _Room([], [])
        if room is None:
            (self.made.wait if waits else self.made.refuse).append(one.id)
            if waits and one.holds:
                self.free -= one.amount
                self.ahead -= one.amount
            return
        if not self.holding:
            self._revoke(room.first)
        depends = one.amount - (self.ahead - self.coming)
        self.holding = self.holding or depends > self._slack
        if not self.holding:
            self._revoke(room.later)
        self.coming -= max(0.0, depends)
        self.ahead -= one.amount
        if one.amount <= self.free + self._slack:
            self.free -= one.amount
            self.made.admit.append(one.id)
        else:
            self.made.wait.append(one.id)

    def rest(self) -> None:
        """Stop the reserves that nobody needs, the last first."""
        if self.made.wait or self.made.start:
            return
        spare_room = min(self.free, self.ahead)
        for spare in reversed(self._reserves):
            if spare.state == "on" and spare.may_stop and spare.amount <= spare_room + self._slack:
                self.made.stop.append(spare.id)
                spare_room -= spare.amount

    def _make_room(self, need: float, rank: float, policy: Sequence[Step]) -> _Room | None:
        """Start reserves, and choose shares, that make `need` more room for somebody of this rank.

        Return None if nothing makes as much; then nothing is started.

        The groups of what may make room are in the order of their use. All before the last one that is needed are
        taken for granted while as little as possible of the last is chosen, and so on back to the first.
        """
        groups = self._groups(rank, policy)
        amounts: list[float] = []
        while math.fsum(amounts) < need:
            if len(amounts) == len(groups):
                return None
            level = groups[len(amounts)]
            amounts.append(total(self._off) if level is None else self._amounts[level])
        room = _Room([], [])
        for level in reversed(groups[: len(amounts)]):
            amounts.pop()
            missing = need - math.fsum(amounts)
            if missing <= 0:
                continue
            if level is None:
                need -= self._use_reserves(missing)
                continue
            victims = self._victims(level, missing)
            need -= total(victims)
            (room.later if None in groups[: len(amounts)] else room.first).extend(victims)
        return room

    def _groups(self, rank: float, policy: Sequence[Step]) -> list[float | None]:
        """Return the priorities that may give way to this rank, and None for the reserves, in the policy's order."""
        if rank <= LEAST:
            return []
        lower = sorted(level for level in self._levels if level < rank)
        groups: list[float | None] = []
        for step in policy:
            if step == "reclaim":
                groups += [level for level in lower if level == _IDLE and level not in groups]
            elif step == "supply":
                groups.append(None)
            elif step == "preempt":
                groups += [level for level in lower if level not in groups]
        return groups

    def _use_reserves(self, need: float) -> float:
        chosen = first_that_do(self._off, need)
        self._start(chosen)
        return total(chosen)

    def _start(self, spares: list[SpareReserve]) -> None:
        self._off = [spare for spare in self._off if spare not in spares]
        self.made.start += [spare.id for spare in spares]
        self.coming += total(spares)
        self.ahead += total(spares)

    def _revoke(self, shares: list[HeldShare]) -> None:
        self.made.revoke += [share.id for share in shares]

    def _victims(self, level: float, need: float) -> list[HeldShare]:
        shares = sorted(self._levels[level], key=lambda share: share.since)
        chosen = fewest_newest(shares, need)
        ids = {share.id for share in chosen}
        self._levels[level] = [share for share in shares if share.id not in ids]
        self._amounts[level] = total(self._levels[level])
        self.ahead += total(chosen)
        return chosen
