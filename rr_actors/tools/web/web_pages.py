"""The pages about a running system that are more than a list: its tree, its resources, and the figures of children."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from nicegui import background_tasks, ui

from rr_actors.base.errors import RrError
from rr_actors.base.notebook import escape
from rr_actors.registrar.pages import ResourceRow
from rr_actors.tools.tables.resource_table import RESOURCES
from rr_actors.tools.tables.row_commands import CHILD_COMMANDS, RESOURCE_COMMANDS
from rr_actors.tools.tables.table import Row
from rr_actors.tools.terminal.figure_curves import Curve
from rr_actors.tools.terminal.terminal_rows import Neighbours, Past, graph_of
from rr_actors.tools.web import graph_picture
from rr_actors.tools.web.page_parts import Page, Panel, Pictures
from rr_actors.tools.web.row_grid import Grid
from rr_actors.tools.web.tree_picture import TreePicture
from rr_actors.tools.web.watch import CHILDREN, Moment, Watch

_PICTURE_S = 0.5
_CURVES = 50  # children of which curves are drawn
_STEP_S = 0.5
"""How long a status takes in the picture from one resource to the next. In the system it is too fast to see."""
_STEPS = 30  # statuses
_NONE: dict[str, int] = {}


class TreePage(Page):
    """The page with the supervisor tree and the chosen child."""

    def __init__(self, watch: Watch) -> None:
        self._chosen = ""
        super().__init__(watch, "/")

    def build(self) -> None:
        """Put the tree and the panel on the page."""
        with ui.element("div").classes("rr-split"):
            with ui.element("div").classes("rr-panel rr-holds-tree").style("flex: 3"):
                self._tree = TreePicture(self._choose)
                self._more = ui.label()
            with ui.element("div").classes("rr-panel").style("flex: 2"):
                self._panel = Panel(self, "Choose a child to see its history.")

    def draw(self, moment: Moment) -> None:
        """Show the tree, and ask for the rows of the chosen child."""
        self._tree.show(moment, self._chosen)
        self._more.text = f"the first {CHILDREN} children" if len(moment.children) >= CHILDREN else ""
        if self._chosen:
            self._panel.offer(self._row(moment))
            background_tasks.create(self._panel.ask())

    async def _choose(self, path: str) -> None:
        self._chosen = path
        self._tree.show(self.moment, path)
        await self._panel.show(Past(path), self._row(self.moment), CHILD_COMMANDS)

    def _row(self, moment: Moment) -> Row:
        child = next((row for row in moment.children if row.path == self._chosen), None)
        return Row("", self._chosen, child=child)


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
    """The page with the resources: the picture of their dependencies beside the tree, and a table of all."""

    def __init__(self, watch: Watch) -> None:
        self._chosen = ""
        self._began = time.time()
        self._graph: ui.echart | None = None
        self._opened: dict[str, list[ResourceRow]] = {}  # servers, with their resources that are drawn
        self._focus: list[ResourceRow] = []  # the chosen resource and its neighbours, where all are too many to draw
        super().__init__(watch, "/resources")

    def build(self) -> None:
        """Put the tree, the graph, the panel and the table on the page."""
        with ui.element("div").classes("rr-split"):
            with ui.element("div").classes("rr-panel rr-holds-tree").style("flex: 2"):
                self._tree = TreePicture(lambda path: ui.navigate.to("/"))
            with ui.element("div").classes("rr-panel").style("flex: 4"):
                with ui.row().classes("items-center gap-2"):
                    self._said = ui.label().classes("rr-note")
                    self._back = ui.button("all", on_click=self._show_all).props("dense no-caps outline")
                self._graph_place = ui.element("div").classes("w-full").style("height: 48vh")
            with ui.element("div").classes("rr-panel").style("flex: 2"):
                self._panel = Panel(self, "Choose a resource to see its holders and parts.")
                self._pictures = Pictures()
                self._actions = ui.html("", sanitize=False).classes("rr-actions")
        self._table = Grid(RESOURCES, "search in id, server, request and status", self._choose)
        ui.timer(0, self._add_libraries, once=True)
        ui.timer(_PICTURE_S, self._look_at_streams)

    def _add_libraries(self) -> None:
        """Add the graph and the table. Their libraries take a second to load, so tree and counts are shown first."""
        with self._graph_place:
            self._graph = ui.echart(self._options(self._seen()), on_point_click=self._clicked)
            self._graph.classes("rr-graph").style("height: 100%")
        self._table.fill()

    async def _look_at_streams(self) -> None:
        """Show the newest picture of each stream of the chosen resource."""
        chosen = self._chosen if self.at is None else ""
        seen = await asyncio.to_thread(self.watch.pictures_of, chosen) if chosen else {}
        if chosen == (self._chosen if self.at is None else ""):  # nothing else was chosen meanwhile
            self._pictures.show(seen)

    def draw(self, moment: Moment) -> None:
        """Show the tree and the graph, and make the table and the panel ask for their rows again."""
        self._tree.show(moment)
        grouped = bool(moment.servers)
        if self._graph is not None:
            self._graph.options.clear()
            self._graph.options.update(self._options(self._seen()))
        how = ": the chosen one, with those above and below it" if self._focus else ": a click opens a server"
        said = f"{moment.total:,} resource{'' if moment.total == 1 else 's'}{how * grouped}"
        self._said.text = "" if moment.stale is None else said  # they are not counted yet
        self._back.set_visibility(grouped and bool(self._focus or self._opened))
        if self.at is None:
            self._table.refresh()
            background_tasks.create(self._panel.ask())
            background_tasks.create(self._draw_actions())
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

    async def _draw_actions(self) -> None:
        """Draw the actions of the chosen resource with their states, if it is a graph of actions."""
        row = next((row for row in (*self.watch.now.resources, *self._focus) if row.id == self._chosen), None)
        with contextlib.suppress(RrError):  # the next moment says why there is no answer
            graph = None if row is None else await asyncio.to_thread(graph_of, self.watch.link, row)
            if row is None or row.id == self._chosen:  # nothing else was chosen meanwhile
                self._actions.content = "" if graph is None else graph.picture

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
        return None if name.startswith("@") else self._choose(name)

    async def _open(self, server: str) -> None:
        """Draw the first resources of a server."""
        self._opened[server] = []
        await self._renew()

    def _show_all(self) -> None:
        self._opened.clear()
        self._focus, self._chosen, self._drawn = [], "", None

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

    async def _choose(self, id: str) -> None:
        self._chosen = id
        self._drawn = None
        if self.watch.now.servers:
            await self._renew()
        name = next((row.name for row in (*self.watch.now.resources, *self._focus) if row.id == id), "")
        await self._panel.show(Neighbours(id, name), Row(id, name, resource=id, name=name), RESOURCE_COMMANDS)
