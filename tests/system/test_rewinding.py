"""Rewinding recordings of real systems: at the end they say what the live console says, and before, what it said."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.base.errors import ConfigError
from rr_actors.system.console.console_connection import ConsoleConnection, find_console, read_pages
from rr_actors.system.console.console_questions import ListChildren, ListResources
from rr_actors.system.recording.recordings import Recording
from rr_actors.system.recording.timelines import read_timeline
from rr_actors.system.rewound.moments import Moment
from rr_actors.system.rewound.rewinding import rewind
from support import Workshop, eventually, hang, kill, wait_respawned
from support_cli import run_cli
from support_managers import Order, Shop

Start = Callable[..., rr.System]
Told = tuple[dict[str, tuple[str, int | None]], dict[str, tuple[str, str]]]


def told_live(state_dir: Path) -> Told:
    """What the console says: of each child its state and process, of each resource its state and message."""
    with ConsoleConnection(find_console(state_dir)) as connection:
        children = [row for page in read_pages(connection.ask, ListChildren()) for row in page.rows]
        resources = [row for page in read_pages(connection.ask, ListResources()) for row in page.rows]
    return (
        {row.path: (row.state, row.pid) for row in children},
        {f"{row.server} {row.id}": (row.condition, row.message) for row in resources},
    )


def told_then(moment: Moment) -> Told:
    return (
        {child.path: (child.state, child.pid) for child in moment.tree},
        {f"{one.server} {one.id}": (one.condition, one.message) for one in moment.listed},
    )


def last(recording: Recording) -> Told:
    rewound = rewind(recording)
    return told_then(rewound.moment(len(rewound)))


@pytest.fixture
def shops(start: Start, workshop: Workshop) -> rr.System:
    """A system with two managers in processes of their own, one below a supervisor."""
    root = str(workshop.root)
    below = rr.Supervisor([rr.ChildSpec(Shop, id="lidars", args=(root,))], id="sensors")
    return start(rr.ChildSpec(Shop, id="robots", args=(root,)), below)


def test_the_end_of_a_recording_is_what_the_console_says_and_its_beginning_was(
    shops: rr.System, state_dir: Path, tmp_path: Path
) -> None:
    app = shops.open_registrar("app")
    front, back = (app.load("lidars/thing", Order(name)) for name in ("front", "back"))
    before = told_live(state_dir)

    with shops.record(tmp_path / "crash.jsonl") as recording:
        app.load("robots/thing", Order("r2", ("lidars/thing:front",)))
        shops.registrar("lidars").send_status(front.resource_id, rr.Status(rr.State.ERROR, "dust"))
        pid = shops.ref("lidars").pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        back.unload()
        eventually(lambda: shops.ref("lidars").pid != pid)
        shops.supervisor().terminate_child("sensors")
        shops.supervisor().restart_child("sensors")
        eventually(lambda: last(recording) == told_live(state_dir), what="the recording says what the console says")

    assert told_then(rewind(recording).moment(0)) == before
    assert told_then(rewind(tmp_path / "crash.jsonl").moment(0)) == before
    assert last(rr.read_recording(tmp_path / "crash.jsonl")) == last(recording)


def test_the_command_records_what_is_there_when_it_begins(shops: rr.System, state_dir: Path, tmp_path: Path) -> None:
    shops.open_registrar("app").load("lidars/thing", Order("front"))
    before = told_live(state_dir)

    ran = run_cli("record", tmp_path / "quiet.jsonl", "--seconds", "0.1", "--state", state_dir)

    assert ran.returncode == 0, ran.stderr
    rewound = rewind(tmp_path / "quiet.jsonl")
    assert (told_then(rewound.moment(0)), rewound.knows_beginning, rewound.left_out) == (before, True, 0)


def test_a_saved_recording_has_its_beginning(shops: rr.System, tmp_path: Path) -> None:
    query = shops.open_registrar("app").load("lidars/thing", Order("front"))
    with shops.record() as recording:
        pass

    recording.save(tmp_path / "quiet.jsonl")

    moment = rewind(tmp_path / "quiet.jsonl").moment(0)
    assert moment == rewind(recording).moment(0)
    assert query.resource_id in moment.resources


def test_a_state_directory_tells_the_lives_of_children_also_after_the_end(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    pid = kill(system, "shop")
    wait_respawned(system, "shop", pid)
    system.stop()

    rewound = rewind(state_dir)
    lives = [(step.entry.event, rewound.moment(step.number).children["root/shop"]) for step in rewound.steps]

    assert [event for event, _ in lives] == ["started", "exited", "restarted", "stopped"]
    assert [child.state for _, child in lives] == ["running", "restarting", "running", "stopped"]
    assert (lives[0][1].pid, lives[1][1].pid, lives[3][1].restarts) == (pid, None, 1)
    assert [lane.path for lane in read_timeline(state_dir).lanes] == ["root", "root/shop"]
    assert rewind(state_dir / "history.jsonl").moment(2).children == rewound.moment(2).children


def test_a_child_that_starts_takes_none_of_the_others_away(start: Start, workshop: Workshop, state_dir: Path) -> None:
    specs = [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),), placement="thread") for id in ("a", "b", "c")]
    system = start(*specs[:2])
    with system.record() as recording:
        system.supervisor().start_child(specs[2])
        eventually(lambda: last(recording) == told_live(state_dir), what="the recording says what the console says")

    rewound = rewind(state_dir)
    assert ["".join(sorted(id[5:] for id in rewound.moment(number).children)) for number in (1, 2, 3)] == [
        "a",
        "ab",
        "abc",
    ]


def test_a_damaged_recording_says_what_can_still_be_read(shops: rr.System, tmp_path: Path) -> None:
    file = tmp_path / "whole.jsonl"
    with shops.record(file):
        shops.open_registrar("app").load("lidars/thing", Order("front"))
    lines = file.read_bytes().splitlines(keepends=True)
    damaged = tmp_path / "damaged.jsonl"
    damaged.write_bytes(b"".join([*lines[:5], b'{"at": "noon"}\n', *lines[5:]]))
    cut = tmp_path / "cut.jsonl"
    cut.write_bytes(b"".join(lines)[:-3])
    later = tmp_path / "later.jsonl"
    later.write_bytes(lines[0].replace(b'"recording":1', b'"recording":2') + b"".join(lines[1:]))

    with pytest.raises(ConfigError, match=r"line 6: expected what rr-actors record writes, got .*noon") as refused:
        rewind(damaged)
    assert f"the 4 entries before it can still be read: head -n 5 {damaged} > whole.jsonl" in str(refused.value)
    assert rewind(cut).until <= rewind(file).until
    with pytest.raises(ConfigError, match="a recording of version 2, expected 1"):
        rewind(later)


def test_a_load_that_hangs_is_in_the_beginning(shops: rr.System, workshop: Workshop) -> None:
    app = shops.open_registrar("app")
    workshop.shut("load front")
    loading = threading.Thread(target=app.load, args=("lidars/thing", Order("front")))
    loading.start()
    workshop.wait("load front")

    with shops.record() as recording:
        workshop.open("load front")
        loading.join()
        eventually(lambda: len(rewind(recording)) > 0)

    assert [one.condition for one in rewind(recording).moment(0).listed] == ["loading"]
    assert [(one.before, one.after) for one in rewind(recording).steps[0].changes] == [("loading", "OK")]


def test_a_recording_begins_while_a_manager_hangs_and_says_what_it_does_not_know(
    shops: rr.System, state_dir: Path, tmp_path: Path
) -> None:
    shops.open_registrar("app").load("lidars/thing", Order("front"))
    pid = shops.ref("lidars").pid
    assert pid is not None
    hang(pid)
    try:
        with shops.record() as recording:
            preview = shops.preview(kill="lidars")
        ran = run_cli("record", tmp_path / "hung.jsonl", "--seconds", "0.1", "--state", state_dir)
    finally:
        os.kill(pid, signal.SIGCONT)

    rewound = rewind(recording)
    assert "root/sensors/lidars" in rewound.moment(0).children
    assert rewound.moment(0).resources == {}
    assert rewound.notes == ["Unavailable: lidars: it has not answered within 2 s"]
    assert preview.notes == ("Unavailable: lidars: it has not answered within 2 s",)
    assert ran.returncode == 0, ran.stderr
    assert rewind(tmp_path / "hung.jsonl").notes != []
