"""Replacing a failed part: a spare takes its place in one call, also if the manager is killed in the middle of it.

python examples/replacing.py
"""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import rr_actors as rr


class Lidars(rr.Manager):
    @rr.server("lidar")
    def load_lidar(self, request: str) -> str:
        return f"/scan/{request}"

    @load_lidar.unload
    def unload_lidar(self, request: str, response: str | None) -> None:
        print(f"lidar {request} is released", flush=True)


class Robots(rr.Manager):
    @rr.server("robot", recovery="keep")
    def load_robot(self, request: str) -> str:
        return self.registrar.load(Lidars.load_lidar, "front").response

    @load_robot.status
    def robot_status(self, request: str, status: rr.Status) -> None:
        if status.resource_id != rr.current().resource_id and status.state is rr.State.FATAL:
            self.registrar.replace_part(status, "spare", response=self.with_spare)

    def with_spare(self, spare: rr.Query[str]) -> str:
        killed = Path(self.registrar.directory, "killed")
        if not killed.exists():  # the spare is loaded, and the failed lidar still held: the worst moment
            killed.touch()
            print("killed, with both lidars held", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        return spare.response


def main() -> None:
    children = [rr.ChildSpec(Lidars, id="lidars"), rr.ChildSpec(Robots, id="robots")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        robot = system.open_registrar("app").load("robots/robot", "clearbot")
        (front,) = system.registrar("lidars").resources()
        system.registrar("lidars").send_status(front.id, rr.Status(rr.State.FATAL, "unplugged"))
        print(f"the app hears {robot.wait_status(timeout_s=20).state}: {robot.response}")
        held = [part.request for part in system.registrar("robots").queries()]
        print(f"the robot holds: {', '.join(held)}")


if __name__ == "__main__":
    main()
