"""The page of the timeline: the lives of all children and what happened to them, live and back to the first record."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import json
import time

from nicegui import ui

from rr_actors.system.recording.timelines import Timeline, looks
from rr_actors.tools.web import timeline_file
from rr_actors.tools.web.page_parts import Page
from rr_actors.tools.web.watch import Moment, Watch

_BYTES_A_SECOND = 400_000
"""How much a page sends of a timeline that changes all the time."""


class TimelinePicture(ui.element, component="timeline_picture.js"):
    """A timeline as a live picture."""

    def __init__(self) -> None:
        super().__init__()
        self._props["data"] = ""
        self._props["live"] = False
        self._props["looks"] = looks()

    def show(self, timeline: Timeline, *, is_live: bool) -> int:
        """Show another timeline at the same scale and place; return how many bytes the page sends.

        Args:
            is_live: the children live on after the timeline's end, until it is shown again.
        """
        self._props["live"] = is_live
        data = json.dumps(timeline.plain())
        self._props["data"] = data
        return len(data)


class TimelinePage(Page):
    """The page with the timeline of the watched system, and of the systems before it in its state directory."""

    goes_back = False

    def __init__(self, watch: Watch) -> None:
        self._next_s = 0.0
        self._version = -1
        super().__init__(watch, "/timeline")

    def build(self) -> None:
        """Put the picture on the page."""
        ui.add_css(timeline_file.CSS)
        with ui.element("div").classes("rr-panel w-full").style("padding: 4px"):
            self._picture = TimelinePicture()

    def draw(self, moment: Moment) -> None:
        """Show the timeline as it is now."""
        self._version = self.watch.version
        sent = self._picture.show(self.watch.timeline(), is_live=not moment.problem)
        self._next_s = time.monotonic() + sent / _BYTES_A_SECOND

    def step(self) -> int:
        """Return the number of the newest state, when there is time to draw it."""
        return self.watch.version if time.monotonic() >= self._next_s else self._version
