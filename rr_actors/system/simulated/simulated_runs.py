"""simulate(): what a tree of supervisors does in an hour of crashes, in virtual time.

The supervisors decide by the same functions as those of a real system (supervision/core). The children are models.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from random import Random
from typing import Any, cast

import msgspec

from rr_actors.base.checks import check_number, check_positive, invalid, is_number
from rr_actors.base.errors import NotFound, RrError, is_a, shown
from rr_actors.base.names import child_meant, no_child
from rr_actors.base.notebook import bundle, table
from rr_actors.supervision.core.specs import ChildModel, ChildSpec, EndReason, Supervisor
from rr_actors.supervision.core.virtual_tree import Happening, VirtualTree
from rr_actors.supervision.event_history import Record, RunFacts, record_of
from rr_actors.supervision.name_entries import manager_of
from rr_actors.system.event_subscribers import ChildEvent
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import entry_of
from rr_actors.system.recording.timelines import Timeline, timeline_of

Scenario = Mapping[str, ChildModel] | Sequence[tuple[str, float]]
"""Models of children by path or id, or deaths: (path or id, seconds since the start)."""

START_TIMEOUT_S = 30.0
"""The time limit for the start of a child that sets none, as in SystemConfig."""


class ChildOutcome(msgspec.Struct, frozen=True):
    """What became of one child in a simulation.

    Attributes:
        path: the child's.
        availability: the part of the time in which it was ready and did not hang, from 0 to 1.
        up_s: that time in seconds.
        deaths: how often it ended by itself, was killed, or was killed because it hung; also during a start.
        restarts: how often it became ready again.
        longest_outage_s: the longest time in seconds between two times in which it was ready, or after the last one.
    """

    path: str
    availability: float
    up_s: float
    deaths: int
    restarts: int
    longest_outage_s: float


class SimulatedRun:
    """What happened in a simulation. str() is a table; a notebook shows it with the timeline.

    Attributes:
        children: the outcome of each child by path, those of supervisors as well.
        until_s: how long the simulation was, in seconds.
        ended_at: when the root ended, in seconds since its start; None if it ran to the end.
        error: why it ended: RestartIntensityExceeded, or StartFailed; None if it did not, or by auto_shutdown.
        gave_up: each supervisor that restarted too often, by path: when it first did, in seconds.
        missed: the deaths of the scenario that met no running process: (path, seconds).
    """

    def __init__(self, tree: Supervisor, virtual: VirtualTree, until_s: float) -> None:
        self._tree = tree
        self._happenings = virtual.happenings
        self.until_s = until_s
        self.ended_at = virtual.ended_at
        self.error: RrError | None = virtual.error
        self.missed = [(path, at) for at, path in virtual.missed]
        self.gave_up: dict[str, float] = {}
        for happening in virtual.happenings:
            if happening.report.event == "gave_up":
                self.gave_up.setdefault(happening.path.rpartition("/")[0], happening.at)
        self.children = {
            path: ChildOutcome(
                path,
                uptime.up_s / until_s,
                uptime.up_s,
                uptime.deaths,
                max(0, uptime.starts - 1),
                uptime.longest_outage_s,
            )
            for path in paths_of(tree)
            for uptime in (virtual.uptime(path),)
        }

    @functools.cached_property
    def events(self) -> list[ChildEvent]:
        """What happened, as System.subscribe() tells it. `at` is in seconds since the start of the tree."""
        flat = [{"event": record.event, **record.facts(), "at": record.at} for record in map(_record, self._happenings)]
        return cast("list[ChildEvent]", flat)

    @functools.cached_property
    def timeline(self) -> Timeline:
        """The picture of all lives, with a clock that begins at midnight."""
        origin = time.mktime((2000, 1, 1, 0, 0, 0, 0, 0, -1))
        events = [Event.of({**cast("dict[str, Any]", event), "at": origin + event["at"]}) for event in self.events]
        picture = timeline_of(map(entry_of, events), f"{self._tree.id}, simulated")
        picture.until = max(picture.until, origin + self.until_s)
        return picture

    def __str__(self) -> str:
        rows = [_HEADS, *(_cells(child) for child in self.children.values())]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(_aligned(row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, *self._ends()])

    def _ends(self) -> list[str]:
        lines = [f"{path} gave up after {at:.1f} s" for path, at in self.gave_up.items()]
        if self.ended_at is not None:
            lines.append(f"the tree ended after {self.ended_at:.1f} s" + (f": {self.error}" if self.error else ""))
        if self.missed:
            lines.append(f"{len(self.missed)} of the deaths met no running process")
        return lines

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        rows = table(_HEADS, map(_cells, self.children.values()), caption="; ".join(self._ends()))
        return bundle(str(self), html=f"{rows}{self.timeline.svg()}")

    def __repr__(self) -> str:
        return f"<SimulatedRun of {self._tree.id}: {len(self._happenings)} events in {self.until_s:g} s>"


_HEADS = ("child", "available", "deaths", "restarts", "longest outage")


def _cells(child: ChildOutcome) -> tuple[str, ...]:
    outage = f"{child.longest_outage_s:.2f} s"
    return child.path, f"{child.availability:.3%}", str(child.deaths), str(child.restarts), outage


def _aligned(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    return [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]


def _record(happening: Happening) -> Record:
    at, path, report, spec, is_restart, began, ready_at = happening
    kind = "actor"
    if spec is not None and (spec.type == "supervisor" or manager_of(spec) is not None):
        kind = "supervisor" if spec.type == "supervisor" else "manager"
    facts = None
    if began is not None:
        ready_s, up_s = (None, None) if ready_at is None else (ready_at - began, at - ready_at)
        facts = RunFacts(is_restart, None, ready_s, up_s)
    return record_of(report, path, kind, at, facts)


def paths_of(tree: Supervisor) -> dict[str, ChildSpec]:
    """Return the specification of each child that starts with the tree, by path, in the order of their start."""
    found: dict[str, ChildSpec] = {}

    def add(supervisor: Supervisor, path: str) -> None:
        if supervisor.strategy == "simple_one_for_one":  # its children are added at run time
            return
        for child in supervisor.child_specs:
            found[f"{path}/{child.id}"] = child
            if isinstance(inner := child.actor_class_or_manager, Supervisor):
                add(inner, f"{path}/{child.id}")

    add(tree, tree.id)
    return found


def simulate(
    tree: Supervisor,
    scenario: Scenario = (),
    *,
    models: Mapping[str, ChildModel] | None = None,
    until_s: float = 3600.0,
    seed: int = 1,
    start_s: float = 0.1,
) -> SimulatedRun:
    """Run a tree in virtual time, and return what happened.

    The supervisors decide as in a real system. Nothing is started: no process, no thread, and no code of the classes.
    The same arguments give the same run. Each child has random numbers of its own, so a change at one child, or of a
    strategy, does not change when the others die.

    Args:
        tree: the specification of the root.
        scenario: a model of how each child lives and dies, `{"cameras": rr.Child.fails(every_s=30)}`; or the
            moments at which processes are killed, `[("cameras", 12.5), ("maps", 13.0)]`, in seconds since the start.
            A child is named by its path or its id. Default: (), nothing dies.
        models: beside moments, how the children live besides. Default: None, they need `start_s` for a start, and
            live until they are killed. Set them to starts that you measured.
        until_s: how long, in virtual seconds. Default: 3600.0, an hour. Take longer for what seldom dies.
        seed: the beginning of all random numbers. Default: 1. Take others to see what differs by chance.
        start_s: seconds that a child without a model needs for its start. Default: 0.1. Set it to what you measured.

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`: a time that is negative, or no number, or after `until_s`; a thread
            that is to be killed.
        NotFound: the scenario names an unknown child.
    """
    who = "simulate"
    if not isinstance(cast(object, tree), Supervisor):
        raise invalid(who, "tree", "a Supervisor", tree)
    check_positive(until_s, who, "until_s")
    check_number(start_s, who, "start_s", least=0)
    if not is_a(seed, int):
        raise invalid(who, "seed", "a whole number", seed)
    specs = paths_of(tree)
    read, deaths = _read(scenario, specs, until_s)
    if models is not None:
        read |= _models(models, "models", specs)
    virtual = VirtualTree(
        tree,
        read,
        ChildModel(start_s=start_s),
        deaths,
        chance_of=lambda path: Random(f"{seed} {path}").random,
        start_timeout_s=START_TIMEOUT_S,
    )
    virtual.run(float(until_s))
    return SimulatedRun(tree, virtual, float(until_s))


def _read(
    scenario: object, specs: Mapping[str, ChildSpec], until_s: float
) -> tuple[dict[str, ChildModel], list[tuple[float, str, EndReason]]]:
    """Return the models of a scenario by path, and its deaths."""
    deaths: list[tuple[float, str, EndReason]] = []
    if isinstance(scenario, Mapping):
        return _models(cast("Mapping[object, object]", scenario), "scenario", specs), deaths
    if not isinstance(scenario, list | tuple):
        raise invalid("simulate", "scenario", "a dict of models by child, or a list of (child, seconds)", scenario)
    for index, death in enumerate(cast("Sequence[object]", scenario)):
        where = f"scenario[{index}]"
        if not (isinstance(death, list | tuple) and len(cast("Sequence[object]", death)) == 2):
            raise invalid("simulate", where, "(child, seconds since the start)", cast(object, death))
        name, at = cast("Sequence[object]", death)
        if not is_number(at) or not 0 <= at <= until_s:
            expected = f"seconds since the start, from 0 to until_s ({until_s:g})"
            raise invalid("simulate", f"{where}[1]", expected, at)
        path = path_meant(name, specs)
        _check_end("killed", path, specs, where)
        deaths.append((float(at), path, "killed"))
    return {}, deaths


def _models(models: Mapping[Any, object], field: str, specs: Mapping[str, ChildSpec]) -> dict[str, ChildModel]:
    found: dict[str, ChildModel] = {}
    for name, model in models.items():
        where = f"{field}[{shown(name)}]"
        if not isinstance(model, ChildModel):
            raise invalid("simulate", where, "what Child.fails() returns", model)
        path = path_meant(name, specs)
        if specs[path].type == "supervisor":
            expected = "a child that is no supervisor: a supervisor ends by what its children do"
            raise invalid("simulate", where, expected, path)
        if model.every_s is not None:
            _check_end(model.reason, path, specs, where)
        if path in found:
            raise invalid("simulate", where, "one model for each child", f"a second one for {path}")
        found[path] = model
    return found


def path_meant(name: object, specs: Mapping[str, ChildSpec]) -> str:
    """Return the path of the child that a path or an id names.

    Raises:
        NotFound: there is none, or several children have the id.
    """
    if not isinstance(name, str):
        raise NotFound(f"simulate: expected the path or id of a child, got {shown(name)}", id=shown(name))
    if (path := child_meant(name, specs.keys())) is None:
        raise no_child(name, specs.keys())
    return path


def _check_end(reason: EndReason, path: str, specs: Mapping[str, ChildSpec], where: str) -> None:
    if reason == "killed" and specs[path].placement == "thread":
        expected = "a child with a process of its own, or reason='abnormal': this one is a thread of its supervisor's"
        raise invalid("simulate", where, expected, path)
