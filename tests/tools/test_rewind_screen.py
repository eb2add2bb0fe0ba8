"""The terminal of `rr-actors rewind`: a recording is stepped through by keys, forward and back."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recording, add, entry_of
from rr_actors.system.rewound.rewinding import rewind
from rr_actors.tools.terminal.rewind_screen import RewindKeys, RewindScreen
from rr_actors.tools.terminal.terminal_pane import Pane
from support import eventually
from support_tmux import Tmux, needs_tmux, terminal

LIMIT_S = 30.0

NOON = time.mktime((2021, 3, 8, 12, 0, 0, 0, 0, -1))


def child(at: float, kind: str, state: str, **facts: Any) -> Event:
    return Event.of({"event": kind, "at": NOON + at, "path": "root/cameras", "kind": "manager", "state": state} | facts)


def lens(at: float, kind: str, detail: str = "") -> Event:
    where = {"registrar": "cameras", "server": "cameras/lens", "resource_id": "x1", "request": '"front"'}
    return Event.of({"event": kind, "at": NOON + at, "detail": detail} | where)


@pytest.fixture
def recording() -> Recording:
    recording = Recording("robot")
    recording.since = NOON
    recording.present = [{"left_out": 0}]
    events = [
        child(1.0, "started", "running", run=1, pid=71),
        lens(2.0, "loaded"),
        lens(3.0, "status", "ERROR no frame"),
        child(4.0, "exited", "restarting", reason="killed", detail="SIGKILL"),
        child(5.0, "restarted", "running", pid=72),
        lens(6.0, "status", "OK"),
    ]
    add(recording, [entry_of(one) for one in events])
    return recording


class Person:
    """Somebody at the terminal: sees lines, presses keys."""

    def __init__(self, screen: RewindScreen, pilot: Pilot[None]) -> None:
        self.screen = screen
        self._pilot = pilot

    async def press(self, *keys: str) -> None:
        await self._pilot.press(*keys)

    def shown(self, pane: Pane) -> str:
        return "\n".join(pane.render_line(y).text.rstrip() for y in range(pane.size.height))

    async def types(self, text: str) -> None:
        await self.press(*("space" if char == " " else char for char in text), "enter")

    async def sees(self, *texts: str, gone: str = "") -> None:
        def shows() -> bool:
            seen = self.all_shown()
            return all(text in seen for text in texts) and not (gone and gone in seen)

        await self.finds(shows, f"{texts}, without {gone!r}")

    async def finds(self, predicate: Callable[[], bool], what: str = "") -> None:
        deadline = time.monotonic() + LIMIT_S
        while not predicate():
            assert time.monotonic() < deadline, f"expected {what or predicate}, got\n{self.all_shown()}"
            await self._pilot.pause(0.02)

    def all_shown(self) -> str:
        panes = (self.screen.left, self.screen.right, self.screen.steps)
        return "\n---\n".join([*map(self.shown, panes), self.screen.status])


def sit_down(recording: Recording, scene: Callable[[Person], Awaitable[None]]) -> None:
    async def play() -> None:
        screen = RewindScreen(rewind(recording))
        async with screen.run_test(size=(100, 24)) as pilot:
            await scene(Person(screen, pilot))

    asyncio.run(play())


def test_arrows_step_back_and_forward(recording: Recording) -> None:
    async def scene(person: Person) -> None:
        await person.sees("6 steps: arrows step back and forward", "restarted", "OK 2021-03-08 12:00:06")
        await person.press("left", "left")
        await person.sees("restarting", "ERROR", "no frame")
        await person.press("up", "left")
        await person.sees('cameras/lens "front"', gone="restarting ")
        await person.press("home")
        await person.sees("the beginning", gone="running")
        await person.press("left", "right")
        await person.sees("running")
        await person.press("end")
        await person.sees("OK", "running")

    sit_down(recording, scene)


def test_a_time_is_typed(recording: Recording) -> None:
    async def scene(person: Person) -> None:
        await person.press("t")
        await person.types("12:00:04.500")
        await person.sees("restarting", "ERROR")
        await person.press("t")
        await person.types("soon")
        await person.sees("time: expected a time")
        await person.press("t")
        await person.types("start")
        await person.sees("the beginning", gone="running")

    sit_down(recording, scene)


def test_it_goes_to_the_next_time_that_something_became_so(recording: Recording) -> None:
    async def scene(person: Person) -> None:
        await person.sees("restarted")
        await person.press("home", "slash")
        await person.types("lens OK")
        await person.sees('cameras/lens "front" became OK')
        await person.press("n")
        await person.sees("OK", gone="ERROR  ")
        await person.press("n")
        await person.sees("lens OK: 2 times, none later")
        await person.press("N", "N")
        await person.sees("lens OK: 2 times, none earlier")
        await person.press("slash")
        await person.types("maps ERROR")
        await person.sees("nothing of this name has changed")
        await person.press("slash", "q", "m", "escape")  # where something is typed, keys are characters
        await person.sees("nothing of this name has changed")

    sit_down(recording, scene)


def test_a_mark_shows_what_is_different_from_it(recording: Recording) -> None:
    async def scene(person: Person) -> None:
        await person.press("t")
        await person.types("+2s")
        await person.press("m", "right", "right")
        await person.sees("OK → ERROR", "running → restarting")
        await person.press("m")
        await person.sees("the mark is taken away", gone="→")

    sit_down(recording, scene)


def test_a_question_mark_shows_the_keys(recording: Recording) -> None:
    async def scene(person: Person) -> None:
        await person.press("question_mark")
        await person.finds(lambda: isinstance(person.screen.screen, RewindKeys))
        await person.press("q")
        await person.finds(lambda: not isinstance(person.screen.screen, RewindKeys))

    sit_down(recording, scene)


def test_an_empty_recording_is_shown(recording: Recording) -> None:
    async def scene(person: Person) -> None:
        await person.sees("the beginning")
        await person.press("left", "right", "m", "n")
        await person.sees("the beginning")

    sit_down(Recording("quiet"), scene)


@pytest.fixture
def tmux(recording: Recording, tmp_path: Path) -> Iterator[Tmux]:
    """`rr-actors rewind` in a real terminal."""
    recording.save(tmp_path / "crash.jsonl")
    with terminal(tmp_path, "rewind", str(tmp_path / "crash.jsonl"), columns=100, lines=24) as tmux:
        yield tmux


@needs_tmux
def test_it_runs_in_a_real_terminal(tmux: Tmux) -> None:
    def shows(*texts: str) -> bool:
        screen = tmux("capture-pane", "-p")
        return all(text in screen for text in texts)

    eventually(lambda: shows("restarted"), LIMIT_S)
    tmux("send-keys", "Left", "Left")
    eventually(lambda: shows("step 4 of 6", "SIGKILL"), LIMIT_S)
    tmux("send-keys", "q")
    eventually(lambda: shows("exit code 0"), LIMIT_S)
