"""Small worlds walked to the end: every interleaving keeps every promise, and a broken protocol is found soonest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from rr_actors.managers.budgets.planner import AskedShare, BudgetPlan, HeldShare, plan
from simulation.budgets import Budget
from simulation.explore import Walk, digest, picture, walk
from simulation.oracle import Violation
from simulation.sim_registrar import SimRegistrar
from simulation.small_worlds import WORLDS, main, told
from simulation.world import World
from support_mutations import DIRECTED, MUTATIONS

SMALLEST = ("at once", "errors", "lost link", "crash", "budget")
"""Each has more than a thousand states."""

ENOUGH = 1000
"""States of each larger world: two minutes of one core for all of them. `make explore` goes on from there."""

FIRST = 200
"""States of two worlds that each run of the tests walks, the shortest histories first. The slow tests walk all."""

FOUND = {
    "reply before commit": ("at once", 8),
    "what is needed left paused": ("pauses", 15),
    "a pause lost in a crash": ("crash and pauses", 7),
    "a reload lost in a crash": ("crash and reload", 5),
}
"""Our protocol broken in one place, a small world in which that shows, and the least number of steps it takes."""


@pytest.mark.parametrize("name", ["at once", "budget"])
def test_the_shortest_histories_of_a_small_world_keep_every_promise(name: str) -> None:
    done = walk(WORLDS[name], go_on=lambda so_far: so_far.states < FIRST)

    assert done.violation is None, "\n".join(told(WORLDS[name], done))
    assert done.states >= FIRST


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", SMALLEST)
def test_every_history_of_a_small_world_keeps_every_promise(name: str) -> None:
    done = walk(WORLDS[name])

    assert done.violation is None, "\n".join(told(WORLDS[name], done))
    assert done.ended
    assert done.states > 1000


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", [name for name in WORLDS if name not in SMALLEST])
def test_a_larger_world_keeps_every_promise_as_far_as_it_is_walked(name: str) -> None:
    done = walk(WORLDS[name], go_on=lambda so_far: so_far.states < ENOUGH)

    assert done.violation is None, "\n".join(told(WORLDS[name], done))
    assert done.ended or done.states >= ENOUGH


@pytest.mark.parametrize("name", FOUND)
def test_a_broken_protocol_is_found_with_a_shortest_history(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    world, steps = FOUND[name]
    mutation = MUTATIONS[name] if name in MUTATIONS else DIRECTED[name][0]
    done = walk(WORLDS[world], mutation(monkeypatch.setattr))

    assert done.violation is not None
    assert len(done.history) == steps


def over(*given: Any) -> BudgetPlan:
    """Admits who has to wait."""
    made = plan(*given)
    return BudgetPlan(admit=[*made.admit, *made.wait])


def too_many(capacity: float, policy: Any, running: list[HeldShare], asked: list[AskedShare]) -> BudgetPlan:
    """Revokes somebody for each who asks, also for who fits."""
    made = plan(capacity, policy, running, asked)
    made.revoke = [share.id for share in running if not share.leaving][: len(asked)]
    return made


def of_equals(capacity: float, policy: Any, running: list[HeldShare], asked: list[AskedShare]) -> BudgetPlan:
    """Revokes what is as urgent as who asks."""
    return plan(capacity, policy, running, [replace(one, priority=(one.priority or 0) + 1) for one in asked])


def never(*given: Any) -> BudgetPlan:
    """Has all wait."""
    made = plan(*given)
    return BudgetPlan(wait=[*made.admit, *made.wait])


@pytest.mark.parametrize(
    ("planner", "capacity", "name"),
    [(over, 2.0, "sum"), (too_many, 4.0, "victims"), (of_equals, 2.0, "victims"), (never, 2.0, "waiting")],
)
def test_a_planner_of_budgets_with_a_defect_is_found(
    planner: Callable[..., BudgetPlan], capacity: float, name: str
) -> None:
    done = walk(WORLDS["budget"]._replace(budget=Budget(capacity, planner)))

    assert isinstance(done.violation, Violation)
    assert done.violation.kind == name


def test_a_shortest_history_is_drawn_with_a_column_for_each_registrar(monkeypatch: pytest.MonkeyPatch) -> None:
    small = WORLDS["at once"]
    factory = MUTATIONS["reply before commit"](monkeypatch.setattr)
    done = walk(small, factory)

    lines = picture(small, done.history, factory)

    assert lines[0].split() == ["a", "b", "r"]
    assert any(line.startswith("|--") and " Load q0 " in line and line.endswith("->") for line in lines)
    assert lines[-1] == f"=> {done.violation}"


def test_worlds_that_differ_in_the_names_of_events_alone_are_equal() -> None:
    small = WORLDS["statuses"]

    def told_after(names: int) -> bytes:
        world = World(dict(small.layout), SimRegistrar, small.hasty)
        for _ in range(names):
            world.new_event()
        for step in (("register", "r", "whole"), ("register", "r", "part")):
            world.apply(step)
        return digest(world, ())

    assert told_after(0) == told_after(7)


def test_a_walk_goes_as_far_as_it_is_allowed_to() -> None:
    done = walk(WORLDS["at once"], go_on=lambda so_far: so_far.states < 50)

    assert done == Walk(done.depth, done.states, done.steps, False)
    assert 50 <= done.states < 60


def test_the_command_says_how_far_it_came(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["crash", "lost link", "--seconds", "0.2"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("crash ")
    assert first.endswith("as far as time allowed")
    assert second.startswith("lost link ")


def test_the_command_names_the_worlds_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["crsh"])
    assert "no world crsh: there are at once, " in capsys.readouterr().err
