"""What a planner loads for itself is released after a crash; what was loaded by hand with its registrar is not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import rr_actors as rr
from rr_actors.managers import Action, Actions, Alternative, Budgets, Choices, Components, Pipes, Pool, Robots
from rr_actors.registrar.registrar import begin_planned
from support import eventually, kill, pid_of, wait_respawned

Start = Callable[..., rr.System]

LAMP = "lamps/lamp"


class Lamps(rr.Manager):
    @rr.server("lamp", recovery="keep")
    def light(self, name: str) -> None: ...

    @rr.server("control", recovery="keep")
    def control(self, name: str) -> None: ...


class Planner(rr.Manager):
    def plan(self) -> None:
        """Load as a planner does beside what it has, and be killed before it has told anybody."""
        begin_planned(self.registrar, LAMP, "planned").get()


class PlannedComponents(Planner, Components): ...


class PlannedPipes(Planner, Pipes): ...


class PlannedRobots(Planner, Robots): ...


class PlannedChoices(Planner, Choices): ...


class PlannedBudgets(Planner, Budgets): ...


class PlannedActions(Planner, Actions): ...


class Wait(Action):
    def run(self, given: Any) -> None: ...


COMPONENT = '[[component]]\nname = "a"\ntype = "b"\nprogram = { command = "true" }\n'
ROBOT = '[[robot]]\nname = "rover"\ndriver = { type = "b" }\n'
KINDS: dict[type[Planner], tuple[Any, ...]] = {
    PlannedComponents: (COMPONENT, LAMP),
    PlannedPipes: (COMPONENT.replace('type = "b"', 'type = "b"\noutputs = ["c"]'), LAMP),
    PlannedRobots: (ROBOT, LAMP),
    PlannedChoices: ([Alternative("light", LAMP, "used")],),
    PlannedBudgets: ([Pool("watts", 100)],),
    PlannedActions: ([Wait],),
}


def test_after_a_crash_a_planner_releases_what_it_has_loaded_itself_and_nothing_else(
    start: Start, tmp_path: Path
) -> None:
    children = [rr.ChildSpec(Lamps, id="lamps")]
    for kind, (first, *rest) in KINDS.items():
        if isinstance(first, str):
            file = tmp_path / f"{kind.__name__}.toml"
            file.write_text(first)
            first = str(file)
        children.append(rr.ChildSpec(kind, id=kind.__name__, args=(first, *rest)))
    system = start(rr.Supervisor(children, max_restarts=1000))
    by_hand: list[rr.Query] = []
    for kind in KINDS:
        name = kind.__name__
        by_hand += [system.registrar(name).load(server, name) for server in (LAMP, "lamps/control")]
        system.ref(name).proxy().plan().get()
        pid = pid_of(system, name)
        kill(system, name)
        wait_respawned(system, name, pid)
    lamps = system.registrar("lamps")
    eventually(lambda: "planned" not in [info.request for info in lamps.resources()])
    for query in by_hand:
        query.unload()
    assert not lamps.resources()
