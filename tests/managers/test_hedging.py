"""Hedging: the first that answers wins, the next is tried beside one that hangs, and the slower ones are withdrawn."""

from __future__ import annotations

import threading

import pytest

import rr_actors as rr
from rr_actors.actors.messaging.futures import Reply
from rr_actors.managers.planning.hedging import Won, first_of

FOREVER_S = 3600.0


class Candidates:
    """Candidates by name: a value, an error, or None for one that hangs until it is withdrawn."""

    def __init__(self, **outcomes: str | Exception | None) -> None:
        self.outcomes = outcomes
        self.begun, self.failed, self.slow = list[str](), list[str](), list[str]()
        self.released, self.withdrawn = list[str](), list[str]()
        self.replies: dict[str, Reply[str]] = {}

    def begin(self, name: str) -> Reply[str]:
        self.begun.append(name)
        reply = self.replies[name] = Reply[str]()
        reply.withdraw = lambda: self.withdrawn.append(name)
        outcome = self.outcomes[name]
        if isinstance(outcome, str):
            reply.set(outcome)
        elif outcome is not None:
            reply.set_exception(outcome)
        return reply

    def first(self, hedge_s: float = FOREVER_S) -> Won[str, str] | None:
        return first_of(
            self.outcomes,
            self.begin,
            release=self.released.append,
            on_failed=lambda name, error: self.failed.append(f"{name}: {error}"),
            on_slow=self.slow.append,
            hedge_s=hedge_s,
        )


def test_the_first_that_is_well_wins_and_no_other_is_tried() -> None:
    some = Candidates(a="A", b="B")
    assert some.first() == Won("a", "A")
    assert (some.begun, some.failed, some.slow) == (["a"], [], [])


def test_the_next_one_is_tried_at_once_when_one_has_failed() -> None:
    some = Candidates(a=rr.LoadFailed("broken"), b="B")
    assert some.first() == Won("b", "B")
    assert some.failed == ["a: broken"]


def test_the_next_one_is_tried_beside_one_that_hangs_and_that_is_withdrawn_then() -> None:
    some = Candidates(a=None, b="B", c="C")
    assert some.first(hedge_s=0.05) == Won("b", "B")
    assert (some.begun, some.slow, some.withdrawn) == (["a", "b"], ["a"], ["a"])


def test_nothing_wins_if_all_fail() -> None:
    some = Candidates(a=rr.LoadFailed("one"), b=rr.LoadTimeout("two"))
    assert some.first() is None
    assert some.failed == ["a: one", "b: two"]


def test_a_candidate_that_cannot_begin_has_failed() -> None:
    some = Candidates(a="A", b="B")
    begin = some.begin

    def refused(name: str) -> Reply[str]:
        if name == "a":
            raise rr.UnknownServer("a: not there", server="a", known=())
        return begin(name)

    some.begin = refused  # type: ignore[method-assign]
    assert some.first() == Won("b", "B")
    assert some.failed == ["a: a: not there"]


def test_one_that_fails_beside_another_is_tried_again_alone_if_all_else_fails() -> None:
    some = Candidates(a=None, b=rr.LoadFailed("the device is taken"), c=rr.LoadFailed("broken"))
    begin, beside = some.begin, list[str]()

    def taken_by_a(name: str) -> Reply[str]:
        if some.begun.count("b") == 1 and name == "b":
            some.outcomes["b"] = "B"
        reply = begin(name)
        if name == "c":
            threading.Timer(0.2, some.replies["a"].set_exception, (rr.LoadFailed("late"),)).start()
        return reply

    won = first_of(
        some.outcomes,
        taken_by_a,
        release=some.released.append,
        on_failed=lambda name, error: some.failed.append(f"{name}: {error}"),
        on_failed_beside=lambda name, error: beside.append(f"{name}: {error}"),
        hedge_s=0.05,
    )
    assert won == Won("b", "B")
    assert some.begun == ["a", "b", "c", "b"]
    assert (some.failed, beside) == (["a: late"], ["b: the device is taken", "c: broken"])


def test_one_that_rests_is_tried_beside_one_that_hangs_when_it_has_rested() -> None:
    some, rests_s = Candidates(a=None, b="B"), [0.1, 0.05, 0.0]
    won = first_of(
        some.outcomes,
        some.begin,
        release=some.released.append,
        on_failed=lambda *_: None,
        rest_s=lambda _: rests_s.pop(0),
        hedge_s=0.01,
    )
    assert won == Won("b", "B")
    assert (rests_s, some.withdrawn) == ([], ["a"])


def test_what_the_caller_raises_ends_it_and_withdraws_what_is_in_flight() -> None:
    some = Candidates(a=None, b=rr.LoadFailed("broken"))

    def stop(name: str, error: Exception) -> None:
        raise error

    with pytest.raises(rr.LoadFailed, match="broken"):
        first_of(some.outcomes, some.begin, release=some.released.append, on_failed=stop, hedge_s=0.05)
    assert some.withdrawn == ["a"]


def test_the_value_of_one_that_answers_too_late_is_released() -> None:
    some = Candidates(a=None, b=None)
    begin = some.begin
    released = threading.Event()

    def both_at_once(name: str) -> Reply[str]:
        reply = begin(name)
        if name == "b":
            some.replies["a"].withdraw = None  # it cannot be taken back any more
            reply.set("B")
        return reply

    won = first_of(
        some.outcomes, both_at_once, release=lambda _: released.set(), on_failed=lambda *_: None, hedge_s=0.05
    )
    assert won == Won("b", "B")
    some.replies["a"].set("A")
    assert released.wait(60)
