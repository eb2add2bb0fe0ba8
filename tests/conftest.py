"""Fixtures of all tests, and the check around each of them that it leaves nothing behind."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import uuid
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from hypothesis import settings

import rr_actors as rr
from rr_actors.base.reporting import log
from rr_actors.runtime import thread_rules
from support import BROWSERS, TEST_PATHS, WARM, Gate, Served, Workshop, eventually, serve
from warm_servers import WarmServers, warm_servers

_MARK = "RR_ACTORS_TESTS"
_LEAK_LIMIT_S = 5.0
_MOST_RUN_AGAIN = 3

# Every process that a test starts inherits this, however it was started and whoever has adopted it since.
os.environ[_MARK] = uuid.uuid4().hex

# Systems that tests start are in a list of this test process alone: another one looks for the one system that runs.
_LIST = tempfile.TemporaryDirectory(prefix="rr-tests-")
os.environ["XDG_RUNTIME_DIR"] = _LIST.name

# Where Python does not buffer, a printed line is two writes, and what another process prints may come between them.
os.environ.pop("PYTHONUNBUFFERED", None)

# What is started in the background by a script ignores Ctrl-C, and so would all that the tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine may put an example aside for longer than Hypothesis allows one: what hangs comes to pytest's limit.
# Where a change is judged, the examples are the same each time (docs/decisions/0033-a-gate-that-repeats.md).
settings.register_profile("busy machine", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("busy machine")


def pytest_collection_modifyitems(items: list[pytest.Item], config: pytest.Config) -> None:
    """With RR_ACTORS_SLOW_PART=2/4, keep the second quarter of the slow tests.

    The same test is always in the same part, whatever others there are.
    """
    part = os.environ.get("RR_ACTORS_SLOW_PART")
    if part is None:
        return
    number, _, parts = part.partition("/")
    others = [item for item in items if _part_of(item, int(parts)) != int(number) and item.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=others)
    left_out = set(others)
    items[:] = [item for item in items if item not in left_out]


def _run_again(config: pytest.Config) -> list[Any]:
    """The reports of the tests that failed and were run once more."""
    terminal: Any = config.pluginmanager.get_plugin("terminalreporter")
    return [] if terminal is None else terminal.stats.get("rerun", [])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where more tests than a few needed their second run: the change has a race, or the machine is too busy."""
    if len(_run_again(session.config)) > _MOST_RUN_AGAIN:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say what each first run failed with, so that nobody needs to see it again to mend it."""
    reports = _run_again(config)
    if not reports:
        return
    terminalreporter.section("failed at the first run, and were run again")
    for report in reports:
        terminalreporter.write_line(f"{report.nodeid} ({report.when})\n{report.longreprtext}\n")
    if len(reports) > _MOST_RUN_AGAIN:
        terminalreporter.write_line(f"{len(reports)} tests were run again, at most {_MOST_RUN_AGAIN} may be: failed")


def _part_of(item: pytest.Item, parts: int) -> int:
    return zlib.crc32(item.nodeid.encode()) % parts + 1


def pytest_collection_finish() -> None:
    """Make each test cheaper, now that all are collected.

    Put the directories of tests at the end of sys.path. Each fork server has the same path, and each of its imports
    would look through a dozen of them first: a tenth of its start.

    Let no garbage collection look at the tests, which are five thousand and stay. The registrars that tests open have
    old garbage collected now and then; each time would take 0.2 s.
    """
    below = f"{Path(__file__).parent}{os.sep}"
    sys.path.sort(key=lambda entry: entry.startswith(below))
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def warm() -> Iterator[WarmServers]:
    """What launches fork servers and web pages: each is forked from a process that has imported what it needs."""
    with warm_servers() as servers:
        yield servers


@pytest.fixture(autouse=True)
def _starts_cold(request: pytest.FixtureRequest, warm: WarmServers) -> Iterator[None]:
    """A test with the mark `cold` has fork servers and pages started as users have them."""
    warm.is_on = request.node.get_closest_marker("cold") is None
    yield
    warm.is_on = True


_others = {int(name) for name in os.listdir("/proc") if name.isdigit()} - {os.getpid()}  # processes that are not ours


def _processes() -> set[tuple[int, float]]:
    """Children of this process, and everything else that carries the mark.

    This is asked before and after each test, so a process that is known not to be ours is not looked at again.
    """
    with contextlib.suppress(IndexError):  # without a command nothing is started
        subprocess.Popen([])  # but first each Popen reaps the processes whose Popen is gone
    running = {int(name) for name in os.listdir("/proc") if name.isdigit()}
    _others.intersection_update(running)
    mark = f"{_MARK}={os.environ[_MARK]}".encode()
    found: set[tuple[int, float]] = set()
    for pid in running - _others - {os.getpid()}:
        try:
            environment = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
            process = psutil.Process(pid)
            if mark in environment or os.getpid() in [parent.pid for parent in process.parents()]:
                found.add((pid, process.create_time()))
            elif environment != [b""]:  # nobody has one for a moment, while it begins another program
                _others.add(pid)
        except (OSError, psutil.NoSuchProcess):
            continue
    found = {one for one in found if one[0] not in WARM}
    if not BROWSERS:
        return found
    of_browsers = {one for one in found if _is_of_a_browser(one[0])}
    _others.update(pid for pid, _ in of_browsers)
    return found - of_browsers


def _is_of_a_browser(pid: int) -> bool:
    try:
        return any(parent.pid in BROWSERS for parent in psutil.Process(pid).parents())
    except psutil.NoSuchProcess:
        return True  # it has ended just now


def _sockets() -> set[str]:
    """The sockets that this process has open."""
    found: set[str] = set()
    for entry in os.scandir("/proc/self/fd"):
        try:
            target = os.readlink(entry.path)
        except OSError:
            continue
        if target.startswith("socket:"):
            found.add(target)
    return found


def _socket_files(root: Path) -> set[Path]:
    found: set[Path] = set()
    for directory, _, names in os.walk(root):
        for name in names:
            path = Path(directory) / name
            try:
                if stat.S_ISSOCK(path.lstat().st_mode):
                    found.add(path)
            except OSError:
                continue
    return found


def _describe(pid: int) -> str:
    try:
        process = psutil.Process(pid)
        return f"{pid} {process.status()} {' '.join(process.cmdline())}"
    except psutil.NoSuchProcess:
        return f"{pid} (gone now)"


_handler: Any = pytest.LogCaptureFixture.handler


def _after_writing(caplog: pytest.LogCaptureFixture) -> Any:
    log.flush()  # a loop gives its log records to a thread, which writes them
    return _handler.__get__(caplog)


pytest.LogCaptureFixture.handler = property(_after_writing)  # type: ignore[method-assign]


@pytest.fixture(autouse=True)
def _nothing_is_left(request: pytest.FixtureRequest) -> Iterator[None]:
    """No process, thread, open socket or socket file outlives a test."""
    tmp_path: Path | None = request.getfixturevalue("tmp_path") if "tmp_path" in request.fixturenames else None
    processes, threads, sockets = _processes(), set(threading.enumerate()), _sockets()
    yield

    def left() -> list[str]:
        found = [f"process {_describe(pid)}" for pid, _ in _processes() - processes]
        found += [f"thread {thread.name}" for thread in set(threading.enumerate()) - threads]
        found += [f"open {name}" for name in _sockets() - sockets]
        found += [f"file {path}" for path in (_socket_files(tmp_path) if tmp_path is not None else ())]
        return found

    try:
        eventually(lambda: not left(), _LEAK_LIMIT_S)
    except AssertionError:
        pytest.fail("left behind: " + "; ".join(left()))


@pytest.fixture(autouse=True)
def _threads_keep_to_the_rules() -> Iterator[None]:
    """No call of the test process breaks a rule of thread_rules.py; the package may have caught the error."""
    assert thread_rules.CHECKED
    yield
    broken = thread_rules.broken.copy()
    thread_rules.broken.clear()
    assert broken == []


Start = Callable[..., "rr.System"]


@pytest.fixture
def state_dir(tmp_path: Path) -> Path:
    """Where the test's System keeps its state."""
    return tmp_path / "state"


@pytest.fixture
def runtime_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A list of running systems for the test alone. Programs that it starts find its modules, and tell UTC."""
    place = tmp_path / "runtime"
    place.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place))
    monkeypatch.setenv("PYTHONPATH", TEST_PATHS)
    monkeypatch.setenv("TZ", "UTC")
    for name in ("RR_STATE", "TMPDIR", "TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    return place


@pytest.fixture
def start(state_dir: Path) -> Iterator[Start]:
    """Start a System with these children, stopped after the test: start(spec, ..., config=...)."""
    systems: list[rr.System] = []

    def start_system(*children: Any, **options: Any) -> rr.System:
        options.setdefault("state_dir", state_dir)
        root = children[0] if len(children) == 1 and isinstance(children[0], rr.Supervisor) else list(children)
        system = rr.System(root, **options)
        system.start()
        systems.append(system)
        return system

    yield start_system
    for system in reversed(systems):
        system.stop()


@pytest.fixture
def system(start: Start) -> rr.System:
    """A running System without children."""
    return start()


@pytest.fixture
def app(system: rr.System) -> rr.Registrar:
    """A registrar of this process that consumes."""
    return system.open_registrar("app")


@pytest.fixture
def provider(system: rr.System) -> rr.Registrar:
    """A registrar of this process that serves."""
    return system.open_registrar("provider")


@pytest.fixture
def served(app: rr.Registrar, provider: rr.Registrar) -> Served:
    """A server, and a consumer with a link that holds "x" there."""
    served = serve(provider, "thing")
    app.load("provider/thing", "x")
    return served


@pytest.fixture
def parts(system: rr.System) -> rr.Registrar:
    """A registrar of this process that serves what `provider` needs."""
    return system.open_registrar("parts")


@pytest.fixture
def gate(system: rr.System) -> Iterator[Gate]:
    """A gate for callbacks, opened at the latest when the test ends."""
    gate = Gate()
    yield gate
    gate.open()


@pytest.fixture
def workshop(tmp_path: Path) -> Workshop:
    """A journal, gates and breakages for callbacks in other processes."""
    return Workshop(tmp_path / "workshop")
