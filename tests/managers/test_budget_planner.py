"""The planner of budgets: who gets a share, and who gives way."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rr_actors.managers.budgets.planner import LEAST, AskedShare, BudgetPlan, HeldShare, SpareReserve, Step, urgencies
from rr_actors.managers.budgets.planner import plan as plan_with_free
from support_steps import steps_of

ALL: tuple[Step, ...] = ("reclaim", "supply", "preempt", "wait")


def running(*shares: tuple[float, int | None], since: int = 0) -> list[HeldShare]:
    return [HeldShare(f"r{i}", amount, priority, since + i) for i, (amount, priority) in enumerate(shares)]


def plan(
    capacity: float,
    policy: Sequence[Step],
    running: Sequence[HeldShare],
    asked: Sequence[AskedShare] = (),
    reserves: Sequence[SpareReserve] = (),
) -> BudgetPlan:
    """Return what is to be done, without what is free for each."""
    made = plan_with_free(capacity, policy, running, asked, reserves)
    assert made.free.keys() == {one.id for one in asked}
    made.free = {}
    return made


def rank(priority: int | None) -> float:
    return -math.inf if priority is None else priority


TABLE = [
    # asked, running, reserves, policy, then the plan
    ((40, 0), [(60, 0)], [], ALL, BudgetPlan(admit=["a"])),
    ((0.3, 0), [(99.7, 0)], [], ALL, BudgetPlan(admit=["a"])),
    ((41, 0), [(60, 0)], [], ALL, BudgetPlan(wait=["a"])),
    ((41, 0), [(60, 0)], [], ("preempt",), BudgetPlan(refuse=["a"])),
    ((41, 1), [(60, 0)], [], ALL, BudgetPlan(revoke=["r0"], wait=["a"])),
    ((41, 1), [(60, 0)], [], ("wait",), BudgetPlan(wait=["a"])),
    # idle ones first, but not for one that is idle itself
    ((50, 0), [(50, None), (50, -5)], [], ALL, BudgetPlan(revoke=["r0"], wait=["a"])),
    ((50, None), [(50, None), (50, -5)], [], ALL, BudgetPlan(wait=["a"])),
    # a reserve before anybody who is not idle
    ((50, 9), [(100, 1)], [50], ALL, BudgetPlan(start=["s0"], wait=["a"])),
    ((50, 9), [(100, 1)], [20, 50], ALL, BudgetPlan(start=["s1"], wait=["a"])),
    ((50, 9), [(100, 1)], [20], ALL, BudgetPlan(revoke=["r0"], wait=["a"])),
    # one that is not enough alone starts first
    ((50, 9), [(30, 1), (70, 9)], [20], ALL, BudgetPlan(start=["s0"], wait=["a"])),
    ((50, 9), [(30, 1), (70, 9)], [20], ("preempt", "supply"), BudgetPlan(start=["s0"], revoke=["r0"], wait=["a"])),
    ((50, 9), [(30, None), (70, 9)], [20], ALL, BudgetPlan(start=["s0"], revoke=["r0"], wait=["a"])),
    # the lowest, then the fewest, then the newest
    ((30, 9), [(50, 2), (50, 1)], [], ALL, BudgetPlan(revoke=["r1"], wait=["a"])),
    ((30, 9), [(30, 1), (10, 1), (10, 1), (10, 1), (40, 3)], [], ALL, BudgetPlan(revoke=["r0"], wait=["a"])),
    ((30, 9), [(30, 1), (30, 1), (40, 1)], [], ALL, BudgetPlan(revoke=["r2"], wait=["a"])),
    ((40, 9), [(30, 1), (30, 1), (40, 3)], [], ALL, BudgetPlan(revoke=["r1", "r0"], wait=["a"])),
    # a low one that is not needed any more is spared
    ((50, 9), [(10, 1), (50, 2), (40, 9)], [], ALL, BudgetPlan(revoke=["r1"], wait=["a"])),
]


@pytest.mark.parametrize(("asked", "shares", "spares", "policy", "expected"), TABLE)
def test_one_that_asks(
    asked: tuple[float, int | None],
    shares: list[tuple[float, int | None]],
    spares: list[float],
    policy: tuple[Step, ...],
    expected: BudgetPlan,
) -> None:
    reserves = [SpareReserve(f"s{i}", amount) for i, amount in enumerate(spares)]

    assert plan(100, policy, running(*shares), [AskedShare("a", *asked)], reserves) == expected


def test_the_highest_priority_is_placed_first_then_the_oldest() -> None:
    asked = [AskedShare("late", 60, 1, 3), AskedShare("early", 60, 1, 2), AskedShare("high", 30, 5, 9)]

    assert plan(100, ALL, [], asked) == BudgetPlan(admit=["high", "early"], wait=["late"])


def test_room_that_is_promised_to_others_is_not_free() -> None:
    leaving = HeldShare("r0", 60, 1, leaving=True)
    asked = [AskedShare("first", 70, 5), AskedShare("small", 10, 2), AskedShare("last", 50, 1, patient=False)]

    made = plan_with_free(100, ("wait",), [leaving, HeldShare("r1", 15, 9)], asked)

    assert (made.wait, made.admit, made.refuse) == (["first"], ["small"], ["last"])
    assert made.free == {"first": 25, "small": 15, "last": 5}


def test_room_that_is_made_is_for_the_one_it_is_made_for() -> None:
    leaving = HeldShare("r0", 60, 1, leaving=True)

    made = plan(
        100,
        ALL,
        [leaving, HeldShare("r1", 20, 9)],
        [AskedShare("a", 70, 5), AskedShare("b", 20, 0), AskedShare("c", 10, 0)],
    )

    assert made == BudgetPlan(admit=["c"], wait=["a", "b"])


def test_one_that_has_waited_long_enough_is_refused_unless_room_is_being_made_for_it() -> None:
    leaving = HeldShare("r0", 60, 1, leaving=True)
    late = AskedShare("a", 60, 5, patient=False)

    assert plan(100, ALL, [leaving, HeldShare("r1", 40, 9)], [late]) == BudgetPlan(wait=["a"])
    assert plan(100, ALL, [HeldShare("r1", 50, 9)], [late]) == BudgetPlan(refuse=["a"])


def test_as_long_as_room_depends_on_a_reserve_that_may_fail_nobody_is_revoked_for_it() -> None:
    shares, asked = running((30, 1), (70, 9)), [AskedShare("a", 50, 9, patient=False)]

    assert plan(100, ALL, shares, asked, [SpareReserve("s0", 20, "starting")]) == BudgetPlan(wait=["a"])
    assert plan(100, ALL, shares, asked, [SpareReserve("s0", 20, "late")]) == BudgetPlan(wait=["a"])
    assert plan(120, ALL, shares, asked, [SpareReserve("s0", 20, "on")]) == BudgetPlan(revoke=["r0"], wait=["a"])
    assert plan(100, ALL, shares, asked) == BudgetPlan(refuse=["a"])
    after = [AskedShare("b", 30, 5), AskedShare("z", 20, 9)]
    assert plan(100, ALL, shares, after, [SpareReserve("s0", 20, "starting")]) == BudgetPlan(wait=["z", "b"])
    assert plan(120, ALL, shares, after, [SpareReserve("s0", 20, "on")]) == BudgetPlan(
        admit=["z"], revoke=["r0"], wait=["b"]
    )


def test_what_is_over_the_capacity_waits_for_a_reserve_unless_it_is_late() -> None:
    shares = running((30, 1), (70, 9))

    assert plan(80, ALL, shares, reserves=[SpareReserve("s0", 20, "starting")]) == BudgetPlan()
    assert plan(80, ALL, shares, reserves=[SpareReserve("s0", 20, "late")]) == BudgetPlan(revoke=["r0"])
    assert plan(50, ALL, shares, reserves=[SpareReserve("s0", 20)]) == BudgetPlan(start=["s0"], revoke=["r0"])


def test_a_capacity_that_has_become_less_sheds_the_lowest_whatever_the_policy_is() -> None:
    shares = running((30, 1), (30, 9), (30, 5))

    assert plan(60, ("wait",), shares) == BudgetPlan(revoke=["r0"])
    assert plan(-9, ("wait",), shares).revoke == ["r0", "r2", "r1"]
    assert plan(0, ("wait",), shares).revoke == ["r1", "r2", "r0"]
    assert plan(60, ALL, shares, reserves=[SpareReserve("s0", 30)]) == BudgetPlan(start=["s0"])
    assert plan(60, ALL, shares, reserves=[SpareReserve("s0", 30, "starting")]) == BudgetPlan()


def test_a_reserve_stops_when_nobody_needs_it() -> None:
    reserves = [SpareReserve("s0", 20, "on"), SpareReserve("s1", 50, "on")]

    assert plan(170, ALL, running((90, 0)), reserves=reserves) == BudgetPlan(stop=["s1", "s0"])
    assert plan(170, ALL, running((110, 0)), reserves=reserves) == BudgetPlan(stop=["s1"])
    assert plan(170, ALL, running((160, 0)), [AskedShare("a", 20)], reserves) == BudgetPlan(wait=["a"])


def test_the_least_priority_makes_no_room() -> None:
    shares, trial = running((60, None)), [AskedShare("a", 50, LEAST)]

    assert plan(100, ALL, shares, trial, [SpareReserve("s0", 50)]) == BudgetPlan(wait=["a"])
    assert plan(110, ALL, shares, trial) == BudgetPlan(admit=["a"])


def test_steps_after_wait_are_for_one_that_may_not_wait() -> None:
    policy: tuple[Step, ...] = ("wait", "preempt")

    assert plan(100, policy, running((70, 1)), [AskedShare("a", 60, 9)]) == BudgetPlan(wait=["a"])
    assert plan(100, policy, running((70, 1)), [AskedShare("a", 60, 9, patient=False)]) == BudgetPlan(
        revoke=["r0"], wait=["a"]
    )


def test_one_that_has_waited_long_is_passed_over_by_nobody_who_comes_later() -> None:
    large, small = AskedShare("large", 100, 0, 1, holds=True), AskedShare("small", 10, 0, 2)

    assert plan(100, ALL, running((50, 0)), [large, small]) == BudgetPlan(wait=["large", "small"])
    assert plan(100, ALL, running((50, 0)), [AskedShare("large", 100, 0, 1), small]) == BudgetPlan(
        admit=["small"], wait=["large"]
    )


def test_a_reserve_that_has_not_been_on_for_long_enough_stays_on() -> None:
    assert plan(150, ALL, running((50, 0)), reserves=[SpareReserve("s0", 50, "on", may_stop=False)]) == BudgetPlan()


def test_a_reserve_is_as_urgent_as_the_first_that_would_not_fit_without_it() -> None:
    on = [SpareReserve("s0", 50, "on"), SpareReserve("s1", 50, "on")]

    assert urgencies(50, running((100, 9)), [], on[:1]) == {"s0": 9}
    assert urgencies(50, running((50, 9), (40, 1)), [], on) == {"s0": 1, "s1": LEAST + 1}
    assert urgencies(50, [], [AskedShare("a", 80, 5), AskedShare("b", 500, 9)], on[:1]) == {"s0": 5}


levels = st.none() | st.integers(-2, 2)
amounts = st.sampled_from([0.1, 1, 2, 3, 5, 8, 13])


@given(st.lists(st.tuples(amounts, levels), max_size=7), amounts, levels, st.floats(0, 20))
def test_the_victims_are_the_lowest_then_the_fewest_then_the_newest(
    shares: list[tuple[float, int | None]], amount: float, priority: int | None, capacity: float
) -> None:
    """Compared with the best of all sets, in the smallest cases."""
    held = running(*shares)
    capacity += math.fsum(share.amount for share in held)

    made = plan(capacity, ALL, held, [AskedShare("a", amount + 5, priority)])

    need = amount + 5 - (capacity - math.fsum(share.amount for share in held)) - capacity * 1e-9
    lower = [share for share in held if rank(share.priority) < rank(priority)]
    sets = [chosen for size in range(len(lower) + 1) for chosen in itertools.combinations(lower, size)]
    enough = [chosen for chosen in sets if math.fsum(share.amount for share in chosen) >= need]

    def worth(chosen: tuple[HeldShare, ...]) -> list[tuple[int, list[float]]]:
        """The count at each priority, the highest first, and the ages there, the newest first."""
        of_level = [
            [share for share in chosen if rank(share.priority) == level] for level in (2, 1, 0, -1, -2, -math.inf)
        ]
        return [(len(level), sorted(-share.since for share in level)) for level in of_level]

    if not enough:
        assert made == BudgetPlan(wait=["a"])
    else:
        assert set(made.revoke) == {share.id for share in min(enough, key=worth)}


def test_ten_thousand_shares_take_few_steps() -> None:
    shares = running(*((1 + i % 7, i % 50) for i in range(10_000)))
    capacity = math.fsum(share.amount for share in shares)

    steps, made = steps_of(lambda: plan(capacity, ALL, shares, [AskedShare("a", 1000, 100)]))

    assert made.wait == ["a"]
    assert steps < 60 * len(shares)


class Pools(RuleBasedStateMachine):
    """A pool in which anything happens in any order, as a manager would carry out the plans.

    A crash of the manager loses what only it knew: the loads that it had admitted and that were not on disk yet, which
    ask again, the revocations that had not begun, the starts of reserves, and the ages.
    """

    def __init__(self) -> None:
        super().__init__()
        self.capacity = 20.0
        self.running: dict[str, HeldShare] = {}
        self.asked: dict[str, AskedShare] = {}
        self.spares = {"s0": SpareReserve("s0", 5), "s1": SpareReserve("s1", 8)}
        self.on_disk: set[str] = set()  # shares
        self.revoked: set[str] = set()  # begun, so that a crash does not lose them
        self.count = 0
        self.is_late = False  # the capacity was lowered, and what is over has not left yet

    @rule(amount=amounts, priority=levels, patient=st.booleans())
    def ask(self, amount: float, priority: int | None, patient: bool) -> None:
        self.count += 1
        self.asked[f"{self.count}"] = AskedShare(f"{self.count}", amount, priority, self.count, patient)
        self.settle()

    @rule(capacity=st.sampled_from([0, 5, 10, 20, 30]))
    def change(self, capacity: float) -> None:
        self.capacity = capacity
        self.is_late = True
        self.settle()

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def leave(self, data: st.DataObject) -> None:
        del self.running[data.draw(st.sampled_from(sorted(self.running)))]
        self.settle()

    @precondition(lambda self: self.running)
    @rule(data=st.data(), priority=levels)
    def reprioritise(self, data: st.DataObject, priority: int | None) -> None:
        one = self.running[data.draw(st.sampled_from(sorted(self.running)))]
        self.running[one.id] = HeldShare(one.id, one.amount, priority, one.since, one.leaving)
        self.settle()

    @precondition(lambda self: self.asked)
    @rule(data=st.data())
    def lose_patience(self, data: st.DataObject) -> None:
        one = self.asked[data.draw(st.sampled_from(sorted(self.asked)))]
        self.asked[one.id] = AskedShare(one.id, one.amount, one.priority, one.since, False)
        self.settle()

    @rule(id=st.sampled_from(["s0", "s1"]), state=st.sampled_from(["off", "late", "on"]))
    def move_reserve(self, id: str, state: Literal["off", "late", "on"]) -> None:
        """A reserve that starts is on, is late or fails; one that is on is lost."""
        is_on = self.spares[id].state == "on"
        if self.spares[id].state == "off" or (is_on and state != "off"):
            return
        self.is_late = self.is_late or is_on
        self.set_reserve(id, state)
        self.settle()

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def reach_the_disk(self, data: st.DataObject) -> None:
        id = data.draw(st.sampled_from(sorted(self.running)))
        self.on_disk.add(id)
        if self.running[id].leaving:
            self.revoked.add(id)

    @rule()
    def crash(self) -> None:
        for id, spare in self.spares.items():
            if spare.state in ("starting", "late"):
                self.set_reserve(id, "off")
        for since, (id, one) in enumerate(list(self.running.items())):
            self.running[id] = HeldShare(id, one.amount, one.priority, since, id in self.revoked)
            if id not in self.on_disk:
                del self.running[id]
                self.asked[id] = AskedShare(id, one.amount, one.priority, since)
        self.settle()

    def set_reserve(self, id: str, state: Literal["off", "starting", "late", "on"]) -> None:
        self.spares[id] = SpareReserve(id, self.spares[id].amount, state)

    def plan(self) -> BudgetPlan:
        return plan(self.total(), ALL, [*self.running.values()], [*self.asked.values()], [*self.spares.values()])

    def settle(self) -> None:
        """Plan and carry it out until nothing more is to be done, as the manager does while somebody waits."""
        for _ in range(5):
            if self.carry_out(self.plan()):
                break

    def carry_out(self, made: BudgetPlan) -> bool:
        """Do what a plan says; return whether that was nothing."""
        assert sorted([*made.admit, *made.wait, *made.refuse]) == sorted(self.asked)
        self._check_victims(made)
        for id in made.refuse:
            del self.asked[id]
        for id in made.revoke:
            one = self.running[id]
            self.running[id] = HeldShare(id, one.amount, one.priority, one.since, True)
        for id in made.admit:
            one = self.asked.pop(id)
            self.running[id] = HeldShare(id, one.amount, one.priority, one.since)
        for id in made.start:
            self.set_reserve(id, "starting")
        for id in made.stop:
            self.set_reserve(id, "off")
        self.is_late = self.is_late and self.used() > self.total() + 1e-6
        return made == BudgetPlan(wait=made.wait)

    def _check_victims(self, made: BudgetPlan) -> None:
        """Check that each victim is lower than somebody who waits, whose room nothing but victims makes."""
        victims = [self.running[id] for id in made.revoke]
        waiting = [self.asked[id] for id in made.wait]
        if self.used(staying=True) <= self.total():
            for victim in victims:
                assert any(rank(victim.priority) < rank(one.priority) for one in waiting)
            staying = self.used(staying=True) - math.fsum(victim.amount for victim in victims)
            fits = [one.amount for one in waiting if staying + one.amount <= self.total() + 1e-6]
            in_vain = [victim for victim in victims if victim.priority is not None and not fits]
            assert not in_vain, "their room depends on a reserve that may fail"

    def total(self) -> float:
        return self.capacity + math.fsum(spare.amount for spare in self.spares.values() if spare.state == "on")

    def used(self, staying: bool = False) -> float:
        return math.fsum(one.amount for one in self.running.values() if not (staying and one.leaving))

    @invariant()
    def the_sum_is_within_the_capacity(self) -> None:
        assert self.is_late or self.used() <= self.total() + 1e-6

    @invariant()
    def what_is_over_the_capacity_leaves_or_waits_for_a_reserve_that_is_not_late(self) -> None:
        starting = math.fsum(spare.amount for spare in self.spares.values() if spare.state == "starting")
        assert self.used(staying=True) <= self.total() + starting + 1e-6

    @invariant()
    def nothing_more_is_to_be_done(self) -> None:
        """A plan that was carried out is complete: planned again, nothing more comes of it."""
        made = self.plan()
        assert made == BudgetPlan(wait=made.wait)

    @invariant()
    def nobody_waits_who_would_fit_while_a_lower_one_runs(self) -> None:
        """Unless a reserve starts, which is preferred to victims."""
        room = self.total() - self.used(staying=True)
        first = max(self.asked.values(), key=lambda one: (rank(one.priority), -one.since), default=None)
        starts = any(spare.state in ("starting", "late") for spare in self.spares.values())
        makes_room = first is not None and first.priority is not None  # an idle one takes what is free
        if first is not None and makes_room and room < first.amount - 1e-6 and not starts:
            lower = [
                one.amount
                for one in self.running.values()
                if not one.leaving and rank(one.priority) < rank(first.priority)
            ]
            off = [spare.amount for spare in self.spares.values() if spare.state == "off"]
            assert room + math.fsum([*lower, *off]) < first.amount + 1e-6


TestPools = Pools.TestCase
