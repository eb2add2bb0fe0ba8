"""An orderly stop goes by what depends on what, and not by the order of opening (docs/semantics.md)."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr

Start = Callable[..., rr.System]


@pytest.mark.parametrize("first", ["me", "far"])
def test_wholes_are_unloaded_before_parts_whichever_registrar_was_opened_first(tmp_path: Path, first: str) -> None:
    unloaded: list[str] = []
    state, place = tmp_path / "state", tmp_path / "me"
    with rr.System(state_dir=state) as system:
        config = rr.RegistrarConfig(name="me", location=place, erase_on_destruct=True)
        if first == "far":
            system.open_registrar("far")
        me = system.open_registrar("me", config=config)
        far = system.open_registrar("far") if first == "me" else system.registrar("far")
        assert isinstance(far, rr.Registrar)

        def load(request: Any) -> str:
            me.load("far/part", request)
            return "whole"

        far.register_server("part", lambda request: request, lambda request, response: unloaded.append("part"))
        me.register_server("whole", load, lambda request, response: unloaded.append("whole"))
        me.load("me/whole", "a")
    assert unloaded == ["whole", "part"]
    assert not [path for path in place.rglob("*") if path.is_file()]


def test_registrars_that_hold_of_each_other_are_closed_all_the_same(tmp_path: Path) -> None:
    unloaded: list[str] = []
    with rr.System(state_dir=tmp_path / "state") as system:
        one, two = system.open_registrar("one"), system.open_registrar("two")
        for registrar in (one, two):
            registrar.register_server(
                "thing", lambda request: request, lambda request, response: unloaded.append(request)
            )
        one.load("two/thing", "of two")
        two.load("one/thing", "of one")
    assert sorted(unloaded) == ["of one", "of two"]


class Cameras(rr.Manager):
    """Notes when a camera is unloaded, in a list of the test's process: it is placed as a thread."""

    def __init__(self, unloaded: list[str]) -> None:
        self.unloaded = unloaded

    @rr.server("camera")
    def load_camera(self, request: str) -> str:
        return request

    @load_camera.unload
    def unload_camera(self, request: str, response: str) -> None:
        self.unloaded.append("camera")


class Maps(rr.Manager):
    """A map has a camera as its part."""

    def __init__(self, unloaded: list[str]) -> None:
        self.unloaded = unloaded

    @rr.server("map")
    def load_map(self, request: str) -> str:
        self.registrar.load("cameras/camera", request)
        return request

    @load_map.unload
    def unload_map(self, request: str, response: str) -> None:
        self.unloaded.append("map")


class Pilot(rr.Manager):
    """Holds a map of its own accord, so that nobody has released it when the children stop."""

    def take(self) -> None:
        self.registrar.load("maps/map", "hall")


CHILDREN: dict[str, Any] = {"cameras": Cameras, "maps": Maps, "pilot": Pilot}


@pytest.mark.parametrize("order", list(itertools.permutations(CHILDREN)), ids=" ".join)
def test_wholes_of_children_in_threads_are_unloaded_before_their_parts_in_any_order(
    start: Start, order: tuple[str, ...]
) -> None:
    unloaded: list[str] = []
    specs = [
        rr.ChildSpec(CHILDREN[id], id=id, args=() if id == "pilot" else (unloaded,), placement="thread") for id in order
    ]
    system = start(*specs)
    system.ref("pilot").proxy().take().get()
    system.stop()
    assert unloaded == ["map", "camera"]


def test_a_whole_of_a_child_in_a_thread_is_unloaded_before_its_part_at_the_application(start: Start) -> None:
    unloaded: list[str] = []
    children = [
        rr.ChildSpec(Maps, id="maps", args=(unloaded,), placement="thread"),
        rr.ChildSpec(Pilot, id="pilot", placement="thread"),
    ]
    system = start(*children)
    cameras = system.open_registrar("cameras")
    cameras.register_server("camera", lambda request: request, lambda request, response: unloaded.append("camera"))
    system.ref("pilot").proxy().take().get()
    system.stop()
    assert unloaded == ["map", "camera"]


@pytest.mark.parametrize("first", ["connection", "far"])
def test_what_a_connection_holds_is_released_before_its_parts_whoever_was_there_first(start: Start, first: str) -> None:
    unloaded: list[str] = []
    system = start()
    with contextlib.ExitStack() as connections:

        def connect() -> Any:
            return connections.enter_context(rr.connect(system.state_dir)).open_registrar("desk")

        desk = connect() if first == "connection" else None
        far, me = system.open_registrar("far"), system.open_registrar("me")
        far.register_server("part", lambda request: request, lambda request, response: unloaded.append("part"))
        me.register_server(
            "whole",
            lambda request: me.load("far/part", request).response,
            lambda request, response: unloaded.append("whole"),
        )
        (desk or connect()).load("me/whole", "a")
        system.stop()
    assert unloaded == ["whole", "part"]
