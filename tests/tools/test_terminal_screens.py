"""What `rr-actors top` looks like, mostly at 80x24: screens of a system that is made up, as they are in tools/screens.

A screen that is to look different is written anew by `RR_RENEW_SCREENS=1 pytest tests/tools/test_terminal_screens.py`,
and looked at in the difference before it is committed.
"""

from __future__ import annotations

import asyncio
import html
import os
import re
import threading
import time
import types
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from rich.cells import cell_len
from textual.pilot import Pilot

from rr_actors.registrar.pages import CONDITIONS, LOAD_ORDERS, HolderRow, LoadRow, QueryRow, ResourceRow
from rr_actors.streams.stream import ReaderRow, StreamInfo, StreamRow
from rr_actors.supervision.event_history import Record
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.attention.attention_items import Known, needs_attention
from rr_actors.system.console.attention.attention_questions import Attention, ListAttention
from rr_actors.system.recording import event_texts
from rr_actors.system.recording.event_memory import Event
from rr_actors.tools import explanations
from rr_actors.tools.tables import load_tables
from rr_actors.tools.terminal import attention_lines, event_lines, terminal_app, terminal_rows
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.terminal.terminal_app import Terminal
from support import LIMIT_S

SCREENS = Path(__file__).parent / "screens"
NOW = 1_760_000_000.0
PID = 5_000_000  # more than the kernel gives: nobody's CPU and memory are shown


def id_of(number: int, age_s: float) -> str:
    """An id as it is made so many seconds before NOW: a UUIDv7."""
    return f"{int((NOW - age_s) * 1000):012x}7000800000000000{number:04x}"


LENS, FRONT, BACK = id_of(1, 95), id_of(2, 90), id_of(3, 60)
CHILDREN = [
    c.ChildRow("root", 0, "supervisor", "running", PID, strategy="one_for_one, 3 in 5 s", up_s=100.0),
    c.ChildRow("root/lenses", 1, "worker", "running", PID + 1, up_s=100.0),
    c.ChildRow("root/inner", 1, "supervisor", "running", PID, strategy="rest_for_one, 3 in 5 s", up_s=100.0),
    c.ChildRow("root/inner/cameras", 2, "worker", "running", PID + 3, restarts=2, up_s=12.0),
    c.ChildRow("root/inner/planner", 2, "worker", "restarting", restarts=1),
    c.ChildRow("root/inner/spare", 2, "worker", "stopped"),
]
REGISTRARS = [
    c.RegistrarRow("app", "up", counts={"resources": 0, "queries": 2, "mailbox": 0}),
    c.RegistrarRow("cameras", "up", ["cameras/camera"], {"resources": 2, "queries": 1, "mailbox": 3}),
    c.RegistrarRow("lenses", "up", ["lenses/lens", "lenses/filter"], {"resources": 1, "queries": 0, "mailbox": 0}),
    c.RegistrarRow("planner", "down"),
]
SERVED = {
    "lenses": [
        ResourceRow(LENS, "lenses/lens", '"front"', '"glass"', "loaded", "WARNING", "dusty",
                    1, [HolderRow(id_of(9, 88), "cameras", FRONT)], 1, [], 0),
    ],
    "cameras": [
        ResourceRow(FRONT, "cameras/camera", '"/dev/video0"', '"3 fps"', "loaded", "OK", "",
                    1, [HolderRow(id_of(7, 90), "app", ""), HolderRow(id_of(8, 30), "planner", "")],
                    2, [id_of(9, 88)], 1),
        ResourceRow(BACK, "cameras/camera", '"/dev/video1"', '"dark"', "loaded", "FATAL", "unplugged",
                    1, [HolderRow(id_of(6, 60), "app", "")], 1, [], 0),
    ],
}  # fmt: skip
_READERS = [ReaderRow("app", PID + 8, "latest", 311), ReaderRow("planner", PID + 9, "all", 0)]
STREAMS = [
    StreamRow(
        StreamInfo(f"{FRONT}/images", "images", "cameras/camera", FRONT, 29.3, 182_000_000.0, 2, 311, 0.016),
        '"/dev/video0"', 4096, _READERS,
    ),
    StreamRow(StreamInfo(f"{FRONT}/boxes", "boxes", "cameras/camera", FRONT, 0, 0, 0, 0, None), '"/dev/video0"', 0, []),
]  # fmt: skip
WAITS = QueryRow(id_of(5, 7.25), "app", "lenses/lens", "", "", '"wide"', "pending", "OK")
LOADS = [
    LoadRow("cameras/camera", 1204, 1180, 31, 2, 0, 1.34, 2.9, 4.1, 32.2),
    LoadRow("lenses/lens", 3, 1, 2, 0, 1, 0.012, 0.02, 0.02, 0.024),
    LoadRow("lenses/filter", 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0),
]
_RECORDS = [
    Record("started", "root/inner/cameras", "manager", 2, NOW - 100, "running", PID + 2, ready_s=0.25),
    Record("exited", "root/inner/cameras", "manager", 2, NOW - 12.5, "restarting", PID + 2, "killed", "SIGKILL",
           -9, "SIGKILL", restarts=2, up_s=87.5),
    Record("restarted", "root/inner/cameras", "manager", 5, NOW - 12, "running", PID + 3, restarts=2, ready_s=0.125),
]  # fmt: skip
HISTORY = [Event.of({"event": one.event, **one.facts()}) for one in _RECORDS]
_DUSTY = {"detail": "WARNING dusty", "status_id": "s", "source": "lenses/lens"}
EVENTS = [
    Event(1, NOW - 3, "status", {"server": "cameras/camera", "request": '"/dev/video0"', "heard_by": "app"} | _DUSTY),
    Event(2, NOW - 3, "status", {"server": "lenses/lens", "request": '"front"', "heard_by": ""} | _DUSTY),
    Event(3, NOW - 2, "loaded", {"server": "cameras/camera", "request": '"/dev/video1"', "detail": ""}),
]


class Stage(ConsoleLink):
    """A system that is made up: the same at each look."""

    def __init__(self) -> None:
        self.state_dir = "/srv/robot"
        self._closed = threading.Event()

    def ask(self, request: Any, timeout_s: float | None = None) -> Any:
        match request:
            case questions.ListChildren(match, offset, limit):
                children = [row for row in CHILDREN if match in row.path]
                return c.Children(len(children), children[offset : offset + limit])
            case questions.ListRegistrars(match, offset, limit):
                registrars = [row for row in REGISTRARS if match in row.name]
                return c.Registrars(len(registrars), registrars[offset : offset + limit])
            case questions.ListResources(match, offset, limit, registrar, sort):
                served = SERVED.get(registrar, []) if registrar else [row for rows in SERVED.values() for row in rows]
                served = [row for row in served if match in row.request]
                if sort:
                    served.sort(key={"state": lambda row: CONDITIONS.index(row.condition)}[sort])
                return c.Resources(len(served), served[offset : offset + limit])
            case questions.ListStreams(match, offset, limit):
                streams = [row for row in STREAMS if match in row.info.id]
                return c.Streams(len(streams), streams[offset : offset + limit])
            case questions.ListHistory(path, _):
                return c.Happenings([event for event in HISTORY if event.path.startswith(path)])
            case questions.ListEvents():
                return c.Happenings(HISTORY)
            case questions.ListLog(path):
                return c.ChildLog(path, 0, [])
            case questions.Find(id):
                part = QueryRow(id, "cameras", "lenses/lens", LENS, FRONT, '"front"', "held", "WARNING")
                found = [row for rows in SERVED.values() for row in rows if row.id == id]
                return c.Found(found, [part] if id == id_of(9, 88) else [])
            case questions.ListLoads(_, offset, limit, _, sort):
                key = LOAD_ORDERS.get(sort, lambda row: 0.0)
                return c.Loads(1, [WAITS][offset : offset + limit], sorted(LOADS, key=key, reverse=True))
            case ListAttention():
                troubled = [row for rows in SERVED.values() for row in rows if row.state != "OK"]
                began = {BACK: NOW - 20}
                items = needs_attention(Known(NOW, CHILDREN, HISTORY, troubled, len(troubled), began=began))
                return Attention(len(items), items)
            case _:
                return c.QueryPage(0, [])

    def follow(self, found: Callable[[c.Welcome], None], hear: Callable[[c.Events | c.Missed], None]) -> str:
        found(c.Welcome(1, "robot", PID, "/srv/robot", NOW - 100))
        hear(c.Events(EVENTS))
        self._closed.wait(LIMIT_S)
        return "the link is closed"

    def close(self) -> None:
        self._closed.set()


@pytest.fixture(autouse=True)
def _it_is_always_now(monkeypatch: pytest.MonkeyPatch) -> None:
    def strftime(form: str, at: time.struct_time | None = None) -> str:
        return time.strftime(form, time.gmtime(NOW) if at is None else at)

    clock = types.SimpleNamespace(time=lambda: NOW, monotonic=time.monotonic, localtime=time.gmtime, strftime=strftime)
    for module in (attention_lines, event_texts, event_lines, explanations, load_tables, terminal_app, terminal_rows):
        monkeypatch.setattr(module, "time", clock)


Look = Callable[[Terminal, Pilot[None]], Awaitable[None]]


TEXT = re.compile(r'<text [^>]* x="([\d.]+)" [^>]*-line-(\d+)\)">([^<]*)</text>')
COLUMN = 12.2  # the width of a character in a screenshot


def screen_of(terminal: Terminal) -> str:
    lines = [""] * terminal.screen.size.height
    for x, line, text in TEXT.findall(terminal.export_screenshot()):
        before = lines[int(line)]
        gap = " " * (round(float(x) / COLUMN) - cell_len(before))
        lines[int(line)] = before + gap + html.unescape(text).replace("\xa0", " ")
    return "".join(f"{line.rstrip()}\n" for line in lines)


async def goes_down_to(terminal: Terminal, pilot: Pilot[None], name: str) -> None:
    pane = terminal.left if terminal.left.has_focus else terminal.right
    await shows(terminal, pilot, name)
    while (row := pane.row) is None or name not in row.text:
        await pilot.press("down")


async def shows(terminal: Terminal, pilot: Pilot[None], *texts: str) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not all(text in screen_of(terminal) for text in texts):
        assert time.monotonic() < deadline, screen_of(terminal)
        await pilot.pause(0.02)


async def the_tree(terminal: Terminal, pilot: Pilot[None]) -> None:
    await shows(terminal, pilot, "one_for_one", "dusty", "is in FATAL")


async def a_chosen_child(terminal: Terminal, pilot: Pilot[None]) -> None:
    await goes_down_to(terminal, pilot, "    cameras")
    await shows(terminal, pilot, "root/inner/cameras: now", "killed", "dusty")


async def a_chosen_registrar(terminal: Terminal, pilot: Pilot[None]) -> None:
    await goes_down_to(terminal, pilot, "@cameras")
    await shows(terminal, pilot, "cameras: serves and holds", "/dev/video1", "dusty")


async def a_chosen_resource(terminal: Terminal, pilot: Pilot[None]) -> None:
    await a_chosen_registrar(terminal, pilot)
    await pilot.press("tab")
    await goes_down_to(terminal, pilot, "/dev/video0")
    await pilot.press("enter")
    await shows(terminal, pilot, "held by 2", "depends on 1", "lenses/lens", "dusty")


async def a_filter(terminal: Terminal, pilot: Pilot[None]) -> None:
    await a_chosen_registrar(terminal, pilot)
    await pilot.press("tab", "slash", *"video1")
    await shows(terminal, pilot, "filter: video1", "1/1")


async def a_key_that_cannot(terminal: Terminal, pilot: Pilot[None]) -> None:
    await a_chosen_registrar(terminal, pilot)
    await pilot.press("K")
    await shows(terminal, pilot, "choose a child")


async def the_tree_alone(terminal: Terminal, pilot: Pilot[None]) -> None:
    await the_tree(terminal, pilot)
    await pilot.press("z", "s", "s", "s", "s")
    await shows(terminal, pilot, "children by mailbox", "▼mailbox", "root/inner/cameras")


async def the_resources(terminal: Terminal, pilot: Pilot[None]) -> None:
    await the_tree(terminal, pilot)
    await pilot.press("2", "s")
    await shows(terminal, pilot, "resources by state", "unplugged", "id 00000003")


async def the_streams(terminal: Terminal, pilot: Pilot[None]) -> None:
    await the_tree(terminal, pilot)
    await pilot.press("4", "z")
    await shows(terminal, pilot, "images", "29.3/s", "173.6 MiB/s", "311")


async def the_loads(terminal: Terminal, pilot: Pilot[None]) -> None:
    await the_tree(terminal, pilot)
    await pilot.press("5", "z", "s", "s")
    await shows(terminal, pilot, "▼p95", "7.2 s", "1,204")


async def the_help(terminal: Terminal, pilot: Pilot[None]) -> None:
    await the_tree(terminal, pilot)
    await pilot.press("question_mark")
    await shows(terminal, pilot, "the pane alone")


async def a_wide_screen(terminal: Terminal, pilot: Pilot[None]) -> None:
    await the_tree(terminal, pilot)
    await shows(terminal, pilot, "cpu, last 5 min", "@planner")


SMALL = (80, 24)


@pytest.mark.parametrize(
    ("look", "size"),
    [
        *((look, SMALL) for look in (the_tree, a_chosen_child, a_chosen_registrar, a_chosen_resource, a_filter)),
        *((look, SMALL) for look in (a_key_that_cannot, the_tree_alone, the_resources, the_streams)),
        *((look, SMALL) for look in (the_loads, the_help)),
        (a_wide_screen, (250, 70)),
    ],
)
def test_a_screen_looks_as_it_did(look: Look, size: tuple[int, int]) -> None:
    async def play() -> str:
        terminal = Terminal(Stage())
        async with terminal.run_test(size=size) as pilot:
            await look(terminal, pilot)
            await pilot.pause()
            return screen_of(terminal)

    seen, file = asyncio.run(play()), SCREENS / f"{look.__name__}.txt"
    if os.environ.get("RR_RENEW_SCREENS"):
        SCREENS.mkdir(exist_ok=True)
        file.write_text(seen)

    assert len(seen.splitlines()) == size[1]
    assert max(map(len, seen.splitlines())) <= size[0]
    assert seen == file.read_text()
