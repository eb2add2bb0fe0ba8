"""What holds whatever many threads do at once: each resource is loaded before it is unloaded, and nothing is left.

The operations are drawn from a seed; their interleaving is the machine's.
"""

from __future__ import annotations

import random
import threading
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, eventually


class Ledger:
    """Counts for each resource what its callbacks did; `wrong` has every step that must not have happened."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._live: dict[str, set[str]] = defaultdict(set)
        self.loads = 0
        self.wrong: list[str] = []

    def loaded(self, place: str, request: Any) -> None:
        resource_id = rr.current().resource_id
        with self._lock:
            self.loads += 1
            live = self._live[f"{place} {request}"]
            if live:
                self.wrong.append(f"{place} {request}: loaded while it was")
            live.add(resource_id)

    def unloaded(self, place: str, request: Any) -> None:
        resource_id = rr.current().resource_id
        with self._lock:
            live = self._live[f"{place} {request}"]
            if resource_id not in live:
                self.wrong.append(f"{place} {request}: unloaded while it was not loaded")
            live.discard(resource_id)

    def nothing_lives(self) -> bool:
        with self._lock:
            return not any(self._live.values())


class Plant:
    """Three registrars, each with a server whose resources need some of the next one's; a load may fail on purpose."""

    depth = 3

    def __init__(self, system: rr.System, seed: int, failing: float = 0.0) -> None:
        self.ledger = Ledger()
        self.failing = failing
        self.random = random.Random(seed)
        self.members = [system.open_registrar(f"r{n}") for n in range(self.depth)]
        for n, member in enumerate(self.members):
            member.register_server("x", self._load(n, member), self._unload(n))

    def _load(self, n: int, member: rr.Registrar) -> Callable[[int], int]:
        def load(request: int) -> int:
            self.ledger.loaded(f"r{n}", request)
            try:
                if n + 1 < self.depth:
                    for part in {request % 3, request % 2}:
                        member.load(f"r{n + 1}/x", part)
                if self.random.random() < self.failing:
                    raise ValueError("by chance")
            except BaseException:
                self.ledger.unloaded(f"r{n}", request)
                raise
            return request

        return load

    def _unload(self, n: int) -> Callable[[int, int], None]:
        return lambda request, response: self.ledger.unloaded(f"r{n}", request)

    def is_empty(self) -> bool:
        return self.ledger.nothing_lives() and not any(m.resources() or m.queries() for m in self.members)


def work(app: rr.Registrar, plan: random.Random, rounds: int, timeout_s: Callable[[], float], errors: Calls) -> None:
    """Load and unload at random; LoadFailed and LoadTimeout are part of the game, anything else is noted."""
    held: list[rr.Query] = []
    try:
        for _ in range(rounds):
            if held and plan.random() < 0.5:
                held.pop(plan.randrange(len(held))).unload()
                continue
            try:
                held.append(app.load(f"r{plan.randrange(3)}/x", plan.randrange(6), timeout_s=timeout_s()))
            except (rr.LoadFailed, rr.LoadTimeout):
                continue
        for query in held:
            query.unload()
    except Exception as error:
        errors(error)


def run_at_once(system: rr.System, seed: int, rounds: int, timeout_s: Callable[[], float]) -> list[Any]:
    """Eight threads of four registrars."""
    errors = Calls()
    apps = [system.open_registrar(f"app{n}") for n in range(4)]
    threads = [
        threading.Thread(target=work, args=(apps[n % 4], random.Random(seed * 100 + n), rounds, timeout_s, errors))
        for n in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive(), "a load or unload hangs"
    eventually(lambda: not any(app.queries() for app in apps))
    return errors.items


@pytest.mark.parametrize("seed", range(4))
def test_many_threads_at_once_leave_nothing(system: rr.System, seed: int) -> None:
    plant = Plant(system, seed)
    assert run_at_once(system, seed, 40, lambda: 30.0) == []
    eventually(plant.is_empty)
    assert plant.ledger.wrong == []
    assert plant.ledger.loads > 20


@pytest.mark.parametrize("seed", range(4))
def test_loads_that_fail_at_random_leave_nothing(system: rr.System, seed: int) -> None:
    plant = Plant(system, seed, failing=0.3)
    assert run_at_once(system, seed, 40, lambda: 30.0) == []
    eventually(plant.is_empty)
    assert plant.ledger.wrong == []


@pytest.mark.parametrize("seed", range(4))
def test_loads_given_up_at_random_moments_leave_nothing(system: rr.System, seed: int) -> None:
    plant, times = Plant(system, seed, failing=0.1), random.Random(seed)
    assert run_at_once(system, seed, 40, lambda: times.choice([0.0, 0.0005, 0.002, 0.005, 30.0])) == []
    eventually(plant.is_empty)
    assert plant.ledger.wrong == []


def test_registrars_that_close_at_random_moments_leave_nothing(system: rr.System) -> None:
    plant = Plant(system, 1)
    for round in range(10):
        app = system.open_registrar("passing")
        futures = [app.load(f"r{n % 3}/x", n, block=False) for n in range(12)]
        for future in futures[:round]:
            future.get(timeout=10)
        app.close()
    eventually(plant.is_empty)
    assert plant.ledger.wrong == []


def test_servers_that_come_and_go_at_random_moments_leave_nothing(system: rr.System) -> None:
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    ledger, outcomes = Ledger(), Calls()
    stopped = threading.Event()

    def consume(n: int) -> None:
        while not stopped.is_set():
            try:
                with app.load("provider/x", n % 2, timeout_s=10.0):
                    pass
                outcomes("loaded")
            except (rr.UnknownServer, rr.UnknownQuery, rr.LoadFailed) as error:
                outcomes(type(error).__name__)

    threads = [threading.Thread(target=consume, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(10):
            provider.register_server(
                "x",
                lambda request: ledger.loaded("x", request),
                lambda request, response: ledger.unloaded("x", request),
            )
            before = len(outcomes)
            outcomes.wait(before + 10)
            provider.unregister_server("x")
    finally:
        stopped.set()
        for thread in threads:
            thread.join(15)
    assert not any(thread.is_alive() for thread in threads)
    eventually(lambda: not app.queries() and not provider.resources() and ledger.nothing_lives())
    assert ledger.wrong == []
