"""system.run(): a program that a signal tells to end stops in order, also as process 1 of a container."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

import rr_actors as rr
from rr_actors.system.endings import Termination
from support import TEST_PATHS, Workshop, kill

LIMIT_S = 40.0
PROGRAM = """
import signal, sys, threading, time
import rr_actors as rr
from support import Workshop

class Lamps(rr.Manager):
    def __init__(self, root):
        self.work = Workshop(root)

    @rr.server("lamp")
    def switch_on(self, room: str) -> str:
        return room

    @switch_on.unload
    def switch_off(self, room: str, response: str) -> None:
        self.work.note("off", room)
        if room == "stuck":
            threading.Event().wait()

class App(rr.Manager):
    def __init__(self, room):
        self.room = room

    def on_start(self):
        self.registrar.load("lamps/lamp", self.room)

def tell_when_it_listens():
    while signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        time.sleep(0.001)
    print("ready", flush=True)

system = rr.System(
    [rr.ChildSpec(Lamps, id="lamps", args=(sys.argv[2],)), rr.ChildSpec(App, id="app", args=(sys.argv[3],))],
    state_dir=sys.argv[1],
    config=rr.SystemConfig(stop_timeout_s=float(sys.argv[4])),
)
if sys.argv[3] != "early":
    system.start()
threading.Thread(target=tell_when_it_listens).start()
print("ended by", system.run(), flush=True)
"""


@contextmanager
def running(
    tmp_path: Path, workshop: Workshop, *before: str, room: str = "hall", stop_s: float = 20.0
) -> Iterator[psutil.Process]:
    """The program above, once its system runs, or is about to start."""
    program = subprocess.Popen(
        [*before, sys.executable, "-c", PROGRAM, str(tmp_path / "state"), str(workshop.root), room, str(stop_s)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": TEST_PATHS},
    )
    try:
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
        yield psutil.Process(program.pid)
        said, _ = program.communicate(timeout=LIMIT_S)
        (tmp_path / "said").write_text(f"{said}{program.returncode}")
    finally:
        program.kill()
        program.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_system_in_order(tmp_path: Path, workshop: Workshop, number: signal.Signals) -> None:
    with running(tmp_path, workshop) as program:
        program.send_signal(number)
    assert (tmp_path / "said").read_text() == f"ended by {number.value}\n0"
    assert workshop.lines("off") == ["off hall"]


def test_a_signal_while_the_system_starts_gives_the_start_up(tmp_path: Path, workshop: Workshop) -> None:
    with running(tmp_path, workshop, room="early") as program:
        program.send_signal(signal.SIGTERM)
    assert (tmp_path / "said").read_text() == "ended by 15\n0"


def test_a_second_signal_does_not_wait_for_what_is_stuck(tmp_path: Path, workshop: Workshop) -> None:
    with running(tmp_path, workshop, room="stuck", stop_s=300) as program:
        program.send_signal(signal.SIGTERM)
        workshop.wait("off")
        program.send_signal(signal.SIGTERM)
    assert (tmp_path / "said").read_text().startswith("ended by 15")


def _may_make_pid_namespaces() -> bool:
    return subprocess.run(["unshare", "--pid", "--fork", "--mount-proc", "true"], capture_output=True).returncode == 0


def test_process_1_of_a_container_stops_in_order_at_sigterm(tmp_path: Path, workshop: Workshop) -> None:
    """Where the kernel lets nobody make a namespace, the program is told the same way and is not process 1."""
    namespace = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child") if _may_make_pid_namespaces() else ()
    with running(tmp_path, workshop, *namespace) as outer:
        inner = outer.children()[0] if namespace else outer
        inner.send_signal(signal.SIGTERM)
    assert (tmp_path / "said").read_text() == "ended by 15\n0"
    assert workshop.lines("off") == ["off hall"]


class Idle(rr.Actor):
    pass


def test_a_tree_that_gives_up_ends_it_with_an_error(state_dir: Path) -> None:
    system = rr.System(rr.Supervisor([rr.ChildSpec(Idle, id="idle")], max_restarts=0), state_dir=state_dir).start()
    before = signal.getsignal(signal.SIGTERM)
    threading.Timer(0.1, kill, (system, "idle")).start()
    with pytest.raises(rr.SupervisionError, match=r"its root supervisor has ended: .*SIGKILL"):
        system.run()
    assert signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(rr.UsageError, match="not running"):
        system.tree()


def test_a_stop_by_another_thread_ends_run_and_wait(state_dir: Path) -> None:
    system = rr.System([], state_dir=state_dir).start()
    waited: list[bool] = []
    waiting = threading.Thread(target=lambda: waited.append(system.wait(LIMIT_S)))
    waiting.start()
    threading.Timer(0.1, system.stop).start()
    assert system.run() is None
    waiting.join(LIMIT_S)
    assert waited == [True]
    assert system.ended is None


def test_a_signal_in_the_moment_before_it_is_awaited_is_heard(state_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enter = Termination.__enter__

    def interrupted(termination: Termination) -> Termination:
        enter(termination)
        os.kill(os.getpid(), signal.SIGTERM)
        return termination

    monkeypatch.setattr(Termination, "__enter__", interrupted)
    assert rr.System([], state_dir=state_dir).run() == signal.SIGTERM


def test_another_thread_than_the_main_one_is_told_that_it_hears_no_signals(state_dir: Path) -> None:
    heard: list[BaseException] = []

    def run(system: rr.System) -> None:
        try:
            system.run()
        except rr.UsageError as error:
            heard.append(error)

    thread: threading.Thread = threading.Thread(target=run, args=(rr.System([], state_dir=state_dir),))
    thread.start()
    thread.join(LIMIT_S)
    assert "only the main thread hears signals" in str(heard[0])
