"""Nodes as resources, in a graph of ROS that is not there: what is started, in which order, and what goes wrong."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import rr_actors as rr
from rr_actors import ros2
from rr_actors.managers import Program, RunProgram
from support import eventually
from support_ros import DOMAIN, WORLDS, FakeLifecycle, FakeNodes, World

Start = Callable[..., rr.System]
CAMERA = ros2.RunNode("camera_program", "camera", namespace="/robot")
QUICK = rr.Health(every_s=0.1, timeout_s=1.0)
LIFECYCLE = ros2.RunNode("camera_program", "camera", lifecycle=True, health=QUICK)


class Place:
    """A system with a manager of nodes, and programs that are not there: each puts its node into the graph."""

    def __init__(self, system: rr.System, world: World) -> None:
        self.system, self.world = system, world
        self.started, self.ended = list[RunProgram](), list[str]()
        self.becomes: FakeLifecycle | None = None  # what the next node is
        self.comes, self.goes_on = True, threading.Event()
        self.goes_on.set()
        self._numbers = itertools.count(1)
        self.programs = system.open_registrar("programs")
        self.programs.register_server("program", self._run, self._end, request_type=RunProgram)
        self.app = system.open_registrar("app")

    def _run(self, request: RunProgram) -> Program:
        number = next(self._numbers)
        name = request.instance.removeprefix("node ")
        self.started.append(request)
        self.world.lifecycles[name] = self.becomes or FakeLifecycle()
        if self.comes:
            self.world.processes[name].add(f"process {number}")
        self.goes_on.wait(30)
        return Program(number, time.clock_gettime(time.CLOCK_BOOTTIME) + 3600)  # later than any attempt began

    def _end(self, request: RunProgram, response: Program) -> None:
        name = request.instance.removeprefix("node ")
        self.world.processes[name].discard(f"process {response.pid}")
        self.ended.append(name)

    def load(self, request: ros2.RunNode) -> rr.Query[ros2.RosNode]:
        return self.app.load("nodes/node", request)

    def kill(self, query: rr.Query[ros2.RosNode]) -> None:
        """Have the program die, as Programs says it. Its node is in the graph for some time more."""
        (program,) = [one for one in self.programs.resources() if one.response.pid == query.response.pid]
        self.programs.send_status(program, rr.Status("fatal", "the program was ended by signal 9 (SIGKILL)"))


@pytest.fixture
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    world = WORLDS[request.node.name] = World()
    yield world
    del WORLDS[request.node.name]


@pytest.fixture
def place(request: pytest.FixtureRequest, rr_system: Start, world: World) -> Place:
    options: dict[str, Any] = getattr(request, "param", {})
    spec = rr.ChildSpec(FakeNodes, id="nodes", args=(request.node.name,), kwargs=options, placement="thread")
    return Place(rr_system([spec]), world)


def test_a_node_is_loaded_when_it_is_in_the_graph_and_ended_with_its_last_holder(place: Place) -> None:
    first, second = place.load(CAMERA), place.load(CAMERA)
    assert first.response == second.response
    assert (first.response.name, first.response.pid) == ("/robot/camera", 1)
    (program,) = place.started
    assert program.command == "camera_program"
    assert program.environment == {"ROS_DOMAIN_ID": str(DOMAIN)}
    first.unload()
    assert place.ended == []
    second.unload()
    assert place.ended == ["/robot/camera"]


def test_a_lifecycle_node_is_configured_and_activated_and_at_its_end_the_other_way_round(place: Place) -> None:
    node = place.becomes = FakeLifecycle()
    query = place.load(LIFECYCLE)
    assert (node.asked, node.state) == (["configure", "activate"], "active")
    query.unload()
    assert node.asked[2:] == ["deactivate", "cleanup"]
    assert place.ended == ["/camera"]
    assert node.is_closed


def test_a_node_that_needs_another_is_active_after_it_and_ends_before_it(place: Place) -> None:
    nodes = {f"/{name}": FakeLifecycle() for name in ("camera", "tracker")}

    def track(request: str) -> str:
        for name, node in nodes.items():
            place.becomes = node
            needed = ros2.RunNode(f"{name}_program", name.removeprefix("/"), lifecycle=True)
            robot.load("nodes/node", needed)
        return "tracks"

    robot = place.system.open_registrar("robot")
    robot.register_server("tracker", track, lambda request, response: None)
    steps = list[str]()
    for name, node in nodes.items():
        node.hears = lambda step, name=name: steps.append(f"{name} {step}")
    with place.app.load("robot/tracker", "a face"):
        assert steps == ["/camera configure", "/camera activate", "/tracker configure", "/tracker activate"]
    ended = steps[4:]
    assert ended.index("/tracker deactivate") < ended.index("/camera deactivate")
    assert sorted(place.ended) == ["/camera", "/tracker"]
    nodes["/tracker"].refuses = {"activate": "inactive"}
    with pytest.raises(rr.LoadFailed, match="it has refused 'activate', and is inactive"):
        place.app.load("robot/tracker", "a face")
    eventually(lambda: place.programs.resources() == [])
    assert nodes["/camera"].state == "unconfigured"


def test_a_request_for_a_transition_that_is_lost_is_sent_again(place: Place) -> None:
    node = place.becomes = FakeLifecycle()
    node.loses = ["configure"]
    place.load(ros2.RunNode("camera_program", "camera", lifecycle=True))
    assert node.asked == ["configure", "activate"]


@pytest.mark.parametrize(("refused", "state"), [("configure", "unconfigured"), ("activate", "finalized")])
def test_a_node_that_refuses_a_transition_is_ended_and_the_load_says_which(
    place: Place, refused: str, state: str
) -> None:
    node = place.becomes = FakeLifecycle()
    node.refuses = {refused: state}
    with pytest.raises(rr.LoadFailed, match=f"node /camera: it has refused '{refused}', and is {state}"):
        place.load(LIFECYCLE)
    eventually(lambda: place.ended == ["/camera"])
    place.becomes = FakeLifecycle()
    assert place.load(LIFECYCLE).response.pid == 2


def test_a_lifecycle_node_that_does_not_answer_is_ended_and_the_load_says_so(place: Place) -> None:
    node = place.becomes = FakeLifecycle()
    node.is_silent = True
    expected = "node /camera: expected an answer of /camera/get_state within .* it hangs, or is no lifecycle node"
    with pytest.raises(rr.LoadFailed, match=expected):
        place.load(ros2.RunNode("camera_program", "camera", lifecycle=True, timeout_s=0.6))
    eventually(lambda: place.ended)


def test_a_node_that_does_not_come_is_ended_and_the_load_says_where_it_was_expected(place: Place) -> None:
    place.comes = False
    place.world.present["/other/camera"] = 1
    expected = f"node /robot/camera: expected it in the graph of domain {DOMAIN} .*, but /other/camera is"
    with pytest.raises(rr.LoadFailed, match=expected):
        place.load(ros2.RunNode("camera_program", "camera", namespace="/robot", timeout_s=0.2))
    eventually(lambda: place.ended)


def test_a_name_that_a_node_has_is_refused_before_anything_starts(place: Place) -> None:
    place.world.processes["/robot/camera"].add("another robot's")
    with pytest.raises(rr.LoadFailed, match="NameTaken: /robot/camera: a node of this name is in the graph already"):
        place.load(CAMERA)
    place.world.processes.clear()
    place.load(CAMERA)
    with pytest.raises(rr.LoadFailed, match="NameTaken: /robot/camera: another node of nodes has this name already"):
        place.load(ros2.RunNode("another_program", "camera", namespace="/robot"))
    assert len(place.started) == 1


def test_a_node_that_was_killed_leaves_its_name_at_once_though_it_is_in_the_graph(place: Place) -> None:
    query = place.load(LIFECYCLE)
    other = place.load(CAMERA)
    before = place.world.lifecycles["/camera"]
    place.kill(query)
    assert "SIGKILL" in query.wait_status("FATAL", timeout_s=30).message
    query.unload()
    place.world.processes["/camera"].add("process 1")  # killed: it stays for some seconds
    again = place.load(LIFECYCLE)
    assert again.response.pid == 3
    assert before.asked == ["configure", "activate"]  # it was not asked at its end: it was dead
    assert other.state is rr.State.OK


@pytest.mark.parametrize(
    ("state", "heard", "said"),
    [
        ("inactive", "WARNING", "it was deactivated, and not by its manager"),
        ("errorprocessing", "ERROR", "it handles an error"),
        ("finalized", "FATAL", "it has failed for good"),
    ],
)
def test_a_transition_that_nobody_here_asked_for_is_heard(place: Place, state: str, heard: str, said: str) -> None:
    node = place.becomes = FakeLifecycle()
    query = place.load(LIFECYCLE)
    node.state = state
    status = query.wait_status(heard, timeout_s=30)
    assert said in status.message
    if heard == "FATAL":
        return
    node.state = "active"
    query.wait_status("OK", timeout_s=30)


def test_a_lifecycle_node_that_hangs_is_heard(place: Place) -> None:
    node = place.becomes = FakeLifecycle()
    quick = rr.Health(every_s=0.1, timeout_s=0.1, fail_after=2)
    query = place.load(ros2.RunNode("camera_program", "camera", lifecycle=True, timeout_s=3.0, health=quick))
    node.is_silent = True
    assert "/camera/get_state" in query.wait_status("ERROR", timeout_s=30).message
    query.unload()  # and it is ended, without being deactivated
    assert place.ended == ["/camera"]


@pytest.mark.parametrize("place", [{"idle": "pause"}], indirect=True)
def test_a_node_on_standby_is_inactive_and_a_priority_activates_it(place: Place) -> None:
    node = place.becomes = FakeLifecycle()
    query = place.load(LIFECYCLE)
    query.standby()
    eventually(lambda: node.state == "inactive")
    query.priority = 0
    eventually(lambda: node.state == "active")
    assert node.asked == ["configure", "activate", "deactivate", "activate"]


def test_a_manager_that_fails_finds_its_nodes_again_and_ends_them(place: Place) -> None:
    node = place.becomes = FakeLifecycle()
    query = place.load(LIFECYCLE)
    place.system.ref("nodes").tell("fail")
    eventually(lambda: len(place.world.joined) == 2)
    node.state = "inactive"
    query.wait_status("WARNING", timeout_s=30)  # so the new one watches it
    node.state = "active"
    query.unload()
    assert node.asked == ["configure", "activate", "deactivate", "cleanup"]
    assert (len(place.started), place.ended) == (1, ["/camera"])


def test_a_load_that_a_crash_interrupted_does_not_take_another_node_for_its_own(place: Place) -> None:
    place.comes = False
    place.goes_on.clear()
    load = place.app.load("nodes/node", ros2.RunNode("camera_program", "camera", timeout_s=0.3), block=False)
    eventually(lambda: place.started)
    place.world.processes["/camera"].add("process 0")  # there before the program that the load starts again
    place.system.ref("nodes").tell("fail")
    eventually(lambda: len(place.world.joined) == 2)
    place.goes_on.set()
    with pytest.raises(rr.LoadFailed, match="node /camera: expected it in the graph"):
        load.get(timeout=30)


@pytest.mark.parametrize(
    ("fields", "path", "expected"),
    [
        ({"name": "front camera"}, "name", "a name without '/'"),
        ({"name": "robot/camera"}, "name", "a name without '/'"),
        ({"namespace": "robot"}, "namespace", "'/', or '/' and"),
        ({"parameters": {"a b": 1}}, "parameters.a b", "a name of ASCII letters"),
        ({"parameters": {"rates": [1, "2"]}}, "parameters.rates", "all of one type"),
        ({"remappings": {"image": "a:=b"}}, "remappings.image", "two names"),
        ({"environment": {"ROS_DOMAIN_ID": "42"}}, "environment.ROS_DOMAIN_ID", "7, the domain of its manager"),
    ],
)
def test_a_request_that_cannot_be_right_is_refused_before_anything_starts(
    place: Place, fields: dict[str, Any], path: str, expected: str
) -> None:
    with pytest.raises(rr.LoadFailed, match=f"{path}: expected .*{expected}"):
        place.load(ros2.RunNode(**{"executable": "camera_program", "name": "camera", **fields}))
    assert place.started == []
