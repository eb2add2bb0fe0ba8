"""What the tests of hosts share: a manager with cameras, one that needs them, and systems that find each other."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import rr_actors as rr
from support_transports import free_port


class Cameras(rr.Manager):
    """Serves cameras: the response counts the loads, and names the process."""

    @rr.server("camera")
    def load_camera(self, request: str) -> dict[str, str]:
        if request == "broken":
            raise ValueError("no such device")
        return {"device": request}

    @rr.server("scope", exclusive=True)
    def load_scope(self, request: str) -> str:
        return request

    @load_camera.recover
    def again(self, request: str, response: dict[str, str]) -> dict[str, str]:
        return response


class Maps(rr.Manager):
    """Serves maps, each made from a camera of hostc."""

    @rr.server("map")
    def load_map(self, request: str) -> dict[str, str]:
        camera = self.registrar.load("cameras/camera", request)
        return {"map": camera.response["device"]}


class Warmed(rr.Manager):
    """Serves what says how far its load has come."""

    @rr.server("lamp")
    def load_lamp(self, request: str) -> str:
        rr.current().progress(0.5, "warm")
        return request


class Loops(rr.Manager):
    """Serves what needs the same of the other host, which needs it of this one: a ring."""

    @rr.server("loop")
    def load_loop(self, request: str) -> str:
        return self.registrar.load("other/loop", request).response


def endpoint() -> str:
    """Return an endpoint on loopback that nothing uses now."""
    return f"tcp/127.0.0.1:{free_port()}"


def cameras_at(state_dir: Path, listen: str, name: str = "hostb", to: tuple[str, ...] | None = None) -> rr.System:
    """Return a system that exports cameras, not started."""
    hosts = rr.Hosts(name, listen=[listen], exports={"cameras": rr.Export(to=to)})
    return rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=state_dir, hosts=hosts)


def until(condition: Callable[[], bool], what: str, limit_s: float = 30.0) -> None:
    """Wait until a condition holds; fail after `limit_s` seconds."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {limit_s:g} s: {what}"
        time.sleep(0.01)
