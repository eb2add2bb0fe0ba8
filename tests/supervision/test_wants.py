"""Want of memory, processes, threads, descriptors and inodes ends no system; when it ends, all is as it was."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import resource
import signal
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.specs import Backoff
from rr_actors.supervision.event_history import Record
from support import catalog_path, eventually, kill, lives, pid_of, wait_respawned
from support_wants import KINDS, PLACE, ROLES, Wants

pytestmark = pytest.mark.cold

Start = Callable[..., rr.System]
CONFIG = rr.SystemConfig(preload=("support_wants",))
MANY = 120
"""More requests for one thing than any of the scenes makes."""
FEW = (1, 2, 5)
"""The requests that the fast tests refuse."""


class Maker(rr.Manager):
    """Serves its process's id."""

    @rr.server("thing")
    def load(self, request: str) -> int:
        return os.getpid()

    @load.unload
    def unload(self, request: str, response: int) -> None:
        pass


def tree(max_restarts: int = 3) -> rr.Supervisor:
    return rr.Supervisor([rr.ChildSpec(Maker, id="maker", heartbeat_s=5.0)], max_restarts=max_restarts)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have starts that failed for want tried again soon. The root supervisor is in this process."""
    monkeypatch.setattr(restarts, "PAUSE", Backoff(delay_s=0.02, factor=2.0, maximum_s=0.2, jitter=0.1))


@pytest.fixture
def wants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: None) -> Iterator[Wants]:
    path = tmp_path / "wants"
    monkeypatch.setenv(PLACE, str(path))
    wants = Wants(path)
    yield wants
    wants.remove()


def _failed(system: rr.System) -> list[Record]:
    return [record for record in system.supervisor().history() if record.event == "start_failed"]


# -- what a start can lack, one by one -----------------------------------------------------------------------------


def _server_of(system: rr.System) -> int:
    """Return the process that forks the system's children."""
    return int(Path(f"/proc/{pid_of(system, 'maker')}/stat").read_text().rpartition(")")[2].split()[1])


def test_want_of_memory_in_the_fork_server_is_waited_for_and_not_counted(start: Start, quick: None) -> None:
    system = start(tree())
    old, server = pid_of(system, "maker"), _server_of(system)
    used = int(Path(f"/proc/{server}/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.prlimit(server, resource.RLIMIT_AS, (used + 2**20, resource.RLIM_INFINITY))
    try:
        kill(system, "maker")
        eventually(lambda: len(_failed(system)) >= 5, 20.0)
        failed = _failed(system)
        assert all("EAGAIN" in record.detail or "ENOMEM" in record.detail for record in failed), failed
        assert not any(record.restarts for record in failed)
        assert lives(server)
    finally:
        resource.prlimit(server, resource.RLIMIT_AS, before)

    wait_respawned(system, "maker", old)
    assert system.open_registrar("app").load("maker/thing", "one").response == pid_of(system, "maker")
    assert _server_of(system) == server


def test_a_fork_that_fails_is_named_and_leaves_the_fork_server_alive(start: Start, wants: Wants) -> None:
    system = start(tree(), config=CONFIG)
    old, server = pid_of(system, "maker"), _server_of(system)
    wants.arm("server", "processes", 1)

    kill(system, "maker")
    wait_respawned(system, "maker", old)

    (failed,) = _failed(system)
    assert "EAGAIN: no more processes or threads can be made" in failed.detail
    assert failed.restarts == 0
    assert _server_of(system) == server


@contextlib.contextmanager
def _locked_as_by_sqlite(catalog: Path) -> Iterator[None]:
    with contextlib.closing(sqlite3.connect(catalog, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        yield


@contextlib.contextmanager
def _opened_as_by_another_system(catalog: Path) -> Iterator[None]:
    with catalog.with_suffix(".lock").open("r+b") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.mark.parametrize("held", [_locked_as_by_sqlite, _opened_as_by_another_system])
def test_a_catalog_that_another_process_holds_is_waited_for_and_not_counted(
    start: Start, quick: None, state_dir: Path, held: Callable[[Path], contextlib.AbstractContextManager[None]]
) -> None:
    later = rr.Backoff(delay_s=0.5, factor=1.0, maximum_s=0.5)  # until the catalog is held
    system = start(rr.ChildSpec(Maker, id="maker", backoff=later))
    query = system.open_registrar("app").load("maker/thing", "one")
    system.registrar("maker").save_catalog()
    old = pid_of(system, "maker")
    kill(system, "maker")
    with held(catalog_path(state_dir, "maker")):
        eventually(lambda: len(_failed(system)) >= 2, 30.0)
        failed = _failed(system)

    assert all("LOCKED: another process has the catalog" in record.detail for record in failed), failed
    assert not any(record.restarts for record in failed)
    wait_respawned(system, "maker", old)
    query.unload()


def test_a_start_of_a_system_that_fails_for_want_names_it(tmp_path: Path, wants: Wants) -> None:
    wants.arm("child", "inodes", 3)
    with pytest.raises(rr.StartFailed, match="ENOSPC: the disk is full, or has no inode left") as failed:
        rr.System(tree(), state_dir=tmp_path / "state", config=CONFIG).start()
    assert failed.value.wanted.startswith("ENOSPC")


@pytest.mark.parametrize("kind", ["inodes", "descriptors"])
def test_the_end_of_a_tree_is_heard_although_it_cannot_be_marked(tmp_path: Path, wants: Wants, kind: str) -> None:
    system = rr.System(tree(max_restarts=0), state_dir=tmp_path / "state", config=CONFIG).start()
    process = pid_of(system, "maker")
    wants.arm("application", kind, 1, lasts=True)
    os.kill(process, signal.SIGKILL)
    assert system.wait(timeout_s=30.0)
    assert wants.disarm()
    assert system.ended is not None
    assert "1 restart needed within 5 s, 0 allowed" in system.ended.detail
    system.stop()


# -- each request of a scene refused in its turn ---------------------------------------------------------------------


def _use(system: rr.System, name: str) -> None:
    with contextlib.closing(system.open_registrar(name)) as app:
        app.load("maker/thing", name).unload()


def _each(scene: Callable[[int], bool], numbers: tuple[int, ...] | None) -> None:
    """Play the scene with each of these requests refused, or with all that there are."""
    for at in numbers or itertools.count(1):
        assert at < MANY
        if not scene(at):
            return


def _started(state_dir: Path, wants: Wants, role: str, kind: str, numbers: tuple[int, ...] | None) -> None:
    def scene(at: int) -> bool:
        system = rr.System(tree(), state_dir=state_dir, config=CONFIG)
        wants.arm(role, kind, at)
        try:
            system.start()
        except rr.StartFailed as error:
            refused = wants.disarm() and bool(error.wanted)
            assert refused
            system.start()
        else:
            refused = wants.disarm()
        try:
            _use(system, "app")
        finally:
            system.stop()
        return refused

    _each(scene, numbers)


def _restarted(state_dir: Path, wants: Wants, role: str, kind: str, numbers: tuple[int, ...] | None) -> None:
    with rr.System(tree(10**6), state_dir=state_dir, config=CONFIG) as system:
        app = system.open_registrar("app")

        def scene(at: int) -> bool:
            system.registrar("maker").save_catalog()  # else each restart reads one file more than the one before
            with app.load("maker/thing", str(at)):
                old = pid_of(system, "maker")
                wants.arm(role, kind, at)
                kill(system, "maker")
                wait_respawned(system, "maker", old)
                refused = wants.disarm()
                _use(system, f"app{at}")
            return refused

        _each(scene, numbers)
        assert not any(record.restarts for record in _failed(system)), _failed(system)


def _loaded(state_dir: Path, wants: Wants, role: str, kind: str, numbers: tuple[int, ...] | None) -> None:
    with rr.System(tree(), state_dir=state_dir, config=CONFIG) as system:

        def scene(at: int) -> bool:
            wants.arm(role, kind, at)
            try:
                _use(system, f"app{at}")
            except rr.RrError:
                refused = wants.disarm()
                assert refused
            else:
                refused = wants.disarm()
            _use(system, f"later{at}")
            return refused

        _each(scene, numbers)


def _stopped(state_dir: Path, wants: Wants, role: str, kind: str, numbers: tuple[int, ...] | None) -> None:
    def scene(at: int) -> bool:
        system = rr.System(tree(), state_dir=state_dir, config=CONFIG).start()
        system.open_registrar("app").load("maker/thing", "one")
        pid = pid_of(system, "maker")
        wants.arm(role, kind, at)
        try:
            system.stop()
        except Exception:  # a step that went wrong; all others were done
            refused = wants.disarm()
            assert refused
        else:
            refused = wants.disarm()
        assert not lives(pid)
        return refused

    _each(scene, numbers)


SCENES = {"start": _started, "restart": _restarted, "load": _loaded, "stop": _stopped}
BY_THE_WAY = {("application", "threads"), ("application", "inodes"), ("server", "descriptors")}
"""What a restart asks for, and does without, or asks for again at once."""
ASKED = [
    *[(role, kind) for role in ("application", "child") for kind in ("threads", "descriptors", "inodes")],
    *[("server", kind) for kind in ("processes", "memory", "descriptors")],
]


@pytest.mark.parametrize(("role", "kind"), ASKED, ids=[" ".join(asked) for asked in ASKED])
def test_a_restart_for_which_something_is_refused_is_made_up_for(
    state_dir: Path, wants: Wants, role: str, kind: str
) -> None:
    _restarted(state_dir, wants, role, kind, FEW)


@pytest.mark.parametrize(("role", "kind"), ASKED, ids=[" ".join(asked) for asked in ASKED])
def test_a_want_that_lasts_is_waited_for_as_long_as_it_lasts(
    state_dir: Path, wants: Wants, role: str, kind: str
) -> None:
    with rr.System(tree(), state_dir=state_dir, config=CONFIG) as system:
        query = system.open_registrar("app").load("maker/thing", "one")
        old = pid_of(system, "maker")
        wants.arm(role, kind, 1, lasts=True)
        kill(system, "maker")
        if (role, kind) not in BY_THE_WAY:
            eventually(lambda: len(_failed(system)) >= 5)
        wants.disarm()
        wait_respawned(system, "maker", old)
        query.unload()
        _use(system, "later")


@pytest.mark.parametrize(("role", "kind"), ASKED, ids=[" ".join(asked) for asked in ASKED])
def test_a_system_stops_while_something_is_wanted(state_dir: Path, wants: Wants, role: str, kind: str) -> None:
    system = rr.System(tree(), state_dir=state_dir, config=CONFIG).start()
    pid = pid_of(system, "maker")
    system.open_registrar("app").load("maker/thing", "one")
    wants.arm(role, kind, 1, lasts=True)
    with contextlib.suppress(Exception):  # of a step that went wrong; all others were done
        system.stop()
    wants.disarm()
    assert not lives(pid)
    with rr.System(tree(), state_dir=state_dir, config=CONFIG) as again:
        _use(again, "app")


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("scene", SCENES)
def test_any_refused_request_ends_no_system_and_leaves_all_as_it_was(
    state_dir: Path, wants: Wants, scene: str, role: str, kind: str
) -> None:
    SCENES[scene](state_dir, wants, role, kind, None)
