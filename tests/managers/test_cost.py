"""cost= of @rr.server: what a server's resources hold of pools, without a line in the load callback."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, Components, LoadComponent, OverCapacity, Pool, Programs, RunProgram
from rr_actors.runtime.processes.control_groups import ControlGroups
from support import LIMIT_S, eventually, kill, wait_respawned

Start = Callable[..., rr.System]


def by_name(name: str, watts: float) -> dict[str, float]:
    return {"watts": watts, "lanes": 1}


def nonsense(request: str) -> Any:
    return {"watts": -1} if request == "negative" else [request]


class Devices(rr.Manager):
    @rr.server("lamp", cost={"watts": 20})
    def light(self, request: str) -> str:
        if request == "broken":
            raise OSError("no bulb")
        return f"{request} is lit"

    @rr.server("oven", cost=by_name)
    def heat(self, name: str, watts: float) -> str:
        return f"{name} at {watts:g} W"

    @rr.server("fan", cost=lambda request: {"watts": 30})
    async def turn(self, request: str) -> str:
        return f"{request} turns"

    @rr.server("odd", cost=nonsense)
    def odd(self, request: str) -> str:
        return request

    @rr.server("elsewhere", cost={"watts": 1}, cost_from="nobody")
    def elsewhere(self, request: str) -> str:
        return request


@pytest.fixture
def system(start: Start) -> rr.System:
    budgets = rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100), Pool("lanes", 1)],))
    return start(budgets, rr.ChildSpec(Devices, id="devices"))


@pytest.fixture
def app(system: rr.System) -> rr.Registrar:
    return system.open_registrar("app")


def used(system: rr.System) -> dict[str, float]:
    return {pool.name: pool.used for pool in system.ref("budgets").proxy().pools().get()}


def test_each_resource_holds_a_share_of_its_own(system: rr.System, app: rr.Registrar) -> None:
    one, two = app.load("devices/lamp", "one"), app.load("devices/lamp", "two")
    assert (one.response, two.response) == ("one is lit", "two is lit")
    assert used(system) == {"watts": 40, "lanes": 0}
    one.unload()
    assert eventually(lambda: used(system) == {"watts": 20, "lanes": 0})


def test_a_function_takes_what_the_load_callback_takes(system: rr.System, app: rr.Registrar) -> None:
    assert app.load("devices/oven", {"name": "big", "watts": 60}).response == "big at 60 W"
    assert used(system) == {"watts": 60, "lanes": 1}
    with pytest.raises(OverCapacity) as caught:
        app.load("devices/oven", {"name": "second", "watts": 10})
    assert (caught.value.pool, caught.value.free) == ("lanes", 0)
    assert used(system) == {"watts": 60, "lanes": 1}


def test_a_coroutine_waits_for_its_share(system: rr.System, app: rr.Registrar) -> None:
    assert app.load("devices/fan", "small").response == "small turns"
    assert used(system) == {"watts": 30, "lanes": 0}


def test_a_load_that_fails_gives_its_share_back(system: rr.System, app: rr.Registrar) -> None:
    with pytest.raises(rr.LoadFailed, match="no bulb"):
        app.load("devices/lamp", "broken")
    assert eventually(lambda: used(system) == {"watts": 0, "lanes": 0})


def test_a_share_gives_way_to_a_higher_priority(system: rr.System, app: rr.Registrar) -> None:
    low = app.load("devices/oven", {"name": "low", "watts": 90}, priority=1)
    app.load("devices/lamp", "needed", priority=9)
    assert low.wait_status("FATAL", timeout_s=20).reason == "revoked"
    assert used(system) == {"watts": 20, "lanes": 0}


def test_a_share_is_there_once_after_a_crash(system: rr.System, app: rr.Registrar) -> None:
    app.load("devices/lamp", "one")
    pid = kill(system, "devices")
    wait_respawned(system, "devices", pid)
    assert app.load("devices/lamp", "two").response == "two is lit"
    assert used(system) == {"watts": 40, "lanes": 0}


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ("negative", r"server 'odd': cost of 'watts': expected a number of at least 0, got -1"),
        ("list", r"server 'odd': cost: expected a dict of pools and the amounts of them, .*, got \['list'\] \(list\)"),
    ],
)
def test_a_function_that_returns_nonsense_is_named(
    system: rr.System, app: rr.Registrar, request_: str, said: str
) -> None:
    with pytest.raises(rr.LoadFailed, match=said):
        app.load("devices/odd", request_)
    assert used(system) == {"watts": 0, "lanes": 0}


def test_a_child_that_there_is_not_is_named(app: rr.Registrar) -> None:
    with pytest.raises(rr.RrError, match="nobody"):
        app.load("devices/elsewhere", "x", timeout_s=20)


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"cost": {"watts": -4}}, rr.InvalidSpec, r"server 'lamp': cost of 'watts': expected a number of at least 0"),
        ({"cost": {"watts": float("nan")}}, rr.InvalidSpec, "cost of 'watts': expected a number .*, got nan"),
        ({"cost": {"watts": "4"}}, rr.InvalidSpec, "cost of 'watts': expected a number of at least 0, got '4'"),
        ({"cost": {"a/b": 4}}, rr.InvalidName, "server 'lamp': cost: pool 'a/b'"),
        ({"cost": 4}, rr.InvalidSpec, r"server 'lamp': cost: expected a dict .*, got 4 \(int\)"),
        ({"cost": {"watts": 4}, "cost_from": "a/b"}, rr.InvalidName, "cost_from 'a/b'"),
    ],
)
def test_a_wrong_cost_is_refused_at_once(options: dict[str, Any], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        rr.server("lamp", **options)


def test_a_program_costs_what_its_request_says_and_a_pool_says_whether_it_is_enforced(start: Start) -> None:
    pools = [Pool("watts", 100), Pool("cpu", 2), Pool("memory_bytes", 1e9)]
    budgets = rr.ChildSpec(Budgets, id="budgets", args=(pools,))
    system = start(budgets, rr.ChildSpec(Programs, id="programs"))
    app = system.open_registrar("app")
    cost = {"watts": 30, "cpu": 0.5, "memory_bytes": 2e8}
    program = app.load("programs/program", RunProgram("sleep", ("1000",), cost=cost))
    assert used(system) == cost
    enforced = {pool.name for pool in system.ref("budgets").proxy().pools().get() if pool.enforced}
    assert enforced == {*ControlGroups.of_this_process().limits()}
    with pytest.raises(OverCapacity, match="pool 'cpu': asked 4"):
        app.load("programs/program", RunProgram("sleep", ("1000",), cost={"cpu": 4}))
    with pytest.raises(rr.LoadFailed, match="cost of 'cpu'"):
        app.load("programs/program", RunProgram("sleep", ("1000",), cost={"cpu": -1}))
    program.unload()
    assert eventually(lambda: used(system) == dict.fromkeys(cost, 0.0))


def test_programs_pay_to_the_budgets_that_they_are_given(start: Start) -> None:
    power = rr.ChildSpec(Budgets, id="power", args=([Pool("watts", 100)],))
    system = start(power, rr.ChildSpec(Programs, id="programs", kwargs={"cost_from": "power"}))
    app = system.open_registrar("app")
    app.load("programs/program", RunProgram("sleep", ("1000",), cost={"watts": 30}))
    assert system.ref("power").proxy().pools().get()[0].used == 30
    with pytest.raises(OverCapacity, match="pool 'watts': asked 80, free 70 of 100"):
        app.load("programs/program", RunProgram("sleep", ("1001",), cost={"watts": 80}))
    with pytest.raises(rr.InvalidName, match="cost_from"):
        Programs(cost_from="power/share")


COMPONENTS = """
[[component]]
name = "front"
type = "camera"
reliability = 0.9
program = { command = "sleep", arguments = ["600"], cost = { watts = 70 } }

[[component]]
name = "rear"
type = "camera"
program = { command = "sleep", arguments = ["601"], cost = { watts = 70 } }
reliability = 0.8
"""


def test_the_next_component_begins_when_the_failed_one_has_let_its_share_go(start: Start, tmp_path: Path) -> None:
    (tmp_path / "components.toml").write_text(COMPONENTS)
    system = start(
        rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],), kwargs={"grace_s": 600.0}),
        rr.ChildSpec(Programs, id="programs", kwargs={"cost_from": "budgets"}),
        rr.ChildSpec(Components, id="components", args=(str(tmp_path / "components.toml"),)),
    )
    camera = system.open_registrar("app").load("components/component", LoadComponent("camera"))
    os.kill(camera.response.pid, signal.SIGKILL)
    assert camera.wait_status("UPDATE", timeout_s=LIMIT_S)
    assert camera.response.name == "rear"
