"""Graph checks: what of a graph cannot work, before anything of it runs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import msgspec

from rr_actors.managers.actions.graph_model import (
    EXIT,
    RESULTS,
    ActionGraph,
    ActionNode,
    Parameter,
    ParentRelation,
    accepts,
    known_types,
    wrong_graph,
)


class Signature(msgspec.Struct, frozen=True):
    """The parameters that the class of an action, or a sub-graph, has."""

    inputs: dict[str, Parameter] = {}
    outputs: dict[str, Parameter] = {}


def check_graph(graph: ActionGraph) -> None:
    """Check a graph that has the parameters of its actions.

    Raises:
        GraphError: a remap is between types that do not fit; nobody gives a required input; as check_shape().
    """
    check_shape(graph)
    for node in graph.nodes.values():
        _check_remaps(graph, node)
        _check_inputs(graph, node)


def check_shape(graph: ActionGraph) -> None:
    """Check what can be known without the actions.

    Raises:
        GraphError: a relation is stated on one side only, or leads to an action that is not there; no way leads to the
            exit, or out of a cycle.
    """
    for node in graph.nodes.values():
        _check_relations(graph, node)
    for key, names in (("graph_entry", graph.entry), ("graph_exit", tuple(graph.exit))):
        for i, name in enumerate(names):
            if name not in graph.nodes:
                raise wrong_graph(graph.file, f"{key}[{i}]", f"one of {', '.join(graph.nodes)}", name)
    _check_ways(graph)


def _check_relations(graph: ActionGraph, node: ActionNode) -> None:
    for side, other, names in (("parents", "children", node.parents), ("children", "parents", node.children)):
        for i, name in enumerate(names):
            place = f"{node.place}.{side}[{i}]"
            if name not in graph.nodes:
                raise wrong_graph(graph.file, place, f"one of {', '.join(graph.nodes)}", name)
            there: Mapping[str, object] = getattr(graph.nodes[name], other)
            if node.name not in there:
                expected = f"{node.name} among the {other} of {name}"
                raise wrong_graph(graph.file, place, expected, list(there), ", ".join(there) or "none")


def _check_ways(graph: ActionGraph) -> None:
    """Check that there is a beginning, and a way out of each cycle of a graph that has an exit."""
    if not graph.entry:
        raise wrong_graph(graph.file, "graph_entry", "an action without parents, or a graph_entry", None)
    _check_required(graph)
    if graph.dialect == 1:
        return  # it ends when nothing runs
    if not graph.exit:
        raise wrong_graph(graph.file, "graph_exit", "an action without children, or a graph_exit", None)
    reached = set(graph.entry).union(*(graph.below(name) for name in graph.entry))
    if reached.isdisjoint(graph.exit):
        expected = f"a way from {', '.join(graph.entry)} to {', '.join(graph.exit)}"
        raise wrong_graph(graph.file, "graph_exit", expected, None)
    for name in graph.nodes:
        below = graph.below(name)
        if name in below and below.isdisjoint(graph.exit):
            expected = f"a way out of the cycle to {', '.join(graph.exit)}"
            raise wrong_graph(graph.file, f"{graph.nodes[name].place}.children", expected, name)


def _check_required(graph: ActionGraph) -> None:
    """Check that each required parent of what the graph leads to can come to an end that is waited for."""
    told = _results(graph)
    for name in (*graph.nodes, EXIT):
        relations = graph.parents_of(name)
        if name in graph.entry or not any(told[parent] for parent in relations):
            continue
        for i, (parent, relation) in enumerate(relations.items()):
            if relation.required and not _heard(relation, told[parent]):
                place = f"graph_exit[{i}]" if name == EXIT else f"{graph.nodes[name].place}.parents[{i}]"
                expected = f"a required parent that can end as {name} waits for it"
                raise wrong_graph(graph.file, place, expected, parent, f"{parent}, which never does")


def _results(graph: ActionGraph) -> dict[str, set[str]]:
    """Return the results that each action can tell its children: its own, and those of parents that bypass it."""
    told: dict[str, set[str]] = {name: set() for name in graph.nodes}
    left = list(graph.nodes)
    while left:
        name = left.pop()
        parents = graph.nodes[name].parents
        can: set[str] = {*RESULTS} if _can_run(graph, name, told) else set()
        for parent, relation in parents.items():
            can |= {result for result in told[parent] if relation.conditions[result] == "bypass"}
        if can != told[name]:
            told[name] = can
            left += graph.nodes[name].children
    return told


def _can_run(graph: ActionGraph, name: str, told: dict[str, set[str]]) -> bool:
    parents = graph.nodes[name].parents
    required = {parent: one for parent, one in parents.items() if one.required}
    waits_for = required or parents
    return name in graph.entry or (
        all(_heard(one, told[parent]) for parent, one in required.items())
        and any(
            one.conditions[result] in ("run", "restart") for parent, one in waits_for.items() for result in told[parent]
        )
    )


def _heard(relation: ParentRelation, results: set[str]) -> bool:
    """Return whether one of these results counts as the end of a required parent."""
    return any(relation.conditions[result] in ("run", "restart", "ignore") for result in results)


def _check_remaps(graph: ActionGraph, node: ActionNode) -> None:
    for i, (name, names) in enumerate(node.children.items()):
        child = graph.nodes[name]
        for j, (from_, to) in enumerate(names.items()):
            place = f"{node.place}.children[{i}].remap[{j}]"
            if from_ not in node.outputs:
                raise wrong_graph(graph.file, f"{place}.from", f"an output: {_words(node.outputs)}", from_)
            if to not in child.inputs:
                raise wrong_graph(graph.file, f"{place}.to", f"an input of {name}: {_words(child.inputs)}", to)
            given, taken = node.outputs.get(from_), child.inputs.get(to)
            if given is not None and taken is not None and not fits(given.type, taken.type):
                raise wrong_graph(graph.file, place, f"a {taken.type}, as {to} of {name} is", given.type)


def fits(given: str, taken: str) -> bool:
    """Return whether a value of one type may be one of the other. Unknown types fit all."""
    return given == taken or not (known_types(given) and known_types(taken))


def offered(parent: ActionNode, child: str) -> dict[str, str]:
    """Return the names that the declared outputs of a parent have at a child, by their names at the parent."""
    return {name: parent.children[child].get(name, name) for name in parent.outputs}


def _check_inputs(graph: ActionGraph, node: ActionNode) -> None:
    """Check that a value or a parent gives each required input. Those of entries may come with the run."""
    if node.name in graph.entry:
        return
    given = {to for name in node.parents for to in offered(graph.nodes[name], node.name).values()}
    for name, parameter in node.inputs.items():
        if parameter.required and not parameter.has_value and name not in given:
            expected = f"a value, or an output of {', '.join(node.parents) or 'a parent'} for it"
            raise wrong_graph(graph.file, f"{node.place}.input_parameters.{name}", expected, None)


# -- with the actions --------------------------------------------------------------------------------------------------


def completed(graph: ActionGraph, known: Mapping[str, Signature]) -> ActionGraph:
    """Return the graph with the parameters of its actions, and check that it can run with them.

    Args:
        known: the actions and the sub-graphs that there are, by name.

    Raises:
        GraphError: an action is not known, or a parameter has another type than its class says; as check_graph().
    """
    nodes = {name: _completed(graph, node, known) for name, node in graph.nodes.items()}
    graph = msgspec.structs.replace(graph, nodes=nodes)
    check_graph(graph)
    return graph


def _completed(graph: ActionGraph, node: ActionNode, known: Mapping[str, Signature]) -> ActionNode:
    if node.actor:
        return node  # its manager knows
    if node.action not in known:
        expected = f"an action or a graph: {_words(sorted(known))}"
        raise wrong_graph(graph.file, f"{node.place}.name", expected, node.action)
    signature = known[node.action]
    for side, mine, theirs in (("input", node.inputs, signature.inputs), ("output", node.outputs, signature.outputs)):
        for name in mine.keys() & theirs.keys():
            if not fits(mine[name].type, theirs[name].type):
                place = f"{node.place}.{side}_parameters.{name}.pvf_type"
                raise wrong_graph(graph.file, place, theirs[name].type, mine[name].type)
    return msgspec.structs.replace(
        node, inputs={**signature.inputs, **node.inputs}, outputs={**signature.outputs, **node.outputs}
    )


def missing_inputs(graph: ActionGraph, given: Collection[str] = ()) -> dict[str, Parameter]:
    """Return the required inputs of the entries that the graph has no value for, by name."""
    inputs = [item for entry in graph.entry for item in graph.nodes[entry].inputs.items()]
    return {name: one for name, one in inputs if one.required and not one.has_value and name not in given}


def checked_inputs(graph: ActionGraph, inputs: dict[str, Any]) -> dict[str, Any]:
    """Return the inputs of a run by flat names.

    Raises:
        GraphError: an entry has no such input, or does not accept the value; or a required input has none.
    """
    known = {name: one for entry in graph.entry for name, one in graph.nodes[entry].inputs.items()}
    for name, value in inputs.items():
        if name not in known:
            raise wrong_graph(graph.file, f"inputs.{name}", f"an input: one of {', '.join(known) or 'none'}", name)
        if not accepts(known[name], value):
            allowed = known[name].allowed
            expected = f"one of {', '.join(map(str, allowed))}" if allowed else f"a {known[name].type}"
            raise wrong_graph(graph.file, f"inputs.{name}", expected, value)
    for name, parameter in missing_inputs(graph, inputs).items():
        raise wrong_graph(graph.file, f"inputs.{name}", f"a {parameter.type}", None)
    return inputs


def signature_of(graph: ActionGraph) -> Signature:
    """Return the parameters of a graph as an action: what its entries lack, and what its exits give."""
    outputs = {name: one for exit in graph.exit for name, one in graph.nodes[exit].outputs.items()}
    return Signature(missing_inputs(graph), outputs)


def _words(names: Collection[str]) -> str:
    return f"one of {', '.join(names) or 'none'}"
