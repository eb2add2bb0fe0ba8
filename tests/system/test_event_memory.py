"""The memory of a system: what happened while nobody watched is there afterwards, within its bounds."""

from __future__ import annotations

import json
import logging
import math
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.folder import Folder
from rr_actors.managers import Alternative, Choices, Choose, Chosen, Keeper, Kept
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_questions import ListEvents, ListHistory
from rr_actors.system.recording import event_memory
from rr_actors.system.recording.event_memory import FILE, OLDER, Event, EventMemory, left_events
from rr_actors.tools.web.watch import Watch
from support import LIMIT_S, Workshop, eventually, kill, pid_of, serve, wait_respawned
from support_inside import node_of
from support_managers import Order, Shop

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


def remembered(state_dir: Path, about: str = "") -> list[Event]:
    with ConsoleConnection(find_console(state_dir)) as connection:
        return connection.ask(ListEvents(about)).events


def kinds(events: list[Event]) -> list[str]:
    return [event.event for event in events]


# -- what is remembered ------------------------------------------------------------------------------------------------


def refuse(number: int) -> None:
    if number < 0:
        raise ValueError("no such number")


def test_what_happened_to_a_resource_before_anybody_watched_is_remembered(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing", load=refuse)
    query = app.load("provider/thing", 1)
    with pytest.raises(rr.LoadFailed):
        app.load("provider/thing", -1)
    provider.send_status(query, rr.Status("ERROR", "no frame"))
    query.wait_status("ERROR")
    provider.revoke(query.resource_id, "too hot", grace_s=5)

    events = [event for event in remembered(state_dir) if event.facts.get("server") == "provider/thing"]

    told = [(event.event, event.facts["detail"]) for event in events]
    failed, status, revoked, fatal = told
    assert failed[0] == "load_failed"
    assert "no such number" in failed[1]
    assert status == ("status", "ERROR no frame")
    assert {revoked, fatal} == {("revoked", "too hot"), ("status", "FATAL too hot")}
    assert [event.at for event in events] == sorted(event.at for event in events)
    assert all(abs(event.at - time.time()) < 60 for event in events)


def test_a_load_that_went_well_is_not_written_and_one_that_took_long_is(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing", load=lambda seconds: time.sleep(seconds))
    app.load("provider/thing", 0.0).unload()
    app.load("provider/thing", 1.2).unload()

    (event,) = remembered(state_dir)

    assert (event.event, event.facts["request"]) == ("loaded", "1.2")
    assert event.facts["detail"].startswith("took 1.")


def test_a_status_that_says_nothing_new_is_remembered_once(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", 1)
    for message in ("hot", "hot", "hot", "burns"):
        provider.send_status(query, rr.Status("WARNING", message))

    def told() -> list[str]:
        return [event.facts["detail"] for event in remembered(state_dir)]

    assert eventually(lambda: told() == ["WARNING hot", "WARNING burns"])


def test_a_manager_in_a_process_of_its_own_is_killed_and_what_happened_there_is_remembered(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    query = system.open_registrar("app").load("shop/thing", Order("lamp"))
    system.registrar("shop").send_status(query, rr.Status("ERROR", "no frame"))
    query.wait_status("ERROR")
    pid = pid_of(system, "shop")
    kill(system, "shop")
    wait_respawned(system, "shop", pid)

    said = eventually(lambda: kinds(remembered(state_dir))[:4] if len(remembered(state_dir)) >= 4 else [])

    assert said == ["started", "status", "exited", "restarted"]
    assert kinds(remembered(state_dir, query.resource_id))[0] == "status"
    with ConsoleConnection(find_console(state_dir)) as connection:
        assert kinds(connection.ask(ListHistory("shop")).events) == ["started", "exited", "restarted"]


SENSORS = [Alternative("range", f"sensors/{name}", "front", {"rate_hz": rate}) for name, rate in (("a", 30), ("b", 10))]


def test_a_choice_that_has_changed_is_remembered(start: Start, state_dir: Path) -> None:
    system = start(rr.ChildSpec(Choices, id="choices", args=(SENSORS, 600.0)))
    app, sensors = system.open_registrar("app"), system.open_registrar("sensors")
    for name in ("a", "b"):
        serve(sensors, name)
    choice = app.load("choices/choice", Choose("range", prefer=["rate_hz"]), response_type=Chosen)
    assert choice.response.server == "sensors/a"
    sensors.send_status(sensors.resources()[0], rr.Status("FATAL", "unplugged"))
    assert eventually(lambda: choice.response.server == "sensors/b")

    def told() -> list[str]:
        events = remembered(state_dir, choice.resource_id)
        return [event.facts["detail"] for event in events if event.event == "status"]

    (said,) = eventually(told)
    assert said.startswith("UPDATE ")
    assert "unplugged" in said


def test_a_kept_thing_that_is_missing_is_remembered(start: Start, state_dir: Path, tmp_path: Path) -> None:
    file = tmp_path / "keep.toml"
    file.write_text('[[keep]]\nname = "lamp"\nserver = "things/thing"\nrequest = "x"\n')
    system = start(rr.ChildSpec(Keeper, id="keeper", args=(str(file),)))
    things = system.open_registrar("things")
    serve(things, "thing")
    app = system.open_registrar("app")
    kept = app.load("keeper/kept", "lamp", response_type=Kept)
    assert eventually(lambda: kept.response.ready == 1)
    things.unregister_server("thing")

    def told() -> list[str]:
        return [event.facts["detail"] for event in remembered(state_dir, kept.resource_id)]

    assert eventually(lambda: any(said.startswith("ERROR") for said in told()))


def test_somebody_who_watches_does_not_make_the_system_remember_more(
    app: rr.Registrar, provider: rr.Registrar, system: rr.System, state_dir: Path
) -> None:
    heard: list[str] = []
    system.subscribe(lambda event: heard.append(event["event"]))
    serve(provider, "thing")
    app.load("provider/thing", 1).unload()
    assert eventually(lambda: heard == ["loaded", "unloaded"])

    assert remembered(state_dir) == []


APPLICATION = """
import sys
import rr_actors as rr

class Idle(rr.Manager):
    pass

with rr.System([rr.ChildSpec(Idle, id="idle")], state_dir=sys.argv[1]) as system:
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    provider.register_server("thing", lambda request: request)
    query = app.load("provider/thing", 1)
    provider.send_status(query, rr.Status("ERROR", sys.argv[2]))
    query.wait_status("ERROR")
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def application(tmp_path: Path, state_dir: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    file = tmp_path / "application.py"
    file.write_text(APPLICATION)
    processes: list[subprocess.Popen[str]] = []

    def begin(message: str) -> subprocess.Popen[str]:
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        process = subprocess.Popen([sys.executable, file, state_dir, message], **pipes)
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield begin
    for process in processes:
        process.communicate(timeout=LIMIT_S)


def test_what_a_killed_application_remembered_is_in_its_state_directory_and_comes_first_in_the_next_run(
    application: Callable[[str], subprocess.Popen[str]], state_dir: Path
) -> None:
    first = application("no frame")
    first.send_signal(signal.SIGKILL)
    first.wait(LIMIT_S)

    assert kinds(left_events(state_dir, 100)) == ["started", "status"]
    with (state_dir / FILE).open("ab") as file:  # as if it had been killed within the write
        file.write(b'{"event":"exited","at":17')

    application("no light")

    events = remembered(state_dir)
    assert kinds(events) == ["started", "status", "started", "status"]
    assert [event.facts["detail"] for event in events[1::2]] == ["ERROR no frame", "ERROR no light"]


# -- its bounds --------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Folder]:
    with Folder.at(tmp_path) as folder:
        yield folder


def event_of(number: int, at: float | None = None) -> dict[str, Any]:
    return {"event": "status", "at": time.time() if at is None else at, "detail": f"{number:06}"}


def numbers(events: list[Event]) -> list[int]:
    return [int(event.facts["detail"]) for event in events]


def test_the_files_are_bounded_in_bytes_and_have_the_newest(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_memory, "_RING_BYTES", 200)
    limit = 20_000
    memory = EventMemory(folder, limit, 3600.0)
    for number in range(2000):
        memory.take(event_of(number))
        assert sum(os.stat(folder.path / name).st_size for name in (FILE, OLDER) if folder.has(name)) <= limit

    found = numbers(memory.newest(10_000))

    assert found == list(range(found[0], 2000))
    assert len(found) > 100  # at least half of the limit
    assert numbers(memory.newest(3)) == [1997, 1998, 1999]
    assert numbers(memory.newest(3, lambda event: event.facts["detail"] < "001990")) == [1987, 1988, 1989]
    assert numbers(memory.newest(5, about="001995")) == [1995]
    assert numbers(left_events(folder.path, 10_000)) == found


def test_what_is_older_than_the_bound_is_forgotten(folder: Folder) -> None:
    now = time.time()
    memory = EventMemory(folder, 2**20, 100.0)
    for number, ago_s in enumerate((500, 450, 90, 10)):
        memory.take(event_of(number, now - ago_s))

    assert numbers(memory.newest(10)) == [2, 3]
    for number in range(4, 8):
        memory.take(event_of(number, now + 120 * number))

    assert "000000" not in (folder.path / OLDER).read_text() + (folder.path / FILE).read_text()


def test_the_bounds_are_those_of_the_configuration(start: Start, state_dir: Path) -> None:
    config = rr.SystemConfig(events_limit_bytes=4_000, events_kept_s=1_000.0)
    system = start(config=config)
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "thing")
    query = app.load("provider/thing", 1)
    for number in range(50):
        provider.send_status(query, rr.Status("WARNING", str(number)))
    assert eventually(lambda: "WARNING 49" in str(remembered(state_dir)))

    assert sum((state_dir / name).stat().st_size for name in (FILE, OLDER)) <= 4_000


def test_a_full_disk_costs_memory_on_disk_alone_and_is_told_once(
    folder: Folder, caplog: pytest.LogCaptureFixture
) -> None:
    memory = EventMemory(folder, 2**20, 3600.0)
    memory.take(event_of(0))
    size = (folder.path / FILE).stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 20, before[1]))  # the next line is cut
        with caplog.at_level(logging.WARNING):
            for number in (1, 2, 3):
                memory.take(event_of(number))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    memory.take(event_of(4))

    assert numbers(memory.newest(10)) == [0, 1, 2, 3, 4]
    assert numbers(left_events(folder.path, 10)) == [0, 4]
    (said,) = [record.getMessage() for record in caplog.records if FILE in record.getMessage()]
    assert "not written" in said


DAMAGE = {
    "no JSON": b"hello\n",
    "no text": b"\xff\xfe\n",
    "nothing": b"\n",
    "a time that is a text": b'{"event":"status","at":"now"}\n',
    "a path that is a number": b'{"event":"exited","at":1.0,"path":3}\n',
    "a list": b"[]\n",
    "very deep": b'{"event":"status","at":1.0,"detail":' + b"[" * 100_000 + b"\n",
    "cut": b'{"event":"status","at":17',
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_line_is_left_out_and_the_others_are_read(folder: Folder, damage: bytes) -> None:
    EventMemory(folder, 2**20, 3600.0).take(event_of(0))
    with (folder.path / FILE).open("ab") as file:
        file.write(damage)

    memory = EventMemory(folder, 2**20, 3600.0)
    memory.take(event_of(1))

    assert numbers(memory.newest(10)) == [0, 1]
    assert numbers(left_events(folder.path, 10)) == [0, 1]


def test_a_directory_in_the_place_of_the_file_costs_memory_on_disk_alone(folder: Folder) -> None:
    (folder.path / FILE).mkdir()
    memory = EventMemory(folder, 2**20, math.inf)
    memory.take(event_of(0))

    assert numbers(memory.newest(10)) == [0]
    assert left_events(folder.path / "none", 10) == []


def test_a_file_that_is_removed_while_the_system_runs_is_made_again(system: rr.System, state_dir: Path) -> None:
    node = node_of(system)
    told = {"registrar": "provider", "server": "provider/thing", "resource_id": "x", "request": "1", "kept": True}
    node.dispatcher.call(lambda: node.emit("status", detail="ERROR 1", **told))
    eventually(lambda: (state_dir / FILE).exists())
    (state_dir / FILE).unlink()
    node.dispatcher.call(lambda: node.emit("status", detail="ERROR 2", **told))

    assert eventually((state_dir / FILE).exists)
    assert [event.facts["detail"] for event in remembered(state_dir)] == ["ERROR 1", "ERROR 2"]
    (line,) = (state_dir / FILE).read_text().splitlines()
    assert json.loads(line)["detail"] == "ERROR 2"
    assert "kept" not in json.loads(line)


# -- what shows it -----------------------------------------------------------------------------------------------------


def test_a_page_that_is_opened_later_begins_with_what_happened_before_and_tells_it_once(
    app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", 1)
    provider.send_status(query, rr.Status("ERROR", "no frame"))
    assert eventually(lambda: kinds(remembered(state_dir)) == ["status"])

    watch = Watch(state_dir)
    watch.start()
    try:
        assert eventually(lambda: [line.how for line in watch.lines.lines()] == ["ERROR no frame"])
        provider.send_status(query, rr.Status("WARNING", "dusty"))
        assert eventually(lambda: [line.times for line in watch.lines.lines()] == [1, 1])
        marks = [mark.text for lane in watch.timeline().lanes for mark in lane.marks]
    finally:
        watch.stop()

    assert ["no frame" in mark for mark in marks] == [True, False]
