"""The live terminal: panes with the tree, the chosen child or registrar, and events; and keys that drive the system.

Textual's loop draws and reads keys. Calls that wait for the system run in threads. Each pane asks for the rows that it
shows, one question at a time; the slower the system answers, the less often.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar, TypeVar

from rich.cells import cell_len
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import events, on
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal
from textual.message import Message
from textual.screen import ModalScreen
from textual.strip import Strip
from textual.widget import Widget
from textual.widgets import Footer, Input, Static

from rr_actors.base.errors import RrError, Unavailable, UsageError
from rr_actors.base.names import short_id
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_client import NotRunning
from rr_actors.system.console.console_questions import ListHistory
from rr_actors.system.console.console_view import Command
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.terminal.event_lines import EventLines, event_of, missed_line
from rr_actors.tools.terminal.terminal_rows import (
    Happenings,
    Listed,
    Neighbours,
    Nothing,
    Past,
    Row,
    Rows,
    Served,
    Window,
    refused,
)
from rr_actors.tools.terminal.terminal_tables import AllLoads, AllResources, AllStreams, TreeTable

_T = TypeVar("_T")
_THREADS = 16  # for the panes, the feed, and commands that wait
_LOOK_S = 0.2
"""The interval at which the screen looks for news."""
_OFTEN_S = 0.5
_SELDOM_S = 2.0
"""The age at which a pane's rows are asked for again: while events happen, and while none do."""
_SHARE = 10
"""A pane waits so many times as long as its last answer took: so it keeps the system busy a tenth of the time."""
_LONGEST_S = 5.0
"""The longest such wait, in seconds: a system that hung may answer quickly again."""
_AGAIN_S = 0.5


def watch(state_dir: str | os.PathLike[str] | None = None) -> None:
    """Show a running system in this terminal until its user leaves.

    Raises:
        NotRunning: no system runs in the directory, or none at all.
        UsageError: several systems run, and no state directory was given; or this process has no terminal.
    """
    if not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise UsageError("top: expected a terminal, got none: rr-actors ps, events and resources need no terminal")
    Terminal(ConsoleLink(state_dir)).run()


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
        self._listed, self._offset = Listed(0, []), 0
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
        if time.monotonic() > self._asked_at + max(age_s, min(_SHARE * self._took_s, _LONGEST_S)):
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
        before = self.cursor, self._top
        height = max(1, self._room)
        self.cursor = max(0, min(to, self._listed.total - 1))
        self._top = max(min(self._top, self.cursor), self.cursor - height + 1, 0)
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
        self._listed, self._offset = listed, offset
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
        self.border_title = Text(_plain("  ".join(filter(None, parts))))  # Textual reads a str as markup
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
        columns = _plain(row.columns)
        width_left = width - cell_len(columns)
        note = _fitted(_plain(row.note), width_left // 2)
        room = width_left - cell_len(note) - (1 if note else 0)
        text = Strip([Segment(_fitted(_plain(row.text), room), style)]).adjust_cell_length(
            width_left - cell_len(note), style
        )
        return Strip([*text, Segment(note, style), Segment(columns, style)]).adjust_cell_length(width, style)


_KEYS = """\
 1 to 5      the tree; resources; the events alone; streams; loads
 z           the pane alone, and back
 s           sorts the left list by the next column, the most first
 arrows j k  move; page up, page down, home and end, too
 Tab  Enter  the next pane; open: holders, parts
 Esc         back: ends a filter, a list that was opened, a pane alone
 /           filters the pane as you type; Enter keeps the filter
             in the events also event:KIND, child:ID and server:NAME

 K           kills the chosen child, after a question: y is yes
 t  r        stops the chosen child; starts it again
 u  p        unloads the query of the chosen row; gives it a priority
 U           takes the chosen resource away from all its holders
 R           revokes the chosen resource: y is yes
 q           leaves

 CPU is that since the last look. Of several children in one process the first
 one has it. Columns appear where there is room for them: z makes room."""


_NUMBER = "a priority from -1000 to 1000, or standby; Enter gives it, Esc leaves it"


class Keys(ModalScreen[None]):
    """The help: what each key does. Any of Esc, ?, q closes it."""

    CSS = "Keys { align: center middle; } #keys { width: 80; height: auto; border: round $accent; }"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,question_mark,q", "dismiss", "back", key_display="esc")]

    def compose(self) -> ComposeResult:
        """Put the text on the screen."""
        yield Static(_KEYS, id="keys", markup=False)


class Terminal(App[None]):
    """The application of `rr-actors top`.

    Args:
        link: the link to the system; it is closed at the end.

    Attributes:
        left, right, events: the panes: the tree, the thing that is chosen in it, the events.
    """

    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; }
    #title { height: 1; text-style: bold; }
    #panes { height: 1fr; }
    Pane { border-top: solid $foreground 40%; height: 100%; }
    Pane:focus { border-top: heavy $accent; }
    #tree { width: 2fr; margin-right: 1; }
    #chosen { width: 3fr; }
    #events { height: 25%; }
    #events.alone { height: 1fr; }
    #tree.alone { margin-right: 0; }
    #filter, #priority { height: 1; border: none; padding: 0; display: none; }
    #status { height: auto; max-height: 3; }
    #status.bad { color: $text-error; text-style: bold; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("K", "kill", "kill"),
        Binding("y", "confirm", show=False),
        Binding("t", "terminate", "stop"),
        Binding("r", "restart", "restart"),
        Binding("u", "unload", "unload"),
        Binding("U", "take_away", "all"),
        Binding("R", "revoke", show=False),
        Binding("p", "give_priority", show=False),
        Binding(
            "slash", "filter", "filter", key_display="/", priority=True
        ),  # the characters typed after it are never commands
        Binding("escape", "leave", "back", key_display="esc"),
        Binding("1", "list_tree", show=False),
        Binding("2", "list_resources", show=False),
        Binding("3", "show_events", show=False),
        Binding("4", "list_streams", show=False),
        Binding("5", "list_loads", show=False),
        Binding("z", "zoom", show=False),
        Binding("s", "sort", show=False),
        Binding("question_mark", "help", "help", key_display="?"),
        Binding("q", "quit", "quit"),
    ]

    class Found(Message):
        """The system was reached."""

        def __init__(self, welcome: c.Welcome) -> None:
            super().__init__()
            self.welcome = welcome

    def __init__(self, link: ConsoleLink) -> None:
        super().__init__()
        self.animation_level = "none"
        self._link = link
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="rr-actors-top")
        self._happened = EventLines()
        # Kept, not looked up on the screen: an answer may arrive when the user leaves and the screen is empty.
        self._tree, self._resources = TreeTable(), AllResources()  # sorted as last
        self._streams, self._loads = AllStreams(), AllLoads()
        self.left = Pane("tree", self._tree, self._look)
        self.right = Pane("chosen", Nothing(), self._look)
        self.events = Pane("events", Happenings(self._happened), self._look)
        self._sides = Horizontal(id="panes")
        self._alone: Pane | None = None
        self._headline = Static(id="title", markup=False)
        self._field = Input(id="filter", placeholder="only rows with this text; Enter keeps the filter, Esc ends it")
        self._number = Input(id="priority", placeholder=_NUMBER)
        self._status_line = Static(id="status", markup=False)
        self._heard = 0
        self._shown = 0
        self._said = ""
        self._is_bad = False
        self._question = ""
        self._asked: tuple[str, Command[c.Done]] = "", commands.Kill("")  # what the question is about
        self._declined = ""  # what is said after a no
        self._lost = ""
        self._silence = ""
        self._welcome: c.Welcome | None = None
        self._filtered: Pane | None = None
        self._needy: tuple[Pane, str] | None = None  # the query whose priority is being typed, and its pane
        self._before: list[tuple[Rows, str, int]] = []  # lists shown before, with filter and cursor

    # -- the screen --------------------------------------------------------------------------------------------------

    def compose(self) -> ComposeResult:
        """Put the panes on the screen."""
        yield self._headline
        with self._sides:
            yield self.left
            yield self.right
        yield self.events
        yield self._field
        yield self._number
        yield self._status_line
        yield Footer(show_command_palette=False, compact=True)

    @property
    def status(self) -> str:
        """The text of the status line."""
        return self._lost or self._said

    def on_mount(self) -> None:
        """Start to follow the system, and to look for news."""
        self.left.focus()
        self.run_worker(self._follow(), group="feed")
        self.set_interval(_LOOK_S, self._look_again)

    async def on_unmount(self) -> None:
        """Close the connections, which ends the calls that wait in threads."""
        self._link.close()
        await asyncio.to_thread(self._threads.shutdown)

    def _say(self, text: str, bad: bool = False) -> None:
        self._said, self._is_bad = f"{time.strftime('%H:%M:%S')} {text}", bad
        self._show_status()

    def _show_status(self) -> None:
        self._status_line.update(_plain(self.status))
        self._status_line.set_class(bool(self._lost) or self._is_bad, "bad")

    def _look_again(self) -> None:
        is_news = self._heard != self._shown
        if is_news:
            self._shown = self._heard
            self.events.ask()
        if not self._lost:
            self.left.ask_again(is_news)
            self.right.ask_again(is_news)

    # -- what is shown -----------------------------------------------------------------------------------------------

    @on(Pane.Picked)
    def _choose(self, message: Pane.Picked) -> None:
        row = message.row
        if message.pane is not self.left or row is None or row != self.left.row:
            return
        if row.child is not None:
            self._show(Past(row.child.path))
        elif row.registrar:
            self._show(Served(row.registrar))
        elif row.resource:
            self._show(Neighbours(row.resource, row.name))

    def _show(self, rows: Rows) -> None:
        """Show the thing under the left cursor, unless it or a list opened from it is shown already."""
        if rows not in (self.right.rows, *(before[0] for before in self._before)):
            self._before.clear()
            self.right.show(rows)

    @on(Pane.Opened)
    def _open(self, message: Pane.Opened) -> None:
        if message.pane is self.left:
            self._give_screen_to(None)
            self.screen.set_focus(self.right)
        elif message.row.resource:
            self._before.append((self.right.rows, self.right.match, self.right.cursor))
            self.right.show(Neighbours(message.row.resource, message.row.name))

    def action_list_tree(self) -> None:
        """Show the tree on the left."""
        self._list(self._tree)

    def action_list_resources(self) -> None:
        """Show all resources on the left."""
        self._list(self._resources)

    def action_list_streams(self) -> None:
        """Show all streams on the left."""
        self._list(self._streams)

    def action_list_loads(self) -> None:
        """Show on the left the loads that wait, and how long those of each server did."""
        self._list(self._loads)

    def _list(self, rows: TreeTable | AllResources | AllStreams | AllLoads) -> None:
        if self._alone is not self.left:
            self._give_screen_to(None)
        self.left.show(rows)
        self.screen.set_focus(self.left)

    def action_sort(self) -> None:
        """Sort the list on the left by its next column."""
        rows = self.left.rows
        if isinstance(rows, TreeTable):
            self._tree = rows = rows.by_next()
        elif isinstance(rows, AllResources):
            self._resources = rows = rows.by_next()
        elif isinstance(rows, AllStreams):
            self._streams = rows = rows.by_next()
        elif isinstance(rows, AllLoads):
            self._loads = rows = rows.by_next()
        self.left.show(rows, self.left.match)

    def action_show_events(self) -> None:
        """Give the whole screen to the events."""
        self._give_screen_to(self.events)
        self.screen.set_focus(self.events)

    def action_zoom(self) -> None:
        """Give the whole screen to the pane that has the focus, or end that."""
        self._give_screen_to(None if self._alone is not None else self._focused_pane())

    def _give_screen_to(self, alone: Pane | None) -> None:
        self._alone = alone
        for pane in (self.left, self.right, self.events):
            pane.display = alone in (None, pane)
            pane.set_class(pane is alone, "alone")
        self._sides.display = alone is not self.events

    def action_help(self) -> None:
        """Show what each key does."""
        self.push_screen(Keys())

    def action_leave(self) -> None:
        """Go back: answer a question with no, or leave the filter, the opened list or the pane alone, or go left."""
        if self._question and self._question == self.status:
            self._say(self._declined)
            return
        if self._needy is not None:
            self._close_number()
            self._say("the priority stays as it was")
            return
        pane = self._focused_pane()
        if self._filtered is not None:
            self._close_filter()
        if pane.match:
            pane.show(pane.rows)
        elif pane is self.right and self._before:
            self.right.show(*self._before.pop())
        elif self._alone is not None:
            self._give_screen_to(None)
        else:
            self.screen.set_focus(self.left)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Return whether the key of an action acts now: where something is typed, `/` is a character."""
        return action != "filter" or (self._filtered is None and self._needy is None)

    def action_filter(self) -> None:
        """Filter the pane that has the focus."""
        self._filtered = self._focused_pane()
        self._field.value = self._filtered.match
        self._field.display = True
        self.screen.set_focus(self._field)  # at once, as Widget.focus() does not

    @on(Input.Changed, "#filter")
    def _filter(self, message: Input.Changed) -> None:
        if self._filtered is not None:
            self._filtered.show(self._filtered.rows, message.value[:200])

    @on(Input.Submitted, "#filter")
    def _keep_filter(self) -> None:
        self._close_filter()

    def _close_filter(self) -> None:
        pane, self._filtered = self._filtered, None
        self.screen.set_focus(pane or self.left)
        self._field.display = False

    def _focused_pane(self) -> Pane:
        if self._filtered is not None:
            return self._filtered
        return next((pane for pane in (self.right, self.events) if pane.has_focus), self.left)

    # -- what is done ------------------------------------------------------------------------------------------------

    def action_kill(self) -> None:
        """Ask whether to kill the process of the chosen child."""
        if (path := self._chosen_child("kill")) is not None:
            self._ask_first(f"kill {path}", commands.Kill(path), f"{path} was not killed")

    def _ask_first(self, what: str, command: Command[c.Done], declined: str) -> None:
        self._say(f"{what}? y: yes, Esc: no")
        self._asked, self._declined, self._question = (what, command), declined, self._said

    def action_confirm(self) -> None:
        """Do what the status line asks about; do nothing if the status line shows no question."""
        if self._question and self._question == self.status:
            self._question = ""
            self._begin(*self._asked)

    def action_terminate(self) -> None:
        """Stop the chosen child."""
        self._to_child("terminate", commands.Terminate)

    def action_restart(self) -> None:
        """Start the chosen child again."""
        self._to_child("restart", commands.Restart)

    def _to_child(self, verb: str, command: Callable[[str], Command[c.Done]]) -> None:
        if (path := self._chosen_child(verb)) is not None:
            self._begin(f"{verb} {path}", command(path))

    def _chosen_child(self, verb: str) -> str | None:
        row = self.left.row
        if row is None or row.child is None:
            self._say(f"{verb}: choose a child in the tree", bad=True)
            return None
        return row.child.path

    def action_unload(self) -> None:
        """Release the query of the chosen row."""
        if query := self._chosen_query("unload", "; U takes it away from all"):
            self._begin(f"unload query {short_id(query)}", commands.Unload(query))

    def _chosen_query(self, verb: str, instead: str = "") -> str:
        """Return the query of the chosen row, or "", and say that it has none."""
        row = self._focused_pane().row
        if row is None or not (row.query or row.resource):
            self._say(f"{verb}: choose a resource or a holder on the right (Tab goes there)", bad=True)
            return ""
        if not row.query:
            self._say(f"{verb}: it has not one holder: Enter shows them{instead}", bad=True)
        return row.query

    def action_give_priority(self) -> None:
        """Have a priority typed for the query of the chosen row."""
        if query := self._chosen_query("priority"):
            self._needy = self._focused_pane(), query
            self._number.value = ""
            self._number.display = True
            self.screen.set_focus(self._number)

    @on(Input.Submitted, "#priority")
    def _give_priority(self, message: Input.Submitted) -> None:
        query = self._close_number()
        try:
            priority = commands.priority_from("priority", message.value)
        except UsageError as error:
            self._say(str(error), bad=True)
        else:
            self._begin(f"priority of query {short_id(query)}", commands.GivePriority(query, priority))

    def _close_number(self) -> str:
        """Put away the field for a priority, and return the query whose it is."""
        (pane, query), self._needy = self._needy or (self.left, ""), None
        self.screen.set_focus(pane)
        self._number.display = False
        return query

    def action_take_away(self) -> None:
        """Take the chosen resource away from all its holders."""
        if (chosen := self._chosen_resource("unload from all")) is not None:
            id, name = chosen
            self._begin(f"unload {name} from all", commands.Unload(id, force=True))

    def action_revoke(self) -> None:
        """Ask whether to revoke the chosen resource."""
        if (chosen := self._chosen_resource("revoke")) is not None:
            id, name = chosen
            self._ask_first(f"revoke {name}", commands.Revoke(id, "revoked in top"), f"{name} was not revoked")

    def _chosen_resource(self, verb: str) -> tuple[str, str] | None:
        """Return the id and the name of the chosen resource, or say that none is chosen."""
        row, shown = self._focused_pane().row, self._focused_pane().rows
        id = shown.id if isinstance(shown, Neighbours) else row.resource if row and row.key == row.resource else ""
        if row is None or not id:
            self._say(f"{verb}: choose a resource on the right (Tab goes there)", bad=True)
            return None
        return id, (shown.name if isinstance(shown, Neighbours) else row.name) or short_id(id)

    def _begin(self, what: str, command: Command[c.Done]) -> None:
        self._say(f"{what} …")
        self.run_worker(self._carry_out(what, command), group="commands")

    async def _carry_out(self, what: str, command: Command[c.Done]) -> None:
        try:
            done = await self._in_thread(self._link.ask, command)
        except RrError as error:
            self._say(f"{what}: {error}", bad=True)
        else:
            self._say(done.text)
        self.left.ask()
        self.right.ask()

    # -- the system --------------------------------------------------------------------------------------------------

    def _in_thread(self, function: Callable[..., _T], *args: object) -> asyncio.Future[_T]:
        return asyncio.get_running_loop().run_in_executor(self._threads, function, *args)

    def _look(self, rows: Rows, window: Window) -> asyncio.Future[Listed]:
        return self._in_thread(rows.list, self._link, window)

    async def _follow(self) -> None:
        """Take the system's events, and when the system ends, look for it until it runs again."""
        while True:
            problem = await self._in_thread(self._link.follow, self._reached, self._hear)
            self._lose(f"{problem}: waiting for it; q leaves")
            await asyncio.sleep(_AGAIN_S)

    def _lose(self, problem: str) -> None:
        if not self._lost:
            self._lost = problem
            self._happened.note(problem, time.time())
            self._heard += 1
            self._show_status()

    def _reached(self, welcome: c.Welcome) -> None:
        """Post the message that the system was reached, and take what has happened before. In a thread."""
        if self._welcome is None:
            with contextlib.suppress(RrError):
                for record in self._link.ask(ListHistory(), _LOOK_S * _SHARE).records:
                    self._happened.take(event_of(record))
                self._heard += 1
        self.post_message(self.Found(welcome))

    def _hear(self, part: c.Events | c.Missed) -> None:
        """Keep the lines of events, for which the screen looks when it can. In a thread."""
        if isinstance(part, c.Missed):
            self._happened.note(missed_line(part), time.time())
        else:
            for event in part.events:
                self._happened.take(event)
        self._heard += 1

    @on(Found)
    def _find(self, message: Found) -> None:
        welcome, before = message.welcome, self._welcome
        self._welcome = welcome
        self._lost = ""
        if before is None:
            self._say(f"system {welcome.system}: Tab changes the pane, Enter opens, Esc goes back")
        elif (before.pid, before.since) != (welcome.pid, welcome.since):
            self._say(f"system {welcome.system} was started again: pid {welcome.pid}")
        else:
            self._say(f"system {welcome.system} is reached again")
        self._headline.update(_plain(f"rr-actors top  system {welcome.system}  pid {welcome.pid}  {welcome.state_dir}"))
        self.left.ask()
        self.right.ask()

    @on(Pane.Failed)
    def _fail(self, message: Pane.Failed) -> None:
        error = message.error
        if self._lost or isinstance(error, NotRunning):  # the feed notices that, too, and reports it
            return
        if error is not None:
            self._silence = str(error)
            self._say(self._silence, bad=True)
        elif self._silence and self._said.endswith(self._silence):
            self._silence = ""
            self._say("the system answers again")


def _plain(text: str) -> str:
    """Return a text in which dots replace the characters that could control a terminal."""
    return text if text.isprintable() else "".join(char if char.isprintable() else "·" for char in text)


def _fitted(text: str, width: int) -> str:
    """Return a text cut to a width in cells."""
    if cell_len(text) <= width:
        return text
    while text and (over := cell_len(text) + 1 - width) > 0:
        text = text[: -max(1, over // 2)]  # a character has two cells at most
    return f"{text}…" if width > 0 else ""
