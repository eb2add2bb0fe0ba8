"""Actions: graphs that run, what their actions load, and what a crash leaves."""

from __future__ import annotations

import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec
import pytest

import rr_actors as rr
from rr_actors.managers import Action, ActionEnd, Actions, GraphError, GraphResult, RunAction, RunGraph, run_graph
from support import eventually, kill, wait_respawned

Start = Callable[..., rr.System]


class Text(msgspec.Struct):
    text: str


class Relay(Action):
    """Gives what it is given, and notes that it ran."""

    Input = Text
    Output = Text

    def run(self, given: Text) -> Text:
        return given


class Triggers(Action):
    class Input(msgspec.Struct):
        result: str

    def run(self, given: Input) -> bool:
        if given.result == "on_error":
            raise OSError("the trigger is broken")
        return given.result == "on_true"


class Compare(Action):
    class Input(msgspec.Struct):
        a: str
        b: str

    def run(self, given: Input) -> bool:
        return given.a == given.b


class Waits(Action):
    """Writes a line, holds a camera, and waits for the file `go`, or until it is stopped."""

    class Input(msgspec.Struct):
        place: str

    def run(self, given: Input) -> bool:
        self.load("cameras/camera", given.place)
        with (Path(given.place) / "lines").open("a") as lines:
            lines.write(f"began {self.attempt}\n")
        while not self.stopping.wait(0.005):
            if (Path(given.place) / "go").exists():
                return True
        return False


class Lingers(Action):
    """Writes a line, and ends only when the file `go` is there, also if it is to stop."""

    class Input(msgspec.Struct):
        place: str

    def run(self, given: Input) -> None:
        self.load("cameras/camera", given.place)
        with (Path(given.place) / "lines").open("a") as lines:
            lines.write(f"lingers {self.attempt}\n")
        while not (Path(given.place) / "go").exists():
            time.sleep(0.005)


class Notes(Action):
    class Input(msgspec.Struct):
        place: str

    def run(self, given: Input) -> None:
        with (Path(given.place) / "lines").open("a") as lines:
            lines.write("noted\n")


class Counts(Action):
    """Writes its number."""

    class Input(msgspec.Struct):
        place: str
        number: str

    def run(self, given: Input) -> None:
        with (Path(given.place) / "lines").open("a") as lines:
            lines.write(f"{given.number}\n")


class Choose(Action):
    name = "TaChoose"

    class Output(msgspec.Struct):
        state: str

    rounds: ClassVar = itertools.count()

    def run(self, given: dict[str, Any]) -> Output:
        return self.Output(["go", "rest", "go", "done"][next(self.rounds)])


class Go(Action):
    class Input(msgspec.Struct):
        state: Literal["go"]

    def run(self, given: Input) -> None: ...


class Rest(Action):
    class Input(msgspec.Struct):
        state: Literal["rest"]

    def run(self, given: Input) -> None: ...


ALL = [Relay, Triggers, Compare, Waits, Lingers, Notes, Counts, Choose, Go, Rest]


class Cameras(rr.Manager):
    may_close: ClassVar = threading.Event()
    may_close.set()

    @rr.server("camera")
    def open_camera(self, place: str) -> str:
        return place

    @open_camera.unload
    def close_camera(self, place: str, response: str | None) -> None:
        self.may_close.wait(30)


def action(
    name: str, children: Sequence[str] = (), parents: Sequence[str] = (), number: int = 0, **more: Any
) -> dict[str, Any]:
    def end(full: str) -> dict[str, Any]:
        other, _, which = full.partition("_")
        return {"name": other, "instance_id": int(which or 0)}

    inputs = {key: {"pvf_type": "string", "pvf_value": value} for key, value in more.pop("inputs", {}).items()}
    relations = {"children": [end(one) for one in children], "parents": [end(one) for one in parents]}
    return {"name": name, "instance_id": number, "input_parameters": inputs, **relations, **more}


CONDITIONAL: dict[str, Any] = {
    "graph_name": "conditional",
    "graph_entry": [{"name": "Triggers"}],
    "graph_exit": [{"name": "Compare"}],
    "actions": [
        action("Triggers", ["Relay_0", "Relay_1"]),
        action("Relay", ["Compare"], ["Triggers"], inputs={"text": "yes"}),
        action("Relay", ["Compare"], ["Triggers"], 1, inputs={"text": "no"}),
        action("Compare", [], ["Relay_0", "Relay_1"], inputs={"b": "yes"}),
    ],
}
for relay, word in ((1, "on_true"), (2, "on_false")):
    other = "on_false" if word == "on_true" else "on_true"
    CONDITIONAL["actions"][relay]["children"][0]["remap"] = [{"from": "text", "to": "a"}]
    CONDITIONAL["actions"][relay]["parents"][0]["conditions"] = [f"{word} -> run", f"{other} -> ignore"]
    CONDITIONAL["actions"][3]["parents"][relay - 1]["required"] = False


def waiting(place: Path) -> dict[str, Any]:
    """Note, wait, note again."""
    inputs = {"place": str(place)}
    actions = [
        action("Notes", ["Waits"], inputs=inputs),
        action("Waits", ["Notes_1"], ["Notes"], inputs=inputs),
        action("Notes", [], ["Waits"], 1, inputs=inputs),
    ]
    entry, exit = [{"name": "Notes"}], [{"name": "Notes", "instance_id": 1}]
    return {"graph_name": "waiting", "graph_entry": entry, "graph_exit": exit, "actions": actions}


def lines(place: Path) -> list[str]:
    file = place / "lines"
    return file.read_text().splitlines() if file.exists() else []


class Robot:
    def __init__(
        self, start: Start, graphs: Path | None = None, strategy: Any = "one_for_one", cameras: Any = "thread"
    ) -> None:
        actions = rr.ChildSpec(Actions, id="actions", kwargs={"actions": ALL, "graphs": graphs, "stop_s": 30.0})
        other = rr.ChildSpec(Cameras, id="cameras", placement=cameras)
        self.system = start(rr.Supervisor([other, actions], max_restarts=100, strategy=strategy))
        self.app = self.system.open_registrar("app")
        self.messages = self.system.ref("actions").proxy()

    def cameras(self) -> int:
        return len(self.system.registrar("cameras").resources())

    def held(self) -> int:
        return len(self.system.registrar("actions").resources())

    def is_clean(self) -> bool:
        return not self.cameras() and not self.held()


@pytest.fixture
def robot(start: Start) -> Robot:
    return Robot(start)


@pytest.mark.parametrize(("trigger", "result"), [("on_true", "on_true"), ("on_false", "on_false")])
def test_a_conditional_graph_runs_the_branch_of_the_result(robot: Robot, trigger: str, result: str) -> None:
    ended = run_graph(robot.app, CONDITIONAL, inputs={"result": trigger}, timeout_s=60)
    assert ended.result == result
    assert ended.states["Relay_0" if trigger == "on_true" else "Relay_1"] == "FINISHED"
    assert ended.states["Relay_1" if trigger == "on_true" else "Relay_0"] == "UNINITIALIZED"
    assert eventually(robot.is_clean)


def test_an_error_ends_the_graph_with_its_trace_and_the_holder_still_holds_it(robot: Robot) -> None:
    graph = {"actions": [action("Triggers", inputs={"result": "on_error"})]}
    with robot.app.load("actions/graph", RunGraph(graph)) as query:
        status = query.wait_status(rr.State.ERROR, timeout_s=60)
        assert "OSError: the trigger is broken" in status.message
        assert query.response["graph_state"] == "ERROR"
        assert query.response["actions"][0]["state"] == "ERROR"
    ended = run_graph(robot.app, graph, timeout_s=60)
    assert (ended.result, ended.states) == ("on_error", {"Triggers_0": "ERROR"})
    assert "the trigger is broken" in ended.error


def test_a_cyclic_state_machine_of_the_older_dialect_runs_until_no_child_accepts(robot: Robot) -> None:
    def older(
        name: str, children: Sequence[str], parents: Sequence[str], effect: str, required: bool
    ) -> dict[str, Any]:
        listed = [{"name": one, "id": 0, "required": required} for one in parents]
        return {
            "name": name,
            "id": 0,
            "effect": effect,
            "parents": listed,
            "children": [{"name": one, "id": 0} for one in children],
        }

    actions = [
        older("TaChoose", ["Go", "Rest"], ["Go", "Rest"], "asynchronous", False) | {"execute_first": True},
        older("Go", ["TaChoose"], ["TaChoose"], "synchronous", True),
        older("Rest", ["TaChoose"], ["TaChoose"], "synchronous", True),
    ]
    said: list[str] = []
    request = RunGraph({"graph_name": "machine", "umrf_actions": actions})
    with robot.app.load("actions/graph", request, on_status=lambda status: said.append(status.message)) as query:
        begun = ["TaChoose", "Go", "TaChoose", "Rest", "TaChoose", "Go", "TaChoose"]
        eventually(lambda: len(said) > len(begun), timeout=60)
        assert query.response["graph_state"] == "FINISHED"
    assert said == ["begin", *(f"{name}_0: on_true" for name in begun)]


def test_what_an_action_has_loaded_is_released_when_it_has_ended(robot: Robot, tmp_path: Path) -> None:
    with robot.app.load("actions/graph", RunGraph(waiting(tmp_path))) as query:
        assert eventually(lambda: robot.cameras() == 1)
        (tmp_path / "go").touch()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
        assert eventually(lambda: robot.cameras() == 0)
    assert lines(tmp_path) == ["noted", "began 1", "noted"]


def test_to_release_a_graph_stops_it_and_leaves_nothing(robot: Robot, tmp_path: Path) -> None:
    query = robot.app.load("actions/graph", RunGraph(waiting(tmp_path)))
    assert eventually(lambda: robot.cameras() == 1)
    query.unload()
    assert eventually(robot.is_clean)
    assert lines(tmp_path) == ["noted", "began 1"]


def test_when_a_graph_is_released_all_that_its_actions_have_loaded_is(robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "go").touch()
    Cameras.may_close.clear()
    later = threading.Timer(0.3, Cameras.may_close.set)
    with robot.app.load(
        "actions/graph", RunGraph({"actions": [action("Waits", inputs={"place": str(tmp_path)})]})
    ) as query:
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
        later.start()
    assert robot.is_clean()


def test_a_graph_can_be_stopped_paused_and_resumed_by_messages(robot: Robot, tmp_path: Path) -> None:
    with robot.app.load("actions/graph", RunGraph(waiting(tmp_path))) as query:
        assert eventually(lambda: robot.cameras() == 1)
        robot.messages.pause_graph(query.resource_id).get()
        (tmp_path / "go").touch()
        assert eventually(lambda: query.response["actions"][2]["state"] == "INITIALIZED")
        assert query.response["graph_state"] == "PAUSED"
        assert lines(tmp_path) == ["noted", "began 1"]
        (row,) = robot.messages.graph_rows().get()
        assert (row["id"], row["state"], row["running"]) == (query.resource_id, "PAUSED", [])
        assert (row["ended"], row["actions"]) == (2, len(query.response["actions"]))
        robot.messages.resume_graph(query.resource_id).get()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
    (tmp_path / "go").unlink()
    with robot.app.load("actions/graph", RunGraph(waiting(tmp_path))) as query:
        assert eventually(lambda: robot.cameras() == 1)
        robot.messages.stop_graph(query.resource_id).get()
        assert eventually(lambda: query.response["graph_state"] == "STOPPED")
    for id, said in (("x", "'x'"), (["x"], r"\['x'\]")):
        with pytest.raises(rr.NotFound, match=f"no graph {said}"):
            robot.messages.stop_graph(id).get()


def test_a_graph_can_be_paused_resumed_and_stopped_by_a_connected_program(robot: Robot, tmp_path: Path) -> None:
    with (
        rr.connect(robot.system.state_dir) as connection,
        robot.app.load("actions/graph", RunGraph(lingering(tmp_path))) as query,
    ):
        actions = connection.proxy("actions")
        actions.pause_graph(query.resource_id).get(timeout=30)
        assert eventually(lambda: query.response["graph_state"] == "PAUSED")
        actions.resume_graph(query.resource_id).get(timeout=30)
        assert eventually(lambda: query.response["graph_state"] == "RUNNING")
        actions.stop_graph(query.resource_id).get(timeout=30)
        (tmp_path / "go").touch()
        assert eventually(lambda: query.response["graph_state"] == "STOPPED")
        with pytest.raises(rr.NotFound, match="no graph 'x'"):
            actions.stop_graph("x").get(timeout=30)


def test_what_is_said_to_a_graph_as_soon_as_it_is_loaded_is_not_lost(robot: Robot, tmp_path: Path) -> None:
    with robot.app.load("actions/graph", RunGraph(lingering(tmp_path))) as query:
        robot.messages.pause_graph(query.resource_id).get()
        assert eventually(lambda: query.response["graph_state"] == "PAUSED")
        (tmp_path / "go").touch()
        robot.messages.resume_graph(query.resource_id).get()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")


def lingering(place: Path) -> dict[str, Any]:
    """Linger, and note."""
    inputs = {"place": str(place)}
    return {"actions": [action("Lingers", ["Notes"], inputs=inputs), action("Notes", [], ["Lingers"], inputs=inputs)]}


def test_a_graph_that_runs_goes_on_as_another_when_what_that_does_not_have_is_released(
    robot: Robot, tmp_path: Path
) -> None:
    with robot.app.load("actions/graph", RunGraph(lingering(tmp_path))) as query:
        assert eventually(lambda: lines(tmp_path) == ["lingers 1"])
        for wrong, start in (({"actions": [action("Relays")]}, ""), (waiting(tmp_path), "Notes_2")):
            with pytest.raises(GraphError, match="expected"):
                robot.messages.change_graph(query.resource_id, wrong, start).get()
        robot.messages.change_graph(query.resource_id, waiting(tmp_path), "Waits_0").get()
        assert query.response["graph_name"] == "waiting"
        assert eventually(lambda: query.response["actions"][1]["state"] == "INITIALIZED")
        assert lines(tmp_path) == ["lingers 1"]
        (tmp_path / "go").touch()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
        assert eventually(lambda: robot.cameras() == 0)
        with pytest.raises(GraphError, match="got 'FINISHED'"):
            robot.messages.change_graph(query.resource_id, waiting(tmp_path)).get()
    assert lines(tmp_path) == ["lingers 1", "began 1", "noted"]
    assert eventually(robot.is_clean)


def test_a_manager_that_is_killed_in_the_middle_of_a_change_goes_on_with_the_new_graph(
    robot: Robot, tmp_path: Path
) -> None:
    with robot.app.load("actions/graph", RunGraph(lingering(tmp_path))) as query:
        assert eventually(lambda: lines(tmp_path) == ["lingers 1"])
        robot.messages.change_graph(query.resource_id, waiting(tmp_path), "Waits_0").get()
        wait_respawned(robot.system, "actions", kill(robot.system, "actions"))
        assert eventually(lambda: lines(tmp_path) == ["lingers 1", "began 1"], timeout=60)
        (tmp_path / "go").touch()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
    assert lines(tmp_path) == ["lingers 1", "began 1", "noted"]
    assert eventually(robot.is_clean)


def test_a_sub_graph_that_a_change_stops_is_stopped_also_if_the_manager_is_killed(start: Start, tmp_path: Path) -> None:
    graphs = tmp_path / "graphs"
    graphs.mkdir()
    inner = action("Lingers", inputs={"place": str(tmp_path)})
    (graphs / "inner.json").write_text(json.dumps({"graph_name": "inner", "actions": [inner]}))
    robot = Robot(start, graphs)
    with robot.app.load("actions/graph", RunGraph({"actions": [action("inner")]})) as query:
        assert eventually(lambda: lines(tmp_path) == ["lingers 1"])
        robot.messages.change_graph(query.resource_id, {"actions": [action("Relay", inputs={"text": "x"})]}).get()
        wait_respawned(robot.system, "actions", kill(robot.system, "actions"))
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
        assert query.response["rr_run"]["outputs"] == {"text": "x"}
    assert eventually(robot.is_clean)


def test_a_killed_manager_goes_on_from_the_last_transition(robot: Robot, tmp_path: Path) -> None:
    with robot.app.load("actions/graph", RunGraph(waiting(tmp_path))) as query:
        assert eventually(lambda: lines(tmp_path) == ["noted", "began 1"])
        wait_respawned(robot.system, "actions", kill(robot.system, "actions"))
        assert eventually(lambda: len(lines(tmp_path)) >= 3, timeout=60)
        assert eventually(lambda: robot.cameras() == 1)
        (tmp_path / "go").touch()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
    assert lines(tmp_path) == ["noted", "began 1", "began 2", "noted"]
    assert eventually(robot.is_clean)


class Late(Actions):
    """Its own graph is loaded, and runs, before on_start goes on with the graphs of the process before."""

    def __init__(self, place: str) -> None:
        super().__init__(ALL)
        self.place = Path(place)

    def on_start(self) -> None:
        self.registrar.load("actions/graph", RunGraph(waiting(self.place)))
        assert eventually(lambda: lines(self.place) == ["noted", "began 1"])
        super().on_start()


def test_a_graph_that_runs_before_on_start_has_one_engine(start: Start, tmp_path: Path) -> None:
    cameras = rr.ChildSpec(Cameras, id="cameras", placement="thread")
    system = start(rr.Supervisor([cameras, rr.ChildSpec(Late, id="actions", args=(str(tmp_path),))]))
    actions, messages = system.registrar("actions"), system.ref("actions").proxy()
    (id,) = [info.id for info in actions.resources() if info.server == "graph"]

    def graph() -> Any:
        return next(info.response for info in actions.resources() if info.id == id)

    messages.pause_graph(id).get()
    (tmp_path / "go").touch()
    assert eventually(lambda: graph()["actions"][2]["state"] == "INITIALIZED")
    assert graph()["graph_state"] == "PAUSED"
    assert lines(tmp_path) == ["noted", "began 1"]
    messages.resume_graph(id).get()
    assert eventually(lambda: graph()["graph_state"] == "FINISHED")
    assert lines(tmp_path) == ["noted", "began 1", "noted"]


def test_killed_at_any_moment_no_action_runs_again_after_its_child_has_begun(robot: Robot, tmp_path: Path) -> None:
    steps = 60
    actions = [
        action(
            "Counts",
            [f"Counts_{i + 1}"] if i + 1 < steps else [],
            [f"Counts_{i - 1}"] if i else [],
            i,
            inputs={"place": str(tmp_path), "number": str(i)},
        )
        for i in range(steps)
    ]
    with robot.app.load("actions/graph", RunGraph({"actions": actions})) as query:
        for count in (3, 20, 40):
            assert eventually(lambda count=count: len(lines(tmp_path)) >= count, timeout=60)
            wait_respawned(robot.system, "actions", kill(robot.system, "actions"))
        assert eventually(lambda: query.response["graph_state"] == "FINISHED", timeout=60)
    numbers = [int(line) for line in lines(tmp_path)]
    assert numbers == sorted(numbers)
    assert set(numbers) == set(range(steps))
    assert eventually(robot.is_clean)


def test_an_action_that_crashes_its_manager_each_time_ends_with_on_error(robot: Robot, tmp_path: Path) -> None:
    graph = {"actions": [action("Waits", inputs={"place": str(tmp_path)})]}
    with robot.app.load("actions/graph", RunGraph(graph)) as query:
        for attempt in (1, 2, 3):
            assert eventually(lambda attempt=attempt: lines(tmp_path)[-1:] == [f"began {attempt}"])
            wait_respawned(robot.system, "actions", kill(robot.system, "actions"))
        assert "in 3 attempts" in query.wait_status(rr.State.ERROR, timeout_s=60).message
    assert eventually(robot.is_clean)


def test_a_sub_graph_is_an_action_that_takes_and_gives(start: Start, tmp_path: Path) -> None:
    (tmp_path / "inner.json").write_text(json.dumps(CONDITIONAL | {"graph_name": "inner"}))
    sub = action("inner", ["Relay"], ["Triggers"], inputs={"result": "on_false"})
    actions = [
        action("Triggers", ["inner"], inputs={"result": "on_true"}),
        sub,
        action("Relay", [], ["inner"], inputs={"text": "after"}),
    ]
    actions[2]["parents"][0]["conditions"] = ["on_false -> run", "on_true -> ignore"]
    outer = {"graph_name": "outer", "graph_entry": [{"name": "Triggers"}], "actions": actions}
    (tmp_path / "outer.json").write_text(json.dumps(outer))
    robot = Robot(start, tmp_path)
    ended = run_graph(robot.app, "outer", timeout_s=60)
    assert ended == GraphResult(
        "on_true", {"text": "after"}, dict.fromkeys(("Triggers_0", "inner_0", "Relay_0"), "FINISHED")
    )
    assert eventually(robot.is_clean)


def test_an_action_can_stop_a_sub_graph_that_never_ends(start: Start, tmp_path: Path) -> None:
    graphs = tmp_path / "graphs"
    graphs.mkdir()
    forever = action("Waits", inputs={"place": str(tmp_path)})
    (graphs / "forever.json").write_text(json.dumps({"graph_name": "forever", "actions": [forever]}))
    stops = action("forever", [], ["Triggers"])
    stops["parents"][0] |= {"required": False, "conditions": ["on_true -> stop"]}
    graph = {
        "graph_entry": [{"name": "Waits", "instance_id": 1}, {"name": "forever"}],
        "graph_exit": [{"name": "forever", "conditions": ["on_stopped -> bypass"]}],
        "actions": [
            action("Waits", ["Triggers"], [], 1, inputs={"place": str(tmp_path / "other")}),
            action("Triggers", ["forever"], ["Waits_1"], inputs={"result": "on_true"}),
            stops,
        ],
    }
    (tmp_path / "other").mkdir()
    robot = Robot(start, graphs)
    with robot.app.load("actions/graph", RunGraph(graph)) as query:
        assert eventually(lambda: robot.cameras() == 2)
        (tmp_path / "other" / "go").touch()
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
        assert query.response["rr_run"]["result"] == "on_stopped"
    assert lines(tmp_path) == ["began 1"]
    assert eventually(robot.is_clean)


def test_an_action_whose_part_is_lost_is_told_to_stop_and_its_graph_goes_on(robot: Robot, tmp_path: Path) -> None:
    heard: list[str] = []
    with robot.app.load(
        "actions/graph", RunGraph(waiting(tmp_path)), on_status=lambda s: heard.append(s.state)
    ) as query:
        assert eventually(lambda: robot.cameras() == 1)
        cameras = robot.system.registrar("cameras")
        cameras.send_status(cameras.resources()[0].id, rr.Status(rr.State.FATAL, "unplugged"))
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
    assert lines(tmp_path) == ["noted", "began 1", "noted"]
    assert rr.State.FATAL not in heard


def test_one_action_can_be_loaded_alone(robot: Robot) -> None:
    with robot.app.load("actions/action", RunAction("Relay", {"text": "hello"})) as query:
        assert query.response == ActionEnd("on_true", {"text": "hello"})


def test_a_wrong_graph_is_refused_by_name_and_leaves_nothing(robot: Robot, tmp_path: Path) -> None:
    file = tmp_path / "wrong.json"
    file.write_text(json.dumps({"actions": [action("Relays")]}))
    cases: list[tuple[Any, dict[str, Any], str, str]] = [
        (file, {}, "actions[0].name", "an action or a graph: one of Choose, "),
        ("patrol", {}, "graph", "a graph: one of none, got 'patrol'"),
        (CONDITIONAL, {}, "inputs.result", "a string, got none"),
        (CONDITIONAL, {"result": 1}, "inputs.result", "a string, got 1"),
        (CONDITIONAL, {"result": "x", "more": 1}, "inputs.more", "an input: one of result"),
    ]
    for graph, inputs, path, said in cases[1:]:
        with pytest.raises(GraphError, match="expected") as raised:
            run_graph(robot.app, graph, inputs=inputs, timeout_s=60)
        assert raised.value.path == path
        assert said in str(raised.value)
    with pytest.raises(GraphError, match="got 'Relays'") as raised:
        run_graph(robot.app, file, timeout_s=60)
    assert (raised.value.file, raised.value.path) == (str(file), "actions[0].name")
    assert eventually(robot.is_clean)


def test_a_graph_that_does_not_end_in_time_is_stopped(robot: Robot, tmp_path: Path) -> None:
    with pytest.raises(rr.LoadTimeout):
        run_graph(robot.app, waiting(tmp_path), timeout_s=0.5)
    assert eventually(robot.is_clean)


def test_a_manager_with_a_wrong_graph_does_not_start(start: Start, tmp_path: Path) -> None:
    (tmp_path / "wrong.json").write_text("[]")
    with pytest.raises(rr.StartFailed, match=r"wrong\.json: expected a JSON object, got \[\]"):
        Robot(start, tmp_path)
    actions = [action("self", inputs={})]
    (tmp_path / "wrong.json").write_text(json.dumps({"graph_name": "self", "actions": actions}))
    with pytest.raises(rr.StartFailed, match="a graph that is not inside itself"):
        Robot(start, tmp_path)


def test_a_manager_that_is_restarted_in_order_ends_no_action(start: Start, tmp_path: Path) -> None:
    robot = Robot(start, strategy="one_for_all", cameras="process")
    query = robot.app.load("actions/graph", RunGraph(waiting(tmp_path)))
    assert eventually(lambda: robot.cameras() == 1)
    kill(robot.system, "cameras")
    assert eventually(lambda: lines(tmp_path) == ["noted", "began 1", "began 2"])
    (tmp_path / "go").touch()
    assert eventually(lambda: query.response["graph_state"] == "FINISHED")


def test_a_class_without_run_is_refused_by_name() -> None:
    class Idle(rr.Action):
        pass

    with pytest.raises(rr.UsageError, match=r"expected a class with a method run\(\), got Idle without one"):
        Actions(actions=[Idle])


class Dies(Actions):
    """Kills its process once, when a sub-graph is loaded and held, and the first step of that is to be written."""

    def __init__(self, graphs: str, mark: str) -> None:
        super().__init__(ALL, graphs)
        self.mark = Path(mark)

    def on_start(self) -> None:
        write = self.registrar.update_response

        def dies(id: Any, response: dict[str, Any], message: str = "") -> None:
            if response.get("graph_name") == "inner" and not self.mark.exists():
                assert eventually(lambda: any(query.resource_id == id for query in self.registrar.queries()))
                self.mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            write(id, response, message)

        self.registrar.update_response = dies  # type: ignore[method-assign]
        super().on_start()


def test_a_crash_between_the_load_of_a_sub_graph_and_its_first_step_holds_up_nothing(
    start: Start, tmp_path: Path
) -> None:
    graphs, mark = tmp_path / "graphs", tmp_path / "mark"
    graphs.mkdir()
    inner = {"graph_name": "inner", "actions": [action("Relay", inputs={"text": "x"})]}
    (graphs / "inner.json").write_text(json.dumps(inner))
    system = start(rr.Supervisor([rr.ChildSpec(Dies, id="actions", args=(str(graphs), str(mark)))]))
    ended = run_graph(system.open_registrar("app"), {"actions": [action("inner")]}, timeout_s=20)
    assert ended.outputs == {"text": "x"}
    assert mark.exists()
