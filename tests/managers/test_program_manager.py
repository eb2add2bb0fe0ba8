"""The program manager: external programs as resources, through a real system."""

from __future__ import annotations

import os
import random
import signal
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

import rr_actors as rr
from rr_actors.managers import Program, Programs, Ready, RunProgram
from support import Calls, eventually, kill, pid_of, wait_respawned
from support_programs import running_programs

SLEEP = "import time; print('ready'); time.sleep(600)"
SPEC = rr.ChildSpec(Programs, id="programs")
Start = Callable[..., rr.System]


def python(code: str, *arguments: str, line: str | None = "ready", **more: Any) -> RunProgram:
    more.setdefault("ready", Ready(line=line))
    return RunProgram(sys.executable, ("-u", "-c", code, *arguments), **more)


def is_running(program: Program) -> bool:
    return psutil.pid_exists(program.pid) and psutil.Process(program.pid).status() != psutil.STATUS_ZOMBIE


@pytest.fixture
def system(start: Start) -> rr.System:
    return start(SPEC)


@pytest.fixture
def app(system: rr.System) -> rr.Registrar:
    return system.open_registrar("app")


def test_a_program_is_started_shared_and_ended_with_its_last_holder(system: rr.System, app: rr.Registrar) -> None:
    other = system.open_registrar("other")
    first = app.load("programs/program", python(SLEEP))
    second = other.load("programs/program", python(SLEEP))
    assert first.response == second.response
    assert is_running(first.response)
    first.unload()
    assert is_running(first.response)
    second.unload()
    assert not psutil.pid_exists(second.response.pid)


def test_instances_tell_equal_programs_apart(app: rr.Registrar) -> None:
    with (
        app.load("programs/program", python(SLEEP, instance="a")) as first,
        app.load("programs/program", python(SLEEP, instance="b")) as second,
    ):
        assert first.response.pid != second.response.pid


def test_the_allocation_is_the_resource_and_the_attempt(app: rr.Registrar) -> None:
    with app.load("programs/program", python(SLEEP)) as program:
        assert running_programs(program.resource_id) == {program.response.pid: f"{program.resource_id}.1"}


def test_environment_and_directory_are_the_requests(app: rr.Registrar, tmp_path: Path) -> None:
    code = "import os, pathlib, time; pathlib.Path(os.environ['MARK']).touch(); print('ready'); time.sleep(600)"
    with app.load("programs/program", python(code, environment={"MARK": "here"}, directory=str(tmp_path))):
        assert (tmp_path / "here").exists()


def test_a_program_can_be_ready_when_a_file_was_written_since_its_start(app: rr.Registrar, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    mark.touch()
    os.utime(mark, (1_000_000, 1_000_000))  # of an earlier run
    code = f"import pathlib, time; time.sleep(0.1); pathlib.Path({str(mark)!r}).write_text('new'); time.sleep(600)"
    with app.load("programs/program", python(code, ready=Ready(file=str(mark)))):
        assert mark.read_text() == "new"


def test_a_program_can_be_ready_when_its_port_accepts(app: rr.Registrar) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    code = f"import socket, time; s = socket.socket(); s.bind(('127.0.0.1', {port})); s.listen(); time.sleep(600)"
    with app.load("programs/program", python(code, ready=Ready(port=port))):
        socket.create_connection(("127.0.0.1", port)).close()


@pytest.mark.parametrize("port", [0, -1, 99_999])
def test_a_port_that_no_program_can_have_is_refused(app: rr.Registrar, port: int) -> None:
    with pytest.raises(
        rr.InvalidRequest, match=r"programs/program: request\.ready\.port: expected int .*(<= 65535|>= 1)"
    ):
        app.load("programs/program", python(SLEEP, ready=Ready(port=port)))


def test_a_program_can_be_ready_when_a_function_says_so(start: Start, tmp_path: Path) -> None:
    seen = tmp_path / "seen"

    def probe(pid: int) -> bool:
        seen.write_text(str(pid))
        return True

    system = start(rr.ChildSpec(Programs, id="programs", kwargs={"probes": {"mine": probe}}))
    app = system.open_registrar("app")
    with app.load("programs/program", python(SLEEP, ready=Ready(probe="mine"))) as program:
        assert seen.read_text() == str(program.response.pid)
    with app.load("programs/program", python(SLEEP, ready=Ready(probe="psutil:pid_exists"))) as program:
        assert is_running(program.response)


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (RunProgram("no-such-program"), "cannot start 'no-such-program': FileNotFoundError"),
        (RunProgram(sys.executable, directory="/no/such/directory"), "FileNotFoundError"),
        (python("print('boom'); raise SystemExit(7)"), "(?s)exited with code 7.*boom"),
        (python(SLEEP, ready=Ready(line="never", timeout_s=2.0)), "(?s)not ready within 2 s.*ready"),
        (python(SLEEP, ready=Ready(line="(")), "expected a regular expression, got '\\('"),
        (python(SLEEP, ready=Ready(probe="no.such:probe")), "package.module:function"),
        (python(SLEEP, stop_signal="SIGNOTHING"), "expected a name like 'SIGTERM', got 'SIGNOTHING'"),
    ],
)
def test_a_program_that_cannot_be_had_fails_with_the_reason_and_leaves_nothing(
    app: rr.Registrar, request_: RunProgram, says: str
) -> None:
    with pytest.raises(rr.LoadFailed, match=says):
        app.load("programs/program", request_)
    assert app.queries() == []


def test_a_request_of_the_wrong_type_names_the_field(app: rr.Registrar) -> None:
    with pytest.raises(rr.InvalidRequest, match="grace_s"):
        app.load("programs/program", {"command": "sleep", "grace_s": "long"})


def test_an_unexpected_end_is_a_fatal_status_with_the_signal_and_the_last_output(app: rr.Registrar) -> None:
    heard = Calls()
    with app.load("programs/program", python(SLEEP), on_status=heard) as program:
        os.kill(program.response.pid, signal.SIGKILL)
        (status,) = heard.wait()
        assert status.state is rr.State.FATAL
        assert "signal 9 (SIGKILL)" in status.message
        assert "ready" in status.message


def test_an_unexpected_end_is_a_fatal_status_with_the_exit_code(app: rr.Registrar, tmp_path: Path) -> None:
    go = tmp_path / "go"
    code = f"""
import os, time
print('ready')
while not os.path.exists({str(go)!r}): time.sleep(0.005)
print('giving up'); raise SystemExit(3)"""
    with app.load("programs/program", python(code)) as program:
        go.touch()
        message = program.wait_status(timeout_s=10).message
        assert "exited with code 3" in message
        assert "giving up" in message


def test_after_an_end_the_same_request_starts_the_program_again(app: rr.Registrar) -> None:
    with app.load("programs/program", python(SLEEP)) as dead:
        os.kill(dead.response.pid, signal.SIGKILL)
        dead.wait_status(timeout_s=10)
        with app.load("programs/program", python(SLEEP)) as fresh:
            assert fresh.response.pid != dead.response.pid
            assert is_running(fresh.response)


def test_stop_is_the_signal_then_sigkill_after_the_grace(app: rr.Registrar, tmp_path: Path) -> None:
    heard = tmp_path / "heard"
    code = f"""
import pathlib, signal, time
signal.signal(signal.SIGINT, lambda *_: pathlib.Path({str(heard)!r}).touch())
print('ready'); time.sleep(600)
while True: time.sleep(600)"""
    program = app.load("programs/program", python(code, stop_signal="SIGINT", grace_s=1.0))
    program.unload()
    assert heard.exists()
    assert not psutil.pid_exists(program.response.pid)


# -- the manager's crash -------------------------------------------------------------------------------------------


def test_a_program_outlives_its_managers_crash_and_is_watched_again(system: rr.System, app: rr.Registrar) -> None:
    with app.load("programs/program", python(SLEEP)) as program:
        pid = kill(system, "programs")
        wait_respawned(system, "programs", pid)
        assert is_running(program.response)
        with app.load("programs/program", python(SLEEP)) as again:
            assert again.response == program.response
        os.kill(program.response.pid, signal.SIGTERM)
        status = program.wait_status(rr.State.FATAL, timeout_s=10)
        assert "signal 15 (SIGTERM)" in status.message


def test_a_program_that_ends_while_its_manager_is_down_is_lost_and_its_holders_hear_why(
    system: rr.System, app: rr.Registrar, tmp_path: Path
) -> None:
    code = """
import signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])  # so that it waits for sigwait(), whenever it comes
print('ready')
signal.sigwait([signal.SIGUSR1])
sys.exit(9)"""
    with app.load("programs/program", python(code)) as program:
        killed = kill(system, "programs")
        os.kill(program.response.pid, signal.SIGUSR1)
        status = program.wait_status(rr.State.FATAL, timeout_s=10)
        assert "exited with code 9" in status.message
        wait_respawned(system, "programs", killed)


def test_a_manager_killed_while_a_program_starts_ends_up_with_exactly_one(
    system: rr.System, app: rr.Registrar, tmp_path: Path
) -> None:
    go, begun = tmp_path / "go", tmp_path / "begun"
    code = f"""
import os, pathlib, time
pathlib.Path({str(begun)!r}).touch()
while not os.path.exists({str(go)!r}): time.sleep(0.005)
print('ready'); time.sleep(600)"""
    future = app.load("programs/program", python(code), block=False)
    eventually(begun.exists)
    pid = kill(system, "programs")
    wait_respawned(system, "programs", pid)
    go.touch()
    with future.get(timeout=20) as program:
        assert list(running_programs(program.resource_id)) == [program.response.pid]


def test_a_manager_killed_while_it_ends_a_program_ends_it_afterwards(
    system: rr.System, app: rr.Registrar, tmp_path: Path
) -> None:
    asked = tmp_path / "asked"
    code = f"""
import pathlib, signal, time
signal.signal(signal.SIGTERM, lambda *_: pathlib.Path({str(asked)!r}).touch())
print('ready')
while True: time.sleep(600)"""
    program = app.load("programs/program", python(code, grace_s=1.0))
    future = app.unload(program, block=False)
    eventually(asked.exists)
    kill(system, "programs")
    future.get(timeout=20)
    assert not running_programs(program.resource_id)


@pytest.mark.slow
def test_whatever_moment_the_manager_is_killed_at_nothing_runs_twice_and_nothing_is_left(start: Start) -> None:
    system = start(rr.Supervisor([SPEC], max_restarts=1000))
    app = system.open_registrar("app")
    chance = random.Random(1)
    for turn in range(12):
        pid = pid_of(system, "programs")
        future = app.load("programs/program", python(SLEEP, instance=str(turn)), block=False)
        wait_for(chance.uniform(0.0, 0.1))
        kill(system, "programs")
        program = future.get(timeout=20)
        assert list(running_programs(program.resource_id)) == [program.response.pid]
        pid = wait_respawned(system, "programs", pid)
        future = app.unload(program, block=False)
        wait_for(chance.uniform(0.0, 0.05))
        kill(system, "programs")
        future.get(timeout=20)
        assert not running_programs()
        wait_respawned(system, "programs", pid)


def wait_for(delay_s: float) -> None:
    """Let a moment pass: at which one the kill comes is the point."""
    threading.Event().wait(delay_s)


def test_a_system_that_stops_ends_its_programs(start: Start) -> None:
    system = start(SPEC)
    program = system.open_registrar("app").load("programs/program", python(SLEEP))
    system.stop()
    assert not running_programs(program.resource_id)
