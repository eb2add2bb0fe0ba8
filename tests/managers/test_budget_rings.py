"""Rings of waiting over several pools."""

from __future__ import annotations

from rr_actors.managers.budgets.rings import RingHold, RingWait, one_to_refuse, without_ground

MOST = {"a": 10.0, "b": 10.0}
HOLDS = [RingHold("a", "x", 10), RingHold("b", "y", 10)]


def test_of_two_that_wait_for_each_other_the_younger_is_refused() -> None:
    waits = [RingWait("older", "b", "x", 5, 0, 1.0), RingWait("younger", "a", "y", 5, 0, 2.0)]

    assert [wait.id for wait in one_to_refuse(MOST, HOLDS, waits)] == ["younger", "older"]


def test_of_two_that_wait_for_each_other_the_less_urgent_is_refused() -> None:
    waits = [RingWait("low", "b", "x", 5, 1, 1.0), RingWait("high", "a", "y", 5, 5, 2.0)]

    assert one_to_refuse(MOST, HOLDS, waits)[0].id == "low"


def test_what_waits_for_somebody_who_waits_for_nothing_is_in_no_ring() -> None:
    assert one_to_refuse(MOST, [*HOLDS, RingHold("b", "z", 5)], [RingWait("one", "b", "x", 5)]) == ()
    assert one_to_refuse({"a": 20.0, "b": 10.0}, HOLDS, [RingWait("1", "b", "x", 5), RingWait("2", "a", "y", 5)]) == ()


def test_what_loses_a_share_waits_for_another_in_vain() -> None:
    wait = RingWait("one", "b", "x", 5)

    assert without_ground([RingHold("a", "x", 10, leaving=True)], [wait]) == [wait]
    assert without_ground([RingHold("a", "x", 10)], [wait]) == []
