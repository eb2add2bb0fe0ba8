"""The first resource: a manager in a process of its own serves cameras, and this program uses one.

python examples/first_resource.py
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass

import rr_actors as rr


@dataclass(frozen=True)
class OpenCamera:
    """The request: requests with the same content mean the same camera."""

    device: str
    fps: int = 30


@dataclass(frozen=True)
class Feed:
    """The response: where the pictures are."""

    topic: str


class Cameras(rr.Manager):
    @rr.server("camera")
    def load_camera(self, request: OpenCamera) -> Feed:
        print(f"process {os.getpid()} opens {request.device} at {request.fps} pictures a second", flush=True)
        return Feed(f"/camera{request.device}")

    @load_camera.unload
    def close_camera(self, request: OpenCamera, response: Feed) -> None:
        print(f"process {os.getpid()} closes {request.device}", flush=True)


def main() -> None:
    with tempfile.TemporaryDirectory() as state, rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=state) as s:
        print(f"process {os.getpid()} is the application", flush=True)
        app = s.open_registrar("app")
        with app.load("cameras/camera", OpenCamera("/dev/video0")) as camera:
            print("loaded:", camera.response, flush=True)
        assert not app.queries()
        print("unloaded: nothing is held any more", flush=True)


if __name__ == "__main__":
    main()
