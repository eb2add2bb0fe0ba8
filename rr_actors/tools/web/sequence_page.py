"""The page of sequences: records a system, and draws the messages around one load, status, crash or restart."""

# pyright: reportUnknownMemberType=false
# Some signatures of NiceGUI are not fully typed.

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Iterator
from functools import partial

import msgspec
from nicegui import Client, ui

from rr_actors.base.errors import RrError, counted
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.recording.recordings import Recording, add
from rr_actors.system.recording.sequence_diagrams import sequence_of
from rr_actors.system.recording.traces import BEGINNINGS
from rr_actors.tools.web.page_parts import Page
from rr_actors.tools.web.watch import Moment, Watch

_LIMIT = 20_000  # entries of a page's recording
_LISTED = 30
_AROUND_S = 1.0
_UNSEEN_S = 60.0
_CRASHES = ("exited", "restarted", "start_failed", "gave_up", "stopped", "started")


class Recorder:
    """Records the system of a watch, from start() to stop(), by a connection of its own. Any thread may use it.

    All pages of a server share one, so a recording goes on, and stays, when its reader opens another page.
    """

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._lock = threading.Lock()  # held by the thread that starts or stops it
        self._is_closed = False
        self._connection: ConsoleConnection | None = None
        self._thread: threading.Thread | None = None
        self.recording = Recording("")

    @property
    def is_recording(self) -> bool:
        """True while it records: until stop(), or until the system ends."""
        thread = self._thread
        return thread is not None and thread.is_alive()

    @property
    def extent(self) -> tuple[int, int, bool]:
        """The number of entries, the number of missed ones, and whether it still records."""
        return len(self.recording), self.recording.missed, self.is_recording

    def start(self) -> None:
        """Begin a new recording, unless the recorder is closed. Not on a loop: it waits for the system.

        Raises:
            RrError: no system runs, or it refuses.
        """
        with self._lock:
            self._stop()
            if self._is_closed:
                return
            connection = ConsoleConnection(find_console(self._watch.link.state_dir))
            try:
                parts = connection.record()
            except BaseException:
                connection.close()
                raise
            self._connection, self.recording = connection, Recording(connection.welcome.system, limit=_LIMIT)
            arguments = (self.recording, parts)
            self._thread = threading.Thread(target=_take, args=arguments, name="rr-web-record", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the recording, and keep its entries. A second call does nothing."""
        with self._lock:
            self._stop()

    def close(self) -> None:
        """End the recording for good, even if another thread is just starting one."""
        self._is_closed = True
        self.stop()

    def _stop(self) -> None:
        connection, self._connection, thread, self._thread = self._connection, None, self._thread, None
        if connection is not None:
            connection.close()
        if thread is not None:
            thread.join()

    def happenings(self) -> list[Entry]:
        """Return the entries that can be drawn, newest first: loads, unloads and messages without a cause; others.

        The others are statuses and crashes.
        """
        found = [
            entry
            for entry in self.recording.entries()
            if entry.event in _CRASHES
            or entry.event == "status"
            or (entry.event == "sent" and entry.name in BEGINNINGS and not entry.parent)
        ]
        return found[: -_LISTED - 1 : -1]

    def diagram(self, entry: Entry) -> str:
        """Return a Mermaid diagram of the entries around an entry: a load's trace, or the second before and after.

        Raises:
            RrError: the recording no longer has the load's entries.
        """
        if entry.event == "sent":
            return self.recording.trace(entry.query).sequence()
        near = [other for other in self.recording.entries() if abs(other.at - entry.at) <= _AROUND_S]
        return sequence_of([_placed(other) for other in near])


class SequencePage(Page):
    """The page with the list of recorded entries, and the diagram around the chosen one."""

    def __init__(self, watch: Watch, recorder: Recorder) -> None:
        self._recorder = recorder
        self._shown: list[Entry] = []
        super().__init__(watch, "/sequence")

    def build(self) -> None:
        """Put the buttons, the list and the diagram on the page."""
        with ui.element("div").classes("rr-split"):
            with ui.element("div").classes("rr-panel").style("flex: 2"):
                with ui.row().classes("gap-2"):
                    ui.button("record", on_click=self._record).props("dense no-caps outline")
                    ui.button("stop recording", on_click=self._end).props("dense no-caps outline")
                self._state = ui.label("nothing is recorded").classes("rr-note")
                self._list = ui.column().classes("rr-rows gap-0")
            with ui.element("div").classes("rr-panel").style("flex: 5"):
                with ui.row().classes("gap-2"):
                    ui.button("copy text", on_click=lambda: ui.clipboard.write(self._text.value or "")).props(
                        "dense no-caps outline"
                    )
                    ui.button("save SVG", on_click=self._save).props("dense no-caps outline")
                self._hint = ui.label("Press record, and choose what has happened: its messages appear here.")
                self._picture = ui.mermaid("").classes("rr-sequence")
                self._picture.set_visibility(False)
                self._text = ui.textarea("Mermaid text").props("readonly outlined autogrow").classes("w-full rr-rows")

    def draw(self, moment: Moment) -> None:
        """Show the list of recorded entries."""
        recorder = self._recorder
        count, missed, is_recording = recorder.extent
        lost = f", {missed} missed" if missed else ""
        self._state.text = f"{counted(count, 'entry')}{lost}{', recording' if is_recording else ''}"
        if (found := recorder.happenings()) == self._shown:
            return
        self._shown = found
        self._list.clear()
        with self._list:
            for entry in found:
                ui.button(_line(entry), on_click=partial(self._choose, entry)).props("dense no-caps flat")

    def step(self) -> object:
        """Return the recorder's extent, which changes with the list."""
        return self._recorder.extent

    async def _record(self) -> None:
        try:
            await asyncio.to_thread(self._recorder.start)
        except RrError as error:
            ui.notify(str(error), type="negative")

    async def _end(self) -> None:
        await asyncio.to_thread(self._recorder.stop)

    async def _choose(self, entry: Entry) -> None:
        with ui.context.client:  # not in the button's place: the list may be drawn anew before the diagram is made
            try:
                text = await asyncio.to_thread(self._recorder.diagram, entry)
            except RrError as error:
                ui.notify(str(error), type="negative")
                return
        self._text.value = text
        self._hint.set_visibility(False)
        self._picture.set_visibility(True)
        self._picture.content = text

    def _save(self) -> None:
        ui.run_javascript(f"""
            const svg = document.querySelector("#c{self._picture.id} svg").outerHTML;
            const link = document.createElement("a");
            link.href = URL.createObjectURL(new Blob([svg], {{ type: "image/svg+xml" }}));
            link.download = "sequence.svg";
            link.click();
            URL.revokeObjectURL(link.href);
        """)


async def end_unseen(recorder: Recorder) -> None:
    """End each recording that no page has been open to see for a minute: to record makes loads slower."""
    unseen = 0
    while True:
        await asyncio.sleep(_UNSEEN_S / 2)
        unseen = 0 if any(client.has_socket_connection for client in Client.instances.values()) else unseen + 1
        if unseen > 1 and recorder.is_recording:
            await asyncio.to_thread(recorder.stop)


def _take(recording: Recording, parts: Iterator[c.Entries]) -> None:
    with contextlib.suppress(RrError):  # the system has ended
        for part in parts:
            add(recording, part.entries, part.dropped)


def _placed(entry: Entry) -> Entry:
    """Return an entry of the tree with its child's id as the registrar: a manager's registrar has its child's id."""
    if entry.registrar or not entry.process:
        return entry
    return msgspec.structs.replace(entry, registrar=entry.process.rpartition("/")[2])


def _line(entry: Entry) -> str:
    what = (
        f"{entry.name} {entry.server or entry.peer}"
        if entry.event == "sent"
        else f"{entry.event} {entry.process or entry.server}"
    )
    return f"{time.strftime('%H:%M:%S', time.localtime(entry.at))} {what} {entry.detail[:40]}".rstrip()
