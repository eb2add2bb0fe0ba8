"""Which alternatives a choice allows and prefers: tables, and properties against what each pair says by itself."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.choices.matching import parse_comparison, ranked, why_none


def one(name: str, /, **provides: Any) -> Alternative:
    return Alternative("range", f"sensors/{name}", provides=provides)


CAMERA = one("camera", rate_hz=30, cost=8, place="roof", colour=True)
LIDAR = one("lidar", rate_hz=10, cost=3, place="bumper")
SONAR = one("sonar", rate_hz=10, cost=1)
ARM = Alternative("arm", "arms/arm", provides={"reach": 2})
ALL = [CAMERA, LIDAR, SONAR, ARM]


def declared(alternative: Alternative) -> float:
    return float(alternative.provides.get("reliability", 1.0))


def names(found: list[Alternative]) -> list[str]:
    return [alternative.server.removeprefix("sensors/") for alternative in found]


@pytest.mark.parametrize(
    ("given", "value", "holds"),
    [
        (">=10", 10, True),
        (">=10", 9.9, False),
        (" <= 10 ", 10, True),
        ("<1e3", 999, True),
        (">-1", 0, True),
        ("==10", 10.0, True),
        ("!=10", 10, False),
        ("10", 10, True),
        (10, 10, True),
        (10, 11, False),
        ("10", "10", True),
        ("roof", "roof", True),
        ("roof", "Roof", False),
        ("==roof", "roof", True),
        ("!=roof", "bumper", True),
        ("!=roof", "roof", False),
        ("two words", "two words", True),
        (True, True, True),
        ("true", True, True),
        (True, False, False),
        (True, 1, False),
        (1, True, False),
        ("roof", 10, False),
        (">=10", "20", False),
        ("!=roof", 10, False),
        (">=10", None, False),
        ("!=10", None, False),
    ],
)
def test_a_comparison_holds_for_values_of_its_own_kind(given: Any, value: Any, holds: bool) -> None:
    assert parse_comparison("where.x", given).holds(value) is holds


@pytest.mark.parametrize(
    "given", [">=", "=>10", "=10", "=", ">>10", ">= ", "<fast", ">=roof", ">nan", "<inf", "", " ", "!", "!10", math.nan]
)
def test_what_is_no_comparison_is_named(given: Any) -> None:
    with pytest.raises(rr.ConfigError, match=r"Choose: where\.x: expected .*, got ") as raised:
        parse_comparison("where.x", given)
    assert raised.value.key == "where.x"


@pytest.mark.parametrize(
    ("where", "prefer", "expected"),
    [
        ({}, [], ["camera", "lidar", "sonar"]),
        ({}, ["-cost"], ["sonar", "lidar", "camera"]),
        ({}, ["rate_hz"], ["camera", "lidar", "sonar"]),
        ({}, ["-rate_hz", "-cost"], ["sonar", "lidar", "camera"]),
        ({}, ["-rate_hz"], ["lidar", "sonar", "camera"]),
        ({"rate_hz": ">10"}, ["-cost"], ["camera"]),
        ({"rate_hz": "<=10", "place": "bumper"}, [], ["lidar"]),
        ({"place": "!=roof"}, [], ["lidar"]),  # the sonar does not say where it is
        ({"colour": True}, [], ["camera"]),
        ({}, ["colour"], ["camera", "lidar", "sonar"]),
        ({"reliability": ">=1"}, ["reliability"], ["camera", "lidar", "sonar"]),
        ({"cost": 100}, [], []),
    ],
)
def test_what_is_allowed_and_preferred(where: Any, prefer: list[str], expected: list[str]) -> None:
    assert names(ranked(ALL, "range", where, prefer, declared)) == expected


def test_reliability_counts_as_it_is_now() -> None:
    trust = {"sensors/camera": 0.25, "sensors/lidar": 0.5, "sensors/sonar": 1.0}
    now = ranked(ALL, "range", {"reliability": ">=0.5"}, ["reliability"], lambda found: trust[found.server])
    assert names(now) == ["sonar", "lidar"]


@pytest.mark.parametrize(
    ("kind", "where", "prefer", "key", "says"),
    [
        (
            "rang",
            {},
            [],
            "kind",
            "expected one of arm, range, got 'rang', which nothing provides; did you mean 'range'?",
        ),
        ("range", {"rate": 1}, [], "where.rate", "which no alternative provides; did you mean 'rate_hz'?"),
        ("range", {"reach": 1}, [], "where.reach", "expected one of colour, cost, place, rate_hz, reliability"),
        ("range", {"rate_hz": "fast"}, [], "where.rate_hz", "expected a number, or a comparison with one, got 'fast'"),
        ("range", {"place": ">3"}, [], "where.place", "expected == or !=, as the alternatives provide no number"),
        ("range", {"rate_hz": ">=fast"}, [], "where.rate_hz", "expected a number after >=, got '>=fast'"),
        ("range", {}, ["speed"], "prefer[0]", "'speed', which no alternative provides"),
        ("range", {}, ["rate_hz", "-"], "prefer[1]", "expected one of colour"),
        ("range", {}, ["-place"], "prefer[0]", "expected the name of a number, got 'place', which is 'roof' for one"),
    ],
)
def test_what_can_never_be_chosen_is_named(kind: str, where: Any, prefer: list[str], key: str, says: str) -> None:
    with pytest.raises(rr.ConfigError) as raised:
        ranked(ALL, kind, where, prefer, declared)
    assert raised.value.key == key
    assert says in str(raised.value)


def test_without_any_alternative_the_kinds_are_none() -> None:
    with pytest.raises(rr.ConfigError, match="expected one of none"):
        ranked([], "range", {}, [], declared)


def test_what_speaks_against_each_alternative_is_said() -> None:
    assert why_none(ALL, "range", {"rate_hz": ">50", "place": "roof"}, declared).splitlines() == [
        "sensors/camera: rate_hz is 30, expected >50",
        "sensors/lidar: rate_hz is 10, expected >50, place is 'bumper', expected ==roof",
        "sensors/sonar: rate_hz is 10, expected >50, place is not provided, expected ==roof",
    ]


# -- properties ----------------------------------------------------------------------------------------------------

NUMBERS = st.integers(0, 3)
PROVIDED = st.fixed_dictionaries({"a": NUMBERS}, optional={"b": NUMBERS, "c": NUMBERS})
OPERATORS = {">=": lambda x, y: x >= y, "<": lambda x, y: x < y, "==": lambda x, y: x == y, "!=": lambda x, y: x != y}


def beats(better: Alternative, worse: Alternative, prefer: list[str]) -> bool:
    """Whether one alternative is better by the first name in which they differ."""
    for given_name in prefer:
        name = given_name.lstrip("-")
        mine, other = better.provides.get(name), worse.provides.get(name)
        if mine == other:
            continue
        if mine is None or other is None:
            return other is None
        return mine < other if given_name.startswith("-") else mine > other  # type: ignore[operator]
    return False


@settings(max_examples=300, deadline=None)
@given(
    provided=st.lists(PROVIDED, min_size=1, max_size=6),
    sign=st.sampled_from(sorted(OPERATORS)),
    limit=NUMBERS,
    prefer=st.lists(st.sampled_from(["a", "-a", "reliability"]), max_size=3, unique=True),
    wider=st.sampled_from([[], ["b"], ["-b"], ["c", "-b"]]),
)
def test_the_chosen_one_is_allowed_and_no_allowed_one_beats_it(
    provided: list[dict[str, Any]], sign: str, limit: int, prefer: list[str], wider: list[str]
) -> None:
    known = {name for row in provided for name in row}
    prefer = prefer + [name for name in wider if name.lstrip("-") in known]
    every = [one(str(i), **row) for i, row in enumerate(provided)]
    found = ranked(every, "range", {"a": f"{sign}{limit}"}, prefer, declared)
    allowed = [other for other in every if OPERATORS[sign](other.provides["a"], limit)]
    assert sorted(found, key=every.index) == allowed
    for place, better in enumerate(found):
        for worse in found[place + 1 :]:
            assert not beats(worse, better, prefer)
            assert beats(better, worse, prefer) or every.index(better) < every.index(worse)
