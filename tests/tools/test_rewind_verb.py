"""`rr-actors rewind RECORDING`: the moment at a time, when something became so, and what is different between two."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import Recording, add, entry_of
from rr_actors.system.rewound.rewinding import rewind
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


def bind(path: Path) -> None:
    """Make a socket in the place of a file. Its path may be too long for an address, so its directory is open."""
    folder = os.open(path.parent, os.O_RDONLY)
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(f"/proc/self/fd/{folder}/{path.name}")
    os.close(folder)


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
        (["--at", "2099-01-01"], "--at: expected a time (12:46:55.020, 2026-11-30 12:46:55.020, +12.5s from the"),
        (["--at", ""], "--at: expected a time (12:46:55.020, "),
        (["--when", ""], "--when: expected a name and a state, such as 'cameras ERROR', got ''"),
        (["--from", ""], "--from: expected a time ("),
        (["--from", "start", "--to", ""], "--to: expected a time ("),
        (["--at", "", "--when", ""], "rewind: expected one of --at, --when, and --from with --to, got several"),
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


HEADER = b'{"recording":1,"system":"robot","at":1.0}\n'


def entry(event: str, facts: object, at: float = 1.0) -> bytes:
    return json.dumps({"at": at, "event": event, "facts": facts}).encode() + b"\n"


BAD = {
    "no header": (b"", "expected a recording, or a history.jsonl, got an empty file"),
    "no JSON": (b"once upon a time\n", "line 1: expected what rr-actors record writes, got b'once upon a time"),
    "a header that began at no time": (
        HEADER.replace(b"1.0", b"1e300"),
        "line 1: expected a time, in seconds since the epoch, got 1e+300",
    ),
    "an entry at no time": (
        HEADER + entry("loaded", {}, at=1e300),
        "line 2: expected a time, in seconds since the epoch, got 1e+300",
    ),
    "a beginning at no time": (
        HEADER + entry("present", {}, at=-1e300),
        "line 2: expected a time, in seconds since the epoch, got -1e+300",
    ),
    "a child that runs since no time": (
        HEADER + entry("present", {"children": [{"path": "root", "since": 1e300}]}),
        "line 2: expected a time, in seconds since the epoch, got 1e+300",
    ),
    "a resource that is there since no time": (
        HEADER + entry("present", {"resources": [{"id": "x", "since": 1e300}]}),
        "line 2: expected a time, in seconds since the epoch, got 1e+300",
    ),
    "children that are a number": (
        HEADER + entry("present", {"children": 7}),
        'line 2: "present": expected what rr-actors record writes (Expected `array`, got `int` - at `$.children`), '
        "got {'children': 7}",
    ),
    "a child without a path": (
        HEADER + entry("present", {"children": [{"kind": "actor"}]}),
        "(Object missing required field `path` - at `$.children[0]`), got {'children': [{'kind': 'actor'}]}",
    ),
    "a count that is text": (
        HEADER + entry("present", {"left_out": "many"}),
        "(Expected `int`, got `str` - at `$.left_out`), got {'left_out': 'many'}",
    ),
    "a count below nothing": (
        HEADER + entry("present", {"left_out": -1}),
        "(Expected `int` >= 0 - at `$.left_out`), got {'left_out': -1}",
    ),
    "notes that are numbers": (
        HEADER + entry("present", {"notes": [7]}),
        "(Expected `str`, got `int` - at `$.notes[0]`), got {'notes': [7]}",
    ),
    "damage after whole entries": (
        HEADER + entry("loaded", {}) + entry("present", {"notes": 7}),
        "the 1 entry before it can still be read: head -n 2 ",
    ),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("read", [rewind, rr.read_recording], ids=["rewind", "read_recording"])
def test_a_file_that_is_no_recording_is_refused_with_its_line(
    read: Callable[[Path], object], case: str, tmp_path: Path
) -> None:
    data, says = BAD[case]
    file = tmp_path / "bad.jsonl"
    file.write_bytes(data)
    if read is rr.read_recording:
        says = says.replace("a recording, or a history.jsonl", "a recording")

    with pytest.raises(rr.ConfigError) as refused:
        read(file)

    assert str(refused.value).startswith(f"{file}: ")
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (os.mkfifo, "cannot be read: a pipe, and no regular file"),
        (bind, "cannot be read: a socket, and no regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "cannot be read: a device, and no regular file"),
        (lambda path: path.symlink_to("/dev/null"), "expected a recording, or a history.jsonl, got an empty file"),
    ],
    ids=["a pipe", "a socket", "a device", "/dev/null"],
)
def test_what_is_no_file_is_refused_at_once(make: Callable[[Path], object], says: str, tmp_path: Path) -> None:
    file = tmp_path / "odd.jsonl"
    make(file)

    ran = run_cli("rewind", file)

    file.unlink()
    assert (ran.returncode, ran.stdout, ran.stderr) == (2, "", f"rr-actors: {file}: {says}\n")


@pytest.mark.parametrize(
    "arguments",
    [("timeline", "F"), ("trace", "F"), ("sequence", "F"), ("verify", "F"), ("graph", "check", "F"), ("start", "F")],
    ids=lambda arguments: arguments[0],
)
def test_other_commands_do_not_wait_for_a_pipe(arguments: tuple[str, ...], tmp_path: Path) -> None:
    file = tmp_path / "pipe.jsonl"
    os.mkfifo(file)

    ran = run_cli(*(str(file) if one == "F" else one for one in arguments))

    assert (ran.returncode, ran.stdout) == (2, "")
    assert f"{file}: " in ran.stderr
    assert "a pipe, and no regular file" in ran.stderr


def test_a_recording_is_read_from_a_pipe_of_the_shell(crash: Path) -> None:
    with subprocess.Popen(["cat", crash], stdout=subprocess.PIPE) as cat:
        assert cat.stdout is not None
        rewound = rewind(f"/dev/fd/{cat.stdout.fileno()}")

    assert [str(step) for step in rewound.steps] == [str(step) for step in rewind(crash).steps]


def test_a_recording_that_was_cut_after_its_header_says_so(tmp_path: Path) -> None:
    (tmp_path / "begun.jsonl").write_bytes(HEADER)

    ran = run_cli("rewind", tmp_path / "begun.jsonl")

    said = "the recording does not say what was there when it began; it has only its header\n"
    assert (ran.returncode, ran.stderr) == (0, said)


def test_a_history_says_what_it_does_not_have(tmp_path: Path) -> None:
    (tmp_path / "history.jsonl").write_text("".join(json.dumps(one.flat()) + "\n" for one in EVENTS))

    ran = run_cli("rewind", tmp_path)

    assert ran.returncode == 0
    assert ran.stderr.startswith("the file does not say what was there when it began")
    assert "step 6 of 6" in ran.stdout
