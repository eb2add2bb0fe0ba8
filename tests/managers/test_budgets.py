"""Budgets: shares of a pool, what gives way, and what a crash leaves."""

from __future__ import annotations

import contextlib
import json
import math
import re
import resource
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, OverCapacity, Pool, PoolInfo, Reserve, Share, Supply
from support import Calls, eventually, kill, pid_of, wait_respawned
from support_cli import run_cli

Start = Callable[..., rr.System]


class House:
    """A system with budgets, and devices and generators in this process. A device's request is (name, watts, wait)."""

    def __init__(self, start: Start, *pools: Pool, grace_s: float = 30.0) -> None:
        budgets = rr.ChildSpec(Budgets, id="budgets", args=(pools, grace_s))
        self.system = start(rr.Supervisor([budgets], max_restarts=100))
        self.app = self.system.open_registrar("app")
        self.devices = self.system.open_registrar("devices")
        self.ended = Calls()
        self.started = Calls()
        self.devices.register_server("device", self._load, self._unload)
        self.devices.register_server("generator", self._start, self._stop)

    def _load(self, request: Any) -> str:
        name, watts, wait_s = request
        self.devices.load("budgets/share", Share("watts", watts, wait_s), timeout_s=60)
        return name

    def _unload(self, request: Any, response: str | None) -> None:
        self.ended(request[0])

    def _start(self, request: float) -> str:
        if request < 0:
            raise OSError("no fuel")
        self.devices.load("budgets/supply", Supply("watts", request))
        self.started(request)
        return "runs"

    def _stop(self, request: float, response: str | None) -> None:
        self.ended(f"generator {request:g}")

    def run(self, name: str, watts: float, *, wait_s: float = 0.0, **options: Any) -> Any:
        return self.app.load("devices/device", (name, watts, wait_s), timeout_s=60, **options)

    def pool(self) -> PoolInfo:
        (pool,) = self.system.ref("budgets").proxy().pools().get()
        return pool

    def set_capacity(self, capacity: float) -> None:
        self.system.ref("budgets").proxy().set_capacity("watts", capacity).get()

    def respawn(self) -> None:
        wait_respawned(self.system, "budgets", kill(self.system, "budgets"))


@pytest.fixture
def house(start: Start) -> House:
    return House(start, Pool("watts", 100))


def test_the_command_line_shows_the_pools_and_a_question_that_is_none_is_refused(house: House) -> None:
    house.run("heater", 60)
    head, row, *rest = run_cli("budgets").stdout.splitlines()
    assert re.split("  +", head.strip()) == [
        *("pool", "used", "free", "by priority", "waiting", "who waits", "enforced", "problem")
    ]
    assert re.split("  +", row.strip()) == ["watts", "60 of 100 ██████░░░░", "40", "0: 60", "0", "no"]
    assert rest == []
    (pool,) = json.loads(run_cli("budgets", "--json").stdout)
    assert (pool["name"], pool["capacity"], pool["free"]) == ("watts", 100.0, 40.0)
    missing = run_cli("budgets", "--budgets", "wallet")
    assert (missing.returncode, "wallet" in missing.stderr) == (2, True)
    with pytest.raises(rr.UsageError, match="budgets: expected a question to Budgets, got 'what'"):
        house.system.ref("budgets").ask("what")


def test_the_list_of_pools_says_what_each_priority_has_and_who_waits(house: House) -> None:
    house.run("heater", 60, priority=2)
    lamp = house.run("lamp", 20)
    oven = house.run("oven", 40, wait_s=60, block=False)
    assert eventually(lambda: json.loads(run_cli("budgets", "--json").stdout)[0]["waiting"] == 1)
    (pool,) = json.loads(run_cli("budgets", "--json").stdout)
    assert pool["by_priority"] == {"2": 60.0, "0": 20.0}
    assert len(pool["who_waits"]) == 1
    assert "by priority 2: 60, 0: 20" in run_cli("plans", "--wide").stdout
    lamp.unload()
    assert oven.get(timeout=60).response == "oven"


def test_shares_are_admitted_while_they_fit_and_given_back(house: House) -> None:
    one, _ = house.run("heater", 60), house.run("lamp", 40)
    assert house.pool() == PoolInfo("watts", 100, 100, 0)
    one.unload()
    assert house.pool().used == 40
    house.run("oven", 60)


def test_equal_devices_have_a_share_each(house: House) -> None:
    house.run("left", 40)
    house.run("right", 40)
    assert house.pool().used == 80


def test_what_does_not_fit_is_refused_by_name(house: House) -> None:
    house.run("heater", 60)
    with pytest.raises(OverCapacity, match="pool 'watts': asked 50, free 40 of 100; held by devices") as raised:
        house.run("oven", 50)
    error = raised.value
    assert (error.pool, error.asked, error.free, error.holders) == ("watts", 50, 40, ("devices",))
    assert error.trace[0].origin == "budgets/share"
    with pytest.raises(OverCapacity):
        house.run("never", 101, wait_s=60)  # at once, as it can never fit
    assert house.pool() == PoolInfo("watts", 100, 60, 0)


WRONG: list[tuple[Any, str]] = [
    (Share("volts", 1), "no pool 'volts': expected one of watts"),
    (Share("watts", -1), "amount: expected a number of at least 0, got -1"),
    (Share("watts", 1, -1), "wait_s: expected a number of at least 0, got -1"),
    (Share("watts", math.inf), "amount"),
    (Share("watts", math.nan), "amount"),
    ({"pool": "watts", "amont": 1}, "amont"),
]


def test_what_is_wrong_is_refused_by_name(house: House) -> None:
    for share, why in WRONG:
        with pytest.raises(rr.RrError, match=why):
            house.app.load("budgets/share", share)
    wrong: list[Any] = [-1, math.nan, "60"]
    for capacity in wrong:
        with pytest.raises(rr.ConfigError, match="capacity: expected a number of at least 0"):
            house.set_capacity(capacity)
    for name, said in (("volts", "'volts'"), (["watts"], r"\['watts'\]")):
        with pytest.raises(rr.NotFound, match=f"no pool {said}: expected one of watts"):
            house.system.ref("budgets").proxy().set_capacity(name, 1).get()
    assert house.pool() == PoolInfo("watts", 100, 0, 0)


def test_who_waits_gets_room_when_others_give_theirs_back(house: House) -> None:
    heater = house.run("heater", 60)
    oven = house.run("oven", 50, wait_s=60, block=False)
    eventually(lambda: house.pool().waiting == 1)
    heater.unload()
    assert oven.get(timeout=30).response == "oven"


def test_a_load_that_waits_for_room_says_for_which_pool_and_how_much_is_free(house: House) -> None:
    heater = house.run("heater", 60)
    oven = house.run("oven", 50, wait_s=60, block=False)

    def said(*command: str) -> bool:
        return "pool 'watts': asked 50, free 40 of 100" in run_cli(*command, "--state", house.system.state_dir).stdout

    def share() -> str | None:
        infos = house.system.registrar("budgets").resources()
        return next((info.id for info in infos if info.phase == "loading"), None)

    id = eventually(share)
    assert id is not None
    assert eventually(lambda: said("why", id))
    assert said("resources")
    assert any(said("why", info.id) for info in house.devices.resources() if info.phase == "loading")
    heater.unload()
    oven.get(timeout=30)
    assert not said("resources")


def test_all_that_happens_for_want_of_room_is_told_by_name(house: House) -> None:
    heard = Calls()
    house.system.subscribe(lambda event: heard((event["event"], event.get("text") or event.get("detail", ""))))
    house.run("heater", 60, priority=1)
    oven = house.run("oven", 50, wait_s=60, priority=1, block=False)
    eventually(lambda: house.pool().waiting == 1)
    kettle = house.run("kettle", 60, wait_s=60, block=False)

    def because(what: str) -> str:
        rows = json.loads(run_cli("loads", "--json", "--state", house.system.state_dir).stdout)["waiting"]
        return next((row["said"] for row in rows if f'device ["{what}' in str(row["request"])), "")

    room = "waits for room in pool 'watts': asked"
    held = f'{room} 50, free 40 of 100; held by devices/device ["heater",60,0.0] (priority 1)'
    assert eventually(lambda: because("oven") == held)
    behind = f'{room} 60, free 40 of 100; behind devices/device ["oven",50,60] (priority 1)'
    assert eventually(lambda: because("kettle") == behind)

    pump = house.run("pump", 60, wait_s=60, priority=9)
    has = "has 60 of pool 'watts' after"
    assert eventually(lambda: any(event[0] == "progress" and event[1].startswith(has) for event in heard.items))
    why = """pool 'watts' has no room for it: devices/device ["pump",60,60] (priority 9) needs room"""
    assert ("revoked", why) in heard.items
    assert ("progress", held.removeprefix("0% ")) in heard.items
    house.set_capacity(50)
    less = ("revoked", "pool 'watts' has no room for it: its capacity is 50 now")
    assert eventually(lambda: less in heard.items)
    pump.wait_status("FATAL", timeout_s=20)
    assert oven.get(timeout=30).response == "oven"
    kettle.cancel()


def test_a_share_is_found_by_the_name_that_it_has_at_its_holder(house: House) -> None:
    query = house.app.load("budgets/share", {"pool": "watts", "amount": 5, "instance": "x"})
    (info,) = house.system.registrar("budgets").resources()
    assert info.request.amount == 5.0

    def why(name: str) -> str:
        ran = run_cli("why", name, "--state", house.system.state_dir)
        return ran.stdout + ran.stderr

    name = 'budgets/share {"amount":5,"instance":"x","pool":"watts"}'
    assert f"({query.resource_id[-8:]}) has been loaded" in why(name)
    assert "no query and no resource has this id" in why(name.replace("5", "6"))


def test_who_has_waited_long_enough_is_refused(house: House) -> None:
    house.run("heater", 60)
    with pytest.raises(OverCapacity):
        house.run("oven", 50, wait_s=0.3)
    assert house.pool() == PoolInfo("watts", 100, 60, 0)


def test_the_lowest_give_way_to_a_higher_priority(house: House) -> None:
    heard = Calls()
    for name, watts, priority in (("a", 20, 1), ("b", 20, 2), ("c", 60, 3)):
        house.run(name, watts, priority=priority, on_status=heard)
    house.run("urgent", 40, priority=9)
    assert sorted(house.ended.items) == ["a", "b"]
    assert {(status.state, status.reason) for status in heard.wait(2)} == {(rr.State.FATAL, "revoked")}
    assert house.pool() == PoolInfo("watts", 100, 100, 0)
    with pytest.raises(OverCapacity):
        house.run("equal", 10, priority=3)


def test_what_is_idle_gives_way_to_any_other(house: House) -> None:
    house.run("spare", 50, priority=-5)
    house.run("idle", 50).standby()
    eventually(lambda: None in [info.priority for info in house.system.registrar("budgets").resources()])
    house.run("lamp", 50, priority=-9)
    assert house.ended.items == ["idle"]


def test_a_priority_that_changes_makes_room(house: House) -> None:
    heater = house.run("heater", 60, priority=5)
    oven = house.run("oven", 60, wait_s=60, priority=4, block=False)
    eventually(lambda: house.pool().waiting == 1)
    heater.priority = 3
    assert oven.get(timeout=30).response == "oven"
    assert house.ended.items == ["heater"]


def test_a_load_that_is_withdrawn_waits_no_more(house: House) -> None:
    house.run("heater", 60)
    with pytest.raises(rr.LoadTimeout):
        house.app.load("budgets/share", Share("watts", 50, 600), timeout_s=0.5)
    assert eventually(lambda: house.pool() == PoolInfo("watts", 100, 60, 0))


def test_a_reserve_starts_before_anybody_gives_way_and_stops_when_it_is_not_needed(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/generator", 50, 50.0),)))
    house.run("heater", 100, priority=1)
    lamp = house.run("lamp", 50, priority=9)
    assert house.started.wait() == [50.0]
    assert house.pool() == PoolInfo("watts", 150, 150, 0)
    house.respawn()  # perhaps before the start of the reserve was noted: then it is started again
    assert eventually(lambda: house.pool() == PoolInfo("watts", 150, 150, 0))
    assert "heater" not in house.ended.items
    lamp.unload()
    eventually(lambda: "generator 50" in house.ended.items)
    assert eventually(lambda: house.pool() == PoolInfo("watts", 100, 100, 0))


def test_a_reserve_without_a_request_is_loaded_as_one_that_takes_none(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/battery", 50),)))

    def connect() -> None:
        house.devices.load("budgets/supply", Supply("watts", 50))

    house.devices.register_server("battery", connect)
    house.run("heater", 100, priority=1)
    house.run("lamp", 50, priority=9)
    assert house.pool() == PoolInfo("watts", 150, 150, 0)
    assert house.ended.items == []


def test_after_a_reserve_that_fails_others_give_way(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/generator", 50, -1.0),)))
    house.run("heater", 100, priority=1)
    house.run("lamp", 50, priority=9)
    assert house.ended.items == ["heater"]


def test_nobody_gives_way_in_vain_beside_a_reserve_that_fails(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/generator", 20, -1.0),)))
    house.run("heater", 30, priority=1)
    house.run("other", 70, priority=9)
    with pytest.raises(OverCapacity):
        house.run("lamp", 50, priority=9)
    assert house.ended.items == []


def test_what_is_over_the_capacity_does_not_wait_longer_than_its_grace_for_a_reserve(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/slow", 50),)), grace_s=0.5)
    begun, goes_on = Calls(), threading.Event()

    def start_slowly() -> None:
        begun("begun")
        goes_on.wait(60)

    house.devices.register_server("slow", start_slowly)
    house.run("heater", 50, priority=1)
    house.run("pump", 50, priority=9)
    house.set_capacity(60)
    begun.wait()
    assert eventually(lambda: house.ended.items == ["heater"])
    assert not goes_on.is_set()
    goes_on.set()


def test_a_reserve_that_is_lost_takes_its_supply_with_it(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/generator", 50, 50.0),)))
    house.run("heater", 100, priority=1)
    house.run("lamp", 50, priority=9)
    eventually(lambda: house.pool().used == 150)

    def loaded() -> list[rr.ResourceInfo]:
        return [info for info in house.devices.resources() if info.server == "generator" and info.phase == "loaded"]

    (generator,) = eventually(loaded)
    house.devices.send_status(generator, rr.Status(rr.State.FATAL, "it burns"))
    eventually(lambda: "heater" in house.ended.items)
    assert eventually(lambda: house.pool() == PoolInfo("watts", 100, 50, 0))


def test_a_capacity_that_falls_sheds_and_one_that_rises_restores_by_priority(house: House) -> None:
    for name, priority in (("a", 1), ("b", 2), ("c", 3)):
        house.run(name, 30, priority=priority)
    house.set_capacity(60)
    eventually(lambda: house.pool().used == 60)
    assert house.ended.items == ["a"]
    again = [house.run(f"{name} again", 30, wait_s=60, priority=p, block=False) for name, p in (("x", 0), ("a", 1))]
    eventually(lambda: house.pool().waiting == 2)
    house.set_capacity(100)
    assert again[1].get(timeout=30).response == "a again"
    assert house.pool() == PoolInfo("watts", 100, 90, 1)
    house.set_capacity(120)
    assert again[0].get(timeout=30).response == "x again"


def test_a_manager_that_is_killed_knows_all_shares_and_who_waits(house: House) -> None:
    house.set_capacity(80)
    heater = house.run("heater", 60)
    oven = house.run("oven", 50, wait_s=60, block=False)
    eventually(lambda: house.pool().waiting == 1)
    house.respawn()
    assert eventually(lambda: house.pool() == PoolInfo("watts", 80, 60, 1))
    with pytest.raises(OverCapacity):
        house.run("lamp", 30)
    heater.unload()
    assert oven.get(timeout=30).response == "oven"


def test_a_manager_that_is_killed_knows_its_supplies_before_their_server_is_there_again(house: House) -> None:
    house.app.load("devices/generator", 50.0)
    heater = house.run("heater", 150)
    oven = house.run("oven", 50, wait_s=60, block=False)
    eventually(lambda: house.pool().waiting == 1)
    house.respawn()  # the load of the oven's share runs again at once
    assert eventually(lambda: house.pool() == PoolInfo("watts", 150, 150, 1))
    heater.unload()
    assert oven.get(timeout=30).response == "oven"


def test_a_manager_that_is_killed_while_others_give_way_goes_on_and_takes_no_more(start: Start) -> None:
    house = House(start, Pool("watts", 100))
    goes_on, asked = threading.Event(), threading.Event()

    def holds_up(_status: rr.Status) -> None:
        asked.set()
        goes_on.wait(60)

    house.run("low", 50, priority=1, on_status=holds_up)
    house.run("other", 50, priority=2)
    urgent = house.run("urgent", 50, priority=9, block=False)
    assert asked.wait(30)
    house.respawn()
    assert house.pool().used == 100
    goes_on.set()
    assert urgent.get(timeout=30).response == "urgent"
    assert house.ended.items == ["low"]
    assert house.pool() == PoolInfo("watts", 100, 100, 0)


def test_the_sum_is_within_the_capacity_while_the_manager_is_killed_again_and_again(house: House) -> None:
    for round in range(5):
        loads = [house.run(f"{round}.{i}", 30, priority=i, wait_s=1, block=False) for i in range(6)]
        kill(house.system, "budgets")
        for load in loads:
            with contextlib.suppress(OverCapacity):
                load.get(timeout=60)
            assert house.pool().used <= 100
        assert eventually(lambda: len(house.devices.resources()) == house.pool().used / 30)


@contextlib.contextmanager
def no_file_grows(pid: int) -> Iterator[None]:
    """No file of the process can be longer than 600 bytes: its record fits, its journal is longer."""
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (600, before[1]))
    yield
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


def test_what_is_to_give_way_does_so_when_a_full_disk_has_room(house: House, caplog: pytest.LogCaptureFixture) -> None:
    house.run("a", 60)
    house.run("b", 30, priority=1)
    pid = pid_of(house.system, "budgets")
    log = house.system.state_dir / "budgets" / "catalog.journal.1"
    assert log.stat().st_size > 600
    with no_file_grows(pid):
        house.set_capacity(50)
        eventually(lambda: "not committed" in caplog.text)
        assert house.pool().used == 90
    assert house.ended.wait(1) == ["a"]
    eventually(lambda: house.pool().used == 30)
    assert pid_of(house.system, "budgets") == pid


def test_a_capacity_that_a_full_disk_refuses_holds_and_is_written_when_there_is_room(house: House) -> None:
    record = house.system.state_dir / "budgets" / "budgets.json"
    pid = pid_of(house.system, "budgets")
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, before[1]))
    house.set_capacity(50)
    assert house.pool().capacity == 50
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    assert eventually(lambda: record.exists() and "50" in record.read_text())
    wait_respawned(house.system, "budgets", kill(house.system, "budgets"))
    assert house.pool().capacity == 50


def test_a_reserve_that_is_not_needed_stops_when_a_full_disk_has_room(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/generator", 50, 50.0),)))
    house.run("a", 90)
    house.run("b", 40, wait_s=30)
    assert house.started.wait(1) == [50.0]
    with no_file_grows(pid_of(house.system, "budgets")):
        house.set_capacity(200)
        eventually(lambda: "not committed" in caplog.text)
    assert house.ended.wait(1) == ["generator 50"]
    eventually(lambda: house.pool().capacity == 200)


def test_a_file_that_is_wrong_fails_the_start_by_name(start: Start, tmp_path: Path) -> None:
    (tmp_path / "pools.toml").write_text('[[pool]]\nname = "watts"\ncapcity = 100\n')
    with pytest.raises(rr.StartFailed, match=r"pools.toml: pool\[0\].capcity: expected one of name, capacity"):
        start(rr.ChildSpec(Budgets, id="budgets", args=(str(tmp_path / "pools.toml"),)))


def test_a_capacity_that_was_set_holds_until_the_file_says_something_else_and_never_comes_back(
    start: Start, tmp_path: Path
) -> None:
    file = tmp_path / "pools.toml"

    def says(capacity: int) -> None:
        file.write_text(f'[[pool]]\nname = "watts"\ncapacity = {capacity}\n')

    says(100)
    system = start(rr.Supervisor([rr.ChildSpec(Budgets, id="budgets", args=(str(file),))], max_restarts=100))
    budgets = system.ref("budgets").proxy()
    budgets.set_capacity("watts", 60).get()
    for capacity, holds in ((100, 60), (80, 80), (100, 100)):
        says(capacity)
        system.supervisor().terminate_child("budgets")
        system.supervisor().restart_child("budgets")
        assert budgets.pools().get()[0].capacity == holds
        says(7)  # nobody asks for the file to be read
        wait_respawned(system, "budgets", kill(system, "budgets"))
        assert eventually(lambda holds=holds: budgets.pools().get()[0].capacity == holds)


def test_what_a_lost_generator_gives_counts_no_more(house: House) -> None:
    house.app.load("devices/generator", 50.0)
    assert house.pool().capacity == 150
    (generator,) = house.devices.resources()
    house.devices.send_status(generator, rr.Status(rr.State.FATAL, "out of diesel"))
    assert eventually(lambda: house.pool().capacity == 100)


def test_what_an_idle_generator_gives_counts_when_it_is_needed_again(house: House) -> None:
    generator = house.app.load("devices/generator", 50.0)
    generator.standby()
    assert eventually(lambda: house.pool().capacity == 100)
    generator.priority = 3
    assert eventually(lambda: house.pool().capacity == 150)


def test_a_reserve_is_as_urgent_as_what_it_was_started_for(start: Start) -> None:
    house = House(start, Pool("watts", 50, reserve=(Reserve("devices/generator", 60, 60.0),)))
    pump = house.run("pump", 100, priority=9)

    def priorities() -> list[int | None]:
        return [info.priority for info in house.devices.resources() if info.server == "generator"]

    assert eventually(lambda: priorities() == [9])
    pump.priority = 4
    assert eventually(lambda: priorities() == [4])


def test_a_patient_share_is_not_refused_for_a_reserve_that_has_failed_once(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/choking", 50),)))
    tries = Calls()

    def choke() -> None:
        tries("try")
        if len(tries.items) == 1:
            raise OSError("choked")
        house.devices.load("budgets/supply", Supply("watts", 50))

    house.devices.register_server("choking", choke)
    assert house.run("oven", 140, wait_s=50).response == "oven"


def test_a_refusal_names_the_reserve_that_could_not_be_loaded(start: Start) -> None:
    house = House(start, Pool("watts", 100, reserve=(Reserve("devices/generator", 50, -1.0),)))
    with pytest.raises(OverCapacity, match=r"reserve devices/generator cannot be loaded: .*no fuel"):
        house.run("oven", 140)


def test_shares_that_are_no_parts_are_a_share_each(house: House) -> None:
    house.app.load("budgets/share", Share("watts", 60))
    with pytest.raises(OverCapacity):
        house.devices.load("budgets/share", Share("watts", 60))
    house.app.load("budgets/share", {"pool": "watts", "amount": 20})
    house.devices.load("budgets/share", {"pool": "watts", "amount": 20})
    assert house.pool().used == 100


def test_a_grace_without_an_end_is_one(start: Start) -> None:
    house = House(start, Pool("watts", 100), grace_s=1e9)
    house.run("heater", 60, priority=1)
    house.run("pump", 60, priority=9)
    assert house.ended.items == ["heater"]
