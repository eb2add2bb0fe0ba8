"""A bridge in a graph of ROS that is not there: what nodes get, what they are refused, and what ends when they end."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import rr_actors as rr
from rr_actors import ros2
from support import eventually
from support_ros import WORLDS, FakeBridge, Node, World

Start = Callable[..., rr.System]
DEVICE = {"device": "/dev/video0"}


class Place:
    """A system with a bridge, and cameras in this process."""

    def __init__(self, system: rr.System, world: World) -> None:
        self.system, self.world = system, world
        self.opened, self.closed = list[str](), list[str]()
        self.goes_on = threading.Event()
        self.goes_on.set()
        self.cameras = system.open_registrar("cameras")
        self.cameras.register_server("camera", self._open, self._close)

    def _open(self, request: dict[str, str]) -> dict[str, str]:
        if set(request) != {"device"}:
            raise ValueError(f"no such device: {request}")
        self.opened.append(request["device"])
        self.goes_on.wait(30)
        return {"topic": f"/camera{request['device']}"}

    def _close(self, request: dict[str, str], response: Any) -> None:
        self.closed.append(request["device"])

    def held(self) -> int:
        """How many holds there are of cameras."""
        return sum(len(one.holders) for one in self.cameras.resources())


@pytest.fixture
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    world = WORLDS[request.node.name] = World()
    yield world
    del WORLDS[request.node.name]


@pytest.fixture
def place(request: pytest.FixtureRequest, rr_system: Start, world: World) -> Place:
    switch = ros2.Switch("front_camera", "cameras/camera", DEVICE)
    options = {"switches": [switch], "json": ros2.Json(allow=("cameras/*",), max_priority=5)}
    spec = rr.ChildSpec(FakeBridge, id="ros", args=(request.node.name,), kwargs=options, placement="thread")
    return Place(rr_system([spec]), world)


def test_a_switch_loads_and_unloads_and_says_whether_its_resource_is_there(place: Place) -> None:
    world = place.world
    assert world.latched["/front_camera/available"] is False
    ok, answer = world.call("/front_camera/hold", True)
    assert (ok, answer["response"]) == (True, {"topic": "/camera/dev/video0"})
    assert world.latched["/front_camera/available"] is True


def test_a_switch_counts_nobody_and_is_answered_each_time(place: Place) -> None:
    call = place.world.call
    first, second = call("/front_camera/hold", True), call("/front_camera/hold", True)
    assert first == second
    assert place.opened == ["/dev/video0"]
    assert call("/front_camera/hold", False)[0]
    assert place.closed == ["/dev/video0"]
    assert place.world.latched["/front_camera/available"] is False
    assert call("/front_camera/hold", False)[0]  # it is off already


def test_a_switch_that_fails_says_why(rr_system: Start, request: pytest.FixtureRequest, world: World) -> None:
    switch = ros2.Switch("door", "cameras/camera", {"door": "1"})
    options: Any = {"switches": [switch]}
    spec = rr.ChildSpec(FakeBridge, id="ros", args=(request.node.name,), kwargs=options, placement="thread")
    Place(rr_system([spec]), world)
    ok, answer = world.call("/door/hold", True)
    error = answer["error"]
    assert (ok, error["type"]) == (False, "LoadFailed")
    assert error["trace"] == [{"origin": "cameras/camera", "message": "ValueError: no such device: {'door': '1'}"}]


def test_while_a_switch_loads_others_are_answered_and_false_withdraws_it(place: Place) -> None:
    place.goes_on.clear()
    nav = Node(place.world, "nav")
    answers = list[tuple[bool, str]]()
    place.world.services["/front_camera/hold"](True, lambda ok, text: answers.append((ok, text)))
    eventually(lambda: place.opened)
    assert nav.ask("load", id="1", server="maps/map")["error"]["type"] == "NotAllowed"
    assert place.world.call("/front_camera/hold", False) == (True, {"query": "", "response": None})
    eventually(lambda: answers)
    assert not answers[0][0]
    assert "it was released while it was loading" in answers[0][1]
    place.goes_on.set()
    eventually(lambda: place.closed)
    eventually(lambda: place.held() == 0)


def test_a_status_of_a_switch_is_latched_and_true_loads_a_lost_one_anew(place: Place) -> None:
    world = place.world
    world.call("/front_camera/hold", True)
    (camera,) = place.cameras.resources()
    place.cameras.send_status(camera, rr.Status("warning", "it is hot"))
    eventually(lambda: "it is hot" in world.latched.get("/front_camera/status", ""))
    assert world.latched["/front_camera/available"] is True
    place.cameras.send_status(camera, rr.Status("fatal", "it melted"))
    eventually(lambda: world.latched["/front_camera/available"] is False)
    assert world.call("/front_camera/hold", True)[0]
    assert world.latched["/front_camera/available"] is True
    assert place.opened == ["/dev/video0"] * 2
    eventually(lambda: place.held() == 1)


def test_two_nodes_share_a_camera_and_each_hears_its_statuses(place: Place) -> None:
    nav, map = Node(place.world, "nav"), Node(place.world, "map")
    one = nav.ask("load", id="1", server="cameras/camera", request=DEVICE)
    other = map.ask("load", id="1", server="cameras/camera", request=DEVICE, priority=5)
    assert one["response"] == other["response"] == {"topic": "/camera/dev/video0"}
    assert one["query"] != other["query"]
    assert place.opened == ["/dev/video0"]
    (camera,) = place.cameras.resources()
    assert camera.priority == 5
    place.cameras.update_response(camera, {"topic": "/other"}, "moved")
    for node, query in ((nav, one["query"]), (map, other["query"])):
        eventually(lambda node=node: node.statuses)
        (status,) = node.statuses
        assert (status["id"], status["query"], status["state"]) == ("1", query, "UPDATE")
        assert (status["message"], status["response"]) == ("moved", {"topic": "/other"})
    assert nav.ask("load", id="1", server="cameras/camera", request=DEVICE)["response"] == {"topic": "/other"}
    assert nav.ask("unload", id="1")["ok"]
    assert place.closed == []
    assert map.ask("unload", id="1")["ok"]
    assert place.closed == ["/dev/video0"]


def test_the_same_id_again_gets_the_same_query_and_after_its_end_nothing(place: Place) -> None:
    nav = Node(place.world, "nav")
    asked: dict[str, Any] = {"id": "1", "server": "cameras/camera", "request": DEVICE}
    assert nav.ask("load", **asked) == nav.ask("load", **asked)
    assert nav.ask("unload", id="1")["ok"]
    assert nav.ask("unload", id="1")["ok"]
    assert nav.ask("load", **asked)["error"]["type"] == "UnknownQuery"
    assert (place.opened, place.closed) == (["/dev/video0"], ["/dev/video0"])


def test_errors_of_a_load_come_back_with_what_the_server_said(place: Place) -> None:
    nav = Node(place.world, "nav")
    failed = nav.ask("load", id="1", server="cameras/camera", request={"lens": "1"})["error"]
    assert (failed["type"], failed["details"]["server"]) == ("LoadFailed", "cameras/camera")
    assert failed["trace"] == [{"origin": "cameras/camera", "message": "ValueError: no such device: {'lens': '1'}"}]
    assert nav.ask("load", id="2", server="cameras/eye")["error"]["type"] == "UnknownServer"
    place.world.publish("/rr/load", '{"id": "3", "owner": "/nav", "server": 7}')
    eventually(lambda: nav.answers[-1]["id"] == "3")
    error = nav.answers[-1]["error"]
    assert (error["type"], error["details"]["path"], error["details"]["got"]) == ("InvalidRequest", "server", "7")
    place.world.publish("/rr/load", "load it")
    eventually(lambda: nav.answers[-1]["id"] == "")
    assert nav.answers[-1]["error"]["details"]["expected"] == "a JSON object"
    assert place.held() == 0


def test_what_a_node_holds_is_released_when_it_leaves_the_graph(place: Place) -> None:
    nav, map = Node(place.world, "nav"), Node(place.world, "map")
    for node in (nav, map):
        node.ask("load", id="1", server="cameras/camera", request=DEVICE)
    place.world.leave("/nav")
    eventually(lambda: place.held() == 1)
    assert place.closed == []
    place.world.leave("/map")
    eventually(lambda: place.closed)


def test_what_a_node_does_not_renew_is_released_and_it_hears_that(place: Place) -> None:
    nav = Node(place.world, "nav")
    nav.ask("load", id="1", server="cameras/camera", request=DEVICE, lease_s=1.0)
    eventually(lambda: place.closed)
    assert nav.statuses[0]["reason"] == "lease_ended"
    assert nav.ask("renew", id="1")["error"]["type"] == "UnknownQuery"


def test_an_owner_that_never_was_is_refused(place: Place) -> None:
    nav, heard = Node(place.world, "nav"), list[str]()
    nav.graph.hear("/rr/answers", heard.append)
    nav.send("load", id="1", server="cameras/camera", request=DEVICE, owner="/ghost")
    eventually(lambda: heard)
    assert '"path":"owner"' in heard[0]
    assert (place.opened, place.held()) == ([], 0)


def test_the_bridge_itself_is_no_owner_as_it_would_never_leave(place: Place) -> None:
    nav = Node(place.world, "nav")
    (bridge,) = (name for name in place.world.present if name.startswith("/rr_ros_"))
    heard = list[str]()
    nav.graph.hear("/rr/answers", heard.append)
    nav.send("load", id="1", server="cameras/camera", request=DEVICE, owner=bridge)
    eventually(lambda: heard)
    assert '"path":"owner"' in heard[0]
    assert (place.opened, place.held()) == ([], 0)


def test_the_leases_of_the_bridge_are_offered_to_nobody(
    rr_system: Start, request: pytest.FixtureRequest, world: World
) -> None:
    options: Any = {"json": ros2.Json(allow=("*/*",))}
    spec = rr.ChildSpec(FakeBridge, id="ros", args=(request.node.name,), kwargs=options, placement="thread")
    Place(rr_system([spec]), world)
    lease = {"owner": "", "id": "front_camera", "server": "cameras/camera", "request": DEVICE}
    answer = Node(world, "nav").ask("load", id="1", server="ros/lease", request=lease)
    assert answer["error"]["type"] == "NotAllowed"


def test_a_switch_whose_load_a_crash_interrupted_says_that_it_is_there_when_it_is(place: Place) -> None:
    world = place.world
    place.goes_on.clear()
    world.services["/front_camera/hold"](True, lambda ok, text: None)
    eventually(lambda: place.opened)
    shown = list[object]()
    Node(world, "nav").graph.hear("/front_camera/available", shown.append)
    place.system.ref("ros").tell("fail")
    eventually(lambda: shown)
    assert shown == [False]
    place.goes_on.set()
    eventually(lambda: shown[-1])
    assert place.held() == 1


def test_a_name_that_is_taken_is_refused_before_it_is_offered(
    rr_system: Start, request: pytest.FixtureRequest, world: World
) -> None:
    other = Node(world, "other")
    other.graph.serve("/front_camera/hold", lambda data, answered: answered(True, "{}"))
    switch = ros2.Switch("front_camera", "cameras/camera", DEVICE)
    options: Any = {"switches": [switch]}
    spec = rr.ChildSpec(FakeBridge, id="ros", args=(request.node.name,), kwargs=options, placement="thread")
    with pytest.raises(rr.StartFailed, match="/front_camera/hold: node /other offers it already") as caught:
        rr_system([spec])
    assert isinstance(caught.value.__cause__, rr.NameTaken)
    assert world.offered["/front_camera/status"] == set()


@pytest.mark.parametrize("kind", [ros2.Bridge, ros2.Nodes])
def test_without_rclpy_or_with_a_domain_that_is_none_the_start_says_what_to_do(
    rr_system: Start, monkeypatch: pytest.MonkeyPatch, kind: type[rr.Manager]
) -> None:
    options: Any = {"switches": [ros2.Switch("door", "doors/door")]} if kind is ros2.Bridge else {}
    spec = rr.ChildSpec(kind, id="ros", kwargs=options, placement="thread")
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(rr.StartFailed, match=r"rclpy cannot be imported .* run `source") as caught:
        rr_system([spec])
    assert isinstance(caught.value.__cause__, rr.MissingDependency)
    monkeypatch.setenv("ROS_DOMAIN_ID", "300")
    with pytest.raises(rr.StartFailed, match="ROS_DOMAIN_ID: expected a whole number from 0 to 232, got '300'"):
        rr_system([spec])


def test_a_second_bridge_with_the_same_topics_does_not_start(place: Place, request: pytest.FixtureRequest) -> None:
    options: Any = {"json": ros2.Json(allow=("maps/*",))}
    spec = rr.ChildSpec(FakeBridge, id="more", args=(request.node.name,), kwargs=options, placement="thread")
    with pytest.raises(rr.StartFailed, match=r"/rr/answers: node /rr_ros_[0-9a-f]{8} offers it already"):
        place.system.start_child(spec)
    assert Node(place.world, "nav").ask("load", id="1", server="cameras/camera", request=DEVICE)["ok"]


def test_what_is_exposed_is_latched(place: Place) -> None:
    expected = '{"allow":["cameras/*"],"max_priority":5,"switches":["front_camera"]}'
    assert place.world.latched["/rr/servers"] == expected


def test_a_bridge_that_fails_goes_on_with_what_was_held(place: Place) -> None:
    nav = Node(place.world, "nav")
    asked: dict[str, Any] = {"id": "1", "server": "cameras/camera", "request": DEVICE}
    first = nav.ask("load", **asked)
    place.world.call("/front_camera/hold", True)
    place.world.services.clear()
    place.system.ref("ros").tell("fail")
    eventually(lambda: "/front_camera/hold" in place.world.services and place.world.hearers["/rr/renew"])
    assert nav.ask("load", **asked) == first
    assert place.world.latched["/front_camera/available"] is True
    assert place.world.call("/front_camera/hold", True)[0]
    assert place.opened == ["/dev/video0"]
    (camera,) = place.cameras.resources()
    place.cameras.send_status(camera, rr.Status("warning", "it is hot"))
    eventually(lambda: nav.statuses)
    assert nav.ask("unload", id="1")["ok"]
    assert place.world.call("/front_camera/hold", False)[0]
    assert place.closed == ["/dev/video0"]
