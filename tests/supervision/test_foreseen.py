"""What a supervisor would do, and what it then does: the decisions, and real processes that are killed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.supervision.core.foreseen import Step, foresee
from rr_actors.supervision.core.restarts import decide_start, decide_started
from rr_actors.supervision.core.state import StartChild, SupervisorState
from rr_actors.supervision.supervisor import SupervisorRef
from support import eventually, kill

Strategy = Literal["one_for_one", "one_for_all", "rest_for_one"]
IDS = ("a", "b", "c", "d")


class Worker(rr.Actor):
    pass


def running(strategy: Strategy, count: int = 3, max_restarts: int = 3) -> SupervisorState:
    """Return the state of a supervisor all of whose children run."""
    children = [rr.ChildSpec(Worker, id=id) for id in IDS[:count]]
    tree, actions = decide_start(
        SupervisorState.of(rr.Supervisor(children, strategy=strategy, max_restarts=max_restarts)), 0
    )
    while starts := [action for action in actions if isinstance(action, StartChild)]:
        actions = []
        for start in starts:
            tree, more = decide_started(tree, start.id, start.run, 0)
            actions += more
    return tree


def steps(text: str) -> tuple[Step, ...]:
    kinds: dict[str, Literal["dies", "stops", "starts"]] = {"!": "dies", "-": "stops", "+": "starts"}
    return tuple(Step(kinds[word[0]], word[1:]) for word in text.split())


@pytest.mark.parametrize(
    ("strategy", "what", "expected"),
    [
        ("one_for_one", "kill", "!b +b"),
        ("rest_for_one", "kill", "!b -c +b +c"),
        ("one_for_all", "kill", "!b -c -a +a +b +c"),
        ("rest_for_one", "stop", "-b"),
        ("rest_for_one", "restart", "-b +b"),
    ],
)
def test_the_steps(strategy: Strategy, what: Literal["kill", "stop", "restart"], expected: str) -> None:
    found = foresee(running(strategy), "b", what, 1.0)

    assert found.steps == steps(expected)
    assert (found.before, found.restarts, found.ends) == (0, 1 if what == "kill" else 0, False)


def test_one_restart_too_many_ends_the_supervisor() -> None:
    found = foresee(running("one_for_one", max_restarts=0), "b", "kill", 1.0)

    assert found.steps == steps("!b -c -a")
    assert found.ends
    assert "0 allowed" in found.error


@given(
    strategy=st.sampled_from(get_args(Strategy)), count=st.integers(1, 4), at=st.integers(0, 3), limit=st.integers(0, 3)
)
def test_who_stops_starts_again_unless_the_supervisor_ends(strategy: Strategy, count: int, at: int, limit: int) -> None:
    tree = running(strategy, count, limit)
    found = foresee(tree, IDS[at % count], "kill", 1.0)

    down = sorted(step.id for step in found.steps if step.happens != "starts")
    up = [step.id for step in found.steps if step.happens == "starts"]
    assert found.ends is (limit == 0)
    assert up == ([] if found.ends else down)
    assert tree == running(strategy, count, limit)  # a copy was used


@pytest.mark.parametrize("strategy", get_args(Strategy))
def test_a_real_kill_does_what_was_foreseen(start: Callable[..., rr.System], strategy: Strategy) -> None:
    children = [rr.ChildSpec(Worker, id=id, placement="process") for id in IDS[:3]]
    system = start(rr.Supervisor(children, strategy=strategy, max_seconds=3600))
    root = SupervisorRef("root")
    foreseen = root.foresee("b", "kill")
    before = len(root.history())

    kill(system, "b")

    names = {"exited": "dies", "stopped": "stops", "restarted": "starts"}

    def happened() -> list[tuple[str, str]]:
        return [(names[record.event], record.id) for record in list(root.history())[before:] if record.event in names]

    eventually(lambda: len(happened()) >= len(foreseen.steps), timeout=60)
    assert happened() == [(step.happens, step.id) for step in foreseen.steps]
    assert root.describe()["recent_restarts"] == foreseen.restarts
