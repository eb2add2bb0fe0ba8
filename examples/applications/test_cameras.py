"""Tests of an application with pytest. The fixture rr_system comes with rr_actors: pytest test_cameras.py"""

from __future__ import annotations

import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        return f"/images/{device}"


def test_a_camera_has_a_topic(rr_system: rr.StartSystem) -> None:
    app = rr_system(rr.ChildSpec(Cameras, id="cameras")).open_registrar("app")
    assert app.load("cameras/camera", "front").response == "/images/front"


def test_a_camera_is_fine_in_a_thread_too(rr_system: rr.StartSystem) -> None:
    system = rr_system(rr.ChildSpec(Cameras, id="cameras", placement="thread"))
    with system.open_registrar("app").load("cameras/camera", "front") as camera:
        assert camera.state is rr.State.OK
