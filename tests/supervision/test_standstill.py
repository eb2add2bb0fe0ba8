"""Everything stands still for a while, as on a machine that is suspended, and goes on: nobody is taken for frozen."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

import rr_actors as rr
from support import TEST_PATHS, Workshop, hang

HEARTBEAT_S = 1.0  # a busy machine may not let a process run for half a second
STILL_S = 3.0  # longer than any heartbeat or time limit here


class Slow(rr.Manager):
    """Takes its time in its start and in its callbacks."""

    def __init__(self, root: str, start_s: float = 0.0) -> None:
        self._shop = Workshop(root)
        self._start_s = start_s

    def on_start(self) -> None:
        self._shop.note("starting", os.getpid())
        time.sleep(self._start_s)
        self._shop.note("started", os.getpid())

    @rr.server("thing")
    def load(self, request: float) -> float:
        self._shop.note("load", request)
        time.sleep(request)
        return request

    @load.unload
    def unload(self, request: float, response: float) -> None:
        self._shop.note("unload", request)
        time.sleep(request)


PROGRAM = """
import sys, threading, time
import rr_actors as rr
from support import Workshop
from test_standstill import HEARTBEAT_S, Slow

state_dir, root = sys.argv[1:]
shop = Workshop(root)
makers = [rr.ChildSpec(Slow, id=f"maker-{n}", args=(root,), heartbeat_s=HEARTBEAT_S) for n in range(3)]
inner = rr.Supervisor([rr.ChildSpec(Slow, id="below", args=(root,), heartbeat_s=HEARTBEAT_S)], id="inner",
                      placement="process")
system = rr.System([*makers, inner], state_dir=state_dir).start()
app = system.open_registrar("app")
held = []

def work():
    number = 0
    while not stopping.is_set():
        number += 1
        try:
            held.append(app.load(f"maker-{number % 3}/thing", number / 1e6, timeout_s=1.0))
            if len(held) > 20:
                app.unload(held.pop(0), timeout_s=1.0)
        except rr.RrError as error:
            shop.note("error", type(error).__name__)
        shop.note("worked")

stopping = threading.Event()
worker = threading.Thread(target=work)
worker.start()
late = rr.ChildSpec(Slow, id="late", args=(root, 1.0), start_timeout_s=2.0, heartbeat_s=HEARTBEAT_S)
system.start_child(late)
shop.note("up")
sys.stdin.readline()
stopping.set()
worker.join()
app.load("maker-0/thing", 0.9)
mine = {query.id for query in app.queries()}
theirs = {query.id for n in range(3) for query in app.fetch_queries(f"maker-{n}")}
shop.note("held", len(mine), "agree" if mine == theirs else f"{mine ^ theirs}")
for record in [*system.supervisor().history(), *system.supervisor("root/inner").history()]:
    if record.event not in ("started",):
        shop.note("record", record.event, record.path, record.detail)
shop.note("stopping")
system.stop()
shop.note("stopped")
"""


def _tree(program: subprocess.Popen[bytes]) -> list[psutil.Process]:
    """The program and all below it, those at the bottom last."""
    top = psutil.Process(program.pid)
    return [top, *top.children(recursive=True)]


def _stand_still(program: subprocess.Popen[bytes]) -> None:
    """Stop every process, wait, and let them go on: first those that judge, and later those that are judged."""
    processes = _tree(program)
    for process in processes:
        hang(process.pid)
    time.sleep(STILL_S)
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):  # while a system stops, one may have been ended meanwhile
            process.send_signal(signal.SIGCONT)
        time.sleep(HEARTBEAT_S / 10)


@pytest.fixture
def program(tmp_path: Path, workshop: Workshop) -> Iterator[subprocess.Popen[bytes]]:
    """A program with a system, in processes of its own."""
    file = tmp_path / "program.py"
    file.write_text(textwrap.dedent(PROGRAM))
    environment = {**os.environ, "PYTHONPATH": TEST_PATHS}
    command = [sys.executable, str(file), str(tmp_path / "state"), str(workshop.root)]
    started = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, start_new_session=True)
    yield started
    if started.poll() is None:
        for process in _tree(started):
            process.kill()
    started.wait()
    assert started.stdin is not None
    started.stdin.close()


@pytest.mark.timeout(90)
@pytest.mark.slow
def test_a_whole_system_that_stands_still_goes_on_as_if_nothing_had_been(
    program: subprocess.Popen[bytes], workshop: Workshop
) -> None:
    assert program.stdin is not None
    workshop.wait("starting", 5)
    _stand_still(program)  # while one starts
    workshop.wait("up", timeout=30)
    before = len(workshop.lines("worked"))
    workshop.wait("worked", before + 50)
    _stand_still(program)
    before = len(workshop.lines("worked"))
    workshop.wait("worked", before + 50)
    program.stdin.write(b"\n")
    program.stdin.flush()
    workshop.wait("stopping", timeout=30)
    workshop.wait("unload 0.9", timeout=30)
    _stand_still(program)  # while it stops
    workshop.wait("stopped", timeout=30)
    assert program.wait(10) == 0
    assert workshop.lines("record") == []
    (held,) = workshop.lines("held")
    assert held.endswith("agree")
    assert len(workshop.lines("starting")) == len(workshop.lines("started")) == 5
    loads, unloads = workshop.lines("load"), workshop.lines("unload")
    assert sorted(line.split()[1] for line in loads) == sorted(line.split()[1] for line in unloads)
