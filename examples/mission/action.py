"""The action: load the robot and a lidar, have it drive to the goal, release everything. And what is done to it."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import rr_actors as rr
from mission.corridor import ROUTE, distance
from mission.record import Record, Sample
from mission.sabotage import Saboteur, Strike, answers, child_pid, replaced
from mission.wire import Subscriber
from rr_actors.managers import Components, LoadComponent, LoadRobot, Programs, Ready, Robots, RunProgram
from rr_actors.system.recording.timelines import timeline_of

HERE = Path(__file__).parent
ROUTE_M = sum(distance(a, b) for a, b in itertools.pairwise(ROUTE))
_LOOK_S = 0.02
_RUN_LIMIT_S = 120.0


@dataclass(frozen=True)
class Plan:
    """What one run is to be like: `faults` at these shares of the way."""

    title: str
    faults: tuple[float, ...] = ()
    recovery: bool = True
    speed: float = 1.0
    seed: int = 1


class View(Protocol):
    """Who is shown the run."""

    def say(self, text: str) -> None:
        """Something has happened."""
        ...

    def look(self, record: Record, system: rr.System, state: str) -> None:
        """A moment has passed."""
        ...


def run(plan: Plan, directory: Path, view: View) -> Record:
    """Run the mission once, on real processes, below `directory`."""
    record = Record(plan.title)
    config = rr.SystemConfig(preload=("rr_actors.managers",))  # imported once, before the managers are forked
    with rr.System(managers(recovery=plan.recovery), state_dir=directory / "state", config=config) as system:
        mission = Mission(plan, directory, system, record, view)
        with system.record() as recording:
            with mission.loaded():
                mission.drive()
            record.timeline = timeline_of(recording.entries(), f"the mission, {plan.title}")
        record.resources_left = count_resources(system)
    return record


def managers(*, recovery: bool) -> list[rr.ChildSpec]:
    """The three managers, each a process of its own, restarted when it dies."""
    components = {"registry": str(HERE / "components.toml"), "replace": recovery}
    robots = {"descriptions": str(HERE / "robots.toml"), "replace": recovery}
    return [
        rr.ChildSpec(Programs, id="programs"),
        rr.ChildSpec(Components, id="components", kwargs=components),
        rr.ChildSpec(Robots, id="robots", kwargs=robots),
    ]


class Mission:
    """One run: what it holds, and the drive."""

    def __init__(self, plan: Plan, directory: Path, system: rr.System, record: Record, view: View) -> None:
        self.plan = plan
        self.system = system
        self.record = record
        self.view = view
        self.app = system.open_registrar("action")
        self.lost: str | None = None  # why the mission cannot go on
        self._sockets = directory
        self._parameters = {"run": str(directory), "speed": str(plan.speed), "seed": str(plan.seed)}
        self._poses = Subscriber(str(directory / "world.sock"))
        self._began = self._world_began_s = 0.0
        self._state = "waiting"

    # -- what the action holds -------------------------------------------------------------------------------------

    @contextmanager
    def loaded(self) -> Iterator[None]:
        """Have the world, the robot and a lidar; release them in the end."""
        load = self.app.load
        motors = str(self._sockets / "motors.sock")
        world = RunProgram(
            sys.executable,
            ("-m", "mission.world", "--poses", self._poses.path, "--motors", motors, "--speed", str(self.plan.speed)),
            directory=str(HERE.parent),
            ready=Ready(line="the world is there"),
        )
        with (
            load("programs/program", world) as self.world,
            load("robots/robot", LoadRobot("rover", self._parameters), on_status=self._heard) as self.robot,
            load("components/component", LoadComponent("lidar", self._parameters), on_status=self._heard) as self.lidar,
        ):
            self._controller = Subscriber(self.robot.response.controller.parameters["listen"])
            try:
                yield
            finally:
                self._controller.close()
                self._poses.close()

    def _heard(self, status: rr.Status) -> None:
        """What a holder hears: UPDATE, the part was replaced; FATAL, it could not be."""
        self.view.say(f"  {status.state}: {status.message.partition('; last output')[0]}")
        if status.state is rr.State.FATAL:
            self.lost = status.message

    # -- the drive -------------------------------------------------------------------------------------------------

    def drive(self) -> None:
        """Drive to the goal, or until it cannot go on; faults come on the way."""
        at_m = [share * ROUTE_M for share in self.plan.faults]
        saboteur = Saboteur(self._strikes(), at_m, self.record, self.view.say)
        self._began = time.monotonic()
        outcome = None
        while outcome is None:
            time.sleep(_LOOK_S)
            self._steer_and_watch()
            saboteur.look()
            self.view.look(self.record, self.system, self._state)
            outcome = self._outcome()
        saboteur.finish()
        self.record.finish(outcome)

    def _strikes(self) -> list[Strike]:
        app, robot, lidar, system = self.app, self.robot, self.lidar, self.system
        return [
            Strike("F1", "lidar 1", lambda: lidar.response.pid, replaced(lidar)),
            Strike("F2", "motor driver", lambda: robot.response.driver.pid, replaced(robot)),
            Strike("F3", "program manager", child_pid(system, "programs"), answers(app, self.world)),
            Strike("F4", "component manager", child_pid(system, "components"), answers(app, lidar)),
            Strike("F5", "robot manager", child_pid(system, "robots"), answers(app, robot)),
        ]

    def _steer_and_watch(self) -> None:
        self._controller.poll()
        self._controller.send({"go": True, "lidar": self.lidar.response.parameters["scans"]})
        if self._controller.latest:
            self._state = self._controller.latest["state"]
        for seen in self._poses.poll():
            if not self.record.samples:  # the world's clock and ours begin together
                self._began, self._world_began_s = time.monotonic(), seen["time_s"]
            time_s = (seen["time_s"] - self._world_began_s) / self.plan.speed
            x, y, _ = seen["pose"]
            self.record.samples.append(Sample(time_s, x, y, seen["driven_m"], seen["speed"]))

    def _outcome(self) -> str | None:
        if self._state == "arrived":
            self.record.time_s = self.record.time_s or self.now()
            if self._stands():
                return "arrived"
        if self.lost is not None and self._stands():
            return f"stopped at {self.record.faults[-1].name}" if self.record.faults else f"stopped: {self.lost}"
        if self.now() > _RUN_LIMIT_S / min(1.0, self.plan.speed):
            return f"stuck: {self._state}"
        return None

    def _stands(self) -> bool:
        return bool(self.record.samples) and abs(self.record.samples[-1].speed) < 0.001

    def now(self) -> float:
        """Seconds since the drive began."""
        return time.monotonic() - self._began


def count_resources(system: rr.System) -> int:
    """Resources that are still there, on any registrar."""
    return sum(len(registrar["resources"]) for registrar in system.snapshot()["registrars"].values())
