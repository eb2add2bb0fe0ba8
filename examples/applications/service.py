"""A service: in a container as process 1, under systemd, or in a terminal. SIGTERM and Ctrl-C end it cleanly."""

from __future__ import annotations

import logging

import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        logging.getLogger("cameras").info("the %s camera is open", device)
        return f"/images/{device}"

    @open_camera.unload
    def close_camera(self, device: str, response: str) -> None:
        logging.getLogger("cameras").info("the %s camera is closed", device)


class Recorder(rr.Manager):
    def on_start(self) -> None:
        rr.send_after(0.1, self.actor_ref, "record")  # when the system has started

    def on_receive(self, message: str) -> None:
        self.registrar.load(Cameras.open_camera, "front")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO)
    children = [rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Recorder, id="recorder")]
    rr.System(children, state_dir="rr_state").run()
