"""When a choice tries a better alternative, and returns to it: tables, and properties of any plan."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.managers.choices.planning import (
    RETRY_LEAST_S,
    RETRY_LIMIT_S,
    UNKNOWN,
    ChoiceState,
    Plan,
    Standing,
    failed,
    in_turn,
    plan,
)

SETTLE_S = 2.0
NOW = 100.0


def on_trial(since: float) -> Standing:
    return Standing(trial="loaded", well_since=since)


@pytest.mark.parametrize(
    ("choice", "better"),
    [
        (ChoiceState(("a", "b", "c"), "a"), ()),
        (ChoiceState(("a", "b", "c"), "c"), ("a", "b")),
        (ChoiceState(("a", "b", "c"), "b", failing=True), ("a", "c")),
        (ChoiceState(("a", "b", "c"), "c", frozenset({"a"})), ("b",)),
        (ChoiceState(("a", "b"), "gone"), ("a", "b")),  # the file does not name it any more
        (ChoiceState((), "gone"), ()),
    ],
)
def test_what_would_be_better(choice: ChoiceState, better: tuple[str, ...]) -> None:
    assert choice.better() == better


CHOICE = ChoiceState(("a", "b", "c"), "c")


@pytest.mark.parametrize(
    ("standings", "expected"),
    [
        ({}, Plan(("a", "b"), (), {}, None)),
        ({"a": Standing(NOW - 1, 2.0)}, Plan(("b",), (), {}, NOW + 1)),
        ({"a": Standing(NOW - 2, 2.0), "b": Standing(NOW, 8.0)}, Plan(("a",), (), {}, NOW + 8)),
        ({"a": Standing(trial="loading"), "b": on_trial(NOW - 1)}, Plan((), (), {}, NOW + 1)),
        ({"a": Standing(trial="loading"), "b": on_trial(NOW - 2)}, Plan((), (), {"x": "b"}, None)),
        ({"a": on_trial(NOW - 2), "b": on_trial(NOW - 9)}, Plan((), (), {"x": "a"}, None)),
        ({"a": on_trial(NOW), "b": on_trial(NOW), "c": on_trial(NOW - 9)}, Plan((), ("c",), {}, NOW + 2)),
    ],
)
def test_what_is_done_now(standings: dict[str, Standing], expected: Plan) -> None:
    assert plan({"x": CHOICE}, standings, NOW, SETTLE_S) == expected


def test_one_trial_serves_all_choices() -> None:
    choices = {"x": ChoiceState(("a", "b"), "b"), "y": ChoiceState(("a", "c"), "c"), "z": ChoiceState(("b", "a"), "b")}
    assert plan(choices, {}, NOW, SETTLE_S).load == ("a",)
    assert plan(choices, {"a": on_trial(0)}, NOW, SETTLE_S).take == {"x": "a", "y": "a"}


def test_without_choices_every_trial_ends_and_nothing_is_due() -> None:
    standings = {"a": on_trial(NOW), "b": Standing(NOW, 2.0), "c": Standing(trial="loading")}
    assert plan({}, standings, NOW, SETTLE_S) == Plan((), ("a",), {}, None)


def test_each_failure_soon_after_another_doubles_the_delay_and_a_good_while_forgives() -> None:
    standing, now, delays = UNKNOWN, NOW, list[float]()
    for _ in range(7):
        standing = failed(standing, now, SETTLE_S)
        delays.append(standing.delay_s)
        now = standing.retry_at
    assert delays == [2, 4, 8, 16, 32, RETRY_LIMIT_S, RETRY_LIMIT_S]
    assert failed(standing, now + 10 * RETRY_LIMIT_S, SETTLE_S).delay_s == SETTLE_S


def test_a_failure_ends_a_trial_but_not_the_load_of_one() -> None:
    assert failed(on_trial(NOW), NOW, SETTLE_S).trial == ""
    assert failed(Standing(trial="loading"), NOW, SETTLE_S).trial == "loading"


def test_those_that_failed_lately_are_the_last_resort() -> None:
    standings = {"a": Standing(NOW - 1, 2.0), "c": Standing(NOW - 3, 2.0)}
    assert in_turn(["a", "b", "c", "d"], standings, {"d"}, NOW) == ["b", "c", "a"]


def test_what_is_loaded_and_well_comes_first() -> None:
    standings = {"a": Standing(NOW - 1, 2.0)}
    assert in_turn(["a", "b", "c", "d"], standings, (), NOW, {"c", "d"}) == ["c", "d", "b", "a"]


# -- properties ----------------------------------------------------------------------------------------------------

KEYS = ("a", "b", "c", "d")
TIMES = st.floats(0, 200)
STANDINGS = st.dictionaries(
    st.sampled_from(KEYS),
    st.builds(Standing, st.none() | TIMES, st.floats(0, 60), st.sampled_from(["", "loading", "loaded"]), TIMES),
)
CHOICES = st.dictionaries(
    st.sampled_from("xyz"),
    st.builds(
        ChoiceState,
        st.permutations(KEYS).map(lambda keys: tuple(keys[:3])),
        st.sampled_from(KEYS),
        st.frozensets(st.sampled_from(KEYS), max_size=2),
        st.booleans(),
    ),
)


@settings(max_examples=300, deadline=None)
@given(choices=CHOICES, standings=STANDINGS)
def test_a_plan_takes_the_best_that_has_settled_and_leaves_no_trial_that_nobody_wants(
    choices: dict[str, ChoiceState], standings: dict[str, Standing]
) -> None:
    made = plan(choices, standings, NOW, SETTLE_S)
    wanted = {key for choice in choices.values() for key in choice.better()}

    def settled(key: str) -> bool:
        one = standings.get(key, UNKNOWN)
        return one.trial == "loaded" and one.well_since <= NOW - SETTLE_S

    for id, choice in choices.items():
        candidates = [key for key in choice.better() if settled(key)]
        assert made.take.get(id) == (candidates[0] if candidates else None)
        assert choice.present != made.take.get(id) not in choice.fixed
    for key in KEYS:
        one = standings.get(key, UNKNOWN)
        assert (key in made.end) == (one.trial == "loaded" and key not in wanted)
        assert (key in made.load) == (key in wanted and not one.trial and one.retry_at <= NOW)
    assert made.look_at is None or made.look_at > NOW


@settings(max_examples=200, deadline=None)
@given(gaps=st.lists(st.floats(0, 2000), max_size=20), settle_s=st.floats(0, 100))
def test_a_delay_is_never_shorter_than_settling_nor_longer_than_its_limit(gaps: Any, settle_s: float) -> None:
    standing, now = UNKNOWN, 0.0
    for gap in gaps:
        now += gap
        standing = failed(standing, now, settle_s)
        assert max(settle_s, RETRY_LEAST_S) <= standing.delay_s <= max(RETRY_LIMIT_S, settle_s)
