"""Planning: a load with a share, the planner, a program that is paused and resumed, and a revocation."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import rr_actors as rr
from benchmarks.measure import Samples, interleaved, time_each
from benchmarks.table import Row
from rr_actors.managers import Budgets, Pool, Programs, RunProgram, Share
from rr_actors.managers.budgets.planner import Asked, Running, plan

SHARE_AIM_MS = 1.5
PLANNER_AIM_MS = 10.0
PROGRAM_AIM_MS = 5.0
REVOKE_AIM_S = 1.0
POLICY = ("reclaim", "supply", "preempt", "wait")
_PATIENCE_S = 60.0


class Devices(rr.Manager):
    """Has a device that costs nothing, one that loads a share, and one with a part that all of them have."""

    @rr.server("plain")
    def load_plain(self, request: int) -> int:
        return request

    @rr.server("costly")
    def load_costly(self, request: int) -> int:
        self.registrar.load("budgets/share", Share("watts", 1))
        return request

    @rr.server("part")
    def load_part(self, request: int) -> int:
        return request

    @rr.server("whole")
    def load_whole(self, request: int) -> int:
        self.registrar.load("devices/part", 0)
        return request


def planning(times: int, shares: int, wholes: int) -> list[Row]:
    """The whole scenario: `times` loads and pauses, a pool with `shares`, a part under `wholes`."""
    return [*_share(times), _planner(shares), *_program(max(5, times // 10)), _revocation(wholes)]


@contextmanager
def _system(*children: rr.ChildSpec) -> Iterator[rr.System]:
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([*children], name="bench", state_dir=state_dir) as system,
    ):
        yield system


def _share(times: int) -> list[Row]:
    budgets = rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 1e9)],))
    with _system(budgets, rr.ChildSpec(Devices, id="devices")) as system:
        app, numbers = system.open_registrar("app"), itertools.count()
        taken = interleaved(
            {
                "plain": lambda: app.load("devices/plain", next(numbers)),
                "costly": lambda: app.load("devices/costly", next(numbers)),
            },
            times=times,
            after_turn=app.unload_all,
        )
    plain, costly = taken["plain"], taken["costly"]
    return [
        Row("load of a device without a share", plain.median * 1e3, "ms", plain.p99 * 1e3),
        Row("load of a device with a share", costly.median * 1e3, "ms", costly.p99 * 1e3, at_most=SHARE_AIM_MS),
    ]


def _planner(shares: int) -> Row:
    running = [Running(str(number), 1.0, number % 10, float(number)) for number in range(shares)]
    asked = [Asked("new", shares / 100, 5)]
    taken = Samples(tuple(time_each(lambda: plan(float(shares), POLICY, running, asked), 20)))
    name = f"planner, {shares:,} shares: one that is to be made room for"
    return Row(name, taken.median * 1e3, "ms", taken.p99 * 1e3, at_most=PLANNER_AIM_MS)


def _program(times: int) -> list[Row]:
    pausing: list[float] = []
    resuming: list[float] = []
    with _system(rr.ChildSpec(Programs, id="programs", kwargs={"idle": "pause"})) as system:
        app, programs = system.open_registrar("app"), system.registrar("programs")
        for _ in range(times + 1):  # the first load starts it
            began = time.perf_counter()
            program = app.load("programs/program", RunProgram("sleep", ("1000",)))
            loaded = time.perf_counter()
            program.unload()
            while programs.resources()[0].phase != "paused":
                if time.perf_counter() - loaded > _PATIENCE_S:
                    raise TimeoutError(f"the program was not paused within {_PATIENCE_S:g} s")
            pausing.append(time.perf_counter() - loaded)
            resuming.append(loaded - began)
    paused, resumed = Samples(tuple(pausing[1:])), Samples(tuple(resuming[1:]))
    return [
        Row("program: release, until paused", paused.median * 1e3, "ms", paused.p99 * 1e3, at_most=PROGRAM_AIM_MS),
        Row("program: load that resumes it", resumed.median * 1e3, "ms", resumed.p99 * 1e3, at_most=PROGRAM_AIM_MS),
    ]


def _revocation(wholes: int) -> Row:
    with _system(rr.ChildSpec(Devices, id="devices")) as system:
        app, devices = system.open_registrar("app"), system.registrar("devices")
        app.load_all([("devices/whole", number) for number in range(wholes)], timeout_s=_PATIENCE_S)
        (part,) = [info for info in devices.resources() if info.server == "part"]
        began = time.perf_counter()
        devices.revoke(part.id, "benchmark", grace_s=_PATIENCE_S)
        return Row(f"revocation of a part of {wholes:,}", time.perf_counter() - began, "s", at_most=REVOKE_AIM_S)
