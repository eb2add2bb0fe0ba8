"""The page of the lab: a button for each experiment, its code, its picture, and what its reader can look for."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
from functools import partial

from nicegui import app, ui

from rr_actors.tools.web import graph_picture
from rr_actors.tools.web.lab_runs import AT_ONCE, Experiment, Place, Run, experiments
from rr_actors.tools.web.tree_picture import TreePicture
from rr_actors.tools.web.watch import Moment
from rr_actors.tools.web.web_pages import CSS

_LOOK_S = 0.2
_LINES = 12


def add_lab() -> None:
    """Add the page of the lab to NiceGUI's application."""
    runs: set[Run] = set()

    def stop_all() -> None:
        for one in list(runs):
            one.stop()

    ui.page("/lab", title="rr-actors: lab")(partial(LabPage, runs))
    ui.page("/", title="rr-actors: lab")(lambda: ui.navigate.to("/lab"))
    app.on_shutdown(lambda: asyncio.to_thread(stop_all))


class LabPage:
    """The page with the experiments. A page runs one at a time, and ends it when it is closed.

    Args:
        runs: the runs of all pages.
    """

    def __init__(self, runs: set[Run]) -> None:
        self._place = Place(runs)
        self._shown: Run | None = None  # the newest run, also after it was stopped
        self._drawn: object = None
        ui.add_css(CSS)
        with ui.row().classes("rr-bar"):
            ui.label("rr-actors lab").classes("text-bold")
            self._status = ui.label("choose an experiment").classes("rr-status").props('role="status"')
        with ui.row().classes("rr-page no-wrap items-start"):
            with ui.column().classes("gap-2").style("width: 15rem"):
                self._buttons = {one.name: self._button(one) for one in experiments()}
                self._stop_button = ui.button("stop it", on_click=self._place.stop).props("outline no-caps dense")
            with ui.column().classes("grow gap-2").style("min-width: 0"):
                self._title = ui.label("").classes("text-h6")
                self._about = ui.label("Each button starts a real system of a few processes, for half a minute or so.")
                self._look_for = ui.label("").classes("text-bold")
                with ui.element("div").classes("rr-split"):
                    with ui.element("div").classes("rr-panel rr-holds-tree").style("flex: 4; min-height: 320px"):
                        self._tree = TreePicture(lambda path: None)
                    with ui.element("div").classes("rr-panel").style("flex: 4") as self._graph_panel:
                        self._graph = (
                            ui.echart(graph_picture.chart(Moment(0))).classes("rr-graph").style("height: 320px")
                        )
                    with ui.element("div").classes("rr-panel").style("flex: 3"):
                        self._said = ui.label("").classes("rr-rows").props('role="log" aria-label="what it prints"')
                        self._events = ui.label("").classes("rr-events rr-note")
                self._code = ui.code("", language="python").classes("w-full")
        ui.context.client.on_delete(self._place.leave)
        ui.timer(_LOOK_S, self._look)

    def _button(self, experiment: Experiment) -> ui.button:
        button = ui.button(experiment.title.partition(":")[0], on_click=partial(self._start, experiment))
        return button.props("no-caps align=left").classes("w-full")

    async def _start(self, experiment: Experiment) -> None:
        self._title.text, self._about.text = experiment.title, experiment.about
        self._look_for.text, self._code.content = f"Look for: {experiment.look_for}", experiment.code
        if not await self._place.start(experiment.name):
            ui.notify(f"{AT_ONCE} experiments run already: stop one, or wait for its end", type="warning")

    def _look(self) -> None:
        self._shown = running = self._place.run or self._shown
        if running is None:
            return
        watch = running.watch
        self._status.text = f"{running.name} {'runs' if running.is_running else 'has ended'}"
        self._said.text = "\n".join(list(running.lines.copy())[-_LINES:])
        if watch is None or (running, watch.version) == self._drawn:
            return
        self._drawn = running, watch.version
        self._tree.show(watch.now)
        self._graph_panel.set_visibility(bool(watch.now.registrars))
        self._graph.options.clear()
        self._graph.options.update(graph_picture.chart(watch.now))
        self._events.text = "\n".join(map(str, watch.lines.lines()[-_LINES:]))
