"""A part is replaced while the managers are SIGKILLed: the whole has one of both parts, and nobody holds the other."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from support import Workshop, eventually, kill, pid_of, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 20.0
ROUNDS = 25


class Lidars(rr.Manager):
    """Serves "lidar"; a lidar is at once there, unless the test has shut its step."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("lidar")
    def load_lidar(self, request: str) -> str:
        self.work.step(f"lidar {request}")
        return f"/scan/{request}"

    @load_lidar.unload
    def unload_lidar(self, request: str, response: str | None) -> None:
        pass


class Robots(rr.Manager):
    """Serves "robot": an arm and a lidar. A FATAL lidar is replaced by that of the next number."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("robot", recovery="keep")
    def load_robot(self, request: str) -> str:
        self.registrar.load("lidars/lidar", "arm")
        return self.registrar.load("lidars/lidar", "0").response

    @load_robot.status
    def robot_status(self, request: str, status: rr.Status) -> None:
        if status.resource_id == rr.current().resource_id or status.state is not rr.State.FATAL:
            return
        (part,) = [part for part in self.registrar.queries() if part.id == status.query_id]
        self.work.note("replace", part.request)
        self.die_at("the beginning")
        self.registrar.replace_part(status, str(int(part.request) + 1), response=self.new_response, timeout_s=LIMIT_S)
        self.die_at("the end")

    def new_response(self, spare: rr.Query) -> str:
        self.die_at("the spare")
        return spare.response

    def die_at(self, point: str) -> None:
        """Die here once, if the test has said so."""
        sign = self.work.root / point
        if sign.exists():
            sign.unlink()
            os.kill(os.getpid(), signal.SIGKILL)


class World:
    """A robot that the application holds, and its lidars."""

    def __init__(self, start: Start, workshop: Workshop) -> None:
        args = (str(workshop.root),)
        children = [rr.ChildSpec(Lidars, id="lidars", args=args), rr.ChildSpec(Robots, id="robots", args=args)]
        self.system = start(rr.Supervisor(children, id="root", max_restarts=10_000, max_seconds=1.0))
        self.lidars = self.system.registrar("lidars")
        self.robots = self.system.registrar("robots")
        self.heard: list[rr.State] = []
        self.robot = self.system.open_registrar("app").load(
            "robots/robot", "clearbot", on_status=lambda status: self.heard.append(status.state)
        )

    def fail(self, number: int) -> None:
        (lidar,) = [lidar for lidar in self.lidars.resources() if lidar.request == str(number)]
        self.lidars.send_status(lidar.id, rr.Status(rr.State.FATAL, "unplugged"))

    def hear(self, number: int) -> None:
        """Have the robot hear a status and pass it on: a run that ends, so the deaths in the runs before do not count.

        After three deaths in a row the status callback would not run any more.
        """
        before = len(self.heard)
        (lidar,) = [lidar for lidar in self.lidars.resources() if lidar.request == str(number)]
        self.lidars.send_status(lidar.id, rr.Status(rr.State.WARNING, "dusty"))
        eventually(lambda: rr.State.WARNING in self.heard[before:], LIMIT_S, "the robot passed the status on")

    def has(self, number: int) -> bool:
        """Whether the robot holds its arm and this lidar, and there is nothing else, nor anything under way."""
        wanted = ["arm", str(number)]
        held = sorted(part.request for part in self.robots.queries())
        there = sorted(lidar.request for lidar in self.lidars.resources() for _ in lidar.queries)
        counts = [self.robots.stats(), self.lidars.stats()]
        busy = [stats[name] for stats in counts for name in ("owed", "loading", "unloading", "notices")]
        if held != sorted(wanted) or there != sorted(wanted) or any(busy):
            return False
        ids = {part.id for part in self.robots.queries()}
        return ids == {id for lidar in self.lidars.resources() for id in lidar.queries}

    def settled_with(self, number: int) -> None:
        eventually(lambda: self.has(number), LIMIT_S, f"the robot with lidar {number} alone")
        eventually(lambda: self.robot.response == f"/scan/{number}", LIMIT_S, "the new response")


@pytest.mark.parametrize("point", ["the beginning", "the spare", "the end"])
def test_a_manager_that_dies_at_a_point_of_the_call_has_replaced_the_part_when_it_is_back(
    start: Start, workshop: Workshop, point: str
) -> None:
    world = World(start, workshop)
    before = pid_of(world.system, "robots")
    sign: Path = workshop.root / point
    sign.touch()
    world.fail(0)
    wait_respawned(world.system, "robots", before)
    world.settled_with(1)
    assert not sign.exists()
    assert len(workshop.lines("replace 0")) == (1 if point == "the end" else 2)
    assert set(world.heard) == {rr.State.UPDATE}  # what is replaced concerns nobody above
    assert len(world.heard) == 1


@pytest.mark.parametrize("victims", [("robots",), ("robots", "lidars"), ("lidars", "robots")])
def test_a_manager_that_dies_while_the_spare_is_being_loaded_loads_it_again(
    start: Start, workshop: Workshop, victims: tuple[str, ...]
) -> None:
    world = World(start, workshop)
    workshop.shut("lidar 1")
    world.fail(0)
    workshop.wait("lidar 1")
    for victim in victims:
        wait_respawned(world.system, victim, kill(world.system, victim))
    workshop.wait("replace 0", 2)
    workshop.open("lidar 1")
    world.settled_with(1)
    assert world.heard == [rr.State.UPDATE]


@pytest.mark.slow
@pytest.mark.parametrize(("victims", "seed"), [(("robots",), 1), (("lidars",), 2), (("robots", "lidars"), 3)])
def test_managers_killed_at_random_moments_of_the_call_leave_one_of_both_parts(
    start: Start, workshop: Workshop, victims: tuple[str, ...], seed: int
) -> None:
    world, moment = World(start, workshop), random.Random(seed)
    for number in range(ROUNDS):
        world.fail(number)
        time.sleep(moment.uniform(0.0, 0.008))  # the moment of the kill: any will do
        for victim in victims:
            wait_respawned(world.system, victim, kill(world.system, victim))
        world.settled_with(number + 1)
        world.hear(number + 1)
    assert rr.State.FATAL not in world.heard
    world.robot.unload()
    eventually(lambda: not world.lidars.resources() and not world.robots.resources())
