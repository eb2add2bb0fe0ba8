"""Graphs in JSON: what both dialects mean, and what each fault of a file is called."""

from __future__ import annotations

import contextlib
import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.base.errors import GraphError, LoadFailed, UsageError
from rr_actors.managers.actions.graph_checks import Signature, check_graph, completed, signature_of
from rr_actors.managers.actions.graph_documents import read_graph, read_graph_file
from rr_actors.managers.actions.graph_model import DEFAULT_CONDITIONS, Parameter, flat, is_of_type, nested

Table = dict[str, Any]
TEXT, NUMBER = {"pvf_type": "string"}, {"pvf_type": "number"}

NEWER: Table = {
    "graph_name": "look_and_tell",
    "graph_entry": [{"name": "TaLook", "instance_id": 0}],
    "graph_exit": [{"name": "TaTell", "instance_id": 2, "conditions": ["on_false->run"]}],
    "actions": [
        {
            "name": "TaLook",
            "type": "sync",
            "input_parameters": {"where": {"x": {**NUMBER, "pvf_value": 1}, "y": {**NUMBER, "pvf_required": False}}},
            "output_parameters": {"seen": TEXT, "count": NUMBER},
            "children": [{"name": "TaTell", "instance_id": 2, "remap": [{"from": "seen", "to": "words"}]}],
            "gui_attributes": {"position": {"x": 1}},
        },
        {
            "name": "TaTell",
            "instance_id": 2,
            "type": "spontaneous",
            "actor": "other",
            "input_parameters": {"words": {**TEXT, "pvf_allowed_values": ["yes", "no"], "pvf_updatable": True}},
            "parents": [{"name": "TaLook", "instance_id": 0, "required": False, "conditions": ["on_true -> restart"]}],
        },
    ],
}
OLDER: Table = {
    "graph_name": "fetch",
    "graph_state": 1,
    "umrf_actions": [
        {
            "name": "TaStart",
            "package_name": "ta_start",
            "id": 0,
            "effect": "asynchronous",
            "output_parameters": {"place": TEXT},
            "children": [{"name": "TaFetch", "id": 1}],
        },
        {
            "name": "TaFetch",
            "package_name": "ta_fetch",
            "id": 1,
            "effect": "synchronous",
            "input_parameters": {"place": {**TEXT, "pvf_example": "kitchen"}},
            "parents": [{"name": "TaStart", "id": 0, "required": True, "stop_when_received": False}],
        },
    ],
}


def test_the_newer_dialect_is_read_as_it_is() -> None:
    graph = read_graph(NEWER)
    check_graph(graph)
    look, tell = graph.nodes["TaLook_0"], graph.nodes["TaTell_2"]
    assert (graph.name, graph.dialect, graph.entry) == ("look_and_tell", 2, ("TaLook_0",))
    assert look.inputs == {"where::x": Parameter("number", 1, True), "where::y": Parameter("number", required=False)}
    assert look.children == {"TaTell_2": {"seen": "words"}}
    assert (look.spontaneous, tell.spontaneous, tell.actor) == (False, True, "other")
    assert tell.inputs["words"].allowed == ("yes", "no")
    parent = tell.parents["TaLook_0"]
    assert (parent.required, parent.conditions) == (False, {**DEFAULT_CONDITIONS, "on_true": "restart"})
    assert graph.exit["TaTell_2"].conditions["on_false"] == "run"


def test_the_older_dialect_is_read_as_it_is() -> None:
    graph = read_graph(OLDER)
    check_graph(graph)
    assert (graph.dialect, graph.entry, graph.exit) == (1, ("TaStart_0",), {})
    assert (graph.nodes["TaStart_0"].kept, graph.nodes["TaFetch_1"].kept) == (True, False)


def test_one_action_needs_no_entry_and_no_exit() -> None:
    graph = read_graph({"graph_name": "one", "actions": [{"name": "TaOne", "type": "sync"}]})
    check_graph(graph)
    assert (graph.entry, list(graph.exit)) == (("TaOne_0",), ["TaOne_0"])


def put(*path: Any, value: Any) -> Callable[[Table], None]:
    """Set what is at a path of a document."""

    def change(document: Table) -> None:
        place: Any = document
        for step in path[:-1]:
            place = place[step]
        if value is ...:
            del place[path[-1]]
        else:
            place[path[-1]] = value

    return change


LOOK, TELL = ("actions", 0), ("actions", 1)
CYCLE = [{"name": "TaTell", "instance_id": 2}]
WRONG: list[tuple[Callable[[Table], None], str, str]] = [
    (put("actions", value=[]), "actions", "at least one action, got none"),
    (put("actions", value=...), "actions", "a list, got none"),
    (put("actions", value={}), "actions", "a list, got {} (dict)"),
    (put("actions", 0, value=7), "actions[0]", "an object, got 7 (int)"),
    (put(*LOOK, "name", value=...), "actions[0].name", "a text, got none"),
    (put(*LOOK, "name", value=""), "actions[0].name", "the name of an action, got '' (str)"),
    (put(*LOOK, "type", value="async"), "actions[0].type", "one of sync, spontaneous, got 'async' (str)"),
    (put(*TELL, "instance_id", value="2"), "actions[1].instance_id", "a whole number, got '2' (str)"),
    (put(*TELL, "instance_id", value=True), "actions[1].instance_id", "a whole number, got True (bool)"),
    (put(*TELL, "parents", 0, "required", value=1), "actions[1].parents[0].required", "true or false, got 1 (int)"),
    (
        put(*TELL, "parents", 0, "conditions", value=["on_maybe -> run"]),
        "actions[1].parents[0].conditions[0]",
        "on_maybe",
    ),
    (put(*TELL, "parents", 0, "conditions", value=["on_true -> walk"]), "actions[1].parents[0].conditions[0]", "walk"),
    (put(*TELL, "parents", 0, "conditions", value=["on_true"]), "actions[1].parents[0].conditions[0]", "got 'on_true'"),
    (
        put(*TELL, "parents", 0, "conditions", value=["on_true -> stop", "on_true -> run"]),
        "actions[1].parents[0].conditions[1]",
        "one response to on_true: stop, got",
    ),
    (
        put(*TELL, "input_parameters", "words", "pvf_allowed_values", value=["yes", 0]),
        "actions[1].input_parameters.words.pvf_allowed_values",
        "values that are each a string, got 0",
    ),
    (put(*TELL, "parents", value=[]), "actions[0].children[0]", "TaLook_0 among the parents of TaTell_2, got none"),
    (put(*LOOK, "children", value=[]), "actions[1].parents[0]", "TaTell_2 among the children of TaLook_0, got none"),
    (
        put(*LOOK, "children", 0, "name", value="TaTold"),
        "actions[0].children[0]",
        "one of TaLook_0, TaTell_2, got 'TaTold_2'",
    ),
    (
        put(*LOOK, "children", 0, "remap", 0, "from", value="sene"),
        "actions[0].children[0].remap[0].from",
        "one of seen, count",
    ),
    (put(*LOOK, "children", 0, "remap", 0, "to", value="wrods"), "actions[0].children[0].remap[0].to", "one of words"),
    (
        put(*LOOK, "children", 0, "remap", 0, "from", value="count"),
        "actions[0].children[0].remap[0]",
        "a string, as words",
    ),
    (
        put(*LOOK, "children", 0, "remap", value=...),
        "actions[1].input_parameters.words",
        "an output of TaLook_0 for it, got none",
    ),
    (put(*LOOK, "output_parameters", "seen", value=5), "actions[0].output_parameters.seen", "an object, got 5"),
    (
        put(*LOOK, "output_parameters", "seen", value={}),
        "actions[0].output_parameters.seen.pvf_type",
        "a text, got none",
    ),
    (
        put(*LOOK, "input_parameters", "where", "x", "pvf_value", value="far"),
        "actions[0].input_parameters.where.x.pvf_value",
        "a number, got 'far'",
    ),
    (
        put(*TELL, "input_parameters", "words", "pvf_value", value="or"),
        "actions[1].input_parameters.words.pvf_value",
        "yes, no",
    ),
    (put("graph_entry", 0, "name", value="TaSee"), "graph_entry[0]", "one of TaLook_0, TaTell_2, got 'TaSee_0'"),
    (put("graph_exit", 0, "instance_id", value=3), "graph_exit[0]", "one of TaLook_0, TaTell_2, got 'TaTell_3'"),
    (put("graph_exit", value=[]), "graph_exit", "an action without children, or a graph_exit, got none"),
]


@pytest.mark.parametrize(("change", "path", "said"), WRONG, ids=[row[1] + ":" + row[2][:12] for row in WRONG])
def test_each_fault_is_named_with_its_place(
    change: Callable[[Table], None], path: str, said: str, tmp_path: Path
) -> None:
    document = copy.deepcopy(NEWER)
    change(document)
    file = tmp_path / "wrong.json"
    file.write_text(json.dumps(document))
    with pytest.raises(GraphError) as raised:
        check_graph(read_graph_file(file))
    error = raised.value
    assert (error.file, error.path) == (str(file), path)
    assert said in str(error)
    assert isinstance(error, (UsageError, LoadFailed))


MISSPELT: list[tuple[tuple[Any, ...], str, str]] = [
    ((), "graph_exits", "graph_exit"),
    (LOOK, "acter", "actor"),
    (LOOK, "childs", "children"),
    (LOOK, "input_paramters", "input_parameters"),
    (LOOK, "instanceid", "instance_id"),
    (LOOK, "typ", "type"),
    ((*LOOK, "children", 0), "instance", "instance_id"),
    ((*LOOK, "output_parameters", "seen"), "pvf_valu", "pvf_value"),
    ((*TELL, "parents", 0), "conditons", "conditions"),
    ((*TELL, "parents", 0), "requird", "required"),
    (("graph_entry", 0), "nam", "name"),
]


@pytest.mark.parametrize(("path", "key", "known"), MISSPELT, ids=[row[1] for row in MISSPELT])
def test_a_misspelt_key_is_refused_and_a_foreign_one_is_kept(path: tuple[Any, ...], key: str, known: str) -> None:
    document = copy.deepcopy(NEWER)
    put(*path, "x_of_a_tool", value=1)(document)
    assert read_graph(document).document == document
    put(*path, key, value=False)(document)
    with pytest.raises(GraphError, match=f"an unknown key; did you mean '{known}'") as raised:
        read_graph(document)
    assert raised.value.got == key
    assert raised.value.path.endswith(key)


@pytest.mark.parametrize("type_name", ["strng", "String", "nubmer", "numbrs", "boll"])
def test_a_misspelt_type_is_refused_and_a_foreign_one_is_kept(type_name: str) -> None:
    document = copy.deepcopy(NEWER)
    put(*LOOK, "output_parameters", "count", "pvf_type", value="pose")(document)
    check_graph(read_graph(document))
    put(*LOOK, "output_parameters", "count", "pvf_type", value=type_name)(document)
    with pytest.raises(
        GraphError, match=r"output_parameters\.count\.pvf_type: .*; did you mean '(string|numbers?|bool)'"
    ):
        read_graph(document)


def test_a_key_twice_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "twice.json"
    file.write_text('{"actions": [{"name": "A", "name": "B"}]}')
    with pytest.raises(GraphError, match=r"name: expected a key that its object has once, got it twice"):
        read_graph_file(file)


REQUIRED_PARENTS: list[tuple[Table, str, str]] = [
    ({"A": "", "Z": "", "C": "A Z"}, "A", "actions[2].parents[1]"),  # nothing leads to Z
    ({"A": "", "B": "A C", "C": "B", "D": "A"}, "", "actions[1].parents[1]"),  # B and C wait for each other
    ({"A": "", "B": "A", "C": "B"}, "", ""),
]


@pytest.mark.parametrize(("parents", "entry", "path"), REQUIRED_PARENTS)
def test_a_required_parent_that_can_never_end_is_refused(parents: Table, entry: str, path: str) -> None:
    names = {name: text.split() for name, text in parents.items()}
    children = {name: [other for other, above in names.items() if name in above] for name in names}
    actions = [
        {
            "name": name,
            "parents": [{"name": one} for one in above],
            "children": [{"name": one} for one in children[name]],
        }
        for name, above in names.items()
    ]
    document = {"actions": actions, "graph_entry": [{"name": one} for one in entry], "graph_exit": [{"name": "C"}]}
    graph = read_graph({**document, **({} if entry else {"graph_entry": [{"name": "A"}]})})
    if not path:
        check_graph(graph)
        return
    said = r"a required parent that can end as ._0 waits for it, got ._0, which never does"
    with pytest.raises(GraphError, match=said) as raised:
        check_graph(graph)
    assert raised.value.path == path


def test_a_required_exit_that_can_never_end_is_refused() -> None:
    actions = [{"name": "A"}, {"name": "B"}]
    entry, exit = [{"name": "A"}], [{"name": "A"}, {"name": "B"}]
    with pytest.raises(GraphError, match=r"graph_exit\[1\]: expected a required parent"):
        check_graph(read_graph({"actions": actions, "graph_entry": entry, "graph_exit": exit}))
    check_graph(
        read_graph({"actions": actions, "graph_entry": entry, "graph_exit": [exit[0], {**exit[1], "required": False}]})
    )


def test_a_name_twice_is_refused() -> None:
    document = copy.deepcopy(NEWER)
    document["actions"].append(document["actions"][0])
    with pytest.raises(GraphError, match=r"actions\[2\]: expected a name and number that no other action has"):
        read_graph(document)


def test_a_cycle_needs_a_way_out() -> None:
    step = {"children": [{"name": "B"}], "parents": [{"name": "B", "required": False}]}
    back = {"children": [{"name": "A"}], "parents": [{"name": "A"}]}
    actions = [{"name": "A", **step}, {"name": "B", **back}, {"name": "C"}]
    entry, exit = [{"name": "A"}], [{"name": "C"}]
    with pytest.raises(GraphError, match="graph_exit: expected a way from A_0 to C_0"):
        check_graph(read_graph({"actions": actions, "graph_entry": entry, "graph_exit": exit}))
    with pytest.raises(GraphError, match=r"actions\[0\].children: expected a way out of the cycle to C_0, got 'A_0'"):
        check_graph(read_graph({"actions": actions, "graph_entry": [*entry, *exit], "graph_exit": exit}))
    check_graph(read_graph({"actions": actions[:2], "graph_entry": entry, "graph_exit": [{"name": "B"}]}))


@pytest.mark.parametrize("data", [b"", b"{", b"[1]", b"7", b"\xff\xfe", b'{"actions": ' + b"[" * 5000, b"null"])
def test_what_is_no_json_object_is_refused(data: bytes, tmp_path: Path) -> None:
    file = tmp_path / "graph.json"
    file.write_bytes(data)
    with pytest.raises(GraphError, match="expected a JSON object, got") as raised:
        read_graph_file(file)
    assert (raised.value.file, raised.value.path, raised.value.expected) == (str(file), "", "a JSON object")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=r"none\.json: expected a file that can be read, got No such file"):
        read_graph_file(tmp_path / "none.json")


def test_the_actions_that_there_are_complete_the_graph() -> None:
    document: Table = {
        "graph_entry": [{"name": "A"}],
        "actions": [{"name": "A", "children": [{"name": "B"}]}, {"name": "B", "parents": [{"name": "A"}]}],
    }
    number = Parameter("number")
    known = {"A": Signature({"x": number}, {"y": number}), "B": Signature({"y": number})}
    graph = completed(read_graph(document), known)
    assert signature_of(graph) == Signature({"x": number}, {})
    with pytest.raises(GraphError, match=r"actions\[1\].name: expected an action or a graph: one of A, got 'B'"):
        completed(read_graph(document), {"A": known["A"]})
    with pytest.raises(GraphError, match=r"actions\[1\].input_parameters.y: expected a value, or an output of A_0"):
        completed(read_graph(document), {**known, "A": Signature()})
    document["actions"][1]["input_parameters"] = {"y": TEXT}
    with pytest.raises(GraphError, match=r"actions\[1\].input_parameters.y.pvf_type: expected number, got 'string'"):
        completed(read_graph(document), known)


TYPES = [
    ("string", "a", True), ("string", 1, False), ("number", 1.5, True), ("number", True, False), ("bool", True, True),
    ("bool", 1, False), ("strings", ["a"], True), ("strings", ["a", 1], False), ("numbers", 1, False),
    ("sensor_msgs::Image", object(), True),
]  # fmt: skip


@pytest.mark.parametrize(("type_name", "value", "fits"), TYPES)
def test_a_value_is_of_its_type(type_name: str, value: object, fits: bool) -> None:
    assert is_of_type(value, type_name) is fits


KEYS = st.text("abc", min_size=1, max_size=3)
LEAVES = st.none() | st.integers() | st.lists(st.integers(), max_size=2)


@given(st.dictionaries(KEYS, st.recursive(LEAVES, lambda inner: st.dictionaries(KEYS, inner, min_size=1, max_size=3))))
def test_flat_names_are_nested_again(values: Table) -> None:
    assert nested(flat(values)) == values


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@given(st.data())
def test_a_document_with_anything_anywhere_is_read_or_refused_by_name(data: st.DataObject) -> None:
    document = copy.deepcopy(data.draw(st.sampled_from([NEWER, OLDER])))
    place: Any = document
    while True:
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
        if not place[key] or not isinstance(place[key], (dict, list)) or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = data.draw(JSON)
    with contextlib.suppress(GraphError):
        check_graph(read_graph(document))
