"""Which chain of components a pipe is: tables, and the best chain by brute force."""

from __future__ import annotations

from itertools import permutations, product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.managers.pipes.chains import (
    LEAST_TRUST,
    ChainComponent,
    Goal,
    PipeStep,
    best_chain,
    substitutes,
    why_none,
)

TYPES = "abcd"


def link(name: str, inputs: str = "", outputs: str = "", trust: float = 1.0, type: str = "") -> ChainComponent:
    """A component; each letter is a type of data."""
    return ChainComponent(name, type or name, frozenset(inputs), frozenset(outputs), trust)


def step(type: str, inputs: str = "", outputs: str = "") -> PipeStep:
    return PipeStep(type, frozenset(inputs), frozenset(outputs))


def names(chain: tuple[ChainComponent, ...] | list[ChainComponent] | None) -> list[str] | None:
    return None if chain is None else [one.name for one in chain]


@pytest.mark.parametrize(
    ("links", "chosen"),
    [
        ([link("camera", "", "a")], ["camera"]),
        ([link("camera", "", "b")], None),
        ([link("filter", "b", "a")], None),
        ([link("filter", "b", "a"), link("camera", "", "b")], ["camera", "filter"]),
        ([link("camera", "", "b"), link("lidar", "", "c"), link("fuse", "bc", "a")], None),
        ([link("camera", "", "bc"), link("fuse", "bc", "a")], ["camera", "fuse"]),
        ([link("camera", "", "a"), link("filter", "a", "a")], ["camera"]),
        ([link("worse", "", "a", 0.5), link("better", "", "a", 0.6)], ["better"]),
        ([link("first", "", "a", 0.5), link("second", "", "a", 0.5)], ["first"]),
        (
            [link("direct", "", "a", 0.5), link("camera", "", "b", 0.9), link("filter", "b", "a", 0.9)],
            ["camera", "filter"],
        ),
        ([link("camera", "", "b", 0.5), link("filter", "b", "a"), link("direct", "", "a", 0.5)], ["direct"]),
        ([link("ring", "a", "b"), link("other", "b", "a")], None),
        ([link("camera", "", "a", 0.0)], ["camera"]),
    ],
)
def test_the_best_chain_that_ends_in_what_is_asked_for(links: list[ChainComponent], chosen: list[str] | None) -> None:
    assert names(best_chain(links, Goal("a"))) == chosen


def test_of_chains_with_a_component_that_is_not_trusted_the_rest_decides() -> None:
    links = [link("broken", "", "b", 0.0), link("worse", "b", "a", 0.5), link("better", "b", "a", 0.9)]

    assert names(best_chain(links, Goal("a"))) == ["broken", "better"]


WAY = (step("camera", "", "b"), step("tracker", "b", "a"))


@pytest.mark.parametrize(
    ("links", "ways", "chosen"),
    [
        ([link("c", "", "b", type="camera"), link("t", "b", "a", type="tracker")], [WAY], ["c", "t"]),
        ([link("c", "", "b", type="lidar"), link("t", "b", "a", type="tracker")], [WAY], None),
        ([link("c", "", "b", type="camera"), link("t", "bc", "a", type="tracker")], [WAY], None),
        ([link("c", "", "bc", type="camera"), link("t", "bc", "ad", type="tracker")], [WAY], ["c", "t"]),
        ([link("c", "", "a", type="camera")], [WAY, (step("camera", "", "a"),)], ["c"]),
        (
            [
                link("c", "", "b", type="camera"),
                link("f", "b", "b", type="filter"),
                link("t", "b", "a", type="tracker"),
            ],
            [(WAY[0], step("filter", "b", "b"), step("filter", "b", "b"), WAY[1])],
            ["c", "f", "f", "t"],
        ),
    ],
)
def test_a_described_pipe_has_one_component_for_each_segment(
    links: list[ChainComponent], ways: list[tuple[PipeStep, ...]], chosen: list[str] | None
) -> None:
    assert names(best_chain(links, Goal("tags", tuple(ways)))) == chosen


def test_the_better_of_two_described_ways_is_chosen() -> None:
    links = [
        link("c", "", "b", 0.9, "camera"),
        link("t", "b", "a", 0.5, "tracker"),
        link("l", "", "a", 0.4, "lidar"),
        link("m", "", "a", 0.46, "lidar"),
    ]
    goal = Goal("tags", (WAY, (step("lidar", "", "a"),)))

    assert names(best_chain(links, goal)) == ["m"]
    assert names(best_chain(links[:3], goal)) == ["c", "t"]


def test_a_substitute_fits_both_neighbours_and_is_in_no_other_place() -> None:
    camera, track = link("camera", "", "b"), link("track", "c", "a")
    old, good, bad, source = (
        link("old", "b", "c", 0.3),
        link("good", "b", "c", 0.9),
        link("bad", "b", "d"),
        link("s", "", "c"),
    )
    links = [old, good, bad, source, camera, track]

    assert names(substitutes(links, [camera], [track], Goal("a"))) == ["good", "old"]
    assert names(substitutes(links, [], [old, track], Goal("a"))) == ["camera"]
    assert names(substitutes(links, [camera, old], [], Goal("a"))) == ["track"]


@pytest.mark.parametrize(
    ("links", "goal", "says"),
    [
        ([link("track", "bc", "a")], Goal("a"), ["track takes b, c: no chain of components gives that"]),
        (
            [],
            Goal("tags", (WAY,)),
            ["segment 0: there is no component of type 'camera' that takes nothing and gives b"],
        ),
        (
            [link("c", "", "b", type="camera"), link("t", "bd", "a", type="tracker")],
            Goal("tags", (WAY,)),
            ["camera, tracker: no components of these types fit each other"],
        ),
    ],
)
def test_why_there_is_no_chain(links: list[ChainComponent], goal: Goal, says: list[str]) -> None:
    assert best_chain(links, goal) is None
    assert why_none(links, goal) == says


# -- by brute force ------------------------------------------------------------------------------------------------

Letters = st.frozensets(st.sampled_from(TYPES), max_size=2)
Trust = st.sampled_from([0.0, 0.25, 0.3, 0.5, 0.9, 1.0]) | st.floats(0, 1)
Links = st.lists(st.tuples(st.sampled_from("xyz"), Letters, Letters, Trust), max_size=6).map(
    lambda rows: [ChainComponent(f"{i}", *row) for i, row in enumerate(rows)]
)
Steps = st.builds(PipeStep, st.sampled_from("xyz"), Letters, Letters)
Ways = st.lists(st.lists(Steps, min_size=1, max_size=3).map(tuple), max_size=2).map(tuple)


def all_chains(links: list[ChainComponent], goal: Goal) -> list[tuple[ChainComponent, ...]]:
    """Every chain that the rules allow, by trying every row of components."""
    if goal.ways:
        rows = [
            row
            for way in goal.ways
            for row in product(links, repeat=len(way))
            if all(
                one.type == step.type and one.inputs >= step.inputs and one.outputs >= step.outputs
                for one, step in zip(row, way, strict=True)
            )
        ]
    else:
        every = [row for length in range(1, len(links) + 1) for row in permutations(links, length)]
        rows = [row for row in every if goal.of_type in row[-1].outputs]
    return [row for row in rows if is_chain(row)]


def is_chain(row: tuple[ChainComponent, ...]) -> bool:
    for place, one in enumerate(row):
        given = row[place - 1].outputs if place else frozenset[str]()
        if bool(one.inputs) != bool(place) or one.inputs - given:
            return False
    return True


def rank(chain: tuple[ChainComponent, ...], links: list[ChainComponent]) -> tuple[object, ...]:
    """The less the better. Whole numbers are exact, where products of floats are rounded."""
    above, below = 1, 1
    for one in chain:
        number, unit = max(one.trust, LEAST_TRUST).as_integer_ratio()
        above, below = above * number, below * unit
    return _Ratio(above, below), len(chain), [links.index(one) for one in chain]


class _Ratio:
    """A reliability; the greater is before the less."""

    def __init__(self, above: int, below: int) -> None:
        self.above, self.below = above, below

    def __lt__(self, other: _Ratio) -> bool:
        return self.above * other.below > other.above * self.below

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Ratio) and self.above * other.below == other.above * self.below

    __hash__ = None  # type: ignore[assignment]


@settings(max_examples=200, deadline=None)
@given(Links, st.sampled_from(TYPES), Ways)
def test_the_chosen_chain_is_the_best_by_brute_force(
    links: list[ChainComponent], of_type: str, ways: tuple[tuple[PipeStep, ...], ...]
) -> None:
    goal = Goal(of_type, ways)
    every = all_chains(links, goal)

    chosen = best_chain(links, goal)

    assert chosen == (min(every, key=lambda chain: rank(chain, links)) if every else None)


@settings(max_examples=200, deadline=None)
@given(Links, st.sampled_from(TYPES), Ways, st.data())
def test_the_substitutes_are_those_with_which_the_chain_is_one(
    links: list[ChainComponent], of_type: str, ways: tuple[tuple[PipeStep, ...], ...], data: st.DataObject
) -> None:
    goal = Goal(of_type, ways)
    every = all_chains(links, goal)
    if not every:
        return
    chain = data.draw(st.sampled_from(every))
    place = data.draw(st.integers(0, len(chain) - 1))
    before, after = chain[:place], chain[place + 1 :]

    found = substitutes(links, before, after, goal)

    assert {one.name for one in found} == {
        one.name for one in links if one not in before + after and (*before, one, *after) in every
    }
    assert [one.trust for one in found] == sorted((one.trust for one in found), reverse=True)
