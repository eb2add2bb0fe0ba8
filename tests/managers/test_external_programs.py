"""ExternalPrograms without a registrar: real programs, really killed."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import psutil
import pytest

from chaos.process_census import stands
from rr_actors.managers import external_programs, shim
from rr_actors.managers.exit_watcher import ExitWatcher, ProcessHandle
from rr_actors.managers.external_programs import (
    TAIL_LINES,
    ExternalPrograms,
    Order,
    ProgramExit,
    ProgramFailed,
    RunningProgram,
)
from rr_actors.managers.process_marks import VARIABLE, find_processes, kill_allocation
from rr_actors.managers.program_directory import Home
from rr_actors.runtime.processes.control_groups import ControlGroup, ControlGroups
from support import WARM, NoDescriptors, descriptors, hang
from support_programs import group_of_program
from support_slow import few_now

KEY = os.environ["RR_ACTORS_TESTS"]  # of this run of the tests alone, and of what its processes start


def output(tmp_path: Path, key: str = KEY) -> tuple[str, ...]:
    """The last lines that a program has printed, running or ended."""
    return Home(tmp_path / "programs" / key).output(TAIL_LINES)


def start_shim(home: Home, order: Order, allocation: str) -> subprocess.Popen[bytes]:
    """Start a shim as ExternalPrograms does, and leave it, as a manager that is killed then."""
    started = subprocess.Popen([sys.executable, "-I", "-S", shim.__file__, str(home.path)], stdin=subprocess.PIPE)
    assert started.stdin is not None
    with started.stdin as order_file:
        environment = {**order.environment, VARIABLE: allocation}
        order_file.write(msgspec.json.encode({**asdict(order), "environment": environment, "group": None}))
    return started


class Exits:
    """Collects what on_exit is told."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, ProgramExit]] = []
        self._changed = threading.Condition()

    def __call__(self, key: str, exit: ProgramExit) -> None:
        with self._changed:
            self.seen.append((key, exit))
            self._changed.notify_all()

    def wait(self, count: int = 1) -> tuple[str, ProgramExit]:
        """The exit that was the `count`th to be heard of."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.seen) >= count, 10), "no exit was heard of"
            return self.seen[count - 1]


@pytest.fixture
def exits() -> Exits:
    return Exits()


@pytest.fixture
def programs(tmp_path: Path, exits: Exits) -> Iterator[ExternalPrograms]:
    programs = ExternalPrograms(tmp_path / "programs", exits)
    yield programs
    for home in (tmp_path / "programs").iterdir():
        if home.is_dir():
            programs.stop(home.name)
    programs.close()
    assert not find_processes(VARIABLE, KEY)
    assert not shims(tmp_path)


def python(code: str, *arguments: str, ready: str | None = None, **more: object) -> Order:
    command = ["-u", "-c", code, *arguments]
    return Order(sys.executable, command, dict(os.environ), "/", ready, **more)  # type: ignore[arg-type]


def shims(tmp_path: Path) -> list[psutil.Process]:
    """The living shims of a test."""
    found: list[psutil.Process] = []
    for process in psutil.process_iter(["cmdline"]):
        line: list[str] = process.info["cmdline"] or []  # type: ignore[attr-defined]
        if len(line) > 4 and line[3].endswith("shim.py") and line[4].startswith(str(tmp_path)):
            found.append(process)
    return found


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.005)


def is_running(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


SLEEP = "import time; print('ready'); time.sleep(600)"


def test_start_returns_once_the_line_was_printed(programs: ExternalPrograms, tmp_path: Path) -> None:
    code = "import time; print('one'); print('now ready: 7'); time.sleep(600)"
    running = programs.start(KEY, python(code, ready=r"ready: \d"))
    assert is_running(running.pid)
    assert output(tmp_path) == ("one", "now ready: 7")


def test_the_response_names_the_programs_own_process_and_its_start(programs: ExternalPrograms) -> None:
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    running = programs.start(KEY, python(SLEEP, ready="ready"))
    process = psutil.Process(running.pid)
    assert SLEEP in process.cmdline()
    assert before - 0.02 <= running.start_time <= time.clock_gettime(time.CLOCK_BOOTTIME)


def test_the_program_has_a_session_of_its_own_and_its_allocation_in_its_environment(programs: ExternalPrograms) -> None:
    running = programs.start(KEY, python(SLEEP, ready="ready"), attempt=3)
    assert os.getsid(running.pid) == running.pid
    assert find_processes(VARIABLE, KEY) == {running.pid: f"{KEY}.3"}


def test_environment_arguments_and_directory_reach_the_program(programs: ExternalPrograms, tmp_path: Path) -> None:
    code = "import os, sys, time; print(os.environ['COLOUR'], sys.argv[1], os.getcwd(), flush=True); time.sleep(600)"
    programs.start(KEY, Order(sys.executable, ["-c", code, "x y"], {"COLOUR": "green"}, str(tmp_path), "green"))
    assert output(tmp_path) == (f"green x y {tmp_path}",)


def test_a_program_that_cannot_be_executed_says_so_and_leaves_nothing(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    with pytest.raises(ProgramFailed, match="cannot start 'no-such-program': FileNotFoundError"):
        programs.start(KEY, Order("no-such-program", [], dict(os.environ), "/"))
    assert not list((tmp_path / "programs").iterdir())


@pytest.mark.parametrize("free", [1, 2])  # descriptors
def test_a_start_without_free_descriptors_leaves_no_descriptor_and_no_shim(
    programs: ExternalPrograms, free: int
) -> None:
    gc.collect()  # what earlier tests have left closes its descriptors now
    before = descriptors()
    with NoDescriptors(free), pytest.raises(ProgramFailed, match="EMFILE"):
        programs.start(KEY, python(SLEEP))
    assert not descriptors() - before
    assert {child.pid for child in psutil.Process().children()} == WARM


def test_a_program_that_ends_before_it_is_ready_fails_with_code_and_output(programs: ExternalPrograms) -> None:
    with pytest.raises(ProgramFailed, match=r"(?s)not ready yet and exited with code 3.*no such device") as caught:
        programs.start(KEY, python("print('no such device'); raise SystemExit(3)", ready="ready"))
    assert caught.value.exit == ProgramExit(3, None, ("no such device",))


def test_a_program_that_is_not_ready_in_time_is_ended(
    programs: ExternalPrograms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Clock:
        """Is first read when it has printed that, however long a busy machine takes to start it."""

        sleep = staticmethod(time.sleep)

        @staticmethod
        def monotonic() -> float:
            eventually(lambda: output(tmp_path) == ("warming up",))
            return time.monotonic()

    monkeypatch.setattr(external_programs, "time", Clock)
    with pytest.raises(ProgramFailed, match=r"(?s)not ready within 0.3 s.*warming up"):
        programs.start(KEY, python("import time; print('warming up'); time.sleep(600)", ready="ready"), timeout_s=0.3)
    assert not find_processes(VARIABLE, KEY)
    assert not list((tmp_path / "programs").iterdir())


def test_ready_may_be_a_condition_checked_from_outside(programs: ExternalPrograms, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    code = f"import time; time.sleep(0.1); open({str(mark)!r}, 'w').close(); time.sleep(600)"
    programs.start(KEY, python(code), missing=lambda running: "" if mark.exists() else "the mark")
    assert mark.exists()


def test_an_unexpected_end_is_heard_of_with_signal_and_output_within_50_ms(
    programs: ExternalPrograms, exits: Exits, tmp_path: Path
) -> None:
    took: list[float] = []
    for turn in range(5):  # the best of some: the machine may have other things to do
        key = f"{KEY}{turn}"
        running = programs.start(
            key, python("print('ready'); print('last words'); import time; time.sleep(600)", ready="ready")
        )
        eventually(lambda key=key: "last words" in output(tmp_path, key))
        began = time.monotonic()
        os.kill(running.pid, signal.SIGKILL)
        assert exits.wait(turn + 1)[0] == key
        took.append(time.monotonic() - began)
    assert min(took) < 0.05
    _, exit = exits.wait()
    assert exit == ProgramExit(None, 9, ("ready", "last words"))
    assert "signal 9 (SIGKILL)" in str(exit)
    assert "last words" in str(exit)


def test_an_unexpected_end_takes_the_programs_descendants_with_it(programs: ExternalPrograms, exits: Exits) -> None:
    code = f"""
import subprocess, sys, time
subprocess.Popen([sys.executable, '-c', {SLEEP!r}])
subprocess.Popen([sys.executable, '-c', {SLEEP!r}], start_new_session=True)
print('ready'); time.sleep(600)"""
    running = programs.start(KEY, python(code, ready="^ready"))
    assert len(find_processes(VARIABLE, KEY)) == 3
    os.kill(running.pid, signal.SIGSEGV)
    assert exits.wait()[1].signal == signal.SIGSEGV
    assert not find_processes(VARIABLE, KEY)


def test_stop_sends_the_stop_signal_and_nobody_hears_of_an_exit(
    programs: ExternalPrograms, exits: Exits, tmp_path: Path
) -> None:
    mark = tmp_path / "mark"
    code = f"""
import signal, time
def leave(*_):
    open({str(mark)!r}, 'w').close()
    raise SystemExit(0)
signal.signal(signal.SIGUSR1, leave)
print('ready'); time.sleep(600)"""
    running = programs.start(KEY, python(code, ready="ready", stop_signal=signal.SIGUSR1))
    programs.stop(KEY)
    assert mark.exists()
    assert not is_running(running.pid)
    assert exits.seen == []
    assert not (tmp_path / "programs" / KEY).exists()


def test_stop_kills_after_the_grace_the_whole_group_and_daemons(programs: ExternalPrograms) -> None:
    stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready'); time.sleep(600)"
    code = f"""
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
for alone in (False, True):
    other = subprocess.Popen([sys.executable, '-u', '-c', {stubborn!r}], stdout=-1, start_new_session=alone)
    other.stdout.readline()
print('all ready'); time.sleep(600)"""
    programs.start(KEY, python(code, ready="all ready", grace_s=0.2))
    assert len(find_processes(VARIABLE, KEY)) == 3
    began = time.monotonic()
    programs.stop(KEY)
    assert 0.2 <= time.monotonic() - began < 4
    assert not find_processes(VARIABLE, KEY)


def test_a_member_of_the_group_that_needs_the_grace_gets_it(programs: ExternalPrograms, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    slow = f"""
import signal, time
def leave(*_):
    time.sleep(0.1); open({str(mark)!r}, 'w').close(); raise SystemExit
signal.signal(signal.SIGTERM, leave)
print('ready'); time.sleep(600)"""
    code = f"""
import subprocess, sys, time
other = subprocess.Popen([sys.executable, '-u', '-c', {slow!r}], stdout=-1)
other.stdout.readline()
print('all ready'); time.sleep(600)"""
    programs.start(KEY, python(code, ready="all ready"))
    programs.stop(KEY)
    assert mark.exists()


@pytest.mark.parametrize("leader_waits", [False, True])
def test_the_stop_signal_reaches_a_process_in_a_session_of_its_own_which_gets_the_grace(
    programs: ExternalPrograms, tmp_path: Path, leader_waits: bool
) -> None:
    saved = tmp_path / "saved"
    saving = f"""
import signal, time
def leave(*_):
    time.sleep(0.2); open({str(saved)!r}, 'a').write('saved '); raise SystemExit
signal.signal(signal.SIGTERM, leave)
print('ready', flush=True)
while True: time.sleep(600)"""
    code = f"""
import signal, subprocess, sys
other = subprocess.Popen([sys.executable, '-u', '-c', {saving!r}], stdout=-1, start_new_session=True)
other.stdout.readline()
signal.signal(signal.SIGTERM, lambda *_: sys.exit({leader_waits} and other.wait()))
print('all ready')
while True: signal.pause()"""
    programs.start(KEY, python(code, ready="all ready", grace_s=60))
    began = time.monotonic()
    programs.stop(KEY)
    assert time.monotonic() - began < 30
    assert saved.read_text() == "saved "
    assert not find_processes(VARIABLE, KEY)


def test_what_a_program_starts_in_order_to_end_gets_no_stop_signal(programs: ExternalPrograms, tmp_path: Path) -> None:
    saved = tmp_path / "saved"
    code = f"""
import signal, subprocess, sys
def leave(*_):
    subprocess.run(['sh', '-c', 'sleep 0.2; touch {saved}'], start_new_session=True)
    sys.exit()
signal.signal(signal.SIGTERM, leave)
print('ready')
while True: signal.pause()"""
    programs.start(KEY, python(code, ready="ready", grace_s=60))
    programs.stop(KEY)
    assert saved.exists()


def refuse_signal(number: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Have shims that may not send this signal, as to processes of another user."""
    file = tmp_path / "refused_shim.py"
    file.write_text(f"""
import os, sys
sys.path.insert(0, {str(Path(shim.__file__).parent)!r})
import shim
def refusing(send):
    def refuse(pid, number):
        if number == {int(number)}:
            raise PermissionError(1, "Operation not permitted")
        send(pid, number)
    return refuse
os.kill, os.killpg = refusing(os.kill), refusing(os.killpg)
os._exit(shim.main(sys.argv[1]))""")
    monkeypatch.setattr("rr_actors.managers.external_programs._SHIM", str(file))


def test_the_end_of_a_program_is_heard_of_though_another_users_process_is_left_of_it(
    programs: ExternalPrograms, exits: Exits, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_signal(signal.SIGKILL, monkeypatch, tmp_path)
    go = tmp_path / "go"
    code = f"""
import os, subprocess, sys, time
subprocess.Popen([sys.executable, '-c', {SLEEP!r}], stdout=subprocess.DEVNULL)
print('ready')
while not os.path.exists({str(go)!r}): time.sleep(0.005)
raise SystemExit(3)"""
    programs.start(KEY, python(code, ready="ready"))
    go.touch()
    assert exits.wait() == (KEY, ProgramExit(3, None, ("ready",)))
    kill_allocation(KEY)


def test_a_group_with_another_users_process_gets_the_grace(
    programs: ExternalPrograms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_signal(0, monkeypatch, tmp_path)
    mark = tmp_path / "mark"
    slow = f"trap '' TERM; echo ready; sleep 0.3; touch {mark}"
    code = f"import subprocess, time; subprocess.Popen(['sh', '-c', {slow!r}]); time.sleep(600)"
    programs.start(KEY, python(code, ready="ready", grace_s=2))
    programs.stop(KEY)
    assert mark.exists()


def test_a_program_that_writes_without_end_is_ended_all_the_same_and_its_log_is_bounded(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    running = programs.start(KEY, python("while True: print('x' * 1000)", grace_s=0.1))
    eventually((tmp_path / "programs" / KEY / "output.old").exists)
    (shim,) = shims(tmp_path)
    hang(shim.pid)  # it renames a file while it is looked at
    size = sum(file.stat().st_size for file in (tmp_path / "programs" / KEY).iterdir())
    shim.resume()
    assert size < 1_500_000
    programs.stop(KEY)
    assert not is_running(running.pid)


def test_stopping_twice_or_what_never_ran_does_nothing(programs: ExternalPrograms) -> None:
    programs.start(KEY, python(SLEEP, ready="ready"))
    programs.stop(KEY)
    programs.stop(KEY)
    programs.stop("never")


# -- watching ------------------------------------------------------------------------------------------------------


def test_a_process_that_ends_while_its_watcher_is_closed_disturbs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    program = subprocess.Popen(["sleep", "600"])
    wake, woken = socket.socketpair()

    class Slow:
        def send(self, data: bytes) -> int:
            program.kill()
            (thread,) = (thread for thread in threading.enumerate() if thread.name == "exit-watcher")
            thread.join(0.2)
            return wake.send(data)

        def close(self) -> None:
            wake.close()

    with monkeypatch.context() as patched:
        patched.setattr(socket, "socketpair", lambda: (Slow(), woken))
        watcher = ExitWatcher()
    watcher.watch(ProcessHandle(program.pid), lambda: None)
    watcher.close()
    program.wait()


def test_a_process_is_not_taken_for_gone_for_want_of_descriptors() -> None:
    with NoDescriptors(1), pytest.raises(OSError, match="Too many open files") as raised:
        ProcessHandle(os.getpid(), 1)
    assert not isinstance(raised.value, ProcessLookupError)


def test_a_callback_that_raises_is_logged_and_the_next_end_is_heard_of(caplog: pytest.LogCaptureFixture) -> None:
    watcher, heard = ExitWatcher(), threading.Event()

    def fail() -> None:
        raise RuntimeError("the callback is broken")

    for callback in (fail, heard.set):
        program = subprocess.Popen(["true"])
        watcher.watch(ProcessHandle(program.pid), callback)
        eventually(lambda pid=program.pid: not is_running(pid))
    assert heard.wait(10)
    watcher.close()
    assert "the callback is broken" in caplog.text


# -- the manager's crash -------------------------------------------------------------------------------------------


def crashed_manager(tmp_path: Path, order: str, *, wait_for: str) -> None:
    """Run a manager in a process of its own that starts a program and is SIGKILLed: `order` is an expression."""
    code = f"""
import os, sys
from pathlib import Path
sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[1])]!r}
from test_external_programs import *
programs = ExternalPrograms(Path({str(tmp_path / "programs")!r}), print)
print('begun', flush=True)
programs.start(KEY, {order})
print('started', flush=True)
import time; time.sleep(600)"""
    manager = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert manager.stdout is not None
    while manager.stdout.readline().strip() != wait_for:
        assert manager.poll() is None, "the manager failed"
    manager.kill()
    manager.wait()
    manager.stdout.close()


def test_a_program_outlives_its_manager_and_is_attached_to_again(
    programs: ExternalPrograms, exits: Exits, tmp_path: Path
) -> None:
    crashed_manager(tmp_path, "python(SLEEP, ready='ready')", wait_for="started")
    (pid,) = find_processes(VARIABLE, KEY)
    running = programs.attach(KEY)
    assert running.pid == pid
    assert is_running(pid)
    os.kill(pid, signal.SIGTERM)
    assert exits.wait() == (KEY, ProgramExit(None, 15, ("ready",)))


def test_a_program_that_ended_while_there_was_no_manager_has_left_its_exit_code(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    code = "import signal; print('ready'); signal.sigwait([signal.SIGUSR1]); print('bye'); raise SystemExit(42)"
    code = "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1]);" + code
    crashed_manager(tmp_path, f"python({code!r}, ready='ready')", wait_for="started")
    (pid,) = find_processes(VARIABLE, KEY)
    os.kill(pid, signal.SIGUSR1)
    eventually(lambda: not psutil.pid_exists(pid))  # reaped, no zombie
    eventually(lambda: not shims(tmp_path))
    with pytest.raises(ProgramFailed, match=r"(?s)exited with code 42.*bye") as caught:
        programs.attach(KEY)
    assert caught.value.exit == ProgramExit(42, None, ("ready", "bye"))


def test_a_program_that_has_ended_is_not_attached_to_while_its_shim_is_still_there(
    programs: ExternalPrograms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crashed_manager(tmp_path, "python(SLEEP, ready='ready')", wait_for="started")
    (shim,) = shims(tmp_path)
    (pid,) = find_processes(VARIABLE, KEY)
    looked = threading.Event()
    state_of = Home.state

    def ended(home: Home) -> dict[str, Any]:
        looked.set()
        return {**state_of(home), "ended": {"code": 42}}

    with monkeypatch.context() as patch:
        patch.setattr(Home, "state", ended)
        outcome: list[object] = []

        def attach() -> None:
            try:
                outcome.append(programs.attach(KEY))
            except ProgramFailed as error:
                outcome.append(error.exit.code if error.exit is not None else None)

        thread = threading.Thread(target=attach)
        thread.start()
        assert looked.wait(10)
        os.kill(shim.pid, signal.SIGKILL)  # the program with it
        thread.join()
    assert outcome == [42]
    eventually(lambda: not psutil.pid_exists(pid))


def test_a_start_interrupted_before_the_program_was_ready_is_taken_over(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    go = tmp_path / "go"
    code = f"""
import os, time
while not os.path.exists({str(go)!r}): time.sleep(0.005)
print('ready'); time.sleep(600)"""
    crashed_manager(tmp_path, f"python({code!r}, ready='ready')", wait_for="begun")
    go.touch()
    running = programs.start(KEY, python(code, ready="ready"), attempt=2)
    assert list(find_processes(VARIABLE, KEY)) == [running.pid]
    assert len(shims(tmp_path)) == 1


@pytest.mark.parametrize("delay_ms", few_now(range(0, 60, 12), [delay for delay in range(0, 60, 4) if delay % 12]))
def test_whatever_moment_the_manager_is_killed_at_there_is_exactly_one_instance(
    exits: Exits, tmp_path: Path, delay_ms: int
) -> None:
    code = f"""
import os, signal, sys, threading, time
sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[1])]!r}
from test_external_programs import *
programs = ExternalPrograms(Path({str(tmp_path / "programs")!r}), print)
def die(): time.sleep({delay_ms / 1000}); os.kill(os.getpid(), signal.SIGKILL)
threading.Thread(target=die).start()
programs.start(KEY, python(SLEEP, ready='ready'))
time.sleep(600)"""
    subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False)
    programs = ExternalPrograms(tmp_path / "programs", exits)
    running = programs.start(KEY, python(SLEEP, ready="ready"), attempt=2)
    assert list(find_processes(VARIABLE, KEY)) == [running.pid]
    programs.stop(KEY)
    eventually(lambda: not shims(tmp_path))
    assert not find_processes(VARIABLE, KEY)
    programs.close()


def test_of_two_shims_for_one_directory_one_runs_the_program(programs: ExternalPrograms, tmp_path: Path) -> None:
    order = python(SLEEP, ready="ready")
    home = Home(tmp_path / "programs" / KEY)
    home.make()
    started = [start_shim(home, order, f"{KEY}.{attempt}") for attempt in (1, 2)]
    running = programs.start(KEY, order, attempt=3)
    eventually(lambda: len(shims(tmp_path)) == 1)
    assert list(find_processes(VARIABLE, KEY)) == [running.pid]
    programs.stop(KEY)
    for each in started:
        each.wait(10)


def test_a_reused_pid_is_not_taken_for_the_program(programs: ExternalPrograms, tmp_path: Path) -> None:
    crashed_manager(tmp_path, "python(SLEEP, ready='ready')", wait_for="started")
    (shim,) = shims(tmp_path)
    shim.kill()
    eventually(lambda: not shims(tmp_path))
    home = tmp_path / "programs" / KEY
    innocent = subprocess.Popen(["sleep", "600"])
    try:
        state = (home / "state.json").read_text()
        (home / "state.json").write_text(state.replace(f"[{shim.pid},", f"[{innocent.pid},"))
        with pytest.raises(ProgramFailed):
            programs.attach(KEY)
        programs.stop(KEY)
        assert innocent.poll() is None
    finally:
        innocent.kill()
        innocent.wait()


DAMAGE = few_now([b"{", b'{"shim": 5}'], [b"", b"\xff\xfe", b"null", b"{}", b'{"shim": [1, 2]}', b"[" * 100_000])


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: repr(damage[:12]))
def test_a_damaged_state_is_named_and_kept_aside_and_its_program_ended(
    programs: ExternalPrograms, tmp_path: Path, damage: bytes
) -> None:
    crashed_manager(tmp_path, "python(SLEEP, ready='ready')", wait_for="started")
    path = tmp_path / "programs" / KEY / "state.json"
    path.write_bytes(damage)
    with pytest.raises(ProgramFailed, match="expected the JSON object that the program's shim writes") as failed:
        programs.attach(KEY)
    (aside,) = (tmp_path / "programs").glob("*.damaged")
    assert aside.read_bytes() == damage
    assert str(path) in str(failed.value)
    assert repr(damage[:60]) in str(failed.value)
    assert str(aside) in str(failed.value)
    assert not find_processes(VARIABLE, KEY)
    programs.stop(KEY)
    running = programs.start(KEY, python(SLEEP, ready="ready"), attempt=2)
    assert list(find_processes(VARIABLE, KEY)) == [running.pid]


def test_a_start_that_finds_the_damaged_state_of_one_that_was_interrupted_fails_and_the_next_one_succeeds(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    crashed_manager(tmp_path, "python(SLEEP, ready='ready')", wait_for="started")
    (tmp_path / "programs" / KEY / "state.json").write_bytes(b"damaged")
    with pytest.raises(ProgramFailed, match=r"cannot take .* over: .*state\.json: expected the JSON object"):
        programs.start(KEY, python(SLEEP, ready="ready"), attempt=2)
    running = programs.start(KEY, python(SLEEP, ready="ready"), attempt=3)
    assert list(find_processes(VARIABLE, KEY)) == [running.pid]


def test_a_program_with_a_damaged_state_whose_shim_was_killed_is_released_all_the_same(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    programs.start(KEY, python(SLEEP, ready="ready"))
    (shim,) = shims(tmp_path)
    shim.kill()
    (tmp_path / "programs" / KEY / "state.json").write_bytes(b"damaged")
    programs.stop(KEY)
    assert not (tmp_path / "programs" / KEY).exists()
    assert not find_processes(VARIABLE, KEY)


def test_a_program_whose_shim_cannot_write_its_state_can_be_ended(
    programs: ExternalPrograms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.managers.external_programs._SHIM_LIMIT_S", 0.5)
    home = Home(tmp_path / "programs" / KEY)
    home.make()
    (home.path / "state.json.new").mkdir()  # as a full disk would
    started = start_shim(home, python(SLEEP), f"{KEY}.1")
    eventually(lambda: bool(find_processes(VARIABLE, KEY)))
    programs.stop(KEY)
    started.wait(10)
    assert not home.exists()
    assert not find_processes(VARIABLE, KEY)


def test_a_directory_that_cannot_be_removed_now_is_no_failure_and_is_removed_at_the_next_start(
    tmp_path: Path, exits: Exits, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs, places, removed = ExternalPrograms(tmp_path / "programs", exits), tmp_path / "programs", os.rmdir

    def on_a_share(path: Any, **options: Any) -> None:
        """As on NFS and FUSE, where a file that is removed while it is open stays in its directory."""
        if lock_files(places):
            raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY))
        removed(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rmdir", on_a_share)
        running = programs.start(KEY, python(SLEEP, ready="ready"))
        programs.stop(KEY)
        assert not is_running(running.pid)
        assert list(places.iterdir()) == [], "this process has closed the files in it by then"
        patch.setattr(os, "rmdir", lambda *_, **__: _raise(OSError(errno.EBUSY, os.strerror(errno.EBUSY))))
        for _ in range(2):
            running = programs.start(KEY, python(SLEEP, ready="ready"))
            programs.stop(KEY)
            assert not is_running(running.pid)
        assert len(list(places.iterdir())) == 2
    programs.close()
    ExternalPrograms(places, exits).close()
    assert list(places.iterdir()) == []


def lock_files(places: Path) -> list[int]:
    """The descriptors of this process that have a lock of a program open."""
    found: list[int] = []
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            if f"{places}/" in os.readlink(f"/proc/self/fd/{name}") and not os.path.isdir(f"/proc/self/fd/{name}"):
                found.append(int(name))
    return found


def _raise(error: Exception) -> NoReturn:
    raise error


def test_killing_the_shim_ends_the_program_and_its_children_and_is_heard_of(
    programs: ExternalPrograms, exits: Exits, tmp_path: Path
) -> None:
    child = "import time; time.sleep(600)"
    code = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {child!r}]); {SLEEP}"
    programs.start(KEY, python(code, ready="ready"))
    (shim,) = shims(tmp_path)
    shim.kill()
    assert exits.wait()[1] == ProgramExit(None, None, ("ready",))
    assert not find_processes(VARIABLE, KEY)


def test_an_end_that_could_not_be_written_is_not_called_a_kill(
    programs: ExternalPrograms, exits: Exits, tmp_path: Path
) -> None:
    programs.start(KEY, python(SLEEP, ready="ready"))
    running = Home(tmp_path / "programs" / KEY).state()["program"][0]
    (tmp_path / "programs" / KEY / "state.json.new").mkdir()  # as a full disk would
    os.kill(running, signal.SIGTERM)
    assert "has ended unseen: the process that watched over it was killed, or could not write" in str(exits.wait()[1])


def test_a_state_that_a_full_disk_did_not_take_is_written_when_it_has_room(
    programs: ExternalPrograms, tmp_path: Path
) -> None:
    code = f"import sys; sys.stdin = open(sys.argv[1]); sys.stdin.readline(); {SLEEP}"
    os.mkfifo(tmp_path / "go")
    home, started = tmp_path / "programs" / KEY, Future[RunningProgram]()

    def start() -> None:
        started.set_result(programs.start(KEY, python(code, str(tmp_path / "go"), ready="ready"), timeout_s=30))

    threading.Thread(target=start, daemon=True).start()
    eventually((home / "state.json").exists)
    (home / "state.json.new").mkdir()  # as a full disk would
    (tmp_path / "go").write_text("\n")
    eventually(lambda: output(tmp_path) == ("ready",))
    (home / "state.json.new").rmdir()
    assert is_running(started.result(10).pid)


@pytest.mark.parametrize(
    ("role", "wanted"), [("mkdir", errno.EDQUOT), ("pipe", errno.EMFILE), ("posix_spawn", errno.EAGAIN)]
)
def test_a_start_that_fails_for_want_of_means_says_which_and_leaves_nothing(
    programs: ExternalPrograms, monkeypatch: pytest.MonkeyPatch, role: str, wanted: int
) -> None:
    programs.start("other", python(SLEEP, ready="ready"))
    with monkeypatch.context() as patched:
        patched.setattr(os, role, lambda *_, **__: _raise(OSError(wanted, os.strerror(wanted))))
        with pytest.raises(
            ProgramFailed, match=rf"cannot start '{sys.executable}': {errno.errorcode[wanted]}"
        ) as failed:
            programs.start(KEY, python(SLEEP, ready="ready"))
    assert failed.value.wanted.startswith(errno.errorcode[wanted])
    assert is_running(programs.start(KEY, python(SLEEP, ready="ready")).pid)


def test_a_program_whose_shim_cannot_write_its_state_fails_for_want_of_room(
    programs: ExternalPrograms, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda *_, **__: _raise(full))
    with pytest.raises(ProgramFailed, match="ENOSPC: the disk is full") as failed:
        programs.start(KEY, python("import time; time.sleep(600)", ready="ready"), timeout_s=0.2)
    assert failed.value.wanted.startswith("ENOSPC")


def test_a_program_that_cannot_be_executed_is_itself_to_blame(programs: ExternalPrograms, tmp_path: Path) -> None:
    order = python(SLEEP)
    too_long = Order(sys.executable, ["-c", "x" * 3_000_000], order.environment, "/")
    with pytest.raises(ProgramFailed, match="Argument list too long") as failed:  # that is no want
        programs.start(KEY, too_long)
    assert failed.value.wanted == ""


def test_closing_leaves_the_programs_running(tmp_path: Path, exits: Exits) -> None:
    first = ExternalPrograms(tmp_path / "programs", exits)
    running = first.start(KEY, python(SLEEP, ready="ready"))
    first.close()
    assert is_running(running.pid)
    second = ExternalPrograms(tmp_path / "programs", exits)
    assert second.attach(KEY) == running
    second.stop(KEY)
    second.close()
    assert not is_running(running.pid)
    assert exits.seen == []


# -- control groups --------------------------------------------------------------------------------------------------


@pytest.fixture
def grouped(tmp_path: Path, exits: Exits) -> Iterator[ExternalPrograms]:
    if ControlGroups.of_this_process().place("rr-test") is None:
        pytest.skip("no control groups of version 2 that can be written")
    programs = ExternalPrograms(tmp_path / "programs", exits, pauses=True)
    yield programs
    programs.stop(KEY)
    programs.close()


def test_a_paused_program_is_frozen_in_a_group_with_all_that_it_started_which_goes_with_it(
    grouped: ExternalPrograms, tmp_path: Path
) -> None:
    code = "import os, time; os.fork() or os.setsid(); print('ready', flush=True); time.sleep(600)"
    running = grouped.start(KEY, python(code, ready="ready"))
    group = group_of_program(running.pid)
    assert group is not None
    pids = set(find_processes(VARIABLE, KEY))
    assert len(pids) == 2
    assert ControlGroup(group).pids() == pids
    grouped.pause(KEY)
    assert all(stands(pid) for pid in pids)
    grouped.pause(KEY)
    grouped.resume(KEY)
    assert not any(stands(pid) for pid in pids)
    assert psutil.Process(running.pid).status() != psutil.STATUS_STOPPED
    grouped.pause(KEY)
    grouped.stop(KEY)  # a frozen program is ended as others are, without waiting for its grace
    assert not find_processes(VARIABLE, KEY)
    assert not group.exists()


def test_a_group_is_removed_when_manager_and_shim_were_killed(grouped: ExternalPrograms, tmp_path: Path) -> None:
    running = grouped.start(KEY, python(SLEEP, ready="ready"))
    group = group_of_program(running.pid)
    assert group is not None
    grouped.pause(KEY)
    shim = psutil.Process(running.pid).parent()
    assert shim is not None
    shim.kill()
    eventually(lambda: not is_running(shim.pid))
    again = ExternalPrograms(tmp_path / "programs", print, pauses=True)
    with pytest.raises(ProgramFailed):
        again.attach(KEY)
    again.stop(KEY)
    again.close()
    assert not group.exists()


def test_a_group_that_was_noted_and_never_made_is_no_error(grouped: ExternalPrograms, tmp_path: Path) -> None:
    home = Home(tmp_path / "programs" / KEY)
    home.make()
    home.note_group(ControlGroup(tmp_path / "none"))
    running = grouped.start(home.key, python(SLEEP, ready="ready"))
    assert group_of_program(running.pid) is not None


@pytest.mark.parametrize("there", [False, True])
def test_where_none_can_be_made_a_program_runs_and_is_stopped_and_its_limits_are_said_not_to_hold(
    tmp_path: Path, exits: Exits, there: bool, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "cgroup.procs").touch()
    (tmp_path / f"rr-{KEY}").touch()  # no group can have this name
    groups = ControlGroups(tmp_path if there else None, tmp_path)
    programs = ExternalPrograms(tmp_path / "programs", exits, pauses=True, groups=groups)
    running = programs.start(KEY, python(SLEEP, ready="ready", limits={"cpu": 0.5, "memory_bytes": 1e8}))
    try:
        assert group_of_program(running.pid) is None
        assert "its share of cpu is counted, not enforced: see rr-actors doctor" in caplog.text
        assert "its share of memory_bytes is counted, not enforced" in caplog.text
        programs.pause(KEY)
        eventually(lambda: stands(running.pid))
        programs.resume(KEY)
        eventually(lambda: not stands(running.pid))
    finally:
        programs.stop(KEY)
        programs.close()


def test_without_a_control_group_a_pause_stops_what_runs_in_a_session_of_its_own_too(
    tmp_path: Path, exits: Exits
) -> None:
    programs = ExternalPrograms(tmp_path / "programs", exits, pauses=True, groups=ControlGroups(None, None))
    code = f"""
import signal, subprocess, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
other = subprocess.Popen([sys.executable, '-c', {SLEEP!r}], stdout=subprocess.DEVNULL, start_new_session=True)
print('ready')
other.wait()"""
    try:
        programs.start(KEY, python(code, ready="ready", grace_s=60))
        pids = set(find_processes(VARIABLE, KEY))
        assert len(pids) == 2
        programs.pause(KEY)
        eventually(lambda: all(stands(pid) for pid in pids))
        programs.resume(KEY)
        eventually(lambda: not any(stands(pid) for pid in pids))
        programs.pause(KEY)
    finally:
        programs.stop(KEY)  # what is stopped goes on, and acts on the stop signal
        programs.close()
    assert not find_processes(VARIABLE, KEY)


def test_a_program_enters_its_group_and_the_limits_are_there_before_it(tmp_path: Path, exits: Exits) -> None:
    top = tmp_path / "top"
    top.mkdir()
    (top / "cgroup.procs").touch()
    (top / "cgroup.subtree_control").write_text("cpu")
    programs = ExternalPrograms(tmp_path / "programs", exits, groups=ControlGroups(top, top))
    limit = str(top / f"rr-{KEY}" / "cpu.max")
    code = f"print(open({limit!r}).read(), flush=True); import time; time.sleep(600)"
    programs.start(KEY, python(code, ready="^50000 100000", limits={"cpu": 0.5}))
    try:
        assert (top / f"rr-{KEY}" / "cgroup.procs").read_text() == "0"
    finally:
        programs.stop(KEY)
        programs.close()
