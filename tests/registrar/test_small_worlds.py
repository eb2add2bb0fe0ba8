"""Small worlds walked to the end: every interleaving keeps every promise, and a broken protocol is found soonest."""

from __future__ import annotations

import pytest

from simulation.explore import Walk, digest, picture, walk
from simulation.sim_registrar import SimRegistrar
from simulation.small_worlds import WORLDS, main, told
from simulation.world import World
from support_mutations import DIRECTED, MUTATIONS

SMALLEST = ("at once", "errors", "lost link", "crash")
"""Each has more than a thousand states."""

FOUND = {
    "reply before commit": ("at once", 8),
    "what is needed left paused": ("pauses", 15),
    "a pause lost in a crash": ("crash and pauses", 7),
}
"""Our protocol broken in one place, a small world in which that shows, and the least number of steps it takes."""


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
    done = walk(WORLDS[name], go_on=lambda so_far: so_far.states < 3000)

    assert done.violation is None, "\n".join(told(WORLDS[name], done))
    assert done.ended or done.states >= 3000


@pytest.mark.parametrize("name", FOUND)
def test_a_broken_protocol_is_found_with_a_shortest_history(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    world, steps = FOUND[name]
    mutation = MUTATIONS[name] if name in MUTATIONS else DIRECTED[name][0]
    done = walk(WORLDS[world], mutation(monkeypatch.setattr))

    assert done.violation is not None
    assert len(done.history) == steps


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
