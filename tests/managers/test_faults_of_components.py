"""Components, pipes and robots: whose fault a failure is, and what fails again and again."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, Components, LoadComponent, LoadRobot, Pipe, Pipes, Pool, Robots, Share
from support import Calls, eventually, kill, wait_respawned
from support_programs import CrampedPrograms, running_programs

Start = Callable[..., rr.System]

LIMIT_S = 30.0
RUNS = "import time; print('ready', flush=True); time.sleep(600)"  # and costs nothing
REQUESTS: dict[str, Any] = {
    "components/component": LoadComponent("camera"),
    "components/pipe": Pipe("image"),
    "robots/robot": LoadRobot("rover"),
}


class Lingering:
    """What a manager does at a stop takes a while, in which its callbacks could end."""

    def on_stop(self) -> None:
        super().on_stop()  # type: ignore[misc]
        time.sleep(0.2)


class LingeringComponents(Lingering, Components):
    pass


class LingeringPipes(Lingering, Pipes):
    pass


def camera(name: str, code: str = "", **more: object) -> str:
    """Return the entry of a camera whose program runs for ever, and costs 70 W, or runs `code`."""
    program = code or RUNS
    lines = [f"{key} = {value}" for key, value in more.items()]
    return "\n".join(
        [
            "[[component]]",
            f'name = "{name}"',
            'type = "camera"',
            'outputs = ["image"]',
            *lines,
            "[component.program]",
            'command = "${python}"',
            f'arguments = ["-c", """{program}""", "{name}"]',
            'ready = { line = "ready" }',
            f"cost = {{ watts = {0 if code else 70} }}",
            "",
        ]
    )


@pytest.fixture(params=[*REQUESTS])
def served(request: pytest.FixtureRequest, start: Start, tmp_path: Path) -> Callable[..., tuple[rr.System, Any]]:
    """Start a system with these cameras; return it, and what loads one of them by the manager that is tested."""
    server: str = request.param

    def begin(*entries: str, replace: bool = True, lingers: bool = False) -> tuple[rr.System, Any]:
        text = "\n".join(entries)
        if server == "components/pipe":
            kind = LingeringPipes if lingers else Pipes
        else:
            kind = LingeringComponents if lingers else Components
            text = text.replace('outputs = ["image"]\n', "")
        (tmp_path / "cameras.toml").write_text(text)
        (tmp_path / "robots.toml").write_text('[[robot]]\nname = "rover"\ndriver = { type = "camera" }\n')
        system = start(
            rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],)),
            rr.ChildSpec(CrampedPrograms, id="programs", args=(str(tmp_path / "full"),)),
            rr.ChildSpec(kind, id="components", args=(str(tmp_path / "cameras.toml"),), kwargs={"replace": replace}),
            rr.ChildSpec(Robots, id="robots", args=(str(tmp_path / "robots.toml"),)),
        )
        app = system.open_registrar("app")

        def load(heard: Calls) -> rr.Query:
            return app.load(server, REQUESTS[server], on_status=heard, priority=1, timeout_s=LIMIT_S)

        return system, load

    return begin


def reliabilities(system: rr.System) -> dict[str, float]:
    """Return the reliability of each component that has lost some."""
    file = system.registrar("components").directory / "reliability.json"
    with contextlib.suppress(FileNotFoundError):
        return json.loads(file.read_text())["reliability"]
    return {}


def is_about_waits(status: rr.Status) -> bool:
    """Return whether a status is none that a slow machine adds, on which a program starts slowly."""
    return "another one is being started" not in status.message


def lives_shortly(starts: Path) -> str:
    return camera(
        "front", f"import time; open({str(starts)!r}, 'a').write('.'); print('ready', flush=True); time.sleep(0.3)"
    )


def test_one_that_ends_again_and_again_waits_longer_each_time_and_the_holders_hear_warning(
    served: Any, tmp_path: Path
) -> None:
    _, load = served(lives_shortly(tmp_path / "starts"))
    heard = Calls()
    load(heard)
    eventually(lambda: [one.state for one in heard if is_about_waits(one)].count(rr.State.WARNING) == 3, LIMIT_S)
    assert [status.state for status in heard if is_about_waits(status)] == [rr.State.UPDATE, rr.State.WARNING] * 3
    assert len((tmp_path / "starts").read_text()) == 4  # the first failure waits for 0.1 s alone
    waits = [
        status.message.partition(",")[0]
        for status in heard
        if is_about_waits(status) and status.state is rr.State.WARNING
    ]
    assert waits == [f"front is tried again in {seconds} s" for seconds in (0.2, 0.4, 0.8)]
    assert "exited with code 0" in heard.items[-1].message


def test_the_holders_hear_warning_while_the_next_one_takes_long_to_start(served: Any, tmp_path: Path) -> None:
    waits = f"import os, time\nwhile not os.path.exists({str(tmp_path / 'go')!r}): time.sleep(0.01)"
    slow = camera("rear", f"{waits}\nprint('ready', flush=True); time.sleep(600)", reliability=0.8)
    system, load = served(camera("front", reliability=0.9), slow)
    heard = Calls()
    query = load(heard)
    (program,) = system.registrar("programs").resources()
    os.kill(program.response.pid, signal.SIGKILL)
    (warning,) = heard.wait()
    assert warning.state is rr.State.WARNING
    assert warning.message.startswith("front has failed, and another one is being started: the program was ended by")
    assert query.state is rr.State.WARNING
    (tmp_path / "go").touch()
    heard.wait(2)
    assert [status.state for status in heard] == [rr.State.WARNING, rr.State.UPDATE]


@pytest.mark.parametrize("served", ["robots/robot"], indirect=True)
def test_a_robot_waits_for_its_part_also_if_its_components_are_not_replaced(served: Any, tmp_path: Path) -> None:
    _, load = served(lives_shortly(tmp_path / "starts"), replace=False)
    heard = Calls()
    load(heard)
    eventually(lambda: [one.state for one in heard if is_about_waits(one)].count(rr.State.WARNING) == 2, LIMIT_S)
    assert [status.state for status in heard if is_about_waits(status)] == [rr.State.UPDATE, rr.State.WARNING] * 2
    assert heard.items[-1].message.startswith("camera is tried again in 0.4 s, as it has failed repeatedly: ")


def test_one_that_gives_way_to_something_more_urgent_does_so_at_once_and_keeps_its_reliability(served: Any) -> None:
    system, load = served(camera("front", reliability=0.9), camera("rear", reliability=0.8))
    heard = Calls()
    load(heard)
    pump = system.registrar("robots").load("budgets/share", Share("watts", 60, instance="pump"), priority=9)
    (status,) = heard.wait()
    assert (status.state, status.reason) == (rr.State.FATAL, "revoked")
    assert pump.state is rr.State.OK
    assert reliabilities(system) == {}


def test_want_of_room_is_no_fault_of_a_component(served: Any) -> None:
    system, load = served(camera("front", reliability=0.9), camera("rear", reliability=0.8))
    system.registrar("robots").load("budgets/share", Share("watts", 60, instance="pump"), priority=9)
    with pytest.raises(rr.LoadFailed, match=r"asked 70, free 40 of 100"):
        load(Calls())
    assert reliabilities(system) == {}


def lose_it_on_a_full_disk(system: rr.System, heard: Calls, full: Path) -> rr.Status:
    """Have the disk of the programs full, end the program that runs, and return what the holders hear first."""
    (program,) = running_programs()
    full.touch()
    os.kill(program, signal.SIGKILL)
    (status,) = heard.wait()
    return status


def test_a_full_disk_is_no_fault_of_a_component_and_the_search_goes_on_until_there_is_room(
    served: Any, tmp_path: Path
) -> None:
    system, load = served(camera("front", RUNS, reliability=0.9), camera("rear", RUNS, reliability=0.8))
    heard = Calls()
    query = load(heard)
    status = lose_it_on_a_full_disk(system, heard, tmp_path / "full")
    assert status.state is rr.State.WARNING
    said = "no other one can be started now, and that is tried again: EDQUOT: the user's share of the disk is full: "
    assert status.message.startswith(said)
    (tmp_path / "full").unlink()
    eventually(lambda: heard.items[-1].state is rr.State.UPDATE, LIMIT_S)
    assert query.state is rr.State.UPDATE
    assert reliabilities(system) == {"front": 0.45}  # the one whose program was killed


def test_a_full_disk_fails_a_first_load_by_name_and_lowers_nothing(served: Any, tmp_path: Path) -> None:
    system, load = served(camera("front", RUNS, reliability=0.9), camera("rear", RUNS, reliability=0.8))
    (tmp_path / "full").touch()
    with pytest.raises(rr.LoadFailed, match="EDQUOT: the user's share of the disk is full") as failed:
        load(Calls())
    assert failed.value.wanted.startswith("EDQUOT")
    assert reliabilities(system) == {}
    (tmp_path / "full").unlink()
    assert load(Calls()).state is rr.State.OK


def test_what_waits_for_room_is_released_at_once(served: Any, tmp_path: Path) -> None:
    system, load = served(camera("front", RUNS, reliability=0.9))
    heard = Calls()
    query = load(heard)
    lose_it_on_a_full_disk(system, heard, tmp_path / "full")
    query.unload(timeout_s=LIMIT_S)
    eventually(lambda: not system.registrar("programs").resources(), LIMIT_S)


@pytest.mark.parametrize("orderly", [False, True])
def test_the_search_for_room_goes_on_in_the_next_process(served: Any, tmp_path: Path, orderly: bool) -> None:
    system, load = served(camera("front", RUNS, reliability=0.9), lingers=orderly)
    heard = Calls()
    query = load(heard)
    lose_it_on_a_full_disk(system, heard, tmp_path / "full")
    if orderly:
        system.supervisor().terminate_child("components")
        system.supervisor().restart_child("components")
    else:
        wait_respawned(system, "components", kill(system, "components"))
    (tmp_path / "full").unlink()
    eventually(lambda: query.state is rr.State.UPDATE, LIMIT_S)
    assert [status.state for status in heard if status.state is rr.State.FATAL] == []
