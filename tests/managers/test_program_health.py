"""The health of programs: one that lives and is silent is noticed, and treated as one that has ended."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from chaos.process_census import stands
from rr_actors.managers import ProgramHealth, Programs, Ready, RunProgram
from rr_actors.managers.external_programs import RunningProgram
from rr_actors.managers.program_conditions import OutputGoesOn
from support import Calls, eventually, hang, kill, lives, messages, pid_of, states, wait_respawned
from support_programs import running_programs

Start = Callable[..., rr.System]

WARNING, FATAL, OK = rr.State.WARNING, rr.State.FATAL, rr.State.OK
OFTEN: dict[str, Any] = {"every_s": 0.05, "timeout_s": 30.0, "fail_after": 2}
TALK = """
import os, sys, time
print("ready", flush=True)
while True:
    time.sleep(0.05)
    if not os.path.exists(sys.argv[1]):
        print("here I am", flush=True)
"""
SERVE = """
import socket, sys
listener = socket.socket(socket.AF_UNIX if sys.argv[1] == "unix" else socket.AF_INET)
listener.bind(sys.argv[2] if sys.argv[1] == "unix" else ("127.0.0.1", int(sys.argv[2])))
listener.listen()
print("ready", flush=True)
while True:
    listener.accept()[0].close()
"""


def python(code: str, *arguments: object, **more: Any) -> RunProgram:
    return RunProgram(sys.executable, ("-c", code, *map(str, arguments)), ready=Ready(line="ready"), grace_s=1, **more)


@pytest.fixture
def quiet(tmp_path: Path) -> Path:
    """The file that makes a program silent."""
    return tmp_path / "quiet"


@pytest.fixture
def talker(quiet: Path) -> RunProgram:
    return python(TALK, quiet, health=ProgramHealth(line_every_s=1.0, **OFTEN))


def begin(start: Start, **options: Any) -> tuple[rr.System, rr.Registrar]:
    system = start(rr.ChildSpec(Programs, id="programs", kwargs=options))
    return system, system.open_registrar("app")


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


# -- what is silent ------------------------------------------------------------------------------------------------


def test_a_program_that_writes_no_line_any_more_is_ended_and_its_holders_hear_warning_then_fatal(
    start: Start, talker: RunProgram, quiet: Path
) -> None:
    system, app = begin(start)
    heard = Calls()
    program = app.load("programs/program", talker, on_status=heard)
    pid = program.response.pid
    output = next((system.registrar("programs").directory / "programs").glob("*/output.log"))
    eventually(lambda: output.read_text().count("here I am") > 10)
    quiet.touch()
    warned, failed = heard.wait(2)
    assert (warned.state, failed.state) == (WARNING, FATAL)
    assert failed.message.startswith("health: no line of its output for ")
    assert failed.message.endswith("; last output:\n" + "\n".join(["  here I am"] * 10))
    assert not lives(pid)  # before its holders hear
    quiet.unlink()
    with app.load("programs/program", talker) as again:
        assert lives(again.response.pid)
    program.unload()
    assert not running_programs()


@pytest.mark.parametrize("kind", ["port", "socket"])
def test_a_program_that_hangs_is_silent_although_the_kernel_still_takes_its_connections(
    start: Start, tmp_path: Path, kind: str
) -> None:
    port, path = free_port(), str(tmp_path / "a socket")
    place: dict[str, Any] = {"port": port} if kind == "port" else {"socket": path}
    code = python(SERVE, *(["tcp", port] if kind == "port" else ["unix", path]))
    health = ProgramHealth(**place, **{**OFTEN, "timeout_s": 1.0})
    _, app = begin(start)
    heard = Calls()
    with app.load("programs/program", msgspec.structs.replace(code, health=health), on_status=heard) as program:
        hang(program.response.pid)
        eventually(lambda: FATAL in states(heard))
        what = f"port {port} of 127.0.0.1" if kind == "port" else f"socket {path}"
        assert messages(heard)[-1].startswith(f"health: {what}: no connection was accepted within 0.5 s")
        assert not lives(program.response.pid)
    Path(path).unlink(missing_ok=True)


@pytest.mark.parametrize("kind", ["port", "socket"])
def test_a_program_that_does_not_listen_any_more_is_silent(start: Start, tmp_path: Path, kind: str) -> None:
    place: dict[str, Any] = {"port": free_port()} if kind == "port" else {"socket": str(tmp_path / "none")}
    _, app = begin(start)
    sleeper = python("import time; print('ready', flush=True); time.sleep(600)", health=ProgramHealth(**place, **OFTEN))
    with app.load("programs/program", sleeper) as program:
        program.wait_status(FATAL, timeout_s=10)


@pytest.mark.parametrize("kind", ["port", "socket"])
def test_a_program_that_accepts_connections_is_well(start: Start, tmp_path: Path, kind: str) -> None:
    checked = tmp_path / "checked"

    def note(pid: int) -> bool:
        with checked.open("a") as file:
            file.write("x")
        return True

    port, path = free_port(), str(tmp_path / "a socket")
    place: dict[str, Any] = {"port": port} if kind == "port" else {"socket": path}
    program = python(
        SERVE,
        *(["tcp", port] if kind == "port" else ["unix", path]),
        health=ProgramHealth(**place, probe="note", **OFTEN),
    )
    _, app = begin(start, probes={"note": note})
    heard = Calls()
    with app.load("programs/program", program, on_status=heard):
        eventually(lambda: checked.exists() and len(checked.read_text()) > 10)
    assert not heard
    Path(path).unlink(missing_ok=True)


def probe_of(sign: Path) -> Callable[[int], bool]:
    """A probe that finds a program well if there is no sign; what the sign says else."""

    def probe(pid: int) -> bool:
        if not sign.exists():
            return True
        if sign.read_text() == "raises":
            raise OSError("no answer")
        if sign.read_text() == "hangs":
            threading.Event().wait()
        return False

    return probe


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("says no", "health: probe mine: it returned False"),
        ("raises", "health: OSError: no answer"),
        ("hangs", "health: not returned within 0.5 s"),
    ],
)
def test_a_program_is_silent_if_its_probe_says_no_or_raises_or_hangs(
    start: Start, tmp_path: Path, how: str, said: str
) -> None:
    sign = tmp_path / "sign"
    _, app = begin(start, probes={"mine": probe_of(sign)})
    health = ProgramHealth(probe="mine", every_s=0.05, timeout_s=0.5, fail_after=2)
    heard = Calls()
    with app.load("programs/program", RunProgram("sleep", ("600",), health=health), on_status=heard) as program:
        sign.write_text(how)
        heard.wait(2)
        assert states(heard) == [WARNING, FATAL]
        assert messages(heard)[-1] == said
        assert not lives(program.response.pid)


def test_a_program_that_recovers_before_it_is_silent_is_well_again_and_runs_on(start: Start, tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    _, app = begin(start, probes={"mine": probe_of(sign)})
    health = ProgramHealth(probe="mine", every_s=0.05, timeout_s=30, fail_after=100_000)
    heard = Calls()
    with app.load("programs/program", RunProgram("sleep", ("600",), health=health), on_status=heard) as program:
        sign.touch()
        eventually(lambda: states(heard) == [WARNING])
        sign.unlink()
        eventually(lambda: states(heard) == [WARNING, OK])
        assert lives(program.response.pid)


def test_each_program_is_checked_as_often_as_its_own_health_says(start: Start, tmp_path: Path) -> None:
    def note(pid: int) -> bool:
        with (tmp_path / str(pid)).open("a") as file:
            file.write("x")
        return True

    _, app = begin(start, probes={"note": note})
    often, seldom = (ProgramHealth(probe="note", every_s=every_s) for every_s in (0.02, 300.0))
    with (
        app.load("programs/program", RunProgram("sleep", ("600",), health=often)) as quick,
        app.load("programs/program", RunProgram("sleep", ("601",), health=seldom)) as slow,
        app.load("programs/program", RunProgram("sleep", ("602",))) as none,
    ):
        count = tmp_path / str(quick.response.pid)
        eventually((tmp_path / str(slow.response.pid)).exists)
        eventually(lambda: count.exists() and len(count.read_text()) > 30)
        assert (tmp_path / str(slow.response.pid)).read_text() == "x"
        assert not (tmp_path / str(none.response.pid)).exists()


def test_a_program_that_a_holder_calls_lost_is_ended_before_the_others_hear(start: Start) -> None:
    system, app = begin(start)
    with app.load("programs/program", RunProgram("sleep", ("600",))) as program:
        system.registrar("programs").send_status(program, rr.Status(FATAL, "no scans"))
        assert program.wait_status(FATAL, timeout_s=10).message == "no scans"
        assert not lives(program.response.pid)


# -- what is not silent, and what goes on ----------------------------------------------------------------------------


def test_a_paused_program_is_not_silent_and_is_checked_again_when_it_goes_on(
    start: Start, talker: RunProgram, quiet: Path, tmp_path: Path
) -> None:
    system, app = begin(start, idle="pause")
    heard = Calls()
    program = app.load("programs/program", talker, on_status=heard)
    program.standby()
    eventually(lambda: stands(program.response.pid))
    with app.load("programs/program", python(TALK, tmp_path, health=talker.health)) as silent:  # from its start on
        silent.wait_status(FATAL, timeout_s=30)  # so a program that does not stand would have been found silent, too
    assert not heard
    program.priority = 0
    eventually(lambda: not stands(program.response.pid))
    assert not heard
    quiet.touch()
    eventually(lambda: states(heard) == [WARNING, FATAL])
    program.unload()
    assert system.registrar("programs").resources() == []


def test_the_checks_go_on_after_the_managers_crash(start: Start, talker: RunProgram, quiet: Path) -> None:
    system, app = begin(start)
    heard = Calls()
    with app.load("programs/program", talker, on_status=heard) as program:
        wait_respawned(system, "programs", kill(system, "programs"))
        assert lives(program.response.pid)
        quiet.touch()
        eventually(lambda: states(heard) == [WARNING, FATAL])
        assert not lives(program.response.pid)


def test_a_probe_that_ends_its_process_each_time_loses_its_program_alone(start: Start, tmp_path: Path) -> None:
    sign = tmp_path / "sign"

    def kill_oneself(pid: int) -> bool:
        if sign.exists():
            os._exit(3)
        return True

    health = ProgramHealth(probe="deadly", **OFTEN)
    _, app = begin(start, probes={"deadly": kill_oneself})
    deadly = app.load("programs/program", RunProgram("sleep", ("600",), health=health))
    other = app.load("programs/program", RunProgram("sleep", ("601",)))
    sign.touch()
    assert "health" in deadly.wait_status(FATAL, timeout_s=45).message
    assert (lives(other.response.pid), other.state) == (True, OK)
    deadly.unload()
    assert list(running_programs()) == [other.response.pid]
    other.unload()


def test_a_silent_program_is_ended_and_heard_of_whatever_moment_its_manager_is_killed_at(start: Start) -> None:
    """The manager dies while it ends the program: the grace is not over yet."""
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True)\n"
    program = RunProgram(
        sys.executable,
        ("-c", code + "while True: time.sleep(600)"),
        ready=Ready(line="ready"),
        grace_s=1.0,
        health=ProgramHealth(line_every_s=0.2, **OFTEN),
    )
    system, app = begin(start)
    heard = Calls()
    with app.load("programs/program", program, on_status=heard) as query:
        eventually(lambda: system.registrar("programs").resources()[0].state == "FATAL")
        wait_respawned(system, "programs", kill(system, "programs"))
        eventually(lambda: FATAL in states(heard))
        eventually(lambda: not lives(query.response.pid))
    assert states(heard).count(FATAL) == 1
    assert not running_programs()


def test_the_silence_of_a_standstill_of_the_manager_does_not_count(start: Start, quiet: Path, tmp_path: Path) -> None:
    """The manager and the program stand still together, as on a machine that is suspended."""
    checks = tmp_path / "checks"

    def count(pid: int) -> bool:
        with checks.open("a") as lines:
            lines.write("checked\n")
        return True

    def checked() -> int:
        return len(checks.read_text().splitlines()) if checks.exists() else 0

    system, app = begin(start, probes={"count": count})
    heard = Calls()
    talker = python(TALK, quiet, health=ProgramHealth(line_every_s=1.0, probe="count", **OFTEN))
    with app.load("programs/program", talker, on_status=heard) as program:
        pids = [pid_of(system, "programs"), program.response.pid]
        eventually(lambda: checked() >= 5)
        for pid in pids:
            hang(pid)
        before = checked()
        time.sleep(1.5)  # the standstill itself, which is longer than line_every_s
        for pid in reversed(pids):
            os.kill(pid, signal.SIGCONT)
        eventually(lambda: checked() >= before + 5)
        assert system.registrar("programs").resources()[0].state == "OK"
        assert not heard


def test_output_goes_on_whatever_becomes_of_the_clock(tmp_path: Path) -> None:
    output = tmp_path / "output.log"
    goes_on = OutputGoesOn(output, within_s=100.0, look_s=100.0)
    running = RunningProgram(1, 0.0)
    assert goes_on(running) == ""
    for set_to in (0.0, time.time() + 10**6):
        output.write_text("x" * 10)
        os.utime(output, (set_to, set_to))
        assert goes_on(running) == ""


def test_output_stops_when_nothing_was_written_for_the_time(tmp_path: Path) -> None:
    output = tmp_path / "output.log"
    output.write_text("x")
    goes_on = OutputGoesOn(output, within_s=0.5, look_s=100.0)
    seen = eventually(lambda: goes_on(RunningProgram(1, 0.0)))
    assert seen.startswith("no line of its output for 0.")
    goes_on.begin()
    output.unlink()  # it gets long: its name goes to a new file
    eventually(lambda: goes_on(RunningProgram(1, 0.0)))
    output.write_text("y")
    assert goes_on(RunningProgram(1, 0.0)) == ""


# -- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "field", "said"),
    [
        ({}, "line_every_s", "line_every_s: expected this, port, socket or probe, got None"),
        ({"line_every_s": 0}, "line_every_s", "line_every_s: expected a number from 0.01 to 86400, got 0"),
        ({"port": 80, "every_s": float("nan")}, "every_s", "every_s: expected a number from 0.01 to 86400, got nan"),
        ({"port": 80, "timeout_s": "1"}, "timeout_s", "timeout_s: expected a number from 0.01 to 86400, got '1'"),
        ({"port": 80, "fail_after": 0}, "fail_after", "fail_after: expected a whole number, 1 or more, got 0"),
        ({"port": 80, "fail_after": True}, "fail_after", "fail_after: expected a whole number, 1 or more, got True"),
        ({"port": 0}, "port", "port: expected a whole number from 1 to 65535, got 0"),
        ({"port": "80"}, "port", "port: expected a whole number from 1 to 65535, got '80'"),
        ({"socket": ""}, "socket", "socket: expected a text that is not empty, got ''"),
        ({"probe": 1}, "probe", "probe: expected a text that is not empty, got 1"),
        ({"port": 80, "host": None}, "host", "host: expected a text that is not empty, got None"),
    ],
)
def test_a_wrong_health_is_refused_when_it_is_made(values: dict[str, Any], field: str, said: str) -> None:
    with pytest.raises(rr.InvalidSpec) as caught:
        ProgramHealth(**values)
    assert str(caught.value) == f"ProgramHealth: {said}"
    assert caught.value.details["field"] == field


def test_a_wrong_health_in_plain_data_is_refused_with_the_load(start: Start) -> None:
    _, app = begin(start)
    wrong: Any = {"port": 80, "fail_after": 0}
    with pytest.raises(rr.InvalidRequest, match="fail_after: expected a whole number, 1 or more, got 0"):
        app.load("programs/program", RunProgram("sleep", ("600",), health=wrong))


def test_a_probe_that_there_is_not_is_refused_before_the_program_starts(start: Start) -> None:
    _, app = begin(start)
    with pytest.raises(rr.LoadFailed, match=r"health\.probe: expected a probe of the manager, or 'package\.module:fun"):
        app.load("programs/program", RunProgram("sleep", ("600",), health=ProgramHealth(probe="no.such:probe")))
    assert not running_programs()
