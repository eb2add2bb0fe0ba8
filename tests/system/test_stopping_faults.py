"""Stopping goes on to its end whatever one step of it raises: nothing lives on, and the next start works."""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

import rr_actors as rr
from rr_actors.actors.remote.hub import ActorHub
from rr_actors.base.steps import Steps
from rr_actors.hosting import run_files
from rr_actors.hosting.run_files import RunKeeper, Watched
from rr_actors.registrar.engine.commit_log import CommitLog
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model.rows import Peer, Put
from rr_actors.runtime import event_loop
from rr_actors.runtime.processes.process import Process, Spawner
from rr_actors.storage.catalog_lock import CatalogLock
from rr_actors.storage.opening import open_store
from rr_actors.supervision import child_runs
from rr_actors.system.event_subscribers import Subscribers
from rr_actors.wire.local_transport import LocalTransport
from rr_actors.wire.name_service import Directory, StateDir
from rr_actors.wire.unix_sockets import SocketDir
from rr_actors.wire.unix_transport import UnixTransport
from support import descriptors, eventually, lives
from support_supervision import Idle


def system_in(state_dir: Path, *, managers: int = 2) -> rr.System:
    children = [rr.ChildSpec(Idle, id=f"m{n}", placement="process") for n in range(managers)]
    return rr.System(children, state_dir=state_dir)


def pids_of(system: rr.System) -> list[int]:
    children = system.supervisor().which_children()
    return [child.pid for child in children if child.pid is not None]


def check_nothing_is_left(pids: list[int], state_dir: Path) -> None:
    """No process, no loop, no lock; and a start finds nothing in its way."""
    eventually(lambda: not any(map(lives, pids)))
    assert event_loop.current() is None
    eventually(lambda: not any(thread.name == "rr-loop" for thread in threading.enumerate()))
    with system_in(state_dir, managers=0) as again:
        again.open_registrar("app").close()


# -- one step that fails -------------------------------------------------------------------------------------------

SYNC: list[tuple[type[Any], str]] = [
    (StateDir, "_clear"),
    (StateDir, "close"),
    (Subscribers, "leave"),
    (RunKeeper, "stop"),
    (Watched, "close"),
    (Directory, "mark"),
    (Directory, "close"),
    (RegistrarActor, "close"),
    (RegistrarActor, "end_closing"),
    (RegistrarActor, "settle"),
    (Consumers, "close"),
    (CommitLog, "close"),
    (CatalogLock, "release"),
    (ActorHub, "close"),
    (Spawner, "close"),
    (SocketDir, "unlink"),
    (SocketDir, "close"),
    (Node, "close_registrar"),
    (Process, "close"),
]
ASYNC: list[tuple[type[Any], str]] = [
    (Node, "dismiss"),
    (Node, "wind_down"),
    (Node, "close"),
    (LocalTransport, "close"),
    (UnixTransport, "close"),
    (UnixTransport, "_close_links"),
    (child_runs.ProcessRun, "stop"),
]


class Broken(Exception):
    """What a step raises."""


@contextlib.contextmanager
def failing(cls: type[Any], name: str) -> Iterator[list[str]]:
    """The step does what it does, and raises then, each time. What it was called for is in the list."""
    real = getattr(cls, name)
    calls: list[str] = []

    def fail(self: Any, *args: Any, **options: Any) -> NoReturn:
        calls.append(name)
        real(self, *args, **options)
        raise Broken(f"{cls.__name__}.{name}")

    async def fail_later(self: Any, *args: Any, **options: Any) -> NoReturn:
        calls.append(name)
        await real(self, *args, **options)
        raise Broken(f"{cls.__name__}.{name}")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cls, name, fail_later if (cls, name) in ASYNC else fail)
        yield calls


def leaves(error: BaseException) -> list[BaseException]:
    """The errors in a group, and in the groups in it."""
    if isinstance(error, BaseExceptionGroup):
        return [leaf for inner in error.exceptions for leaf in leaves(inner)]
    return [error]


@pytest.mark.slow
@pytest.mark.parametrize(("cls", "name"), [*SYNC, *ASYNC], ids=lambda value: getattr(value, "__name__", value))
def test_a_step_that_fails_ends_no_other_and_is_raised_at_the_end_or_logged(
    tmp_path: Path, cls: type[Any], name: str, caplog: pytest.LogCaptureFixture
) -> None:
    system = system_in(tmp_path, managers=1)
    system.start()
    pids = pids_of(system)
    system.open_registrar("one")
    system.open_registrar("two")
    raised: list[BaseException] = []
    with failing(cls, name) as calls:
        try:
            system.stop()
        except Exception as error:
            raised = leaves(error)
    assert calls, "the step is not one of stopping any more"
    assert any(isinstance(error, Broken) for error in raised) or f"{cls.__name__}.{name}" in caplog.text
    assert all(isinstance(error, Broken) for error in raised), raised
    assert system.state_dir == tmp_path
    system.stop()
    check_nothing_is_left(pids, tmp_path)


# -- run/ that is removed ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["run", "names", "sockets"])
def test_stopping_ends_everything_though_a_cleaner_has_removed_run_and_a_manager_was_killed(
    tmp_path: Path, what: str
) -> None:
    system = system_in(tmp_path)
    system.start()
    app = system.open_registrar("app")
    pids = pids_of(system)
    remove(tmp_path, what)
    os.kill(pids[0], signal.SIGKILL)
    system.stop()
    assert "(closed)" in repr(app)
    check_nothing_is_left(pids, tmp_path)


def remove(state_dir: Path, what: str) -> None:
    (incarnation,) = (state_dir / "run").iterdir()
    if what == "run":
        clear(state_dir / "run")
    elif what == "names":
        clear(incarnation / "names")
    else:
        for path in incarnation.glob("*.sock"):
            path.unlink()


def clear(place: Path) -> None:
    """Remove a directory as a cleaner does that goes on until it is gone: its owner may make it again meanwhile."""
    while place.exists():
        shutil.rmtree(place, ignore_errors=True)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["run", "names", "sockets"])
def test_run_is_made_again_while_the_system_runs_and_everybody_is_found_again(
    tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_files, "LOOK_S", 0.05)  # in this process; its children were forked with it, too
    system = system_in(tmp_path)
    system.start()
    try:
        system.open_registrar("app")
        before = names_in(tmp_path)
        remove(tmp_path, what)
        eventually(lambda: names_in(tmp_path) == before)
        os.kill(pids_of(system)[0], signal.SIGKILL)
        eventually(lambda: len(pids_of(system)) == 2 and system.registrar("m0").servers() == [])
        assert system.registrar("m1").servers() == []
    finally:
        system.stop()


def names_in(state_dir: Path) -> set[str]:
    """The names and the sockets there are; which processes they are of does not matter."""
    found = {path.name.rpartition(".")[2] for path in state_dir.glob("run/*/*.sock")}
    sockets = len(list(state_dir.glob("run/*/*.sock")))
    return found | {path.name for path in state_dir.glob("run/*/names/*")} | {str(sockets)}


# -- locks that are removed ----------------------------------------------------------------------------------------


def test_a_state_directorys_lock_that_is_removed_is_taken_again_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(run_files, "LOOK_S", 0.05)
    with system_in(tmp_path, managers=0):
        (tmp_path / "system.lock").unlink()
        eventually(lambda: "system.lock, was removed" in caplog.text)
        with pytest.raises(rr.CatalogLocked):
            system_in(tmp_path, managers=0).start()


def test_a_catalogs_lock_that_is_removed_is_taken_again_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = open_store(tmp_path / "app" / "catalog.sqlite3")
    (tmp_path / "app" / "catalog.lock").unlink()
    store.commit([Put(Peer("maker"))])
    store.tidy()
    assert "catalog.lock: it was removed" in caplog.text
    with pytest.raises(rr.CatalogLocked):
        open_store(tmp_path / "app" / "catalog.sqlite3")
    store.close()


# -- steps ---------------------------------------------------------------------------------------------------------


def raising(error: BaseException) -> Callable[[], NoReturn]:
    def step() -> NoReturn:
        raise error

    return step


def test_a_stopped_system_holds_no_descriptor(tmp_path: Path) -> None:
    with system_in(tmp_path, managers=1):
        pass
    gc.collect()  # of what other tests have left
    before = descriptors()
    gc.disable()
    try:
        with system_in(tmp_path, managers=1) as system:
            system.open_registrar("app")
        assert not descriptors() - before
    finally:
        gc.enable()


def test_steps_raise_one_error_as_it_is_several_as_a_group_and_an_interruption_before_them() -> None:
    steps = Steps()
    steps.take("nothing", int)
    steps.end("all well")
    one, two, interruption = ValueError("one"), KeyError("two"), KeyboardInterrupt()
    steps.take("the first", raising(one))
    with pytest.raises(ValueError, match="one") as caught:
        steps.end("text")
    assert caught.value.__notes__ == ["while the first"]
    steps.take("the second", raising(two))
    with pytest.raises(ExceptionGroup, match="text") as group:
        steps.end("text")
    assert group.value.exceptions == (one, two)
    steps.take("the third", raising(interruption))
    with pytest.raises(KeyboardInterrupt) as interrupted:
        steps.end("text")
    assert isinstance(interrupted.value.__cause__, ExceptionGroup)
