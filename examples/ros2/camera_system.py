"""A camera for the nodes of ROS 2: one system, and a bridge that says what nodes may load.

python examples/ros2/camera_system.py, in a shell in which ROS 2 is sourced; then camera_node.py in another one.
"""

from __future__ import annotations

from pathlib import Path

import rr_actors as rr
from rr_actors import ros2


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> dict[str, str]:
        print(f"opens {device}", flush=True)
        return {"topic": f"/camera{device}"}

    @open_camera.unload
    def close_camera(self, device: str, response: dict[str, str]) -> None:
        print(f"closes {device}", flush=True)


if __name__ == "__main__":
    bridge = rr.ChildSpec(ros2.Bridge, id="ros", args=(str(Path(__file__).with_name("ros.toml")),))
    rr.System([rr.ChildSpec(Cameras, id="cameras"), bridge]).run()
