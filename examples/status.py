"""Status: whoever holds a resource hears what becomes of it, up to the first consumer, unless somebody deals with it.

python examples/status.py
"""

from __future__ import annotations

import queue
import tempfile
from typing import Any

import rr_actors as rr


def main() -> None:
    heard: queue.Queue[str] = queue.Queue()
    with tempfile.TemporaryDirectory() as state, rr.System(state_dir=state) as system:
        sensors, robots, app = (system.open_registrar(name) for name in ("sensors", "robots", "app"))
        sensors.register_server("lidar", lambda request: f"/scan/{request}")

        def load_robot(request: str) -> Any:
            return robots.load("sensors/lidar", "first").response

        def robot_status(request: str, status: rr.Status) -> None:
            if status.state is rr.State.FATAL:
                heard.put(f"robot manager hears FATAL: {status.message}")
                robots.replace_part(status, "second")  # and it is handled: nobody above needs to know
                heard.put("robot manager takes another lidar")

        def app_status(status: rr.Status) -> None:
            heard.put(f"app hears {status.state}: {status.message}")

        robots.register_server("robot", load_robot, status=robot_status)
        robot = app.load("robots/robot", "clearbot", on_status=app_status)
        (lidar,) = sensors.resources()

        sensors.send_status(lidar.id, rr.Status(rr.State.WARNING, "battery low"))
        print(heard.get(timeout=5))
        sensors.send_status(lidar.id, rr.Status(rr.State.FATAL, "lidar unplugged"))
        print(heard.get(timeout=5))
        print(heard.get(timeout=5))
        robots.send_status(robot.resource_id, rr.Status(rr.State.OK, "driving on"))
        last = heard.get(timeout=5)
        print("app hears nothing of that:", last == "app hears OK: driving on")


if __name__ == "__main__":
    main()
