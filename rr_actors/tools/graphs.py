"""Graphs of a running system, its tree and its resources with their holders: SVG, PNG, Mermaid and Graphviz."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal

from rr_actors.base.svg_pictures import Box, draw
from rr_actors.registrar.pages import ResourceRow
from rr_actors.supervision.core.rendering import Tree, dot_text, mermaid_text, svg_boxes, tree_edges
from rr_actors.system.console.console_messages import ChildRow

Part = Literal["tree", "dependencies", "both"]
_HOLDER = "holder "  # no id of a resource begins so


def mermaid(children: list[ChildRow], resources: list[ResourceRow], part: Part) -> str:
    """Return a Mermaid graph; GitHub shows it in a fenced block "mermaid"."""
    tree = [] if part == "dependencies" else Tree(_nested(children)).mermaid().splitlines()[1:]
    depend = [] if part == "tree" else _mermaid_dependencies(resources)
    return "\n".join(["graph TD", *tree, *depend])


def dot(children: list[ChildRow], resources: list[ResourceRow], part: Part) -> str:
    """Return a graph for Graphviz: `dot -Tsvg`."""
    tree = [] if part == "dependencies" else Tree(_nested(children)).dot().splitlines()[2:-1]
    depend = [] if part == "tree" else _dot_dependencies(resources)
    return "\n".join(["digraph system {", "    node [shape=box]", *tree, *depend, "}"])


def svg(children: list[ChildRow], resources: list[ResourceRow], part: Part) -> str:
    """Return an SVG document."""
    boxes: dict[str, Box] = {}
    edges: list[tuple[str, str]] = []
    if part != "dependencies":
        root = _nested(children)
        boxes |= svg_boxes(root)
        edges += tree_edges(root)
    if part != "tree":
        held = edges_of(resources, _HOLDER)
        boxes |= {holder: Box([name], "#eeeeff", True) for holder, name in _holders(held)}
        boxes |= {one.id: Box(_resource_lines(one), _COLOURS.get(one.state, "#ffffff")) for one in resources}
        edges += held
    return draw(boxes, edges)


def _resource_lines(resource: ResourceRow) -> list[str]:
    return [resource.server, resource.request, f"{resource.condition} {resource.message}".strip()]


_COLOURS = {"WARNING": "#fff2cc", "ERROR": "#ffd9b3", "FATAL": "#ffbbbb"}


def _nested(rows: list[ChildRow]) -> dict[str, Any]:
    """Return the tree of these rows as rendering.py takes it. Each supervisor comes before its children."""
    nodes: dict[str, dict[str, Any]] = {}
    for row in rows:
        node: dict[str, Any] = {"id": row.id, "path": row.path, "type": row.type}
        node |= {"what": row.strategy, "state": row.state, "pid": row.pid, "restarts": row.restarts, "children": []}
        nodes[row.path] = node
        above = nodes.get(row.path.rpartition("/")[0])
        if above is not None:
            above["children"].append(node)
    return nodes[rows[0].path]


def edges_of(resources: Collection[ResourceRow], mark: str) -> list[tuple[str, str]]:
    """Return pairs of a holder and the id of the resource that it holds.

    A holder is the id of a resource, or `mark` and the name of a registrar that holds for itself. A row lists its first
    holders only: others of them list the resource as their part.
    """
    known = {resource.id for resource in resources}
    found: dict[tuple[str, str], None] = {}
    for resource in resources:
        found.update(dict.fromkeys((resource.id, part) for part in resource.part_resources if part in known))
        for holder in resource.holders:
            above = holder.parent if holder.parent in known else mark + holder.origin
            found[above, resource.id] = None
    return list(found)


def _holders(edges: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the holders among these edges that are registrars, each once, with their names."""
    marked = dict.fromkeys(above for above, _ in edges if above.startswith(_HOLDER))
    return [(holder, holder.removeprefix(_HOLDER)) for holder in marked]


def _by_registrar(resources: list[ResourceRow]) -> list[tuple[str, list[ResourceRow]]]:
    """Return the registrars in the order of their names, each with its resources."""
    found: dict[str, list[ResourceRow]] = {}
    for resource in resources:
        found.setdefault(resource.server.partition("/")[0], []).append(resource)
    return sorted(found.items())


def _label(resource: ResourceRow) -> str:
    return resource.name + ("" if resource.condition == "OK" else f" [{resource.condition}]")


def _mermaid_dependencies(resources: list[ResourceRow]) -> list[str]:
    names = {resource.id: f"r{number}" for number, resource in enumerate(resources)}
    lines: list[str] = []
    for number, (registrar, mine) in enumerate(_by_registrar(resources)):
        lines.append(f"    subgraph g{number}[{mermaid_text(registrar)}]")
        lines += [f"        {names[resource.id]}[{mermaid_text(_label(resource))}]" for resource in mine]
        lines.append("    end")
    edges = edges_of(resources, _HOLDER)
    for number, (holder, name) in enumerate(_holders(edges)):
        names[holder] = f"h{number}"
        lines.append(f"    h{number}([{mermaid_text(name)}])")
    return [*lines, *(f"    {names[above]} --> {names[below]}" for above, below in edges)]


def _dot_dependencies(resources: list[ResourceRow]) -> list[str]:
    lines: list[str] = []
    for registrar, mine in _by_registrar(resources):
        lines.append(f"    subgraph {dot_text(f'cluster_{registrar}')} {{ label={dot_text(registrar)}")
        lines += [f"        {dot_text(resource.id)} [label={dot_text(_label(resource))}]" for resource in mine]
        lines.append("    }")
    edges = edges_of(resources, _HOLDER)
    lines += [f"    {dot_text(holder)} [label={dot_text(name)}, shape=ellipse]" for holder, name in _holders(edges)]
    return [*lines, *(f"    {dot_text(above)} -> {dot_text(below)}" for above, below in edges)]
