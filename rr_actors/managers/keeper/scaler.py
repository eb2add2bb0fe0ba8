"""Scaler: reads what the numbers of replicas follow, and remembers what has followed from that (scaling.py)."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence

import msgspec

from rr_actors.base.checks import is_number
from rr_actors.base.errors import RrError, did_you_mean, shown, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.managers.keeper import comparing, scaling
from rr_actors.managers.keeper.comparing import KeptReport, Slot, WantedReplica
from rr_actors.managers.keeper.desired import KeptKind
from rr_actors.managers.keeper.scaling import Range, Reading, Scale, ScaleOn
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.planning.planning_loop import PlanningLoop, StepEnded
from rr_actors.managers.planning.probes import probe_of
from rr_actors.registrar.queries import Query
from rr_actors.registrar.registrar import Registrar

logger = Log("rr_actors.managers.keeper")

_READING = -1  # in the place of a replica's number, in the key of the step that reads

RegistrarOf = Callable[[str], Registrar]


class NoReading(RrError):
    """What decides how many replicas there are cannot be read now."""


class KeptScale(msgspec.Struct):
    """How many replicas of one thing were wanted, and why, when the keeper's process died."""

    wanted: int
    why: str = ""


class KeptScales(msgspec.Struct):
    """What a keeper knows of its scales beside its catalog."""

    scales: dict[str, KeptScale] = {}


class Scaler:
    """The numbers of replicas that a keeper decides. Its methods run on the planning loop's thread.

    Args:
        loop: where the readings are steps.
        record: what is known after a crash; None: the keeper is in no system.
        parts_of: returns the parts of a replica by the id of its query.
        registrar_of: returns a registrar of the system by its name.
    """

    def __init__(
        self,
        loop: PlanningLoop[Slot | str, WantedReplica | None],
        record: KeptRecord[KeptScales] | None,
        parts_of: Callable[[str], list[Query]],
        registrar_of: RegistrarOf,
    ) -> None:
        self._loop, self._record = loop, record
        self._parts_of, self._registrar_of = parts_of, registrar_of
        self._ranges: dict[str, Range] = {}
        self._scales: dict[str, Scale] = {}
        self._troubles: dict[str, str] = {}
        self._due_at: dict[str, float] = {}

    def counts(self, keeps: Iterable[KeptKind], held: Mapping[str, int], now: float) -> dict[str, int]:
        """Return how many replicas are wanted of what scales. `held`: how many of a name are held.

        What scales since now, or is not in the record, goes on with the number that is held.
        """
        before, ranges = self._ranges, {keep.name: keep.range_ for keep in keeps if keep.range_ is not None}
        self._ranges = ranges
        for name in [name for name in before if before[name] != ranges.get(name)]:
            self._troubles.pop(name, None)  # another file says what is read, or that nothing is
            self._due_at.pop(name, None)
        for name in [name for name in self._scales if name not in ranges]:
            del self._scales[name]
        kept = {} if self._record is None else self._record.now.scales
        for name, range_ in ranges.items():
            if name not in self._scales:
                known = kept[name] if name in kept else KeptScale(held.get(name, 0))
                self._scales[name] = scaling.begun(range_, known.wanted, known.why, now)
            self._take(name, scaling.within(range_, self._scales[name]))
        self._keep()
        return {name: scale.wanted for name, scale in self._scales.items()}

    def begin(self, ready: Mapping[str, Sequence[str]], now: float) -> float | None:
        """Begin the readings that are due. Return when the next one is, or is late; None: nothing scales.

        Args:
            ready: the queries of the replicas that are ready, by the name of what is kept.
        """
        times: list[float] = []
        for name, range_ in self._ranges.items():
            on, step = range_.scale_on, self._loop.in_flight.get((name, _READING))
            if step is not None:
                late_at = step.since + on.timeout_s
                if late_at <= now:  # its end wakes the loop
                    self._trouble(name, f"{on.label} has not been read within {on.timeout_s:g} s")
                else:
                    times.append(late_at)
            elif (due_at := self._due_at.get(name, now)) > now:
                times.append(due_at)
            else:
                self._due_at[name] = now + on.every_s
                times.append(now + min(on.every_s, on.timeout_s))
                self._read(name, range_, ready.get(name, ()))
        return min(times, default=None)

    def told(self, name: str, report: KeptReport) -> KeptReport:
        """Return the report of one kind of thing with what is known of its number."""
        range_, trouble = self._ranges.get(name), self._troubles.get(name, "")
        if range_ is None:
            return report
        report = msgspec.structs.replace(report, least=range_.least, most=range_.most, scaled=self._scales[name].why)
        if not trouble:
            return report
        why = ", ".join(filter(None, (report.why, comparing.NO_READING)))
        return msgspec.structs.replace(report, why=why, detail=report.detail or trouble)

    # -- readings --------------------------------------------------------------------------------------------------

    def _read(self, name: str, range_: Range, ready: Sequence[str]) -> None:
        """Read once, in a thread of its own, if there is anything that could be asked."""
        on = range_.scale_on
        if on.usage and not ready:
            return
        if on.usage:
            read = functools.partial(_used, on, [self._parts_of(id) for id in ready], self._registrar_of)
        else:
            read = functools.partial(_probed, on, len(ready))
        self._loop.begin_call((name, _READING), None, read, functools.partial(self._heard, name, range_))

    def _heard(self, name: str, range_: Range, ended: StepEnded) -> None:
        if self._ranges.get(name) != range_:  # another file holds by now
            return
        if ended.error is not None:
            self._trouble(name, str(ended.error))
            return
        if self._troubles.pop(name, ""):
            logger.info("%s: %s is read again", name, range_.scale_on.label)
        self._take(name, scaling.next_scale(range_, self._scales[name], ended.value, time.monotonic()))
        self._keep()

    def _trouble(self, name: str, said: str) -> None:
        if self._troubles.get(name) != said:
            logger.warning("%s: %s; the number of replicas stays", name, said)
        self._troubles[name] = said

    def _take(self, name: str, scale: Scale) -> None:
        if scale.why != self._scales[name].why:
            logger.info("%s: replicas %s", name, scale.why)
        self._scales[name] = scale

    def _keep(self) -> None:
        """Write the numbers, if they have changed. A disk that refuses it costs the memory of them."""
        if self._record is None:
            return
        scales = {name: KeptScale(scale.wanted, scale.why) for name, scale in self._scales.items()}
        if scales != self._record.now.scales:
            self._record.now = KeptScales(scales)
            self._record.save()

    def catch_up(self) -> bool:
        """Write the numbers, if the disk has refused that. Return whether they are on disk."""
        return self._record is None or self._record.catch_up()


def _probed(on: ScaleOn, count: int) -> Reading:
    """Ask the probe. In a thread of its own."""
    try:
        value: object = probe_of(on.probe)()
    except BaseException as error:  # a user's function may raise anything
        raise NoReading(f"{on.label} raised {text_of(error)}") from error
    if not is_number(value):
        raise NoReading(f"{on.label} returned {shown(value)}, not a finite number")
    return Reading(float(value), count)


def _used(on: ScaleOn, replicas: Sequence[Sequence[Query]], registrar_of: RegistrarOf) -> Reading:
    """Ask for the usage of the replicas' parts. In a thread of its own.

    A replica of which a part says why it does not know its usage does not count.
    """
    asked: dict[str, list[str]] = {}
    said, failures = dict[str, Mapping[str, float]](), dict[str, str]()
    for part in (part for parts in replicas for part in parts):
        asked.setdefault(part.registrar, []).append(part.resource_id)
    for name, ids in asked.items():
        limit_s = on.timeout_s / 2 / len(asked)  # one callback that hangs does not make the whole reading late
        try:
            usages = registrar_of(name).usage(of=ids, timeout_s=limit_s)
        except RrError as error:
            failures |= dict.fromkeys(ids, text_of(error))
        else:
            said |= usages
            failures |= usages.failures
    numbers: list[float] = []
    for parts in replicas:
        known = [said[part.resource_id][on.usage] for part in parts if on.usage in said.get(part.resource_id, ())]
        if known and not any(part.resource_id in failures for part in parts):
            numbers.append(sum(known))
    if not numbers:
        names = sorted({key for usage in said.values() for key in usage})
        nobody = f"not among what they use: {', '.join(names) or 'nothing'}{did_you_mean(on.usage, names)}"
        raise NoReading(f"{on.label}: {next(iter(failures.values()), nobody)}")
    return Reading(sum(numbers) / len(numbers), len(numbers))
