"""The program manager: external programs as resources, through a real system."""

from __future__ import annotations

import functools
import os
import random
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

import rr_actors as rr
from chaos.process_census import stands
from rr_actors.managers import Program, Programs, Ready, RunProgram
from support import Calls, eventually, kill, pid_of, wait_respawned
from support_programs import running_programs

SLEEP = "import time; print('ready'); time.sleep(600)"
EVIL = RunProgram(  # takes some thousand years to see that the line does not match
    "sh", ("-c", f"echo {'a' * 60}b; exec sleep 600"), ready=Ready(line="(a+)+$", timeout_s=2.0), grace_s=600.0
)
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


def test_a_program_that_nobody_waits_for_any_more_is_ended_before_it_is_ready(app: rr.Registrar) -> None:
    slow = RunProgram("sleep", ("600",), ready=Ready(line="ready", timeout_s=600.0))
    with pytest.raises(rr.LoadTimeout):
        app.load("programs/program", slow, timeout_s=1.0)
    eventually(lambda: not running_programs())


def is_paused(program: Program) -> bool:
    return stands(program.pid)


def test_an_idle_program_is_paused_also_over_a_crash_of_its_manager_and_goes_on_when_it_is_needed(start: Start) -> None:
    system = start(rr.ChildSpec(Programs, id="programs", kwargs={"idle": "pause"}))
    app = system.open_registrar("app")
    query = app.load("programs/program", python(SLEEP))
    assert not is_paused(query.response)
    query.standby()
    eventually(lambda: is_paused(query.response))

    wait_respawned(system, "programs", kill(system, "programs"))
    assert is_paused(query.response)
    again = app.load("programs/program", python(SLEEP))
    assert again.response == query.response
    assert not is_paused(again.response)

    again.unload()
    eventually(lambda: is_paused(query.response))
    query.unload()
    (kept,) = system.registrar("programs").resources()  # nobody holds it; without paused_s it is kept
    eventually(lambda: system.registrar("programs").resources()[0].phase == "paused")
    system.registrar("programs").unload(kept, force=True)
    assert not psutil.pid_exists(query.response.pid)


def test_a_paused_program_ends_in_order_when_its_time_is_over(start: Start, tmp_path: Path) -> None:
    """Its handler of SIGTERM runs, though it was stopped when the signal came."""
    code = "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: (open(sys.argv[1], 'w'), sys.exit()))\n"
    code += "print('ready')\nwhile True: time.sleep(600)"
    system = start(rr.ChildSpec(Programs, id="programs", kwargs={"idle": "pause", "paused_s": 0.2}))
    app = system.open_registrar("app")
    program = app.load("programs/program", python(code, str(tmp_path / "ended"), grace_s=600.0), priority=None)
    eventually(lambda: is_paused(program.response))
    program.unload()
    eventually(lambda: system.registrar("programs").resources() == [])
    assert (tmp_path / "ended").exists()


@pytest.mark.parametrize(("options", "named"), [({"idle": "sleep"}, "idle"), ({"linger_s": -1}, "linger_s")])
def test_a_wrong_way_to_treat_idle_programs_is_refused_by_name(
    start: Start, options: dict[str, Any], named: str
) -> None:
    with pytest.raises(rr.StartFailed, match=named):
        start(rr.ChildSpec(Programs, id="programs", kwargs=options))


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


def test_a_program_that_is_not_ready_in_time_says_what_is_missing_and_what_was_seen(
    app: rr.Registrar, tmp_path: Path
) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
        ready = Ready(line="ready", port=port, file=str(tmp_path / "never"), timeout_s=3.0)
        with pytest.raises(rr.LoadFailed) as failed:
            app.load("programs/program", python(SLEEP, ready=ready))
    seen = f"file {tmp_path}/never: not there; port {port} of 127.0.0.1: ConnectionRefusedError"
    assert f"was not ready within 3 s: {seen}" in str(failed.value)
    with pytest.raises(rr.LoadFailed, match=r"within 2 s: no line of its output has 'never'; its output"):
        app.load("programs/program", python(SLEEP, ready=Ready(line="never", timeout_s=2.0)))
    with pytest.raises(rr.LoadFailed, match=r"within 2 s: probe builtins:callable: it returned False"):
        app.load("programs/program", python(SLEEP, ready=Ready(probe="builtins:callable", timeout_s=2.0)))


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (RunProgram("no-such-program"), "cannot start 'no-such-program': FileNotFoundError"),
        (RunProgram(sys.executable, directory="/no/such/directory"), "FileNotFoundError"),
        (python("print('boom'); raise SystemExit(7)"), "(?s)exited with code 7.*boom"),
        (python(SLEEP, ready=Ready(line="never", timeout_s=2.0)), "(?s)not ready within 2 s.*ready"),
        (python(SLEEP, ready=Ready(line="(")), "expected a regular expression, got '\\('"),
        (python(SLEEP, ready=Ready(line="(?u)ready")), "expected a regular expression, got .*bytes pattern"),
        (EVIL, "(?s)not ready within 2 s.*aaab"),
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


@pytest.mark.parametrize(
    ("first", "says"),
    [
        ("#!/no/such/interpreter -u", "is there, but not its interpreter '/no/such/interpreter -u'"),
        ("#!/bin/sh\r", r"is there, but not its interpreter '/bin/sh\\r'"),
    ],
)
@pytest.mark.parametrize("in_path", [False, True])
def test_a_script_whose_interpreter_is_missing_names_that(
    app: rr.Registrar, tmp_path: Path, first: str, says: str, in_path: bool
) -> None:
    script = tmp_path / "a_script"
    script.write_text(f"{first}\nexit 0\n")
    script.chmod(0o700)
    path = {"PATH": f"{tmp_path}:/usr/bin:/bin"} if in_path else {}
    with pytest.raises(rr.LoadFailed, match=f"cannot start .*a_script': FileNotFoundError: {script} {says}"):
        app.load("programs/program", RunProgram("a_script" if in_path else str(script), environment=path))


def hang_until(gate: str, pid: int) -> bool:
    """Hang as a probe does that waits for something that does not come."""
    Path(gate).joinpath("asked").touch()
    while not Path(gate).joinpath("open").exists():
        threading.Event().wait(0.02)
    return True


@pytest.fixture
def hanging(start: Start, tmp_path: Path) -> Iterator[rr.System]:
    """A system whose programs may have a probe that hangs."""
    probe = functools.partial(hang_until, str(tmp_path))
    yield start(rr.ChildSpec(Programs, id="programs", kwargs={"probes": {"hangs": probe}}))
    (tmp_path / "open").touch()


def test_a_probe_that_hangs_is_given_up_in_time(hanging: rr.System) -> None:
    with pytest.raises(rr.LoadFailed, match=r"not ready within 2 s: the check whether it is ready has not returned"):
        hanging.open_registrar("app").load("programs/program", python(SLEEP, ready=Ready(probe="hangs", timeout_s=2.0)))
    assert not running_programs()


def test_the_end_of_a_program_whose_probe_hangs_is_noticed(hanging: rr.System, tmp_path: Path) -> None:
    code = (
        f"import os, time\nwhile not os.path.exists({str(tmp_path / 'asked')!r}): time.sleep(0.01)\nraise SystemExit(3)"
    )
    with pytest.raises(rr.LoadFailed, match="not ready yet and exited with code 3"):
        hanging.open_registrar("app").load(
            "programs/program", python(code, ready=Ready(probe="hangs", timeout_s=600.0))
        )


@pytest.mark.parametrize("grace_s", [float("inf"), 1e300])
def test_a_grace_without_end_is_waited_for(app: rr.Registrar, tmp_path: Path, grace_s: float) -> None:
    mark = tmp_path / "mark"
    code = (
        "import pathlib, signal, time\n"
        f"def end(*_): time.sleep(0.1); pathlib.Path({str(mark)!r}).touch(); raise SystemExit\n"
        "signal.signal(signal.SIGTERM, end); print('ready'); time.sleep(600)"
    )
    with app.load("programs/program", python(code, grace_s=grace_s)) as program:
        assert is_running(program.response)
    assert mark.exists()
    assert not running_programs(program.resource_id)


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


@pytest.mark.parametrize("ready", [Ready(line="never", timeout_s=600.0), Ready(probe="hangs", timeout_s=600.0)])
def test_a_system_that_stops_ends_a_program_that_is_not_ready_yet(
    hanging: rr.System, tmp_path: Path, ready: Ready
) -> None:
    code = f"import pathlib, time; pathlib.Path({str(tmp_path / 'runs')!r}).touch(); time.sleep(600)"
    hanging.open_registrar("app").load("programs/program", python(code, ready=ready), block=False)
    eventually((tmp_path / "runs").exists)
    hanging.stop()
    assert not running_programs()


# -- usage -----------------------------------------------------------------------------------------------------------

BUSY = """
import os, threading, time
held = bytearray(os.urandom(1)) * 50_000_000
threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
if os.fork() == 0:
    while True:
        pass
print("ready")
time.sleep(600)
"""
ENDED = """
import os, time
if os.fork() == 0:
    if os.fork() == 0:  # an orphan soon, which the shim reaps
        end = time.process_time() + 0.6  # and a margin: /proc counts in ticks
        while time.process_time() < end:
            pass
    os._exit(0)
os.wait()
print("ready")
time.sleep(600)
"""


def test_the_usage_of_a_program_is_that_of_its_whole_tree(system: rr.System, app: rr.Registrar) -> None:
    programs = system.registrar("programs")
    with app.load("programs/program", python(BUSY)) as busy, app.load("programs/program", python(SLEEP)) as idle:
        assert eventually(lambda: programs.usage()[busy.resource_id]["cpu_s"] >= 0.3)
        found = programs.usage()
        assert found.failures == {}
        used, unused = found[busy.resource_id], found[idle.resource_id]
        assert set(used) == {"cpu_s", "cpu", "memory_bytes", "threads"}
        assert 0 < used["cpu"] <= 1.2
        assert used["cpu"] > unused["cpu"]
        assert (used["threads"], unused["threads"]) == (3, 1)
        assert 50e6 < used["memory_bytes"] < 100e6  # once, though two processes have it
        assert unused["memory_bytes"] < 50e6
    assert programs.usage() == {}


def test_the_usage_has_the_time_of_descendants_that_have_ended(system: rr.System, app: rr.Registrar) -> None:
    programs = system.registrar("programs")
    with app.load("programs/program", python(ENDED)) as program:
        assert eventually(lambda: programs.usage()[program.resource_id]["cpu_s"] >= 0.4)
        assert eventually(lambda: programs.usage()[program.resource_id]["threads"] == 1)
        assert programs.usage()[program.resource_id]["cpu_s"] >= 0.4


def test_a_respawned_manager_knows_the_usage_of_its_programs(system: rr.System, app: rr.Registrar) -> None:
    programs = system.registrar("programs")
    with app.load("programs/program", python(BUSY)) as busy:
        before = programs.usage()[busy.resource_id]["cpu_s"]
        wait_respawned(system, "programs", kill(system, "programs"))
        assert eventually(lambda: programs.usage()[busy.resource_id]["cpu_s"] >= before)


def test_a_control_group_of_its_own_counts_what_nobody_reaped(system: rr.System, app: rr.Registrar) -> None:
    mounts = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    mounted = next((Path(mount[1]) for mount in mounts if mount[2] == "cgroup2"), None)
    if mounted is None or not os.access(mounted, os.W_OK):
        pytest.skip("no control groups of version 2 that can be written")
    group = mounted / f"rr-usage-{os.getpid()}"
    code = """
import os, pathlib, signal, sys, time
pathlib.Path(sys.argv[1], "cgroup.procs").write_text(str(os.getpid()))
signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps the child, and counts its time nowhere else
if os.fork() == 0:
    end = time.process_time() + 0.4
    while time.process_time() < end:
        pass
    os._exit(0)
print("ready")
time.sleep(600)
"""
    group.mkdir()
    try:
        programs = system.registrar("programs")
        with app.load("programs/program", python(code, str(group))) as program:
            assert eventually(lambda: programs.usage()[program.resource_id]["threads"] == 1)
            assert programs.usage()[program.resource_id]["cpu_s"] >= 0.4
    finally:
        group.rmdir()


def test_the_end_of_a_program_that_a_full_disk_hides_is_heard_of_when_there_is_room(
    system: rr.System, app: rr.Registrar
) -> None:
    heard = Calls()
    query = app.load("programs/program", python(SLEEP), on_status=heard)
    pid = pid_of(system, "programs")
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (600, before[1]))  # its journal is longer
    os.kill(query.response.pid, signal.SIGKILL)
    with pytest.raises(rr.CatalogError):
        system.registrar("programs").send_status(query, rr.Status(rr.State.WARNING))
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    (status,) = heard.wait()
    assert status.state is rr.State.FATAL
    assert status.message.startswith("the program was ended by signal 9 (SIGKILL)")
