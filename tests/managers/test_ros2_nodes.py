"""Real nodes of ROS 2 as resources: `make test-ros` runs these, where rclpy is installed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors import ros2
from rr_actors.managers import Programs
from support import REPOSITORY, eventually, kill, wait_respawned
from support_ros2 import PatientNodes, domain_of_its_own

pytest.importorskip("rclpy")

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]

Start = Callable[..., rr.System]
PAGE = REPOSITORY / "docs" / "ros.md"
NODE = REPOSITORY / "tests" / "support_ros2_node.py"
LIMIT_S = 60.0


def node(name: str, *words: str, **fields: Any) -> ros2.RunNode:
    """Return the request for a node of the tests; "lifecycle" is one of its words."""
    given: dict[str, Any] = {"timeout_s": 30.0, "lifecycle": "lifecycle" in words, **fields}
    return ros2.RunNode(sys.executable, name, arguments=(str(NODE), *words), **given)


class Place:
    """A system with programs and nodes, each in a process of its own."""

    def __init__(self, system: rr.System) -> None:
        self.system, self.app = system, system.open_registrar("app")

    def load(self, request: ros2.RunNode) -> rr.Query[ros2.RosNode]:
        return self.app.load("nodes/node", request, timeout_s=120)

    def output(self, query: rr.Query[ros2.RosNode]) -> list[str]:
        """Return what the program of a node has printed."""
        (part,) = self.app.children(query)
        return self.system.ref("programs").proxy().output(part.resource_id, 50).get(timeout=LIMIT_S)


@pytest.fixture
def place(rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    with domain_of_its_own(monkeypatch, tmp_path):
        nodes = rr.ChildSpec(ros2.Nodes, id="nodes", kwargs={"idle": "pause"}, start_timeout_s=60)
        tree = rr.Supervisor([rr.ChildSpec(Programs, id="programs"), nodes], max_restarts=9)
        yield Place(rr_system(tree))


def test_a_node_is_in_the_graph_by_its_name_with_its_parameters_and_killed_it_is_lost_at_once(place: Place) -> None:
    request = node("camera", "late", namespace="/robot", parameters={"rate": 30.0, "frame": 'a "b"'})
    query = place.load(request)
    assert query.response.name == "/robot/camera"
    expected = "/robot/camera is up: rate 30.0, frame 'a \"b\"'"
    eventually(lambda: expected in place.output(query), LIMIT_S)
    os.kill(query.response.pid, signal.SIGKILL)
    assert "SIGKILL" in query.wait_status("FATAL", timeout_s=LIMIT_S).message
    query.unload()
    again = place.load(request)  # while DDS has the killed one in the graph still
    assert again.response.pid != query.response.pid
    again.unload()


def test_a_lifecycle_node_is_configured_activated_paused_and_ended(place: Place) -> None:
    query = place.load(node("camera", "lifecycle"))
    query.standby()
    eventually(lambda: "camera deactivate" in place.output(query), LIMIT_S)
    query.priority = 0
    place.load(node("camera", "lifecycle"))  # answered when it is active
    steps = ["camera configure", "camera activate", "camera deactivate", "camera activate"]
    eventually(lambda: [line for line in place.output(query) if line.startswith("camera ")] == steps, LIMIT_S)


def test_a_lifecycle_node_that_was_killed_is_loaded_again_while_the_graph_has_the_old_one(place: Place) -> None:
    request = node("camera", "lifecycle", "deaf")
    for _ in range(2):
        query = place.load(request)
        os.kill(query.response.pid, signal.SIGKILL)
        query.wait_status("FATAL", timeout_s=LIMIT_S)
        query.unload()


@pytest.mark.parametrize(
    ("word", "timeout_s", "expected"),
    [
        ("refuses", 30.0, "node /camera: it has refused 'configure', and is unconfigured"),
        ("hangs", 15.0, "node /camera: expected an answer of /camera/get_state within"),
    ],
)
def test_a_lifecycle_node_that_does_not_configure_is_ended(
    place: Place, word: str, timeout_s: float, expected: str
) -> None:
    with pytest.raises(rr.LoadFailed, match=expected):
        place.load(node("camera", "lifecycle", word, timeout_s=timeout_s, grace_s=0.5))
    eventually(lambda: not place.system.registrar("programs").resources(), LIMIT_S)


def test_a_node_that_is_finalized_is_lost_and_its_program_is_ended_before_its_holders_hear(place: Place) -> None:
    query = place.load(node("camera", "lifecycle", "breaks"))
    query.standby()  # it is deactivated for that, and breaks
    assert "it is finalized" in query.wait_status("FATAL", timeout_s=LIMIT_S).message
    assert not Path(f"/proc/{query.response.pid}").exists()


def test_a_node_that_cannot_start_says_why_at_once(place: Place) -> None:
    broken = ros2.RunNode(sys.executable, "camera", arguments=("-c", "import no_such_rclpy"))
    with pytest.raises(rr.LoadFailed, match="No module named 'no_such_rclpy'"):
        place.load(broken)


def test_a_node_in_another_domain_is_not_seen_and_the_load_says_in_which_it_is(place: Place) -> None:
    script = f"ROS_DOMAIN_ID=200 exec {sys.executable} {NODE}"
    request = ros2.RunNode("sh", "camera", arguments=("-c", script), timeout_s=5.0)
    with pytest.raises(rr.LoadFailed, match="not there, as its program runs in domain 200"):
        place.load(request)


def test_a_manager_of_nodes_that_is_killed_finds_them_again(place: Place) -> None:
    query = place.load(node("camera", "lifecycle"))
    wait_respawned(place.system, "nodes", kill(place.system, "nodes"))
    again = place.load(node("camera", "lifecycle"))
    assert again.response == query.response
    again.unload()
    query.standby()
    eventually(lambda: "camera deactivate" in place.output(query), LIMIT_S)
    query.unload()


def test_a_manager_that_is_killed_while_a_node_starts_has_one_node_after_that(place: Place) -> None:
    load = place.app.load("nodes/node", node("camera", "lifecycle", "late"), timeout_s=120, block=False)
    programs = place.system.registrar("programs")
    eventually(programs.resources, LIMIT_S)
    wait_respawned(place.system, "nodes", kill(place.system, "nodes"))
    query = load.get(timeout=120)
    eventually(lambda: [one.response.pid for one in programs.resources()] == [query.response.pid], LIMIT_S)
    steps = ["camera configure", "camera activate"]
    eventually(lambda: [line for line in place.output(query) if line.startswith("camera ")] == steps, LIMIT_S)


def test_the_program_of_the_page_activates_a_node_of_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```text\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (shown,) = (block for block in blocks if "ros2.Nodes" in block and "import rr_actors" in block)
    (tmp_path / "page.py").write_text(shown)
    index = tmp_path / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "my_cameras").touch()
    driver = tmp_path / "lib" / "my_cameras" / "camera_driver"
    driver.parent.mkdir(parents=True)
    driver.write_text(f'#!/bin/sh\nexec {sys.executable} {NODE} lifecycle "$@"\n')
    driver.chmod(0o755)
    with domain_of_its_own(monkeypatch, tmp_path):
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "AMENT_PREFIX_PATH": str(tmp_path)}
        ran = subprocess.run(
            [sys.executable, "page.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
        )
    assert "/front_camera" in ran.stdout.splitlines(), ran.stdout + ran.stderr


def test_a_name_that_a_node_of_another_system_has_is_refused(
    rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, str(NODE), "--ros-args", "-r", "__node:=camera"]
    with domain_of_its_own(monkeypatch, tmp_path):
        other = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert other.stdout is not None
            assert other.stdout.readline().startswith("/camera is up")
            nodes = rr.ChildSpec(PatientNodes, id="nodes", start_timeout_s=60)
            place = Place(rr_system([rr.ChildSpec(Programs, id="programs"), nodes]))
            with pytest.raises(rr.LoadFailed, match="NameTaken: /camera: a node of this name is in the graph already"):
                place.load(node("camera"))
        finally:
            other.kill()
            other.communicate()
