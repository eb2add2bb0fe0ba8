"""The machine's clock is set forwards and backwards, by days, while a system runs: nothing is killed, lost or late."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
import support_clocks
from rr_actors.managers import Programs, Ready, RunProgram
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from support import Workshop, child, eventually, kill, pid_of, wait_respawned

Start = Callable[..., rr.System]
DAY_S = 86_400.0
JUMPS = (3 * DAY_S, -3 * DAY_S, 3650 * DAY_S, 0.0, -3650 * DAY_S, 0.5, -0.5, 0.0)


class Maker(rr.Manager):
    """Serves things in a process whose clock is set, too."""

    def __init__(self, root: str) -> None:
        self._shop = Workshop(root)

    def on_start(self) -> None:
        support_clocks.install()

    @rr.server("thing", linger_s=0.05)
    def load(self, request: int) -> int:
        self._shop.note("load", request)
        return request

    @load.unload
    def unload(self, request: int, response: int) -> None:
        self._shop.note("unload", request)


@pytest.fixture
def clock(tmp_path: Path) -> Iterator[Callable[[float], None]]:
    """Sets the clock of this process and of those it starts."""
    support_clocks.begin(tmp_path / "clock")
    yield support_clocks.jump
    support_clocks.end()


def _makers(workshop: Workshop) -> list[rr.ChildSpec]:
    root = str(workshop.root)
    backoff = rr.Backoff(delay_s=0.01, maximum_s=0.05)
    return [
        rr.ChildSpec(Maker, id="maker", args=(root,), heartbeat_s=0.5),
        rr.ChildSpec(Maker, id="other", args=(root,), heartbeat_s=0.5, backoff=backoff),
    ]


@pytest.mark.timeout(60)
def test_nothing_is_killed_lost_or_late_when_the_clock_is_set(
    start: Start, workshop: Workshop, clock: Callable[[float], None]
) -> None:
    system = start(*_makers(workshop))
    app = system.open_registrar("app")
    pids = [pid_of(system, "maker"), pid_of(system, "other")]
    kept = app.load("maker/thing", -1)
    statuses: list[rr.Status] = []
    app.on_status("maker/thing", statuses.append)
    longest = 0.0
    for number, offset_s in enumerate(JUMPS):
        clock(offset_s)
        began = time.monotonic()
        for server in ("maker/thing", "other/thing"):
            with app.load(server, number, timeout_s=5.0) as query:
                assert query.response == number
        system.registrar("maker").send_status(kept.id, rr.Status("WARNING", f"jump {number}"))
        eventually(lambda number=number: statuses and statuses[-1].message == f"jump {number}", 5.0)
        assert system.ref("maker").is_alive()
        longest = max(longest, time.monotonic() - began)
        threading.Event().wait(0.6)  # a heartbeat's time and more, in which nobody may be killed
    assert longest < 5.0
    assert [pid_of(system, "maker"), pid_of(system, "other")] == pids
    assert {record.event for record in system.supervisor().history()} == {"started"}
    assert [query.id for query in app.fetch_queries("maker")] == [kept.id]
    kept.unload()
    loads = [line.split()[1] for line in workshop.lines("load")]
    eventually(lambda: sorted(line.split()[1] for line in workshop.lines("unload")) == sorted(loads))


@pytest.mark.timeout(60)
def test_restarts_are_counted_and_delayed_by_a_clock_that_nobody_sets(
    start: Start, workshop: Workshop, clock: Callable[[float], None]
) -> None:
    """Five restarts in an hour are allowed. By the wall clock each would be a day after, or before, the last."""
    system = start(rr.Supervisor(_makers(workshop), max_restarts=5, max_seconds=3600.0))
    app = system.open_registrar("app")
    held = app.load("other/thing", 7)
    for offset_s in JUMPS[:5]:
        clock(offset_s)
        began = time.monotonic()
        wait_respawned(system, "other", kill(system, "other"))
        assert time.monotonic() - began < 5.0
        assert [query.id for query in app.fetch_queries("other")] == [held.id]
    clock(JUMPS[0])
    kill(system, "other")
    eventually(lambda: child_is_gone(system), what="the sixth restart is one too many, whatever the clock says")


def child_is_gone(system: rr.System) -> bool:
    try:
        return child(system, "other").state == "stopped"
    except rr.RrError:
        return True


def test_ages_that_are_shown_are_those_of_a_clock_that_nobody_sets(
    start: Start, workshop: Workshop, clock: Callable[[float], None], state_dir: Path
) -> None:
    system = start(*_makers(workshop))
    clock(3650 * DAY_S)
    children: list[Any] = system.supervisor().describe()["children"]
    assert all(0 <= each["up_s"] < 60 for each in children)
    with ConsoleConnection(find_console(state_dir)) as console:
        rows = console.children().rows
    assert all(row.up_s is None or 0 <= row.up_s < 60 for row in rows)


@pytest.mark.parametrize("offset_s", [DAY_S, -DAY_S])
def test_a_programs_file_that_is_written_before_or_after_the_clock_is_set_makes_it_ready(
    start: Start, tmp_path: Path, clock: Callable[[float], None], offset_s: float
) -> None:
    system = start(rr.ChildSpec(Programs, id="programs", placement="thread"))
    app = system.open_registrar("app")
    mark, go_on = tmp_path / "mark", tmp_path / "go on"
    code = f"""
import pathlib, threading, time
while not pathlib.Path({str(go_on)!r}).exists():
    time.sleep(0.01)
pathlib.Path({str(mark)!r}).touch()
threading.Event().wait(60)  # until it is ended
"""
    request = RunProgram("python3", ("-c", code), ready=Ready(file=str(mark), timeout_s=8.0))
    for attempt in range(2):  # the second time there is a file already
        loading: Any = app.load("programs/program", request, block=False)
        eventually(lambda: app.stats()["loading"] == 1)
        clock(offset_s * (attempt + 1))
        go_on.touch()
        loading.get(timeout=10).unload()
        go_on.unlink()
