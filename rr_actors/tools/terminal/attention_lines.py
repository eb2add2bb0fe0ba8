"""The first lines of the live terminal: what needs attention, the worst first. While all is well there are none."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

from rich.style import Style
from textual.strip import Strip
from textual.widget import Widget

from rr_actors.base.errors import RrError
from rr_actors.system.console.attention.attention_questions import Attention
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.tables.table import STATE_STYLES, Row
from rr_actors.tools.terminal.terminal_pane import drawn, pause_s

_LINES = 3


class AttentionLines(Widget):
    """At most three lines with what needs attention, and how long it has been so.

    Args:
        look: a function that asks what needs attention, in a thread.
    """

    def __init__(self, look: Callable[[], asyncio.Future[Attention]]) -> None:
        super().__init__(id="attention")
        self._look = look
        self._rows: list[Row] = []

    def on_mount(self) -> None:
        """Start the worker that asks what needs attention."""
        self.display = False
        self.run_worker(self._keep_asking(), group="panes")

    async def _keep_asking(self) -> None:
        while True:
            began = time.monotonic()
            with contextlib.suppress(RrError):  # the panes notice a system that does not answer, and report it
                self._take(await self._look())
            await asyncio.sleep(pause_s(time.monotonic() - began))

    def _take(self, found: Attention) -> None:
        self._rows = attention_rows(found)
        self.styles.height = len(self._rows)
        self.display = bool(self._rows)
        self.refresh(layout=True)

    def render_line(self, y: int) -> Strip:
        """Draw a line, as Textual asks for it."""
        if y >= len(self._rows):
            return Strip.blank(self.size.width, self.rich_style)
        row, style = self._rows[y], self.rich_style
        return drawn(row, self.size.width, style + Style.parse(row.style))


def attention_rows(found: Attention) -> list[Row]:
    """Return the rows for what needs attention: the three worst, or the two worst and how many more there are."""
    shown = found.items if found.total <= _LINES else found.items[: _LINES - 1]
    now = time.time()
    rows = [
        Row(
            item.id,
            f"{item.severity:<7} {item.what}",
            "" if item.since is None else ago(max(0.0, now - item.since)),
            STATE_STYLES[item.severity],
        )
        for item in shown
    ]
    if more := found.total - len(shown):
        rows.append(Row("", f"and {more:,} more: rr-actors attention", style="bold"))
    return rows
