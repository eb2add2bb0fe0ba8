"""Spin, then park: when a thread that waits for answers spins, and what it costs when that is wasted."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rr_actors.wire.thread_connections import SPIN_LIMIT_S, AdaptiveSpin

QUICK_S = 50e-6
LATE_S = SPIN_LIMIT_S * 1.5  # too late for who spins, but soon
SLOW_S = 2.0


class Caller:
    """Waits for answers as BlockingLink does, on a clock of its own."""

    def __init__(self) -> None:
        self.spin = AdaptiveSpin()
        self.in_vain_s = 0.0
        self.spins = 0

    def wait(self, answer_s: float, *, put_aside_s: float = 0.0) -> None:
        """For an answer that takes so long; who spins has the core, or Python's lock, only after `put_aside_s`."""
        if not self.spin.worthwhile:
            self.spin.parked(answer_s)
            return
        self.spins += 1
        answered = max(answer_s, put_aside_s) <= SPIN_LIMIT_S or put_aside_s >= answer_s
        took_s = max(answer_s, put_aside_s) if answered else SPIN_LIMIT_S
        if not answered or took_s > SPIN_LIMIT_S:
            self.in_vain_s += took_s
        self.spin.spun(took_s, answered)


def spins_of(caller: Caller, answers: int, answer_s: float, *, put_aside_s: float = 0.0) -> int:
    before = caller.spins
    for _ in range(answers):
        caller.wait(answer_s, put_aside_s=put_aside_s)
    return caller.spins - before


def test_the_first_answer_is_spun_for() -> None:
    assert AdaptiveSpin().worthwhile


def test_quick_answers_are_all_spun_for() -> None:
    assert spins_of(Caller(), 1_000, QUICK_S) == 1_000


def test_slow_answers_are_spun_for_once_and_then_no_more() -> None:
    assert spins_of(Caller(), 1_000, SLOW_S) == 1


def test_after_quick_answers_slow_ones_are_spun_for_twice() -> None:
    caller = Caller()
    spins_of(caller, 1_000, QUICK_S)
    assert spins_of(caller, 1_000, SLOW_S) == 2


def test_one_quick_answer_after_a_slow_one_brings_it_back() -> None:
    caller = Caller()
    caller.wait(SLOW_S)
    assert spins_of(caller, 100, QUICK_S) == 99


def test_quick_answers_after_many_slow_ones_bring_it_back() -> None:
    caller = Caller()
    spins_of(caller, 1_000, SLOW_S)
    assert spins_of(caller, 1_000, QUICK_S) >= 900


def test_a_slow_answer_now_and_then_is_forgiven() -> None:
    caller = Caller()
    spins_of(caller, 10, QUICK_S)
    for _ in range(100):
        caller.wait(SLOW_S)
        assert spins_of(caller, 10, QUICK_S) == 10


def test_answers_that_are_always_a_little_late_are_seldom_spun_for() -> None:
    assert spins_of(Caller(), 10_000, LATE_S) < 10_000 / 25


def test_answers_that_are_there_but_late_as_others_had_the_core_count_as_late() -> None:
    assert spins_of(Caller(), 10_000, QUICK_S, put_aside_s=0.003) < 10_000 / 250


def test_one_very_long_pause_does_not_end_it_for_good() -> None:
    caller = Caller()
    caller.wait(QUICK_S, put_aside_s=3_600.0)
    assert spins_of(caller, 10_000, QUICK_S) > 5_000


ANSWERS = st.lists(
    st.tuples(st.floats(0.0, 0.01), st.sampled_from([0.0, 0.0, 0.0001, 0.003, 0.005])), min_size=1, max_size=300
)


@given(ANSWERS)
def test_what_is_spun_in_vain_is_paid_by_what_was_saved(answers: list[tuple[float, float]]) -> None:
    caller = Caller()
    for answer_s, put_aside_s in answers:
        caller.wait(answer_s, put_aside_s=put_aside_s)
    longest_s = max(SPIN_LIMIT_S, *(max(pair) for pair in answers))
    assert caller.in_vain_s <= SPIN_LIMIT_S + 50e-6 * len(answers) + longest_s


@given(ANSWERS)
def test_whatever_came_before_slow_answers_are_spun_for_twice_at_most(answers: list[tuple[float, float]]) -> None:
    caller = Caller()
    for answer_s, put_aside_s in answers:
        caller.wait(answer_s, put_aside_s=put_aside_s)
    assert spins_of(caller, 100, SLOW_S) <= 2


@given(ANSWERS)
def test_whatever_came_before_quick_answers_bring_it_back(answers: list[tuple[float, float]]) -> None:
    caller = Caller()
    for answer_s, put_aside_s in answers:
        caller.wait(answer_s, put_aside_s=put_aside_s)
    spins_of(caller, 4_000, QUICK_S)
    assert spins_of(caller, 100, QUICK_S) == 100
