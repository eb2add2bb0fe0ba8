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
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import msgspec
from nicegui import Client, background_tasks, ui

from rr_actors.base.errors import RrError, UsageError, counted
from rr_actors.base.notebook import escape
from rr_actors.managers.actions.graph_pictures import ShownGraph
from rr_actors.system.console import console_commands as commands
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_view import Command
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.tables.row_commands import CHILD_COMMANDS, QUERY_COMMANDS, RESOURCE_COMMANDS, RowCommand
from rr_actors.tools.tables.table import Row
from rr_actors.tools.terminal.event_lines import EventFilter
from rr_actors.tools.terminal.terminal_rows import graph_of
from rr_actors.tools.web import tree_picture
from rr_actors.tools.web.frame import page_style
from rr_actors.tools.web.frame.detail_html import body_html, buttons_html, head_html, refused_html
from rr_actors.tools.web.frame.details import Detail, detail_of
from rr_actors.tools.web.frame.live_html import LiveHtml
from rr_actors.tools.web.frame.page_addresses import Address, Kind
from rr_actors.tools.web.watch import Moment, Watch

_MOMENT_S = 0.05
_LOOK_S = 0.2
"""The time between two looks for a new moment, which cost next to nothing, and for all news."""
_TAKEN_S = 10.0
"""How long a browser may take for what it was sent, before the page sends it more all the same."""
_LINES = 200  # events: the newest are in sight, and the others are scrolled to
_FORESEEN = (commands.Kill, commands.Terminate)
_PICTURE_S, _ASK_S = 0.5, 2.0
"""The time between two pictures of the chosen thing's streams, and between two questions for its details."""

CSS = page_style.CSS + tree_picture.CSS
_SCRIPT = (Path(page_style.__file__).parent / "page_frame.js").read_text(encoding="utf-8")


def address_of(name: str) -> str:
    """Return the address of the page of this name. The overview is the first page."""
    return "/" if name == "Overview" else f"/{name.lower()}"


class Page(ABC):
    """The parts of all pages: a bar, a status line, events, and a slider over the last minutes.

    A page that shows the past by itself sets goes_back to False: it has no slider.
    """

    goes_back = True

    def __init__(self, watch: Watch, here: str) -> None:
        self.watch = watch
        self.client = ui.context.client
        self.address = Address.read(self.client.request.query_params)
        self.at = self.address.at  # the time that is shown; None for now
        self._zero = 0.0  # the time at the slider's right end, while it is in the past
        self._drawn: object = None
        self._newest: Moment | None = None
        self._heard = -1
        self._looked = 0.0
        ui.add_css(CSS)
        ui.add_body_html(f"<script>{_SCRIPT}</script>")
        ui.on("rr_address", lambda event: self._readdressed(event.args))
        with ui.element("div").classes("rr-frame"):
            self._navigate(here)
            with ui.element("main").classes("rr-main") as self._main:
                self._banner = ui.label("").classes("rr-banner").props('role="alert"')
                with ui.column().classes("rr-page"):
                    self.build()
                    self._build_past()
            self.drawer = Drawer(self)
        if self.at is not None:
            self._go_back_to(self.at)
        self._look()  # what is known already is in the page itself: nobody waits for the first news
        ui.timer(_MOMENT_S, self._keep_up, immediate=False)
        if self.address.kind:
            ui.timer(0, self._choose_first, once=True)

    def _navigate(self, here: str) -> None:
        """Put the pages at the left, each with a count, if it has one."""
        self._counts: dict[str, ui.label] = {}
        with ui.element("nav").classes("rr-nav").props('aria-label="pages"'):
            with ui.element("div").classes("rr-who"):
                self._name = ui.label("").classes("rr-name")
                self._status = ui.label("").classes("rr-status").props('role="status" aria-live="polite"')
            for name in self.watch.pages:
                target = address_of(name)
                with ui.link(target=target).props("data-page").classes("rr-here" if target == here else "") as link:
                    ui.label(name)
                    self._counts[name] = ui.label().classes("rr-badge").props('aria-hidden="true"')
                if target == here:
                    link.props('aria-current="page"')
            ui.html("<kbd>/</kbd> search, <kbd>?</kbd> keys", sanitize=False).classes("rr-help")

    def _build_past(self) -> None:
        """Put the slider and the events below the page's own parts."""
        with ui.row().classes("w-full items-center no-wrap rr-past") as back:
            back.set_visibility(self.goes_back)
            ui.button("now", on_click=lambda: self._slider.set_value(0)).props("dense no-caps outline")
            self._slider = ui.slider(min=-1, max=0, value=0, step=0.2, on_change=lambda event: self._slid(event.value))
            self._slider.props('aria-label="seconds back"').classes("grow")
            self._clock = ui.label().classes("rr-clock").style("min-width: 13em")
        with ui.element("div").classes("rr-panel w-full"):
            self._wanted = ui.input(
                "events: text, event:, child:, server:", value=self.address.events, on_change=self._wants_events
            )
            self._wanted.props("dense outlined clearable debounce=200").classes("w-full")
            with ui.element("div").classes("rr-events-box w-full").props('tabindex="0"'):
                self._events = ui.label().classes("rr-events").props('role="log" aria-label="events"')

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

    def readdressed(self) -> None:
        """Show the search and the order of the address, which has changed. A page without a list has neither."""
        return

    def now_at(self, address: Address, *, push: bool = False) -> None:
        """Show another address in the browser; `push`: the last one is a step back."""
        if address != self.address:
            self.address = address
            ui_run(self.client, f"rrFrame.address({json.dumps(address.query())}, {json.dumps(push)})")

    async def choose(self, kind: Kind, name: str) -> None:
        """Show a thing in the drawer; "" closes it."""
        self.now_at(self.address.chosen(kind, name), push=True)
        await self._show_chosen()

    def is_chosen(self, address: Address) -> None:
        """Show in this page's own parts what is chosen, if it is in one of them."""
        return

    async def _choose_first(self) -> None:
        await self._show_chosen()

    async def _show_chosen(self) -> None:
        self._drawn = None
        self.is_chosen(self.address)
        await self.drawer.show(self.address)

    async def _readdressed(self, query: object) -> None:
        """Follow the browser to the address that it has gone to."""
        if not isinstance(query, dict):
            return
        before, self.address = self.address, Address.read(cast("dict[str, str]", query))
        if (before.kind, before.name) != (self.address.kind, self.address.name):
            await self._show_chosen()
        if before.events != self.address.events:
            self._wanted.value = self.address.events
        if before.at != self.address.at and self.goes_back:
            self._go_back_to(self.address.at)
        if (before.match, before.sort) != (self.address.match, self.address.sort):
            self.readdressed()

    def _go_back_to(self, at: float | None) -> None:
        """Move the slider to a time."""
        if at is None:
            self._slider.set_value(0)
            return
        self._zero = time.time()
        back = round(min(-0.2, at - self._zero), 1)
        self._slider.props["min"] = min(-1, back)
        self.at = at
        self._slider.set_value(back)

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
        with ui.context.client, ui.dialog().props('aria-label="question"') as dialog, ui.card():
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
        with ui.context.client, ui.dialog().props('aria-label="priority"') as dialog, ui.card():
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
        self.now_at(replace(self.address, at=None if self.at is None else round(self.at, 1)))
        self.drawer.offer()
        self._look()

    async def _keep_up(self) -> None:
        """Show what is new, and wait until the browser has taken it. Later news wait for that, and show as one."""
        if time.monotonic() >= self._looked + _LOOK_S:
            self._look()
        elif self.at is None and self.watch.now is not self._newest:
            self._show_moment()
        if self.client.outbox.updates:
            with contextlib.suppress(TimeoutError):
                await self.client.run_javascript("0", timeout=_TAKEN_S)

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
        self._name.text = watch.welcome.system if watch.welcome is not None else "rr-actors"
        self._status.text = f"{problem}: waiting for it" if problem else _named(watch)
        self._main.classes(toggle="rr-stale") if bool(problem) != ("rr-stale" in self._main.classes) else None
        self._count(watch.now)
        self._status.classes(toggle="rr-bad") if bool(problem) != ("rr-bad" in self._status.classes) else None
        if (state := (id(moment), self.step())) != self._drawn:
            self._drawn = state
            self.draw(moment)
            self.drawer.offer()

    def _count(self, now: Moment) -> None:
        """Show the number of what each page lists."""
        for name, count in (("Tree", len(now.children)), ("Resources", now.total)):
            if (badge := self._counts.get(name)) is not None:
                badge.text = f"{count:,}" if count else ""
        if (badge := self._counts.get("Overview")) is not None:
            count = self.watch.attention.total
            badge.text = f"{count:,}" if count else ""
            if bool(count) != ("rr-bad" in badge.classes):
                badge.classes(toggle="rr-bad")

    def _wants_events(self) -> None:
        self.now_at(replace(self.address, events=self._wanted.value or ""))
        self._show_lines()

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
    missed = f", {counted(watch.missed, 'event')} missed" if watch.missed else ""
    return "" if welcome is None else f"pid {welcome.pid}, {welcome.state_dir}{missed}"


class Drawer:
    """What is known of the chosen thing, and buttons for what can be done to it now; it is on every page.

    Args:
        page: the page, which carries out the buttons' commands.
    """

    def __init__(self, page: Page) -> None:
        self._page = page
        self._address = Address()
        self._detail: Detail | None = None
        self._rows: dict[str, Row] = {}  # by their queries
        self._asked_at = 0.0
        self._is_asking = self._is_wanted = False
        self._pictures_of = ""
        with ui.element("aside").classes("rr-drawer").props('aria-label="what is chosen" tabindex="-1"') as self._place:
            ui.html(
                '<button type="button" class="rr-close" data-close aria-label="close (Esc)">×</button>', sanitize=False
            )
            self._head = LiveHtml()
            self._buttons = LiveHtml(self._act).classes("rr-acts")
            self._pictures = Pictures()
            self._actions = LiveHtml().classes("rr-actions")
            self._body = LiveHtml(self._act_on_query).classes("rr-rows")
        ui.timer(_PICTURE_S, self._look)

    async def show(self, address: Address) -> None:
        """Show what an address has chosen; close the drawer if that is nothing."""
        self._address, self._detail = address, None
        is_open = bool(address.kind)
        self._place.classes(add="rr-open" if is_open else "", remove="" if is_open else "rr-open")
        ui_run(self._page.client, f"rrFrame.opened({json.dumps(is_open)})")
        self._head.show(f"<h2>{escape(address.name.rpartition('/')[2])}</h2>" if address.kind == "child" else "")
        self._body.show("")
        self._actions.show("")
        self._pictures.show({})
        self.offer()
        await self.ask()

    def offer(self) -> None:
        """Show the buttons of what can be done to the thing as it is now."""
        row = self._row()
        offered = {"child": CHILD_COMMANDS, "resource": RESOURCE_COMMANDS}.get(self._address.kind, ())
        can = [one for one in offered if not one.obstacle(row)]
        self._buttons.show(buttons_html(can, is_past=self._page.at is not None))
        self._show()

    def _row(self) -> Row:
        """Return the chosen thing as the row that commands are for."""
        name = self._address.name
        if self._address.kind == "child":
            child = next((row for row in self._page.moment.children if row.path == name), None)
            return Row("", name, child=child)
        title = self._detail.title if self._detail is not None else ""
        return Row(name, title, resource=name, name=title) if self._address.kind == "resource" else Row("", "")

    async def ask(self) -> None:
        """Ask for the details again. A call in the meantime makes the first call ask once more."""
        self._is_wanted = True
        while self._is_wanted and not self._is_asking and self._address.kind:
            self._is_wanted, self._is_asking = False, True
            try:
                await self._ask(self._address)
            finally:
                self._is_asking = False

    async def _ask(self, address: Address) -> None:
        self._asked_at = time.monotonic()
        watch = self._page.watch
        try:
            detail = await asyncio.to_thread(detail_of, watch.link, address, watch.lines.lines)
        except RrError as error:
            if address is self._address:
                self._body.show(refused_html(str(error)))
            return
        if (address.kind, address.name) == (self._address.kind, self._address.name):
            self._detail = detail
            self._rows = {row.query: row for row in detail.rows if row.query}
            self._show()

    def _show(self) -> None:
        if self._detail is not None:
            self._head.show(head_html(self._detail))
            self._body.show(body_html(self._detail, is_past=self._page.at is not None))

    async def _look(self) -> None:
        """Keep up with what is chosen: its details every two seconds, its pictures, and its actions."""
        address, page = self._address, self._page
        if not address.kind:
            return
        if time.monotonic() > self._asked_at + _ASK_S and not page.watch.now.problem:
            background_tasks.create(self.ask())
        chosen = address.name if address.kind == "resource" and page.at is None else ""
        seen = await asyncio.to_thread(page.watch.pictures_of, chosen) if chosen else {}
        graph = await asyncio.to_thread(self._graph, chosen) if chosen else None
        if chosen == (self._address.name if page.at is None else ""):  # nothing else was chosen meanwhile
            self._pictures.show(seen)
            self._actions.show("" if graph is None else graph.picture)

    def _graph(self, id: str) -> ShownGraph | None:
        link = self._page.watch.link
        with contextlib.suppress(RrError):  # the next moment says why there is no answer
            rows = link.ask(questions.Find(id)).resources
            return graph_of(link, rows[0]) if rows else None
        return None

    async def _act(self, name: str, of: str) -> None:
        offered = (*CHILD_COMMANDS, *RESOURCE_COMMANDS)
        await self._carry_out(next(one for one in offered if one.name == name), self._row())

    async def _act_on_query(self, name: str, query: str) -> None:
        if (row := self._rows.get(query)) is None:
            return
        if name == "priority":
            await self._page.ask_priority(row.query, row.text.strip("-> "))
        else:
            await self._carry_out(next(one for one in QUERY_COMMANDS if one.name == name), row)

    async def _carry_out(self, one: RowCommand, row: Row) -> None:
        if self._page.at is not None:
            return
        do, said = partial(self._page.carry_out, one.name, one.command(row)), one.said_of(row)
        if one.warning:
            foretold = await self._foretold(one.command(row))
            question = " ".join(filter(None, (f"{said[0].upper()}{said[1:]}?", one.warning, foretold)))
            await self._page.ask_first(question, f"{said.split()[0]} it", do)
        else:
            await do()
        await self.ask()

    async def _foretold(self, command: Command[c.Done]) -> str:
        """Return what a command would do, as the system foresees it; "" of one that cannot be foreseen."""
        if not isinstance(command, _FORESEEN):
            return ""
        try:
            done = await asyncio.to_thread(self._page.watch.link.ask, msgspec.structs.replace(command, dry_run=True))
        except RrError:  # the command itself says why not
            return ""
        return f"It {done.text}."


def ui_run(client: Client, script: str) -> None:
    """Run a script in a page's browser, from wherever this is called."""
    with client:
        ui.run_javascript(script)


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
