"""How many replicas a Keeper wants, by what it reads."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.managers.keeper.desired import changes, parse_desired
from rr_actors.managers.keeper.scaling import Range, Reading, Scale, ScaleOn, begun, next_scale, within

CPU = ScaleOn(0.5, usage="cpu", down_s=60.0)
QUEUE = ScaleOn(5, probe="psi:cpu", down_s=60.0)
LATENCY = ScaleOn(100, probe="psi:cpu", kind="level", down_s=60.0)


def after(on: ScaleOn, wanted: int, *readings: tuple[float, float, int], least: int = 1, most: int = 8) -> Scale:
    """Return the scale after readings (time, value, count of replicas that say it)."""
    range_ = Range(least, most, on)
    scale = begun(range_, wanted, "", 0.0)
    for at, value, count in readings:
        scale = next_scale(range_, scale, Reading(value, count), at)
    return scale


UP: list[tuple[ScaleOn, int, float, int, int]] = [
    # what it follows, how many are wanted, what is read, of how many, and how many are wanted then
    (CPU, 2, 0.5, 2, 2),
    (CPU, 2, 0.55, 2, 2),  # within the tolerance
    (CPU, 2, 0.6, 2, 3),
    (CPU, 2, 1.0, 2, 4),
    (CPU, 4, 1.0, 2, 4),  # two are still starting, and will have their part
    (CPU, 4, 2.0, 2, 8),
    (CPU, 3, 1.0, 0, 3),  # none says anything
    (CPU, 4, 50.0, 4, 8),  # never more than the most
    (CPU, 1, 1e308, 1, 8),
    (QUEUE, 1, 11, 1, 3),
    (QUEUE, 1, 11, 0, 3),  # what there is to do counts, not who is ready
    (QUEUE, 2, 10.9, 2, 2),
    (ScaleOn(0.1, probe="psi:cpu"), 1, 0.7, 1, 7),  # 0.7 / 0.1 is no more than 7
    (LATENCY, 2, 150, 2, 3),
    (LATENCY, 2, 150, 0, 2),
]


@pytest.mark.parametrize(("on", "wanted", "value", "count", "then"), UP)
def test_more_are_wanted_at_once(on: ScaleOn, wanted: int, value: float, count: int, then: int) -> None:
    assert after(on, wanted, (1.0, value, count)).wanted == then


def test_fewer_are_wanted_when_they_would_have_been_enough_for_the_whole_window() -> None:
    for on, low in ((CPU, 0.1), (QUEUE, 3), (LATENCY, 10)):
        assert after(on, 4, (30, low, 4), (59, low, 4)).wanted == 4
        assert after(on, 4, (30, low, 4), (60, low, 4)).wanted == 1
    # what was right at 40 holds until 100, what was right at 70 until 130
    readings = [(40.0, 14.0, 4), (70.0, 9.0, 4), (99.0, 1.0, 4), (101.0, 1.0, 3), (131.0, 1.0, 2)]
    assert [after(QUEUE, 4, *readings[: i + 1]).wanted for i in range(5)] == [4, 3, 3, 2, 1]


def test_those_that_say_nothing_count_as_loaded_where_there_are_too_many() -> None:
    assert after(CPU, 4, (60, 0.1, 2)).wanted == 3  # (2 * 0.1 + 2 * 0.5) / 0.5 = 2.4
    assert after(CPU, 4, (60, 0.1, 4)).wanted == 1


def test_none_may_be_wanted_and_come_back() -> None:
    nothing = after(QUEUE, 3, (60, 0, 3), least=0)
    assert (nothing.wanted, nothing.why) == (0, "3 -> 0: psi:cpu is 0, the target 5 each")
    assert after(QUEUE, 0, (60, 1, 0), least=0).wanted == 1
    assert after(LATENCY, 0, (60, 150, 0), least=0).wanted == 2
    assert after(QUEUE, 0, (60, -7, 0), least=0).wanted == 0


def test_a_change_says_why() -> None:
    assert after(CPU, 2, (1, 0.93, 2)).why == "2 -> 4: cpu is 0.93, the target 0.5"
    assert after(CPU, 2, (1, 0.93, 2), (2, 0.5, 4)).why == "2 -> 4: cpu is 0.93, the target 0.5"
    assert within(Range(3, 8, CPU), Scale(2)) == Scale(3, "2 -> 3: min is 3")
    assert within(Range(1, 2, CPU), Scale(5)) == Scale(2, "5 -> 2: max is 2")
    assert within(Range(1, 5, CPU), Scale(5, "why")) == Scale(5, "why")


@given(
    st.sampled_from([CPU, QUEUE, LATENCY]),
    st.integers(1, 8),
    st.lists(st.tuples(st.floats(0, 30), st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 9))),
)
def test_it_stays_within_its_limits_and_nothing_is_released_that_was_right_within_the_window(
    on: ScaleOn, wanted: int, readings: list[tuple[float, float, int]]
) -> None:
    range_, now = Range(1, 8, on), 0.0
    scale = begun(range_, wanted, "", now)
    for wait_s, value, count in readings:
        now += wait_s
        before, scale = scale, next_scale(range_, scale, Reading(value, count), now)
        assert 1 <= scale.wanted <= 8
        assert len(scale.recent) <= 8
        if scale.wanted < before.wanted:
            assert all(one.count <= scale.wanted for one in before.recent if one.at > now - on.down_s)


KEEP = '[[keep]]\nname = "a"\nserver = "x/y"\nrequest = "{instance}"\n'
ON = '[keep.scale_on]\nusage = "cpu"\ntarget = 0.7\n'


def test_a_file_says_within_which_limits() -> None:
    desired = parse_desired(f"{KEEP}min = 2\nmax = 5\n{ON}".encode(), "keep.toml")
    assert desired.keeps["a"].range_ == Range(2, 5, ScaleOn(0.7, usage="cpu"))
    assert len(desired.replicas("keeper/group")) == 2
    assert [one.slot for one, _ in desired.replicas("keeper/group", {"a": 3})] == [("a", 0), ("a", 1), ("a", 2)]
    least = parse_desired(f"{KEEP}max = 5\n{ON}".encode(), "keep.toml")
    assert changes(least, desired) == ["~ a: min None -> 2"]


WRONG: list[tuple[str, str, Any]] = [
    ("max = 3\n", "max: expected none without scale_on, got 3", 3),
    ("min = 1\n", "min: expected none without scale_on, got 1", 1),
    (ON, "max: expected how many replicas there are at most, as scale_on decides, got None", None),
    (f"max = 0\n{ON}", "max: expected a whole number from 1 to 10000, got 0", 0),
    (f"min = 4\nmax = 3\n{ON}", "min: expected a whole number from 1 to 3, got 4", 4),
    (f"min = 0\nmax = 3\n{ON}", "min: expected a whole number from 1 to 3, got 0", 0),
    (f"max = 3\nreplicas = 2\n{ON}", "replicas: expected none, as scale_on decides, got 2", 2),
    (f"max = 3\n{ON}probe = 'psi:cpu'\n", "scale_on.usage: expected a usage or a probe, and not both", "cpu"),
    ("max = 3\n[keep.scale_on]\ntarget = 1\n", "scale_on.usage: expected a usage or a probe, and not both", ""),
    (f"max = 3\n{ON}kind = 'level'\n", "scale_on.kind: expected none, as a usage is that of each replica", "level"),
    (f"max = 3\n{ON}kind = 'sum'\n", "scale_on.kind: ", "sum"),
    ("max = 3\n[keep.scale_on]\nusage = 'cpu'\ntarget = 0\n", "scale_on.target: expected a number above 0, got 0", 0),
    ("max = 3\n[keep.scale_on]\nusage = 'cpu'\n", "scale_on: expected the key target, got none", {"usage": "cpu"}),
    (f"max = 3\n{ON}down_s = -1\n", "scale_on.down_s: expected a number of at least 0, got -1", -1),
    (f"max = 3\n{ON}every_s = 0\n", "scale_on.every_s: expected a number above 0, got 0", 0),
    (f"max = 3\n{ON}targets = 0\n", "scale_on.targets: expected one of target, usage, ", "targets"),
    (
        "max = 3\n[keep.scale_on]\nprobe = 'no_such:thing'\ntarget = 1\n",
        "scale_on.probe: expected a function, its name 'package.module:function', or one of psi:cpu",
        "no_such:thing",
    ),
]


@pytest.mark.parametrize(("text", "said", "got"), WRONG)
def test_what_is_wrong_is_named(text: str, said: str, got: Any) -> None:
    with pytest.raises(rr.ConfigError) as caught:
        parse_desired((KEEP + text).encode(), "keep.toml")
    assert f"keep.toml: keep[0].{said}" in str(caught.value)
    assert (caught.value.key, caught.value.got) == (f"keep[0].{said.partition(':')[0]}", got)


def test_replicas_that_would_be_one_thing_are_refused() -> None:
    with pytest.raises(rr.ConfigError, match=r"expected a request with \{instance\}, so that the 3 replicas differ"):
        parse_desired(f'[[keep]]\nname = "a"\nserver = "x/y"\nmax = 3\n{ON}'.encode(), "keep.toml")
