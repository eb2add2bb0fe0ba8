"""Rendering: a supervisor tree as text, as a Mermaid graph and in DOT. It works on plain data.

A node, of a running tree or of a specification, is a dict with "id", "path", "type" ("supervisor" or "worker") and, for
a supervisor, "children". Its other entries ("strategy", "state", "pid", "restarts", "what" ...) are shown, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, cast

from rr_actors.base.errors import UsageError, counted, shown
from rr_actors.base.notebook import bundle
from rr_actors.base.svg_pictures import Box, draw
from rr_actors.supervision.core.specs import ChildSpec, Supervisor, as_child_spec

Node = Mapping[str, Any]
Format = Literal["text", "mermaid", "dot", "svg"]

_SHADES = {"restarting": "#ffdd99", "starting": "#ffffcc", "stopped": "#dddddd", "unavailable": "#ffbbbb"}
_WELL = "#e8f4e8"


class Tree:
    """A picture of a supervisor tree at one moment, or of a specification. str() gives the text.

    Attributes:
        data: the root, as plain data.
    """

    def __init__(self, data: Node) -> None:
        self.data = data

    def render(self) -> str:
        """Return one line for each child: id, type, state, process and number of restarts."""
        rows = [(f"{branches}{node['id']}", *_facts(node)) for node, branches in _walk(self.data)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        used = [(index, width) for index, width in enumerate(widths) if width]
        return "\n".join("  ".join(row[index].ljust(width) for index, width in used).rstrip() for row in rows)

    def mermaid(self) -> str:
        """Return a Mermaid graph, which GitHub shows in a fenced block "mermaid"."""
        lines = ["graph TD"]
        nodes = [node for node, _ in _walk(self.data)]
        numbers = {node["path"]: f"n{number}" for number, node in enumerate(nodes)}
        for node in nodes:
            label = "<br/>".join(_escape_mermaid(line) for line in _label(node))
            left, right = ('(["', '"])') if node["type"] == "supervisor" else ('["', '"]')
            shade = _state(node)
            suffix = f":::{shade}" if shade in _SHADES else ""
            lines.append(f"    {numbers[node['path']]}{left}{label}{right}{suffix}")
        lines += [f"    {numbers[above]} --> {numbers[below]}" for above, below in tree_edges(self.data)]
        states = {_state(node) for node in nodes}
        lines += [f"    classDef {state} fill:{shade}" for state, shade in _SHADES.items() if state in states]
        return "\n".join(lines)

    def dot(self) -> str:
        """Return a graph for Graphviz (`dot -Tsvg`)."""
        lines = [f"digraph {dot_text(self.data['id'])} {{", "    node [shape=box]"]
        for node, _ in _walk(self.data):
            shape = ", shape=ellipse" if node["type"] == "supervisor" else ""
            shade = _SHADES.get(_state(node))
            fill = "" if shade is None else f', style=filled, fillcolor="{shade}"'
            label = "\\n".join(_escape_dot(line) for line in _label(node))
            lines.append(f'    {dot_text(node["path"])} [label="{label}"{shape}{fill}]')
        lines += [f"    {dot_text(above)} -> {dot_text(below)}" for above, below in tree_edges(self.data)]
        return "\n".join([*lines, "}"])

    def svg(self) -> str:
        """Return an SVG document, drawn without other programs. It has the first 500 nodes."""
        return draw(svg_boxes(self.data), list(tree_edges(self.data)))

    def paths(self) -> list[str]:
        """Return the paths of all nodes in the order of their start, each supervisor before its children."""
        return [node["path"] for node, _ in _walk(self.data)]

    def __str__(self) -> str:
        return self.render()

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return bundle(self.render(), svg=self.svg(), mermaid=self.mermaid())

    def __repr__(self) -> str:
        return f"<Tree of {self.data['path']}: {counted(len(self.paths()), 'node')}>"


def render(what: Supervisor | ChildSpec | Tree | Node, format: Format = "text") -> str:
    """Return a picture of a specification, a Tree or snapshot()["tree"].

    Args:
        format: "text", "mermaid", "dot" or "svg".

    Raises:
        UsageError: `what` is no tree, or the format is unknown.
    """
    if isinstance(what, Supervisor | ChildSpec):
        tree = Tree(describe_spec(what))
    elif isinstance(what, Tree):
        tree = what
    elif isinstance(cast(object, what), Mapping) and {"id", "path", "type"} <= set(what):
        tree = Tree(what)
    else:
        raise UsageError(f"render: expected a Supervisor, a Tree or snapshot()['tree'], got {type(what).__name__}")
    match format:
        case "text":
            return tree.render()
        case "mermaid":
            return tree.mermaid()
        case "dot":
            return tree.dot()
        case "svg":
            return tree.svg()
        case _:
            raise UsageError(f"render: format: expected 'text', 'mermaid', 'dot' or 'svg', got {shown(format)}")


def describe_spec(spec: Supervisor | ChildSpec, above: str = "") -> dict[str, Any]:
    """Return a specification as plain data."""
    child = as_child_spec(spec)
    inner = child.actor_class_or_manager
    path = f"{above}/{child.id}" if above else child.id
    node: dict[str, Any] = {"id": child.id, "path": path, "type": child.type}
    if isinstance(inner, Supervisor):
        node |= describe_settings(inner)
        node["children"] = [describe_spec(each, path) for each in inner.children]
        if inner.strategy == "simple_one_for_one":
            node["children"][0]["what"] += ", the template"
    else:
        node["what"] = inner.__name__
    if above:
        node |= {"restart": child.restart, "placement": child.placement}
        node |= {"significant": True} if child.significant else {}
    return node


def describe_settings(spec: Supervisor) -> dict[str, Any]:
    """Return how a supervisor reacts when children end, as plain data."""
    settings: dict[str, Any] = {
        "strategy": spec.strategy,
        "max_restarts": spec.max_restarts,
        "max_seconds": spec.max_seconds,
    }
    settings |= {} if spec.auto_shutdown == "never" else {"auto_shutdown": spec.auto_shutdown}
    return settings | ({} if spec.max_children is None else {"max_children": spec.max_children})


def svg_boxes(root: Node) -> dict[str, Box]:
    """Return the boxes of a tree's nodes, by path. A box shows the state by its colour and in words."""
    return {
        node["path"]: Box(_label(node), _SHADES.get(_state(node), _WELL), node["type"] == "supervisor")
        for node, _ in _walk(root)
    }


# -- one node ----------------------------------------------------------------------------------------------------------


def _facts(node: Node) -> tuple[str, ...]:
    """Return the cells that follow the id in a line."""
    restarts = node.get("restarts", 0)
    return (
        node["type"],
        _settings(node) or node.get("what", ""),
        _state(node),
        "" if node.get("pid") is None else f"pid {node['pid']}",
        counted(restarts, "restart") if restarts else "",
        " ".join(str(node[key]) for key in ("restart", "placement") if key in node),
        "significant" if node.get("significant") else "",
    )


def _label(node: Node) -> list[str]:
    """Return the lines of a node's box in a graph."""
    _, settings, state, process, restarts, spec, significant = _facts(node)
    life = ", ".join(part for part in (state, process, restarts) if part)
    return [line for line in (node["id"], settings, life, spec, significant) if line]


def _state(node: Node) -> str:
    return "unavailable" if "error" in node else node.get("state", "")


def _settings(node: Node) -> str:
    if "strategy" not in node:
        return ""
    auto = f", auto_shutdown {node['auto_shutdown']}" if "auto_shutdown" in node else ""
    most = f", at most {node['max_children']}" if "max_children" in node else ""
    return f"{node['strategy']}, {node['max_restarts']} in {node['max_seconds']:g} s{auto}{most}"


# -- all nodes ---------------------------------------------------------------------------------------------------------


def _walk(root: Node, first: str = "", then: str = "") -> Iterator[tuple[Node, str]]:
    """Yield each node with the branches that are drawn before it."""
    yield root, first
    children = root.get("children", ())
    for number, child in enumerate(children, 1):
        last = number == len(children)
        yield from _walk(child, then + ("└─ " if last else "├─ "), then + ("   " if last else "│  "))


def tree_edges(root: Node) -> Iterator[tuple[str, str]]:
    """Yield an edge from each supervisor to each of its children, as paths."""
    for child in root.get("children", ()):
        yield root["path"], child["path"]
        yield from tree_edges(child)


def _escape_mermaid(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "#quot;").replace("<", "&lt;").replace(">", "&gt;")


def _escape_dot(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def mermaid_text(text: str) -> str:
    """Return a text in the quoted form of a Mermaid label."""
    return f'"{_escape_mermaid(text)}"'


def dot_text(text: str) -> str:
    """Return a text in the quoted form of a Graphviz name or label."""
    return f'"{_escape_dot(text)}"'
