"""The action: load the robot and a lidar, have it drive to the goal, release everything. And what is done to it."""

from __future__ import annotations

import itertools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import rr_actors as rr
from mission.corridor import ROUTE, distance
from mission.record import Fault, Record, Sample
from mission.wire import Subscriber
from rr_actors.managers import Components, LoadComponent, LoadRobot, Programs, Ready, Robots, RunProgram

HERE = Path(__file__).parent
ROUTE_M = sum(distance(a, b) for a, b in itertools.pairwise(ROUTE))
_LOOK_S = 0.02
_FAULT_LIMIT_S = 20.0  # a fault that is not repaired by then will not be
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
        with mission.loaded():
            mission.drive()
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
        self.world = RunProgram(
            sys.executable,
            ("-m", "mission.world", "--poses", self._poses.path, "--motors", motors, "--speed", str(self.plan.speed)),
            directory=str(HERE.parent),
            ready=Ready(line="the world is there"),
        )
        with (
            load("programs/program", self.world),
            load("robots/robot", LoadRobot("rover", self._parameters), on_status=self._heard) as self.robot,
            load("components/component", self.look_around(), on_status=self._heard) as self.lidar,
        ):
            self._controller = Subscriber(self.robot.response.controller.parameters["listen"])
            try:
                yield
            finally:
                self._controller.close()
                self._poses.close()

    def look_around(self) -> LoadComponent:
        return LoadComponent("lidar", self._parameters)

    def _heard(self, status: rr.Status) -> None:
        """What a holder hears: UPDATE, the part was replaced; FATAL, it could not be."""
        self.view.say(f"  {status.state}: {status.message.partition('; last output')[0]}")
        if status.state is rr.State.FATAL:
            self.lost = status.message

    # -- the drive -------------------------------------------------------------------------------------------------

    def drive(self) -> None:
        """Drive to the goal, or until it cannot go on; faults come on the way."""
        saboteur = Saboteur(self)
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
            return f"stopped at {self.record.faults[-1].name}"
        if self.now() > _RUN_LIMIT_S / min(1.0, self.plan.speed):
            return f"stuck: {self._state}"
        return None

    def _stands(self) -> bool:
        return bool(self.record.samples) and abs(self.record.samples[-1].speed) < 0.001

    def now(self) -> float:
        """Seconds since the drive began."""
        return time.monotonic() - self._began


class Saboteur:
    """Kills one process after the other, each when the robot has come a certain share of its way."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        app, robot, lidar = mission.app, mission.robot, mission.lidar
        replaced = _until_updated
        warm = _until_loaded
        self._plan: list[tuple[str, str, Callable[[], int], Callable[[], Any]]] = [
            ("F1", "lidar 1", lambda: lidar.response.pid, replaced(lidar, mission)),
            ("F2", "motor driver", lambda: robot.response.driver.pid, replaced(robot, mission)),
            ("F3", "program manager", self._pid_of("programs"), warm(app, "programs/program", mission.world)),
            ("F4", "component manager", self._pid_of("components"), warm(app, lidar.server_id, lidar.request)),
            ("F5", "robot manager", self._pid_of("robots"), warm(app, robot.server_id, robot.request)),
        ]
        self._due = [share * ROUTE_M for share in mission.plan.faults]
        self._repair: threading.Thread | None = None

    def look(self) -> None:
        """Strike if it is time to; never before the last fault is repaired."""
        samples, done = self._mission.record.samples, len(self._mission.record.faults)
        if done >= len(self._due) or not samples or samples[-1].driven_m < self._due[done]:
            return
        if self._repair is None or not self._repair.is_alive():
            self._strike(*self._plan[done], samples[-1])

    def finish(self) -> None:
        """Wait for the last repair to be timed."""
        if self._repair is not None:
            self._repair.join(_FAULT_LIMIT_S)

    def _strike(self, name: str, what: str, victim: Callable[[], int], serving: Callable[[], Any], at: Sample) -> None:
        now = self._mission.now()
        fault = Fault(name, what, now, at.x, at.y, at.driven_m)
        self._mission.record.faults.append(fault)
        pid = victim()
        self._mission.view.say(f"{name}: SIGKILL for {what} (pid {pid})")
        began = time.monotonic()
        os.kill(pid, signal.SIGKILL)

        def repaired() -> None:
            if serving():
                fault.serving_s = time.monotonic() - began
                self._mission.view.say(f"{name}: {what} serves again after {fault.serving_s * 1000:.0f} ms")

        self._repair = threading.Thread(target=repaired, name=f"repair-{name}")
        self._repair.start()

    def _pid_of(self, child: str) -> Callable[[], int]:
        def pid() -> int:
            children = {found.id: found for found in self._mission.system.supervisor().which_children()}
            return children[child].pid or 0

        return pid


def _until_updated(query: rr.Query, mission: Mission) -> Callable[[], bool]:
    """Wait until a part was replaced; False if it could not be."""

    def wait() -> bool:
        return query.wait_status(timeout_s=_FAULT_LIMIT_S).state is rr.State.UPDATE

    return wait


def _until_loaded(app: rr.Registrar, server: str, request: Any) -> Callable[[], bool]:
    """Wait until a manager answers: load what is loaded already, which takes no longer than the answer."""

    def wait() -> bool:
        app.load(server, request, timeout_s=_FAULT_LIMIT_S).unload()
        return True

    return wait


def count_resources(system: rr.System) -> int:
    """Resources that are still there, on any registrar."""
    return sum(len(registrar["resources"]) for registrar in system.snapshot()["registrars"].values())
