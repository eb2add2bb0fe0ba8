"""The semantics of graphs: for each shape of the public tests of TeMoto's action engine, the result that they expect.

The graphs are written for these tests, with actions of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.managers import Actions, run_graph
from support import eventually

Start = Callable[..., rr.System]


class Joins(rr.Action):
    class Input(msgspec.Struct):
        left: str
        right: str

    class Output(msgspec.Struct):
        joined: str

    def run(self, given: Input) -> Output:
        return self.Output(f"{given.left}+{given.right}")


class Equals(rr.Action):
    class Input(msgspec.Struct):
        text: str
        wanted: str

    def run(self, given: Input) -> bool:
        return given.text == given.wanted


class Ends(rr.Action):
    """Ends with the result that it is given."""

    class Input(msgspec.Struct):
        result: str

    def run(self, given: Input) -> bool:
        if given.result == "on_error":
            raise OSError("as it was told")
        return given.result == "on_true"


class Gives(rr.Action):
    Input = Output = Ends.Input

    def run(self, given: Ends.Input) -> Ends.Input:
        return given


class Endless(rr.Action):
    def run(self, given: object) -> None:
        assert self.stopping.wait(60)


class Third(rr.Action):
    """Is started afresh by a spontaneous parent; only its third run ends by itself."""

    begun = 0

    def run(self, given: object) -> bool:
        Third.begun += 1
        return Third.begun >= 3 or not self.stopping.wait(60)


def action(name: str, *children: Any, number: int = 0, **more: Any) -> dict[str, Any]:
    """An action with inputs by their names, and its children: a name, or a name, a number and a remap."""
    inputs = {key: {"pvf_type": "string", "pvf_value": value} for key, value in more.pop("inputs", {}).items()}
    return {"name": name, "instance_id": number, "input_parameters": inputs, "children": list(children), **more}


def end(name: str, *conditions: str, number: int = 0, required: bool = True, **remap: str) -> dict[str, Any]:
    """One end of a relation, or an entry or exit."""
    pairs = [{"from": key, "to": value} for key, value in remap.items()]
    found = {"name": name, "instance_id": number, "required": required, "conditions": list(conditions)}
    return found | ({"remap": pairs} if pairs else {})


BYPASS = ("on_true -> run", "on_false -> bypass", "on_error -> bypass")
SEQUENCE = [
    action("Joins", end("Equals", joined="text"), inputs={"left": "a", "right": "b"}),
    action("Equals", inputs={"wanted": "a+b"}, parents=[end("Joins", *BYPASS)]),
]
CONCURRENT = [
    action("Joins", end("Joins", number=2, joined="left"), inputs={"left": "a", "right": "b"}),
    action("Joins", end("Joins", number=2, joined="right"), number=1, inputs={"left": "c", "right": "d"}),
    action(
        "Joins",
        end("Equals", joined="text"),
        number=2,
        parents=[end("Joins", *BYPASS), end("Joins", *BYPASS, number=1)],
    ),
    action("Equals", inputs={"wanted": "a+b+c+d"}, parents=[end("Joins", *BYPASS, number=2)]),
]
CONDITIONAL = [
    action("Ends", end("Gives"), end("Gives", number=1), inputs={"result": "on_true"}),
    action(
        "Gives",
        end("Equals", result="text"),
        inputs={"result": "yes"},
        parents=[end("Ends", "on_true -> run", "on_false -> ignore", "on_error -> bypass")],
    ),
    action(
        "Gives",
        end("Equals", result="text"),
        number=1,
        inputs={"result": "no"},
        parents=[end("Ends", "on_true -> ignore", "on_false -> run", "on_error -> bypass")],
    ),
    action(
        "Equals",
        inputs={"wanted": "yes"},
        parents=[end("Gives", required=False), end("Gives", number=1, required=False)],
    ),
]
STOPPED = [
    action("Ends", end("Endless"), inputs={"result": "on_true"}),
    action("Endless", parents=[end("Ends", "on_true -> stop", "on_false -> bypass", required=False)]),
]
HIERARCHY = [
    action("Gives", end("inner", result="left"), inputs={"result": "a"}),
    action("inner", end("Equals", joined="text"), parents=[end("Gives")]),
    action("Equals", inputs={"wanted": "a+b+c"}, parents=[end("inner")]),
]
REACTIVE = [
    action("Ends", end("Third"), inputs={"result": "on_true"}, type="spontaneous"),
    action("Third", parents=[end("Ends")]),
]
STOPPED_INNER = [
    action("Ends", end("endless"), inputs={"result": "on_true"}),
    action("endless", parents=[end("Ends", "on_true -> stop", required=False)]),
]
HALTED = [action("Gives", end("Ends"), inputs={"result": "on_error"}), action("Ends", parents=[end("Gives")])]
INNER = [
    action("Joins", end("Joins", number=1, joined="left"), inputs={"right": "b"}),
    action("Joins", number=1, inputs={"right": "c"}, parents=[end("Joins")]),
]
LIBRARY = {"inner": INNER, "endless": [action("Endless")]}

SEMANTICS: list[tuple[str, list[dict[str, Any]], list[Any], list[Any], str]] = [
    # the shape, its actions, its entries and exits, the result
    ("one action", [action("Ends", inputs={"result": "on_true"})], [], [], "on_true"),
    ("a sequence", SEQUENCE, [], [], "on_true"),
    ("two at once, and a join", CONCURRENT, [], [], "on_true"),
    ("a branch", CONDITIONAL, [], [], "on_true"),
    (
        "an action stops another one",
        STOPPED,
        [end("Ends"), end("Endless")],
        [end("Endless", "on_stopped -> run")],
        "on_stopped",
    ),
    ("a sub-graph", HIERARCHY, [], [], "on_true"),
    ("a spontaneous action starts its child afresh", REACTIVE, [], [end("Third")], "on_true"),
    (
        "an action stops a sub-graph",
        STOPPED_INNER,
        [end("Ends"), end("endless")],
        [end("endless", "on_stopped -> bypass")],
        "on_stopped",
    ),
    ("the exit ignores the result", HALTED, [], [end("Ends", "on_error -> ignore")], "on_halted"),
]


@pytest.fixture
def system(start: Start, tmp_path: Path) -> rr.System:
    for name, actions in LIBRARY.items():
        (tmp_path / f"{name}.json").write_text(json.dumps({"graph_name": name, "actions": actions}))
    kwargs = {"actions": [Joins, Equals, Ends, Gives, Endless, Third], "graphs": tmp_path, "stop_s": 30.0}
    return start(rr.ChildSpec(Actions, id="actions", kwargs=kwargs, placement="thread"))


def test_each_shape_of_the_public_semantics_has_its_result(system: rr.System) -> None:
    app = system.open_registrar("app")
    results: dict[str, str] = {}
    for shape, actions, entries, exits, _ in SEMANTICS:
        Third.begun = 0
        graph: dict[str, Any] = {"graph_name": shape, "actions": actions, "graph_entry": entries}
        results[shape] = run_graph(app, graph | ({"graph_exit": exits} if exits else {}), timeout_s=60).result
        assert eventually(lambda: not system.registrar("actions").resources())
    assert results == {shape: result for shape, *_, result in SEMANTICS}
