"""A typed program: what type checkers know of loads. tests/base/test_typing.py has mypy and pyright read it, and runs
it.
"""

from __future__ import annotations

import asyncio
import tempfile
from dataclasses import dataclass
from typing import Any, assert_type

import pykka

import rr_actors as rr


@dataclass(frozen=True)
class OpenCamera:
    device: str
    fps: int = 30


@dataclass(frozen=True)
class Feed:
    topic: str


class Cameras(rr.Manager):
    @rr.server("camera", linger_s=0.5, recovery="reload")
    def open_camera(self, request: OpenCamera) -> Feed:
        return Feed(f"/images{request.device}")

    @open_camera.unload
    def close_camera(self, request: OpenCamera, response: Feed) -> None:
        self.last = request.device

    @open_camera.status
    async def camera_status(self, request: OpenCamera, status: rr.Status) -> None:
        assert_type(status.state, rr.State)

    @open_camera.recover
    def recover_camera(self, request: OpenCamera, response: Feed) -> Feed:
        return self.open_camera(request)

    @open_camera.usage
    async def camera_usage(self, request: OpenCamera, response: Feed) -> dict[str, int]:
        return {"frames": 1}

    @open_camera.upgrade
    def upgrade_camera(self, request: Any, response: Any) -> tuple[OpenCamera, Feed]:
        return OpenCamera(request["device"]), Feed(response["topic"])

    @rr.server("lamp", idle="pause", health=rr.Health(every_s=5.0))
    def open_lamp(self, name: str) -> Feed | None:
        return None

    @open_lamp.health
    def look(self, name: str, response: Feed | None) -> rr.State | None:
        return None

    @open_lamp.pause
    async def pause_lamp(self, name: str, response: object) -> int:
        return 3

    @open_lamp.resume
    async def resume_lamp(self, name: str, response: Feed | None) -> Feed:
        return Feed(name)

    @rr.server("rate")
    async def measure_rate(self, device: str) -> float:
        camera = await self.registrar.load_async(Cameras.open_camera, OpenCamera(device))
        assert_type(camera, rr.Query[Feed])
        return 30.0

    def on_start(self) -> None:
        assert_type(self.actor_ref.path, str | None)
        rr.send_after(60.0, self.actor_ref, "look")

    def me(self) -> rr.ActorRef[Any]:
        return self.actor_ref

    @rr.server("zoom")
    def zoom(self, device: str, factor: float = 1.0) -> Feed:
        return Feed(f"{device} at {factor}")

    @zoom.unload
    def end_zoom(self, device: str, response: Feed) -> None: ...

    @zoom.recover
    def recover_zoom(self, factor: float, device: str, response: Feed) -> Feed:
        return response

    @rr.server("all")
    def open_all(self) -> list[str]:
        return []

    @rr.server("anything")
    def anything(self, request: Any) -> Any:
        return request


class BetterCameras(Cameras):
    """Inherits its servers."""


def on_event(event: rr.Event) -> str:
    if event["event"] == "exited":
        assert_type(event, rr.ChildEvent)
        return event["path"]
    if event["event"] == "loaded":
        return event["resource_id"]
    if event["event"] == "progress":
        assert_type(event["fraction"], float)
        return event["text"]
    if event["event"] == "stream_opened":
        assert_type(event, rr.StreamEvent)
        return event["stream"]
    return event["event"]


def on_any_event(event: dict[str, Any]) -> str:
    return str(event["event"])


def subscribed(system: rr.System) -> None:
    system.subscribe(on_event)
    system.subscribe(on_any_event)
    system.subscribe(lambda event: print(event["event"]))


def plain(query: rr.Query) -> Any:
    """A Query alone is one of any response."""
    return query.response


def use(app: rr.Registrar, block: bool) -> None:
    named = app.load("cameras/camera", OpenCamera("/dev/video0"))
    assert_type(named, rr.Query[Any])
    typed = app.load("cameras/camera", {"device": "/dev/video0"}, response_type=Feed)
    assert_type(typed, rr.Query[Feed])
    assert_type(typed.response.topic, str)
    declared = app.load(Cameras.open_camera, OpenCamera("/dev/video0"), on_status=print, timeout_s=5)
    assert_type(declared, rr.Query[Feed])
    assert_type(declared.response, Feed)

    def heard(status: rr.Status) -> None:
        assert_type(status.query, rr.Query[Any] | None)

    with app.on_status(Cameras.open_camera, heard) as subscription:
        assert_type(subscription, rr.Subscription)
    declared.on_status(heard)
    declared.on_status(None)
    of_subclass = app.load(BetterCameras.open_camera, OpenCamera("/dev/video0"))
    assert_type(of_subclass.response, Feed)
    rate: rr.Query[float] = app.load(Cameras.measure_rate, "/dev/video0")  # of async callbacks mypy knows Any
    assert rate.response == 30.0

    assert_type(app.load(Cameras.zoom, {"device": "a", "factor": 2}), rr.Query[Feed])
    assert_type(app.load(Cameras.open_all), rr.Query[list[str]])
    app.load("cameras/all")

    later = app.load("cameras/camera", OpenCamera("b"), block=False)
    assert_type(later, pykka.Future[rr.Query[Any]])
    typed_later = app.load("cameras/camera", OpenCamera("b"), response_type=Feed, block=False)
    assert_type(typed_later, pykka.Future[rr.Query[Feed]])
    declared_later = app.load(Cameras.open_camera, OpenCamera("b"), block=False)
    assert_type(declared_later.get(), rr.Query[Feed])
    assert typed_later.get().response == declared_later.get().response == later.get().response == Feed("/imagesb")
    either = app.load("cameras/anything", 3) if block else app.load("cameras/anything", 3, block=False)
    assert_type(either, rr.Query[Any] | pykka.Future[rr.Query[Any]])

    with app.load("cameras/anything", "a", response_type=str) as query:
        assert_type(query, rr.Query[str])
        assert_type(query.response.upper(), str)
        assert plain(query) == "a"
    app.unload(typed)
    assert_type(app.unload(declared, block=False), pykka.Future[None])
    app.unload_client("cameras/camera")
    app.unload_all()
    queries: list[rr.Query] = app.queries()
    assert not queries


async def use_async(app: rr.Registrar) -> None:
    assert_type(await app.load_async("cameras/camera", OpenCamera("b")), rr.Query[Any])
    assert_type(await app.load_async("cameras/all"), rr.Query[Any])
    assert_type(await app.load_async("cameras/camera", OpenCamera("b"), response_type=Feed), rr.Query[Feed])
    assert_type(await app.load_async(Cameras.open_camera, OpenCamera("b")), rr.Query[Feed])
    fractions: list[float] = []
    heard = await app.load_async(
        Cameras.open_camera, OpenCamera("b"), progress=lambda progress: fractions.append(progress.fraction)
    )
    assert_type(heard, rr.Query[Feed])
    assert_type(app.load(Cameras.open_camera, OpenCamera("b"), progress=True), rr.Query[Feed])
    rate: rr.Query[float] = await app.load_async(Cameras.measure_rate, "/dev/video0")
    assert rate.response == 30.0
    query = await app.load(Cameras.open_camera, OpenCamera("b"), block=False)
    assert_type(query, rr.Query[Feed])
    app.unload_all(block=False)


def main() -> None:
    tree = [rr.ChildSpec(BetterCameras, id="cameras")]
    with tempfile.TemporaryDirectory() as state, rr.System(tree, state_dir=state) as system:
        app = system.open_registrar("app")
        use(app, True)
        asyncio.run(use_async(app))
        print("used")


if __name__ == "__main__":
    main()
