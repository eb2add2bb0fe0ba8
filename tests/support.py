"""What the tests share: waiting with a deadline, callbacks that note what they heard, a journal for other processes.

Nothing here sleeps and hopes: `eventually` asks again until the answer is yes or the deadline has passed, `Calls` and
`Gate` wake their waiters.
"""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeVar

import rr_actors as rr
from rr_actors.registrar.links.local_line import LocalLine
from rr_actors.registrar.model.messages import Unload
from rr_actors.wire.thread_connections import BlockingLink

REPOSITORY = Path(__file__).resolve().parent.parent
TESTS = REPOSITORY / "tests"
# What a program that a test starts needs in its PYTHONPATH to import the tests' own modules.
_FOLDERS = sorted(path for path in TESTS.iterdir() if path.is_dir() and not (path / "__init__.py").exists())
TEST_PATHS = os.pathsep.join(map(str, [REPOSITORY, TESTS, *_FOLDERS]))
T = TypeVar("T")
BROWSERS: set[int] = set()
"""Browsers that serve all tests of this process. They start and end processes of their own as they like."""
WARM: set[int] = set()
"""The processes that fork fork servers and pages for tests, children of this one (warm_servers.py)."""
_PAUSE_S, _LONGEST_PAUSE_S = 0.003, 0.05
LIMIT_S = 10.0
"""How long a test waits for something that is promised, before it says that it did not happen."""


def break_exchanges(monkeypatch: Any, error: BaseException, *, sends: bool, kind: type = Unload) -> None:
    """Have connections of threads fail with `error` for messages of a kind: before they are sent, or when answered."""

    def broken(exchange: Any) -> Any:
        def fail(self: Any, message: Any, deadline: float) -> Any:
            if type(message) is not kind:
                return exchange(self, message, deadline)
            if sends:
                exchange(self, message, deadline)
            raise error

        return fail

    for line in (LocalLine, BlockingLink):
        monkeypatch.setattr(line, "exchange", broken(line.exchange))


def eventually(predicate: Callable[[], T], timeout: float = LIMIT_S, what: str = "") -> T:
    """Return the first true value of `predicate`, asked every few milliseconds.

    A predicate that takes long is asked less often: what it waits for needs a processor, too.

    Raises:
        AssertionError: it was not true within `timeout` seconds.
    """
    began = asked = time.monotonic()
    while not (value := predicate()):
        now = time.monotonic()
        if now > began + timeout:
            raise AssertionError(f"not within {timeout:g} s: {what or predicate}; last value {value!r}")
        time.sleep(min(max(_PAUSE_S, 3 * (now - asked)), _LONGEST_PAUSE_S))
        asked = time.monotonic()
    return value


def lives(pid: int) -> bool:
    """Whether the process is there, and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def descriptors(target: str = "") -> set[tuple[str, str, int]]:
    """The number, target and inode of each open descriptor of this process whose target has this in its name.

    A test that leaves no descriptor asserts that `descriptors() - before` is empty. It compares no counts: what a
    thread of an earlier test still holds may be closed meanwhile.
    """
    found: set[tuple[str, str, int]] = set()
    for number in os.listdir("/proc/self/fd"):
        path = f"/proc/self/fd/{number}"
        with suppress(OSError):  # the one that reads the directory is closed by now
            found.add((number, os.readlink(path), os.stat(path).st_ino))
    return {each for each in found if target in each[1]}


def wait_gone(*pids: int) -> float:
    """How many seconds it takes until none of these processes lives."""
    began = time.monotonic()
    eventually(lambda: not any(lives(pid) for pid in pids), what=f"end of {pids}")
    return time.monotonic() - began


def quickly(attempt: Callable[[], float], limit_s: float) -> None:
    """See that one of three attempts, which return how many seconds it took, takes less: the machine may be busy."""
    took: list[float] = []
    while len(took) < 3:
        took.append(attempt())
        if took[-1] < limit_s:
            return
    raise AssertionError(f"not within {limit_s:g} s: {took}")


class Calls:
    """Callable that notes what it is called with, from any thread: a single argument as it is, several as a tuple."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._items: list[Any] = []

    def __call__(self, *args: Any) -> None:
        with self._changed:
            self._items.append(args[0] if len(args) == 1 else args)
            self._changed.notify_all()

    @property
    def items(self) -> list[Any]:
        """What was noted so far, oldest first."""
        with self._changed:
            return list(self._items)

    def wait(self, count: int = 1, timeout: float = LIMIT_S) -> list[Any]:
        """Return all items once there are at least `count`."""
        with self._changed:
            done = self._changed.wait_for(lambda: len(self._items) >= count, timeout)
            assert done, f"expected {count} calls within {timeout:g} s, got {self._items!r}"
            return list(self._items)

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.items)


class Gate:
    """A place where callbacks wait until the test opens it. An unopened gate lets go after LIMIT_S with an error."""

    def __init__(self) -> None:
        self._arrivals = Calls()
        self._opened = threading.Event()

    def __call__(self, who: object = None) -> None:
        """Pass the gate: what a callback does."""
        self._arrivals(who)
        if not self._opened.wait(LIMIT_S):
            raise AssertionError("the gate was never opened")

    def wait_arrived(self, count: int = 1) -> None:
        """Return when `count` callbacks have come to the gate."""
        self._arrivals.wait(count)

    def open(self) -> None:
        """Let everybody through, now and later."""
        self._opened.set()


class Served:
    """A server of a registrar in this process whose callbacks note what they were called with.

    `load`, `unload` and `status` of the constructor say what else the callbacks do. Without `load`, the response is
    {"of": request, "number": how many loads there have been}.
    """

    def __init__(
        self,
        load: Callable[[Any], Any] | None = None,
        unload: Callable[[Any, Any], None] | None = None,
        status: Callable[[Any, rr.Status], None] | None = None,
    ) -> None:
        self.loads = Calls()
        self.unloads = Calls()
        self.statuses = Calls()
        self.do_load, self.do_unload, self.do_status = load, unload, status

    def load(self, request: Any) -> Any:
        self.loads(request)
        if self.do_load is not None:
            return self.do_load(request)
        return {"of": request, "number": len(self.loads)}

    def unload(self, request: Any, response: Any) -> None:
        self.unloads(request, response)
        if self.do_unload is not None:
            self.do_unload(request, response)

    def status(self, request: Any, status: rr.Status) -> None:
        self.statuses(request, status)
        if self.do_status is not None:
            self.do_status(request, status)


def serve(
    registrar: rr.Registrar,
    name: str,
    load: Callable[[Any], Any] | None = None,
    unload: Callable[[Any, Any], None] | None = None,
    status: Callable[[Any, rr.Status], None] | None = None,
    **options: Any,
) -> Served:
    """Register a Served at `registrar`."""
    served = Served(load, unload, status)
    registrar.register_server(name, served.load, served.unload, status=served.status, **options)
    return served


def loaded_with_parts(registrar: rr.Registrar, *parts: tuple[str, Any]) -> Callable[[Any], Any]:
    """Return a load callback that loads `parts`, (server id, request) each, and answers with their responses."""

    def load(request: Any) -> Any:
        return [registrar.load(server, part).response for server, part in parts]

    return load


def states(calls: Calls) -> list[rr.State]:
    """The states of the statuses noted by an on_status callback."""
    return [status.state for status in calls]


def messages(calls: Calls) -> list[str]:
    """The messages of the statuses noted by an on_status callback."""
    return [status.message for status in calls]


# -- across processes ----------------------------------------------------------------------------------------------


_END = " ."


class Workshop:
    """A directory that callbacks in any process use: a journal they append to, gates and breakages set by the test."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self.root.mkdir(parents=True, exist_ok=True)
        self.journal = self.root / "journal"

    def note(self, *words: object) -> None:
        """Append one line to the journal, whole even when others write at the same time.

        Who is killed where his line crosses a page of the file may leave a part of it: that has no end.
        """
        line = "\n" + " ".join(str(word) for word in words) + _END
        file = os.open(self.journal, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        try:
            os.write(file, line.encode())
        finally:
            os.close(file)

    def lines(self, start: str = "") -> list[str]:
        """The journal's lines that begin with `start`, oldest first."""
        if not self.journal.exists():
            return []
        whole = [line for line in self.journal.read_text().splitlines() if line.endswith(_END)]
        return [line.removesuffix(_END) for line in whole if line.startswith(start)]

    def wait(self, start: str, count: int = 1, timeout: float = LIMIT_S) -> list[str]:
        """Return the lines that begin with `start` once there are at least `count`."""

        def enough() -> list[str]:
            lines = self.lines(start)
            return lines if len(lines) >= count else []

        return eventually(enough, timeout, f"{count} journal lines {start!r} in {self.lines()}")

    def shut(self, step: str) -> None:
        """From now on callbacks wait at this step."""
        self._sign("shut", step).touch()

    def open(self, step: str) -> None:
        """Let callbacks pass this step again."""
        self._sign("shut", step).unlink(missing_ok=True)

    def spoil(self, step: str) -> None:
        """From now on callbacks raise ValueError at this step."""
        self._sign("spoilt", step).touch()

    def mend(self, step: str) -> None:
        """Undo `spoil`."""
        self._sign("spoilt", step).unlink(missing_ok=True)

    def step(self, step: str, *details: object) -> None:
        """What a callback does: note the step, wait while it is shut, raise if it is spoilt."""
        self.note(step, *details)
        if self._sign("shut", step).exists():
            eventually(lambda: not self._sign("shut", step).exists(), 2 * LIMIT_S, f"opening of {step!r}")
        if self._sign("spoilt", step).exists():
            raise ValueError(f"{step} is spoilt")

    def _sign(self, kind: str, step: str) -> Path:
        return self.root / f"{kind}-{step.replace(' ', '-').replace('/', '~')}"


def child(system: rr.System, id: str) -> rr.Child:
    """The child of this id right under the root."""
    (found,) = [child for child in system.supervisor().which_children() if child.id == id]
    return found


def pid_of(system: rr.System, id: str) -> int:
    """The process id of a child that is running."""

    def running() -> int:
        found = child(system, id)
        return (found.pid or 0) if found.state == "running" else 0

    return eventually(running, what=f"{id} running")


def kill(system: rr.System, id: str) -> int:
    """SIGKILL the child's process; return the process id it had."""
    pid = pid_of(system, id)
    os.kill(pid, signal.SIGKILL)
    return pid


def hang(pid: int) -> None:
    """SIGSTOP the process, and return when each of its threads has stopped: until then one may go on and answer."""
    os.kill(pid, signal.SIGSTOP)

    def states() -> set[str]:
        try:
            stats = [(task / "stat").read_text() for task in Path(f"/proc/{pid}/task").iterdir()]
        except FileNotFoundError:  # one that ended just now
            return set()
        return {stat.rpartition(")")[2].split()[0] for stat in stats}

    eventually(lambda: states() == {"T"}, what=f"all threads of {pid} stopped")


def wait_respawned(system: rr.System, id: str, old_pid: int) -> int:
    """Return the new process id of a killed child once it is running again."""

    def new_pid() -> int:
        found = child(system, id)
        return found.pid if found.state == "running" and found.pid and found.pid != old_pid else 0

    return eventually(new_pid, what=f"{id} respawned after {old_pid}")


def connect_threads(registrar: rr.Registrar, server: str, request: object) -> None:
    """Have a registrar hold something. The registrar's threads have connections to the provider from now on.

    The first call of a thread goes by the link.
    """
    registrar.load(server, request)
    registrar.load(server, request).unload()


# -- catalogs on disk ----------------------------------------------------------------------------------------------


def catalog_path(state_dir: Path, registrar: str) -> Path:
    """Where a registrar's catalog is, unless its config says otherwise."""
    return state_dir / registrar / "catalog.sqlite3"


def read_catalog(path: Path, table: str) -> list[dict[str, Any]]:
    """All rows of a table, as a person with the sqlite3 tool would read them; none before the file is made."""
    if not path.exists():
        return []
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=5.0)) as connection:
        connection.row_factory = sqlite3.Row
        return [dict(row) for row in connection.execute(f"SELECT * FROM {table}")]


class NoDescriptors:
    """In this block this process can open no more descriptors, or only so many."""

    def __init__(self, spare: int = 0) -> None:
        self._spare = spare

    def __enter__(self) -> None:
        self._before = resource.getrlimit(resource.RLIMIT_NOFILE)
        probes = [os.dup(0) for _ in range(self._spare + 1)]
        for probe in probes:
            os.close(probe)
        resource.setrlimit(resource.RLIMIT_NOFILE, (probes[-1], self._before[1]))

    def __exit__(self, *exc: object) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, self._before)


def run_example(folder: Path, *arguments: str | Path, limit_s: float, may_log_errors: bool = False) -> str:
    """Run Python with these arguments in a folder; return what it prints. It must end well, and within a time limit."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert may_log_errors or "Traceback" not in done.stderr  # that a process was killed may be logged
    return done.stdout
