"""The live terminal: what needs attention, panes with the tree, the chosen thing and events, and keys that act.

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

from textual import on
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal
from textual.message import Message
from textual.screen import ModalScreen
from textual.widgets import Footer, Input, Static

from rr_actors.base.errors import RrError, UsageError
from rr_actors.base.names import short_id
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.attention.attention_questions import ListAttention
from rr_actors.system.console.console_connection import NotRunning
from rr_actors.system.console.console_questions import ListEvents
from rr_actors.system.console.console_view import Command
from rr_actors.tools.tables.row_commands import (
    CHILD_COMMANDS,
    KEYS,
    RESOURCE_COMMANDS,
    ROW_COMMANDS,
    RowCommand,
    no_query,
)
from rr_actors.tools.tables.sheets import SHEETS
from rr_actors.tools.tables.table import Row, tables_of
from rr_actors.tools.terminal.attention_lines import AttentionLines
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.terminal.event_lines import EventLines, missed_line
from rr_actors.tools.terminal.terminal_pane import Pane, plain
from rr_actors.tools.terminal.terminal_rows import (
    LOOK_S,
    Happenings,
    Listed,
    Neighbours,
    Nothing,
    Past,
    Rows,
    Served,
    Window,
)
from rr_actors.tools.terminal.terminal_tables import SheetRows

_T = TypeVar("_T")
_THREADS = 16  # for the panes, the feed, and commands that wait
_LOOK_S = 0.2
"""The interval at which the screen looks for news."""
_WELCOME_S = 2.0  # for the events that have happened before
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


_KEYS = """\
 1 to 5      the tree; resources; the events alone; streams; loads
 z           the pane alone, and back
 s           sorts the left list by the next column, the most first
 arrows j k  move; page up, page down, home and end, too
 Tab  Enter  the next pane; open: holders, parts
 Esc         back: ends a filter, a list that was opened, a pane alone
 /           filters the pane as you type; Enter keeps the filter
             in the events also event:KIND, child:ID and server:NAME

 K  t        kills the chosen child; stops it; each after a question: y is yes
 r           restarts the chosen child, or starts it if it is stopped
 u  p        unloads the query of the chosen row; gives it a priority
 U  R  l     takes the chosen resource away from all its holders; revokes it;
             reloads it; each after a question
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
        attention: the lines above them, with what needs attention.
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
        Binding("y", "confirm", show=False),
        *(Binding(key, f"do('{key}')", label, show=bool(label)) for key, label in KEYS.items()),
        Binding("p", "give_priority", show=False),
        Binding(
            "slash", "filter", "filter", key_display="/", priority=True
        ),  # the characters typed after it are never commands
        Binding("escape", "leave", "back", key_display="esc"),
        *(Binding(sheet.key, f"list('{sheet.key}')", show=False) for sheet in SHEETS),
        Binding("3", "show_events", show=False),
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
        self._sheets = {sheet.key: SheetRows(sheet, tables_of(sheet.module())) for sheet in SHEETS}  # sorted as last
        self.left = Pane("tree", next(iter(self._sheets.values())), self._look)
        self.right = Pane("chosen", Nothing(), self._look)
        self.events = Pane("events", Happenings(self._happened), self._look)
        self.attention = AttentionLines(lambda: self._in_thread(self._link.ask, ListAttention(), LOOK_S))
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
        yield self.attention
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
        self._status_line.update(plain(self.status))
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

    def action_list(self, key: str) -> None:
        """Show the sheet of this key on the left."""
        if self._alone is not self.left:
            self._give_screen_to(None)
        self.left.show(self._sheets[key])
        self.screen.set_focus(self.left)

    def action_sort(self) -> None:
        """Sort the list on the left by its next column."""
        rows = self.left.rows
        if isinstance(rows, SheetRows):
            self._sheets[rows.sheet.key] = rows = rows.by_next()
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

    def action_do(self, key: str) -> None:
        """Do what the key does to the chosen thing, or ask whether to, or say why it cannot be done."""
        several = [one for one in ROW_COMMANDS if one.key == key]
        row = self._chosen(several[0])
        one = next((one for one in several if not one.obstacle(row)), None)
        if one is None:
            self._say(f"{several[0].label or several[0].name}: {several[0].obstacle(row)}", bad=True)
        elif one.warning:
            self._put_question(one, row)
        else:
            self._begin(one.said_of(row), one.command(row))

    def _put_question(self, one: RowCommand, row: Row) -> None:
        """Ask whether to do something, and add what would happen as soon as the system says it."""
        self._say(f"{one.said_of(row)}? y: yes, Esc: no. {one.warning}")
        self._asked, self._declined = (one.said_of(row), one.command(row)), f"not done: {one.said_of(row)}"
        self._question = self._said
        self.run_worker(self._foretell(self._question, one.dry_run(row)), group="commands")

    async def _foretell(self, question: str, command: Command[c.Done]) -> None:
        with contextlib.suppress(RrError):  # the command itself will say it
            would = (await self._in_thread(self._link.ask, command, LOOK_S)).text
            if self._question == question == self.status:
                self._question = self._said = f"{question} It {would}."
                self._show_status()

    def _chosen(self, command: RowCommand) -> Row:
        """Return the row that a command is for: a child in the tree, or what is chosen in the pane with the focus."""
        pane = self.left if command in CHILD_COMMANDS else self._focused_pane()
        if isinstance(pane.rows, Neighbours) and command in RESOURCE_COMMANDS:
            return Row(pane.rows.id, "", resource=pane.rows.id, name=pane.rows.name)
        return pane.row or Row("", "")

    def action_confirm(self) -> None:
        """Do what the status line asks about; do nothing if the status line shows no question."""
        if self._question and self._question == self.status:
            self._question = ""
            self._begin(*self._asked)

    def action_give_priority(self) -> None:
        """Have a priority typed for the query of the chosen row."""
        row = self._focused_pane().row or Row("", "")
        if why := no_query(row):
            self._say(f"priority: {why.partition(';')[0]}", bad=True)
            return
        self._needy = self._focused_pane(), row.query
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
                for event in self._link.ask(ListEvents(), _WELCOME_S).events:
                    self._happened.take(event)
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
        self._headline.update(plain(f"rr-actors top  system {welcome.system}  pid {welcome.pid}  {welcome.state_dir}"))
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
