"""Components, pipes and robots go on with another component beside one that hangs, also if they are killed."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Components, LoadComponent, LoadRobot, Pipe, Pipes, Programs, Robots
from support import Calls, eventually, kill, pid_of, states, wait_respawned
from support_programs import running_programs

Start = Callable[..., rr.System]

LIMIT_S = 60.0
REQUESTS: dict[str, Any] = {
    "components/component": LoadComponent("camera"),
    "components/pipe": Pipe("image"),
    "robots/robot": LoadRobot("rover"),
}
WELL = "print('ready', flush=True); time.sleep(600)"
HANGS = "time.sleep(600)"
TAKES_THE_DEVICE = "file = open(f'{here}/device', 'w'); fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)"
WAITS = "wait(f'{here}/go')"
PROGRAM = """
import fcntl, os, time
here = os.environ["HERE"]
def wait(path):
    while not os.path.exists(path):
        time.sleep(0.01)
open(f"{here}/{os.environ['NAME']}.begun", "w")
"""


class World:
    """A system with cameras, of which the manager under test has one; the files of `here` show what has begun."""

    def __init__(self, start: Start, here: Path, server: str) -> None:
        self.here, self.server, self.heard = here, server, Calls()
        self._start = start

    def camera(self, name: str, reliability: float, *code: str, ready_s: float = 30.0, more: str = "") -> str:
        outputs = 'outputs = ["image"]' if self.server == "components/pipe" else ""
        return f"""
[[component]]
name = "{name}"
type = "camera"
reliability = {reliability}
{outputs}
{more}
[component.program]
command = "${{python}}"
arguments = ["-c", '''{PROGRAM}{"; ".join(code)}''']
environment = {{ HERE = "{self.here}", NAME = "{name}" }}
ready = {{ line = "ready", timeout_s = {ready_s} }}
grace_s = 1
"""

    def begin(self, *cameras: str) -> rr.Query:
        (self.here / "cameras.toml").write_text("".join(cameras))
        (self.here / "robots.toml").write_text('[[robot]]\nname = "rover"\ndriver = { type = "camera" }\n')
        kind = Pipes if self.server == "components/pipe" else Components
        children = [
            rr.ChildSpec(Programs, id="programs"),
            rr.ChildSpec(kind, id="components", args=(str(self.here / "cameras.toml"),)),
            rr.ChildSpec(Robots, id="robots", args=(str(self.here / "robots.toml"),)),
        ]
        self.system = self._start(rr.Supervisor(children, max_restarts=1000))
        app = self.system.open_registrar("app")
        self.query = app.load(self.server, REQUESTS[self.server], on_status=self.heard, timeout_s=LIMIT_S)
        return self.query

    def used(self) -> Any:
        """Return the component in use."""
        response = self.query.response
        if self.server == "robots/robot":
            return response.driver
        return response.segments[0] if self.server == "components/pipe" else response

    def lose(self) -> None:
        os.kill(self.used().pid, signal.SIGKILL)

    def begun(self, name: str) -> bool:
        return (self.here / f"{name}.begun").exists()

    def is_settled(self) -> bool:
        """Whether the program of the component in use runs, and no other, and nothing else is held."""
        programs = self.system.registrar("programs").resources()
        held = [query for info in programs for query in info.queries]
        return list(running_programs()) == [self.used().pid] and len(programs) == len(held) == 1

    def reliabilities(self) -> str:
        file = self.system.registrar("components").directory / "reliability.json"
        return file.read_text() if file.exists() else ""


@pytest.fixture(params=[*REQUESTS])
def world(request: pytest.FixtureRequest, start: Start, tmp_path: Path) -> World:
    return World(start, tmp_path, request.param)


def test_the_next_one_is_started_beside_one_that_hangs_and_that_is_ended_then(world: World) -> None:
    world.begin(world.camera("front", 0.9, WELL), world.camera("rear", 0.8, HANGS), world.camera("side", 0.6, WELL))
    world.lose()
    eventually(lambda: world.used().name == "side", 20)
    assert world.begun("rear")
    eventually(lambda: states(world.heard) == [rr.State.WARNING, rr.State.UPDATE])
    eventually(world.is_settled, LIMIT_S)
    assert "rear" not in world.reliabilities()
    world.query.unload()
    assert not running_programs()


def test_what_has_failed_is_started_anew_beside_another_one_that_hangs(world: World) -> None:
    world.begin(world.camera("front", 0.9, WELL), world.camera("rear", 0.8, HANGS))
    pid = world.used().pid
    world.lose()
    eventually(lambda: world.used().pid != pid, 20)
    assert world.used().name == "front"
    assert world.begun("rear")
    eventually(world.is_settled, LIMIT_S)


def test_one_that_cannot_run_beside_another_is_started_when_that_has_ended(world: World) -> None:
    world.begin(
        world.camera("front", 0.9, WELL),
        world.camera("rear", 0.8, TAKES_THE_DEVICE, HANGS, ready_s=3.0, more="break_first = true"),
        world.camera("side", 0.6, TAKES_THE_DEVICE, WELL, more="break_first = true"),
    )
    world.lose()
    eventually(lambda: world.begun("rear"), LIMIT_S)
    eventually(lambda: world.used().name == "side", LIMIT_S)
    eventually(world.is_settled, LIMIT_S)
    assert "side" not in world.reliabilities()
    assert "rear" in world.reliabilities()


def test_one_that_fails_beside_another_is_tried_again_when_that_has_ended_and_is_trusted_as_before(
    world: World,
) -> None:
    world.begin(
        world.camera("front", 0.9, f"if os.path.exists(f'{{here}}/broken'): raise SystemExit(1)\n{WELL}"),
        world.camera("rear", 0.8, TAKES_THE_DEVICE, HANGS, ready_s=4.0),
        world.camera("side", 0.6, TAKES_THE_DEVICE, WELL),
    )
    (world.here / "broken").touch()
    world.lose()
    eventually(lambda: world.used().name == "side", LIMIT_S)
    eventually(world.is_settled, LIMIT_S)
    assert "side" not in world.reliabilities()


def test_a_release_ends_the_search_while_the_next_one_hangs(world: World) -> None:
    world.begin(
        world.camera("front", 0.9, WELL), world.camera("rear", 0.8, HANGS, ready_s=600.0, more="break_first = true")
    )
    world.lose()
    eventually(lambda: world.begun("rear"), LIMIT_S)
    world.query.unload()
    eventually(lambda: not running_programs(), 20)
    eventually(lambda: not world.system.registrar("programs").resources(), 20)


@pytest.mark.parametrize("moment", ["rear hangs", "side begins", "side is well", "side is used"])
def test_killed_at_any_moment_it_has_one_component_in_the_end_and_loses_nothing(world: World, moment: str) -> None:
    manager = world.server.partition("/")[0]
    world.begin(
        world.camera("front", 0.9, WELL), world.camera("rear", 0.8, HANGS), world.camera("side", 0.6, WAITS, WELL)
    )
    front = world.used().pid
    world.lose()
    eventually(lambda: world.begun("rear" if moment == "rear hangs" else "side"), LIMIT_S)
    if moment in ("side is well", "side is used"):
        (world.here / "go").touch()
    if moment == "side is used":
        eventually(lambda: world.used().name == "side", LIMIT_S)
    old = pid_of(world.system, manager)
    kill(world.system, manager)
    wait_respawned(world.system, manager, old)
    (world.here / "go").touch()
    eventually(lambda: world.used().pid != front, LIMIT_S)
    eventually(world.is_settled, LIMIT_S)
    assert rr.State.FATAL not in states(world.heard)
    world.query.unload()
    assert not running_programs()


@pytest.mark.parametrize("world", ["components/component"], indirect=True)
def test_the_best_one_that_hangs_costs_a_new_component_half_of_its_time(world: World) -> None:
    began = time.monotonic()
    world.begin(world.camera("front", 0.9, HANGS, ready_s=12.0), world.camera("rear", 0.8, WELL, ready_s=12.0))
    assert world.used().name == "rear"
    assert time.monotonic() - began < 11
    eventually(world.is_settled, LIMIT_S)
