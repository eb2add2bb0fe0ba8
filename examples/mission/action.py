"""The mission: a graph of actions that have a robot, and drive it to the goal or stop it; and what is done to it.

The graph is in mission.json. Its actions run in a thread of this process, so that they can show and record the drive.
"""

from __future__ import annotations

import itertools
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

import rr_actors as rr
from mission.corridor import ROUTE, distance
from mission.record import Record, Sample
from mission.sabotage import Saboteur, Strike, answers, child_pid, replaced
from mission.wire import Subscriber
from rr_actors.managers import Actions, Components, LoadComponent, LoadRobot, Programs, Ready, Robots, RunProgram
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
        Step.mission = mission = Mission(plan, directory, system, record, view)
        with system.record() as recording:
            record.finish(mission.outcome())
            record.timeline = timeline_of(recording.entries(), f"the mission, {plan.title}")
        record.resources_left = count_resources(system)
    return record


def managers(*, recovery: bool) -> list[rr.ChildSpec]:
    """The three managers, each a process of its own, restarted when it dies; and the one that runs the graph."""
    components = {"registry": str(HERE / "components.toml"), "replace": recovery}
    robots = {"descriptions": str(HERE / "robots.toml"), "replace": recovery}
    return [
        rr.ChildSpec(Programs, id="programs"),
        rr.ChildSpec(Components, id="components", kwargs=components),
        rr.ChildSpec(Robots, id="robots", kwargs=robots),
        rr.ChildSpec(Actions, id="actions", kwargs={"actions": [HaveRobot, Drive, Stop]}, placement="thread"),
    ]


# -- the actions of the graph ----------------------------------------------------------------------------------------


class Step(rr.Action):
    """One step of the mission that goes on now."""

    mission: ClassVar[Mission]


class HaveRobot(Step):
    """Load the robot. The graph says "asynchronous": it is kept until the graph ends."""

    def run(self, given: object) -> None:
        self.load("robots/robot", LoadRobot("rover", self.mission.parameters))


class Drive(Step):
    """Drive to the goal. Parts are replaced on the way (UPDATE); if one is lost (FATAL), the result is False."""

    def run(self, given: object) -> bool:
        mission, heard = self.mission, self.mission.heard
        robot = self.load("robots/robot", LoadRobot("rover", mission.parameters), on_status=heard)
        lidar = self.load("components/component", LoadComponent("lidar", mission.parameters), on_status=heard)
        return mission.drive(robot, lidar, self.stopping)


class Stop(Step):
    """The fallback routine: have the robot stop where it is (thesis, Fig. 6.3)."""

    def run(self, given: object) -> None:
        self.mission.stop(self.stopping)


class Mission:
    """One run: the world, the graph, and what its actions do."""

    def __init__(self, plan: Plan, directory: Path, system: rr.System, record: Record, view: View) -> None:
        self.plan = plan
        self.system = system
        self.record = record
        self.view = view
        self.app = system.open_registrar("mission")
        self.parameters = {"run": str(directory), "speed": str(plan.speed), "seed": str(plan.seed)}
        self._motors = str(directory / "motors.sock")
        self._poses = Subscriber(str(directory / "world.sock"))
        self._lost = ""  # why the mission cannot go on
        self._began = self._world_began_s = 0.0
        self._state = "waiting"

    def outcome(self) -> str:
        """Run the graph in a world, and return how it has ended."""
        sockets = ("--poses", self._poses.path, "--motors", self._motors)
        world = RunProgram(
            sys.executable,
            ("-m", "mission.world", *sockets, "--speed", str(self.plan.speed)),
            directory=str(HERE.parent),
            ready=Ready(line="the world is there"),
        )
        with self.app.load("programs/program", world) as self.world:
            try:
                limit_s = _RUN_LIMIT_S / min(1.0, self.plan.speed)
                ended = rr.run_graph(self.app, HERE / "mission.json", timeout_s=limit_s)
            except rr.LoadTimeout:
                return f"stuck: {self._state}"
            finally:
                self._poses.close()
        if ended.result == "on_error":
            raise rr.LoadFailed(ended.error, server="actions/graph")
        if ended.states["Stop_0"] == "UNINITIALIZED":
            return "arrived"
        return f"stopped at {self.record.faults[-1].name}" if self.record.faults else f"stopped: {self._lost}"

    def heard(self, status: rr.Status) -> None:
        """What a holder hears: UPDATE, the part was replaced; FATAL, it could not be."""
        self.view.say(f"  {status.state}: {status.message.partition('; last output')[0]}")
        if status.state is rr.State.FATAL:
            self._lost = status.message

    # -- the drive -------------------------------------------------------------------------------------------------

    def drive(self, robot: rr.Query, lidar: rr.Query, stopping: threading.Event) -> bool:
        """Drive to the goal, or until it cannot go on; faults come on the way."""
        at_m = [share * ROUTE_M for share in self.plan.faults]
        saboteur = Saboteur(self._strikes(robot, lidar), at_m, self.record, self.view.say)
        self._controller = Subscriber(robot.response.controller.parameters["listen"])
        self._began = time.monotonic()
        while not (self._has_arrived() or stopping.wait(_LOOK_S)):
            self._steer_and_watch({"go": True, "lidar": lidar.response.parameters["scans"]})
            saboteur.look()
        if self._lost or not stopping.is_set():  # else it is interrupted
            saboteur.finish()
        return not stopping.is_set()

    def stop(self, stopping: threading.Event) -> None:
        """Stop, and wait until the robot stands."""
        while not (self._stands() or stopping.wait(_LOOK_S)):
            self._steer_and_watch({"go": False})

    def _strikes(self, robot: rr.Query, lidar: rr.Query) -> list[Strike]:
        app, system = self.app, self.system
        return [
            Strike("F1", "lidar 1", lambda: lidar.response.pid, replaced(lidar), "disconnected", signal.SIGUSR1),
            Strike("F2", "motor driver", lambda: robot.response.driver.pid, replaced(robot)),
            Strike("F3", "program manager", child_pid(system, "programs"), answers(app, self.world)),
            Strike("F4", "component manager", child_pid(system, "components"), answers(app, lidar)),
            Strike("F5", "robot manager", child_pid(system, "robots"), answers(app, robot)),
            Strike("F6", "lidar 2", lambda: lidar.response.pid, replaced(lidar)),
        ]

    def _steer_and_watch(self, order: dict[str, object]) -> None:
        self._controller.poll()
        self._controller.send(order)
        if self._controller.latest:
            self._state = self._controller.latest["state"]
        for seen in self._poses.poll():
            if not self.record.samples:  # the world's clock and ours begin together
                self._began, self._world_began_s = time.monotonic(), seen["time_s"]
            time_s = (seen["time_s"] - self._world_began_s) / self.plan.speed
            x, y, _ = seen["pose"]
            self.record.samples.append(Sample(time_s, x, y, seen["driven_m"], seen["speed"]))
        self.view.look(self.record, self.system, self._state)

    def _has_arrived(self) -> bool:
        if self._state != "arrived":
            return False
        self.record.time_s = self.record.time_s or self.now()
        return self._stands()

    def _stands(self) -> bool:
        return bool(self.record.samples) and abs(self.record.samples[-1].speed) < 0.001

    def now(self) -> float:
        """Seconds since the drive began."""
        return time.monotonic() - self._began


def count_resources(system: rr.System) -> int:
    """Resources that are still there, on any registrar."""
    return sum(len(registrar["resources"]) for registrar in system.snapshot()["registrars"].values())
