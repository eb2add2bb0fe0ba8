"""Measured capacities: how they follow a probe, and what a probe may do wrong."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.base.errors import ConfigError
from rr_actors.managers import Budgets, Measure, Pool, PoolInfo, Share, Sink
from rr_actors.managers.budgets.gauge import Gauge
from rr_actors.managers.budgets.measures import next_capacity, surplus
from rr_actors.managers.planning.probes import NoProbe, probe_of
from support import Calls, eventually, kill, wait_respawned

Start = Callable[..., rr.System]


def no_probe() -> float:
    raise AssertionError("nobody asks it")


HERTZ = Measure(no_probe, shed_at=49.0, restore_at=49.8, step=20)
PRESSURE = Measure(no_probe, shed_at=60, restore_at=30, step=20)
DIRECT = Measure(no_probe, step=5)


@pytest.mark.parametrize(
    ("measure", "before", "readings", "capacities"),
    [
        (DIRECT, 100, (80, 84, 85, 86, 85, 200, -3), (80, 80, 80, 86, 85, 100, 0)),
        (Measure(no_probe), 100, (80, 81, 80), (80, 81, 80)),
        (HERTZ, 100, (50, 49.4, 49, 48, 49.4, 49.8, 50, 50), (100, 100, 80, 60, 60, 80, 100, 100)),
        (HERTZ, 30, (48, 48, 48), (10, 0, 0)),
        (PRESSURE, 100, (10, 45, 60, 90, 45, 30, 5, 0), (100, 100, 80, 60, 60, 80, 100, 100)),
    ],
)
def test_the_capacity_follows_the_readings(
    measure: Measure, before: float, readings: tuple[float, ...], capacities: tuple[float, ...]
) -> None:
    found: list[float] = []
    for reading in readings:
        before = next_capacity(measure, 100, before, reading)
        found.append(before)
    assert found == list(capacities)


@given(st.lists(st.floats(60, 64.9), min_size=1))
def test_readings_that_waver_by_less_than_a_step_only_lower_the_capacity(readings: list[float]) -> None:
    capacity = 100.0
    for reading in readings:
        assert next_capacity(DIRECT, 100, capacity, reading) <= capacity
        capacity = next_capacity(DIRECT, 100, capacity, reading)
    assert capacity == min(readings)


@given(st.sampled_from([DIRECT, HERTZ, PRESSURE]), st.floats(0, 100), st.floats(0, 1e9), st.floats(-1e9, 1e9))
def test_a_capacity_is_between_nothing_and_the_most(
    measure: Measure, most: float, before: float, reading: float
) -> None:
    assert 0 <= next_capacity(measure, most, before, reading) <= most


def test_a_pressure_is_read_from_the_kernels_files(tmp_path: Path) -> None:
    (tmp_path / "cpu").write_text("some avg10=12.50 avg60=1.00 avg300=0.10 total=7\nfull avg10=0.00 avg60=0.00\n")
    assert probe_of("psi:cpu", tmp_path)() == 12.5
    with pytest.raises(NoProbe, match=r"expected a kernel that measures its pressure: Linux 4\.20 or later.*got .*/io"):
        probe_of("psi:io", tmp_path)


class Told:
    """A probe that returns what the test sets, and what its gauge says of it."""

    def __init__(self) -> None:
        self.now: Callable[[], object] = lambda: 1
        self.readings, self.problems, self.begun = Calls(), Calls(), Calls()
        measure = Measure(self.probe, every_s=0.01, timeout_s=0.05)
        self.gauge = Gauge(measure, self.probe, self.readings, self.problems)

    def probe(self) -> float:
        self.begun("begun")
        return self.now()  # type: ignore[return-value]


@pytest.fixture
def told() -> Iterator[Told]:
    told = Told()
    yield told
    told.gauge.stop()


def test_a_gauge_says_what_a_probe_reads_and_what_is_wrong_with_it(told: Told) -> None:
    def fails() -> float:
        raise OSError("no battery")

    told.gauge.start()
    assert eventually(lambda: 1.0 in told.readings.items)
    told.now = fails
    assert eventually(lambda: "raised OSError: no battery" in told.problems.items)
    told.now = lambda: "much"
    assert eventually(lambda: "returned 'much', not a finite number" in told.problems.items)
    told.now = lambda: 2
    assert eventually(lambda: 2.0 in told.readings.items)


def test_a_probe_that_raises_what_is_no_exception_is_asked_again(told: Told) -> None:
    def cancelled() -> float:
        raise asyncio.CancelledError

    told.now = cancelled
    told.gauge.start()
    assert eventually(lambda: "raised CancelledError: " in told.problems.items)
    told.now = lambda: 2
    assert eventually(lambda: 2.0 in told.readings.items)


def test_a_probe_that_hangs_is_named_and_is_not_begun_again_until_it_has_returned(told: Told) -> None:
    goes_on = threading.Event()

    def hangs() -> float:
        goes_on.wait(60)
        return 3

    told.now = hangs
    told.gauge.start()
    assert eventually(lambda: "has not returned within 0.05 s" in told.problems.items)
    assert (len(told.begun.items), told.readings.items) == (1, [])
    goes_on.set()
    assert eventually(lambda: 3.0 in told.readings.items)


def test_a_gauge_stops_while_its_probe_hangs(told: Told) -> None:
    goes_on = threading.Event()
    told.now = lambda: goes_on.wait(60)
    told.gauge.start()
    eventually(lambda: told.begun.items)
    told.gauge.stop()
    goes_on.set()
    assert (len(told.begun.items), told.readings.items) == (1, [])


def battery() -> float:
    """Read how many watts the battery has, from a file beside the test."""
    return float(Path("battery").read_text())


def test_a_pool_follows_its_probe_keeps_the_last_value_and_knows_it_after_a_crash(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "battery"
    file.write_text("80")
    pool = Pool("watts", 100, measure=Measure(battery, every_s=0.02))
    system = start(rr.Supervisor([rr.ChildSpec(Budgets, id="budgets", args=([pool],))], max_restarts=9))
    app, budgets = system.open_registrar("app"), system.ref("budgets").proxy()

    def info() -> PoolInfo:
        (found,) = budgets.pools().get()
        return found

    eventually(lambda: info().capacity == 80)
    low = app.load("budgets/share", Share("watts", 40), priority=1)
    app.load("budgets/share", Share("watts", 30, instance="other"), priority=2)
    file.write_text("50")
    low.wait_status("FATAL", timeout_s=60)
    assert eventually(lambda: info() == PoolInfo("watts", 50, 30, 0))
    file.write_text("empty")
    assert "raised ValueError" in eventually(lambda: info().problem)
    assert info().capacity == 50
    wait_respawned(system, "budgets", kill(system, "budgets"))
    assert "raised ValueError" in eventually(lambda: info().problem)
    assert info().capacity == 50
    file.write_text("70")
    assert eventually(lambda: info() == PoolInfo("watts", 70, 30, 0))


# -- too much ----------------------------------------------------------------------------------------------------------

GRID = Measure(no_probe, shed_at=49.0, restore_at=49.8, step=20, settled_at=50.2, surplus_at=50.5)
FULL = Measure(no_probe, surplus_at=5.0, settled_at=20.0)  # small readings say that there is too much


@pytest.mark.parametrize(
    ("measure", "readings", "said"),
    [
        (GRID, (48, 50, 50.2, 50.3, 50.5, 51), (-1, -1, -1, 0, 1, 1)),
        (FULL, (30, 20, 10, 5, 0), (-1, -1, 0, 1, 1)),
        (HERTZ, (48, 51, 60), (0, 0, 0)),
    ],
)
def test_a_reading_says_whether_there_is_too_much(
    measure: Measure, readings: tuple[float, ...], said: tuple[int, ...]
) -> None:
    assert tuple(surplus(measure, reading) for reading in readings) == said


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"surplus_at": 50.5}, "settled_at"),
        ({"surplus_at": 50.5, "settled_at": 50.5}, "settled_at"),
        ({"surplus_at": "high", "settled_at": 50.0}, "surplus_at"),
        ({"shed_at": 49, "restore_at": 50, "settled_at": 49.5, "surplus_at": 51, "step": 1}, "surplus_at"),
        ({"shed_at": 49, "restore_at": 50, "settled_at": 48, "surplus_at": 47, "step": 1}, "surplus_at"),
    ],
)
def test_readings_that_cannot_be_are_refused_by_name(options: dict[str, object], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Budgets([Pool("watts", 100, measure=Measure(battery, **options))])  # type: ignore[arg-type]
    assert caught.value.key == f"pool[0].measure.{key}"


@pytest.mark.parametrize(
    ("pool", "key"),
    [
        (Pool("watts", 100, sink=(Sink("house/boiler"),)), "pool[0].sink"),
        (Pool("watts", 100, sink=(Sink("boiler"),), measure=GRID), "pool[0].sink[0].server"),
        (Pool("watts", 100, sink=(Sink("house/boiler", least_on_s=-1),), measure=GRID), "pool[0].sink[0].least_on_s"),
        (Pool("watts", 100, sink=("house/boiler",), measure=GRID), "pool[0].sink[0]"),  # type: ignore[arg-type]
    ],
)
def test_a_sink_that_cannot_be_is_refused_by_name(pool: Pool, key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Budgets([pool])
    assert caught.value.key == key


def grid() -> float:
    """Read one reading that a test has given. Each of the others is as the battery says."""
    with contextlib.suppress(FileNotFoundError):
        Path("once").rename("taken")
        return float(Path("taken").read_text())
    return battery()


def put(name: str, reading: str) -> None:
    """Write a file whole, beside a probe that reads it."""
    Path("new").write_text(reading)
    Path("new").rename(name)


def test_while_there_is_too_much_sinks_are_loaded_one_after_another(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    put("battery", "50.3")  # between: nothing changes
    measure = msgspec.structs.replace(GRID, probe=grid, every_s=0.02)
    sinks = tuple(Sink("house/sink", name, least_on_s=0.0) for name in ("boiler", "car"))
    budgets = rr.ChildSpec(Budgets, id="budgets", args=([Pool("hertz", 100, sink=sinks, measure=measure)],))
    system = start(rr.Supervisor([budgets], max_restarts=9))
    house, proxy = system.open_registrar("house"), system.ref("budgets").proxy()
    steps = Calls()

    def take(name: str) -> str:
        house.load("budgets/share", Share("hertz", 30))
        steps(f"on {name}")
        return name

    house.register_server("sink", take, lambda name, _: steps(f"off {name}"))

    def problem() -> str:
        return proxy.pools().get()[0].problem

    put("once", "50.6")
    steps.wait(1)
    eventually(lambda: proxy.pools().get()[0].used == 30)
    put("once", "50.6")
    steps.wait(2)
    put("battery", "50.6")
    eventually(lambda: problem() == "there is too much: its probe reads 50.6, and no sink is left")
    assert [info.priority for info in house.resources()] == [-1000, -1000]
    assert proxy.pools().get()[0].used == 60
    put("battery", "50.3")
    eventually(lambda: problem() == "")
    wait_respawned(system, "budgets", kill(system, "budgets"))
    assert eventually(lambda: proxy.pools().get()[0].used == 60)
    assert [len(info.queries) for info in house.resources()] == [1, 1]
    put("once", "50.1")
    steps.wait(3)
    put("once", "50.1")
    steps.wait(4)
    assert steps.items == ["on boiler", "on car", "off car", "off boiler"]


def test_a_sink_that_is_lost_is_loaded_again_while_there_is_too_much(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "battery").write_text("51")
    measure = Measure(battery, every_s=0.02, surplus_at=50.5, settled_at=50.1)
    pool = Pool("hertz", 100, sink=(Sink("house/sink", "boiler"),), measure=measure)
    system = start(rr.ChildSpec(Budgets, id="budgets", args=([pool],)))
    house, loads = system.open_registrar("house"), Calls()
    house.register_server("sink", lambda name: loads(name) or name)
    loads.wait(1)
    eventually(lambda: house.resources()[0].state == "OK")
    house.send_status(house.resources()[0], rr.Status("FATAL", "burnt out"))
    loads.wait(2)
