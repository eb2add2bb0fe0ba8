"""What `rr-actors graph check`, `show`, `run` and `change` do with a graph of actions: a JSON file, or one by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import typer

from rr_actors.base.errors import UnknownQuery, UsageError, shown
from rr_actors.base.values.canonical import encode
from rr_actors.managers.actions.graph_checks import check_shape
from rr_actors.managers.actions.graph_documents import read_graph_file
from rr_actors.managers.actions.graph_model import ActionGraph
from rr_actors.managers.actions.graph_pictures import draw_graph
from rr_actors.managers.actions.graph_results import run_graph
from rr_actors.supervision.core.rendering import mermaid_text
from rr_actors.system.console.connection import connect
from rr_actors.system.console.console_commands import AskActor
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_questions import Find
from rr_actors.tools.cli_commands import say, say_json, say_picture, say_table

_HOLDER = "graph"
_ANSWER_S = 60.0


def check(file: Path) -> None:
    """Say that a graph has no fault which the file alone shows.

    Raises:
        GraphError: it has one. `.file`, `.path`, `.expected`, `.got`
    """
    graph = read_graph_file(file)
    check_shape(graph)
    ends = ", ".join(graph.exit) or "the last actions"
    say(f"{file}: {graph.name}: {len(graph.nodes)} actions, from {', '.join(graph.entry)} to {ends}; no fault found")


def show(file: Path, format: str) -> None:
    """Draw a graph: as SVG or PNG, or as text for Mermaid.

    Raises:
        GraphError: the file is no graph.
        UsageError: there is no such format for it.
    """
    if format == "dot":
        raise UsageError("graph show: --format: expected mermaid, svg or png, got dot")
    drawn = draw_graph(file, {}) if format in ("svg", "png") else "\n".join(_mermaid(read_graph_file(file)))
    say_picture(drawn, format)


def _mermaid(graph: ActionGraph) -> Iterator[str]:
    ids = {name: f"a{number}" for number, name in enumerate(graph.nodes)}
    yield "graph TD"
    for name, id in ids.items():
        yield f"    {id}({mermaid_text(name)})"
    for name, node in graph.nodes.items():
        yield from (f"    {ids[name]} --> {ids[child]}" for child in node.children)


def run(file: Path, state: Path | None, inputs: str, timeout_s: float) -> None:
    """Have the child `actions` of a running system run a graph to its end, and say how it has ended.

    `file`: a JSON file, or the name of a graph of the manager's folder. The exit code is 1 if the result is not
    on_true.

    Raises:
        GraphError: the graph or an input is wrong, and nothing has run.
        LoadTimeout: it has not ended in time; it is stopped and released.
        UsageError: `inputs` is no JSON object.
        RrError: no system runs, or it has no such child.
    """
    try:
        given = msgspec.json.decode(inputs.encode(), type=dict[str, object])
    except (msgspec.MsgspecError, UnicodeEncodeError) as error:
        raise UsageError(f"--inputs: expected a JSON object, got {shown(inputs)}: {error}") from error
    with connect(state) as connection:
        ended = run_graph(connection.open_registrar(_HOLDER), _named(file) or file, inputs=given, timeout_s=timeout_s)
    say_table(("action", "state"), list(ended.states.items()), gives_way=("action",))
    say_json({"result": ended.result, "outputs": ended.outputs, "error": ended.error})
    if ended.result != "on_true":
        raise typer.Exit(1)


def _named(file: Path) -> str:
    """Return the name of a graph of the manager's folder, if this is none of a file."""
    return "" if file.suffix == ".json" or file.exists() or len(file.parts) > 1 else str(file)


def change(file: Path, id: str, state: Path | None, start: str) -> None:
    """Put the graph in a file in the place of one that runs, as Actions.change_graph().

    Args:
        id: of the resource of the graph that runs, or the beginning or end of it.
        start: the action that runs then; "": what is ready.

    Raises:
        GraphError: the graph or `start` is wrong, or the graph that is to be changed has ended: nothing has changed.
        UnknownQuery: no resource has this id. UsageError: several have.
        RrError: no system runs.
    """
    name = _named(file)
    graph = None if name else read_graph_file(file)
    with ConsoleConnection(find_console(state), timeout_s=_ANSWER_S + 10) as connection:
        found = [row for row in connection.ask(Find(id)).resources if row.server.endswith("/graph")]
        if len(found) > 1:
            raise UsageError(f"{shown(id)}: {len(found)} graphs have this in their ids; give more of the id")
        if not found:
            raise UnknownQuery(f"{shown(id)}: no graph that runs has this id", query_id=id)
        new = name if graph is None else graph.document
        message = {"change_graph": found[0].id, "new": new, "start": start, "file": "" if name else str(file)}
        manager = found[0].server.partition("/")[0]
        connection.ask(AskActor(manager, encode(message, f"message to {manager}"), _ANSWER_S))
    say(f"{found[0].id}: goes on as {name if graph is None else graph.name}")
