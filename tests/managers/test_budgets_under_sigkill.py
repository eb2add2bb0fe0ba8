"""Budgets, programs that pause, and those who hold them, while their managers alone are killed at any moment.

`make chaos` harms them in other ways, too, among other managers. RR_MANY says how many SIGKILLs: 20 by default, 300 for
a long run (`RR_MANY=300`, some minutes).
"""

from __future__ import annotations

import contextlib
import os
import random
import threading
import time
from collections.abc import Callable

import psutil
import pytest

import rr_actors as rr
from chaos.invariants import check_house, used_by
from chaos.load_threads import Resident
from chaos.process_census import stands
from chaos.report import Tally
from chaos.victim_managers import LESS, RESERVE, WATTS, House
from rr_actors.managers import Budgets, Programs
from support import eventually, kill
from support_programs import group_of_program

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("RR_MANY", "20"))
LIMIT_S = 90.0
MANAGERS = ("budgets", "programs", "house")
PROGRAMS = {"idle": "pause", "linger_s": 0.1, "paused_s": 2.0}
CHILDREN = [
    rr.ChildSpec(Budgets, id="budgets", args=([WATTS], 60.0)),  # a grace longer than any restart
    rr.ChildSpec(Programs, id="programs", kwargs=PROGRAMS),
    rr.ChildSpec(House, id="house"),
]


class Home:
    """The system, its residents, and what is seen of it."""

    def __init__(self, system: rr.System) -> None:
        self.system = system
        self.tally = Tally()
        apps = [system.open_registrar(f"app-{number}") for number in range(4)]
        self.residents = [Resident(app, number, self.tally) for number, app in enumerate(apps)]

    def resources(self, of: str) -> list[rr.ResourceInfo]:
        return self.system.registrar(of).resources()

    def used(self) -> float:
        return used_by(self.resources("house"))

    def set_capacity(self, capacity: float) -> None:
        eventually(lambda: self._set_capacity(capacity), LIMIT_S)

    def _set_capacity(self, capacity: float) -> bool:
        try:
            self.system.ref("budgets").proxy().set_capacity("watts", capacity).get(timeout=10)
        except Exception:  # it is being killed: an ask may fail in many ways
            return False
        return True

    def wrongs(self) -> list[str]:
        budgets, programs, devices = map(self.resources, MANAGERS)
        return check_house(devices, budgets, programs, stands)


def test_no_promise_is_broken_while_managers_are_killed(start: Callable[..., rr.System]) -> None:
    home = Home(start(rr.Supervisor(CHILDREN, max_restarts=1_000_000)))
    plan, moment = random.Random(KILLS), threading.Event()
    capacity = limit = WATTS.capacity
    for resident in home.residents:
        resident.start()
    try:
        for number in range(KILLS):
            moment.wait(plan.uniform(0.02, 0.5))
            if number % 10 == 5:
                capacity = (WATTS.capacity, LESS)[number // 10 % 2 - 1]
                home.set_capacity(capacity)
            used = home.used()
            if capacity > limit or used <= capacity + RESERVE:  # else it is over a lowered capacity, for a grace
                limit = capacity
            assert used <= limit + RESERVE
            with contextlib.suppress(AssertionError, ProcessLookupError):  # it is just being respawned
                kill(home.system, plan.choice(MANAGERS))
    finally:
        for resident in home.residents:
            resident.stop()
    for resident in home.residents:
        resident.join(time.monotonic() + LIMIT_S)
    home.set_capacity(LESS)
    eventually(lambda: home.used() <= LESS + RESERVE, LIMIT_S)
    eventually(lambda: home.wrongs() == [], LIMIT_S)
    (pool,) = home.system.ref("budgets").proxy().pools().get(timeout=LIMIT_S)
    assert pool.used == home.used() <= pool.capacity
    pids = [info.response.pid for info in home.resources("programs")]
    groups = [group for pid in pids if (group := group_of_program(pid)) is not None]
    for resident in home.residents:
        resident.release()
    eventually(lambda: not any(map(home.resources, MANAGERS)), LIMIT_S)
    eventually(lambda: not any(psutil.pid_exists(pid) for pid in pids), LIMIT_S)
    assert not any(group.exists() for group in groups)
    assert home.tally.violations == []
