"""The pages about a running system that are more than a list: its tree, its resources, and the figures of children."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from nicegui import background_tasks, ui

from rr_actors.base.errors import RrError, counted
from rr_actors.base.notebook import escape
from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console.attention.attention_questions import Silence
from rr_actors.system.recording.timelines import Timeline
from rr_actors.tools.tables.resource_table import RESOURCES
from rr_actors.tools.terminal.figure_curves import STEP_S, STEPS, Curve
from rr_actors.tools.web import graph_picture
from rr_actors.tools.web.frame import overview
from rr_actors.tools.web.frame.live_html import LiveHtml
from rr_actors.tools.web.frame.page_addresses import Address
from rr_actors.tools.web.page_parts import Page
from rr_actors.tools.web.row_grid import Grid
from rr_actors.tools.web.tree_picture import TreePicture
from rr_actors.tools.web.watch import CHILDREN, Moment, Watch

_CURVES = 50  # children of which curves are drawn
_STEP_S = 0.5
"""How long a status takes in the picture from one resource to the next. In the system it is too fast to see."""
_STEPS = 30  # statuses
_SILENCE_S = 600.0
_NONE: dict[str, int] = {}


class OverviewPage(Page):
    """The first page: whether all is well, what needs attention, and the last ten minutes of each child."""

    goes_back = False

    def __init__(self, watch: Watch) -> None:
        super().__init__(watch, "/")

    def build(self) -> None:
        """Put the head, the figures, the list and the lanes on the page."""
        self._html = LiveHtml(self._silence).classes("rr-overview")

    def draw(self, moment: Moment) -> None:
        """Show the overview."""
        problem, timeline = moment.problem if moment.at else "", self.watch.timeline()
        curves, troubles = self.watch.figures.curves(), self.watch.attention.items
        parts = (
            overview.head_card(troubles, problem),
            overview.figures_html(_five(self.watch, moment, timeline, curves)),
            overview.troubles_html(troubles, problem),
            overview.lanes_html(timeline, moment.children, {path: _usage(of) for path, of in curves.items()}),
        )
        self._html.show("".join(parts))

    def step(self) -> int:
        """Return the second: times grow older."""
        return int(time.monotonic())

    async def _silence(self, act: str, item: str) -> None:
        await self.carry_out(act, Silence(item, _SILENCE_S))


def _usage(curves: Sequence[Curve]) -> str:
    return " · ".join(curve.now for curve in curves if curve.kind.name in ("CPU", "memory") and curve.now)


def _five(
    watch: Watch, moment: Moment, timeline: Timeline, curves: Mapping[str, Sequence[Curve]]
) -> Iterator[overview.Figure]:
    """Yield the five figures of the overview."""
    running = sum(row.state == "running" for row in moment.children)
    count = len(moment.children)
    look = "good" if running == count else "bad"
    yield overview.Figure("Children running", f"{running:,}", f"of {count:,}", _running(watch), look)
    died, most, each = overview.deaths(timeline)
    yield overview.Figure("Deaths, last hour", f"{died:,}", most, each, "bad" if died else "still")
    states = Counter[str]()
    for row in moment.resources:
        states[row.condition] += 1
    for server in moment.servers:
        states.update(server.states)
    bad = ", ".join(f"{states[state]:,} {state}" for state in ("FATAL", "ERROR", "WARNING") if states[state])
    held = overview.total(curves.values(), "resources")
    yield overview.Figure("Resources", f"{moment.total:,}", bad, held)
    loads = overview.total(curves.values(), "loads")
    now = overview.newest(loads)
    yield overview.Figure("Loads a second", "–" if now is None else f"{now:.1f}", "", loads)
    cpu, memory = (overview.total(curves.values(), kind) for kind in ("CPU", "memory"))
    used, taken = overview.newest(cpu), overview.newest(memory)
    value = "–" if used is None else f"{used:.0f} %"
    yield overview.Figure("CPU · memory", value, "" if taken is None else f"{taken:,.0f} MiB", cpu)


def _running(watch: Watch) -> list[float | None]:
    """Return how many children ran in the last ten minutes, a value for each five seconds."""
    moments = [moment for moment in watch.moments.copy() if moment.at]
    now = time.time()
    values: list[float | None] = []
    place = 0
    for step in range(STEPS):
        at = now - (STEPS - 1 - step) * STEP_S
        while place + 1 < len(moments) and moments[place + 1].at <= at:
            place += 1
        known = moments and moments[place].at <= at
        values.append(float(sum(row.state == "running" for row in moments[place].children)) if known else None)
    return values


class TreePage(Page):
    """The page with the supervisor tree."""

    def __init__(self, watch: Watch) -> None:
        super().__init__(watch, "/tree")

    def build(self) -> None:
        """Put the tree on the page."""
        with ui.element("div").classes("rr-panel rr-holds-tree w-full"):
            self._tree = TreePicture(lambda path: self.choose("child", path))
            self._more = ui.label()

    def draw(self, moment: Moment) -> None:
        """Show the tree."""
        self._tree.show(moment, self.address.name)
        self._more.text = f"the first {CHILDREN} children" if len(moment.children) >= CHILDREN else ""

    def is_chosen(self, address: Address) -> None:
        """Mark the chosen child."""
        self._tree.show(self.moment, address.name)


class FiguresPage(Page):
    """The page with the figures of the children over the last ten minutes, as curves."""

    goes_back = False

    def __init__(self, watch: Watch) -> None:
        super().__init__(watch, "/figures")

    def build(self) -> None:
        """Put the filter and the curves on the page."""
        with ui.element("div").classes("rr-panel w-full"):
            self._match = ui.input("only children with this text in their path").classes("w-full")
            self._match.props("dense outlined clearable debounce=200")
            self._said = ui.label().classes("rr-note")
            self._curves = ui.html("", sanitize=False).classes("rr-figures")

    def draw(self, moment: Moment) -> None:
        """Show the curves as they are now."""
        match = self._match.value or ""
        found = self.watch.figures.curves(match)
        shown = dict(list(found.items())[:_CURVES])
        self._curves.content = "".join(_section(path, curves) for path, curves in shown.items())
        first = f"the first {_CURVES} of " if len(found) > _CURVES else ""
        self._said.text = f"The last ten minutes of {first}{len(found)} child{'' if len(found) == 1 else 'ren'}."

    def step(self) -> tuple[int, str]:
        """Return the number of the newest step, and the filter."""
        return self.watch.figures.step, self._match.value or ""


def _section(path: str, curves: Sequence[Curve]) -> str:
    rows = "".join(
        f"<div><span>{curve.kind.name}</span>{curve.svg(path)}<b>{escape(curve.now)}</b></div>" for curve in curves
    )
    return f'<section data-child="{escape(path)}"><h2>{escape(path)}</h2>{rows}</section>'


class ResourcesPage(Page):
    """The page with the resources: a table of all, and below it the picture of their dependencies."""

    def __init__(self, watch: Watch) -> None:
        self._chosen = ""
        self._began = time.time()
        self._graph: ui.echart | None = None
        self._opened: dict[str, list[ResourceRow]] = {}  # servers, with their resources that are drawn
        self._focus: list[ResourceRow] = []  # the chosen resource and its neighbours, where all are too many to draw
        super().__init__(watch, "/resources")

    def build(self) -> None:
        """Put the table and the graph on the page."""
        self._table = Grid(RESOURCES, "search in id, server, request and status", self, "state")
        with ui.element("div").classes("rr-panel w-full"):
            with ui.row().classes("items-center gap-2"):
                self._said = ui.label().classes("rr-note")
                self._back = ui.button("all", on_click=self._show_all).props("dense no-caps outline")
            self._graph_place = ui.element("div").classes("w-full").style("height: 40vh")
        ui.timer(0, self._add_libraries, once=True)

    def _add_libraries(self) -> None:
        """Add the graph and the table. Their libraries take a second to load, so the counts are shown first."""
        with self._graph_place:
            self._graph = ui.echart(self._options(self._seen()), on_point_click=self._clicked)
            self._graph.classes("rr-graph").style("height: 100%")
        self._table.fill()

    def draw(self, moment: Moment) -> None:
        """Show the graph, and make the table ask for its rows again."""
        grouped = bool(moment.servers)
        if self._graph is not None:
            self._graph.options.clear()
            self._graph.options.update(self._options(self._seen()))
        how = ": the chosen one, with those above and below it" if self._focus else ": a click opens a server"
        said = f"{counted(moment.total, 'resource')}{how * grouped}"
        self._said.text = "" if moment.stale is None else said  # they are not counted yet
        self._back.set_visibility(grouped and bool(self._focus or self._opened))
        if self.at is None:
            self._table.refresh()
            if grouped:
                background_tasks.create(self._renew())

    def _seen(self) -> Moment:
        """Return what the graph shows: the moment, or of many resources the chosen one with its neighbours."""
        moment = self.moment
        if moment.servers and self._focus and self.at is None:
            return replace(moment, resources=tuple(self._focus), servers=())
        return moment

    def _options(self, seen: Moment) -> graph_picture.Chart:
        chosen = self._chosen if any(row.id == self._chosen for row in seen.resources) else ""
        return graph_picture.chart(seen, chosen, self.step(), self._opened)

    def step(self) -> set[str]:
        """Return the nodes that the newest statuses have just reached on their way up, slowed down for the picture.

        It returns none while the page shows the past, or servers in place of resources.
        """
        if self.at is not None or self._seen().servers:
            return set()
        statuses = [event for event in self.watch.events.copy() if event.event == "status" and event.at > self._began]
        told = [(str(event.facts.get("resource_id")), event.at) for event in statuses[-_STEPS:]]
        begins = graph_picture.travels(told, self.watch.now, _STEP_S)
        now = time.time()
        return {name for name, at in begins.items() if at <= now < at + 2 * _STEP_S}

    def _clicked(self, event: Any) -> Any:
        name = str(event.name)
        if name.startswith(graph_picture.SERVER):
            return self._open(name.removeprefix(graph_picture.SERVER))
        return self.choose("registrar", name[1:]) if name.startswith("@") else self.choose("resource", name)

    async def _open(self, server: str) -> None:
        """Draw the first resources of a server."""
        self._opened[server] = []
        await self._renew()

    def _show_all(self) -> None:
        self._opened.clear()
        self._focus, self._drawn = [], None
        background_tasks.create(self.choose("", ""))

    async def _renew(self) -> None:
        """Ask again for the rows of opened servers, and of the resource that is shown with its neighbours."""
        chosen, servers = self._chosen, list(self._opened)
        states = {one.server: one.states for one in self.watch.now.servers}
        ask = self.watch.link.ask
        with contextlib.suppress(RrError):  # the next moment says why there is no answer
            focus = await asyncio.to_thread(graph_picture.neighbours_of, ask, chosen) if chosen else []
            asked = [
                await asyncio.to_thread(graph_picture.rows_of_server, ask, one, states.get(one, _NONE))
                for one in servers
            ]
            opened = dict(zip(servers, asked, strict=True))
            if (chosen, servers) == (self._chosen, list(self._opened)) and (focus, opened) != (
                self._focus,
                self._opened,
            ):
                self._focus, self._opened, self._drawn = focus, opened, None

    def is_chosen(self, address: Address) -> None:
        """Light up the chosen resource with its holders and parts."""
        self._chosen = address.name if address.kind == "resource" else ""
        self._drawn = None
        if self.watch.now.servers and self._chosen:
            background_tasks.create(self._renew())

    def readdressed(self) -> None:
        """Search and sort as the address says."""
        self._table.follow(self.address)
