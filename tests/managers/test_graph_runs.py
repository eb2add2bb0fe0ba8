"""What happens next in a graph: the rules of both dialects, as tables, and against a small model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.base.errors import GraphError
from rr_actors.managers.actions.graph_checks import check_graph
from rr_actors.managers.actions.graph_documents import read_graph
from rr_actors.managers.actions.graph_model import RESPONSES, RESULTS, ActionGraph
from rr_actors.managers.actions.graph_runs import (
    LIVE,
    MOST_ATTEMPTS,
    OVER,
    Begin,
    Change,
    GraphRun,
    Halt,
    NodeEffect,
    NodeEnded,
    Pause,
    Restored,
    Resume,
    decide,
    first_run,
)

Edge = tuple[str, str] | tuple[str, str, str] | tuple[str, str, str, bool]


def graph_of(
    edges: Sequence[Edge], exits: Sequence[str] = (), entry: Sequence[str] = (), **actions: dict[str, Any]
) -> ActionGraph:
    """A graph of these edges: (parent, child, "on_true -> run, on_false -> stop", whether it is required)."""
    names = list(dict.fromkeys([*entry, *(name for edge in edges for name in edge[:2]), *exits]))
    tables: dict[str, dict[str, Any]] = {
        name: {"name": name, "children": [], "parents": [], **actions.get(name, {})} for name in names
    }
    for edge in edges:
        conditions = edge[2] if len(edge) > 2 else ""
        required = edge[3] if len(edge) > 3 else True
        listed = [one for one in conditions.split(", ") if one]
        tables[edge[0]]["children"].append({"name": edge[1]})
        tables[edge[1]]["parents"].append({"name": edge[0], "conditions": listed, "required": required})
    document = {
        "actions": list(tables.values()),
        "graph_exit": [{"name": name} for name in exits or names[-1:]],
        "graph_entry": [{"name": name} for name in entry],
    }
    return read_graph(document)


class Player:
    """Plays a graph, with the ends of actions as they are told."""

    def __init__(self, graph: ActionGraph, **inputs: Any) -> None:
        self.graph, self.run, self.said = graph, first_run(graph), list[NodeEffect]()
        self.tell(Begin(inputs))

    def tell(self, event: Any) -> list[str]:
        self.run, effects = decide(self.graph, self.run, event)
        if isinstance(event, Change):
            self.graph = event.graph
        self.said += effects
        return [f"{effect.do} {effect.node.removesuffix('_0')}" for effect in effects]

    def ends(self, node: str, result: str = "on_true", **outputs: Any) -> list[str]:
        name = f"{node}_0"
        return self.tell(NodeEnded(name, self.run.node(name).number, result, outputs, "it broke"))

    def state(self, node: str) -> str:
        return self.run.nodes[f"{node}_0"].state


def test_a_sequence_runs_one_after_another_and_ends_with_its_exit() -> None:
    player = Player(graph_of([("a", "b"), ("b", "c")]))
    assert player.said == [NodeEffect("run", "a_0")]
    assert player.ends("a") == ["run b"]
    assert player.ends("b") == ["run c"]
    assert player.run.state == "RUNNING"
    assert player.ends("c", given=1) == []
    assert (player.run.state, player.run.result, player.run.outputs) == ("FINISHED", "on_true", {"given": 1})


def test_a_join_waits_for_all_required_parents_and_any_of_for_one() -> None:
    join = Player(graph_of([("a", "b"), ("a", "c"), ("b", "d"), ("c", "d")]))
    assert join.ends("a") == ["run b", "run c"]
    assert join.ends("c") == []
    assert join.ends("b") == ["run d"]

    any_of = Player(graph_of([("a", "b"), ("a", "c"), ("b", "d", "", False), ("c", "d", "", False)]))
    any_of.ends("a")
    assert any_of.ends("c") == ["run d"]
    assert any_of.ends("b") == []  # it runs already
    any_of.ends("d")
    assert any_of.run.state == "FINISHED"


def test_a_join_in_a_cycle_joins_in_each_round() -> None:
    edges: list[Edge] = [("s", "a", "", False), ("a", "b"), ("a", "c"), ("b", "d"), ("c", "d"), ("d", "a", "", False)]
    graph = graph_of([*edges, ("d", "e", "on_true -> ignore, on_false -> run")], exits=["e"])
    player = Player(graph)
    player.ends("s")
    for _ in range(3):
        assert player.ends("a") == ["run b", "run c"]
        assert player.ends("b") == []
        assert player.ends("c") == ["run d"]
        assert player.ends("d") == ["run a"]
    assert [player.run.nodes[f"{name}_0"].number for name in "abcd"] == [4, 3, 3, 3]


RESPONSE_TABLE = [
    # how b is when a ends, the response to that, what is to be done, the state of b
    ("UNINITIALIZED", "run", ["run b"], "RUNNING"),
    ("UNINITIALIZED", "restart", ["run b"], "RUNNING"),
    ("UNINITIALIZED", "stop", [], "UNINITIALIZED"),
    ("UNINITIALIZED", "pause", [], "UNINITIALIZED"),
    ("UNINITIALIZED", "ignore", [], "UNINITIALIZED"),
    ("UNINITIALIZED", "bypass", ["run z"], "BYPASSED"),
    ("RUNNING", "run", [], "RUNNING"),
    ("RUNNING", "restart", ["stop b"], "STOPPING"),
    ("RUNNING", "stop", ["stop b"], "STOPPING"),
    ("RUNNING", "pause", ["pause b"], "PAUSED"),
    ("RUNNING", "ignore", [], "RUNNING"),
    ("RUNNING", "bypass", [], "RUNNING"),
    ("PAUSED", "run", ["resume b"], "RUNNING"),
    ("PAUSED", "stop", ["stop b"], "STOPPING"),
]


@pytest.mark.parametrize(("before", "response", "done", "after"), RESPONSE_TABLE)
def test_each_response_does_what_it_says(before: str, response: str, done: list[str], after: str) -> None:
    edges: list[Edge] = [("a", "b", f"on_true -> {response}", False), ("p", "b", "on_true -> pause", False), ("b", "z")]
    entry = ["a", "p", "k"] + ["b"] * (before != "UNINITIALIZED")
    player = Player(graph_of(edges, exits=["z"], entry=entry))
    if before == "PAUSED":
        player.ends("p")
    assert player.ends("a") == done
    assert player.state("b") == after


def test_an_action_that_is_restarted_runs_again_when_it_has_stopped() -> None:
    player = Player(graph_of([("a", "b", "on_true -> restart", False), ("b", "z")], entry=["a", "b"]))
    player.ends("a")
    assert player.ends("b", "on_false") == ["run b"]
    assert player.ends("b") == ["run z"]


def test_what_is_stopped_ends_with_on_stopped_whatever_it_returns() -> None:
    edges: list[Edge] = [("a", "b", "on_true -> stop", False), ("b", "z", "on_true -> ignore, on_stopped -> run")]
    player = Player(graph_of(edges, entry=["a", "b"]))
    player.ends("a")
    assert player.ends("b") == ["run z"]


def test_an_error_is_passed_on_to_the_exit_and_ends_the_graph_with_it() -> None:
    player = Player(graph_of([("a", "b"), ("b", "c")]))
    assert player.ends("a", "on_error") == []
    assert (player.run.state, player.run.result, player.run.why) == ("ERROR", "on_error", "it broke")
    assert (player.state("b"), player.state("c")) == ("BYPASSED", "BYPASSED")


def test_the_branch_that_the_result_names_runs() -> None:
    edges: list[Edge] = [
        ("a", "t", "on_true -> run, on_false -> ignore"),
        ("a", "f", "on_true -> ignore, on_false -> run"),
    ]
    edges += [("t", "z", "", False), ("f", "z", "", False)]
    for result, branch in (("on_true", "t"), ("on_false", "f")):
        player = Player(graph_of(edges))
        assert player.ends("a", result) == [f"run {branch}"]
        assert player.ends(branch) == ["run z"]
        player.ends("z", result)
        assert (player.run.state, player.run.result) == ("FINISHED", result)


def test_a_graph_in_which_nothing_can_run_is_halted_and_can_be_resumed_at_an_action() -> None:
    player = Player(graph_of([("a", "b", "on_true -> ignore")]))
    player.ends("a")
    assert (player.run.state, player.run.result) == ("HALTED", "on_halted")
    with pytest.raises(GraphError, match="start: expected one of a_0, b_0, got 'c_0'"):
        player.tell(Resume("c_0"))
    assert player.tell(Resume("b_0")) == ["run b"]
    player.ends("b")
    assert player.run.state == "FINISHED"


def test_the_end_of_the_graph_stops_what_still_runs() -> None:
    player = Player(graph_of([("a", "c"), ("b", "d")], exits=["c"]))
    player.ends("a")
    assert player.ends("c") == ["stop b"]
    assert (player.run.state, player.run.result) == ("STOPPING", "on_true")
    player.ends("b")
    assert player.run.state == "FINISHED"


def test_a_graph_that_is_stopped_ends_when_nothing_runs() -> None:
    player = Player(graph_of([("a", "b")]))
    assert player.tell(Halt()) == ["stop a"]
    assert player.tell(Halt()) == []
    player.ends("a")
    assert (player.run.state, player.run.result) == ("STOPPED", "on_stopped")


def test_a_paused_graph_begins_nothing_until_it_is_resumed() -> None:
    player = Player(graph_of([("a", "c"), ("b", "d"), ("c", "e"), ("d", "e")]))
    assert player.tell(Pause()) == ["pause a", "pause b"]
    assert player.ends("a") == []
    assert (player.run.state, player.state("c")) == ("PAUSED", "INITIALIZED")
    assert sorted(player.tell(Resume())) == ["resume b", "run c"]


def test_a_spontaneous_action_runs_again_and_starts_its_children_afresh() -> None:
    player = Player(graph_of([("a", "b"), ("b", "c")], a={"type": "spontaneous"}))
    assert player.ends("a") == ["run b", "run a"]
    assert player.ends("b") == ["run c"]
    assert player.ends("a") == ["stop c", "run b", "run a"]
    assert player.ends("a") == ["stop b", "run a"]
    assert player.ends("c") == []
    assert player.ends("b") == ["run b"]
    assert player.ends("b") == ["run c"]
    assert player.ends("c") == ["stop a"]
    player.ends("a")
    assert player.run.state == "FINISHED"


STATES = {
    name: {"input_parameters": {"state": {"pvf_type": "string", "pvf_allowed_values": name}}} for name in ("go", "rest")
}


def test_the_child_that_accepts_the_value_runs_and_a_graph_without_an_exit_ends_when_none_does() -> None:
    """A state machine of dialect 1."""

    def action(name: str, parents: list[str], children: list[str], required: bool = True) -> dict[str, Any]:
        listed = [{"name": parent, "id": 0, "required": required} for parent in parents]
        told = [{"name": child, "id": 0} for child in children]
        return {
            "name": name,
            "id": 0,
            "effect": "synchronous",
            "parents": listed,
            "children": told,
            **STATES.get(name, {}),
        }

    choose = action("choose", ["begin", "go", "rest"], ["go", "rest"], False)
    choose |= {"effect": "asynchronous", "output_parameters": {"state": {"pvf_type": "string"}}}
    actions = [
        action("begin", [], ["choose"]),
        choose,
        action("go", ["choose"], ["choose"]),
        action("rest", ["choose"], ["choose"]),
    ]
    graph = read_graph({"graph_name": "states", "umrf_actions": actions})
    check_graph(graph)
    player = Player(graph)
    assert player.ends("begin") == ["run choose"]
    for state in ("go", "rest", "rest", "go"):
        assert player.ends("choose", state=state) == [f"run {state}"]
        assert player.ends(state) == ["run choose"]
    player.ends("choose", state="done")
    assert (player.run.state, player.run.result) == ("FINISHED", "on_true")


def test_outputs_go_to_children_by_their_names_there() -> None:
    text, fixed = {"pvf_type": "string"}, {"pvf_type": "string", "pvf_value": "mine", "pvf_updatable": False}
    graph = graph_of(
        [("a", "b")], a={"output_parameters": {"x": text, "y": text}}, b={"input_parameters": {"to": text, "y": fixed}}
    )
    children = {"b_0": {"x": "to"}}
    graph = msgspec.structs.replace(
        graph, nodes={**graph.nodes, "a_0": msgspec.structs.replace(graph.nodes["a_0"], children=children)}
    )
    player = Player(graph)
    player.ends("a", x="given", y="theirs")
    assert player.run.nodes["b_0"].inputs == {"to": "given", "y": "mine"}


def test_a_crash_makes_what_ran_run_again_but_not_for_ever() -> None:
    player = Player(graph_of([("a", "b", "on_error -> run")]))
    for attempt in range(2, MOST_ATTEMPTS + 1):
        assert player.tell(Restored(("a_0",))) == ["run a"]
        assert player.run.nodes["a_0"].attempt == attempt
    assert player.tell(Restored(("a_0",))) == ["run b"]
    assert "interrupted a_0 in 3 attempts" in player.run.nodes["a_0"].why


def test_an_end_is_heard_once() -> None:
    player = Player(graph_of([("a", "b")]))
    end = NodeEnded("a_0", 1, "on_true")
    assert player.tell(end) == ["run b"]
    assert player.tell(end) == []
    assert player.tell(NodeEnded("b_0", 7, "on_true")) == []


# -- another graph -------------------------------------------------------------------------------------------------

VALUE = {"input_parameters": {"x": {"pvf_type": "string", "pvf_value": "new"}}}
FROM_PARENT = {"input_parameters": {"x": {"pvf_type": "string"}}}


def test_what_runs_goes_on_and_its_end_means_what_the_new_graph_says() -> None:
    player = Player(graph_of([("a", "b"), ("b", "c")]))
    assert player.tell(Change(graph_of([("a", "d"), ("d", "e")]))) == []
    assert player.ends("a") == ["run d"]
    assert player.ends("d") == ["run e"]
    assert sorted(player.run.nodes) == ["a_0", "d_0", "e_0"]


def test_what_runs_and_is_gone_is_stopped_before_another_begins() -> None:
    player = Player(graph_of([("a", "c"), ("b", "c")]))
    assert player.tell(Change(graph_of([("a", "d"), ("d", "e")]), "d_0")) == ["stop b"]
    assert (player.state("d"), list(player.run.leaving)) == ("INITIALIZED", ["b_0"])
    assert player.ends("b") == ["run d"]
    assert player.run.leaving == {}
    assert player.run.state == "RUNNING"


def test_what_runs_otherwise_than_the_new_graph_says_begins_again_with_what_it_was_given() -> None:
    text = {"output_parameters": {"x": {"pvf_type": "string"}}}
    edges: list[Edge] = [("a", "b"), ("b", "c")]
    player = Player(
        graph_of(
            edges,
            a=text,
            b={"input_parameters": {**FROM_PARENT["input_parameters"], "y": VALUE["input_parameters"]["x"]}},
        )
    )
    player.ends("a", x="given")
    first = player.run.nodes["b_0"]
    assert first.inputs == {"x": "given", "y": "new"}
    newer = {"x": {"pvf_type": "string"}, "y": {"pvf_type": "string", "pvf_value": "newer"}}
    assert player.tell(Change(graph_of(edges, a=text, b={"input_parameters": newer}))) == ["stop b"]
    assert player.ends("b", "on_error") == ["run b"]
    assert player.run.nodes["b_0"].inputs == {"x": "given", "y": "newer"}
    assert player.run.nodes["b_0"].number > first.number
    assert player.tell(NodeEnded("b_0", first.number, "on_true")) == []
    assert player.ends("b") == ["run c"]


def test_with_a_start_what_ran_otherwise_is_only_stopped() -> None:
    edges: list[Edge] = [("a", "c"), ("b", "c")]
    player = Player(graph_of(edges))
    assert player.tell(Change(graph_of(edges, b=VALUE), "c_0")) == ["stop b"]
    assert player.ends("b") == ["run c"]
    assert player.state("b") == "UNINITIALIZED"


def test_a_join_whose_last_parent_is_taken_away_runs_and_an_exit_ends_the_graph() -> None:
    player = Player(graph_of([("a", "d"), ("b", "d"), ("d", "e")]))
    player.ends("a")
    assert player.tell(Change(graph_of([("a", "d"), ("d", "e")]))) == ["stop b"]
    assert player.ends("b") == ["run d"]

    player = Player(graph_of([("a", "c"), ("b", "d")], exits=["a", "b"]))
    player.ends("a")
    assert player.tell(Change(graph_of([("b", "c")], exits=["a"], entry=["a", "b"]))) == ["stop b", "stop c"]


def test_a_new_child_of_an_action_that_has_ended_runs_as_its_relation_says() -> None:
    before = graph_of([("a", "b"), ("b", "d")])
    for conditions, begins in (("", ["run c"]), ("on_true -> ignore, on_false -> run", [])):
        player = Player(before)
        player.ends("a")
        after: list[Edge] = [("a", "b"), ("b", "d"), ("a", "c", conditions), ("c", "d", "", bool(begins))]
        assert player.tell(Change(graph_of(after, exits=["d"]))) == begins
        assert player.ends("b") == ([] if begins else ["run d"])
    player = Player(before)
    player.ends("a", "on_false")
    assert player.tell(Change(graph_of([*after[:2], ("a", "c", "on_true -> ignore, on_false -> run"), after[3]]))) == [
        "run c"
    ]


def test_a_graph_whose_new_exit_has_ended_is_finished_as_that_ended() -> None:
    for result in ("on_true", "on_false"):
        player = Player(graph_of([("a", "b"), ("b", "c")]))
        player.ends("a")
        player.ends("b", result)
        assert player.tell(Change(graph_of([("a", "b")]))) == ["stop c"]
        player.ends("c", "on_stopped")
        assert (player.run.state, player.run.result) == ("FINISHED", result)


def test_a_halted_graph_says_what_it_waits_for() -> None:
    player = Player(graph_of([("a", "c"), ("b", "c", "on_true -> stop")], entry=["a", "b"]))
    player.ends("a")
    player.ends("b")
    assert (player.run.state, player.run.why) == ("HALTED", "nothing runs: c_0 waits for b_0")


def test_another_graph_altogether_begins_with_its_entries() -> None:
    player = Player(graph_of([("a", "b")]))
    assert player.tell(Change(graph_of([("c", "d"), ("e", "d")]))) == ["stop a"]
    assert sorted(player.ends("a")) == ["run c", "run e"]


def test_an_action_that_is_stopping_runs_again_when_a_change_starts_it() -> None:
    player = Player(graph_of([("a", "b", "on_true -> stop", False), ("b", "z")], entry=["a", "b"]))
    assert player.ends("a") == ["stop b"]
    assert player.tell(Change(player.graph, "b_0")) == []
    assert player.ends("b") == ["run b"]


def test_a_halted_graph_goes_on_where_it_is_told() -> None:
    player = Player(graph_of([("a", "b", "on_true -> ignore")]))
    player.ends("a")
    graph = graph_of([("a", "b", "on_true -> ignore"), ("b", "c")])
    assert player.tell(Change(graph)) == []
    assert player.run.state == "HALTED"
    assert player.tell(Change(graph, "b_0")) == ["run b"]
    assert (player.run.state, player.run.result) == ("RUNNING", "")
    assert player.tell(Change(graph, "b_0")) == []  # it runs


def test_a_paused_graph_stays_paused_and_begins_when_it_is_resumed() -> None:
    player = Player(graph_of([("a", "c"), ("b", "c")]))
    player.tell(Pause())
    assert player.tell(Change(graph_of([("a", "d")]), "d_0")) == ["stop b"]
    assert player.ends("b") == []
    assert player.tell(Resume()) == ["resume a", "run d"]


def test_a_graph_that_is_stopped_while_it_changes_begins_nothing() -> None:
    player = Player(graph_of([("a", "b")]))
    player.tell(Change(graph_of([("c", "d")])))
    assert player.tell(Halt()) == []
    assert player.run.state == "STOPPING"
    assert player.ends("a") == []
    assert player.run.state == "STOPPED"


def test_a_crash_in_the_middle_of_a_change_ends_what_was_to_be_stopped() -> None:
    player = Player(graph_of([("a", "b")]))
    player.tell(Change(graph_of([("c", "d")])))
    assert player.tell(Restored(("a_0",))) == ["run c"]


def test_a_run_of_an_action_that_comes_back_is_never_taken_for_an_earlier_one() -> None:
    graphs = [graph_of([("a", "b")]), graph_of([("a", "b")], a=VALUE)]
    player = Player(graphs[0])
    numbers = [player.run.nodes["a_0"].number]
    for i in range(6):
        player.tell(Change(graphs[(i + 1) % 2]))
        player.tell(Change(graphs[i % 2]))
        player.tell(Change(graph_of([("x", "y")])))
        player.tell(Change(graphs[(i + 1) % 2]))
        assert player.ends("a") == ["run a"]
        numbers.append(player.run.nodes["a_0"].number)
    assert numbers == sorted(set(numbers))


REFUSED: list[tuple[ActionGraph, str, str, str]] = [
    (graph_of([("a", "b")]), "c_0", "start", "one of a_0, b_0, got 'c_0'"),
    (graph_of([("a", "b")], b=FROM_PARENT), "b_0", "actions[1].input_parameters.x", "a value, got none"),
    (graph_of([("c", "d")], c=FROM_PARENT), "", "actions[0].input_parameters.x", "a value, got none"),
]


@pytest.mark.parametrize(("graph", "start", "path", "said"), REFUSED)
def test_a_change_that_cannot_begin_is_refused(graph: ActionGraph, start: str, path: str, said: str) -> None:
    player = Player(graph_of([("a", "b")]))
    with pytest.raises(GraphError) as raised:
        player.tell(Change(graph, start))
    assert raised.value.path == path
    assert said in str(raised.value)


def test_a_run_that_ends_or_has_ended_is_not_changed() -> None:
    player = Player(graph_of([("a", "b")]))
    player.tell(Halt())
    with pytest.raises(GraphError, match="graph_state: expected one of RUNNING, PAUSED, HALTED, got 'STOPPING'"):
        player.tell(Change(graph_of([("a", "b")])))
    player.ends("a")
    with pytest.raises(GraphError, match="got 'STOPPED'"):
        player.tell(Change(graph_of([("a", "b")])))


# -- against a small model -----------------------------------------------------------------------------------------

NODES = "abcdefg"


@st.composite
def acyclic(draw: st.DrawFn) -> list[Edge]:
    """Edges from earlier to later actions; each but the first has a parent, and each response runs or ignores."""
    edges: list[Edge] = []
    for i in range(1, draw(st.integers(1, len(NODES) - 1)) + 1):
        for parent in draw(st.sets(st.sampled_from(NODES[:i]), min_size=1)):
            words = [f"{result} -> {draw(st.sampled_from(['run', 'ignore']))}" for result in RESULTS]
            edges.append((parent, NODES[i], ", ".join(words)))
    return edges


@settings(deadline=None)
@given(acyclic(), st.data())
def test_in_whatever_order_actions_end_those_run_that_the_model_says(edges: list[Edge], data: st.DataObject) -> None:
    results = {name: data.draw(st.sampled_from(["on_true", "on_false", "on_error"])) for name in NODES}
    graph = graph_of(edges, exits=[edges[-1][1]], entry=["a"])

    def runs(name: str) -> bool:
        parents = [edge for edge in edges if edge[1] == name]
        wanted = [f"{results[edge[0]]} -> run" in str(edge[2:]) for edge in parents]
        return not parents or (all(runs(edge[0]) for edge in parents) and any(wanted))

    player = Player(graph)
    while live := [name for name, node in player.run.nodes.items() if node.state in LIVE]:
        name = data.draw(st.sampled_from(live))
        player.ends(name[:-2], results[name[0]])
    ran = {name[0] for name, node in player.run.nodes.items() if node.number}
    exit = edges[-1][1]
    if not runs(exit) or results[exit] == "on_error":
        assert player.run.state in ("HALTED", "ERROR")
    if not runs(exit):
        assert ran == {name for name in player.run.nodes for name in name[0] if runs(name)}
    else:
        assert ran <= {name for name in NODES if runs(name)}
        assert exit in ran
    assert all(node.number <= 1 for node in player.run.nodes.values())


@st.composite
def any_graph(draw: st.DrawFn) -> ActionGraph:
    """Any edges, also in cycles, and any conditions."""
    count = draw(st.integers(1, 5))
    pairs = draw(
        st.lists(st.tuples(st.sampled_from(NODES[:count]), st.sampled_from(NODES[:count])), unique=True, max_size=9)
    )
    edges: list[Edge] = []
    for parent, child in pairs:
        words = [f"{result} -> {draw(st.sampled_from(RESPONSES))}" for result in RESULTS]
        edges.append((parent, child, ", ".join(words), draw(st.booleans())))
    kinds = {name: {"type": draw(st.sampled_from(["sync", "spontaneous"]))} for name in NODES[:count]}
    return graph_of(edges, exits=[NODES[count - 1]], entry=["a"], **kinds)


@settings(deadline=None)
@given(any_graph(), st.data())
def test_whatever_happens_the_run_is_one_that_can_be(graph: ActionGraph, data: st.DataObject) -> None:
    player = Player(graph)
    for _ in range(data.draw(st.integers(0, 25))):
        before = player.run
        name = data.draw(st.sampled_from(sorted(graph.nodes)))
        result = data.draw(st.sampled_from(["on_true", "on_false", "on_error"]))
        live = tuple(one for one, node in before.nodes.items() if node.state in LIVE)
        end = NodeEnded(name, before.nodes[name].number, result)
        player.said.clear()
        player.tell(data.draw(st.sampled_from([end, end, end, Pause(), Resume(), Halt(), Restored(live), Begin()])))
        check(before, player.run, player.said)


def check(before: GraphRun, after: GraphRun, effects: list[NodeEffect]) -> None:
    live = {name for name, node in after.nodes.items() if node.state in LIVE}
    if after.state in OVER:
        assert live == set()
    if after.state == "RUNNING":
        assert live
    if before.state in ("FINISHED", "STOPPED", "ERROR"):
        assert after == before  # what is over stays so
    for name in {effect.node for effect in effects if effect.do == "run"}:
        old, new = before.nodes[name], after.nodes[name]
        assert new.state in LIVE
        assert new.number == old.number + 1 or (new.number == old.number and new.attempt == old.attempt + 1)
    began = {name for name in after.nodes if after.nodes[name].number > before.nodes[name].number}
    assert began == {effect.node for effect in effects if effect.do == "run"} - {
        name for name in after.nodes if after.nodes[name].attempt > before.nodes[name].attempt
    }
    assert (after.steps > before.steps) == (after != before)


def related(draw: st.DrawFn, count: int) -> ActionGraph:
    """A graph without cycles in which some actions are as they always are, and others are not."""
    names = draw(st.lists(st.sampled_from(NODES), min_size=1, max_size=count, unique=True))
    edges: list[Edge] = []
    for i, name in enumerate(names[1:], 1):
        for parent in draw(st.sets(st.sampled_from(names[:i]), min_size=1)):
            words = [f"{result} -> {draw(st.sampled_from(RESPONSES))}" for result in RESULTS]
            edges.append((parent, name, ", ".join(words), draw(st.booleans())))
    return graph_of(edges, exits=names[-1:], entry=names[:1], **{name: VALUE for name in names if draw(st.booleans())})


@settings(deadline=None)
@given(st.data())
def test_whenever_a_graph_is_changed_what_runs_is_in_it_and_what_has_ended_runs_again_only_if_it_is_started(
    data: st.DataObject,
) -> None:
    draw: Any = data.draw
    player = Player(related(draw, 5))
    ended: dict[str, int] = {}  # the number of the run whose end was told last
    for _ in range(draw(st.integers(1, 25))):
        before, graph = player.run, player.graph
        live = [name for name in [*before.nodes, *before.leaving] if before.node(name).state in LIVE]
        events: list[Any] = [Pause(), Resume(), Restored(tuple(live)), *[Change(related(draw, 5))] * 3]
        if before.state not in OVER and live:
            name = draw(st.sampled_from(live))
            events += [NodeEnded(name, before.node(name).number, draw(st.sampled_from(RESULTS)))] * 5
        event = draw(st.sampled_from(events))
        if isinstance(event, Change) and draw(st.booleans()):
            event = Change(event.graph, draw(st.sampled_from(sorted(event.graph.nodes))))
        player.said.clear()
        try:
            player.tell(event)
        except GraphError:
            assert isinstance(event, Change)
            assert before.state in (*OVER, "STOPPING")
            continue
        after, runs = player.run, [effect.node for effect in player.said if effect.do == "run"]
        assert list(after.nodes) == list(player.graph.nodes)
        assert all(node.state == "STOPPING" for node in after.leaving.values())
        assert not any(after.nodes[name].state in LIVE for name in after.leaving if name in after.nodes)
        if after.leaving:  # nothing begins beside what is to end
            assert all(after.node(name).attempt > 1 for name in runs)
        if isinstance(event, NodeEnded):
            ended[event.node] = event.number
        for name in runs:
            assert after.nodes[name].state in LIVE
            assert after.nodes[name].number > ended.get(name, 0)
        if isinstance(event, Change):
            stay = event.graph.unchanged(graph)
            kept = {name for name in stay if before.nodes[name].state in LIVE and name not in before.leaving}
            if not after.ending:
                assert all(after.nodes[name].state == before.nodes[name].state for name in kept)
            for name in stay - kept:
                has_ended = before.nodes[name].state in ("FINISHED", "ERROR")
                again = after.nodes[name].state in ("RUNNING", "INITIALIZED")
                if has_ended and again and name != event.start:
                    assert name in newly_ready(graph, event.graph, before, after)
    player.tell(Halt())
    while live := [name for name in [*player.run.nodes, *player.run.leaving] if player.run.node(name).state in LIVE]:
        player.ends(live[0].removesuffix("_0"))
    assert player.run.state in OVER


def newly_ready(old: ActionGraph, new: ActionGraph, before: GraphRun, after: GraphRun) -> set[str]:
    """The actions which the relations of a new graph, and not those of the old one, let run."""

    def waits(graph: ActionGraph, name: str) -> set[str]:
        required = {parent for parent, one in graph.parents_of(name).items() if one.required}
        return required - before.nodes[name].heard.keys()

    return {name for name in new.nodes.keys() & old.nodes.keys() if waits(old, name) and not waits(new, name)}
