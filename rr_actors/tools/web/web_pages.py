"""The pages about a running system: its tree, its resources, and both as they were some minutes ago.

A page does not wait for the system while it is drawn. Five times a second it looks for news in the Watch. When its
reader chooses something, a thread asks the system for it.
"""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from functools import partial
from typing import Any

from nicegui import background_tasks, ui

from rr_actors.base.errors import RrError
from rr_actors.system.console import console_messages as c
from rr_actors.tools.explanations import ago, event_line
from rr_actors.tools.terminal.terminal_rows import Neighbours, Past, Row, Rows, Window, refused
from rr_actors.tools.web import graph_picture, tree_picture
from rr_actors.tools.web.resource_table import ResourceTable
from rr_actors.tools.web.tree_picture import TreePicture
from rr_actors.tools.web.watch import CHILDREN, GROUPED_FROM, Moment, Watch

_LOOK_S = 0.2
_LINES = 14  # events
_ROWS = 300  # of the panel
_WIDTH = 110
_STEP_S = 0.5
"""How long a status takes in the picture from one resource to the next. In the system it is too fast to see."""
_STEPS = 30  # statuses

CSS = (
    tree_picture.CSS
    + """\
.nicegui-content { padding: 0; gap: 0; }
.rr-page { width: 100%; padding: 8px 14px; gap: 10px; }
.rr-bar { width: 100%; background: #263238; color: #fff; padding: 6px 14px; align-items: center; gap: 18px; }
.rr-bar a { color: #cfd8dc; } .rr-bar a.rr-here { color: #fff; font-weight: 700; text-decoration: underline; }
.rr-status { margin-left: auto; font-size: 13px; } .rr-status.rr-bad { color: #ffccbc; font-weight: 700; }
.rr-panel { border: 1px solid #b0bec5; border-radius: 8px; padding: 8px 12px; overflow: auto; }
.rr-rows, .rr-events { font: 12px/1.45 monospace; white-space: pre-wrap; overflow-wrap: anywhere; width: 100%; }
.rr-line { display: flex; gap: 10px; align-items: baseline; } .rr-line.rr-red { color: #c62828; }
.rr-line.rr-bold { font-weight: 700; } .rr-line.rr-dim { color: #607d8b; } .rr-line.rr-yellow { color: #a15c00; }
.rr-rows .q-btn { flex: none; white-space: nowrap; overflow-wrap: normal; }
.rr-note { color: #607d8b; }
"""
)


class Page(ABC):
    """The parts of all pages: a bar, a status line, events, and a slider over the last minutes."""

    def __init__(self, watch: Watch, here: str) -> None:
        self.watch = watch
        self.at: float | None = None  # the time that is shown; None for now
        self._zero = 0.0  # the time at the slider's right end, while it is in the past
        self._drawn: object = None
        self._heard = -1
        ui.add_css(CSS)
        with ui.row().classes("rr-bar"):
            ui.label("rr-actors").classes("text-bold")
            for name, target in (("Tree", "/"), ("Resources", "/resources"), ("Sequence", "/sequence")):
                ui.link(name, target).classes("rr-here" if target == here else "")
            self._status = ui.label("").classes("rr-status").props('role="status" aria-live="polite"')
        with ui.column().classes("rr-page"):
            self.build()
            with ui.row().classes("w-full items-center no-wrap"):
                ui.button("now", on_click=lambda: self._slider.set_value(0)).props("dense no-caps outline")
                self._slider = ui.slider(
                    min=-1, max=0, value=0, step=0.2, on_change=lambda event: self._slid(event.value)
                )
                self._slider.props('aria-label="seconds back"').classes("grow")
                self._clock = ui.label().classes("rr-clock").style("min-width: 13em")
            with ui.element("div").classes("rr-panel w-full"):
                self._events = ui.label().classes("rr-events").props('role="log" aria-label="events"')
        ui.timer(_LOOK_S, self._look)

    @abstractmethod
    def build(self) -> None:
        """Put this page's own parts on it."""

    @abstractmethod
    def draw(self, moment: Moment) -> None:
        """Show a moment in this page's own parts."""

    def step(self) -> object:
        """Return a value that changes when the page must be drawn again for the same moment."""
        return None

    async def carry_out(self, what: str, command: c.Command) -> None:
        """Send a command to the system, and show the reader what was done, or the error."""
        try:
            done = await asyncio.to_thread(self.watch.link.ask, command, c.Done)
        except RrError as error:
            ui.notify(f"{what}: {error}", type="negative", multi_line=True)
        else:
            ui.notify(done.text, type="positive")
        self.watch.look_soon()

    def _slid(self, back: float | None) -> None:
        back = back or 0.0
        if back < 0 and self.at is None:
            self._zero = time.time()
        self.at = self._zero + back if back < 0 else None
        self._look()

    def _look(self) -> None:
        """Show the news of the watch."""
        watch, moment = self.watch, self.watch.now if self.at is None else self.watch.moment_at(self.at)
        if self.at is None:
            begins = watch.moments[0].at
            self._slider.props(f"min={min(-1, round(begins - time.time())) if begins else -1}")
            self._clock.text = "now"
        else:
            self._clock.text = f"{time.strftime('%H:%M:%S', time.localtime(self.at))}, {ago(time.time() - self.at)} ago"
        if watch.heard != self._heard:
            self._heard = watch.heard
            newest = list(watch.events.copy())[-_LINES:]
            self._events.text = "\n".join(event_line(event) for event in newest)
            self._events.props(f"data-seq={newest[-1].seq if newest else 0}")
        problem = watch.now.problem
        self._status.text = f"{problem}: waiting for it" if problem else _named(watch)
        self._status.classes(toggle="rr-bad") if bool(problem) != ("rr-bad" in self._status.classes) else None
        if (state := (id(moment), self.step())) != self._drawn:
            self._drawn = state
            self.draw(moment)


def _named(watch: Watch) -> str:
    welcome = watch.welcome
    missed = f", {watch.missed} events missed" if watch.missed else ""
    return "" if welcome is None else f"{welcome.system}, pid {welcome.pid}, {welcome.state_dir}{missed}"


class _Panel:
    """Rows about the chosen thing, as the live terminal shows them, and buttons.

    Args:
        page: the page, which carries out the buttons' commands.
    """

    def __init__(self, page: Page) -> None:
        self._page = page
        self._rows: Rows | None = None
        self._shown: list[Row] = []
        self._is_asking = self._is_wanted = False
        self._title = ui.label("").classes("text-bold")
        self._buttons = ui.row().classes("gap-2")
        self._lines = ui.column().classes("rr-rows gap-0")

    async def show(self, rows: Rows, buttons: dict[str, c.Command]) -> None:
        """Show these rows, and a button for each command."""
        self._rows = rows
        self._title.text = rows.title
        self._buttons.clear()
        with self._buttons:
            for name, command in buttons.items():
                self._button(name, command)
        await self.ask()

    async def ask(self) -> None:
        """Ask for the rows again. A call in the meantime makes the first call ask once more."""
        self._is_wanted = True
        while self._is_wanted and not self._is_asking and self._rows is not None:
            self._is_wanted, self._is_asking = False, True
            try:
                await self._ask(self._rows, Window("", 0, _ROWS, _WIDTH))
            finally:
                self._is_asking = False

    async def _ask(self, rows: Rows, window: Window) -> None:
        try:
            listed = await asyncio.to_thread(rows.list, self._page.watch.link, window)
        except RrError as error:
            listed = refused(error, window)
        if rows is not self._rows or listed.rows == self._shown:
            return
        self._shown = listed.rows
        self._lines.clear()
        with self._lines:
            for row in listed.rows:
                self._line(row)

    def _line(self, row: Row) -> None:
        with ui.element("div").classes("rr-line " + " ".join(f"rr-{word}" for word in row.style.split())):
            ui.label(row.text)
            if row.note:
                ui.label(row.note).classes("rr-note")
            if row.query:
                self._button("unload", c.Unload(row.query))

    def _button(self, name: str, command: c.Command) -> None:
        carry_out = partial(self._page.carry_out, name, command)
        ui.button(name, on_click=carry_out).props("dense no-caps outline")


class TreePage(Page):
    """The page with the supervisor tree and the chosen child."""

    def __init__(self, watch: Watch) -> None:
        self._chosen = ""
        super().__init__(watch, "/")

    def build(self) -> None:
        """Put the tree and the panel on the page."""
        with ui.row().classes("w-full no-wrap items-start"):
            with ui.element("div").classes("rr-panel").style("flex: 3; max-height: 62vh"):
                self._tree = TreePicture(self._choose)
                self._more = ui.label()
            with ui.element("div").classes("rr-panel").style("flex: 2; max-height: 62vh"):
                self._panel = _Panel(self)

    def draw(self, moment: Moment) -> None:
        """Show the tree, and ask for the rows of the chosen child."""
        self._tree.show(moment.children, self._chosen)
        self._more.text = f"the first {CHILDREN} children" if len(moment.children) >= CHILDREN else ""
        if self._chosen:
            background_tasks.create(self._panel.ask())

    async def _choose(self, path: str) -> None:
        self._chosen = path
        self._tree.show(self.watch.now.children, path)
        commands: dict[str, c.Command] = {
            "kill -9": c.Kill(path),
            "stop": c.Terminate(path),
            "restart": c.Restart(path),
        }
        await self._panel.show(Past(path), commands)


class ResourcesPage(Page):
    """The page with the resources: the picture of their dependencies beside the tree, and a table of all."""

    def __init__(self, watch: Watch) -> None:
        self._chosen = ""
        self._opened = time.time()
        super().__init__(watch, "/resources")

    def build(self) -> None:
        """Put the tree, the graph, the panel and the table on the page."""
        with ui.row().classes("w-full no-wrap items-stretch"):
            with ui.element("div").classes("rr-panel").style("flex: 2; max-height: 52vh"):
                self._tree = TreePicture(lambda path: ui.navigate.to("/"))
            with ui.element("div").classes("rr-panel").style("flex: 4"):
                self._said = ui.label().classes("rr-note")
                self._graph = ui.echart(graph_picture.chart(Moment(0)), on_point_click=self._clicked)
                self._graph.style("height: 48vh")
            with ui.element("div").classes("rr-panel").style("flex: 2; max-height: 52vh"):
                self._panel = _Panel(self)
        self._table = ResourceTable(self._choose)

    def draw(self, moment: Moment) -> None:
        """Show the tree and the graph, and make the table and the panel ask for their rows again."""
        self._tree.show(moment.children)
        options = graph_picture.chart(moment, self._chosen, self.step())
        self._graph.options.clear()
        self._graph.options.update(options)
        grouped = moment.total > GROUPED_FROM
        self._said.text = f"{moment.total} resources" + (": too many to draw, these are their registrars" * grouped)
        if self.at is None:
            self._table.refresh()
            background_tasks.create(self._panel.ask())

    def step(self) -> set[str]:
        """Return the nodes that the newest statuses have just reached on their way up, slowed down for the picture.

        It returns none while the page shows the past.
        """
        if self.at is not None:
            return set()
        statuses = [event for event in self.watch.events.copy() if event.event == "status" and event.at > self._opened]
        told = [(str(event.facts.get("resource_id")), event.at) for event in statuses[-_STEPS:]]
        begins = graph_picture.travels(told, self.watch.now, _STEP_S)
        now = time.time()
        return {name for name, at in begins.items() if at <= now < at + 2 * _STEP_S}

    def _clicked(self, event: Any) -> Any:
        name = str(event.name)
        return None if name.startswith("@") else self._choose(name)

    async def _choose(self, id: str) -> None:
        self._chosen = id
        self._drawn = None
        await self._panel.show(Neighbours(id), {"unload from all": c.Unload(id, force=True)})
