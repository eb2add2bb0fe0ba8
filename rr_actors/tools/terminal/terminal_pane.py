"""A pane of the live terminal: a list with a cursor, which asks for the rows that it shows."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import ClassVar

from rich.cells import cell_len
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import events
from textual.binding import Binding, BindingType
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from rr_actors.base.errors import RrError, Unavailable
from rr_actors.system.console import console_messages as c
from rr_actors.tools.tables.table import Row
from rr_actors.tools.terminal.terminal_rows import Listed, Rows, Window, refused

_OFTEN_S = 0.5
_SELDOM_S = 2.0
"""The age at which a pane's rows are asked for again: while events happen, and while none do."""
_SHARE = 10
"""A pane waits so many times as long as its last answer took: so it keeps the system busy a tenth of the time."""
_LONGEST_S = 5.0
"""The longest such wait, in seconds: a system that hung may answer quickly again."""


class Pane(Widget, can_focus=True):
    """A list with a cursor. It knows only its visible rows.

    Args:
        look: a function that asks for the rows of a window, in a thread.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,k", "move(-1)", show=False),
        Binding("down,j", "move(1)", show=False),
        Binding("pageup", "page(-1)", show=False),
        Binding("pagedown", "page(1)", show=False),
        Binding("home", "move(-1_000_000_000)", show=False),
        Binding("end", "move(1_000_000_000)", show=False),
        Binding("enter", "open", "open"),
    ]

    class Picked(Message):
        """The cursor of a pane is on another row, or the pane shows another list."""

        def __init__(self, pane: Pane, row: Row | None) -> None:
            super().__init__()
            self.pane, self.row = pane, row

    class Opened(Message):
        """Enter was pressed on a row."""

        def __init__(self, pane: Pane, row: Row) -> None:
            super().__init__()
            self.pane, self.row = pane, row

    class Failed(Message):
        """The system did not answer; with None, it answers again."""

        def __init__(self, error: Unavailable | None) -> None:
            super().__init__()
            self.error = error

    def __init__(self, id: str, rows: Rows, look: Callable[[Rows, Window], asyncio.Future[Listed]]) -> None:
        super().__init__(id=id)
        self.match = ""
        self.rows = rows
        self._look = look
        self._listed = Listed(0, [])
        self._is_listed = False  # whether the list has been asked for its rows
        self._offset = 0  # of the first known row
        self._top = 0
        self.cursor = 0
        self._wanted = asyncio.Event()
        self._asked_at = 0.0
        self._took_s = 0.0
        self._has_failed = False

    @property
    def row(self) -> Row | None:
        """The row under the cursor; None while the pane does not know it."""
        return self._known(self.cursor)

    def show(self, rows: Rows, match: str = "", cursor: int = 0) -> None:
        """Show another list, or the same with another filter, with the cursor on row number `cursor`."""
        if (rows, match) == (self.rows, self.match):
            return
        self.rows, self.match = rows, match
        self._listed, self._is_listed, self._offset = Listed(0, []), False, 0
        self.cursor = cursor
        self._top = max(0, cursor - self._room // 2)
        self.ask()

    def ask(self) -> None:
        """Ask for the visible rows now."""
        self._wanted.set()
        self._draw()

    def ask_again(self, is_news: bool) -> None:
        """Ask for the visible rows, if the known ones are old enough."""
        age_s = _OFTEN_S if is_news else _SELDOM_S
        if time.monotonic() > self._asked_at + pause_s(self._took_s, age_s):
            self._wanted.set()

    def on_mount(self) -> None:
        """Start the worker that asks for rows."""
        self.run_worker(self._keep_asking(), group="panes")
        self.ask()

    def on_resize(self) -> None:
        """Show as many rows as there is room for."""
        self._go(self.cursor)
        self.ask()

    def on_mouse_scroll_up(self, event: events.MouseScrollUp) -> None:
        """Move the cursor up by three rows."""
        self.action_move(-3)

    def on_mouse_scroll_down(self, event: events.MouseScrollDown) -> None:
        """Move the cursor down by three rows."""
        self.action_move(3)

    def on_click(self, event: events.Click) -> None:
        """Move the cursor to the row that was clicked."""
        self._go(self._top + event.get_content_offset_capture(self).y - bool(self._listed.heads))

    def action_move(self, by: int) -> None:
        """Move the cursor by so many rows."""
        self._go(self.cursor + by)

    def action_page(self, by: int) -> None:
        """Move the cursor by a screen."""
        self._go(self.cursor + by * max(1, self._room - 1))

    def action_open(self) -> None:
        """Open the row under the cursor."""
        if (row := self.row) is not None:
            self.post_message(self.Opened(self, row))

    def _go(self, to: int) -> None:
        if not self._is_listed:  # the cursor stays where show() has put it, until there are rows
            return
        before = self.cursor, self._top
        height = max(1, self._room)
        self.cursor = max(0, min(to, self._listed.total - 1))
        top = max(min(self._top, self.cursor), self.cursor - height + 1, 0)
        self._top = min(top, max(0, self._listed.total - height))  # no empty lines below while rows above are left out
        if (self.cursor, self._top) != before:
            if self._top != before[1] or self.row is None:
                self._wanted.set()
            self._draw()
            self.post_message(self.Picked(self, self.row))

    async def _keep_asking(self) -> None:
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            if not self.size.height:
                continue
            rows, match = self.rows, self.match
            limit = min(self.size.height, c.PAGE_LIMIT)
            window = Window(match, self._top, limit, self.size.width)
            self._asked_at = time.monotonic()
            try:
                listed = await self._look(rows, window)
            except Unavailable as error:
                self._has_failed = True
                self.post_message(self.Failed(error))
                continue
            except RrError as error:
                listed = refused(error, window)
            finally:
                self._took_s = time.monotonic() - self._asked_at
            if self._has_failed:
                self._has_failed = False
                self.post_message(self.Failed(None))
            if (rows, match) == (self.rows, self.match):
                self._take(listed, window.offset)

    def _take(self, listed: Listed, offset: int) -> None:
        """Show the rows of an answer. The cursor stays on its row, if that is still visible."""
        before = self.row
        self._listed, self._is_listed, self._offset = listed, True, offset
        if before is not None and before.key and (now := self.row) is not None and now.key != before.key:
            places = [offset + at for at, row in enumerate(listed.rows) if row.key == before.key]
            self.cursor = places[0] if places else self.cursor
        self._go(self.cursor)
        if self.row != before:
            self.post_message(self.Picked(self, self.row))
        self._draw()

    @property
    def _room(self) -> int:
        """The number of rows that have room below the heads."""
        return self.size.height - bool(self._listed.heads)

    def _known(self, number: int) -> Row | None:
        at = number - self._offset
        return self._listed.rows[at] if 0 <= at < len(self._listed.rows) else None

    def _draw(self) -> None:
        parts = (
            self.rows.title,
            f"{min(self.cursor + 1, self._listed.total)}/{self._listed.total}",
            f"filter: {self.match}" if self.match else "",
            f"not asked: {self._listed.notes[0]}" if self._listed.notes else "",
        )
        self.border_title = Text(plain("  ".join(filter(None, parts))))  # Textual reads a str as markup
        self.refresh()

    def render_line(self, y: int) -> Strip:
        """Draw a line, as Textual asks for it."""
        width, heads, base = self.size.width, self._listed.heads, self.rich_style
        if heads and y == 0:
            return Strip([Segment(heads.rjust(width), base + Style(bold=True))]).adjust_cell_length(width, base)
        number = self._top + y - bool(heads)
        if number >= self._listed.total:
            return Strip.blank(width, base)
        row = self._known(number) or Row("", "…", style="dim")
        style = base + Style.parse(row.style)
        if number == self.cursor:
            style += Style(reverse=True, bold=self.has_focus)
        return drawn(row, width, style)


def pause_s(took_s: float, age_s: float = _SELDOM_S) -> float:
    """Return after how many seconds rows are asked for again if the last answer took `took_s`: `age_s` at least."""
    return max(age_s, min(_SHARE * took_s, _LONGEST_S))


def drawn(row: Row, width: int, style: Style) -> Strip:
    """Return a row as a line of the screen: its text on the left, cut if need be, and its note and columns right."""
    columns = plain(row.columns)
    width_left = width - cell_len(columns)
    note = _fitted(plain(row.note), width_left // 2)
    room = width_left - cell_len(note) - (1 if note else 0)
    text = Strip([Segment(_fitted(plain(row.text), room), style)]).adjust_cell_length(
        width_left - cell_len(note), style
    )
    return Strip([*text, Segment(note, style), Segment(columns, style)]).adjust_cell_length(width, style)


def plain(text: str) -> str:
    """Return a text in which dots replace the characters that could control a terminal."""
    return text if text.isprintable() else "".join(char if char.isprintable() else "·" for char in text)


def _fitted(text: str, width: int) -> str:
    """Return a text cut to a width in cells."""
    if cell_len(text) <= width:
        return text
    while text and (over := cell_len(text) + 1 - width) > 0:
        text = text[: -max(1, over // 2)]  # a character has two cells at most
    return f"{text}…" if width > 0 else ""
