"""check_manager finds what a manager does wrong, shrinks it to a few steps, and prints a program that shows it."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

import rr_actors as rr
import support_planted as planted
from rr_actors.testing import (
    AskUsage,
    Fatal,
    Kill,
    Load,
    LoadTogether,
    ManagerFault,
    Pause,
    Reload,
    Resume,
    SendStatus,
    Step,
    Unload,
    UnloadTogether,
    Update,
    Wrong,
    check_manager,
    play_steps,
)
from support import REPOSITORY

DEVICES = st.sampled_from(["left", "right"])
FAST = {"callback_s": 2.0, "kills": 25}


def found(manager: type[rr.Manager], **options: Any) -> ManagerFault:
    with pytest.raises(ManagerFault) as fault:
        check_manager(manager, DEVICES, **{**FAST, "limit_s": 150, **options})
    return fault.value


def kinds(fault: ManagerFault) -> list[type[Step]]:
    """The kinds of the steps. A step that kills in its callback counts as a Kill, if the callback itself is right."""
    return [Kill if getattr(step, "kill_at", None) is not None else type(step) for step in fault.steps]


@pytest.mark.timeout(200)
@pytest.mark.parametrize(
    ("manager", "promise", "steps"),
    [
        (planted.ClosesTwice, "each open is closed once", [Load]),
        (planted.KeepsOpenAfterACrash, "nothing is left when nothing is loaded", [Load, Kill]),
        (planted.InventsAResponse, "after a crash, recover gives the same or says lost", [Load, Kill]),
        pytest.param(
            planted.InventsAPort,
            "after a crash, recover gives the same or says lost",
            [Load, Kill],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            planted.SharesAKey, "two resources of one request do not share a key", [Load, Fatal], marks=pytest.mark.slow
        ),
        pytest.param(planted.Blocks, "no callback takes longer than its limit", [Load, Kill], marks=pytest.mark.slow),
        (planted.CountsByItself, "callbacks that run at the same time do not race for an attribute", [LoadTogether]),
        pytest.param(
            planted.OpensTwice,
            "callbacks that run at the same time do not race for an attribute",
            [LoadTogether],
            marks=pytest.mark.slow,
        ),
        (planted.TakesAnything, "a wrong request is refused", [Wrong]),
        pytest.param(
            planted.FailsAfterACrash,
            "a request that loads in a fresh manager always loads",
            [Kill],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            planted.LeavesThreads, "nothing is left when nothing is loaded", [Load, Fatal], marks=pytest.mark.slow
        ),
        pytest.param(
            planted.RaisesInStatus,
            "no callback but load and recover raises",
            [Load, SendStatus],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            planted.DiesByItself,
            "the manager's process dies by the check alone",
            [Load, SendStatus],
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_a_planted_fault_is_found_and_shrunk(manager: type[rr.Manager], promise: str, steps: list[type[Step]]) -> None:
    fault = found(manager)

    assert (fault.promise, kinds(fault)) == (promise, steps)
    assert promise in str(fault)
    ast.parse(fault.program)


@pytest.mark.parametrize(
    ("manager", "requests"),
    [
        (planted.Ports, DEVICES),
        (planted.Supplies, DEVICES),
        (planted.CountsWithALock, DEVICES),
        (planted.CountsSerially, DEVICES),
        (
            rr.ChildSpec(planted.Lamps, id="lamps"),
            {"lamp": st.builds(dict, room=DEVICES, bright=st.booleans()), "scene": DEVICES},
        ),
    ],
    ids=["ports", "supplies", "lock", "serial", "lamps"],
)
@pytest.mark.timeout(120)
def test_a_good_manager_passes(manager: Any, requests: Any) -> None:
    lines: list[str] = []
    done = check_manager(manager, requests, kills=4, limit_s=60, progress=lines.append)

    assert done.kills >= 4
    assert done.loads >= done.scenarios / 2
    assert done.seconds < 65
    assert all("of 4 kills" in line for line in lines)


def test_each_step_runs_its_callback_and_may_kill_in_it() -> None:
    lamp = {"room": "hall"}
    play_steps(
        rr.ChildSpec(planted.Lamps, id="lamps"),
        [
            Load("lamp", lamp, kill_at=0),
            Load("lamp", lamp),
            Pause(kill_at=0),
            Resume(kill_at=0),
            AskUsage(kill_at=0),
            Update(),
            Kill(),
            Reload(),
            Load("scene", "day", kill_at=1),
            Kill(kill_at=0),
            SendStatus(2, "ERROR"),
            Fatal(2),
            Wrong("scene", 3),
            Unload(0),
            Unload(0, kill_at=0),
            LoadTogether("lamp", (lamp, {"room": "attic"}, {"room": "attic"})),
            UnloadTogether(),
        ],
    )


def test_without_kills_none_is_made() -> None:
    assert check_manager(planted.Ports, DEVICES, kills=0, limit_s=20).kills == 0


def test_a_program_ends_with_the_fault_that_it_is_of(tmp_path: Path) -> None:
    with pytest.raises(ManagerFault) as fault:
        play_steps(planted.FailsAfterACrash, [Load("lock", "a", kill_at=2)])
    (tmp_path / "shown.py").write_text(fault.value.program)

    env = {**os.environ, "PYTHONPATH": str(REPOSITORY)}  # the program itself says where the manager's module is
    ran = subprocess.run(
        [sys.executable, "shown.py"], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=50
    )

    assert ran.returncode == 1
    assert "FileExistsError" in ran.stderr
    assert ".take_lock" not in fault.value.program
    assert "Load('lock', 'a', kill_at=2)" in fault.value.program


SCRIPT = '''
import rr_actors as rr
from rr_actors.testing import Load, ManagerFault, Unload, play_steps

def made():
    class Shelf(rr.Manager):
        """It is in no module."""
        @rr.server("book")
        def take(self, title: str) -> str:
            return title
        @take.unload
        def put_back(self, title: str, response: str | None) -> None:
            raise OSError("the shelf is full")
    return Shelf

class Desk(rr.Manager):
    @rr.server("book")
    def take(self, title: str) -> str:
        return title
    @take.unload
    def put_back(self, title: str, response: str | None) -> None:
        raise OSError("the desk is full")

if __name__ == "__main__":
    for number, cls in enumerate((made(), Desk)):
        try:
            play_steps(cls, [Load("book", "a")])
        except ManagerFault as fault:
            open(f"program{number}.py", "w").write(fault.program)
'''


def test_managers_of_a_script_and_of_a_function_are_checked_and_their_programs_run(tmp_path: Path) -> None:
    (tmp_path / "library.py").write_text(SCRIPT)
    ran = subprocess.run([sys.executable, "library.py"], cwd=tmp_path, capture_output=True, text=True, timeout=50)
    assert (ran.returncode, ran.stderr) == (0, "")

    for number, words in enumerate(("the shelf is full", "the desk is full")):
        program = [sys.executable, f"program{number}.py"]
        again = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=50)
        assert again.returncode == 1
        assert words in again.stderr


def test_after_a_check_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    threads = set(threading.enumerate())
    with pytest.raises(ManagerFault):
        play_steps(planted.Blocks, [Load("port", "a"), Unload(kill_at=0)], callback_s=0.5)
    check_manager(planted.Ports, DEVICES, kills=1, limit_s=20)

    assert list(tmp_path.iterdir()) == []
    assert [thread for thread in set(threading.enumerate()) - threads if not thread.name.startswith("rr-")] == []
    assert "RR_ACTORS_TEST" not in os.environ


class NoServers(rr.Manager):
    pass


class NeedsAPlace(planted.Ports):
    def __init__(self, place: str) -> None:
        super().__init__()
        self.place = place


class TakesTheLock(planted.Ports):
    def __init__(self, lock: Any) -> None:
        super().__init__()


@pytest.mark.parametrize(
    ("manager", "requests", "options", "words"),
    [
        (dict, DEVICES, {}, ["manager: expected a class of rr.Manager", "dict"]),
        (planted.Ports(), DEVICES, {}, ["manager: expected a class of rr.Manager", "got", "Ports"]),
        (rr.ChildSpec(rr.Actor, id="a"), DEVICES, {}, ["manager: expected a class of rr.Manager", "Actor"]),
        (NoServers, DEVICES, {}, ["NoServers: expected a manager with a server", "got none"]),
        (NeedsAPlace, DEVICES, {}, ["NeedsAPlace: expected a manager that starts", "place"]),
        (
            rr.ChildSpec(TakesTheLock, id="a", args=(threading.Lock(),)),
            DEVICES,
            {},
            ["TakesTheLock: expected a manager that can travel to another process", "lock", "args"],
        ),
        (planted.Lamps, DEVICES, {}, ["requests: expected a dict", "lamp, scene", "2 servers"]),
        (planted.Ports, {"prot": DEVICES}, {}, ["requests: expected one of its servers (port)", "'prot'", "port"]),
        (planted.Ports, {"port": ["a"]}, {}, ["requests: port: expected a strategy of Hypothesis", "['a']"]),
        (planted.Ports, ["a"], {}, ["requests: expected a strategy of Hypothesis", "['a']"]),
        (planted.Ports, {}, {}, ["requests: expected a strategy of Hypothesis", "{}"]),
        (planted.Ports, st.integers(), {}, ["expected requests that the manager loads", "refused all", "port"]),
        (planted.Ports, DEVICES, {"kills": -1}, ["kills: expected a whole number from 0 on, got -1"]),
        (planted.Ports, DEVICES, {"kills": True}, ["kills: expected a whole number from 0 on, got True"]),
        (planted.Ports, DEVICES, {"limit_s": 1e-9}, ["limit_s: expected time for a scenario"]),
        (planted.Ports, DEVICES, {"limit_s": 0}, ["limit_s: expected seconds greater than 0, got 0"]),
        (
            planted.Ports,
            DEVICES,
            {"callback_s": float("nan")},
            ["callback_s: expected seconds greater than 0, got nan"],
        ),
        (planted.Ports, DEVICES, {"same": 3}, ["same: expected a function of two responses, got 3"]),
        (planted.Ports, DEVICES, {"seed": "x"}, ["seed: expected a whole number, got 'x'"]),
        (planted.Ports, DEVICES, {"beside": [3]}, ["beside: expected a list of ChildSpecs and Supervisors, got 3"]),
        (planted.Ports, DEVICES, {"wrong": "x"}, ["wrong: expected a list of requests", "'x'"]),
    ],
)
def test_what_cannot_be_checked_is_refused_by_name(manager: Any, requests: Any, options: Any, words: list[str]) -> None:
    with pytest.raises(rr.UsageError) as refused:
        check_manager(manager, requests, **{"kills": 3, "limit_s": 30, **options})
    assert [word for word in ("check_manager", *words) if word not in str(refused.value)] == [], str(refused.value)


def test_steps_that_cannot_be_played_are_refused_by_name() -> None:
    with pytest.raises(rr.UsageError, match=r"steps: expected steps such as Load\(...\), got 'load'"):
        play_steps(planted.Ports, ["load"])  # pyright: ignore[reportArgumentType]
    with pytest.raises(rr.UsageError, match=r"expected one of its servers \(port\), got 'prot'; did you mean"):
        play_steps(planted.Ports, [Load("prot", "a")])
    with pytest.raises(rr.UsageError, match="expected a request that the manager loads, got"):
        play_steps(planted.Ports, [Load("port", 3)])


def test_without_hypothesis_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hypothesis.strategies", None)
    monkeypatch.setitem(sys.modules, "hypothesis", None)
    with pytest.raises(rr.UsageError, match=r"check_manager\(\) needs the library hypothesis.*pip install.*hypothesis"):
        check_manager(planted.Ports, DEVICES)


def test_requests_that_the_managers_own_code_refuses_may_be_named() -> None:
    fault = found(planted.Ports, wrong=["left"], kills=0)

    assert (fault.promise, fault.steps[-1]) == ("a wrong request is refused", Wrong("port", "left"))
