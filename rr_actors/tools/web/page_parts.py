"""The parts of all pages about a running system: the bar, the status, the events, the slider, and a panel of rows.

A page does not wait for the system while it is drawn. It shows a new moment of the Watch at once, and all else five
times a second. A browser that is slower gets the newest state when it has taken the last one: nothing queues up for it.
When its reader chooses something, a thread asks the system for it.
"""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
import base64
import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial

from nicegui import ui

from rr_actors.base.errors import RrError, UsageError
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_view import Command
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.tables.row_commands import QUERY_COMMANDS, RowCommand
from rr_actors.tools.tables.table import Row
from rr_actors.tools.terminal.event_lines import EventFilter
from rr_actors.tools.terminal.terminal_rows import Rows, Window, refused
from rr_actors.tools.web import tree_picture
from rr_actors.tools.web.watch import Moment, Watch

_MOMENT_S = 0.05
_LOOK_S = 0.2
"""The time between two looks for a new moment, which cost next to nothing, and for all news."""
_TAKEN_S = 10.0
"""How long a browser may take for what it was sent, before the page sends it more all the same."""
_LINES = 200  # events: the newest are in sight, and the others are scrolled to
_ROWS = 300  # of the panel
_WIDTH = 110

CSS = (
    tree_picture.CSS
    + """\
.nicegui-content { padding: 0; gap: 0; }
body { --q-primary: light-dark(#1565c0, #7db9f5) !important; --q-negative: #b71c1c !important;
  --q-positive: #1b6e2a !important; --q-warning: #8a5300 !important; }
.q-loading-bar { display: none; }
.rr-page { width: 100%; padding: 8px 14px; gap: 10px; }
.rr-bar { width: 100%; background: #263238; color: #fff; padding: 6px 14px; align-items: center; gap: 18px; }
.rr-bar a { color: #cfd8dc; } .rr-bar a.rr-here { color: #fff; font-weight: 700; text-decoration: underline; }
.rr-status { margin-left: auto; font-size: 13px; } .rr-status.rr-bad { color: #ffccbc; font-weight: 700; }
.rr-panel { border: 1px solid var(--rr-edge); border-radius: 8px; padding: 8px 12px; overflow: auto; min-width: 0; }
.rr-split { display: flex; width: 100%; gap: 16px; align-items: stretch; } .rr-split > .rr-panel { max-height: 62vh; }
.rr-holds-tree { container-type: inline-size; }
@media (max-width: 900px) { .rr-split { flex-direction: column; } .rr-split > .rr-panel { flex: none !important; } }
@media (prefers-color-scheme: dark) {
  .rr-graph canvas, .rr-sequence svg, .rr-actions svg { filter: invert(1) hue-rotate(180deg); } }
.rr-events-box { display: flex; flex-direction: column-reverse; max-height: 17em; overflow-y: auto; }
.rr-row-bad .ag-cell { color: var(--rr-bad); } .rr-row-warm .ag-cell { color: var(--rr-amber); }
.rr-rows, .rr-events { font: 12px/1.45 monospace; white-space: pre-wrap; overflow-wrap: anywhere; width: 100%; }
.rr-line { display: flex; flex-wrap: wrap; gap: 2px 10px; align-items: baseline; }
.rr-line.rr-red, .rr-harmful { color: var(--rr-bad); }
.rr-line.rr-bold { font-weight: 700; } .rr-line.rr-dim { color: var(--rr-dim); }
.rr-line.rr-yellow { color: var(--rr-amber); }
.rr-line .q-btn { flex: none; white-space: nowrap; overflow-wrap: normal; }
.rr-rows > .q-btn { max-width: 100%; text-align: left; } .rr-rows > .q-btn .q-btn__content { text-align: left;
  justify-content: flex-start; }
.rr-note { color: var(--rr-dim); } .rr-line .rr-note { overflow-wrap: break-word; }
.rr-pictures img { max-width: 100%; border-radius: 4px; }
.rr-figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 380px), 1fr)); gap: 10px 22px; }
.rr-figures section { min-width: 0; } .rr-figures h2 { font: 600 13px/1.6 sans-serif; margin: 0;
  overflow-wrap: anywhere; }
.rr-figures div { display: grid; grid-template-columns: 5.5em 1fr 5.5em; gap: 8px; align-items: center;
  font-size: 12px; color: var(--rr-fact); }
.rr-figures b { text-align: right; color: var(--rr-text); }
.rr-figures svg { width: 100%; height: 26px; background: var(--rr-unknown-paper); margin: 1px 0; border-radius: 3px; }
.rr-figures path { fill: none; stroke: var(--rr-focus); stroke-width: 1.5; vector-effect: non-scaling-stroke; }
.rr-loads { width: 100%; border-collapse: collapse; font-size: 13px; }
.rr-loads caption { text-align: left; font-weight: 700; padding: 2px 0 6px; }
.rr-loads th button { background: none; border: none; padding: 0; font: inherit; color: inherit; cursor: pointer;
  text-decoration: underline dotted; }
.rr-loads th, .rr-loads td { text-align: right; padding: 3px 10px; border-bottom: 1px solid var(--rr-edge); }
.rr-loads th:first-child, .rr-loads td:first-child, .rr-loads .rr-left { text-align: left; overflow-wrap: anywhere; }
@media (max-width: 900px) { .rr-loads, .rr-loads :is(tbody, tr, td, caption) { display: block; }
  .rr-loads thead { display: none; } .rr-loads td, .rr-loads td:first-child { border: none; padding: 1px 4px;
  text-align: left; } .rr-loads td::before { content: attr(data-head) ": "; color: var(--rr-dim); }
  .rr-loads tr { border-bottom: 1px solid var(--rr-edge); padding: 4px 0; } }
.rr-banner { width: 100%; padding: 6px 14px; background: var(--rr-warm-paper); color: var(--rr-text);
  font-weight: 600; }
.rr-banner.rr-bad { background: var(--rr-bad-paper); }
"""
)


def address_of(name: str) -> str:
    """Return the address of the page of this name. The first page that there was is the tree."""
    return "/" if name == "Tree" else f"/{name.lower()}"


class Page(ABC):
    """The parts of all pages: a bar, a status line, events, and a slider over the last minutes.

    A page that shows the past by itself sets goes_back to False: it has no slider.
    """

    goes_back = True

    def __init__(self, watch: Watch, here: str) -> None:
        self.watch = watch
        self.at: float | None = None  # the time that is shown; None for now
        self._zero = 0.0  # the time at the slider's right end, while it is in the past
        self._drawn: object = None
        self._newest: Moment | None = None
        self._heard = -1
        self._looked = 0.0
        self._client = ui.context.client
        ui.add_css(CSS)
        with ui.row().classes("rr-bar"):
            ui.label("rr-actors").classes("text-bold")
            for name in watch.pages:
                target = address_of(name)
                ui.link(name, target).classes("rr-here" if target == here else "")
            self._status = ui.label("").classes("rr-status").props('role="status" aria-live="polite"')
        self._banner = ui.label("").classes("rr-banner").props('role="alert"')
        with ui.column().classes("rr-page"):
            self.build()
            with ui.row().classes("w-full items-center no-wrap") as back:
                back.set_visibility(self.goes_back)
                ui.button("now", on_click=lambda: self._slider.set_value(0)).props("dense no-caps outline")
                self._slider = ui.slider(
                    min=-1, max=0, value=0, step=0.2, on_change=lambda event: self._slid(event.value)
                )
                self._slider.props('aria-label="seconds back"').classes("grow")
                self._clock = ui.label().classes("rr-clock").style("min-width: 13em")
            with ui.element("div").classes("rr-panel w-full"):
                self._wanted = ui.input("events: a text, event:KIND, child:ID, server:NAME", on_change=self._show_lines)
                self._wanted.props("dense outlined clearable debounce=200").classes("w-full")
                with ui.element("div").classes("rr-events-box w-full").props('tabindex="0"'):
                    self._events = ui.label().classes("rr-events").props('role="log" aria-label="events"')
        self._look()  # what is known already is in the page itself: nobody waits for the first news
        ui.timer(_MOMENT_S, self._keep_up, immediate=False)

    @abstractmethod
    def build(self) -> None:
        """Put this page's own parts on it."""

    @abstractmethod
    def draw(self, moment: Moment) -> None:
        """Show a moment in this page's own parts."""

    def step(self) -> object:
        """Return a value that changes when the page must be drawn again for the same moment."""
        return None

    @property
    def moment(self) -> Moment:
        """The moment that is shown: of now, or of the time that the slider is at."""
        return self.watch.now if self.at is None else self.watch.moment_at(self.at)

    async def carry_out(self, what: str, command: Command[c.Done]) -> None:
        """Send a command to the system, and show the reader what was done, or the error."""
        with ui.context.client:  # not in the button's place: the page may draw it anew before the answer is here
            try:
                done = await asyncio.to_thread(self.watch.link.ask, command)
            except RrError as error:
                ui.notify(f"{what}: {error}", type="negative", multi_line=True, position="top")
            else:
                ui.notify(done.text, type="positive", position="top")
        self.watch.look_soon()

    async def ask_first(self, question: str, yes: str, carry_out: Callable[[], Awaitable[None]]) -> None:
        """Carry out a command if the reader agrees."""
        with ui.context.client, ui.dialog() as dialog, ui.card():
            ui.label(question)
            with ui.row():
                ui.button("cancel", on_click=lambda: dialog.submit(False)).props("no-caps outline")
                ui.button(yes, on_click=lambda: dialog.submit(True)).props("no-caps color=negative")
        agreed = await dialog
        dialog.delete()
        if agreed:
            await carry_out()

    async def ask_priority(self, query_id: str, whose: str) -> None:
        """Give a query the priority that the reader types, if any."""
        with ui.context.client, ui.dialog() as dialog, ui.card():
            ui.label(f"The priority of {whose}:")
            field = ui.input("from -1000 to 1000, or standby").props("dense outlined autofocus").classes("w-full")
            field.on("keydown.enter", lambda: dialog.submit(field.value))
            with ui.row():
                ui.button("cancel", on_click=lambda: dialog.submit(None)).props("no-caps outline")
                ui.button("give it", on_click=lambda: dialog.submit(field.value)).props("no-caps")
        typed: str | None = await dialog
        dialog.delete()
        if typed is None:
            return
        try:
            command = commands.GivePriority(query_id, commands.priority_from("priority", typed))
        except UsageError as error:
            with ui.context.client:
                ui.notify(str(error), type="negative", multi_line=True, position="top")
        else:
            await self.carry_out("priority", command)

    def _slid(self, back: float | None) -> None:
        back = back or 0.0
        if back < 0 and self.at is None:
            self._zero = time.time()
        self.at = self._zero + back if back < 0 else None
        self._look()

    async def _keep_up(self) -> None:
        """Show what is new, and wait until the browser has taken it. Later news wait for that, and show as one."""
        if time.monotonic() >= self._looked + _LOOK_S:
            self._look()
        elif self.at is None and self.watch.now is not self._newest:
            self._show_moment()
        if self._client.outbox.updates:
            with contextlib.suppress(TimeoutError):
                await self._client.run_javascript("0", timeout=_TAKEN_S)

    def _look(self) -> None:
        """Show the news of the watch."""
        watch = self.watch
        self._looked = time.monotonic()
        if self.at is None:
            begins = watch.moments[0].at
            self._slider.props["min"] = min(-1, round(begins - time.time())) if begins else -1
            self._clock.text = "now"
        else:
            self._clock.text = f"{_clock(self.at)}, {ago(time.time() - self.at)} ago"
        if watch.heard != self._heard:
            self._heard = watch.heard
            self._events.props(f"data-seq={watch.events[-1].seq if watch.events else 0}")
            self._show_lines()
        self._show_moment()

    def _show_moment(self) -> None:
        """Show the moment that is chosen, and whether it is of a system that answers."""
        watch, moment = self.watch, self.moment
        self._newest = moment
        self._warn()
        problem = watch.now.problem
        self._status.text = f"{problem}: waiting for it" if problem else _named(watch)
        self._status.classes(toggle="rr-bad") if bool(problem) != ("rr-bad" in self._status.classes) else None
        if (state := (id(moment), self.step())) != self._drawn:
            self._drawn = state
            self.draw(moment)

    def _show_lines(self) -> None:
        wanted = self._wanted.value or ""
        lines = self.watch.lines.lines(EventFilter.parse(wanted))[-_LINES:]
        none = f"No event matches {wanted!r}." if wanted else "No event yet."
        self._events.text = "\n".join(map(str, lines)) or none

    def _warn(self) -> None:
        """Say above the page that it does not show the running system of now."""
        now, at = self.watch.now, self.at
        text = f"No answer since {_clock(now.at)}: {now.problem}." if now.problem and now.at else ""
        if now.stale and not text:
            text = f"Registrars and resources may have changed: {now.stale}."
        if at is not None:
            text = f"This is the picture of {_clock(at)}. Details and events are of now, and buttons are off."
        self._banner.text = text
        self._banner.set_visibility(bool(text))
        self._banner.classes(add="rr-bad" if at is None else "", remove="rr-bad" if at is not None else "")


def _clock(at: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(at))


def _named(watch: Watch) -> str:
    welcome = watch.welcome
    missed = f", {watch.missed} events missed" if watch.missed else ""
    return "" if welcome is None else f"{welcome.system}, pid {welcome.pid}, {welcome.state_dir}{missed}"


def _shape(row: Row) -> tuple[str, str]:
    """Return what a line of a panel is made for. Of lines for the same, the words change in place.

    A button that is clicked while it is replaced by another one does nothing.
    """
    return row.style, row.query


class Panel:
    """Rows about the chosen thing, as the live terminal shows them, and buttons.

    Args:
        page: the page, which carries out the buttons' commands.
        hint: what the panel says until something is chosen.
    """

    def __init__(self, page: Page, hint: str) -> None:
        self._page = page
        self._rows: Rows | None = None
        self._shown: list[Row] = []
        self._row = Row("", "")
        self._offered: list[tuple[RowCommand, ui.button]] = []
        self._labels: list[tuple[ui.label, ui.label]] = []  # of each line its text and its note
        self._is_asking = self._is_wanted = False
        self._title = ui.label(hint).classes("text-bold")
        self._buttons = ui.row().classes("gap-2")
        self._lines = ui.column().classes("rr-rows gap-0")

    async def show(self, rows: Rows, row: Row, offered: Sequence[RowCommand]) -> None:
        """Show these rows about the thing of a row, and a button for each command that can be done to it."""
        self._rows = rows
        self._title.text = rows.title
        self._buttons.clear()
        with self._buttons:
            self._offered = [(one, self._command(one, lambda: self._row)) for one in offered]
        self.offer(row)
        await self.ask()

    def offer(self, row: Row) -> None:
        """Show the buttons of what can be done to the thing as it is now."""
        self._row = row
        for one, button in self._offered:
            if button.visible != (can := not one.obstacle(row)):
                button.set_visibility(can)

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
        before, self._shown = self._shown, listed.rows
        if list(map(_shape, before)) == list(map(_shape, listed.rows)):
            for (text, note), row in zip(self._labels, listed.rows, strict=True):
                text.text, note.text = row.text, row.note
            return
        self._lines.clear()
        with self._lines:
            self._labels = [self._line(row) for row in listed.rows]

    def _line(self, row: Row) -> tuple[ui.label, ui.label]:
        with ui.element("div").classes("rr-line " + " ".join(f"rr-{word}" for word in row.style.split())):
            text, note = ui.label(row.text), ui.label(row.note).classes("rr-note")
            note.bind_visibility_from(note, "text", backward=bool)
            for one in QUERY_COMMANDS:
                if not one.obstacle(row):
                    self._command(one, lambda: row)
                    self._button("priority", partial(self._page.ask_priority, row.query, row.text.strip("-> ")))
        return text, note

    def _command(self, one: RowCommand, row: Callable[[], Row]) -> ui.button:
        async def carry_out() -> None:
            chosen = row()
            do, said = partial(self._page.carry_out, one.name, one.command(chosen)), one.said_of(chosen)
            if one.warning:
                await self._page.ask_first(f"{said[0].upper()}{said[1:]}? {one.warning}", f"{said.split()[0]} it", do)
            else:
                await do()

        return self._button(one.name, carry_out, harmful=one.harms)

    def _button(self, name: str, do: Callable[[], Awaitable[None]], *, harmful: bool = False) -> ui.button:
        button = ui.button(name, on_click=do, color=None if harmful else "primary").props("dense no-caps outline")
        button.classes("rr-harmful" if harmful else "")
        return button.bind_enabled_from(self._page, "at", backward=lambda at: at is None)


class Pictures:
    """The newest pictures of some streams. Whatever a frame contains, it is the source of an image and nothing else."""

    def __init__(self) -> None:
        self._row = ui.row().classes("rr-pictures gap-2")
        self._images: dict[str, ui.element] = {}

    def show(self, pictures: Mapping[str, bytes]) -> None:
        """Show these PNGs, by the names of their streams, in place of those before."""
        for name in [name for name in self._images if name not in pictures]:
            self._images.pop(name).delete()
        for name, picture in pictures.items():
            if name not in self._images:
                with self._row:
                    self._images[name] = ui.element("img")
                self._images[name].props["alt"] = self._images[name].props["title"] = f"stream {name}"
            self._images[name].props["src"] = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
