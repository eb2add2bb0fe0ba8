"""Camera: a manager publishes pictures to all who hold its camera. They go on with the pictures after its SIGKILL.

python examples/camera.py
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
from dataclasses import dataclass

import rr_actors as rr


@dataclass(frozen=True)
class Picture:
    pid: int  # of the process that made it
    pixels: bytes


class Cameras(rr.Manager):
    def __init__(self) -> None:
        self.off: dict[str, threading.Event] = {}  # by the id of the resource: a device may have two for a while

    @rr.server("camera", recovery="reload")  # a respawned manager opens its cameras again
    def open_camera(self, device: str) -> rr.Stream:
        me = rr.current()
        images = me.open_stream("images")
        off = self.off[me.resource_id] = threading.Event()

        def run() -> None:
            while not off.wait(0.01):
                images.publish(Picture(os.getpid(), bytes(640 * 480)))

        threading.Thread(target=run, daemon=True).start()
        return images.stream

    @open_camera.unload
    def close_camera(self, device: str, response: rr.Stream) -> None:
        self.off.pop(rr.current().resource_id, threading.Event()).set()  # after a crash in this callback there is none


def main() -> None:
    children = [rr.ChildSpec(Cameras, id="cameras")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        display = system.open_registrar("display").load(Cameras.open_camera, "front").stream(timeout_s=20)
        recorder = system.open_registrar("recorder").load("cameras/camera", "front").stream(keep="all", timeout_s=20)
        picture = next(display).value
        print(f"both have pictures of {len(picture.pixels)} bytes: {next(recorder).value == picture}", flush=True)
        os.kill(picture.pid, signal.SIGKILL)
        for name, reader in (("display", display), ("recorder", recorder)):
            after = next(frame for frame in reader if frame.value.pid != picture.pid)
            print(f"{name} goes on with picture {after.number} of the new process", flush=True)


if __name__ == "__main__":
    main()
