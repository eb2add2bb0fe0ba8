"""breakpoint() in a manager: the debugger asks at the terminal that the program runs in."""

from __future__ import annotations

import sys

import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        topic = f"/images/{device}"
        breakpoint()
        return topic


if __name__ == "__main__":
    placement = "thread" if "thread" in sys.argv else "process"
    with rr.System([rr.ChildSpec(Cameras, id="cameras", heartbeat_s=1.0, placement=placement)]) as system:
        camera = system.open_registrar("app").load("cameras/camera", "front", timeout_s=None)
        print("loaded", camera.response)
