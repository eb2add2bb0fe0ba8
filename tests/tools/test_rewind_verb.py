"""`rr-actors rewind RECORDING`: the moment at a time, when something became so, and what is different between two."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recording, add, entry_of
from support_cli import run_cli

NOON = time.mktime((2026, 11, 30, 12, 0, 0, 0, 0, -1))


def child(at: float, event: str, state: str, **facts: Any) -> Event:
    told = {"event": event, "at": NOON + at, "path": "root/cameras", "kind": "manager", "state": state}
    return Event.of(told | facts)


def lens(at: float, event: str, detail: str = "") -> Event:
    where = {"registrar": "cameras", "server": "cameras/lens", "resource_id": "x1", "request": '"front"'}
    return Event.of({"event": event, "at": NOON + at, "detail": detail} | where)


EVENTS = [
    child(1.0, "started", "running", run=1, pid=71),
    lens(2.0, "loaded"),
    lens(3.0, "status", "ERROR no frame"),
    child(4.0, "exited", "restarting", reason="killed", detail="SIGKILL"),
    child(5.0, "restarted", "running", pid=72),
    lens(6.0, "status", "OK"),
]


@pytest.fixture
def crash(tmp_path: Path) -> Path:
    """A recording."""
    recording = Recording("robot")
    recording.since = NOON
    recording.present = [{"left_out": 0}]
    add(recording, [entry_of(one) for one in EVENTS])
    recording.save(tmp_path / "crash.jsonl")
    return tmp_path / "crash.jsonl"


def said(*arguments: object) -> list[str]:
    ran = run_cli("rewind", *arguments)
    assert (ran.returncode, ran.stderr) == (0, "")
    return ran.stdout.splitlines()


def test_without_a_terminal_it_prints_the_last_moment(crash: Path) -> None:
    lines = said(crash)

    assert lines[0].endswith('12:00:06.000  step 6 of 6: status  cameras/lens "front"  OK')
    assert [line.split() for line in lines[1:4]] == [
        ["child", "state", "since", "pid", "restarts", "why"],
        ["root", "running", *lines[2].split()[2:]],
        ["cameras", "running", *lines[3].split()[2:-2], "72", "1"],
    ]
    assert lines[5].split()[:2] == ["resource", "state"]
    assert lines[6].split()[:3] == ["cameras/lens", '"front"', "OK"]


def test_it_prints_the_moment_at_a_time(crash: Path) -> None:
    lines = said(crash, "--at", "12:00:04.500")

    assert "12:00:04.500  step 4 of 6: " in lines[0]
    assert lines[0].endswith("exited  root/cameras  killed: SIGKILL")
    assert lines[3].split()[:2] == ["cameras", "restarting"]
    assert lines[3].endswith("killed: SIGKILL")
    assert lines[6].split()[2] == "ERROR"
    assert said(crash, "--at", "+4.5s") == lines
    assert said(crash, "--at", "start")[0].endswith("step 0 of 6: the beginning")


def test_it_prints_a_moment_for_programs(crash: Path) -> None:
    moment = json.loads("\n".join(said(crash, "--at", "+3s", "--json")))

    assert (moment["step"], moment["steps"], moment["at"]) == (3, 6, NOON + 3.0)
    assert [(child["path"], child["pid"]) for child in moment["children"]] == [("root", None), ("root/cameras", 71)]
    assert [(one["name"], one["state"], one["message"]) for one in moment["resources"]] == [
        ('cameras/lens "front"', "ERROR", "no frame")
    ]


def test_it_says_when_something_became_so(crash: Path) -> None:
    heads, line = said(crash, "--when", "lens ERROR")

    assert heads.split() == ["step", "time", "what", "before", "after", "why"]
    assert line.split()[0] == "3"
    assert line.endswith('12:00:03.000  cameras/lens "front"  OK      ERROR  no frame')
    (change,) = json.loads("".join(said(crash, "--when", "root/cameras restarting", "--json")))
    assert (change["step"], change["before"], change["after"]) == (4, "running", "restarting")


def test_it_says_what_is_different_between_two_times(crash: Path) -> None:
    lines = said(crash, "--from", "+2s", "--to", "+4s")

    told = [line.partition(":0")[2].split()[1:] for line in lines[1:]]
    assert told == [
        ["cameras/lens", '"front"', "OK", "ERROR", "no", "frame"],
        ["root/cameras", "running", "restarting", "killed:", "SIGKILL"],
    ]
    ran = run_cli("rewind", crash, "--from", "+2s", "--to", "+2.5s")
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "nothing is different\n")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--at", "soon"], "--at: expected a time"),
        (["--at", "13:00"], "--at: expected a time from"),
        (["--when", "lens"], "--when: expected a name and a state, such as 'cameras ERROR', got 'lens'"),
        (["--when", "lens FATAL"], "never became 'FATAL'; it was: OK, ERROR"),
        (["--from", "+4s", "--to", "+2s"], "--from: expected a time before --to, got '+4s', after '+2s'"),
        (["--at", "+1s", "--when", "lens OK"], "rewind: expected one of --at, --when, and --from with --to"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(crash: Path, options: list[str], says: str) -> None:
    ran = run_cli("rewind", crash, *options)

    assert (ran.returncode, ran.stdout, ran.stderr.count("\n")) == (2, "", 1)
    assert says in ran.stderr


def test_a_history_says_what_it_does_not_have(tmp_path: Path) -> None:
    (tmp_path / "history.jsonl").write_text("".join(json.dumps(one.flat()) + "\n" for one in EVENTS))

    ran = run_cli("rewind", tmp_path)

    assert ran.returncode == 0
    assert ran.stderr.startswith("the file does not say what was there when it began")
    assert "step 6 of 6" in ran.stdout
