"""Timelines: from entries to lanes, bars and marks; and their pictures."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

import rr_actors as rr
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import entry_of
from rr_actors.system.recording.timeline_lanes import (
    KINDS,
    Bar,
    Lane,
    Lanes,
    Mark,
    chosen_lanes,
    merged_bars,
    merged_marks,
)
from rr_actors.system.recording.timelines import MOST_SENT, SHAPES, Timeline, read_timeline, timeline_of
from support import Workshop, eventually, kill
from support_managers import Order, Shop

Start = Callable[..., rr.System]
SVG = "{http://www.w3.org/2000/svg}"


def child(at: float, event: str, path: str = "root/a", pid: int = 7, **facts: object) -> Entry:
    told = {"event": event, "at": at, "path": path, "kind": "manager", "run": 1, "pid": pid}
    return entry_of(Event.of(told | facts))


def resource(at: float, event: str, detail: str = "", registrar: str = "a") -> Entry:
    facts = {"registrar": registrar, "server": f"{registrar}/lamp", "resource_id": "x", "request": '"front"'}
    return entry_of(Event.of({"event": event, "at": at, "detail": detail} | facts))


def lanes_of(*entries: Entry) -> dict[str, Lane]:
    return {lane.path: lane for lane in timeline_of(entries).lanes}


KILLED: dict[str, Any] = {"reason": "killed", "detail": "SIGKILL", "signal": "SIGKILL"}

LIVES: list[tuple[str, list[Entry], list[Bar]]] = [
    ("one that goes on", [child(12.0, "started", ready_s=2.0)], [Bar(10.0, None, 12.0, 7)]),
    (
        "one that is killed, and the next",
        [
            child(12.0, "started", ready_s=2.0),
            child(15.0, "exited", up_s=3.0, **KILLED),
            child(17.0, "restarted", pid=8, ready_s=1.0),
        ],
        [Bar(10.0, 15.0, 12.0, 7, "killed"), Bar(16.0, None, 17.0, 8)],
    ),
    (
        "one that began before the recording",
        [child(15.0, "stopped", reason="shutdown", up_s=9.0, ready_s=1.0)],
        [Bar(5.0, 15.0, 6.0, 7, "stopped")],
    ),
    (
        "one whose end nobody has seen, as the system was killed",
        [child(12.0, "started"), child(20.0, "started", pid=8, ready_s=1.0)],
        [Bar(12.0, 19.0, 12.0, 7, "unknown"), Bar(20.0 - 1.0, None, 20.0, 8)],
    ),
    (
        "one that recovers resources before it is ready",
        [
            Entry(18.5, "began", process="root/a", pid=8, registrar="a", name="recover"),
            child(20.0, "restarted", pid=8, ready_s=2.0),
        ],
        [Bar(18.0, None, 20.0, 8)],
    ),
    (
        "one of which only messages are recorded",
        [Entry(18.5, "sent", process="root/a", pid=8, registrar="a", peer="b", name="Load")],
        [Bar(None, None, None, 8)],
    ),
    (
        "one whose last message comes after its end",
        [
            child(12.0, "started", ready_s=2.0),
            child(15.0, "exited", reason="normal"),
            Entry(15.1, "sent", process="root/a", pid=7, registrar="a"),
        ],
        [Bar(10.0, 15.0, 12.0, 7, "stopped")],
    ),
    ("one that cannot start", [child(12.0, "start_failed", detail="ValueError")], []),
    (
        "one that ends with its root",
        [
            child(12.0, "started"),
            entry_of(Event.of({"event": "ended", "at": 14.0, "path": "root", "reason": "shutdown"})),
        ],
        [Bar(12.0, 14.0, 12.0, 7, "stopped")],
    ),
]


@pytest.mark.parametrize(("entries", "bars"), [life[1:] for life in LIVES], ids=[life[0] for life in LIVES])
def test_a_life_is_a_bar(entries: list[Entry], bars: list[Bar]) -> None:
    assert lanes_of(*entries)["root/a"].bars == bars


MARKS: list[tuple[Entry, str, str]] = [
    (child(1.0, "exited", up_s=3.0, **KILLED), "killed", "exited  root/a  killed: SIGKILL, after 3 s"),
    (child(1.0, "exited", reason="abnormal", detail="ValueError: no"), "crashed", "abnormal: ValueError: no"),
    (child(1.0, "exited", reason="normal"), "stopped", "normal"),
    (child(1.0, "stopped", reason="killed", detail="too slow"), "killed", "killed: too slow"),
    (child(1.0, "start_failed", detail="ValueError: no"), "start_failed", "ValueError: no"),
    (child(1.0, "restarted"), "restarted", "pid 7"),
    (resource(1.0, "loaded"), "loaded", 'loaded  a/lamp "front"'),
    (resource(1.0, "load_failed", "ValueError: no"), "failed", 'load_failed  a/lamp "front"  ValueError: no'),
    (resource(1.0, "status", "FATAL lost: no lens"), "lost", "FATAL lost: no lens"),
    (resource(1.0, "status", "FATAL unplugged"), "ERROR", "FATAL unplugged"),
    (resource(1.0, "status", "WARNING dirty"), "WARNING", "WARNING dirty"),
    (resource(1.0, "status", "OK"), "status", "OK"),
    (resource(1.0, "unloaded"), "unloaded", 'unloaded  a/lamp "front"'),
    (
        Entry(1.0, "ended", process="root/a", pid=7, registrar="a", name="recover", server="a/lamp"),
        "restored",
        "restored  a/lamp",
    ),
]


@pytest.mark.parametrize(("entry", "kind", "text"), MARKS, ids=[f"{kind}: {text}" for _, kind, text in MARKS])
def test_an_event_is_a_mark_that_says_why(entry: Entry, kind: str, text: str) -> None:
    before = child(0.0, "started")
    (_, mark) = lanes_of(before, entry)["root/a"].marks

    assert (mark.at, mark.kind, mark.count) == (1.0, kind, 1)
    assert text in mark.text


def test_a_callback_that_could_not_recover_is_no_mark_as_the_status_says_that_it_is_lost() -> None:
    failed = Entry(1.0, "ended", process="root/a", pid=7, registrar="a", name="recover", detail="ValueError: no")

    assert lanes_of(failed)["root/a"].marks == []


def test_the_supervisor_gives_up_not_its_child() -> None:
    lanes = lanes_of(child(1.0, "started", "root/inner/a"), child(2.0, "gave_up", "root/inner/a", detail="2 restarts"))

    (mark,) = lanes["root/inner"].marks
    assert (mark.kind, lanes["root/inner"].kind) == ("gave_up", "supervisor")
    assert "2 restarts" in mark.text
    assert lanes["root/inner"].bars == [Bar(1.0)]


def test_the_lanes_stand_as_in_the_tree_and_an_applications_registrar_is_on_the_roots() -> None:
    lanes = lanes_of(
        child(1.0, "started", "root/inner/b"),
        child(1.1, "started", "root/a"),
        child(1.2, "started", "root/inner/c"),
        resource(1.3, "loaded", registrar="app"),
        resource(1.4, "loaded", registrar="c"),
    )

    assert list(lanes) == ["root", "root/inner", "root/inner/b", "root/inner/c", "root/a"]
    assert [mark.kind for mark in lanes["root"].marks] == ["loaded"]
    assert [mark.kind for mark in lanes["root/inner/c"].marks] == ["started", "loaded"]


def test_marks_that_are_too_close_are_one_that_has_the_worst_kind_and_counts() -> None:
    marks = [
        Mark(1.0, "loaded", "one"),
        Mark(1.1, "killed", "two"),
        Mark(1.2, "loaded", "three"),
        Mark(9.0, "lost", ""),
    ]
    first, last = merged_marks(marks, 1.0)

    assert (first.kind, first.count, first.counts) == ("killed", 3, {"loaded": 2, "killed": 1})
    assert first.text.splitlines() == ["1 × killed, 2 × loaded", "two", "one", "three"]
    assert last is marks[-1]
    (again,) = merged_marks([first, last], 100.0)
    assert (again.kind, again.count, again.counts) == ("killed", 4, {"killed": 1, "lost": 1, "loaded": 2})


def test_a_mark_with_a_count_beside_it_needs_more_room() -> None:
    marks = [Mark(at, "loaded", "") for at in (0.0, 0.5, 1.5, 4.0)] + [Mark(4.5, "killed", "")]

    assert [(mark.count, mark.label) for mark in merged_marks(marks, 1.0)] == [(2, "2"), (1, ""), (2, "+")]
    assert [(mark.count, mark.label) for mark in merged_marks(marks, 1.0, 1.0)] == [(3, "3"), (2, "+")]
    assert Mark(0.0, "killed", "", 12_500, {"killed": 12_000, "loaded": 500}).label == "12k+"


def test_lives_that_are_too_short_are_one_bar_that_counts_them() -> None:
    lives = [Bar(number / 10, number / 10 + 0.05) for number in range(10)]

    assert [bar.count for bar in merged_bars(lives, 0.4)] == [4, 4, 2]
    assert merged_bars(lives, 0.01) == lives
    (long, going_on) = merged_bars([Bar(0.0, 9.0), Bar(9.1)], 1.0)
    assert (long.count, going_on.count) == (1, 1)


def test_a_lane_keeps_a_bounded_number_however_often_its_child_dies() -> None:
    building = Lanes()
    for number in range(20_000):
        building.take(child(number, "restarted", pid=number + 1))
        building.take(child(number + 0.5, "exited", pid=number + 1, **KILLED))
    lane = next(lane for lane in building.lanes() if lane.path == "root/a")

    assert len(lane.bars) <= 4000
    assert len(lane.marks) <= 4000
    assert sum(bar.count for bar in lane.bars) == 20_000
    assert sum(mark.count for mark in lane.marks) == 40_000


def test_of_too_many_lanes_those_with_trouble_are_chosen_with_the_supervisors_above_them() -> None:
    entries = [child(1.0, "started", f"root/s{number // 10}/c{number}") for number in range(100)]
    lanes = timeline_of([*entries, child(2.0, "exited", "root/s7/c77", **KILLED)]).lanes

    assert [lane.path for lane in chosen_lanes(lanes, 3)] == ["root", "root/s7", "root/s7/c77"]
    assert chosen_lanes(lanes, 1000) is lanes


# -- pictures --------------------------------------------------------------------------------------------------------


def texts(svg: str) -> str:
    return " ".join(ElementTree.fromstring(svg).itertext())


def test_each_kind_has_a_shape_and_a_colour_of_its_own_or_at_least_one_of_them() -> None:
    svg = Timeline([Lane("root", "", [], [Mark(float(n), kind, kind) for n, kind in enumerate(KINDS)])], 0, 20).svg()

    assert set(SHAPES) == set(KINDS)
    looks = re.findall(r'class="mark (k-\w+)" transform="[^"]*" d="([^"]*)"', svg)
    assert len(set(looks)) == len(KINDS)


def test_a_picture_is_svg_that_says_what_happened_whatever_is_in_it() -> None:
    hostile = 'ValueError: <img onerror="x"> & \x00 \x1b[2J'
    svg = timeline_of([child(1.0, "started"), child(2.0, "exited", reason="abnormal", detail=hostile)], "<b>").svg()

    assert '<img onerror="x">' in texts(svg)
    assert "<b>, " in texts(svg)
    assert "prefers-color-scheme: dark" in svg
    assert timeline_of([])._repr_svg_().count("nothing has happened") == 2


@pytest.mark.slow
def test_a_picture_of_many_children_and_lives_is_bounded_and_counts_what_it_leaves_out() -> None:
    entries = [
        child(at, event, f"root/c{number}", pid=at + 1, reason="killed" if event == "exited" else "")
        for at in range(400)
        for number in range(200)
        for event in ("restarted", "exited")
    ]
    timeline = timeline_of(entries)

    assert "left out: 51 lanes with less trouble" in texts(timeline.svg())
    assert len(timeline.svg()) < 8_000_000
    plain = timeline.plain()
    assert sum(len(lane["bars"]) + len(lane["marks"]) for lane in plain["lanes"]) <= MOST_SENT
    assert sum(bar[4] for lane in plain["lanes"] for bar in lane["bars"] if lane["path"] != "root") == 80_000


def test_a_real_kill_is_seen_in_a_recording_in_its_file_and_in_the_history(
    start: Start, workshop: Workshop, tmp_path: Path, state_dir: Path
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    with system.record() as recording:
        app.load("shop/thing", Order("chair"))
        kill(system, "shop")
        eventually(lambda: any(entry.event == "restarted" for entry in recording.entries()))
    recording.save(tmp_path / "run.jsonl")
    history = next(state_dir.rglob("history.jsonl"))
    for timeline in (timeline_of(recording.entries()), read_timeline(tmp_path / "run.jsonl"), read_timeline(history)):
        (lane,) = [lane for lane in timeline.lanes if lane.path == "root/shop"]
        assert [bar.how for bar in lane.bars] == ["killed", ""]
        kinds = [mark.kind for mark in lane.marks]
        assert kinds.index("killed") < kinds.index("restarted")
        assert "SIGKILL" in texts(timeline.svg())
    assert "loaded" in [mark.kind for lane in read_timeline(tmp_path / "run.jsonl").lanes for mark in lane.marks]


def test_a_life_before_the_first_event_is_drawn_from_the_beginning_of_the_recording(tmp_path: Path) -> None:
    began = time.time() - 60
    file = tmp_path / "run.jsonl"
    killed = {"at": began + 5, "event": "exited", "process": "root/a", "facts": {"reason": "killed", "up_s": 30.0}}
    file.write_text(f"{json.dumps({'recording': 1, 'system': 's', 'at': began})}\n{json.dumps(killed)}\n")

    timeline = read_timeline(file)

    assert (timeline.since, timeline.until) == (began, began + 5)
    ((bar,),) = [lane.bars for lane in timeline.lanes if lane.path == "root/a"]
    assert (bar.begin, bar.end, bar.how) == (began - 25, began + 5, "killed")


# -- files -----------------------------------------------------------------------------------------------------------

HEADER = json.dumps({"recording": 1, "system": "s", "at": 1.0})
STARTED = json.dumps({"event": "started", "path": "root/a", "kind": "actor", "run": 1, "at": time.time()})
BAD = {
    "nothing": "",
    "no JSON": "hello\n",
    "other JSON": "{}\n",
    "a broken line of a history": f'{STARTED}\n{{"event": 3}}\n{STARTED}\n',
    "a time that no calendar has": f'{HEADER}\n{{"at": 1e300, "event": "sent"}}\n',
    "facts of another type": f'{HEADER}\n{{"at": 1, "event": "exited", "process": "a", "facts": {{"up_s": "x"}}}}\n',
    "a history of the year 10^20": STARTED.replace('"at": ', '"at": 1e20, "b": ') + "\n",
}


@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
def test_a_file_that_is_neither_a_recording_nor_a_history_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    file = tmp_path / "file"
    file.write_text(text)

    with pytest.raises(rr.ConfigError, match="file"):
        read_timeline(file)


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(rr.ConfigError, match="cannot be read"):
            read_timeline(path)


def test_a_last_line_of_a_history_that_is_not_whole_is_left_out(tmp_path: Path) -> None:
    file = tmp_path / "history.jsonl"
    file.write_text(f"{STARTED}\n".replace(", ", ",").replace(": ", ":") + '{"event":"exi')

    assert [lane.path for lane in read_timeline(file).lanes] == ["root", "root/a"]


def test_programs_that_know_no_variables_have_a_colour_for_each() -> None:
    svg = timeline_of(()).svg()

    colours = re.findall(r"(\w+): (#\w+); \1: var\(", svg)
    assert len(colours) == svg.count("var(")
