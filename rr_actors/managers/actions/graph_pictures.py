"""Graph pictures: a graph of actions with their states, as SVG, and a run of one as tools show it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import msgspec

from rr_actors.base.svg_pictures import Box, draw
from rr_actors.managers.actions.graph_documents import KEY, document_in, read_graph, read_graph_file, run_in
from rr_actors.managers.actions.graph_model import ActionGraph

_COLOURS = {
    "RUNNING": "#cfe8ff",
    "PAUSED": "#fff3bf",
    "STOPPING": "#fff3bf",
    "FINISHED": "#d3f9d8",
    "BYPASSED": "#e9ecef",
    "ERROR": "#ffc9c9",
}


def draw_graph(file: str | os.PathLike[str], states: Mapping[str, str]) -> str:
    """Return an SVG document of the graph in a file, with the states of its actions by their names.

    Raises:
        GraphError: the file is no graph.
    """
    return _drawn(read_graph_file(file), states)


def _drawn(graph: ActionGraph, states: Mapping[str, str]) -> str:
    boxes = {
        name: Box([name, states.get(name, "")], _COLOURS.get(states.get(name, ""), "#ffffff"), is_round=True)
        for name in graph.nodes
    }
    return draw(boxes, [(name, child) for name, node in graph.nodes.items() for child in node.children])


class ShownGraph(msgspec.Struct, frozen=True):
    """A run of a graph as tools show it.

    Attributes:
        state: of the graph.
        states: of its actions, by their names.
        notes: of actions: the attempt, if a crash has interrupted one before, or the last line of an error.
        picture: an SVG document.
    """

    state: str
    states: dict[str, str]
    notes: dict[str, str]
    picture: str


def shown_graph(response: str) -> ShownGraph | None:
    """Return the run in a response of `actions/graph`, which is JSON; None if the response is another one.

    Raises:
        GraphError: its graph is wrong.
    """
    try:
        table = msgspec.json.decode(response, type=dict[str, Any])
    except msgspec.MsgspecError:
        return None
    if KEY not in table:
        return None
    run, graph = run_in(table), read_graph(document_in(table))
    states = {name: run.nodes[name].state for name in graph.nodes}
    notes = {name: node.why.strip().rpartition("\n")[2] for name, node in run.nodes.items() if node.why}
    notes |= {name: f"attempt {node.attempt}" for name, node in run.nodes.items() if node.attempt > 1}
    return ShownGraph(run.state, states, notes, _drawn(graph, states))
