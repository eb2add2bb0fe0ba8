"""Isolated actions: their processes are killed when they do not stop, and what they do is seen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import pytest

import rr_actors as rr
from rr_actors.managers import Actions, RunAction, RunGraph, run_graph
from support import eventually, kill, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 40.0
STOP_S = 0.5


class In(msgspec.Struct):
    folder: str = ""
    how: str = ""


def begun(given: In) -> None:
    (Path(given.folder) / f"{os.getpid()}").touch()


def hang() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.Signals) - {signal.SIGKILL, signal.SIGSTOP})
    while True:
        time.sleep(60)


class Where(rr.Action):
    Input = In
    isolate = True

    class Output(msgspec.Struct):
        pid: int
        attempt: int

    def run(self, given: In) -> Any:
        return (given.how != "false", self.Output(os.getpid(), self.attempt))


class Fail(rr.Action):
    """Ends in the way that it is given."""

    Input = In
    isolate = True

    def run(self, given: In) -> Any:
        match given.how:
            case "raise":
                raise ValueError("no grip")
            case "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            case "exit":
                os._exit(7)
            case "load":
                self.load("a/b", None)
            case "nonsense":
                return object()
        return None


def start_daemon(given: In) -> None:
    """Start a process with a session of its own, as launchers of robots do."""
    daemon = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], start_new_session=True)
    (Path(given.folder) / f"daemon-{daemon.pid}").touch()


class Daemon(rr.Action):
    """Ends by itself, and leaves a process behind."""

    Input = In
    isolate = True

    def run(self, given: In) -> Any:
        start_daemon(given)


class Hang(rr.Action):
    Input = In
    isolate = True

    def run(self, given: In) -> Any:
        start_daemon(given)
        begun(given)
        hang()


class Overdue(Hang):
    timeout_s: ClassVar[float | None] = 0.2


class Wait(rr.Action):
    """Ends when it is asked to, and writes a file when it pauses."""

    Input = In
    isolate = True

    def run(self, given: In) -> Any:
        begun(given)
        while not self.stopping.wait(0.01):
            if self.pausing.is_set():
                (Path(given.folder) / "paused").touch()
        (Path(given.folder) / "stopped").touch()


ACTIONS: list[type[rr.Action]] = [Where, Fail, Daemon, Hang, Overdue, Wait]


class World:
    def __init__(self, start: Start, folder: Path) -> None:
        self.folder = folder / "begun"
        self.folder.mkdir()
        actions = rr.ChildSpec(Actions, id="actions", kwargs={"actions": ACTIONS, "stop_s": STOP_S})
        self.system = start(rr.Supervisor([actions], max_restarts=1000))
        self.app = self.system.open_registrar("app")

    def graph(self, name: str, how: str = "") -> dict[str, Any]:
        inputs = {"folder": str(self.folder), "how": how}
        given = {key: {"pvf_type": "string", "pvf_value": value} for key, value in inputs.items()}
        return {"graph_name": "one", "actions": [{"name": name, "input_parameters": given}]}

    def run(self, name: str, how: str = "") -> Any:
        return run_graph(self.app, self.graph(name, how), timeout_s=LIMIT_S)

    def started(self, count: int = 1) -> list[int]:
        """Wait until so many runs have begun, and return the ids of their processes."""

        def pids() -> list[int]:
            return [int(path.name) for path in self.folder.iterdir() if path.name.isdigit()]

        eventually(lambda: len(pids()) >= count, LIMIT_S, "a run")
        return pids()

    def daemons(self) -> list[int]:
        """Return the ids of the processes that the runs have started in sessions of their own."""
        return [int(path.name.partition("-")[2]) for path in self.folder.glob("daemon-*")]


@pytest.fixture
def world(start: Start, tmp_path: Path) -> World:
    return World(start, tmp_path)


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def ends(pid: int) -> None:
    eventually(lambda: not is_alive(pid), LIMIT_S, f"the end of {pid}")


def test_results_and_outputs_come_back_from_another_process(world: World) -> None:
    ended = world.run("Where")
    assert (ended.result, ended.error) == ("on_true", "")
    assert ended.outputs["attempt"] == 1
    assert ended.outputs["pid"] not in (os.getpid(), world.system.supervisor().which_children()[0].pid)
    assert world.run("Where", "false").result == "on_false"


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ("raise", "ValueError: no grip"),
        ("killed", r"Fail: its process was killed \(SIGKILL\) before there was a result"),
        ("exit", "Fail: its process has ended with exit code 7 before there was a result"),
        ("load", "Fail: it is isolated, and its process has no registrar"),
        ("nonsense", r"Fail.run\(\): expected an Output"),
    ],
)
def test_whatever_ends_the_process_is_an_error_with_a_reason(world: World, how: str, why: str) -> None:
    with pytest.raises(rr.LoadFailed, match=why):
        world.app.load("actions/action", RunAction("Fail", {"folder": "", "how": how}), timeout_s=LIMIT_S)
    assert world.run("Fail", how).result == "on_error"


@pytest.mark.parametrize("how", ["it ends", "overdue", "released", "its manager dies"])
def test_a_process_in_a_session_of_its_own_ends_with_the_run_that_has_started_it(world: World, how: str) -> None:
    if how == "it ends":
        assert world.run("Daemon").result == "on_true"
    elif how == "overdue":
        assert world.run("Overdue").result == "on_error"
    else:
        graph = world.app.load("actions/graph", RunGraph(world.graph("Hang")), timeout_s=LIMIT_S)
        world.started()
        if how == "its manager dies":
            wait_respawned(world.system, "actions", kill(world.system, "actions"))
            world.started(2)
        graph.unload(timeout_s=LIMIT_S)
    assert world.daemons()
    for pid in world.daemons():
        ends(pid)


def test_a_run_that_hangs_is_killed_when_its_graph_is_released(world: World) -> None:
    graph = world.app.load("actions/graph", RunGraph(world.graph("Hang")), timeout_s=LIMIT_S)
    (pid,) = world.started()
    graph.unload(timeout_s=LIMIT_S)
    assert not is_alive(pid)
    eventually(lambda: not world.system.registrar("actions").resources(), LIMIT_S, "all released")


def test_a_run_that_is_overdue_is_killed_and_says_so(world: World) -> None:
    request = RunAction("Overdue", {"folder": str(world.folder), "how": ""})
    why = "Overdue: it was overdue after 0.2 s, and did not end within 0.5 s of stopping: its process was killed"
    with pytest.raises(rr.LoadFailed, match=why):
        world.app.load("actions/action", request, timeout_s=LIMIT_S)


def test_a_run_hears_that_it_is_to_pause_and_to_stop(world: World) -> None:
    graph = world.app.load("actions/graph", RunGraph(world.graph("Wait")), timeout_s=LIMIT_S)
    world.started()
    actions = world.system.ref("actions").proxy()
    actions.pause_graph(graph.resource_id).get(timeout=LIMIT_S)
    eventually((world.folder / "paused").exists, LIMIT_S, "the pause")
    actions.stop_graph(graph.resource_id).get(timeout=LIMIT_S)
    eventually((world.folder / "stopped").exists, LIMIT_S, "the stop")
    eventually(lambda: graph.response["graph_state"] == "STOPPED", LIMIT_S, "the end")


def test_a_kill_of_the_engine_leaves_no_process_and_the_run_begins_again(world: World) -> None:
    graph = world.app.load("actions/graph", RunGraph(world.graph("Hang")), timeout_s=LIMIT_S)
    (first,) = world.started()
    wait_respawned(world.system, "actions", kill(world.system, "actions"))
    ends(first)
    second = next(pid for pid in world.started(2) if pid != first)
    assert is_alive(second)
    graph.unload(timeout_s=LIMIT_S)
    ends(second)


def test_a_stop_of_the_system_leaves_no_process(world: World) -> None:
    world.app.load("actions/graph", RunGraph(world.graph("Hang")), timeout_s=LIMIT_S)
    (pid,) = world.started()
    world.system.stop()
    assert not is_alive(pid)


class Late(rr.Action):
    timeout_s = 1.0

    def run(self, given: Any) -> None:
        return None


class Never(Late):
    isolate = True
    timeout_s = 0


class Maybe(Late):
    isolate: Any = "yes"


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Late, "Late.timeout_s: expected isolate = True, without which nothing can end a run, got 1.0"),
        (Never, "Never.timeout_s: expected seconds greater than 0, or None, got 0"),
        (Maybe, "Maybe.isolate: expected True or False, got 'yes'"),
    ],
)
def test_a_class_that_says_something_else_is_refused(kind: type[rr.Action], says: str) -> None:
    with pytest.raises(rr.UsageError, match=says):
        Actions([kind])
