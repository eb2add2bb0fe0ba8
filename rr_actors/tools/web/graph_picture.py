"""The picture of dependencies between resources, or if these are too many between servers: a chart for ECharts.

A server is one node with its resources counted, in the colour of the worst; a server that is opened has nodes for its
first resources, the worst ones first. Registrars are boxes. A holder is left of the resource that it holds, so a status
travels from right to left.
"""

from __future__ import annotations

import html
import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from rr_actors.base.names import named
from rr_actors.registrar.pages import CONDITIONS, ResourceRow
from rr_actors.system.console.console_questions import Find, ListResources
from rr_actors.tools.graphs import edges_of
from rr_actors.tools.web.watch import Moment

Chart = dict[str, Any]
Edge = tuple[str, str]

_STATES = {  # the colour, sign and shape of each state
    "OK": ("#2e7d32", "", "circle"),
    "UPDATE": ("#1565c0", "↻ ", "circle"),
    "WARNING": ("#ef8f00", "! ", "triangle"),
    "ERROR": ("#c62828", "✖ ", "diamond"),
    "FATAL": ("#7f0000", "✖✖ ", "rect"),
    "unload_failed": ("#c62828", "✖ ", "diamond"),
    "revoked": ("#c62828", "✖ ", "diamond"),
}
SERVER = "#"
"""A node of this beginning is a server, "#cameras/camera"."""
_BUSY = ("#78909c", "… ", "emptyCircle")
_STACK = 16  # resources above one another in a box
_TALL = 4  # of them have the height of a server, whose text has a line for each state and stands below it
_LABELS = 60  # up to so many nodes always have labels; of more nodes, a label appears under the mouse
_TEXT = 34
_LABEL_LAYOUT = """() => ({
  hideOverlap: true,
  width: Math.max(24, 0.75 * (document.querySelector(".rr-graph").clientWidth - 16) / %s - 14),
})"""
"""A label ends with dots at the edge of its box: a node of a box's last column is 0.75 columns left of that edge."""
_OPENED = 40  # resources of a server
_NEIGHBOURS = 100
_LOOK_S = 20.0
_Ask = Callable[[Any, float], Any]


def edges_in(moment: Moment) -> list[Edge]:
    """Return pairs of a holder and the resource that it holds: resources as ids, registrars as "@name"."""
    return edges_of(moment.resources, "@")


def around(chosen: str, edges: Iterable[Edge]) -> set[str]:
    """Return a node, all its holders, direct or not, and all its parts; nothing for ""."""
    if not chosen:
        return set()
    edges = list(edges)
    up, down = {chosen}, {chosen}
    while more := {above for above, below in edges if below in up} - up:
        up |= more
    while more := {below for above, below in edges if above in down} - down:
        down |= more
    return up | down


def travels(told: Iterable[tuple[str, float]], moment: Moment, step_s: float) -> dict[str, float]:
    """Return the times at which a picture shows statuses arrive at resources, and in the end at their registrars.

    Args:
        told: resources, and when a status reached them, oldest first.
        step_s: the least time from a resource to its holder.
    """
    begins: dict[str, float] = {}
    edges = edges_in(moment)
    for name, at in told:
        below = [begins[part] + step_s for above, part in edges if above == name and part in begins]
        begins[name] = max([at, *below])
    for above, below in edges:
        if above.startswith("@") and below in begins:
            begins[above] = max(begins.get(above, 0.0), begins[below] + step_s)
    return begins


def chart(
    moment: Moment,
    chosen: str = "",
    told: Collection[str] = (),
    opened: Mapping[str, Sequence[ResourceRow]] | None = None,
) -> Chart:
    """Return ECharts' options for the picture of a moment.

    Args:
        chosen: the id of the resource whose holders and parts light up; "" for none.
        told: the nodes that a status has just reached, which stand out.
        opened: the resources that are drawn of a server, where the moment has servers alone.
    """
    if moment.servers:
        return _drawn(*_collapsed(moment, opened or {}), set(), ())
    boxes: dict[str, list[str]] = {}
    labels: dict[str, tuple[str, str]] = {}  # text and state
    for row in moment.resources:
        boxes.setdefault(row.server.partition("/")[0], []).append(row.id)
        labels[row.id] = _label(row), row.condition
    edges = edges_in(moment)
    for above, _ in edges:
        if above.startswith("@") and above not in labels:
            boxes.setdefault(above[1:], []).append(above)
            labels[above] = above, "OK"
    return _drawn(boxes, labels, edges, around(chosen, edges), told)


def _collapsed(
    moment: Moment, opened: Mapping[str, Sequence[ResourceRow]]
) -> tuple[dict[str, list[str]], dict[str, tuple[str, str]], list[Edge]]:
    """Return the nodes of servers, and of the resources of those that are opened, with the edges between them."""
    boxes: dict[str, list[str]] = {}
    labels: dict[str, tuple[str, str]] = {}
    nodes: dict[str, list[str]] = {}  # of a server, or of a registrar that holds for itself
    for one in moment.servers:
        registrar, _, local = one.server.partition("/")
        rows = opened.get(one.server, ())
        rest = Counter(one.states) - Counter(row.condition for row in rows)
        labels |= {row.id: (_label(row), row.condition) for row in rows}
        nodes[one.server] = [row.id for row in rows]
        if not local:
            nodes[one.server].append(f"@{registrar}")
            labels[f"@{registrar}"] = f"@{registrar}", "OK"
        elif rest or not rows:
            nodes[one.server].append(SERVER + one.server)
            labels[SERVER + one.server] = _counted(local, rest, "more" if rows else "")
        boxes.setdefault(registrar, []).extend(nodes[one.server])
    for row in moment.registrars:
        if row.status != "up" and row.name not in boxes:
            boxes[row.name] = [f"@{row.name}"]
            labels[f"@{row.name}"] = f"@{row.name}: {row.status}", ""
    drawn = {row.id: row for rows in opened.values() for row in rows}
    edges: dict[Edge, None] = {}
    for one in moment.servers:
        for below in one.holds:
            between = itertools.product(nodes[one.server], nodes.get(below, ()))
            edges |= dict.fromkeys(edge for edge in between if _may_hold(*edge, drawn))
    return boxes, labels, list(edges)


def _may_hold(above: str, below: str, drawn: Mapping[str, ResourceRow]) -> bool:
    """Return whether an edge between two nodes is right, as far as the rows of opened servers say it."""
    if below not in drawn:
        return above not in drawn or drawn[above].part_count > 0
    holders = drawn[below].holders
    if above in drawn:
        return below in drawn[above].part_resources or any(holder.parent == above for holder in holders)
    origin = above.strip("@#").partition("/")[0]
    return any(holder.origin == origin and bool(holder.parent) != above.startswith("@") for holder in holders)


def _counted(name: str, states: Mapping[str, int], more: str) -> tuple[str, str]:
    """Return the text and the state of a server: lines such as "camera", "400", "3 ERROR", and the worst state."""
    there = [state for state in CONDITIONS if states.get(state)]
    bad = [f"{states[state]:,} {state}" for state in there if state != "OK"]
    total = " ".join(filter(None, (f"{sum(states.values()):,}", more)))
    return "\n".join([name, total, *bad]), there[0] if there else "OK"


def _drawn(
    boxes: dict[str, list[str]],
    labels: dict[str, tuple[str, str]],
    edges: list[Edge],
    lit: set[str],
    told: Collection[str],
) -> Chart:
    places, areas = _places(boxes, edges)
    shown = len(labels) <= _LABELS
    columns = max((area[2] for area in areas.values()), default=1.0)
    return {
        "animationDuration": 0,  # a picture that moves into sight costs more than all else of its page
        "animationDurationUpdate": 300,
        "grid": {"left": 8, "right": 8, "top": 24, "bottom": 8},
        "tooltip": {"confine": True},
        "xAxis": {"show": False, "min": 0, "max": columns},
        "yAxis": {
            "show": False, "inverse": True, "min": 0,
            "max": max((area[3] for area in areas.values()), default=1),
        },
        "series": [
            {"type": "scatter", "data": [], "silent": True, "markArea": _areas(areas)},
            {
                "type": "graph",
                "coordinateSystem": "cartesian2d",
                "edgeSymbol": ["none", "arrow"],
                "edgeSymbolSize": 7,
                ":labelLayout": _LABEL_LAYOUT % columns,
                "cursor": "pointer",
                "data": [_node(name, places[name], *labels[name], shown, lit, told) for name in labels],
                "links": [_link(edge, lit, told) for edge in edges],
            },
        ],
    }  # fmt: skip


def _node(
    name: str, place: tuple[float, float], text: str, state: str, shown: bool, lit: set[str], told: Collection[str]
) -> Chart:
    colour, sign, shape = _STATES.get(state, _BUSY)
    if name.startswith(("@", SERVER)):
        shape = "roundRect"
    is_dark = bool(lit) and name not in lit
    reached = name in told
    node: Chart = {"name": name, "value": list(place), "symbol": shape, "symbolSize": 26 if reached else 15}
    node["itemStyle"] = {"color": colour, "opacity": 0.15 if is_dark else 1}
    node["itemStyle"] |= {"borderColor": "#ffab00", "borderWidth": 6} if reached else {}
    where: Chart = {"position": "right"}
    if name.startswith(SERVER):
        where = {"position": [0, 18], "align": "left", "verticalAlign": "top", "lineHeight": 14}
    node["label"] = {"show": shown or name in lit or reached, "formatter": sign + text, "overflow": "truncate"} | where
    node["label"] |= {"color": "#b0bec5" if is_dark else "#1c2529", "fontWeight": "bold" if reached else "normal"}
    node["tooltip"] = {"formatter": html.escape(f"{text}: {state}".replace("\n", ", "), quote=False)}
    return node


def _link(edge: Edge, lit: set[str], told: Collection[str]) -> Chart:
    above, below = edge
    travelling = above in told and below in told
    is_lit = above in lit and below in lit
    style: Chart = {"color": "#607d8b", "width": 1.2, "opacity": 0.1 if lit and not is_lit else 0.8, "curveness": 0.08}
    if is_lit:
        style |= {"color": "#1565c0", "width": 3}
    if travelling:
        style |= {"color": "#ffab00", "width": 5, "opacity": 1}
    return {"source": above, "target": below, "lineStyle": style}


def _areas(areas: Mapping[str, tuple[float, float, float, float]]) -> Chart:
    style = {"color": "rgba(120, 144, 156, 0.10)", "borderColor": "#90a4ae", "borderWidth": 1}
    label = {"position": "insideTopLeft", "color": "#37474f", "fontWeight": "bold"}
    data = [
        [{"name": name, "coord": [left, top]}, {"coord": [right, bottom]}]
        for name, (left, top, right, bottom) in areas.items()
    ]
    return {"silent": True, "itemStyle": style, "label": label, "data": data}


def _places(
    boxes: dict[str, list[str]], edges: list[Edge]
) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float, float, float]]]:
    """Return the place of each node, and each registrar's box: left, top, right, bottom."""
    home = {name: box for box, names in boxes.items() for name in names}
    columns = _columns(list(boxes), {(home[above], home[below]) for above, below in edges})
    places: dict[str, tuple[float, float]] = {}
    areas: dict[str, tuple[float, float, float, float]] = {}
    left = 0.0
    for column in columns:
        top, widest = 0.0, 1.0
        for box in column:
            row = high = wide = 0
            for name in boxes[box]:
                tall = _TALL if name.startswith(SERVER) else 1
                if row and row + tall > _STACK:
                    row, wide = 0, wide + 1
                places[name] = left + 0.15 + wide, top + 1.2 + row
                row += tall
                high = max(high, row)
            wide += 1
            areas[box] = left, top, left + wide - 0.1, top + high + 0.9
            top += high + 1.4
            widest = max(widest, wide)
        left += widest + 0.15
    return places, areas


def _columns(boxes: list[str], edges: set[Edge]) -> list[list[str]]:
    """Return the boxes in columns: each right of the boxes that hold its resources, unless these are in a ring."""
    depth = dict.fromkeys(boxes, 0)
    for _ in boxes:  # the longest way has no more steps than there are boxes
        deeper = {
            below: max(depth[below], depth[above] + 1)
            for above, below in edges
            if above != below and depth[above] + 1 > depth[below]
        }
        if not deeper or max(deeper.values()) >= len(boxes):
            break
        depth |= deeper
    return [list(group) for _, group in itertools.groupby(sorted(boxes, key=depth.__getitem__), key=depth.__getitem__)]


def _label(row: ResourceRow) -> str:
    return named(row.server.partition("/")[2], row.text, _TEXT)


# -- the rows of a picture where all resources are too many ------------------------------------------------------------


def rows_of_server(ask: _Ask, server: str, states: Mapping[str, int]) -> list[ResourceRow]:
    """Return the first 40 resources of a server, the worst ones first.

    Args:
        states: how many of its resources are in each state.

    Raises:
        RrError: the system did not answer.
    """
    found: dict[str, ResourceRow] = {}
    for match in [state for state in CONDITIONS if states.get(state) and state != "OK"] + [server]:
        page = ask(ListResources(match, registrar=server.partition("/")[0]), _LOOK_S)
        found = {row.id: row for row in page.rows if row.server == server} | found
    return sorted(found.values(), key=_badness)[:_OPENED]


def _badness(row: ResourceRow) -> int:
    return CONDITIONS.index(row.condition)


def neighbours_of(ask: _Ask, id: str) -> list[ResourceRow]:
    """Return a resource with all that hold it and all that it depends on, direct or not: the first 100.

    Raises:
        RrError: the system did not answer.
    """
    found = {row.id: row for row in ask(Find(id), _LOOK_S).resources if row.id == id}
    for beside in (_above, _below):
        new = list(found.values())[:1]
        while new and len(found) < _NEIGHBOURS:
            asked = [row for one in new for question in beside(one) for row in ask(question, _LOOK_S).resources]
            new = [row for row in asked if row.id not in found]
            found |= {row.id: row for row in new}
    return list(found.values())[:_NEIGHBOURS]


def _above(row: ResourceRow) -> Iterator[Find]:
    return (Find(holder.parent, holder.origin) for holder in row.holders if holder.parent)


def _below(row: ResourceRow) -> Iterator[Find]:
    return (Find(part) for part in row.parts)
