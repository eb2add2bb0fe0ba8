"""Stop, pause and release reach what runs, wherever it runs; what was confirmed does not begin afterwards."""

from __future__ import annotations

import datetime
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Actions, GraphError, RunGraph, run_graph
from support import Calls, eventually, kill, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 60.0


def note(given: dict[str, Any], text: str) -> None:
    with (Path(given["place"]) / "lines").open("a") as lines:
        lines.write(f"{text}\n")


class Moves(rr.Action):
    """Notes its begin, and its end when it is told to stop, or when the file `go` is there."""

    def run(self, given: dict[str, Any]) -> None:
        note(given, f"began {self.attempt}")
        paused = False
        while not self.stopping.wait(0.01) and not (Path(given["place"]) / "go").exists():
            if self.pausing.is_set() and not paused:
                note(given, "pauses")
            paused = self.pausing.is_set()
        note(given, "ended")


class Step(rr.Action):
    """Notes the time of its begin."""

    def run(self, given: dict[str, Any]) -> None:
        note(given, str(time.monotonic()))


class Alone(Step):
    isolate = True


class Loads(rr.Action):
    def run(self, given: dict[str, Any]) -> None:
        note(given, "began")
        self.load("slow/thing", "x")


class Slow(rr.Manager):
    def on_start(self) -> None:
        self.may_end = threading.Event()

    @rr.server("thing")
    def make(self, name: str) -> str:
        while not rr.current().stopping.wait(0.01):
            pass
        raise ValueError("nobody wants it")


class Gives(rr.Action):
    def run(self, given: dict[str, Any]) -> dict[str, Any]:
        return {"path": Path("/a"), "raw": b"abc", "many": {1, 2}, "when": datetime.date(2026, 11, 28)}


class Takes(rr.Action):
    """Notes what it is given, and dies the first time."""

    def run(self, given: dict[str, Any]) -> None:
        note(given, f"{given['raw']!r} {given['path']!r}")
        if self.attempt == 1:
            os.kill(os.getpid(), signal.SIGKILL)


class Much(rr.Action):
    def run(self, given: dict[str, Any]) -> dict[str, Any]:
        return {f"much_{given['number']}": b"x" * 7_000_000}


class Odd(rr.Action):
    def run(self, given: dict[str, Any]) -> dict[str, Any]:
        return {"odd": threading.Lock()}


class Stays(rr.Action):
    """Does not hear that it is to stop."""

    def run(self, given: dict[str, Any]) -> None:
        note(given, "began")
        while not (Path(given["place"]) / "go").exists():
            time.sleep(0.01)


ACTIONS: list[type[rr.Action]] = [Moves, Step, Alone, Loads, Gives, Takes, Much, Odd, Stays]


class World:
    def __init__(self, start: Start, place: Path, **options: Any) -> None:
        self.place = place
        kwargs = {"actions": ACTIONS, "stop_s": 1.0}
        engine, arm = (rr.ChildSpec(Actions, id=id, kwargs=kwargs) for id in ("actions", "arm"))
        children = [engine, rr.ChildSpec(Slow, id="slow"), arm]
        self.system = start(rr.Supervisor(children, max_restarts=1000, **options))
        self.app = self.system.open_registrar("app")
        self.messages = self.system.ref("actions").proxy()

    def lines(self) -> list[str]:
        file = self.place / "lines"
        return file.read_text().splitlines() if file.exists() else []

    def graph(self, *names: str, actor: str = "") -> dict[str, Any]:
        """A graph of these actions, one after the other."""
        place = {"place": {"pvf_type": "string", "pvf_value": str(self.place)}}
        actions: list[dict[str, Any]] = []
        for i, name in enumerate(names):
            parents = [{"name": names[i - 1], "instance_id": i - 1}] if i else []
            children = [{"name": names[i + 1], "instance_id": i + 1}] if i + 1 < len(names) else []
            more = {"actor": actor, "parents": parents, "children": children, "input_parameters": place}
            actions.append({"name": name, "instance_id": i, **more})
        return {"graph_name": "g", "actions": actions}

    def load(self, *names: str, actor: str = "") -> rr.Query[Any]:
        return self.app.load("actions/graph", RunGraph(self.graph(*names, actor=actor)), timeout_s=LIMIT_S)

    def say(self, what: str, query: rr.Query[Any], *more: str) -> None:
        getattr(self.messages, what)(query.resource_id, *more).get(timeout=LIMIT_S)


@pytest.fixture
def world(start: Start, tmp_path: Path) -> World:
    return World(start, tmp_path)


def state_is(query: rr.Query[Any], state: str) -> None:
    eventually(lambda: query.response["graph_state"] == state, LIMIT_S, state)


@pytest.mark.parametrize("actor", ["", "arm"])
def test_a_pause_and_a_stop_reach_an_action_in_whatever_manager_it_runs(world: World, actor: str) -> None:
    with world.load("Moves", actor=actor) as query:
        eventually(lambda: world.lines() == ["began 1"], LIMIT_S)
        world.say("pause_graph", query)
        eventually(lambda: world.lines() == ["began 1", "pauses"], LIMIT_S)
        world.say("resume_graph", query)
        world.say("stop_graph", query)
        state_is(query, "STOPPED")
    assert world.lines() == ["began 1", "pauses", "ended"]


def test_a_release_reaches_an_action_of_another_manager(world: World) -> None:
    query = world.load("Moves", actor="arm")
    eventually(lambda: world.lines() == ["began 1"], LIMIT_S)
    query.unload(timeout_s=LIMIT_S)
    eventually(lambda: world.lines() == ["began 1", "ended"], LIMIT_S)


def test_after_a_kill_of_the_engine_an_action_of_another_manager_ends_before_it_begins_again(world: World) -> None:
    with world.load("Moves", actor="arm") as query:
        eventually(lambda: world.lines() == ["began 1"], LIMIT_S)
        wait_respawned(world.system, "actions", kill(world.system, "actions"))
        eventually(lambda: world.lines() == ["began 1", "ended", "began 2"], LIMIT_S)
        (world.place / "go").touch()
        state_is(query, "FINISHED")


def test_an_action_whose_other_manager_is_restarted_in_order_is_run_again(start: Start, tmp_path: Path) -> None:
    world = World(start, tmp_path, strategy="rest_for_one")
    with world.load("Moves", actor="arm") as query:
        eventually(lambda: world.lines() == ["began 1"], LIMIT_S)
        kill(world.system, "slow")
        eventually(lambda: world.lines() == ["began 1", "ended", "began 2"], LIMIT_S)
        (tmp_path / "go").touch()
        state_is(query, "FINISHED")


def test_a_crash_in_a_pause_begins_nothing_and_is_no_attempt(world: World) -> None:
    with world.load("Moves") as query:
        eventually(lambda: world.lines() == ["began 1"], LIMIT_S)
        world.say("pause_graph", query)
        eventually(lambda: world.lines() == ["began 1", "pauses"], LIMIT_S)
        for _ in range(4):
            wait_respawned(world.system, "actions", kill(world.system, "actions"))
        (world.place / "go").touch()
        assert query.response["graph_state"] == "PAUSED"
        assert world.lines() == ["began 1", "pauses"]
        world.say("resume_graph", query)
        state_is(query, "FINISHED")
    assert world.lines() == ["began 1", "pauses", "began 1", "ended"]


def test_a_stop_reaches_an_action_that_waits_for_a_load(world: World) -> None:
    with world.load("Loads") as query:
        eventually(lambda: world.lines() == ["began"], LIMIT_S)
        world.say("stop_graph", query)
        eventually(lambda: query.response["graph_state"] == "STOPPED", 15.0, "the end")


@pytest.mark.parametrize(("name", "actor"), [("Step", ""), ("Alone", ""), ("Step", "arm")])
@pytest.mark.parametrize("what", ["stop_graph", "pause_graph"])
def test_nothing_begins_after_the_answer_to_a_stop_or_a_pause(world: World, name: str, actor: str, what: str) -> None:
    moments = random.Random(7)
    for _ in range(6):
        (world.place / "lines").unlink(missing_ok=True)
        query = world.load(*[name] * 4, actor=actor)
        time.sleep(moments.random() * 0.2)  # at random is what is tested
        try:
            world.say(what, query)
            answered = time.monotonic()
        except GraphError:  # it has ended already
            answered = time.monotonic()
        if what == "pause_graph":
            wait_respawned(world.system, "actions", kill(world.system, "actions"))
        else:
            eventually(lambda query=query: query.response["graph_state"] in ("STOPPED", "FINISHED"), LIMIT_S)
        late = [line for line in world.lines() if float(line) > answered + 0.005]  # a thread that is about to begin
        query.unload(timeout_s=LIMIT_S)
        assert not late


def test_outputs_keep_their_types(world: World) -> None:
    ended = run_graph(world.app, world.graph("Gives"), timeout_s=LIMIT_S)
    expected = {"path": Path("/a"), "raw": b"abc", "many": {1, 2}, "when": datetime.date(2026, 11, 28)}
    assert ended.outputs == expected


def test_inputs_keep_their_types_also_in_the_attempt_after_a_crash(world: World) -> None:
    inputs = {name: {"pvf_type": "any"} for name in ("raw", "path")}
    place = {"place": {"pvf_type": "string", "pvf_value": str(world.place)}}
    graph = {"actions": [{"name": "Takes", "input_parameters": {**inputs, **place}}]}
    given = {"raw": b"abc", "path": Path("/a")}
    assert run_graph(world.app, graph, inputs=given, timeout_s=LIMIT_S).result == "on_true"
    assert world.lines() == ["b'abc' PosixPath('/a')"] * 2


def test_an_end_that_cannot_be_kept_is_an_error_of_the_graph(world: World) -> None:
    numbers = range(3)
    actions: list[dict[str, Any]] = [
        {"name": "Much", "instance_id": n, "input_parameters": {"number": {"pvf_type": "number", "pvf_value": n}}}
        for n in numbers
    ]
    ends = [{"name": "Much", "instance_id": n} for n in numbers]
    together = {"actions": actions, "graph_entry": ends, "graph_exit": ends}
    ended = run_graph(world.app, together, timeout_s=LIMIT_S)
    assert (ended.result, "its end cannot be kept" in ended.error) == ("on_error", True)
    assert "frame_limit_bytes" in ended.error
    ended = run_graph(world.app, {"actions": [{"name": "Odd"}]}, timeout_s=LIMIT_S)
    assert (ended.result, "lock" in ended.error) == ("on_error", True)


def test_an_action_that_does_not_stop_is_named_to_the_holders(world: World) -> None:
    statuses = Calls()
    request = RunGraph(world.graph("Stays"))
    with world.app.load("actions/graph", request, on_status=statuses, timeout_s=LIMIT_S) as query:
        eventually(lambda: world.lines() == ["began"], LIMIT_S)
        world.say("stop_graph", query)
        text = "Stays_0 has not ended within 1 s of stopping"
        eventually(lambda: [one.message for one in statuses if one.state is rr.State.WARNING] == [text], LIMIT_S)
        assert query.response["graph_state"] == "STOPPING"
        (world.place / "go").touch()
        state_is(query, "STOPPED")


def test_a_graph_that_is_overdue_says_which_action_runs(world: World) -> None:
    with pytest.raises(rr.LoadTimeout, match=r"the graph has not ended within 2 s: RUNNING, running: Moves_0 RUNNING"):
        run_graph(world.app, world.graph("Moves"), timeout_s=2)


def test_a_resume_that_cannot_be_is_refused(world: World) -> None:
    with world.load("Moves") as query:
        eventually(lambda: world.lines() == ["began 1"], LIMIT_S)
        with pytest.raises(GraphError, match="got 'RUNNING'"):
            world.say("resume_graph", query, "Moves_0")
        (world.place / "go").touch()
        state_is(query, "FINISHED")
        with pytest.raises(GraphError, match="got 'FINISHED'"):
            world.say("resume_graph", query)
