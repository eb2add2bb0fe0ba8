"""The systems that a test starts by the fixture `rr_system`, and what they leave behind."""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, cast

from rr_actors.base.config import SystemConfig
from rr_actors.base.steps import Steps
from rr_actors.registrar.manager import Manager
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.registrar_lookup import left_behind
from rr_actors.system.system import System
from rr_actors.testing.callback_notes import NoteReader
from rr_actors.testing.seen_manager import seen_class

LIMIT_S = 5.0
"""How long the processes and threads of a stopped system may take to end."""

VARIABLE = "RR_ACTORS_TEST"


class StartSystem(Protocol):
    """The type of the fixture `rr_system` of pytest: a function that starts a system, and returns it::

        def test_a_camera_has_a_topic(rr_system: rr.StartSystem) -> None:
            system = rr_system(rr.ChildSpec(Cameras, id="cameras"))

    After the test each system is stopped, which releases what the test holds. The test fails if a process, a thread, a
    socket or a loaded resource is left then.
    """

    def __call__(
        self,
        *children: ChildSpec | Supervisor | Sequence[ChildSpec | Supervisor],
        name: str = "system",
        state_dir: str | os.PathLike[str] | None = None,
        config: SystemConfig | None = None,
        debug: bool = False,
    ) -> System:
        """Start a system for this test.

        Args:
            children: the ChildSpecs and Supervisors, or one list of them, or one Supervisor, as System takes them.
            state_dir: None: a directory in the test's tmp_path.
            name, config, debug: as System takes them.

        Raises:
            The errors of System() and System.start().
        """
        ...


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


def started_systems(
    place: Path, setenv: Callable[[str, str], None], *, races: bool = False
) -> Generator[StartSystem, None, list[str]]:
    """Yield what starts systems for a test. Then stop them, and return what is wrong: what is left, and what races.

    Args:
        place: the directory for their state directories.
        setenv: gives an environment variable a value until the test ends.
        races: whether managers are seen through the race lens.
    """
    mark = uuid.uuid4().hex
    setenv(VARIABLE, mark)
    before = _look(mark)
    systems: list[System] = []
    notes = place / "rr_races"

    def start(
        *children: ChildSpec | Supervisor | Sequence[ChildSpec | Supervisor],
        name: str = "system",
        state_dir: str | os.PathLike[str] | None = None,
        config: SystemConfig | None = None,
        debug: bool = False,
    ) -> System:
        number = len(systems) + 1
        if state_dir is None:
            state_dir = place / ("rr_state" if number == 1 else f"rr_state{number}")
        first = children[0] if len(children) == 1 else None
        specs = [child for child in children if isinstance(child, ChildSpec | Supervisor)]
        root = specs if first is None or isinstance(first, ChildSpec) else first
        if races:
            notes.mkdir(exist_ok=True)
            root = _seen(root, str(notes))
        system = System(root, name=name, state_dir=state_dir, config=config, debug=debug)
        systems.append(system)
        return system.start()

    try:
        yield start
    finally:
        steps = Steps()
        for system in reversed(systems):
            steps.take(f"stopping {system.state_dir}", system.stop)
        steps.end("rr_system: several systems did not stop cleanly")
    left = _still_left(mark, before)
    for system in systems:
        found = left_behind(system.config, system.state_dir, set()) if system.state_dir.is_dir() else {}
        left += [f"registrar {name} of {system.state_dir}: {contents}" for name, contents in found.items()]
    wrong = [f"left behind: {'; '.join(left)}"] if left else []
    if notes.is_dir():
        wrong += [f"callbacks race for {race}" for race in _races(notes)]
    return wrong


T = TypeVar("T")


def _seen(children: T, notes: str) -> T:
    """Return children whose managers are seen through the race lens."""
    seen: Any = children
    if isinstance(children, ChildSpec):
        cls: object = children.actor_class_or_manager
        if isinstance(cls, type) and issubclass(cls, Manager):
            seen = replace(children, actor_class_or_manager=seen_class(cls, notes))
    elif isinstance(children, Supervisor):
        seen = replace(children, children=_seen(children.children, notes))
    elif isinstance(children, list | tuple):
        seen = [_seen(child, notes) for child in cast("Sequence[object]", children)]
    return seen


def _races(notes: Path) -> list[str]:
    reader = NoteReader(notes)
    try:
        return sorted({note.text for note in reader.read() if note.what == "race"})
    finally:
        reader.close()


def _still_left(mark: str, before: _Left) -> list[str]:
    deadline = time.monotonic() + LIMIT_S
    while (left := _look(mark).beyond(before)) and time.monotonic() < deadline:
        time.sleep(0.01)
    return left


def _look(mark: str) -> _Left:
    return _Left(frozenset(marked(mark)), frozenset(threading.enumerate()), frozenset(_sockets()))


def marked(mark: str) -> Iterator[str]:
    """Yield a line for each process that carries a mark, but this one."""
    wanted = f"{VARIABLE}={mark}".encode()
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
