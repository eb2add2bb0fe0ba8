"""A bridge among real nodes of ROS 2: `make test-ros` runs these, where rclpy is installed."""

from __future__ import annotations

import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors import ros2
from support import REPOSITORY, eventually, kill, wait_respawned
from support_ros2 import PatientBridge, domain_of_its_own

pytest.importorskip("rclpy")

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]

Start = Callable[..., rr.System]
DEVICE = {"device": "/dev/video0"}
CLIENT = REPOSITORY / "rr_actors" / "managers" / "ros" / "ros2_client.py"
PEER = REPOSITORY / "tests" / "support_ros2_peer.py"
LIMIT_S = 60.0


class Peer:
    """A process that is a node, with what it has told."""

    def __init__(self, folder: Path, name: str, lease_s: float, slow_s: float) -> None:
        shutil.copy(CLIENT, folder / "ros2_client.py")
        command = [sys.executable, "-P", PEER, folder / "ros2_client.py", name, str(lease_s), str(slow_s)]
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        self.process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment,
        )
        self._told = queue.SimpleQueue[dict[str, Any]]()
        self.seen = list[dict[str, Any]]()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        assert self.until("up")["imported"] == []

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("{"):
                self._told.put(json.loads(line))

    def do(self, what: str, **fields: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": what, **fields}) + "\n")
        self.process.stdin.flush()

    def until(self, what: str, /, **fields: Any) -> dict[str, Any]:
        """Return the first thing told from now on that has this field, and these."""
        deadline = time.monotonic() + LIMIT_S
        while True:
            try:
                told = self._told.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"nothing with {what} and {fields}, but {self.seen}") from None
            self.seen.append(told)
            if what in told and all(told.get(name) == value for name, value in fields.items()):
                return told

    def answer(self, **fields: Any) -> dict[str, Any]:
        """Return the first answer on the topic from now on that has these fields."""
        while True:
            answer = self.until("answer")["answer"]
            if all(answer.get(name) == value for name, value in fields.items()):
                return answer

    def load(self, key: str = "camera", server: str = "cameras/camera", request: Any = DEVICE) -> dict[str, Any]:
        self.do("load", key=key, server=server, request=request)
        return self.until("loaded", key=key)

    def call(self, service: str, data: bool) -> dict[str, Any]:
        self.do("call", service=service, data=data)
        return self.until("ok", service=service)

    def end(self, number: int = signal.SIGKILL) -> None:
        self.process.send_signal(number)
        self.process.wait(LIMIT_S)
        self._reader.join()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()


class Place:
    """A system with a bridge in a process of its own, cameras in this one, and peers."""

    def __init__(self, start: Start, folder: Path) -> None:
        self.start, self.folder = start, folder
        self.opened, self.closed = list[str](), list[str]()
        self.goes_on = threading.Event()
        self.goes_on.set()
        self.peers = list[Peer]()

    def begin(self, bridge: type[ros2.Bridge] = ros2.Bridge) -> None:
        options: dict[str, Any] = {
            "switches": [ros2.Switch("front_camera", "cameras/camera", DEVICE)],
            "json": ros2.Json(allow=("cameras/*",)),
        }
        tree = rr.Supervisor([rr.ChildSpec(bridge, id="ros", kwargs=options, start_timeout_s=60)], max_restarts=9)
        self.system = self.start(tree)
        self.cameras = self.system.open_registrar("cameras")
        self.cameras.register_server("camera", self._open, self._close)

    def _open(self, request: dict[str, str]) -> dict[str, str]:
        if set(request) != {"device"}:
            raise ValueError(f"no such device: {request}")
        self.opened.append(request["device"])
        self.goes_on.wait(60)
        return {"topic": f"/camera{request['device']}"}

    def _close(self, request: dict[str, str], response: Any) -> None:
        self.closed.append(request["device"])

    def peer(self, name: str, *, lease_s: float = 60.0, slow_s: float = 0.0) -> Peer:
        folder = self.folder / name
        folder.mkdir()
        self.peers.append(Peer(folder, name, lease_s, slow_s))
        return self.peers[-1]

    def held(self) -> int:
        return sum(len(one.holders) for one in self.cameras.resources())

    def kill_bridge(self) -> None:
        wait_respawned(self.system, "ros", kill(self.system, "ros"))


@pytest.fixture
def place(rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    with domain_of_its_own(monkeypatch, tmp_path):
        place = Place(rr_system, tmp_path)
        yield place
        place.goes_on.set()
        for peer in place.peers:
            if peer.process.returncode is None:
                peer.end()


def test_two_nodes_load_the_same_camera_and_one_that_is_killed_is_released_by_its_lease(place: Place) -> None:
    place.begin()
    nav, map = place.peer("nav", lease_s=3.0), place.peer("map", lease_s=3.0)
    first, second = nav.load(), map.load()
    assert first["loaded"] == second["loaded"] == {"topic": "/camera/dev/video0"}
    assert first["query"] != second["query"]
    assert place.opened == ["/dev/video0"]
    nav.end()
    eventually(lambda: place.held() == 1, LIMIT_S)
    (camera,) = place.cameras.resources()
    place.cameras.send_status(camera, rr.Status("warning", "it is hot"))
    assert map.until("status", status="WARNING")["message"] == "it is hot"  # it renews, and holds on
    assert place.closed == []
    map.do("unload", key="camera")
    assert map.until("unloaded")["unloaded"]
    assert place.closed == ["/dev/video0"]


def test_a_node_that_leaves_the_graph_is_released_before_its_lease_ends(place: Place) -> None:
    place.begin()
    nav = place.peer("nav", lease_s=3600.0)
    nav.load()
    assert nav.process.stdin is not None
    nav.process.stdin.close()  # it shuts down, as a node that is stopped
    nav.process.wait(LIMIT_S)
    eventually(lambda: place.closed, LIMIT_S)


def test_a_bridge_killed_while_it_loads_loads_once_for_the_client_that_sends_again(place: Place) -> None:
    place.begin()
    nav = place.peer("nav")
    place.goes_on.clear()
    nav.do("load", key="camera", server="cameras/camera", request=DEVICE)
    eventually(lambda: place.opened, LIMIT_S)
    place.kill_bridge()
    place.goes_on.set()
    assert nav.until("loaded")["loaded"] == {"topic": "/camera/dev/video0"}
    eventually(lambda: place.held() == 1, LIMIT_S)
    assert (place.opened, place.closed) == (["/dev/video0"], [])
    nav.do("unload", key="camera")
    nav.until("unloaded")
    assert place.closed == ["/dev/video0"]


def test_a_bridge_killed_before_its_answer_arrives_has_the_same_query_after_that(place: Place) -> None:
    place.begin()
    nav = place.peer("nav")
    asked = {"id": "1", "owner": "/nav", "server": "cameras/camera", "request": DEVICE}
    nav.do("call", service="/front_camera/hold", data=True)
    switch = nav.until("ok")
    nav.do("write", topic="/rr/load", text=json.dumps(asked))
    eventually(lambda: place.held() == 2, LIMIT_S)
    first = [query for one in place.cameras.resources() for query in one.queries]
    place.kill_bridge()  # the answer may have been on its way, or not
    nav.do("write", topic="/rr/load", text=json.dumps(asked))
    answer = nav.answer(id="1", ok=True)
    assert [query for one in place.cameras.resources() for query in one.queries] == first
    again = nav.call("/front_camera/hold", True)
    assert again["answer"] == switch["answer"]
    assert answer["response"] == switch["answer"]["response"]
    assert place.opened == ["/dev/video0"]
    nav.do("write", topic="/rr/unload", text=json.dumps({"id": "1", "owner": "/nav"}))
    assert nav.answer(**{"for": "unload"})["ok"]
    assert nav.call("/front_camera/hold", False)["ok"]
    assert place.closed == ["/dev/video0"]


def test_what_a_node_hears_of_a_switch_is_latched(place: Place) -> None:
    place.begin()
    nav = place.peer("nav")
    assert nav.call("/front_camera/hold", True)["answer"]["response"] == {"topic": "/camera/dev/video0"}
    nav.do("hear", topic="/front_camera/available", flag=True)
    assert nav.until("topic", topic="/front_camera/available")["data"] is True
    nav.do("hear", topic="/rr/servers", flag=False)
    assert json.loads(nav.until("topic", topic="/rr/servers")["data"])["allow"] == ["cameras/*"]
    (camera,) = place.cameras.resources()
    place.cameras.send_status(camera, rr.Status("fatal", "it melted"))
    assert nav.until("topic", topic="/front_camera/available")["data"] is False
    nav.do("hear", topic="/front_camera/status", flag=False)
    assert json.loads(nav.until("topic", topic="/front_camera/status")["data"])["message"] == "it melted"


def test_refusals_reach_the_client_with_their_kind_and_trace(place: Place) -> None:
    place.begin()
    nav = place.peer("nav")
    nav.do("load", key="map", server="maps/map", request=None)
    assert nav.until("failed", key="map")["failed"] == "NotAllowed"
    nav.do("load", key="lens", server="cameras/camera", request={"lens": "wide"})
    failed = nav.until("failed", key="lens")
    assert failed["failed"] == "LoadFailed"
    assert failed["trace"] == [["cameras/camera", "ValueError: no such device: {'lens': 'wide'}"]]


def test_an_executor_that_spins_slowly_loads_awaits_and_unloads(place: Place) -> None:
    place.begin()
    nav = place.peer("nav", slow_s=0.2)
    nav.do("awaited", key="camera", server="cameras/camera", request=DEVICE)
    assert nav.until("loaded")["loaded"] == {"topic": "/camera/dev/video0"}
    assert nav.until("unloaded")["unloaded"]
    assert (place.opened, place.closed) == (["/dev/video0"], ["/dev/video0"])


def test_a_load_that_takes_long_holds_up_no_other_and_no_executor(place: Place) -> None:
    place.begin()
    nav = place.peer("nav")
    place.goes_on.clear()
    nav.do("call", service="/front_camera/hold", data=True)
    eventually(lambda: place.opened, LIMIT_S)
    nav.do("load", key="map", server="maps/map", request=None)
    assert nav.until("failed")["failed"] == "NotAllowed"
    place.goes_on.set()
    assert nav.until("ok")["answer"]["response"] == {"topic": "/camera/dev/video0"}


RAISING = """
import queue
from rr_actors.managers.ros.ros2_graph import Ros2Graph
failures = queue.SimpleQueue()
hearer, speaker = Ros2Graph("hearer", failures.put), Ros2Graph("speaker", failures.put)
hearer.hear("/words", int)  # it raises, as a bug in rclpy would
say = speaker.publish("/words")
while failures.empty():
    say("no number")  # the first ones are lost: the hearer is not known yet
print(failures.get())
hearer.close()
speaker.close()
"""


def test_a_node_whose_executor_ends_by_an_error_says_so_and_is_not_deaf(place: Place) -> None:
    ran = subprocess.run([sys.executable, "-c", RAISING], capture_output=True, text=True, timeout=LIMIT_S, check=True)
    assert "invalid literal for int()" in ran.stdout


def test_a_name_that_another_node_offers_is_refused(place: Place) -> None:
    other = place.peer("other")
    other.do("serve", service="/front_camera/hold")
    other.until("serves")
    with pytest.raises(rr.StartFailed, match="/front_camera/hold: node /other offers it already"):
        place.begin(PatientBridge)


def test_the_first_program_of_the_page_gives_a_camera_to_a_node(place: Place) -> None:
    first = re.search(r"```text\n(import rr_actors.*?)```", (REPOSITORY / "docs" / "ros.md").read_text(), re.DOTALL)
    assert first is not None
    (place.folder / "first.py").write_text(first[1])
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    system = subprocess.Popen([sys.executable, "first.py"], cwd=place.folder, env=environment)
    try:
        nav = place.peer("nav")
        assert nav.call("/front_camera/hold", True)["answer"]["response"] == {"topic": "/camera/dev/video0"}
        nav.do("hear", topic="/front_camera/available", flag=True)
        assert nav.until("topic")["data"] is True
        assert nav.call("/front_camera/hold", False)["ok"]
    finally:
        system.terminate()
        system.wait(LIMIT_S)


def test_the_example_loads_a_camera_for_a_node_and_releases_it(place: Place) -> None:
    examples = REPOSITORY / "examples" / "ros2"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    system = subprocess.Popen(
        [sys.executable, examples / "camera_system.py"],
        cwd=place.folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert system.stdout is not None
    try:
        node = [sys.executable, examples / "camera_node.py"]
        said = subprocess.run(
            node, cwd=place.folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=True
        )
        assert said.stdout.splitlines() == ["loaded: {'topic': '/camera/dev/video0'}", "released"]
        assert [system.stdout.readline() for _ in range(2)] == ["opens /dev/video0\n", "closes /dev/video0\n"]
    finally:
        system.terminate()
        system.wait(LIMIT_S)
        system.stdout.close()
