"""What a registrar leaves on disk that is gone for good: nothing, unless it holds something or is owed something."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import pytest

import rr_actors as rr
from rr_actors.managers.programs import Program, Programs, RunProgram
from rr_actors.registrar.engine import node as node_module
from support import LIMIT_S, Workshop, catalog_path, eventually, serve
from support_inside import actor_of
from support_managers import Order, Shop

Start = Callable[..., rr.System]


def directories(state_dir: Path) -> set[str]:
    """The directories of registrars."""
    return {path.name for path in state_dir.iterdir() if path.is_dir() and path.name not in ("run", ".catalogs")}


def records(state_dir: Path) -> set[str]:
    return {path.name for path in (state_dir / ".catalogs").iterdir() if not path.name.startswith(".")}


def test_registrars_that_are_closed_leave_no_directory(
    system: rr.System, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    for number in range(10):
        session = system.open_registrar(f"session-{number}")
        session.load("provider/thing", "x").unload()
        session.close()
    eventually(lambda: directories(state_dir) == {"provider"})
    assert records(state_dir) <= {"provider"}


def test_the_catalog_of_a_session_that_is_over_never_has_an_sqlite_file(
    system: rr.System, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    session = system.open_registrar("session")
    session.load("provider/thing", "x").unload()
    session.close()
    assert not catalog_path(state_dir, "session").exists(), "to make it, the loop waits for the disk"


def test_nothing_is_removed_any_more_when_stop_has_returned(
    system: rr.System, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ended, never = threading.Event(), threading.Event(), threading.Event()

    def remove(_names: Sequence[str], _state_dir: str) -> None:
        begun.set()
        never.wait(1.5)  # a stop waits less for other work
        ended.set()

    monkeypatch.setattr(node_module, "_REMOVE_S", 0.0)
    monkeypatch.setattr(actor_of(system.open_registrar("kept")).node, "_remove_catalogs", remove)
    system.open_registrar("session").close()
    assert begun.wait(LIMIT_S)
    system.stop()
    assert ended.is_set()


def test_a_registrar_that_is_opened_again_goes_on_whether_its_directory_was_removed_or_not(
    system: rr.System, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    system.open_registrar("session").close()
    session = system.open_registrar("session")
    query = session.load("provider/thing", "x")
    system.open_registrar("another").close()
    eventually(lambda: directories(state_dir) == {"provider", "session"})
    assert [held.id for held in session.queries()] == [query.id]
    session.close()
    eventually(lambda: directories(state_dir) == {"provider"})
    session = system.open_registrar("session")
    assert session.queries() == []
    session.load("provider/thing", "x")
    assert len(provider.resources()) == 1


def test_what_is_owed_at_a_provider_that_is_down_keeps_the_directory(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    session = system.open_registrar("session")
    session.load("shop/thing", Order("wheel"))
    system.supervisor().terminate_child("shop")
    session.close(timeout_s=0.1)
    system.open_registrar("another").close()
    eventually(lambda: not (state_dir / "another").exists())
    assert catalog_path(state_dir, "session").exists()
    system.supervisor().restart_child("shop")
    workshop.wait("unload wheel")


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_children_that_are_deleted_leave_no_directory(
    start: Start, workshop: Workshop, state_dir: Path, placement: Literal["process", "thread"]
) -> None:
    system = start()
    for number in range(3):
        spec = rr.ChildSpec(Shop, id=f"shop-{number}", args=(str(workshop.root),), placement=placement)
        system.start_child(spec)
        app = system.open_registrar("app")
        app.load(f"shop-{number}/thing", Order("wheel")).unload()
        app.close()
        system.supervisor().terminate_child(f"shop-{number}")
        assert (state_dir / f"shop-{number}").exists(), "it may be started again"
        system.supervisor().delete_child(f"shop-{number}")
    eventually(lambda: directories(state_dir) == set())
    assert records(state_dir) == set()


def test_a_manager_of_programs_leaves_no_directory(start: Start, state_dir: Path) -> None:
    system = start()
    system.start_child(rr.ChildSpec(Programs, id="programs"))
    app = system.open_registrar("app")
    query: rr.Query[Program] = app.load(Programs.run_program, RunProgram("sleep", ("1000",)))
    assert (state_dir / "programs" / "programs").exists()
    query.unload()
    app.close()
    system.supervisor().terminate_child("programs")
    system.supervisor().delete_child("programs")
    eventually(lambda: directories(state_dir) == set())


def test_a_location_that_the_user_has_chosen_stays(system: rr.System, tmp_path: Path) -> None:
    system.open_registrar("elsewhere", rr.RegistrarConfig(location=tmp_path / "mine")).close()
    system.open_registrar("session").close()
    eventually(lambda: not (Path(system.state_dir) / "session").exists())
    assert (tmp_path / "mine" / "catalog.lock").exists()


KILLED = """
    import os, sys
    import rr_actors as rr
    system = rr.System(state_dir=sys.argv[1]).start()
    provider = system.open_registrar("provider")
    provider.register_server("thing", load=lambda request: None, unload=lambda request, response: None)
    for number in range(3):
        system.open_registrar(f"session-{number}")
    system.open_registrar("holder").load("provider/thing", "x")
    os.kill(os.getpid(), 9)
"""


def test_the_next_start_removes_what_a_killed_application_leaves_and_what_is_held_stays(
    start: Start, state_dir: Path
) -> None:
    subprocess.run([sys.executable, "-c", textwrap.dedent(KILLED), str(state_dir)], check=False)
    assert len(directories(state_dir)) == 5
    system = start()
    assert directories(state_dir) == {"provider", "holder"}
    assert set(system.dormant()) == {"provider", "holder"}


def test_a_dormant_registrar_that_is_released_leaves_no_directory(start: Start, state_dir: Path) -> None:
    subprocess.run([sys.executable, "-c", textwrap.dedent(KILLED), str(state_dir)], check=False)
    system = start()
    serve(system.open_registrar("provider"), "thing")
    system.release("holder")
    assert directories(state_dir) == {"provider"}
