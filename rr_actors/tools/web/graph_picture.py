"""The picture of dependencies between resources, or if these are too many between registrars: a chart for ECharts.

Registrars are boxes. A holder is left of the resource that it holds, so a status travels from right to left.
"""

from __future__ import annotations

import html
import itertools
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from rr_actors.registrar.pages import ResourceRow
from rr_actors.tools.graphs import edges_of
from rr_actors.tools.web.watch import GROUPED_FROM, Moment

Chart = dict[str, Any]
Edge = tuple[str, str]

_STATES = {  # the colour, sign and shape of each state
    "OK": ("#2e7d32", "", "circle"),
    "UPDATE": ("#1565c0", "↻ ", "circle"),
    "WARNING": ("#ef8f00", "! ", "triangle"),
    "ERROR": ("#c62828", "✖ ", "diamond"),
    "FATAL": ("#7f0000", "✖✖ ", "rect"),
}
_BUSY = ("#78909c", "… ", "emptyCircle")
_STACK = 16  # resources above one another in a box
_LABELS = 60  # up to so many nodes always have labels; of more nodes, a label appears under the mouse
_TEXT = 34


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


def chart(moment: Moment, chosen: str = "", told: Collection[str] = ()) -> Chart:
    """Return ECharts' options for the picture of a moment.

    Args:
        chosen: the id of the resource whose holders and parts light up; "" for none.
        told: the nodes that a status has just reached, which stand out.
    """
    if moment.total > GROUPED_FROM:
        return _drawn(*_grouped(moment), set(), ())
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


def _grouped(moment: Moment) -> tuple[dict[str, list[str]], dict[str, tuple[str, str]], list[Edge]]:
    """Return a node for each registrar, with its number of resources, and the edges between them."""
    labels = {
        f"@{row.name}": (f"{row.name}: {row.counts.get('resources', 0)} resources", "OK" if row.status == "up" else "")
        for row in moment.registrars
    }
    home = {row.id: f"@{row.server.partition('/')[0]}" for row in moment.resources}
    edges = {(home.get(above, above), home[below]) for above, below in edges_in(moment) if below in home}
    return {name[1:]: [name] for name in labels}, labels, sorted(edge for edge in edges if edge[0] in labels)


def _drawn(
    boxes: dict[str, list[str]],
    labels: dict[str, tuple[str, str]],
    edges: list[Edge],
    lit: set[str],
    told: Collection[str],
) -> Chart:
    places, areas = _places(boxes, edges)
    shown = len(labels) <= _LABELS
    return {
        "animationDurationUpdate": 300,
        "grid": {"left": 8, "right": 8, "top": 24, "bottom": 8},
        "tooltip": {"confine": True},
        "xAxis": {"show": False, "min": 0, "max": max((area[2] for area in areas.values()), default=1)},
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
    if name.startswith("@"):
        shape = "roundRect"
    is_dark = bool(lit) and name not in lit
    reached = name in told
    node: Chart = {"name": name, "value": list(place), "symbol": shape, "symbolSize": 26 if reached else 15}
    node["itemStyle"] = {"color": colour, "opacity": 0.15 if is_dark else 1}
    node["itemStyle"] |= {"borderColor": "#ffab00", "borderWidth": 6} if reached else {}
    node["label"] = {"show": shown or name in lit or reached, "position": "right", "formatter": sign + text}
    node["label"] |= {"color": "#b0bec5" if is_dark else "#1c2529", "fontWeight": "bold" if reached else "normal"}
    node["tooltip"] = {"formatter": html.escape(f"{text}: {state}", quote=False)}
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
            names = boxes[box]
            wide = -(-len(names) // _STACK)
            high = min(len(names), _STACK)
            for number, name in enumerate(names):
                places[name] = left + 0.15 + number // _STACK, top + 1.2 + number % _STACK
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
    text = f"{row.server.partition('/')[2]} {row.request}"
    return text if len(text) <= _TEXT else text[: _TEXT - 1] + "…"
