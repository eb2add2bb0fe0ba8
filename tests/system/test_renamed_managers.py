"""A manager whose id differs from that of the run before, which was killed: nothing is lost, or started twice."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import CatalogError
from rr_actors.managers.programs import Program, Programs, RunProgram
from rr_actors.storage.opening import read_rows
from rr_actors.system import registrar_lookup
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from support import TEST_PATHS, catalog_path, eventually
from support_programs import running_programs

Start = Callable[..., rr.System]
SLEEP = RunProgram("sleep", ("1000",))


@pytest.fixture
def killed(state_dir: Path) -> Path:
    """The state directory of an application that was killed while it held a program of the manager "programs"."""
    program = f"""
        import os, signal
        import rr_actors as rr
        from rr_actors.managers.programs import Programs, RunProgram

        if __name__ == "__main__":
            system = rr.System([rr.ChildSpec(Programs, id="programs")], state_dir={str(state_dir)!r}).start()
            app = system.open_registrar("app")
            app.load(Programs.run_program, RunProgram("sleep", ("1000",)))
            app.save_catalog()
            os.kill(os.getpid(), signal.SIGKILL)
    """
    environment = dict(os.environ, PYTHONPATH=TEST_PATHS)
    command = [sys.executable, "-c", textwrap.dedent(program)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    return state_dir


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def test_it_takes_over_its_programs_by_renamed_from(
    start: Start, killed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (pid,) = running_programs()
    spec = rr.ChildSpec(Programs, id="launcher", renamed_from="programs")
    system = start(spec)
    assert system.dormant() == ["app"]
    app = system.open_registrar("app")
    (held,) = app.queries()
    assert (held.registrar, held.server) == ("launcher", "program")
    again: rr.Query[Program] = app.load(Programs.run_program, SLEEP)
    assert (again.response.pid, again.resource_id) == (pid, held.resource_id)
    held.unload()
    again.unload()
    assert running_programs() == {}
    assert not (killed / "programs").exists()
    assert not [text for text in warnings_in(caplog) if "app" not in text]
    system.stop()
    assert start(spec).dormant() == [], "the second time there is nothing to take over"


def test_the_dormant_one_is_named_and_a_stop_does_not_wait_for_it(
    start: Start, killed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    system = start(rr.ChildSpec(Programs, id="launcher"), config=SystemConfig(stop_timeout_s=60.0))
    assert system.dormant() == ["app", "programs"]
    named = [text for text in warnings_in(caplog) if "is dormant" in text]
    assert len(named) == 1, "the application opens its own registrar again: that is no news"
    assert "registrar programs is dormant: " in named[0]
    assert "it serves 1 x program" in named[0]
    assert "renamed_from='programs'" in named[0]
    with ConsoleConnection(find_console(system.state_dir)) as console:
        (row,) = [row for row in console.registrars().rows if row.name == "programs"]
    assert (row.status, row.error) == ("dormant", "dormant: it serves 1 x program")
    app = system.open_registrar("app")
    app.load("launcher/program", SLEEP)
    began = time.monotonic()
    system.stop()
    assert time.monotonic() - began < 30, "half of the limit"
    assert "system system: stops, and registrar programs stays dormant: it serves 1 x program" in warnings_in(caplog)
    assert any("app: 1 releases are owed to programs" in text for text in warnings_in(caplog))
    assert len(running_programs()) == 1
    start(rr.ChildSpec(Programs, id="programs")).open_registrar("app")
    eventually(lambda: running_programs() == {})


def test_what_a_dormant_one_serves_is_forgotten_by_a_forced_release(
    start: Start, killed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    system = start(rr.ChildSpec(Programs, id="launcher"))
    app = system.open_registrar("app")
    (held,) = app.queries()
    system.release("programs", force=True)
    assert system.dormant() == []
    assert not catalog_path(killed, "programs").exists()
    told = "registrar programs: it serves 1 x program; what it serves is forgotten, and no unload callback has run"
    assert told in warnings_in(caplog)
    eventually(lambda: held.state is rr.State.FATAL)
    assert app.queries() == []
    assert len(running_programs()) == 1, "only its own manager could have ended it"
    for pid in running_programs():
        os.kill(pid, signal.SIGKILL)
    caplog.clear()
    system.stop()
    again = start(rr.ChildSpec(Programs, id="programs"))
    app = again.open_registrar("app")
    eventually(lambda: app.owed() == [])
    assert (app.queries(), again.registrar("programs").resources(), again.dormant()) == ([], [], [])


@pytest.mark.parametrize("placed", [{}, {"launcher": rr.RegistrarConfig(location="elsewhere")}])
def test_a_take_over_that_is_interrupted_anywhere_is_finished_by_the_next_start(
    killed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, placed: dict[str, rr.RegistrarConfig]
) -> None:
    config = SystemConfig(registrars=placed)
    shutil.rmtree(killed / "run")
    app, new = catalog_path(killed, "app"), config.registrar("launcher").catalog_path(killed)
    copy = tmp_path / "copy"
    shutil.copytree(killed, copy)

    def taken_over() -> tuple[list[str], list[str]]:
        registrar_lookup.take_over(config, killed, {"launcher": "programs"})
        assert not (killed / "programs").exists()
        return sorted(map(repr, read_rows(app))), sorted(map(repr, read_rows(new)))

    expected = taken_over()
    assert not [row for row in expected[0] if "'programs" in str(row)]
    steps = ("remove_unneeded", "move_catalog", "change", "read_rows")
    interrupted = 0
    for at in range(20):
        shutil.rmtree(killed)
        shutil.copytree(copy, killed)
        left = at
        with monkeypatch.context() as patch:
            for step in steps:

                def dies(*args: object, step: Callable[..., object], **options: object) -> object:
                    nonlocal left
                    left -= 1
                    if left < 0:
                        raise KeyboardInterrupt
                    return step(*args, **options)

                real = getattr(registrar_lookup, step)
                patch.setattr(
                    registrar_lookup, step, lambda *args, real=real, **options: dies(*args, step=real, **options)
                )
            try:
                registrar_lookup.take_over(config, killed, {"launcher": "programs"})
            except KeyboardInterrupt:
                interrupted += 1
        assert taken_over() == expected
    assert 3 <= interrupted < 20
    for pid in running_programs():
        os.kill(pid, signal.SIGKILL)


def test_a_manager_that_has_something_of_its_own_takes_nothing_over(start: Start, killed: Path) -> None:
    shutil.copytree(killed / "app", killed / "launcher")
    with pytest.raises(CatalogError, match="launcher"):
        rr.System([rr.ChildSpec(Programs, id="launcher", renamed_from="programs")], state_dir=killed).start()
    system = start(rr.ChildSpec(Programs, id="programs"))
    system.open_registrar("app")
    system.stop()
    assert running_programs() == {}


def test_a_renamed_from_that_cannot_be_meant_is_refused(system: rr.System) -> None:
    with pytest.raises(rr.InvalidSpec, match="renamed_from: expected an earlier id"):
        rr.ChildSpec(Programs, id="programs", renamed_from="programs")
    with pytest.raises(rr.InvalidSpec, match="renamed_from"):
        rr.ChildSpec(Programs, id="programs", renamed_from="a/b")
    with pytest.raises(rr.InvalidSpec, match="renamed_from: expected None, as only managers"):
        rr.System([rr.ChildSpec(rr.Actor, id="actor", renamed_from="before")])
    with pytest.raises(rr.InvalidSpec, match="renamed_from: expected an id that no other manager has"):
        rr.System([rr.ChildSpec(Programs, id="a"), rr.ChildSpec(Programs, id="b", renamed_from="a")])
    with pytest.raises(rr.InvalidSpec, match="renamed_from: expected None in a child that is added at run time"):
        system.start_child(rr.ChildSpec(Programs, id="b", renamed_from="a"))
