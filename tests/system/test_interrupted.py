"""A system whose thread is interrupted while it starts or stops (Ctrl-C), and one whose process is forked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.actors import turns
from rr_actors.storage import opening as catalogs
from support import REPOSITORY, Workshop, eventually, serve
from support_asks import in_threads
from support_managers import Order, Shop


def shops(workshop: Workshop, *ids: str) -> list[rr.ChildSpec]:
    return [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),), shutdown_s=0.1) for id in ids]


@contextmanager
def interrupted(when: Callable[[], object]) -> Iterator[None]:
    """This thread gets a KeyboardInterrupt as soon as `when` has returned."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGUSR1, interrupt)
    me = threading.get_ident()

    def watch() -> None:
        when()
        signal.pthread_kill(me, signal.SIGUSR1)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            yield
        watcher.join()
    finally:
        signal.signal(signal.SIGUSR1, before)


def works(system: rr.System) -> None:
    """Nobody else has the catalog of "one"."""
    with system.open_registrar("app").load("one/thing", Order("again")) as query:
        assert query.response.shop == "one"


def test_a_start_that_is_interrupted_stops_what_had_started(state_dir: Path, workshop: Workshop) -> None:
    workshop.shut("start two")
    system = rr.System(shops(workshop, "one", "two", "three"), state_dir=state_dir)
    with interrupted(lambda: workshop.wait("start two")):
        system.start()
    workshop.open("start two")
    assert workshop.lines("start three") == []
    with system:
        works(system)


def test_a_registrar_whose_opening_is_interrupted_can_be_opened_again(
    state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opening, go_on = threading.Event(), threading.Event()
    real = catalogs.open_store

    def slowly(*args: Any, **options: Any) -> Any:
        store = real(*args, **options)
        opening.set()
        go_on.wait(5.0)
        return store

    def wait_and_let_go() -> None:
        opening.wait(5.0)
        threading.Timer(0.2, go_on.set).start()

    with rr.System(state_dir=state_dir) as system:
        monkeypatch.setattr(catalogs, "open_store", slowly)
        with interrupted(wait_and_let_go):
            system.open_registrar("app")
        monkeypatch.undo()
        assert system.open_registrar("app").queries() == []


def test_a_stop_that_is_interrupted_kills_what_had_not_stopped(state_dir: Path, workshop: Workshop) -> None:
    class Stubborn(Shop):
        def on_stop(self) -> None:
            self.work.note("stopping")
            threading.Event().wait(60)

    stubborn = rr.ChildSpec(Stubborn, id="two", args=(str(workshop.root),), shutdown_s="infinity")
    system = rr.System([*shops(workshop, "one"), stubborn], state_dir=state_dir).start()
    with interrupted(lambda: workshop.wait("stopping")):
        system.stop(60)
    system.stop()
    with rr.System(shops(workshop, "one"), state_dir=state_dir) as system:
        works(system)


def in_a_fork(do: Callable[[], object]) -> None:
    """Do it in a forked child, and fail here if it fails there."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            do()
            code = 0
        finally:
            os._exit(code)

    def ended() -> tuple[int] | None:
        done, status = os.waitpid(pid, os.WNOHANG)
        return (status,) if done else None

    assert eventually(ended) == (0,)


def test_a_forked_child_has_no_part_in_the_system_and_does_it_no_harm(state_dir: Path, workshop: Workshop) -> None:
    with rr.System(shops(workshop, "one"), state_dir=state_dir) as system:
        app = system.open_registrar("app")
        serve(app, "own")
        query = app.load("one/thing", Order("kept"))

        def use_it() -> None:
            for call in (
                *(lambda: app.load("one/thing", Order("other")), lambda: app.load("app/own", 1)),
                *(query.unload, app.unload_all, app.queries),
            ):
                with pytest.raises(rr.RegistrarDown, match="forked from"):
                    call()
            for call in (lambda: system.ref("one").ask("hello"), system.snapshot):
                with pytest.raises(rr.UsageError, match="forked from"):
                    call()
            app.close()
            system.stop()
            with pytest.raises(rr.CatalogLocked):
                system.start()
            with rr.System(shops(workshop, "one"), state_dir=state_dir.with_name("elsewhere")) as other:
                works(other)

        in_a_fork(use_it)
        assert [held.request for held in app.queries()] == [Order("kept")]
        app.load("app/own", 1).unload()
        assert [resource.request for resource in system.registrar("one").resources()] == [Order("kept")]


FORKS = """
import multiprocessing, os, signal, sys
import rr_actors as rr

def rest():
    print(os.getpid(), flush=True)
    signal.pause()

system = rr.System([], state_dir=sys.argv[1]).start()
multiprocessing.get_context("fork").Process(target=rest).start()
signal.pause()
"""


def test_a_forked_child_does_not_keep_the_state_directory_when_its_parent_is_killed(state_dir: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FORKS, str(state_dir)],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        stdout=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        forked = int(program.stdout.readline())
        try:
            program.kill()
            program.wait()
            rr.System([], state_dir=state_dir).start().stop()
        finally:
            os.kill(forked, signal.SIGKILL)


WITHOUT_STANDARD_FDS = """
import os, sys
import rr_actors as rr

class Main(rr.Manager):
    @rr.server("fds")
    def load_fds(self, request: int) -> list[str]:
        return [os.readlink(f"/proc/self/fd/{fd}") for fd in range(3)]

with rr.System([rr.ChildSpec(Main, id="main")], state_dir=sys.argv[1]) as system:
    app = system.open_registrar("app")
    with app.load("main/fds", 1) as query:
        found = query.response
    app.close()
with open(sys.argv[2], "w") as file:
    print(found, file=file)
"""


def test_a_program_without_standard_files_does_not_mistake_its_own_for_them(state_dir: Path, tmp_path: Path) -> None:
    close_and_run = "import os, sys; os.closerange(0, 3); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    told = tmp_path / "told"
    done = subprocess.run(
        [sys.executable, "-c", close_and_run, "-c", WITHOUT_STANDARD_FDS, str(state_dir), str(told)],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        timeout=30,
        check=False,
    )
    assert done.returncode == 0
    assert told.read_text().strip() == str(["/dev/null"] * 3)


def test_in_a_forked_child_the_thread_that_forked_is_the_one_that_handlers_interrupt() -> None:
    statuses: list[int] = []

    def fork() -> None:
        pid = os.fork()
        if pid == 0:
            os._exit(0 if turns.runs_handlers() else 1)
        statuses.append(os.waitpid(pid, 0)[1])
        assert not turns.runs_handlers()

    in_threads(fork)
    assert statuses == [0]
    assert turns.runs_handlers()
