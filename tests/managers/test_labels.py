"""Labels: servers that say what they provide, which Choices finds beside the alternatives that it was given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Alternative, Choices, Choose
from support import eventually, kill, serve, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 30.0
FAST = Choose("range", prefer=["rate_hz"])


class Lidars(rr.Manager):
    @rr.server("lidar", recovery="keep", provides={"range": {"rate_hz": 10, "place": "roof"}, "map": {}})
    def open_lidar(self) -> str:
        return "/scan"


def load(request: Any) -> Any:
    return "/there"


class World:
    """Choices, a manager with a labelled server, and the registrar "sensors" for more of them."""

    def __init__(self, start: Start, *given: Alternative) -> None:
        choices = rr.ChildSpec(Choices, id="choices", args=(given, 0.05))
        lidars = rr.ChildSpec(Lidars, id="lidars")
        self.system = start(rr.Supervisor([lidars, choices], max_restarts=1000))
        self.app, self.sensors = self.system.open_registrar("app"), self.system.open_registrar("sensors")

    def choose(self, request: Choose = FAST) -> Any:
        return self.app.load("choices/choice", request, timeout_s=LIMIT_S)

    def camera(self, rate_hz: int = 30) -> None:
        serve(self.sensors, "camera", load, provides={"range": {"rate_hz": rate_hz}})


@pytest.fixture
def world(start: Start) -> World:
    return World(start)


def comes_to(choice: Any, server: str) -> None:
    eventually(lambda: choice.response.server == server, LIMIT_S, f"{server} in use")


def test_a_server_with_labels_is_an_alternative_of_each_kind_that_it_provides(world: World) -> None:
    assert world.choose(Choose("range", {"place": "roof"})).response.provides == {"rate_hz": 10, "place": "roof"}
    assert world.choose(Choose("map")).response.server == "lidars/lidar"


def test_labelled_servers_come_after_the_alternatives_that_were_given(start: Start) -> None:
    world = World(start, Alternative("range", "sensors/camera", provides={"rate_hz": 1}))
    world.camera()
    assert world.choose(Choose("range")).response.server == "sensors/camera"
    assert world.choose(FAST).response.server == "lidars/lidar", "what was given counts, not the label of the same load"


def test_a_better_server_that_comes_later_takes_the_place_of_the_one_in_use(world: World) -> None:
    choice = world.choose()
    world.camera()
    comes_to(choice, "sensors/camera")


def test_a_server_that_goes_is_replaced_and_known_no_more(world: World) -> None:
    world.camera()
    choice = world.choose()
    assert choice.response.server == "sensors/camera"
    world.sensors.unregister_server("camera")
    comes_to(choice, "lidars/lidar")
    with pytest.raises(rr.LoadFailed, match="lidars/lidar: rate_hz is 10, expected ==30") as raised:
        world.choose(Choose("range", {"rate_hz": 30}))
    assert "camera" not in str(raised.value)


def test_a_server_that_is_registered_again_with_other_labels_is_compared_by_these(world: World) -> None:
    world.camera()
    world.sensors.unregister_server("camera")
    world.camera(rate_hz=5)
    assert world.choose().response.server == "lidars/lidar"


def test_a_manager_that_is_stopped_takes_its_labels_with_it(world: World) -> None:
    world.system.supervisor().terminate_child("lidars")
    with pytest.raises(rr.LoadFailed, match="kind: expected one of none, got 'range', which nothing provides"):
        world.choose()
    world.system.supervisor().restart_child("lidars")
    assert world.choose().response.server == "lidars/lidar"


def test_labels_are_there_again_after_crashes_of_both_managers(world: World) -> None:
    choice = world.choose()
    for id in ("lidars", "choices"):
        wait_respawned(world.system, id, kill(world.system, id))
    assert world.choose(Choose("map")).response.server == "lidars/lidar"
    world.camera()
    comes_to(choice, "sensors/camera")


def test_labels_of_a_server_that_another_process_registers_are_found(world: World) -> None:
    world.system.registrar("lidars").register_server("far", load, provides={"range": {"rate_hz": 99}})
    assert world.choose().response.server == "lidars/far"


WRONG: list[tuple[Any, str, str]] = [
    (["range"], "provides", "a dict of kinds, each with a dict of what it provides"),
    ({"range": 30}, "provides.range", "a dict of kinds"),
    ({1: {}}, "provides", "kinds, each a text"),
    ({"": {}}, "provides", "kinds, each a text"),
    ({"range": {"-rate": 1}}, "provides.range", "names that do not begin with '-'"),
    ({"range": {2: 1}}, "provides.range", "names that do not begin with '-'"),
    ({"range": {"rate_hz": [30]}}, "provides.range.rate_hz", "a finite number, a text or a truth value"),
    ({"range": {"rate_hz": float("nan")}}, "provides.range.rate_hz", "a finite number"),
    ({"range": {"reliability": 2}}, "provides.range.reliability", "a number from 0 to 1"),
    ({"range": {"place": "x" * 900}}, "provides", "at most 900 bytes as JSON"),
]


@pytest.mark.parametrize(("provides", "field", "expected"), WRONG)
def test_wrong_labels_are_refused_by_name_where_they_are_declared(provides: Any, field: str, expected: str) -> None:
    with pytest.raises(rr.InvalidSpec, match=f"server 'lidar': {field}: expected {expected}") as raised:
        rr.server("lidar", provides=provides)
    assert raised.value.field == field
    with pytest.raises(rr.InvalidSpec):
        rr.server("lidar", provides={"range": {"place": "\ud800"}})


def test_wrong_labels_are_refused_where_a_server_is_registered(world: World) -> None:
    with pytest.raises(rr.InvalidSpec, match=r"provides\.range"):
        world.sensors.register_server("camera", load, provides={"range": {"-rate": 1}})
    assert world.sensors.servers() == []
