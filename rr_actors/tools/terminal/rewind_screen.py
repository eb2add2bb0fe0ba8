"""The terminal of `rr-actors rewind`: the tree and the resources as they were, and the steps that lead there."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import ClassVar, TypeVar

from textual import on
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal
from textual.screen import ModalScreen
from textual.widgets import Footer, Input, Static

from rr_actors.base.errors import NotRunning, RrError, UsageError, counted
from rr_actors.system.console.console_view import Verb
from rr_actors.system.rewound.rewind_times import time_meant
from rr_actors.system.rewound.rewinding import Rewound
from rr_actors.tools.tables.moment_tables import caveats, change_row, child_row, headline, resource_row
from rr_actors.tools.tables.table import Asks, Row
from rr_actors.tools.terminal.terminal_pane import Pane, plain
from rr_actors.tools.terminal.terminal_rows import Listed, Nothing, Rows, Window

_A = TypeVar("_A")

_KEYS = """\
 right left   the next step; the step before. Also l and h
 down up      the same in the list of steps; page up, page down, home, end, too
 t            goes to a time: 12:46:55.020, +12.5s from the beginning, -3m
 /            goes to the next time that something came into a state:
              cameras ERROR, root/maps restarting, lens gone
 n  N         goes to the next such time; to the one before
 m            marks this step: the right pane then says what is different here
              from there; m again ends that
 Tab          the next pane
 q            leaves

 What the step has changed is bold."""


def watch(rewound: Rewound) -> None:
    """Show a recording in this terminal until its user leaves."""
    RewindScreen(rewound).run()


class _NoSystem:
    """The link of lists that ask nobody."""

    def ask(self, request: Verb[_A], timeout_s: float | None = None) -> _A:
        raise NotRunning("a recording is shown, and no system")


def _cut(rows: list[Row], window: Window) -> Listed:
    return Listed(len(rows), rows[window.offset : window.offset + window.limit])


@dataclass(frozen=True)
class StepRows:
    """The beginning and the steps of a recording."""

    rewound: Rewound = field(compare=False)

    @property
    def title(self) -> str:
        """The word "steps"."""
        return "steps"

    def list(self, link: Asks, window: Window) -> Listed:
        """Return the lines of a window, without asking."""
        steps = self.rewound.steps
        numbers = range(len(steps) + 1)[window.offset : window.offset + window.limit]
        rows = [Row(str(number), str(steps[number - 1]) if number else "the beginning") for number in numbers]
        return Listed(len(steps) + 1, rows)


@dataclass(frozen=True)
class TreeThen:
    """The tree after a step."""

    rewound: Rewound = field(compare=False)
    number: int

    @property
    def title(self) -> str:
        """The word "tree"."""
        return "tree"

    def list(self, link: Asks, window: Window) -> Listed:
        """Return the children of a window, without asking."""
        changed = changed_by(self.rewound, self.number)
        tree = self.rewound.moment(self.number).tree
        return _cut([child_row(child, child.path in changed) for child in tree], window)


@dataclass(frozen=True)
class ResourcesThen:
    """The resources after a step."""

    rewound: Rewound = field(compare=False)
    number: int

    @property
    def title(self) -> str:
        """The word "resources"."""
        return "resources"

    def list(self, link: Asks, window: Window) -> Listed:
        """Return the resources of a window, without asking."""
        changed = changed_by(self.rewound, self.number)
        listed = self.rewound.moment(self.number).listed
        return _cut([resource_row(one, one.id in changed) for one in listed], window)


@dataclass(frozen=True)
class Differences:
    """What is different after a step from what was after another one."""

    rewound: Rewound = field(compare=False)
    marked: int
    number: int

    @property
    def title(self) -> str:
        """The two steps."""
        first, last = sorted((self.marked, self.number))
        return f"different from step {first} to step {last}"

    def list(self, link: Asks, window: Window) -> Listed:
        """Return the differences of a window, without asking."""
        first, last = sorted((self.marked, self.number))
        return _cut([change_row(change) for change in self.rewound.between(first, last)], window)


def changed_by(rewound: Rewound, number: int) -> set[str]:
    """Return the ids of what a step has changed."""
    return {change.id for change in rewound.steps[number - 1].changes} if number else set()


class RewindKeys(ModalScreen[None]):
    """The help: what each key does. Any of Esc, ?, q closes it."""

    CSS = "RewindKeys { align: center middle; } #keys { width: 80; height: auto; border: round $accent; }"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,question_mark,q", "dismiss", "back", key_display="esc")]

    def compose(self) -> ComposeResult:
        """Put the text on the screen."""
        yield Static(_KEYS, id="keys", markup=False)


class RewindScreen(App[None]):
    """The application of `rr-actors rewind`.

    Attributes:
        left, right, steps: the panes: the tree, the resources or what is different, the steps.
    """

    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { layout: vertical; }
    #title { height: 1; text-style: bold; }
    #panes { height: 1fr; }
    Pane { border-top: solid $foreground 40%; height: 100%; }
    Pane:focus { border-top: heavy $accent; }
    #tree { width: 2fr; margin-right: 1; }
    #right { width: 3fr; }
    #steps { height: 35%; }
    #field { height: 1; border: none; padding: 0; display: none; }
    #status { height: auto; max-height: 3; }
    #status.bad { color: $text-error; text-style: bold; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left,h", "step(-1)", "back", key_display="←"),
        Binding("right,l", "step(1)", "forward", key_display="→"),
        Binding("t", "type('time')", "time"),
        Binding("slash", "type('when')", "when", key_display="/"),
        Binding("n", "again(1)", show=False),
        Binding("N", "again(-1)", show=False),
        Binding("m", "mark", "mark"),
        Binding("escape", "leave", show=False),
        Binding("question_mark", "help", "help", key_display="?"),
        Binding("q", "quit", "quit"),
    ]

    def __init__(self, rewound: Rewound) -> None:
        super().__init__()
        self.animation_level = "none"
        self.rewound = rewound
        self.left = Pane("tree", Nothing(), self._look)
        self.right = Pane("right", Nothing(), self._look)
        self.steps = Pane("steps", Nothing(), self._look)
        self._number = len(rewound)
        self._marked: int | None = None
        self._typed = ""  # what the field is for
        self._when = ""
        self._title = Static(id="title", markup=False)
        self._field = Input(id="field")
        self._status_line = Static(id="status", markup=False)
        self.status = ""

    def compose(self) -> ComposeResult:
        """Put the panes on the screen."""
        yield self._title
        with Horizontal(id="panes"):
            yield self.left
            yield self.right
        yield self.steps
        yield self._field
        yield self._status_line
        yield Footer(show_command_palette=False, compact=True)

    def on_mount(self) -> None:
        """Show the last step."""
        self.steps.show(StepRows(self.rewound), cursor=self._number)
        self.steps.focus()
        self._show(self._number)
        said = [f"{counted(len(self.rewound), 'step')}: arrows step back and forward", *caveats(self.rewound)]
        self._say("; ".join(said))

    def _look(self, rows: Rows, window: Window) -> asyncio.Future[Listed]:
        answer: asyncio.Future[Listed] = asyncio.get_running_loop().create_future()
        answer.set_result(rows.list(_NoSystem(), window))
        return answer

    def _say(self, text: str, bad: bool = False) -> None:
        self.status = text
        self._status_line.update(plain(text))
        self._status_line.set_class(bad, "bad")

    def _show(self, number: int) -> None:
        """Show the moment after so many steps."""
        self._number = number
        self._title.update(plain(headline(self.rewound, number)))
        self.left.show(TreeThen(self.rewound, number), cursor=self.left.cursor)
        there = ResourcesThen(self.rewound, number)
        if self._marked is not None:
            there = Differences(self.rewound, self._marked, number)
        self.right.show(there, cursor=self.right.cursor)

    @on(Pane.Picked)
    def _choose(self, message: Pane.Picked) -> None:
        if message.pane is self.steps and self.steps.cursor != self._number:
            self._show(self.steps.cursor)

    def _go(self, number: int) -> None:
        self.steps.action_move(number - self.steps.cursor)
        self._show(number)

    def action_step(self, by: int) -> None:
        """Go by so many steps."""
        self._go(min(max(self._number + by, 0), len(self.rewound)))

    def action_mark(self) -> None:
        """Mark this step, or take the mark away."""
        self._marked = self._number if self._marked is None else None
        marked = f"step {self._marked} is marked: the right pane says what is different from there"
        self._say("the mark is taken away" if self._marked is None else marked)
        self._show(self._number)

    def action_help(self) -> None:
        """Show what each key does."""
        self.push_screen(RewindKeys())

    def action_type(self, what: str) -> None:
        """Have a time or a state typed."""
        self._typed = what
        times = "a time: 12:46:55.020, +12.5s, -3m, start, end; Enter goes there"
        self._field.placeholder = times if what == "time" else "a name and a state: cameras ERROR; Enter goes there"
        self._field.value = ""
        self._field.display = True
        self.screen.set_focus(self._field)

    def action_leave(self) -> None:
        """Put away the field, or take the mark away."""
        if self._typed:
            self._close_field()
        elif self._marked is not None:
            self.action_mark()

    def _close_field(self) -> None:
        self._typed = ""
        self._field.display = False
        self.screen.set_focus(self.steps)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Return whether the key of an action acts now: where something is typed, keys are characters."""
        return not self._typed or action not in ("type", "mark", "again", "step", "help", "quit")

    @on(Input.Submitted, "#field")
    def _enter(self, message: Input.Submitted) -> None:
        typed, text = self._typed, message.value.strip()
        self._close_field()
        if typed == "when":
            self._when = text
            self.action_again(1)
            return
        try:
            at = time_meant(text, self.rewound.since, self.rewound.until, "time")
        except UsageError as error:
            self._say(str(error), bad=True)
        else:
            self._go(self.rewound.number_at(at))

    def action_again(self, way: int) -> None:
        """Go to the next step, or with -1 to the one before, at which something came into the state that was typed."""
        name, _, state = self._when.rpartition(" ")
        if not name:
            self._say("/ asks for a name and a state, such as: cameras ERROR", bad=True)
            return
        try:
            found = self.rewound.when(name.strip(), state)
        except RrError as error:
            self._say(str(error).removeprefix("--when: "), bad=True)
            return
        ahead = [(step, one) for step, one in found if (step.number - self._number) * way > 0]
        if not ahead:
            self._say(
                f"{self._when}: {counted(len(found), 'time')}, none {'later' if way > 0 else 'earlier'}", bad=True
            )
            return
        step, change = ahead[0 if way > 0 else -1]
        self._go(step.number)
        self._say(f"{change.name} became {change.after or 'gone'}  {change.why}".rstrip())
