"""Declarations: a server named by the method that declares it, and responses read as the type that the caller gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

import rr_actors as rr

Start = Callable[..., rr.System]


@dataclass(frozen=True)
class Feed:
    topic: str


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> Feed:
        return Feed(f"/{self.registrar.name}/{device}")

    @rr.server("raw")
    def open_raw(self, device: str):  # type: ignore[no-untyped-def]
        return {"topic": device}


class NightCameras(Cameras):
    pass


class Maps(rr.Manager):
    @rr.server("map")
    def load_map(self, room: str) -> str:
        return self.registrar.load(Cameras.open_camera, room).response.topic


def test_a_method_names_its_server_in_the_one_child_of_its_class(start: Start) -> None:
    system = start(rr.ChildSpec(Maps, id="maps"), rr.Supervisor([rr.ChildSpec(Cameras, id="front")], id="inner"))
    app = system.open_registrar("app")

    assert app.load(Cameras.open_camera, "a").response == Feed("/front/a")
    assert app.load(Cameras.open_camera, "a", block=False).get(timeout=30).server_id == "front/camera"
    assert app.load(Maps.load_map, "b").response == "/front/b", "from another manager's process"
    assert system.registrar("maps").load(Cameras.open_camera, "c").response == Feed("/front/c"), "by a handle"


def test_a_child_of_a_subclass_is_meant_too(start: Start) -> None:
    app = start(rr.ChildSpec(NightCameras, id="night")).open_registrar("app")

    assert app.load(Cameras.open_camera, "a").response == app.load(NightCameras.open_camera, "a").response
    assert app.load(NightCameras.open_camera, "a").response == Feed("/night/a")


def test_of_several_children_of_the_class_the_error_names_all_and_a_subclass_tells_them_apart(start: Start) -> None:
    system = start(rr.ChildSpec(Cameras, id="day"), rr.ChildSpec(NightCameras, id="night"))
    app = system.open_registrar("app")

    with pytest.raises(rr.UsageError, match=r'Cameras\.open_camera: 2 children .*"day/camera".* or .*"night/camera"'):
        app.load(Cameras.open_camera, "a")
    assert app.load(NightCameras.open_camera, "a").response == Feed("/night/a")
    system.supervisor().terminate_child("night")
    system.supervisor().delete_child("night")
    assert app.load(Cameras.open_camera, "a").response == Feed("/day/a"), "the other one is gone for good"


def test_without_a_child_of_the_class_the_error_names_the_class_and_the_registrars(start: Start) -> None:
    app = start(rr.ChildSpec(Maps, id="maps")).open_registrar("app")

    with pytest.raises(rr.UnknownRegistrar, match=r"Cameras\.open_camera: no child .* is a .*:Cameras; .*: app, maps$"):
        app.load(Cameras.open_camera, "a")


def test_a_child_that_is_added_later_is_found(start: Start) -> None:
    system = start()
    system.start_child(rr.ChildSpec(Cameras, id="late"))

    assert system.open_registrar("app").load(Cameras.open_camera, "a").response == Feed("/late/a")


def test_a_response_is_read_as_the_type_that_the_caller_gives(start: Start) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras"))
    app = system.open_registrar("app")

    def typed(**options: Any) -> rr.Query[Feed]:
        return app.load("cameras/raw", "a", response_type=Feed, **options)

    assert app.load("cameras/raw", "a").response == {"topic": "a"}
    assert typed().response == Feed("a")
    assert app.load("cameras/raw", "a", response_type=Feed, block=False).get(timeout=30).response == Feed("a")
    assert system.registrar("cameras").load("cameras/raw", "a", response_type=Feed).response == Feed("a")
    system.registrar("cameras").update_response(typed(), {"topic": "b"})
    heard = typed()
    assert heard.response == Feed("b")


def test_a_response_that_is_not_of_the_callers_type_is_refused_where_it_is_read(start: Start) -> None:
    app = start(rr.ChildSpec(Cameras, id="cameras")).open_registrar("app")

    query = app.load("cameras/camera", "a", response_type=int)

    with pytest.raises(rr.InvalidResponse, match=r"cameras/camera: response: expected int, got "):
        _ = query.response
    query.unload()


def test_a_type_that_no_response_can_be_of_is_refused_before_anything_is_loaded(start: Start) -> None:
    app = start(rr.ChildSpec(Cameras, id="cameras")).open_registrar("app")

    with pytest.raises(rr.NotSerializable, match=r"load: response_type type function: expected plain data"):
        app.load("cameras/camera", "a", response_type=type(lambda: None))
    assert app.queries() == []
