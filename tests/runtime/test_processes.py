"""Child processes: started fast, watched by pidfd, ended with everything they started."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import multiprocessing.spawn
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from rr_actors.base.errors import StartFailed
from rr_actors.runtime.processes import fork_server, lifeline
from rr_actors.runtime.processes.process import Exited, Process, Spawner
from support import WARM, eventually, lives, quickly, wait_gone
from support_children import hear

pytestmark = pytest.mark.cold

TELL = "support_children:until_told"


@pytest.fixture
def spawner() -> Iterator[Spawner]:
    spawner = Spawner()
    yield spawner
    spawner.close()


@contextlib.contextmanager
def started(spawner: Spawner, entry: str = TELL, payload: bytes = b"", name: str = "child") -> Iterator[Process]:
    process = spawner.start(entry, payload, name=name)
    try:
        yield process
    finally:
        process.kill()
        wait_gone(process.pid)
        process.close()


def exit_of(child: Process, timeout_s: float = 5.0) -> Exited:
    """How it has ended, once it has."""

    async def told() -> Exited:
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Exited] = loop.create_future()
        child.watch(loop, future.set_result)
        return await asyncio.wait_for(future, timeout_s)

    return asyncio.run(told())


def test_a_child_runs_its_entry_in_a_process_group_of_its_own(spawner: Spawner) -> None:
    with started(spawner, payload=b"12345", name="cameras") as child:
        said = hear(child.control)
        assert said["pid"] == child.pid != os.getpid()
        assert said["group"] == child.pid
        assert (said["name"], said["size"]) == ("cameras", 5)


def test_a_large_payload_arrives_whole(spawner: Spawner) -> None:
    with started(spawner, payload=bytes(5_000_000)) as child:
        assert hear(child.control)["size"] == 5_000_000


def test_a_child_finds_its_parents_surroundings(
    spawner: Spawner, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RR_ACTORS_TEST_VARIABLE", "set later")
    monkeypatch.chdir(tmp_path)
    with started(spawner) as child:
        said = hear(child.control)
    assert said["variable"] == "set later"
    assert said["cwd"] == str(tmp_path)
    assert said["argv"] == sys.argv


def test_a_child_and_its_programs_have_the_environment_that_the_parent_has_now(
    spawner: Spawner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RR_ACTORS_TEST_VARIABLE", "at first")
    monkeypatch.setenv("RR_ACTORS_TEST_REMOVED", "at first")
    with started(spawner) as first:  # the fork server has these
        assert hear(first.control)["variable"] == "at first"
    monkeypatch.setenv("RR_ACTORS_TEST_VARIABLE", "changed")
    monkeypatch.delenv("RR_ACTORS_TEST_REMOVED")
    monkeypatch.setenv("RR_ACTORS_TEST_ADDED", "later")
    with started(spawner, "support_children:say_environment") as child:
        said = hear(child.control)
    assert said["own"] == dict(os.environ)
    assert said["of_program"] == dict(os.environ)


def test_a_child_is_a_process_of_multiprocessing(spawner: Spawner) -> None:
    with started(spawner, "support_children:say_process", name="cameras") as child:
        said = hear(child.control)
    parent = multiprocessing.current_process()
    assert said == {
        "name": "cameras",
        "key": bytes(parent.authkey).hex(),
        "parent": [parent.name, os.getpid()],
        "children": 0,
        "method": "forkserver",
        "thread": child.pid,
        "grandchild": ["1", 7],
        "standard_input": "",
        "excepthook": True,
    }


def test_the_exit_code_is_what_the_entry_returns(spawner: Spawner) -> None:
    with started(spawner) as child:
        assert child.exited is None
        child.control.sendall(b"7")
        assert exit_of(child).code == 7
        assert child.kill() is False


def test_an_exception_is_exit_code_1_with_its_traceback_on_stderr(
    spawner: Spawner, capfd: pytest.CaptureFixture[str]
) -> None:
    with started(spawner, "support_children:raise_at_once") as child:
        assert exit_of(child) == (1, pytest.approx(time.monotonic(), abs=5))
    assert "ValueError: as it was told" in capfd.readouterr().err


def test_a_child_that_returns_does_not_wait_for_its_threads(
    spawner: Spawner, capfd: pytest.CaptureFixture[str]
) -> None:
    with started(spawner, "support_children:stay_with_thread") as child:
        assert exit_of(child).code == 0
    assert "last words" in capfd.readouterr().out


def test_a_signal_is_told_as_its_negative_number(spawner: Spawner) -> None:
    with started(spawner) as child:
        assert child.kill(signal.SIGKILL)
        assert exit_of(child).code == -signal.SIGKILL


def test_an_interrupt_at_the_terminal_does_not_end_a_child(spawner: Spawner) -> None:
    with started(spawner) as child:
        hear(child.control)
        child.kill(signal.SIGINT)
        child.control.sendall(b"3")
        assert exit_of(child).code == 3


def test_a_death_is_noticed_on_the_loop_within_milliseconds(spawner: Spawner) -> None:
    async def noticed_after() -> float:
        with started(spawner) as child:
            hear(child.control)
            future: asyncio.Future[Exited] = asyncio.get_running_loop().create_future()
            child.watch(asyncio.get_running_loop(), future.set_result)
            killed = time.monotonic()
            os.kill(child.pid, signal.SIGKILL)
            exited = await asyncio.wait_for(future, 5.0)
            assert exited.code == -signal.SIGKILL
            return exited.at - killed

    quickly(lambda: statistics.median(asyncio.run(noticed_after()) for _ in range(9)), 0.02)


def test_watching_a_process_that_is_dead_already_tells_at_once(spawner: Spawner) -> None:
    with started(spawner) as child:
        child.kill()
        wait_gone(child.pid)
        assert exit_of(child).code == -signal.SIGKILL


def test_a_death_is_noticed_without_the_fork_server(spawner: Spawner) -> None:
    async def watch(child: Process) -> Exited:
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Exited] = loop.create_future()
        child.watch(loop, future.set_result)
        psutil.Process(psutil.Process(child.pid).ppid()).kill()
        wait_gone(server)
        assert not future.done()
        os.kill(child.pid, signal.SIGKILL)
        return await asyncio.wait_for(future, 5.0)

    with started(spawner) as child:
        hear(child.control)
        server = psutil.Process(child.pid).ppid()
        assert asyncio.run(watch(child)).code is None  # nobody was there to collect its code


def test_a_killed_fork_server_is_replaced_and_its_children_live_on(spawner: Spawner) -> None:
    with started(spawner) as first:
        hear(first.control)
        server = psutil.Process(first.pid).ppid()
        os.kill(server, signal.SIGKILL)
        wait_gone(server)
        with started(spawner) as second:
            hear(second.control)
            assert psutil.Process(second.pid).ppid() != server
            assert lives(first.pid)


PLACINGS = 5  # a fork server that is placed badly is started so often at most


def test_an_interpreter_is_placed_where_its_branches_are_not_taken_for_its_parents(spawner: Spawner) -> None:
    with started(spawner) as child:
        (server,) = [parent for parent in psutil.Process(child.pid).parents() if parent.ppid() == os.getpid()]
        its_code = server.cmdline()[server.cmdline().index("-c") + 1]
    placing = "; ".join(its_code.split("; ")[:2])
    code = f"{placing}; print(id(type), len(sys.argv))"
    running = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(32)]
    places = [tuple(map(int, process.communicate(timeout=30)[0].split())) for process in running]

    assert [place for place, _ in places if place != id(type) and (place - id(type)) % (1 << 24) == 0] == []
    assert all(arguments <= PLACINGS for _, arguments in places)


def test_a_fork_server_that_cannot_be_placed_well_serves_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fork_server, "_ALIKE_BYTES", 1)  # no place is good
    spawner = Spawner()
    try:
        with started(spawner, payload=b"12345") as child:
            assert hear(child.control)["size"] == 5
            (server,) = [parent for parent in psutil.Process(child.pid).parents() if parent.ppid() == os.getpid()]
            assert server.cmdline()[-PLACINGS + 1 :] == ["again"] * (PLACINGS - 1)
    finally:
        spawner.close()


def test_a_child_starts_its_own_children_by_the_fork_server_it_came_from(spawner: Spawner) -> None:
    with started(spawner, "support_children:have_a_child") as child:
        said = hear(child.control)
        assert said["same_server"]
        child.control.sendall(b"x")
        assert exit_of(child).code == 0
        assert not lives(said["grandchild"])


def test_a_payload_larger_than_a_pipe_arrives_whole(spawner: Spawner) -> None:
    with started(spawner, payload=bytes(3_000_000)) as child:
        assert hear(child.control)["size"] == 3_000_000


def test_a_process_that_cannot_be_started_in_time_is_an_error_and_leaves_nothing(spawner: Spawner) -> None:
    with started(spawner) as child:
        hear(child.control)
        server = psutil.Process(psutil.Process(child.pid).ppid())
        server.suspend()
        try:
            with pytest.raises(StartFailed, match=r"slow.*in time"):
                spawner.start(TELL, b"", name="slow", timeout_s=0.1)
        finally:
            server.resume()


@pytest.mark.parametrize("error", ["RuntimeError", "SystemExit"])
def test_a_broken_preload_does_not_keep_children_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: str
) -> None:
    (tmp_path / "broken_preload.py").write_text(f"raise {error}('broken on purpose')")
    monkeypatch.syspath_prepend(str(tmp_path))
    spawner = Spawner(["broken_preload"])
    with started(spawner) as child:
        hear(child.control)
    spawner.close()
    assert "could not preload 'broken_preload'" in capfd.readouterr().err


LEAVES_GARBAGE = """
import os

class Ring:
    def __init__(self):
        self.itself = self

    def __del__(self):
        open(os.environ["COLLECTED"], "w").close()

Ring()
"""


def test_garbage_that_a_preloaded_module_leaves_is_collected_before_a_child_is_forked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "leaves_garbage.py").write_text(LEAVES_GARBAGE)
    collected = tmp_path / "collected"
    monkeypatch.setenv("COLLECTED", str(collected))
    monkeypatch.syspath_prepend(str(tmp_path))
    spawner = Spawner(["leaves_garbage"])
    with started(spawner) as child:
        hear(child.control)
        assert collected.exists()
    spawner.close()


SAYS_GOODBYE = """
import atexit, os, tempfile

def say(text):
    with open(os.environ["GOODBYES"], "a") as file:
        print(os.getpid(), text, file=file)

atexit.register(say, "preloaded")
folder = tempfile.TemporaryDirectory(prefix="preloaded-")
"""


def test_a_child_runs_its_own_exit_handlers_and_not_those_of_its_fork_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "says_goodbye.py").write_text(SAYS_GOODBYE)
    goodbyes = tmp_path / "goodbyes"
    monkeypatch.setenv("GOODBYES", str(goodbyes))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    spawner = Spawner(["says_goodbye"])
    with started(spawner, "support_children:say_goodbye") as child:
        pid = child.pid
        assert exit_of(child, 10.0).code == 0
    assert goodbyes.read_text().splitlines() == [f"{pid} own", f"{pid} finalized", f"{pid} multiprocessing"]
    assert list(tmp_path.glob("own-*")) == []
    assert len(list(tmp_path.glob("preloaded-*"))) == 1  # it is the server's
    spawner.close()
    (server, said), *others = [line.split() for line in goodbyes.read_text().splitlines()[3:]]
    assert (int(server) != pid, said, others) == (True, "preloaded", [])
    assert list(tmp_path.glob("preloaded-*")) == []


def test_what_a_child_started_dies_with_it(spawner: Spawner) -> None:
    def gone_after() -> float:
        with started(spawner, "support_children:start_programs") as child:
            said = hear(child.control)
            child.kill()
            wait_gone(child.pid)
            lifeline.kill_group(child.pid)
            inside_s = wait_gone(said["inside"])
            assert lives(said["outside"])
            assert spawner.sweep() == 1
            return max(inside_s, wait_gone(said["outside"]))

    quickly(gone_after, 0.2)


def test_a_python_without_pidfds_ends_what_a_child_started_all_the_same(
    spawner: Spawner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "pidfd_open", raising=False)
    with started(spawner, "support_children:start_programs") as child:
        said = hear(child.control)
        assert child.kill()
        assert exit_of(child).code == -signal.SIGKILL
        lifeline.kill_group(child.pid)
        wait_gone(said["inside"])
        assert spawner.sweep() == 1
        wait_gone(said["outside"])


def test_a_python_without_pidfds_waits_for_the_end_of_a_process_all_the_same(
    spawner: Spawner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "pidfd_open", raising=False)
    with started(spawner) as child:
        hear(child.control)
        assert not lifeline.wait_gone((child.pid,), 0.0)
        child.kill()
        assert lifeline.wait_gone((child.pid,), 5.0)


def test_closing_the_spawner_leaves_no_process_and_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    spawner = Spawner()
    with started(spawner) as child:
        hear(child.control)
    assert psutil.Process().children()
    spawner.close()
    assert {child.pid for child in psutil.Process().children(recursive=True)} == WARM
    assert not list(tmp_path.iterdir())
    with pytest.raises(StartFailed, match="stopping"):
        spawner.start(TELL, b"", name="late")


def test_a_fork_server_that_is_killed_with_its_launcher_leaves_nothing(tmp_path: Path) -> None:
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
    program = textwrap.dedent(PARENT).format(paths=paths, entries=["until_told"], signal=0)
    command = [sys.executable, "-c", program]
    surroundings = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings) as parent:
        assert parent.stdout is not None
        (pid,) = map(int, parent.stdout.readline().split())
        (server,) = psutil.Process(parent.pid).children()
        assert list(tmp_path.iterdir()) == []
        parent.send_signal(signal.SIGSTOP)  # so that it does not hear of the server's death
        server.kill()
        parent.kill()
        wait_gone(pid, server.pid)
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_a_child_starts_has_no_way_to_the_fork_server(spawner: Spawner) -> None:
    with started(spawner, "support_children:start_programs") as child:
        said = hear(child.control)
        assert any("rr-fork-" in file for file in _open_files(child.pid))
        assert not any("rr-fork-" in file for file in _open_files(said["inside"]))


def _open_files(pid: int) -> list[str]:
    return [os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir()]


def test_children_started_from_many_threads_at_once_all_come_up(spawner: Spawner) -> None:
    children: list[Process] = []

    def start() -> None:
        children.append(spawner.start(TELL, b"", name="one-of-many"))

    threads = [threading.Thread(target=start) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10.0)
    assert len({hear(child.control)["pid"] for child in children}) == 20
    for child in children:
        child.close()
    wait_gone(*(child.pid for child in children))


PARENT = """
    import sys, time, signal, os
    sys.path[:0] = {paths!r}
    from rr_actors.runtime.processes.process import Spawner
    from support_children import hear
    spawner = Spawner()
    children = [spawner.start("support_children:" + entry, b"", name=entry) for entry in {entries!r}]
    said = [hear(child.control) for child in children]
    pids = [pid for facts in said for key, pid in facts.items() if key in ("pid", "grandchild", "inside", "outside")]
    os.kill(children[0].pid, {signal})
    print(*pids, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize(
    ("entries", "sig"),
    [
        (["until_told", "until_told"], 0),
        (["until_told"], signal.SIGSTOP),
        (["hold_the_interpreter"], 0),
        (["have_a_child"], 0),
        (["start_programs"], 0),
    ],
    ids=["children", "a stopped child", "a child that holds the interpreter", "grandchildren", "their programs"],
)
def test_nothing_outlives_a_killed_parent_for_200_ms(entries: list[str], sig: int, tmp_path: Path) -> None:
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
    program = textwrap.dedent(PARENT).format(paths=paths, entries=entries, signal=int(sig))
    surroundings = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", program]

    def gone_after() -> float:
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings) as parent:
            assert parent.stdout is not None
            pids = [int(word) for word in parent.stdout.readline().split()]
            servers = [process.pid for process in psutil.Process(parent.pid).children()]
            assert pids
            assert all(lives(pid) for pid in (*pids, *servers))
            parent.kill()
            return wait_gone(*pids, *servers)

    quickly(gone_after, 0.2)
    assert not list(tmp_path.iterdir())


def test_a_long_path_to_temporary_files_does_no_harm(
    spawner: Spawner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = tmp_path / ("x" * 120)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    with started(spawner) as child:
        hear(child.control)
    assert not list(long.iterdir())


def test_where_temporary_files_cannot_be_made_the_next_place_is_taken(
    spawner: Spawner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "file"))
    with tempfile.TemporaryDirectory(dir="/tmp") as there:  # a short path: there is to be room for a socket
        monkeypatch.setenv("TEMP", there)
        with started(spawner) as child:
            hear(child.control)
            assert any(file.startswith(f"{there}/rr-fork-") for file in _open_files(child.pid))
            assert not list(Path(there).iterdir())


def test_the_interpreter_that_multiprocessing_was_told_of_is_the_one_that_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = tmp_path / "python"
    told.write_text(f'#!/bin/sh\ntouch "$0.used"\nexec {sys.executable} "$@"\n')
    told.chmod(0o700)
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", os.fsencode(told))
    spawner = Spawner()
    with started(spawner) as child:
        hear(child.control)
    spawner.close()
    assert (tmp_path / "python.used").exists()


def test_the_parents_main_module_is_not_run_again_in_a_child(tmp_path: Path) -> None:
    script = tmp_path / "main_script.py"
    script.write_text(
        textwrap.dedent(f"""
            import sys
            sys.path[:0] = {[str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]!r}
            print("main runs", flush=True)
            from rr_actors.runtime.processes.process import Spawner
            from support_children import hear
            spawner = Spawner()
            child = spawner.start("support_children:until_told", b"", name="child")
            said = hear(child.control)
            child.close()
            spawner.close()
            print(said["argv"], "main_script" in said["main"])
        """)
    )
    done = subprocess.run(
        [sys.executable, script, "an argument"], capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout.splitlines() == ["main runs", f"{[str(script), 'an argument']} False"]
    assert done.stderr == ""


def test_a_fork_server_that_cannot_start_is_named_as_what_is_wanting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("multiprocessing.spawn._python_exe", b"/bin/false")
    spawner = Spawner()
    try:
        with pytest.raises(StartFailed, match="fork server: it ends before it answers") as failed:
            spawner.start("support_children:until_told", b"", name="child")
        assert failed.value.wanted.startswith("fork server")
    finally:
        spawner.close()


def test_how_long_a_process_has_waited_for_a_processor_is_known() -> None:
    spin = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass"
    spinning = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2)]
    try:
        eventually(lambda: all(lifeline.starved_s(process.pid) > 0.1 for process in spinning))
    finally:
        for process in spinning:
            process.kill()
            process.wait()
    assert lifeline.starved_s(spinning[0].pid) == 0.0
