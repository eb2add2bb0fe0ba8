"""Moments: what each entry of a recording changes of the tree and the resources; forward and back, it is the same."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rr_actors.base.errors import ConfigError, UsageError
from rr_actors.registrar.model.recorded import Entry, in_order
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recording, add, entry_of
from rr_actors.system.rewound.moments import Moment, differences, first_moment, moment_after
from rr_actors.system.rewound.rewind_times import time_meant
from rr_actors.system.rewound.rewinding import Rewound, rewind

LENS = "cameras/lens"


def child(event: str, path: str, state: str | None, at: float = 1.0, **facts: Any) -> Entry:
    return entry_of(Event.of({"event": event, "at": at, "path": path, "kind": "manager", "state": state} | facts))


def resource(event: str, detail: str = "", at: float = 1.0, id: str = "x") -> Entry:
    facts = {"registrar": "cameras", "server": LENS, "resource_id": id, "request": '"front"', "detail": detail}
    return entry_of(Event.of({"event": event, "at": at, **facts}))


def callback(event: str, role: str, id: str = "x", detail: str = "") -> Entry:
    return Entry(1.0, event, name=role, resource=id, server=LENS, registrar="cameras", detail=detail)


def load(id: str = "x") -> Entry:
    return Entry(1.0, "sent", name="Load", query=id, server=LENS, detail='"front"')


def states(moment: Moment) -> dict[str, str]:
    """The states of children by path, and of resources by id."""
    return {id: one.condition for id, one in (moment.children | moment.resources).items()}


def supervisor(event: str, path: str, state: str | None, **facts: Any) -> Entry:
    return child(event, path, state, kind="supervisor", **facts)


RUNNING = [child("started", "root/a", "running", run=1), child("started", "root/b", "running", run=1)]
NESTED = [
    child("started", "root/s/a", "running", run=1),
    supervisor("started", "root/s", "running", run=1),
    child("started", "root/b", "running", run=1),
]


def first(path: str, at: float, ready_s: float = 0.5, kind: str = "manager") -> Entry:
    return child("started", path, "running", at=at, kind=kind, run=1, ready_s=ready_s)


TWO = [first("root/a", 1.0), first("root/b", 1.5)]

COURSES: dict[str, tuple[list[Entry], dict[str, str]]] = {
    "nothing": ([], {}),
    "children start": (RUNNING, {"root": "running", "root/a": "running", "root/b": "running"}),
    "a supervisor is being started while its children are": (
        NESTED[:1],
        {"root": "running", "root/s": "starting", "root/s/a": "running"},
    ),
    "a child dies": (
        [*RUNNING, child("exited", "root/a", "restarting", reason="killed")],
        {"root": "running", "root/a": "restarting", "root/b": "running"},
    ),
    "and is started again": (
        [*RUNNING, child("exited", "root/a", "restarting"), child("restarted", "root/a", "running")],
        {"root": "running", "root/a": "running", "root/b": "running"},
    ),
    "a child is forgotten": ([*RUNNING, child("deleted", "root/a", None)], {"root": "running", "root/b": "running"}),
    "all below a supervisor go with it": (
        [*NESTED, supervisor("exited", "root/s", "restarting")],
        {"root": "running", "root/s": "restarting", "root/b": "running"},
    ),
    "a start that fails": (
        [child("start_failed", "root/a", "restarting", run=1, detail="ValueError")],
        {"root": "running", "root/a": "restarting"},
    ),
    "the tree ends": (
        [*RUNNING, entry_of(Event.of({"event": "ended", "at": 2.0, "path": "root", "reason": "shutdown"}))],
        {"root": "stopped", "root/a": "stopped", "root/b": "stopped"},
    ),
    "a system that was killed is followed by another": (
        [*TWO, first("root/b", 9.0)],
        {"root": "running", "root/b": "running"},
    ),
    "that ended": (
        [*TWO, entry_of(Event.of({"event": "ended", "at": 5.0, "path": "root", "reason": "shutdown"})),
         first("root/b", 9.0)],
        {"root": "running", "root/b": "running"},
    ),
    "by a clock that was put back": ([*TWO, first("root/b", 0.9)], {"root": "running", "root/b": "running"}),
    "which has another child, the first": (
        [*TWO, first("root/c", 9.0), first("root/a", 9.6)],
        {"root": "running", "root/c": "running", "root/a": "running"},
    ),
    "children start one after another": (
        [*TWO, first("root/c", 3.0, 1.5)],
        {"root": "running", "root/a": "running", "root/b": "running", "root/c": "running"},
    ),
    "a child is added later": (
        [*TWO, first("root/c", 99.0)],
        {"root": "running", "root/a": "running", "root/b": "running", "root/c": "running"},
    ),
    "a child is taken away, and added again": (
        [*TWO, child("deleted", "root/b", None, at=9.0), first("root/b", 99.0)],
        {"root": "running", "root/a": "running", "root/b": "running"},
    ),
    "of an inner supervisor, too": (
        [first("root/s/a", 1.0), first("root/s/b", 1.5), first("root/s", 1.5, 1.0, "supervisor"), first("root/c", 2.0),
         first("root/s/a", 9.0), first("root/s", 9.0, 0.6, "supervisor"), first("root/c", 9.5)],
        {"root": "running", "root/s": "running", "root/s/a": "running", "root/c": "running"},
    ),
    "a resource is loaded": ([resource("loaded")], {"x": "OK"}),
    "while its callback runs": ([load(), callback("began", "load")], {"x": "loading"}),
    "a load fails": ([load(), callback("began", "load"), resource("load_failed", "no")], {}),
    "a status": ([resource("loaded"), resource("status", "ERROR no frame")], {"x": "ERROR"}),
    "FATAL lasts": ([resource("status", "FATAL gone"), resource("status", "OK")], {"x": "FATAL"}),
    "an unload": ([resource("loaded"), callback("began", "unload")], {"x": "unloading"}),
    "that ends": ([resource("loaded"), callback("began", "unload"), resource("unloaded")], {}),
    "that fails": ([resource("loaded"), resource("unload_failed", "stuck")], {"x": "unload_failed"}),
    "paused": ([resource("loaded"), callback("began", "pause"), resource("paused")], {"x": "paused"}),
    "resumed": ([resource("paused"), callback("began", "resume"), resource("resumed")], {"x": "OK"}),
    "revoked": ([resource("loaded"), resource("revoked", "needed")], {"x": "revoked"}),
    "reloading": ([resource("loaded"), resource("reloading")], {"x": "reloading"}),
    "reloaded": ([resource("reloading"), resource("status", "UPDATE")], {"x": "UPDATE"}),
    "recovered": ([resource("reloading"), callback("ended", "recover")], {"x": "OK"}),
    "its priority alone says nothing of it": ([resource("priority", "priority 5")], {}),
    "a callback of what nobody knows": ([callback("began", "unload"), callback("ended", "recover")], {}),
}  # fmt: skip


@pytest.mark.parametrize("course", COURSES)
def test_an_entry_changes_a_moment(course: str) -> None:
    entries, expected = COURSES[course]

    assert states(moment_after(Moment(), entries)) == expected


def test_a_moment_says_since_when_why_and_how_often() -> None:
    told = [
        child("started", "root/a", "running", at=1.0, run=1, pid=7),
        child("exited", "root/a", "restarting", at=2.0, reason="killed", detail="SIGKILL", up_s=1.0, pid=7),
        child("restarted", "root/a", "running", at=3.0, pid=8, ready_s=0.5),
        resource("loaded", at=4.0),
        resource("status", "ERROR no frame", at=5.0),
    ]
    dead, end = moment_after(Moment(), told[:2]).children["root/a"], moment_after(Moment(), told)

    assert (dead.since, dead.pid, dead.why) == (2.0, None, "killed: SIGKILL, after 1 s")
    assert (end.children["root/a"].pid, end.children["root/a"].restarts) == (8, 1)
    assert (end.at, [child.path for child in end.tree]) == (5.0, ["root", "root/a"])
    (lens,) = end.listed
    assert (lens.name, lens.since, lens.message) == ('cameras/lens "front"', 5.0, "no frame")


def test_the_name_of_a_resource_that_is_being_loaded_comes_from_its_load() -> None:
    moment = moment_after(Moment(), [load("x"), callback("began", "load")])

    assert moment.resources["x"].name == 'cameras/lens "front"'
    answered = moment_after(moment, [Entry(2.0, "received", name="Loaded", query="x")])
    assert moment.asked == {"x": (LENS, '"front"')}
    assert answered.asked == {}


BEFORE: dict[str, tuple[Entry, dict[str, str]]] = {
    "what exits ran": (child("exited", "root/a", "restarting", up_s=3.0), {"root": "running", "root/a": "running"}),
    "what starts did not": (child("started", "root/a", "running", run=1), {}),
    "what starts again was down": (child("restarted", "root/a", "running"), {"root": "running"}),
    "what has a status was loaded": (resource("status", "ERROR"), {"x": "OK"}),
    "what is loaded was not": (resource("loaded"), {}),
}


@pytest.mark.parametrize("what", BEFORE)
def test_entries_tell_what_was_there_before(what: str) -> None:
    entry, expected = BEFORE[what]

    assert states(first_moment([entry], [], 0.5)) == expected


def test_a_recording_says_what_was_there_when_it_began() -> None:
    present = [
        {"children": [{"path": "root/a", "kind": "worker", "state": "running", "since": 0.5, "pid": 7}]},
        {"resources": [{"id": "x", "server": LENS, "text": '"front"', "state": "ERROR", "message": "no"}]},
        {"left_out": 3},
    ]

    assert states(first_moment([resource("loaded", id="y")], present, 1.0)) == {"root/a": "running", "x": "ERROR"}


# -- forward and back --------------------------------------------------------------------------------------------------

PATHS = st.sampled_from(["root/a", "root/b", "root/s", "root/s/a", "root/s/t", "root/s/t/a"])
CHILDREN = st.builds(
    child,
    st.sampled_from(["started", "restarted", "exited", "stopped", "start_failed", "deleted", "gave_up"]),
    PATHS,
    st.sampled_from(["running", "starting", "restarting", "stopped", None]),
    run=st.integers(1, 4),
    pid=st.integers(1, 9),
    kind=st.sampled_from(["manager", "supervisor"]),
)
RESOURCES = st.builds(
    resource,
    st.sampled_from(["loaded", "unloaded", "status", "load_failed", "paused", "resumed", "revoked", "reloading"]),
    st.sampled_from(["OK", "ERROR no", "FATAL gone", "UPDATE"]),
    id=st.sampled_from("xyz"),
)
CALLBACKS = st.builds(
    callback, st.sampled_from(["began", "ended"]), st.sampled_from(["load", "unload", "recover"]), st.sampled_from("xy")
)
COURSE = st.lists(st.one_of(CHILDREN, RESOURCES, CALLBACKS, st.builds(load, st.sampled_from("xy"))), max_size=30)


def numbered(entries: list[Entry]) -> list[Entry]:
    """The entries, a second apart."""
    return [replace(entry, at=number + 1.0) for number, entry in enumerate(entries)]


def recorded(entries: list[Entry]) -> Recording:
    recording = Recording("robot", limit=max(1, len(entries)))
    add(recording, numbered(entries))
    return recording


@given(COURSE, st.integers(0, 30))
def test_a_course_may_be_folded_in_parts(entries: list[Entry], cut: int) -> None:
    whole = moment_after(Moment(), entries)

    assert moment_after(moment_after(Moment(), entries[:cut]), entries[cut:]) == whole


@given(COURSE)
def test_forward_and_back_it_is_the_same_moment(entries: list[Entry]) -> None:
    rewound = Rewound(recorded(entries))
    forward = [rewound.moment(number) for number in range(len(rewound) + 1)]
    back = [rewound.moment(number) for number in reversed(range(len(rewound) + 1))]

    assert back[::-1] == forward
    assert forward[0].children == first_moment(recorded(entries).entries(), [], 1.0).children


@given(COURSE)
def test_each_step_says_what_is_different_after_it(entries: list[Entry]) -> None:
    rewound = Rewound(recorded(entries))

    for step in rewound.steps:
        told = {one.id: one.after for one in step.changes}  # of several changes of one thing, the last
        assert all(told[one.id] == one.after for one in rewound.between(step.number - 1, step.number))


@given(COURSE, COURSE)
def test_nothing_is_different_between_equal_moments(first: list[Entry], then: list[Entry]) -> None:
    moment = moment_after(Moment(), first)
    after = moment_after(moment, then)

    assert differences(moment, moment) == []
    assert (differences(moment, after) == []) == (told(moment) == told(after))


def told(moment: Moment) -> dict[str, tuple[object, ...]]:
    """What people see of a moment as different from another: a process id is not among it."""
    return {id: (one.condition, one.since, one.why) for id, one in (moment.children | moment.resources).items()}


def test_many_entries_are_folded_from_the_moment_kept_before() -> None:
    entries = [resource("status", f"ERROR {number}", id=f"r{number % 7}") for number in range(3000)]
    rewound = Rewound(recorded(entries))
    plain = numbered(entries)

    for number in (0, 1, 199, 200, 201, 2999, 3000):
        first = first_moment(plain, [], 1.0)
        assert rewound.moment(number).resources == moment_after(first, plain[:number]).resources


# -- the clock ---------------------------------------------------------------------------------------------------------


def arrived(entries: list[Entry]) -> list[Entry]:
    """The entries, with their numbers in a recording."""
    return [replace(entry, seq=number) for number, entry in enumerate(entries, 1)]


def lens_ends(put_back_s: float) -> Recording:
    """A recording in which the clock is put back between a death and the next start. Callbacks arrive late."""
    started = child("started", "root/cameras", "running", at=100.0, run=1)
    began = replace(callback("began", "load"), at=101.0, process="root/cameras", pid=7)
    died = child("exited", "root/cameras", "restarting", at=103.0, reason="killed")
    again = child("restarted", "root/cameras", "running", at=103.5 - put_back_s, run=2)
    unloads = replace(callback("began", "unload"), at=104.0 - put_back_s, process="root/cameras", pid=8)
    unloaded = resource("unloaded", at=104.1 - put_back_s)
    recording = Recording("robot")
    add(recording, arrived([started, resource("loaded", at=101.1), began, died, again, unloaded, unloads]))
    return recording


@pytest.mark.parametrize("put_back_s", [0.0, 1.0, 3600.0])
def test_a_clock_that_is_put_back_changes_no_order(put_back_s: float, tmp_path: Path) -> None:
    recording = lens_ends(put_back_s)
    recording.save(tmp_path / "clock.jsonl")

    for rewound in (rewind(recording), rewind(tmp_path / "clock.jsonl")):
        assert [step.entry.event for step in rewound.steps] == [
            *("started", "began", "loaded", "exited", "restarted", "began", "unloaded")
        ]
        assert states(rewound.moment(len(rewound))) == {"root": "running", "root/cameras": "running"}
        assert rewound.number_at(rewound.until) == len(rewound)
    events = [entry.event for entry in recording.trace("x").entries]
    assert events == ["began", "loaded", "exited", "restarted", "began", "unloaded"]


@given(
    st.lists(st.tuples(st.floats(0.001, 5.0), st.integers(0, 2), st.floats(0.0, 0.2)), max_size=20),
    st.integers(0, 20),
    st.floats(20.0, 1e6),
)
def test_entries_are_in_the_order_in_which_they_happened(
    happened: list[tuple[float, int, float]], jump: int, put_back_s: float
) -> None:
    """Three processes send what happened a little later, each in its order; the clock is put back once, or never."""
    now, entries, sent = 1000.0, list[tuple[float, Entry]](), [0.0, 0.0, 0.0]
    for number, (after_s, source, late_s) in enumerate(happened):
        now += after_s + (1.0 if number == jump else 0.0)  # what is late has come when the clock is put back
        sent[source] = max(sent[source], now + late_s)
        at = now - (put_back_s if number >= jump else 0.0)
        entries.append((sent[source], Entry(at, "began", process=f"root/{source}", detail=f"{number:02}")))
    found = in_order(arrived([entry for _, entry in sorted(entries, key=lambda one: one[0])]))

    for source in range(3):
        of_one = [entry.detail for entry in found if entry.process == f"root/{source}"]
        assert of_one == sorted(of_one)
    if jump >= len(happened):
        assert [entry.detail for entry in found] == [f"{number:02}" for number in range(len(happened))]


# -- questions ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def robot() -> Rewound:
    return Rewound(
        recorded(
            [
                child("started", "root/cameras", "running", run=1),
                resource("loaded"),
                resource("status", "ERROR no frame"),
                child("exited", "root/cameras", "restarting", reason="killed"),
                child("restarted", "root/cameras", "running"),
                resource("status", "OK"),
                resource("status", "ERROR again"),
                resource("unloaded"),
            ]
        )
    )


def test_it_says_when_something_became_so(robot: Rewound) -> None:
    assert [(step.number, one.before, one.why) for step, one in robot.when("lens", "error")] == [
        (3, "OK", "no frame"),
        (7, "OK", "again"),
    ]
    assert [step.number for step, _ in robot.when("root/cameras", "restarting")] == [4]
    assert [step.number for step, _ in robot.when("lens", "gone")] == [8]


@pytest.mark.parametrize(
    ("name", "state", "says"),
    [
        ("lens", "FATAL", "never became 'FATAL'; it was: OK, ERROR, gone"),
        ("maps", "ERROR", "nothing of this name has changed"),
    ],
)
def test_what_never_became_so_is_refused_with_what_was(robot: Rewound, name: str, state: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        robot.when(name, state)


def test_it_says_what_is_different_between_two_moments(robot: Rewound) -> None:
    found = {one.name: (one.before, one.after, one.why) for one in robot.between(2, 7)}

    assert found['cameras/lens "front"'] == ("OK", "ERROR", "again")
    assert found["root/cameras"][:2] == ("running", "running")
    assert robot.between(2, 2) == []
    assert [(one.before, one.after) for one in robot.between(2, 8) if one.id == "x"] == [("OK", "")]


def test_a_time_finds_the_last_step_up_to_it(robot: Rewound) -> None:
    assert [robot.number_at(at) for at in (0.5, 1.0, 1.5, 7.9, 8.0, 99.0)] == [0, 1, 1, 7, 8, 8]
    with pytest.raises(UsageError, match="expected a number from 0 to 8, got 9"):
        robot.moment(9)


def test_an_empty_recording_has_a_beginning_alone() -> None:
    rewound = Rewound(Recording("robot"))

    assert len(rewound) == 0
    assert states(rewound.moment(0)) == {}


@pytest.mark.parametrize(
    "present", [{"children": [{"path": 7}]}, {"children": 7}, {"resources": [{"state": "OK"}]}, {"left_out": "many"}]
)
def test_a_beginning_that_is_damaged_is_refused_by_name(present: dict[str, Any]) -> None:
    recording = Recording("robot")
    recording.present = [present]

    with pytest.raises(ConfigError, match='robot: "present": expected what rr-actors record writes'):
        rewind(recording)


# -- times -------------------------------------------------------------------------------------------------------------

NOON = time.mktime((2026, 11, 30, 12, 0, 0, 0, 0, -1))
TIMES = [
    ("12:00:05", 5.0),
    ("12:00:05.250", 5.25),
    ("12:01", 60.0),
    ("2026-11-30 12:00:05", 5.0),
    ("2026-11-30T12:00:05.5", 5.5),
    ("+12.5s", 12.5),
    ("+1m", 60.0),
    ("+7", 7.0),
    ("-10s", 80.0),
    ("start", 0.0),
    ("end", 90.0),
    (f"{NOON + 3.5:.1f}", 3.5),
]


@pytest.mark.parametrize(("text", "after_s"), TIMES)
def test_a_time_is_meant(text: str, after_s: float) -> None:
    assert time_meant(text, NOON, NOON + 90.0) == pytest.approx(NOON + after_s)


def test_a_time_of_the_clock_may_be_of_the_next_day() -> None:
    since = time.mktime((2026, 11, 30, 23, 59, 0, 0, 0, -1))

    assert time_meant("00:01:00", since, since + 600.0) == since + 120.0


@pytest.mark.parametrize("text", ["", "soon", "12:00:05.x", "25:00", "+", "+x", "+-3s", "-nan", "+inf", "1e999"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--at: expected a time"):
        time_meant(text, NOON, NOON + 90.0)


@pytest.mark.parametrize("text", ["+91s", "-91s", "11:59:59", "12:02", "2020-01-01 00:00", "99999999999999999999"])
def test_a_time_outside_the_recording_is_refused_with_its_bounds(text: str) -> None:
    with pytest.raises(UsageError, match=r"expected a time from .*12:00:00\.000 to .*12:01:30\.000, got"):
        time_meant(text, NOON, NOON + 90.0)


def test_a_path_that_is_neither_recording_nor_state_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected a recording, or a state directory with a history\.jsonl"):
        rewind(tmp_path)
    with pytest.raises(ConfigError, match="missing: cannot be read: No such file"):
        rewind(tmp_path / "missing")
