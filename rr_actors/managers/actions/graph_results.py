"""Graph results: run a graph to its end from a program, in one call."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any

from rr_actors.managers.actions.action_manager import RunGraph, wait_ended
from rr_actors.managers.actions.graph_documents import read_graph_file
from rr_actors.registrar.registrar import Registrar
from rr_actors.system.console.connection import ConnectedRegistrar


@dataclass(frozen=True)
class GraphResult:
    """How a graph has ended.

    Attributes:
        result: on_true, on_false, on_stopped, on_error; or on_halted, if nothing runs and the exit was not reached.
        outputs: of its exits, by flat names.
        states: of its actions at the end, by their names in the graph.
        error: the trace of the error that on_error comes from; else "".
    """

    result: str
    outputs: dict[str, Any]
    states: dict[str, str]
    error: str = ""


def run_graph(
    app: Registrar | ConnectedRegistrar,
    graph: str | os.PathLike[str] | dict[str, Any],
    *,
    inputs: dict[str, Any] | None = None,
    timeout_s: float | None = None,
    manager: str = "actions",
) -> GraphResult:
    """Run a graph to its end, release it, and return how it has ended.

    Args:
        app: the registrar that holds the graph meanwhile; a connection's (rr.connect) may do so, too.
        graph: the name of a graph in the manager's folder; or a JSON file, by a path, or by a text that ends in
            ".json"; or a JSON object.
        inputs: of the entries, nested or by flat names ("nav_goal::x").
        timeout_s: seconds until the graph is stopped; None: no limit.
        manager: the id of the rr_actors.managers.Actions that runs it.

    Raises:
        GraphError: the graph or an input is wrong, and nothing has run.
        LoadTimeout: it has not ended in time; it is stopped and released.
        RrError: as Registrar.load().
    """
    file = ""
    if isinstance(graph, os.PathLike) or (isinstance(graph, str) and graph.endswith(".json")):
        file = os.fspath(graph)
        graph = read_graph_file(file).document
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    with app.load(f"{manager}/graph", RunGraph(graph, inputs or {}, file=file), timeout_s=timeout_s) as query:
        left_s = None if deadline is None else max(0.0, deadline - time.monotonic())
        run = wait_ended(query, left_s, timeout_s)
    states = {name: node.state for name, node in run.nodes.items()}
    return GraphResult(run.result, run.outputs, states, run.why)
