"""Graph documents: make an ActionGraph of a JSON object in either published dialect of UMRF.

Dialect 1 has `umrf_actions`, each with an `id`, an `effect` and `package_name`. Dialect 2 has `actions`, each with an
`instance_id` and a `type`, and says in `graph_entry` and `graph_exit` where the graph begins and ends. Other keys
stay in the document.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec

from rr_actors.base.errors import did_you_mean
from rr_actors.base.folder import read_plain
from rr_actors.managers.actions.graph_model import (
    DEFAULT_CONDITIONS,
    RESPONSES,
    RESULTS,
    SEPARATOR,
    ActionGraph,
    ActionNode,
    Parameter,
    ParentRelation,
    is_of_type,
    likely_type,
    wrong_graph,
)
from rr_actors.managers.actions.graph_runs import GraphRun, NodeRun

KEY = "rr_run"  # what the dialects have no key for

_KEYS = {
    "graph": ("graph_name", "graph_description", "graph_entry", "graph_exit", "graph_state", "actions", "umrf_actions"),
    "action": (
        *("name", "id", "instance_id", "type", "effect", "actor", "parents", "children", "input_parameters"),
        *("output_parameters", "execute_first", "package_name", "description", "library_path", "notation", "state"),
        *("stop_when_received", "suffix"),
    ),
    "relation": ("name", "id", "instance_id", "conditions", "required", "remap"),
    "parameter": (
        "pvf_type",
        "pvf_value",
        "value",
        "pvf_allowed_values",
        "pvf_required",
        "pvf_updatable",
        "pvf_example",
    ),
}
"""The keys of both dialects, also those that mean nothing here. Others are kept, unless they look like one of these."""

T = TypeVar("T")
Table = dict[str, Any]

_KEPT = {"synchronous": False, "asynchronous": True}
_SPONTANEOUS = {"sync": False, "spontaneous": True}
_NAMES: dict[type, str] = {
    str: "a text",
    int: "a whole number",
    bool: "true or false",
    dict: "an object",
    list: "a list",
}
_ABSENT = object()


def read_graph_file(path: str | os.PathLike[str]) -> ActionGraph:
    """Read the graph in a JSON file.

    Raises:
        GraphError: the file cannot be read, is not JSON, or is no graph.
    """
    file = os.fspath(path)
    return parse_graph(read_graph_bytes(file), file)


def read_graph_bytes(file: str) -> bytes:
    """Return the contents of a file with a graph; raise GraphError if it cannot be read."""
    try:
        return read_plain(file)
    except (OSError, ValueError) as error:  # ValueError: no file has such a name
        said = getattr(error, "strerror", None) or str(error)
        raise wrong_graph(file, "", "a file that can be read", said, said) from error


def parse_graph(data: bytes, file: str) -> ActionGraph:
    """Return the graph in the contents of a JSON file.

    Raises:
        GraphError: they are not JSON, or no graph.
    """
    try:
        document = msgspec.json.decode(data)
        json.loads(data, object_pairs_hook=lambda pairs: _check_once(pairs, file))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise wrong_graph(file, "", "a JSON object", str(error), f"no JSON: {error}") from error
    return read_graph(document, file)


def read_graph(document: object, file: str = "") -> ActionGraph:
    """Read a graph that is a JSON object already; `file` is named in errors.

    Raises:
        GraphError: it is no graph.
    """
    reader = _Reader(file)
    table = reader.as_table(document, "")
    reader.check_keys(table, "graph", "")
    dialect = 1 if "umrf_actions" in table else 2
    key = "umrf_actions" if dialect == 1 else "actions"
    actions = reader.list_at(table, key, "", required=True)
    if not actions:
        raise wrong_graph(file, key, "at least one action", actions, "none")
    number = "id" if dialect == 1 else "instance_id"
    tables = [reader.as_table(action, f"{key}[{i}]") for i, action in enumerate(actions)]
    nodes: dict[str, ActionNode] = {}
    firsts: list[str] = []
    for i, action in enumerate(tables):
        node = reader.node(action, f"{key}[{i}]", number, dialect)
        if node.name in nodes:
            raise wrong_graph(file, node.place, "a name and number that no other action has", node.name)
        nodes[node.name] = node
        if reader.get(action, "execute_first", bool, node.place, False):
            firsts.append(node.name)
    entry = reader.ends(table, "graph_entry", number) if dialect == 2 else dict.fromkeys(firsts, ParentRelation())
    exit = reader.ends(table, "graph_exit", number) if dialect == 2 else {}
    if not entry:
        entry = {name: ParentRelation() for name, node in nodes.items() if not node.parents or len(nodes) == 1}
    if not exit and dialect == 2 and "graph_exit" not in table:
        exit = {name: ParentRelation() for name, node in nodes.items() if not node.children or len(nodes) == 1}
    name = reader.get(table, "graph_name", str, "", "") or Path(file).name.partition(".")[0] or "graph"
    return ActionGraph(name, file, dialect, nodes, tuple(entry), exit, table)


def _check_once(pairs: list[tuple[str, object]], file: str) -> None:
    """Refuse an object that has a key twice: JSON readers take the last of them, and lose the others."""
    keys: set[str] = set()
    for key, _ in pairs:
        if key in keys:
            raise wrong_graph(file, key, "a key that its object has once", key, "it twice")
        keys.add(key)


def _kind_of(kind: str) -> str:
    """Return a kind of object with its article."""
    return f"{'an' if kind[0] == 'a' else 'a'} {kind}"


class _Reader:
    """Reads the parts of one document; each error has the place."""

    def __init__(self, file: str) -> None:
        self.file = file

    def checked(self, value: object, kind: type[T], path: str) -> T:
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise wrong_graph(self.file, path, "a JSON object" if not path else _NAMES[kind], value)
        return value

    def as_table(self, value: object, path: str) -> Table:
        return cast("Table", self.checked(value, dict, path))

    def table_at(self, table: Table, key: str, path: str) -> Table:
        return cast("Table", self.get(table, key, dict, path))

    def list_at(self, table: Table, key: str, path: str, *, required: bool = False) -> list[object]:
        return cast("list[object]", self.get(table, key, list, path, required=required))

    def check_keys(self, table: Table, kind: str, path: str) -> None:
        """Refuse a key that looks like a known one, and is none."""
        for key in table:
            known = _KEYS[kind]
            if key not in known and (hint := did_you_mean(key, known)):
                place = f"{path}.{key}".lstrip(".")
                raise wrong_graph(self.file, place, f"a key of {_kind_of(kind)}", key, f"an unknown key{hint}")

    def get(
        self, table: Table, key: str, kind: type[T], path: str, default: T | None = None, *, required: bool = False
    ) -> T:
        """Return the value of a key, or the default, or else an empty value of its kind."""
        value: object = table.get(key, _ABSENT)
        place = f"{path}.{key}".lstrip(".")
        if value is _ABSENT:
            if required:
                raise wrong_graph(self.file, place, _NAMES[kind], None)
            return kind() if default is None else default
        return self.checked(value, kind, place)

    def word(self, table: Table, key: str, path: str, words: dict[str, bool]) -> bool:
        """Return what one of several words means; the first of them is the default."""
        value = self.get(table, key, str, path, next(iter(words)))
        if value not in words:
            raise wrong_graph(self.file, f"{path}.{key}", f"one of {', '.join(words)}", value)
        return words[value]

    def node(self, table: Table, path: str, number: str, dialect: int) -> ActionNode:
        self.check_keys(table, "action", path)
        name = self.full_name(table, path, number)
        outputs = self.parameters(self.table_at(table, "output_parameters", path), f"{path}.output_parameters")
        parents = {
            self.related(parent, place, number): self.relation(parent, place)
            for place, parent in self.tables(table, "parents", path)
        }
        children = {
            self.related(child, place, number): self.remap(child, place)
            for place, child in self.tables(table, "children", path)
        }
        return ActionNode(
            name=name,
            action=self.get(table, "name", str, path),
            place=path,
            spontaneous=dialect == 2 and self.word(table, "type", path, _SPONTANEOUS),
            kept=dialect == 1 and self.word(table, "effect", path, _KEPT),
            actor=self.get(table, "actor", str, path),
            inputs=self.parameters(self.table_at(table, "input_parameters", path), f"{path}.input_parameters"),
            outputs=outputs,
            parents=parents,
            children=children,
        )

    def related(self, table: Table, path: str, number: str) -> str:
        self.check_keys(table, "relation", path)
        return self.full_name(table, path, number)

    def full_name(self, table: Table, path: str, number: str) -> str:
        name = self.get(table, "name", str, path, required=True)
        if not name:
            raise wrong_graph(self.file, f"{path}.name", "the name of an action", name)
        return f"{name}_{self.get(table, number, int, path, 0)}"

    def tables(self, table: Table, key: str, path: str) -> list[tuple[str, Table]]:
        """Return the tables of a list, each with its place."""
        place = f"{path}.{key}".lstrip(".")
        found = enumerate(self.list_at(table, key, path))
        return [(f"{place}[{i}]", self.as_table(one, f"{place}[{i}]")) for i, one in found]

    def ends(self, table: Table, key: str, number: str) -> dict[str, ParentRelation]:
        return {
            self.related(one, place, number): self.relation(one, place) for place, one in self.tables(table, key, "")
        }

    def relation(self, table: Table, path: str) -> ParentRelation:
        conditions = dict(DEFAULT_CONDITIONS)
        stated: dict[str, str] = {}
        for i, text in enumerate(self.list_at(table, "conditions", path)):
            place = f"{path}.conditions[{i}]"
            result, arrow, response = self.checked(text, str, place).partition("->")
            result, response = result.strip(), response.strip()
            if not arrow or result not in RESULTS or response not in RESPONSES:
                expected = f"one of {', '.join(RESULTS)}, then ->, then one of {', '.join(RESPONSES)}"
                raise wrong_graph(self.file, place, expected, text)
            if stated.setdefault(result, response) != response:
                raise wrong_graph(self.file, place, f"one response to {result}: {stated[result]}", text)
            conditions[result] = response
        return ParentRelation(self.get(table, "required", bool, path, True), conditions)

    def remap(self, table: Table, path: str) -> dict[str, str]:
        """Return the names that the outputs of an action have at a child."""
        names: dict[str, str] = {}
        for place, pair in self.tables(table, "remap", path):
            from_, to = (self.get(pair, key, str, place, required=True) for key in ("from", "to"))
            names[from_] = to
        return names

    def parameters(self, table: Table, path: str, prefix: str = "") -> dict[str, Parameter]:
        """Return the parameters in a table, and in the tables in it, by their flat names."""
        found: dict[str, Parameter] = {}
        for key, value in table.items():
            place = f"{path}.{key}"
            one = self.as_table(value, place)
            if "pvf_type" in one or not one:
                found[prefix + key] = self.parameter(one, place)
            else:
                found |= self.parameters(one, place, prefix + key + SEPARATOR)
        return found

    def parameter(self, table: Table, path: str) -> Parameter:
        self.check_keys(table, "parameter", path)
        type_name = self.get(table, "pvf_type", str, path, required=True)
        if hint := likely_type(type_name):
            raise wrong_graph(self.file, f"{path}.pvf_type", "a type", type_name, f"an unknown one{hint}")
        listed: object = table.get("pvf_allowed_values", ())
        allowed = tuple(cast("list[object]", listed)) if isinstance(listed, (list, tuple)) else (listed,)
        for one in allowed:
            if not is_of_type(one, type_name):
                raise wrong_graph(self.file, f"{path}.pvf_allowed_values", f"values that are each a {type_name}", one)
        value: object = table.get("pvf_value", table.get("value"))
        if value is not None and not is_of_type(value, type_name):
            raise wrong_graph(self.file, f"{path}.pvf_value", f"a {type_name}", value)
        if value is not None and allowed and value not in allowed:
            raise wrong_graph(self.file, f"{path}.pvf_value", f"one of {', '.join(map(str, allowed))}", value)
        return Parameter(
            type_name,
            value,
            value is not None,
            self.get(table, "pvf_required", bool, path, True),
            self.get(table, "pvf_updatable", bool, path, True),
            allowed,
        )


# -- runs --------------------------------------------------------------------------------------------------------------


def feedback(graph: ActionGraph, run: GraphRun) -> dict[str, Any]:
    """Return the JSON object of a graph with `graph_state`, and with the `state` of each action."""
    key = "umrf_actions" if graph.dialect == 1 else "actions"
    names = list(graph.nodes)  # in the order of the document
    tables: list[dict[str, Any]] = graph.document[key]
    actions = [{**table, "state": run.nodes[name].state} for name, table in zip(names, tables, strict=True)]
    return {**graph.document, key: actions, "graph_state": run.state, KEY: _table(run)}


def _table(run: GraphRun) -> dict[str, Any]:
    """Return a run as a table. Inputs and outputs keep their types, as to_builtins() would not have it."""
    nodes = [{name: _without_defaults(node) for name, node in some.items()} for some in (run.nodes, run.leaving)]
    return {**msgspec.structs.asdict(run), "nodes": nodes[0], "leaving": nodes[1]}


def _without_defaults(node: NodeRun) -> dict[str, Any]:
    table = msgspec.structs.asdict(node)
    return {key: value for key, value in table.items() if value != getattr(_FIRST, key)}


_FIRST = NodeRun()


def run_in(response: dict[str, Any]) -> GraphRun:
    """Return the run in a response of `actions/graph`."""
    return msgspec.convert(response[KEY], GraphRun)


def document_in(response: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON object of the graph in a response, without the run."""
    return {key: value for key, value in response.items() if key != KEY}
