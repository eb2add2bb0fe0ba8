"""Children that freeze in their start, that cannot work any more, or for which there are no resources."""

from __future__ import annotations

import asyncio
import errno
import os
import re
import resource
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import StartFailed
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.processes.process import Spawner
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.specs import Backoff
from rr_actors.supervision.heartbeat import Heartbeat, ProcessHealth
from support import (
    NoDescriptors,
    Workshop,
    child,
    descriptors,
    eventually,
    kill,
    lives,
    pid_of,
    wait_gone,
    wait_respawned,
)
from support_children import hear

Start = Callable[..., rr.System]


def test_time_without_a_processor_does_not_count_for_a_heartbeat() -> None:
    limit_s = 0.02
    starved = [0.0, limit_s, 2 * limit_s, 3 * limit_s]  # for as long as it was waited, three times; then no more
    killed: list[tuple[str, int]] = []

    def starved_s() -> float:
        return starved.pop(0) if len(starved) > 1 else starved[0]

    async def beat() -> None:
        dead = asyncio.Event()

        def kill(why: str) -> None:
            killed.append((why, len(starved)))
            dead.set()

        heartbeat = Heartbeat(limit_s, lambda: None, kill, starved_s)
        await asyncio.wait_for(dead.wait(), 10)
        heartbeat.stop()

    asyncio.run(beat())

    assert killed == [("hung: its loop had not answered for 0.02 s (heartbeat_s)", 1)]


class Frozen(rr.Manager):
    """Stops its own process in the middle of its start, as often as its workshop says."""

    def __init__(self, root: str) -> None:
        self._shop = Workshop(root)

    def on_start(self) -> None:
        self._shop.note("starting", os.getpid())
        if len(self._shop.lines("starting")) in (2, 3):
            os.kill(os.getpid(), signal.SIGSTOP)
            threading.Event().wait()
        self._shop.note("started", os.getpid())


class Failing(rr.Manager):
    """Loses what it needs, as a load tells it to; its next incarnation has it again."""

    def on_start(self) -> None:
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 200), hard))  # soon used up

    @rr.server("thing")
    def load(self, request: str) -> int:
        if rr.current().attempt > 1:  # an interrupted load, which is not given up yet
            return os.getpid()
        match request:
            case "descriptors":
                _use_up_descriptors()
            case "root":
                os.chroot("/proc/self")
            case "rights":
                os.setuid(65534)
            case _:
                pass
        return os.getpid()


def _use_up_descriptors() -> None:
    try:
        while True:
            os.dup(0)
    except OSError:
        return


def _try_to_load(app: rr.Registrar, what: str) -> None:
    try:
        app.load("maker/thing", what, timeout_s=0.3)
    except rr.RrError:
        pass


def _records(system: rr.System, event: str) -> list[Any]:
    return [record for record in system.supervisor().history() if record.event == event]


def test_a_manager_that_freezes_while_it_starts_is_replaced_within_its_heartbeat(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Frozen, id="maker", args=(str(workshop.root),), heartbeat_s=1.0))
    kill(system, "maker")

    workshop.wait("started", 2, 20.0)  # in the fourth start: two have frozen

    frozen = _records(system, "start_failed")
    assert len(frozen) == 2
    assert all("hung: its loop had not answered" in record.detail for record in frozen)
    assert not any(lives(int(line.split()[1])) for line in workshop.lines("starting")[1:3])


LOST = {"descriptors": r"unhealthy: it cannot open .*: EMFILE"}
if os.geteuid() == 0:  # others may not change their root or their user
    LOST |= {"root": r"unhealthy: it has another root", "rights": r"unhealthy: it cannot open .*: EACCES"}


@pytest.mark.parametrize("what", LOST)
def test_a_manager_that_has_lost_what_it_needs_is_replaced(start: Start, what: str) -> None:
    system = start(rr.ChildSpec(Failing, id="maker", heartbeat_s=2.0))
    app = system.open_registrar("app")
    old = pid_of(system, "maker")
    loading = threading.Thread(target=_try_to_load, args=(app, what))
    loading.start()

    new = wait_respawned(system, "maker", old)

    loading.join()
    (record,) = _records(system, "exited")
    assert record.reason == "abnormal"
    assert re.search(LOST[what], record.detail)
    assert app.load("maker/thing", "nothing").response == new


def test_what_a_new_process_would_suffer_from_as_well_is_no_trouble(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = ProcessHealth(lambda: [tmp_path / "missing"])
    assert missing.trouble() == ""
    elsewhere = tmp_path.stat()
    monkeypatch.setattr(os, "stat", lambda _path: elsewhere)
    assert "another root directory" in missing.trouble()


def test_restarts_without_descriptors_back_off_and_name_what_is_wanted(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    pause = Backoff(delay_s=0.5, factor=2.0, maximum_s=30.0, jitter=0.1)
    monkeypatch.setattr(restarts, "PAUSE", pause)  # this process has the root supervisor
    system = start(rr.Supervisor([rr.ChildSpec(Failing, id="maker")], max_restarts=10_000))
    old = pid_of(system, "maker")
    with NoDescriptors():
        kill(system, "maker")
        eventually(lambda: len(_records(system, "start_failed")) >= 2, 20.0)
        failed = _records(system, "start_failed")
        assert child(system, "maker").state == "restarting"

    assert len(failed) == 2
    assert failed[1].at - failed[0].at > 0.8 * pause.delay_s
    assert failed[1].delay_s > failed[0].delay_s >= pause.delay(0, 1.0)
    assert all("EMFILE: the process has as many descriptors open as it may" in record.detail for record in failed)
    wait_respawned(system, "maker", old)


@pytest.mark.slow
def test_the_default_intensity_is_not_exceeded_for_want_of_descriptors(start: Start) -> None:
    system = start(rr.ChildSpec(Failing, id="maker"))
    old = pid_of(system, "maker")
    with NoDescriptors():
        kill(system, "maker")
        eventually(lambda: len(_records(system, "start_failed")) >= 3, 20.0)
    wait_respawned(system, "maker", old)


def test_a_start_that_fails_at_any_descriptor_leaves_no_process_and_no_descriptor() -> None:
    spawner = Spawner()
    failures: list[str] = []
    try:
        _started(spawner)
        before = descriptors()
        for spare in range(14):
            with NoDescriptors(spare):
                try:
                    _started(spawner)
                except StartFailed as error:
                    failures.append(str(error))
            assert not descriptors() - before
        assert 5 < len(failures) < 14
        assert all("EMFILE" in failure for failure in failures)
        _started(spawner)
    finally:
        spawner.close()


def _started(spawner: Spawner) -> None:
    process = spawner.start("support_children:until_told", b"", name="child")
    try:
        hear(process.control)
    finally:
        process.kill()
        wait_gone(process.pid)
        process.close()


def test_a_fork_server_that_is_frozen_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rr_actors.runtime.processes.fork_server.ANSWER_S", 0.5)
    spawner = Spawner()
    try:
        process = spawner.start("support_children:until_told", b"", name="child")
        hear(process.control)
        server = int(Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[1])
        os.kill(server, signal.SIGSTOP)

        _started(spawner)  # if it had waited for the frozen server to the end of its own time limit, it would fail

        assert not lives(server)
        assert lives(process.pid)
        process.kill()
        wait_gone(process.pid)
        process.close()
    finally:
        spawner.close()


# -- what was missing when it failed ---------------------------------------------------------------------------------


def _caused(error: BaseException, cause: BaseException) -> BaseException:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "named"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "EMFILE"),
        (_caused(StartFailed("it did not start"), OSError(errno.EAGAIN, "no process")), "EAGAIN"),
        (MemoryError(), "ENOMEM"),
        (RuntimeError("can't start new thread"), "EAGAIN"),
        (ExceptionGroup("several", [ValueError(), OSError(errno.ENOSPC, "disk full")]), "ENOSPC"),
        (ValueError("no such device"), ""),
        (OSError(errno.ENOENT, "no such file"), ""),
        (OSError("without a number"), ""),
    ],
)
def test_the_resource_that_is_wanted_is_named(error: BaseException, named: str) -> None:
    assert wanted_by(error).partition(":")[0] == named


def test_a_ring_of_causes_has_an_end() -> None:
    first, second = ValueError(), KeyError()
    first.__cause__, second.__cause__ = second, first
    assert wanted_by(first) == ""


def test_the_sockets_of_killed_processes_are_removed(start: Start, workshop: Workshop, state_dir: Path) -> None:
    system = start(rr.ChildSpec(Failing, id="maker"), rr.ChildSpec(Failing, id="other"))

    def sockets() -> set[str]:
        return {path.name for path in (state_dir / "run").glob("*/*-*.sock")}

    before, pid = sockets(), pid_of(system, "maker")
    for _ in range(3):
        kill(system, "maker")
        pid = wait_respawned(system, "maker", pid)
    eventually(lambda: len(sockets()) == len(before), what="as many as there are processes")
    assert len(sockets() & before) == len(before) - 1
    assert any(name.startswith(f"{pid}-") for name in sockets())
