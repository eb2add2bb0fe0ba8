"""Plugin of pytest: the fixture `rr_system`, which starts systems for a test and checks that they leave nothing behind.

pytest finds it wherever the package is installed. A test asks for it by the fixture's name.
"""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rr_actors.base.steps import Steps
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.system import System

LIMIT_S = 5.0
"""How long the processes and threads of a stopped system may take to end."""

_VARIABLE = "RR_ACTORS_TEST"

StartSystem = Callable[..., System]
"""start(child, ..., **options): the children are ChildSpecs and Supervisors, or one list of them, or one Supervisor, as
System takes them; the options are those of System."""


class _Left(NamedTuple):
    """The processes that carry the test's mark, and the threads and sockets of this process."""

    processes: frozenset[str]
    threads: frozenset[threading.Thread]
    sockets: frozenset[str]

    def beyond(self, before: _Left) -> list[str]:
        """Return a line for each item that was not there before."""
        return [
            *sorted(self.processes - before.processes),
            *sorted(f"thread {thread.name}" for thread in self.threads - before.threads),
            *sorted(f"open {name}" for name in self.sockets - before.sockets),
        ]


@pytest.fixture
def rr_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StartSystem]:
    """Start a system of rr_actors: rr_system(rr.ChildSpec(Cameras, id="cameras"), config=...).

    Its state is in the test's tmp_path, unless `state_dir` says otherwise. After the test each system is stopped. The
    test fails if a process, a thread or a socket is left behind then.
    """
    mark = uuid.uuid4().hex
    monkeypatch.setenv(_VARIABLE, mark)
    before = _look(mark)
    systems: list[System] = []

    def start(*children: ChildSpec | Supervisor | Sequence[ChildSpec | Supervisor], **options: Any) -> System:
        number = len(systems) + 1
        options.setdefault("state_dir", tmp_path / ("rr_state" if number == 1 else f"rr_state{number}"))
        is_root = len(children) == 1 and not isinstance(children[0], ChildSpec)
        root: Any = children[0] if is_root else children
        system = System(root, **options)
        systems.append(system)
        return system.start()

    try:
        yield start
    finally:
        steps = Steps()
        for system in reversed(systems):
            steps.take(f"stopping {system.state_dir}", system.stop)
        steps.end("rr_system: several systems did not stop cleanly")
    if left := _still_left(mark, before):
        pytest.fail(f"rr_system: left behind: {'; '.join(left)}")


def _still_left(mark: str, before: _Left) -> list[str]:
    deadline = time.monotonic() + LIMIT_S
    while (left := _look(mark).beyond(before)) and time.monotonic() < deadline:
        time.sleep(0.01)
    return left


def _look(mark: str) -> _Left:
    return _Left(frozenset(_marked(mark)), frozenset(threading.enumerate()), frozenset(_sockets()))


def _marked(mark: str) -> Iterator[str]:
    wanted = f"{_VARIABLE}={mark}".encode()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if entry.name != str(os.getpid()) and wanted in (entry / "environ").read_bytes().split(b"\0"):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
                yield f"process {entry.name} ({(entry / 'comm').read_text().strip()}: {command[:200]})"
        except OSError:  # the process has ended, or is another user's
            continue


def _sockets() -> Iterator[str]:
    for entry in os.scandir("/proc/self/fd"):
        try:
            target = os.readlink(entry.path)
        except OSError:
            continue
        if target.startswith("socket:"):
            yield target
