"""`rr-actors graph check`, `show`, `run` and `change`: a graph of actions in a file, from the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

import rr_actors as rr
from rr_actors.managers import Actions, RunGraph
from rr_actors.tools.verbs.verb_group import app
from support import eventually

Start = Callable[..., rr.System]

GRAPH: dict[str, Any] = {
    "graph_name": "look_and_tell",
    "graph_exit": [{"name": "Tell"}],
    "actions": [
        {"name": "Look", "children": [{"name": "Tell", "remap": [{"from": "seen", "to": "words"}]}]},
        {"name": "Tell", "parents": [{"name": "Look"}]},
    ],
}


class Look(rr.Action):
    class Input(msgspec.Struct):
        where: str

    class Output(msgspec.Struct):
        seen: str

    def run(self, given: Input) -> Output:
        if given.where == "nowhere":
            raise RuntimeError("nothing to see")
        return self.Output(f"a cup in the {given.where}")


class Wait(rr.Action):
    def run(self, given: object) -> None:
        self.stopping.wait(60)


class Tell(rr.Action):
    class Input(msgspec.Struct):
        words: str

    Output = Input

    def run(self, given: Input) -> Input:
        return given


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "graph.json"
    path.write_text(json.dumps(GRAPH))
    return path


def said(*arguments: object, code: int = 0) -> str:
    ran = CliRunner().invoke(app, ["graph", *map(str, arguments)])
    if isinstance(ran.exception, rr.RrError):
        raise ran.exception
    assert ran.exit_code == code, ran.output
    return ran.output


def test_a_graph_without_a_fault_is_said_to_have_none(file: Path) -> None:
    assert said("check", file) == f"{file}: look_and_tell: 2 actions, from Look_0 to Tell_0; no fault found\n"


@pytest.mark.parametrize(
    ("change", "path"),
    [
        (lambda graph: graph["actions"][1].pop("parents"), "actions[0].children[0]"),
        (lambda graph: graph.pop("actions"), "actions"),
        (lambda graph: graph["graph_exit"][0].update(name="Run"), "graph_exit[0]"),
        (lambda graph: graph["actions"][1]["parents"][0].update(conditions=["on_true -> jump"]), "conditions"),
    ],
)
def test_a_fault_is_named_with_its_file_and_place(change: Callable[[Any], object], path: str, file: Path) -> None:
    graph = json.loads(file.read_text())
    change(graph)
    file.write_text(json.dumps(graph))
    with pytest.raises(rr.GraphError) as caught:
        said("check", file)
    assert caught.value.file == str(file)
    assert path in caught.value.path


def test_a_graph_is_drawn_as_text_and_as_svg(file: Path) -> None:
    assert said("show", file).splitlines() == ["graph TD", '    a0("Look_0")', '    a1("Tell_0")', "    a0 --> a1"]
    picture = said("show", file, "--format", "svg")
    assert picture.startswith("<svg")
    assert re.findall(r">(\w+_0)<", picture) == ["Look_0", "Tell_0"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("check",), "graph check: expected a file with a graph of actions, got none"),
        (("show", "{file}", "--format", "dot"), "graph show: --format: expected mermaid, svg or png, got dot"),
        (("run", "{file}", "--inputs", "[1]"), "--inputs: expected a JSON object, got '[1]'"),
    ],
)
def test_a_wrong_call_is_refused(arguments: tuple[str, ...], text: str, file: Path) -> None:
    with pytest.raises(rr.UsageError, match=re.escape(text)):
        said(*(one.format(file=file) for one in arguments))


def test_a_graph_is_run_by_the_child_actions_to_its_end(start: Start, state_dir: Path, file: Path) -> None:
    start(rr.ChildSpec(Actions, id="actions", kwargs={"actions": [Look, Tell]}, placement="thread"))
    at = ("--state", state_dir)
    *table, result = said("run", file, "--inputs", '{"where": "kitchen"}', *at).splitlines()
    assert [line.split() for line in table] == [["action", "state"], ["Look_0", "FINISHED"], ["Tell_0", "FINISHED"]]
    assert json.loads(result) == {"result": "on_true", "outputs": {"words": "a cup in the kitchen"}, "error": ""}
    failed = json.loads(said("run", file, "--inputs", '{"where": "nowhere"}', *at, code=1).splitlines()[-1])
    assert failed["result"] == "on_error"
    assert "nothing to see" in failed["error"]
    with pytest.raises(rr.GraphError) as caught:
        said("run", file, *at)
    assert (caught.value.file, caught.value.path) == (str(file), "inputs.where")


def test_a_graph_that_runs_goes_on_as_the_one_in_a_file(start: Start, state_dir: Path, file: Path) -> None:
    kwargs = {"actions": [Look, Tell, Wait]}
    system = start(rr.ChildSpec(Actions, id="actions", kwargs=kwargs, placement="thread"))
    graph: dict[str, Any] = json.loads(file.read_text())
    graph["actions"][1]["input_parameters"] = {"words": {"pvf_type": "string", "pvf_value": "hello"}}
    file.write_text(json.dumps(graph))
    at = ("--state", state_dir)
    with system.open_registrar("app").load("actions/graph", RunGraph({"actions": [{"name": "Wait"}]})) as query:
        with pytest.raises(rr.UnknownQuery, match="'x': no graph that runs has this id"):
            said("change", file, "x", *at)
        with pytest.raises(rr.GraphError) as caught:
            said("change", file, query.resource_id, "--from", "Look_1", *at)
        assert (caught.value.file, caught.value.path) == (str(file), "start")
        goes_on = said("change", file, query.resource_id[-8:], "--from", "Tell_0", *at)
        assert goes_on == f"{query.resource_id}: goes on as look_and_tell\n"
        assert eventually(lambda: query.response["graph_state"] == "FINISHED")
        assert run_of(query.response) == {"Look_0": "UNINITIALIZED", "Tell_0": "FINISHED"}
        with pytest.raises(rr.GraphError, match="expected one of RUNNING, PAUSED, HALTED, got 'FINISHED'"):
            said("change", file, query.resource_id, *at)


def run_of(response: dict[str, Any]) -> dict[str, str]:
    return {f"{one['name']}_0": one["state"] for one in response["actions"]}


def test_a_graph_of_the_managers_folder_is_run_by_its_name(start: Start, state_dir: Path, file: Path) -> None:
    names = [f"{__name__}:{kind.__name__}" for kind in (Look, Tell)]  # as in a TOML file
    actions = rr.ChildSpec(Actions, id="actions", args=(names, str(file.parent)), placement="thread")
    start(actions)
    inputs = ("--inputs", '{"where": "hall"}', "--state", state_dir)
    assert "a cup in the hall" in said("run", "look_and_tell", *inputs)
    with pytest.raises(rr.GraphError, match="expected a graph: one of look_and_tell, got 'look'"):
        said("run", "look", *inputs)


@pytest.mark.parametrize("name", ["Look", f"{__name__}:Nothing", "no_such_module:Look", ":Look"])
def test_an_action_by_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(rr.UsageError, match=f"expected subclasses of rr.Action, or their names .*, got '{name}'"):
        Actions([name])
