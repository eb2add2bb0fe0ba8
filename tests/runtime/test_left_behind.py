"""What callbacks start in ways that hide it: nothing of it outlives its manager, however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import REPOSITORY, Workshop, kill, lives, wait_gone, wait_respawned
from support_escapes import WAYS, Escaping, StartProgram, fork_with_setsid

Start = Callable[..., rr.System]


def _tree(shop: Workshop, way: Callable[[Workshop], None]) -> rr.ChildSpec:
    return rr.ChildSpec(Escaping, id="maker", args=(str(shop.root), way))


def _escaped(shop: Workshop, count: int = 1) -> int:
    pid = int(shop.wait("escaped", count)[-1].split()[1])
    assert lives(pid)
    return pid


def _load(system: rr.System, request: int = 1) -> Any:
    return system.open_registrar(f"app-{request}").load("maker/thing", request)


@pytest.mark.parametrize("way", WAYS)
def test_it_ends_when_its_manager_is_killed_and_respawned(start: Start, workshop: Workshop, way: Any) -> None:
    system = start(_tree(workshop, way))
    _load(system)
    escaped = _escaped(workshop)

    old = kill(system, "maker")

    wait_gone(escaped)
    wait_respawned(system, "maker", old)
    _load(system, 2)
    assert lives(_escaped(workshop, 2))  # what belongs to the next incarnation is left alone


@pytest.mark.parametrize("way", WAYS)
def test_it_ends_when_its_manager_is_stopped(start: Start, workshop: Workshop, way: Any) -> None:
    system = start(_tree(workshop, way))
    _load(system).unload()
    escaped = _escaped(workshop)

    system.supervisor().terminate_child("maker")

    wait_gone(escaped)


@pytest.mark.parametrize("way", WAYS)
def test_it_ends_with_the_system(start: Start, workshop: Workshop, way: Any) -> None:
    system = start(_tree(workshop, way))
    _load(system)
    escaped = _escaped(workshop)

    system.stop()

    assert not lives(escaped)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_it_ends_when_the_supervisor_above_its_manager_is_killed(start: Start, workshop: Workshop, way: Any) -> None:
    inner = rr.Supervisor([_tree(workshop, way)], id="inner", placement="process")
    system = start(rr.Supervisor([inner]))
    _load(system)
    escaped = _escaped(workshop)

    kill(system, "inner")

    wait_gone(escaped)


APPLICATION = """
    import sys, time
    sys.path[:0] = {paths!r}
    import rr_actors as rr
    import support_escapes
    from support import Workshop
    shop = Workshop({shop!r})
    maker = rr.ChildSpec(support_escapes.Escaping, id="maker", args=(shop.root, support_escapes.{way}))
    system = rr.System([maker], state_dir={state!r}).start()
    query = system.open_registrar("app").load("maker/thing", 1)
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_it_ends_with_an_application_that_is_killed(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, workshop: Workshop, way: Any
) -> None:
    state_dir = tmp_path_factory.mktemp("state")  # whose sockets nobody removes before the next start
    paths = [str(REPOSITORY / "tests"), str(REPOSITORY)]
    program = textwrap.dedent(APPLICATION).format(
        paths=paths, shop=str(workshop.root), way=way.__name__, state=str(state_dir)
    )
    surroundings = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, env=surroundings) as application:
        assert application.stdout is not None
        assert application.stdout.readline() == b"ready\n"
        escaped = _escaped(workshop)

        application.kill()

        wait_gone(escaped)
    assert not list(tmp_path.glob("rr-fork-*"))


def test_a_killed_fork_server_takes_neither_managers_nor_what_they_started_along(
    start: Start, workshop: Workshop
) -> None:
    system = start(_tree(workshop, fork_with_setsid))
    _load(system)
    escaped = _escaped(workshop)
    (maker,) = system.supervisor().which_children()
    assert maker.pid is not None
    server = int(Path(f"/proc/{maker.pid}/stat").read_text().rpartition(")")[2].split()[1])

    os.kill(server, signal.SIGKILL)
    system.supervisor().start_child(rr.ChildSpec(Escaping, id="other", args=(str(workshop.root), fork_with_setsid)))
    old = kill(system, "other")
    wait_respawned(system, "other", old)  # its death has had everything swept that belongs to nobody

    assert lives(maker.pid)
    assert lives(escaped)
    kill(system, "maker")
    wait_gone(escaped)


def test_a_system_within_a_manager_ends_with_it_and_its_own_managers_are_left_alone_until_then(
    start: Start, workshop: Workshop, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """An application that a callback starts has a family of its own."""
    inner = Workshop(tmp_path / "inner")
    program = textwrap.dedent(APPLICATION).format(
        paths=[str(REPOSITORY / "tests"), str(REPOSITORY)],
        shop=str(inner.root),
        way="fork_with_setsid",
        state=str(tmp_path_factory.mktemp("state")),
    )
    system = start(rr.ChildSpec(Escaping, id="maker", args=(str(workshop.root), StartProgram(program))))
    _load(system)
    escaped = _escaped(inner)
    other = system.supervisor().start_child(rr.ChildSpec(Escaping, id="other", args=(str(workshop.root), print)))
    assert other is not None
    wait_respawned(system, "other", kill(system, "other"))
    assert lives(escaped)

    kill(system, "maker")

    wait_gone(_escaped_of(workshop), escaped)


def _escaped_of(shop: Workshop) -> int:
    return int(shop.wait("escaped")[-1].split()[1])
