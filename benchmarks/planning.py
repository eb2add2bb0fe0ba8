"""Planning: a load with a share, the planner, a paused program, a revocation, a choice, a pipe, a keeper, a graph."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import rr_actors as rr
from benchmarks.measure import Samples, interleaved, time_each
from benchmarks.table import Row
from rr_actors.managers import Actions, Alternative, Budgets, Choices, Choose, Pool, Programs, RunProgram, Share
from rr_actors.managers.budgets.planner import AskedShare, HeldShare, plan
from rr_actors.managers.keeper.comparing import SeenReplica, compare, report
from rr_actors.managers.keeper.desired import parse_desired
from rr_actors.managers.pipes.chains import ChainComponent, Goal, best_chain

SHARE_AIM_MS = 1.5
PLANNER_AIM_MS = 10.0
PROGRAM_AIM_MS = 5.0
REVOKE_AIM_S = 1.0
CHOICE_AIM_MS = 20.0  # beyond the load of the new one
KEEP_AIM_MS = 50.0
PIPE_AIM_MS = 50.0
_PIPE_STAGES = 10
STEP_AIM_MS = 2.0
_STEPS = 50
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


class Nothing(rr.Action):
    """An action that does nothing."""

    def run(self, given: object) -> bool:
        return True


def planning(times: int, shares: int, wholes: int, kept: int) -> list[Row]:
    """The whole scenario: `times` loads and pauses, a pool with `shares`, a part under `wholes`, `kept` replicas."""
    return [
        *_share(times),
        _planner(shares),
        *_program(max(5, times // 10)),
        _revocation(wholes),
        *_choice(max(5, times // 5)),
        _pipe(kept),
        _keep(kept),
        *_graph(max(2, times // 50)),
    ]


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
    running = [HeldShare(str(number), 1.0, number % 10, float(number)) for number in range(shares)]
    asked = [AskedShare("new", shares / 100, 5)]
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


def _choice(times: int) -> list[Row]:
    """Time the replacement of a device that fails, until the holder of the choice hears of the next one."""
    alternatives = [Alternative("device", "devices/plain", -number) for number in (1, 2)]
    choices = rr.ChildSpec(Choices, id="choices", args=(alternatives,), kwargs={"settle_s": _PATIENCE_S})
    with _system(rr.ChildSpec(Devices, id="devices"), choices) as system:
        app, devices, numbers = system.open_registrar("app"), system.registrar("devices"), itertools.count()
        replacing: list[float] = []

        def replace() -> None:
            with app.load("choices/choice", Choose("device")) as choice:
                (device,) = [info for info in devices.resources() if info.request == choice.response.request]
                began = time.perf_counter()
                devices.send_status(device, rr.Status("FATAL", "benchmark"))
                choice.wait_status("UPDATE", timeout_s=_PATIENCE_S)
                replacing.append(time.perf_counter() - began)

        taken = interleaved(
            {"plain": lambda: app.load("devices/plain", next(numbers)), "replace": replace},
            times=times,
            after_turn=app.unload_all,
        )
    plain, replaced = taken["plain"], Samples(tuple(replacing))
    name = "choice: a device fails, until its holder hears of the next, less the load of a device"
    return [Row(name, (replaced.median - plain.median) * 1e3, "ms", replaced.p99 * 1e3, at_most=CHOICE_AIM_MS)]


def _pipe(components: int) -> Row:
    """Choose a chain of ten among components that can stand in one of its places each, and fit all before them."""

    def link(number: int) -> ChainComponent:
        place, trust = number % _PIPE_STAGES, 1 - (number * 7919 % components) / components / 10
        inputs, outputs = ({f"data {place}"} if place else set[str](), {f"data {place + 1}"})
        return ChainComponent(f"{number}", "any", frozenset(inputs), frozenset(outputs), trust)

    links, goal = [link(number) for number in range(components)], Goal(f"data {_PIPE_STAGES}")

    def choose() -> None:
        chain = best_chain(links, goal)
        assert chain is not None
        assert len(chain) == _PIPE_STAGES

    taken = Samples(tuple(time_each(choose, 20)))
    name = f"pipe, {components:,} components: the best chain of {_PIPE_STAGES}"
    return Row(name, taken.median * 1e3, "ms", taken.p99 * 1e3, at_most=PIPE_AIM_MS)


def _keep(kept: int) -> Row:
    """Compare what is desired with what is there, of which each tenth is missing."""
    text = f'[[keep]]\nname = "a"\nserver = "b/c"\nrequest = "{{instance}}"\nreplicas = {kept}\n'
    desired = parse_desired(text.encode(), "keep.toml")
    wanted = [one for one, _ in desired.replicas("keeper/group")]
    there = [SeenReplica(one.keep, one.instance, one.what) for one in wanted if one.instance % 10]

    def look() -> None:
        steps = compare(wanted, there, {}, 0.0)
        assert len(steps.load) == kept - len(there)
        report(desired.keeps, wanted, there, {})

    taken = Samples(tuple(time_each(look, 20)))
    name = f"keeper, {kept:,} replicas: compared with what is desired"
    return Row(name, taken.median * 1e3, "ms", taken.p99 * 1e3, at_most=KEEP_AIM_MS)


def _graph(times: int) -> list[Row]:
    """Run a chain of actions that do nothing, in turns with two loads of a device."""
    numbers = range(_STEPS)
    nodes = [
        {
            "name": "Nothing",
            "instance_id": number,
            "parents": [{"name": "Nothing", "instance_id": number - 1}] if number else [],
            "children": [{"name": "Nothing", "instance_id": number + 1}] if number + 1 < _STEPS else [],
        }
        for number in numbers
    ]
    actions = rr.ChildSpec(Actions, id="actions", kwargs={"actions": [Nothing]})
    with _system(rr.ChildSpec(Devices, id="devices"), actions) as system:
        app, devices = system.open_registrar("app"), itertools.count()

        def load_two() -> None:
            for _ in range(2):
                app.load("devices/plain", next(devices)).unload()

        def run() -> None:
            ended = rr.run_graph(app, {"graph_name": "chain", "actions": nodes}, timeout_s=_PATIENCE_S)
            assert ended.result == "on_true"

        taken = interleaved({"two": load_two, "graph": run}, times=times)
    two, step = taken["two"].median * 1e3, taken["graph"].median * 1e3 / _STEPS
    return [
        Row("two loads of a device, and their unloads", two, "ms", taken["two"].p99 * 1e3),
        Row(f"a step of a graph of {_STEPS} actions that do nothing", step, "ms", at_most=STEP_AIM_MS),
    ]
