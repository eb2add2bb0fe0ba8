"""Systems that are started twice in one process, as in a notebook, and systems that are dropped without stop()."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import warnings
import weakref
from pathlib import Path

import pytest

import rr_actors as rr
from support import REPOSITORY, Calls, Workshop, eventually, lives, pid_of, serve, wait_gone
from support_managers import Order, Shop


def shops(workshop: Workshop, *ids: str) -> list[rr.ChildSpec]:
    return [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),)) for id in ids]


def test_a_second_system_on_a_directory_says_that_the_first_is_of_this_process(state_dir: Path) -> None:
    with rr.System(state_dir=state_dir) as system:
        expected = rf"a system of this same process \(pid {os.getpid()}\).*System\.running\('{state_dir}'\)"
        with pytest.raises(rr.CatalogLocked, match=expected) as caught:
            rr.System(state_dir=state_dir).start()
        assert caught.value.pid == os.getpid()
        assert rr.System.running(state_dir) is system


def test_the_running_system_is_found_by_any_path_of_its_directory_and_not_after_its_end(
    state_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(state_dir)
    assert rr.System.running(state_dir) is None
    with rr.System(state_dir=state_dir) as system:
        for path in (str(state_dir), os.path.relpath(state_dir), tmp_path / "link"):
            assert rr.System.running(path) is system
        assert rr.System.running(tmp_path / "other") is None
        with pytest.raises(rr.ConfigError):
            rr.System.running(7)  # type: ignore[arg-type]
    assert rr.System.running(state_dir) is None
    with rr.System(state_dir="rr_state") as system:
        assert rr.System.running() is system


def test_a_system_whose_start_failed_does_not_count_as_running(state_dir: Path, workshop: Workshop) -> None:
    workshop.spoil("start one")
    with pytest.raises(rr.StartFailed):
        rr.System(shops(workshop, "one"), state_dir=state_dir).start()
    assert rr.System.running(state_dir) is None


def test_a_dropped_system_warns_and_stops_and_the_next_start_waits_for_that(
    state_dir: Path, workshop: Workshop
) -> None:
    system = rr.System(shops(workshop, "one"), name="first", state_dir=state_dir).start()
    pid = pid_of(system, "one")
    with pytest.warns(ResourceWarning, match=r"system 'first'.*was dropped without stop\(\).*context manager"):
        del system
    with rr.System(shops(workshop, "one"), state_dir=state_dir) as system:
        assert not lives(pid)
        with system.open_registrar("app").load("one/thing", Order("again")) as query:
            assert query.response.shop == "one"


def test_a_dropped_system_stops_by_itself(state_dir: Path, workshop: Workshop) -> None:
    system = rr.System(shops(workshop, "one"), state_dir=state_dir).start()
    pid = pid_of(system, "one")
    with pytest.warns(ResourceWarning):
        del system
    wait_gone(pid)
    eventually(lambda: rr.System.running(state_dir) is None and not any(state_dir.glob("run/*")))


def test_a_system_whose_registrar_is_in_use_is_not_dropped(state_dir: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        app = rr.System(state_dir=state_dir).start().open_registrar("app")
        serve(app, "own")
        gc.collect()
        with app.load("app/own", 1) as query:
            assert query.response == {"of": 1, "number": 1}
        system = rr.System.running(state_dir)
        assert system is not None
        system.stop()


def test_a_system_of_which_a_handle_is_in_use_is_not_dropped(state_dir: Path, workshop: Workshop) -> None:
    handle = rr.System(shops(workshop, "one"), state_dir=state_dir).start().registrar("one")
    gc.collect()
    assert handle.servers() == ["one/thing"]
    with pytest.warns(ResourceWarning):
        del handle
    eventually(lambda: rr.System.running(state_dir) is None and not any(state_dir.glob("run/*")))


def test_a_stopped_system_is_dropped_in_silence(state_dir: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with rr.System(state_dir=state_dir) as system:
            system.open_registrar("app")
            system.subscribe(Calls())
        gone = weakref.ref(system)
        del system
        gc.collect()
        assert gone() is None


def test_a_program_that_ends_without_a_stop_is_warned_and_leaves_nothing(state_dir: Path) -> None:
    program = (
        "import rr_actors as rr, sys\n"
        "system = rr.System([rr.ChildSpec(rr.Actor, id='one')], state_dir=sys.argv[1]).start()\n"
        "print(system.ref('one').is_alive())\n"
    )
    ran = subprocess.run(
        [sys.executable, "-X", "dev", "-c", program, str(state_dir)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    assert ran.stdout == "True\n"
    assert "was dropped without stop()" in ran.stderr
    assert "Traceback" not in ran.stderr
    for left in state_dir.glob("run/*/*.sock"):
        left.unlink()  # the next start would


def test_a_program_that_exits_just_after_it_has_dropped_a_system_waits_until_that_is_stopped(tmp_path: Path) -> None:
    code = (
        "import sys\nimport rr_actors as rr\n\n\n"
        "class Slow(rr.Actor):\n"
        "    def on_stop(self):\n"
        "        import time\n"
        "        time.sleep(0.3)\n"
        "        open(sys.argv[1] + '/stopped', 'w').close()\n\n\n"
        "rr.System([rr.ChildSpec(Slow, id='slow', placement='thread')], state_dir=sys.argv[1] + '/state').start()\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=30, cwd=REPOSITORY
    )
    assert ran.returncode == 0
    assert (tmp_path / "stopped").exists()
    (line,) = ran.stderr.splitlines()
    assert line.endswith("it is being stopped")
