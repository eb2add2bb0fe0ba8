"""Children are processes of multiprocessing, beside what the user's code does with multiprocessing itself."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil
import pytest

import rr_actors as rr
from support import REPOSITORY, eventually, kill, lives, pid_of, wait_gone, wait_respawned
from support_on_multiprocessing import Known

pytestmark = pytest.mark.cold

Start = Callable[..., rr.System]
NAMES = ["root/one", "root/two"]


def two() -> list[rr.ChildSpec]:
    return [rr.ChildSpec(Known, id="one"), rr.ChildSpec(Known, id="two")]


def active() -> dict[str, BaseProcess]:
    """Return the processes of this package among multiprocessing's."""
    return {child.name: child for child in multiprocessing.active_children() if child.name.startswith("root/")}


# -- the objects in the parent ---------------------------------------------------------------------------------------


def test_active_children_lists_the_managers_while_they_run(start: Start) -> None:
    system = start(*two())
    assert {name: child.pid for name, child in active().items()} == {
        "root/one": pid_of(system, "one"),
        "root/two": pid_of(system, "two"),
    }
    old = kill(system, "one")
    wait_respawned(system, "one", old)
    assert {name: child.pid for name, child in active().items()} == {
        "root/one": pid_of(system, "one"),
        "root/two": pid_of(system, "two"),
    }
    system.stop()
    assert active() == {}


def test_a_child_says_all_that_a_process_of_multiprocessing_says(start: Start) -> None:
    system = start(*two())
    one = active()["root/one"]
    assert isinstance(one, multiprocessing.get_context("forkserver").Process)
    assert (one.is_alive(), one.exitcode, one.daemon) == (True, None, False)
    assert repr(one) == f"<ForkedProcess name='root/one' pid={one.pid} parent={os.getpid()} started>"
    one.join(0)
    with pytest.raises(ValueError, match="still running"):
        one.close()
    system.supervisor().terminate_child("one")
    one.join(10)
    assert (one.is_alive(), one.exitcode) == (False, 0)
    assert connection.wait([one.sentinel], 0) == [one.sentinel]
    one.close()
    system.supervisor().restart_child("one")
    assert active()["root/one"].is_alive()


@pytest.mark.parametrize(
    ("end", "code"), [("kill", -signal.SIGKILL), ("terminate", 0)], ids=["by SIGKILL", "by SIGTERM, in order"]
)
def test_what_ends_a_child_by_its_object_is_a_death_like_any_other(start: Start, end: str, code: int) -> None:
    system = start(*two())
    old = active()["root/one"]
    pid = pid_of(system, "one")
    getattr(old, end)()
    assert connection.wait([old.sentinel], 10) == [old.sentinel]
    assert old.exitcode == code
    wait_respawned(system, "one", pid)
    exits = [
        record for record in system.supervisor().history() if record.event == "exited" and record.path == "root/one"
    ]
    assert [(record.pid, record.code) for record in exits] == [(pid, code)]
    getattr(old, end)()  # it does nothing to the next one
    assert active()["root/one"].pid == pid_of(system, "one")


def test_a_child_lives_for_multiprocessing_when_its_fork_server_is_killed(start: Start) -> None:
    system = start(*two())
    one = active()["root/one"]
    assert one.pid is not None
    server = psutil.Process(one.pid).parent()
    assert server is not None
    server.kill()
    wait_gone(server.pid)
    assert (one.is_alive(), one.exitcode) == (True, None)
    old = kill(system, "one")
    one.join(10)
    assert one.exitcode == 255  # nobody was there to collect it
    wait_respawned(system, "one", old)


# -- in the child ----------------------------------------------------------------------------------------------------


def test_a_child_knows_its_name_and_its_parent_which_lives(start: Start) -> None:
    system = start(rr.Supervisor([rr.ChildSpec(Known, id="below")], id="inner", placement="process"), *two())
    own = multiprocessing.current_process()
    pid = pid_of(system, "one")
    assert system.ref("one").ask("known") == ("root/one", pid, True, own.name, os.getpid(), True)
    name, _, lives_itself, *parent = system.ref("below").ask("known")
    assert (name, lives_itself, parent) == ("root/inner/below", True, ["root/inner", pid_of(system, "inner"), True])
    assert sorted(active()) == ["root/inner", *NAMES]  # each process lists its own


# -- beside the user's own use of multiprocessing: whole programs ----------------------------------------------------

BEGIN = """
import logging, multiprocessing, os, sys, time
import rr_actors as rr

class One(rr.Manager):
    def __init__(self, given=None):
        self.given = given

    def on_receive(self, message):
        multiprocessing.get_logger().info("heard %s", message)
        return message(self.given) if callable(message) else os.getpid()

def square(n):
    return n * n

def system(given=None):
    return rr.System([rr.ChildSpec(One, id="one", args=(given,))], state_dir="state")
"""


def run(directory: Path, program: str) -> tuple[str, str]:
    """Run a program, without a guard for its main part; return what it has printed, and its standard error."""
    (directory / "program.py").write_text(BEGIN + program)
    ran = subprocess.run(
        [sys.executable, "program.py"],
        cwd=directory,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "PYTHONWARNINGS": "ignore"},  # of os.fork()
        timeout=60,
        capture_output=True,
        text=True,
        check=False,
    )
    shutil.rmtree(directory / "state", ignore_errors=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout, ran.stderr


# -- what is handed to a child ---------------------------------------------------------------------------------------

REFUSED = {
    "Queue()": ("multiprocessing.queues.Queue", "an actor's mailbox is the queue"),
    "JoinableQueue()": ("multiprocessing.queues.JoinableQueue", "an actor's mailbox is the queue"),
    "SimpleQueue()": ("multiprocessing.queues.SimpleQueue", "an actor's mailbox is the queue"),
    "Pipe()[0]": ("multiprocessing.connection.Connection", "pass the reference of an actor"),
    "Lock()": ("multiprocessing.synchronize.Lock", "let one actor own what the lock protects"),
    "RLock()": ("multiprocessing.synchronize.RLock", "let one actor own what the lock protects"),
    "Semaphore()": ("multiprocessing.synchronize.Semaphore", "let one actor own what the lock protects"),
    "Condition()": ("multiprocessing.synchronize.Condition", "let one actor own what the lock protects"),
    "Barrier(2)": ("multiprocessing.synchronize.Barrier", "let one actor own what the lock protects"),
    "Event()": ("multiprocessing.synchronize.Event", "watch for an actor's end with rr_actors.monitor"),
    "Value('i', 1)": ("multiprocessing.sharedctypes.Synchronized", "let one actor own the value"),
    "Array('i', 1)": ("multiprocessing.sharedctypes.SynchronizedArray", "let one actor own the value"),
    "RawArray('i', 1)": ("mmap.mmap", "let one actor own the value"),
    "Process()": ("multiprocessing.context.ForkServerProcess", "make what it runs a child of a supervisor"),
    "Manager()": ("multiprocessing.managers.SyncManager", "send its proxies"),
}


def test_what_cannot_be_handed_to_a_child_is_refused_by_name_with_what_does_it_instead(tmp_path: Path) -> None:
    printed, _ = run(
        tmp_path,
        f"""
context = multiprocessing.get_context("forkserver")
if __name__ == "__main__":
    for kind in {list(REFUSED)!r}:
        given = eval("context." + kind)
        try:
            system(given).start()
        except rr.StartFailed as error:
            print(error)
""",
    )
    for (named, instead), line in zip(REFUSED.values(), printed.splitlines(), strict=True):
        assert "the ChildSpec of root/one: attribute 'args': item 0: " in line
        assert f"cannot pickle '{named}' object" in line
        assert instead in line


def test_proxies_of_a_manager_of_multiprocessing_work_in_a_child_and_in_the_next_one(tmp_path: Path) -> None:
    printed, _ = run(
        tmp_path,
        """
if __name__ == "__main__":
    with multiprocessing.Manager() as manager:
        kinds = dict(
            queue=(manager.Queue(), lambda given: given.put(1), lambda given: given.get(timeout=5)),
            event=(manager.Event(), lambda given: given.set(), lambda given: given.is_set()),
            dict=(manager.dict(), lambda given: given.update(a=1), lambda given: given.copy()),
            list=(manager.list(), lambda given: given.append(1), lambda given: given[:]),
            lock=(manager.Lock(), lambda given: given.acquire(), lambda given: given.acquire(False)),
            value=(manager.Value("i", 0), lambda given: given.set(1), lambda given: given.get()),
            names=(manager.Namespace(), lambda given: setattr(given, "a", 1), lambda given: given.a),
        )
        with system({kind: given for kind, (given, _, _) in kinds.items()}) as running:
            for kind, (given, use, look) in kinds.items():
                running.ref("one").ask(lambda all, kind=kind, use=use: use(all[kind]))
                print(kind, look(given))
            kinds["dict"][0].update(b=2)
            running.supervisor().terminate_child("one")
            running.supervisor().restart_child("one")
            print(running.ref("one").ask(lambda all: all["dict"].copy()))
        try:
            system(manager).start()
        except rr.StartFailed as error:
            print(error)
""",
    )
    *used, refused = printed.splitlines()
    assert used == [
        "queue 1",
        "event True",
        "dict {'a': 1}",
        "list [1]",
        "lock False",
        "value 1",
        "names 1",
        "{'a': 1, 'b': 2}",
    ]
    assert "cannot pickle 'multiprocessing.managers.SyncManager' object" in refused
    assert "send its proxies" in refused


def test_shared_memory_outlives_the_children_that_used_it(tmp_path: Path) -> None:
    printed, said = run(
        tmp_path,
        """
from multiprocessing import shared_memory

def write(memory):
    memory.buf[:5] = b"there"
    memory.close()

with system() as running:
    memory = shared_memory.SharedMemory(create=True, size=16)
    running.ref("one").ask(lambda _: write(memory))
    running.supervisor().terminate_child("one")
    print(bytes(memory.buf[:5]))
    running.supervisor().restart_child("one")
    memory.buf[:5] = b"again"
    running.ref("one").ask(lambda _: write(memory))
    print(bytes(memory.buf[:5]))
again = shared_memory.SharedMemory(memory.name)  # no child has removed it
print(bytes(again.buf[:5]))
again.close()
memory.close()
memory.unlink()
""",
    )
    assert (printed, said) == ("b'there'\n" * 3, "")


# -- its log, its start method, its fork server, its ends -----------------------------------------------------------


def test_the_log_of_multiprocessing_has_what_its_users_know(tmp_path: Path) -> None:
    _, said = run(
        tmp_path,
        """
multiprocessing.log_to_stderr(logging.INFO)
with system() as running:
    running.ref("one").ask("a message")
""",
    )
    lines, path = said.splitlines(), "root/one"
    assert f"[INFO/{path}] child process calling self.run()" in lines
    assert f"[INFO/{path}] heard a message" in lines
    assert f"[INFO/{path}] process exiting with exitcode 0" in lines


def test_a_child_is_silent_where_the_parent_does_not_show_the_log(tmp_path: Path) -> None:
    _, said = run(
        tmp_path,
        """
multiprocessing.get_logger().addHandler(logging.FileHandler("log"))
multiprocessing.get_logger().setLevel(logging.INFO)
with system() as running:
    running.ref("one").ask("a message")
""",
    )
    assert said == ""


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_the_users_start_method_is_not_fixed_by_a_system(tmp_path: Path, method: str) -> None:
    printed, _ = run(
        tmp_path,
        f"""
if __name__ == "__main__":
    with system() as running:
        multiprocessing.set_start_method({method!r})
        with multiprocessing.Pool(1) as pool:
            print(pool.map(square, [2]), running.ref("one").ask(1) != os.getpid())
        try:
            multiprocessing.set_start_method("forkserver")
        except RuntimeError as error:
            print(error)
    print(multiprocessing.get_start_method())
""",
    )
    assert printed == f"[4] True\ncontext has already been set\n{method}\n"


def test_the_users_fork_server_and_that_of_a_system_leave_each_other_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import sys\n")
    printed, _ = run(
        tmp_path,
        """
def loaded(_):
    return "mine" in sys.modules, "rr_actors.system.system" in sys.modules

class Two(rr.Manager):
    def on_receive(self, message):
        return loaded(message)

if __name__ == "__main__":
    multiprocessing.set_forkserver_preload(["mine"])
    with rr.System([rr.ChildSpec(Two, id="two")], state_dir="state") as running:
        with multiprocessing.get_context("forkserver").Pool(1) as pool:
            print(pool.map(loaded, [0]), running.ref("two").ask(0))
            print(sorted(child.name.partition("-")[0] for child in multiprocessing.active_children()))
        running.ref("two").ask(0)
    with multiprocessing.get_context("forkserver").Pool(1) as pool:
        print(pool.map(square, [3]))
""",
    )
    assert printed.splitlines() == ["[(True, False)] (False, True)", "['ForkServerPoolWorker', 'root/two']", "[9]"]


@pytest.mark.parametrize("shown", ["", "multiprocessing.log_to_stderr(logging.CRITICAL)"], ids=["", "with its log"])
def test_a_program_that_exits_without_a_stop_does_not_wait_for_its_children(tmp_path: Path, shown: str) -> None:
    printed, _ = run(
        tmp_path,
        f"""
running = system().start()
{shown}
print(running.ref("one").ask(1))
""",
    )
    wait_gone(int(printed))


IN_A_FORK = {
    "of os": """
sys.stdout.flush()
forked = os.fork()
if forked == 0:
    use()
    sys.exit()
os.waitpid(forked, 0)
""",
    "of multiprocessing": """
sys.stdout.flush()
process = multiprocessing.get_context("fork").Process(target=use)
process.start()
process.join()
""",
}


@pytest.mark.parametrize("fork", IN_A_FORK)
def test_a_fork_of_the_program_has_none_of_its_children(tmp_path: Path, fork: str) -> None:
    printed, said = run(
        tmp_path,
        f"""
running = system().start()
kept = multiprocessing.active_children()

def use():
    print(multiprocessing.active_children())
    kept[0]._popen.kill()

pid = running.ref("one").ask(1)
{IN_A_FORK[fork]}
print(running.ref("one").ask(1) == pid, len(multiprocessing.active_children()))
running.stop()
""",
    )
    assert (printed, said) == ("[]\nTrue 1\n", "")


def test_a_daemonic_process_is_told_that_it_may_have_no_children(tmp_path: Path) -> None:
    printed, _ = run(
        tmp_path,
        """
def use():
    try:
        system().start()
    except rr.StartFailed as error:
        print(error)
    with rr.System([rr.ChildSpec(One, id="one", placement="thread")], state_dir="state") as running:
        print(running.ref("one").ask(1) == os.getpid())

process = multiprocessing.get_context("fork").Process(target=use, daemon=True, name="Worker")
process.start()
process.join()
""",
    )
    refused, *rest = printed.splitlines()
    assert "this process (Worker) is daemonic" in refused
    assert "multiprocessing.Process(daemon=False)" in refused
    assert rest == ["True"]


def test_no_child_is_left_by_a_program_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        BEGIN + "running = system().start()\nprint(running.ref('one').ask(1), flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        pid = int(program.stdout.readline())
        assert lives(pid)
        program.kill()
    shutil.rmtree(tmp_path / "state")
    eventually(lambda: not lives(pid))


# -- processes that a user's code forks ------------------------------------------------------------------------------


class Workers(rr.Manager):
    @rr.server("ended")
    def end_a_worker(self, method: str) -> int:
        context: Any = multiprocessing.get_context(method)
        process = context.Process(target=time.sleep, args=(600,))
        process.start()
        process.terminate()
        process.join()
        return process.exitcode

    @rr.server("pool")
    def use_a_pool(self, method: str) -> list[int]:
        with multiprocessing.get_context(method).Pool(2) as pool:
            pool.apply_async(time.sleep, (600,))
            return pool.map(abs, [1, -2])


@pytest.mark.parametrize("method", ["fork", "forkserver"])
def test_a_process_that_a_manager_has_forked_heeds_terminate(start: Start, method: str) -> None:
    app = start(rr.ChildSpec(Workers, id="workers")).open_registrar("app")
    assert app.load("workers/ended", method).response == -signal.SIGTERM
    assert app.load("workers/pool", method).response == [1, 2]


RUNS = """
import multiprocessing, os, threading, time
import rr_actors as rr

def fork(system):
    process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(600,))
    process.start()
    process.terminate()
    process.join()
    print(process.exitcode, flush=True)
    system.stop()

if __name__ == "__main__":
    system = rr.System([], state_dir="state").start()
    threading.Thread(target=fork, args=(system,)).start()
    system.run()
"""


def test_a_process_that_a_program_has_forked_while_it_runs_heeds_terminate(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(RUNS)
    command = [sys.executable, "program.py"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=30, check=True)
    assert ended.stdout == f"{-signal.SIGTERM}\n"
