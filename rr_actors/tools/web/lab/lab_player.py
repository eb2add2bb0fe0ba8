"""The player of the lab: pictures of a run at one time, and buttons that stop, slow and repeat that time."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from nicegui import ui

from rr_actors.system.recording.event_texts import clock
from rr_actors.tools.terminal.event_lines import event_line
from rr_actors.tools.web import graph_picture, timeline_file
from rr_actors.tools.web.lab.lab_runs import Run
from rr_actors.tools.web.lab.playback import PACES, Playback
from rr_actors.tools.web.timeline_page import TimelinePicture
from rr_actors.tools.web.tree_picture import TreePicture
from rr_actors.tools.web.watch import Moment

_LINES = 24
_NAMES = {PACES[0]: "slower", PACES[1]: "slower: 1/2", PACES[2]: "slower: 1/4"}


class Player:
    """Shows a run: its tree, its resources, its timeline, and what was printed and happened, in one order.

    Args:
        on_pick: called with the path of a child that the reader has chosen.

    Attributes:
        run: the run that is shown.
        buttons: the row of the buttons.
    """

    def __init__(self, on_pick: Callable[[str], None]) -> None:
        self.run: Run | None = None
        self._playback = Playback()
        self._looked = time.monotonic()
        self._chosen = ""
        self._drawn: object = None
        ui.add_css(timeline_file.CSS)
        with ui.row().classes("gap-2 items-center").props('role="toolbar" aria-label="playback"') as self.buttons:
            self._pause = self._button("pause", lambda now: self._playback.toggled(now))
            self._button("step", lambda now: self._playback.stepped(self._times(), now))
            self._slower = self._button("slower", lambda now: self._playback.slower(now))
            self._button("again", lambda _: self._playback.again(self.run.began if self.run else 0.0))
            self._clock = ui.label("").classes("rr-note")
        with ui.element("div").classes("rr-split"):
            with ui.element("div").classes("rr-panel rr-holds-tree rr-lab-tree").style("flex: 4"):
                self._tree = TreePicture(on_pick)
                self._empty = ui.label("The tree appears here when the experiment runs.").classes("rr-note")
            with ui.element("div").classes("rr-panel").style("flex: 4") as self._graph_panel:
                self._graph = ui.echart(graph_picture.chart(Moment(0))).classes("rr-graph").style("height: 320px")
            with ui.element("div").classes("rr-panel").style("flex: 4"):
                self._log = ui.label().classes("rr-events")
                self._log.props('role="log" aria-label="what it prints and what happens" tabindex="0"')
        with ui.element("div").classes("rr-panel w-full").style("padding: 4px") as self._timeline_panel:
            self._timeline = TimelinePicture()
        self.show(None)

    def _button(self, name: str, change: Callable[[float], Playback]) -> ui.button:
        def press() -> None:
            if self.run is not None:
                self._playback = change(self._newest())
                self.look()

        return ui.button(name, on_click=press).props("outline no-caps dense")

    @property
    def is_live(self) -> bool:
        """True while the newest time is shown."""
        return self._playback.at is None

    def show(self, run: Run | None) -> None:
        """Show a run from its beginning on, or none."""
        self.run, self._chosen, self._drawn = run, "", None
        self._playback = Playback()
        self._tree.show(Moment(0))
        self._log.text = "What the program prints, and what happens, appears here in one order."
        self._empty.set_visibility(True)
        for panel in (self._graph_panel, self._timeline_panel):
            panel.set_visibility(False)

    def choose(self, path: str) -> None:
        """Mark a child as chosen."""
        self._chosen, self._drawn = path, None

    def look(self) -> None:
        """Draw the time that is to be shown now."""
        run, now = self.run, time.monotonic()
        by_s, self._looked = now - self._looked, now
        if run is None:
            return
        playback = self._playback = self._playback.advanced(by_s, self._newest())
        self._pause.text = "go on" if playback.is_paused else "pause"
        self._slower.text = _NAMES[playback.pace]
        at = playback.at
        self._clock.text = f"{'now' if run.is_running else 'the end'}" if at is None else f"at {at - run.began:.1f} s"
        state = (run, run.watch and run.watch.version, len(run.said), at)
        if state != self._drawn:
            self._drawn = state
            self._draw(run, at)

    def _newest(self) -> float:
        run = self.run
        assert run is not None
        return time.time() if run.is_running else max(self._times(), default=run.began)

    def _times(self) -> list[float]:
        """Return the times of all that was printed and has happened."""
        run = self.run
        return sorted((*(at for at, _ in run.said.copy()), *(one.at for one in run.seen.events))) if run else []

    def _draw(self, run: Run, at: float | None) -> None:
        self._log.text = "\n".join(_lines(run, at)[-_LINES:])
        if (watch := run.watch) is None:
            return
        moment = watch.now if at is None else watch.moment_at(at)
        if not run.is_running:  # its system has gone as it should: the picture of the last moment stays
            moment = replace(moment, problem="", stale=moment.stale and "")
        self._tree.show(moment, self._chosen)
        self._empty.set_visibility(not moment.children)
        self._graph_panel.set_visibility(bool(moment.registrars))
        self._graph.options.clear()
        self._graph.options.update(graph_picture.chart(moment))
        timeline = watch.timeline()
        self._timeline_panel.set_visibility(bool(timeline.lanes))
        self._timeline.show(timeline if at is None else timeline.as_of(at), is_live=at is None and run.is_running)


def _lines(run: Run, at: float | None) -> list[str]:
    """Return what was printed and what happened until a time, in one order."""
    printed = [(when, f"{clock(when)}  prints        {line}") for when, line in run.said.copy()]
    happened = [(event.at, event_line(event)) for event in run.seen.events]
    return [line for when, line in sorted(printed + happened) if at is None or when <= at]
