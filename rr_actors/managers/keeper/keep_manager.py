"""Keeper: the manager that keeps what a file wants.

Each replica is a resource of the keeper's own server `replica`, and what is kept is its part. So the catalog alone
says what is there, also after a crash. The planning loop looks, compares (comparing.py), and begins the steps.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from typing import Any

import msgspec

from rr_actors.actors.actor_tables import TableColumn, table
from rr_actors.base.errors import (
    CatalogError,
    NotFound,
    OverCapacity,
    RegistrarDown,
    RrError,
    UnknownQuery,
    UnknownRegistrar,
    UnknownServer,
    UnloadFailed,
    UsageError,
    did_you_mean,
    few,
    shown,
    text_of,
)
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode
from rr_actors.managers.keeper import comparing
from rr_actors.managers.keeper.comparing import KeptReport, ReplicaSteps, SeenReplica, Slot, WantedReplica
from rr_actors.managers.keeper.desired import Desired, Replica, Request, changes, parse_desired
from rr_actors.managers.keeper.scaler import KeptScales, Scaler
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.planning.last_good import LastGood, Sources, one_file, path_of
from rr_actors.managers.planning.planning_loop import PlanningLoop, StepEnded
from rr_actors.managers.planning.setbacks import BACKOFF, Setbacks
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import Phase, State
from rr_actors.registrar.queries import Query, ResourceInfo, Status
from rr_actors.registrar.registrar import NO_FIELDS, Registrar
from rr_actors.supervision.core.specs import Backoff
from rr_actors.system.registrar_lookup import registrar_in

logger = Log("rr_actors.managers.keeper")

_SOON_S = 0.05  # so long after a look the next one, while a holder's response is on its way
_LOOK_S = 1.0  # while something is not as it is wanted, it looks so often: not every end is announced
_APPLY_S = 30.0
_GROUP_CHANGED = "the group has other members by now: load it anew"
_PART_S = 5.0  # so long the release of a replica waits for that of its part; if it takes longer, it is owed


class Kept(msgspec.Struct, frozen=True, repr_omit_defaults=True):
    """The response: how what is kept under a name is. It changes with each UPDATE.

    Attributes:
        name: the name in the file.
        wanted, ready: how many replicas.
        why: why others are not ready: "none registered", "over capacity", "failing", "all failing", "waits for NAME",
            "loading", "unload failed", or several of them; "" if all are. "no reading": what decides how many there are
            cannot be read, so that number stays.
        min, max: how many replicas may be wanted; None: the number is fixed.
        scaled: the reason of the last change of `wanted`, "2 -> 3: cpu is 0.93, the target 0.7".
    """

    name: str
    wanted: int
    ready: int
    why: str = ""
    min: int | None = None
    max: int | None = None
    scaled: str = ""


class Keeper(Manager):
    """Keeps what a TOML file wants: loads what is missing or lost, and releases what is not wanted.

    Serves `kept`: a request is a name of the file, and the response is a Kept. Its holders hear WARNING while replicas
    are not ready, and ERROR when none is, for a reason that time alone does not end. Serves `group`: a request is the
    name of a group of the file, whose members are loaded as parts. Kubernetes calls such a manager a controller.
    """

    _rr_side_by_side = True

    def __init__(self, file: str | os.PathLike[str], backoff: Backoff = BACKOFF) -> None:
        """Read what is to be kept from a TOML file. `backoff`: the waiting times before a replica is loaded again.

        Raises:
            ConfigError: the file cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
        """
        path, beginning = path_of(file, "Keeper", "file"), self._rr_beginning()
        name = "keeper" if beginning is None else beginning.name
        self._group_server = f"{name}/group"
        self._configuration = LastGood(beginning, lambda: one_file(path), self._parse)
        self._loop: PlanningLoop[Slot | str, WantedReplica | None] = PlanningLoop("keeper", self._look, self._rr_failed)
        record = None if beginning is None else KeptRecord(beginning.directory / "scales.json", KeptScales)
        self._scaler = Scaler(self._loop, record, self._parts_of, self._registrar_of)
        self._backoff = backoff
        self._failures: Setbacks[Slot] = Setbacks(backoff)
        self._not_before: dict[str, float] = {}
        self._stuck: dict[str, str] = {}  # by query: why it could not be released
        self._errors: dict[Slot, RrError] = {}  # of load callbacks: they know more than what their callers hear
        self._held_since: dict[str, float] = {}
        self._messages: dict[str, str] = {}
        self._said: dict[str, str] = {}  # by resource of `kept`: what its holders have heard
        self._lost: set[str] = set()
        self._is_full = False  # something of the last look could not be written
        self._what: dict[str, bytes] = {}  # by query, as its replica does not change
        self._wanted: tuple[Desired, dict[str, int], list[tuple[WantedReplica, Replica]]] | None = None
        self._reports: dict[str, KeptReport] | None = None

    def on_start(self) -> None:
        """Go on with what is held."""
        self.registrar.on_status(f"{self.registrar.name}/replica", self._hear)
        self._loop.start()

    def on_stop(self) -> None:
        """Begin no more steps."""
        self._loop.stop()

    @property
    def _desired(self) -> Desired:
        return self._configuration.now

    def _parse(self, sources: Sources) -> Desired:
        ((file, data),) = sources.items()
        return parse_desired(data, file, self._group_server)

    # -- messages --------------------------------------------------------------------------------------------------

    def apply(self, file: str | os.PathLike[str]) -> list[str]:
        """Keep what another TOML file wants instead, also after a restart, until a start finds the first file changed.

        Return a line for each change, when the steps that follow from it have begun: "~ camera: replicas 3 -> 1".
        Another line says so if the disk does not take it: it is written when there is room.

        Raises:
            ConfigError: the file cannot be read, or is wrong. Nothing has changed.
        """
        return self._apply(one_file(path_of(file, "apply", "file")))

    def get(self) -> list[Kept]:
        """Return how all that is kept is."""
        return [_kept(report) for report in self._newest_reports().values()]

    def diff(self, file: str | os.PathLike[str] | None = None) -> list[str]:
        """Return a line for each thing that is not as it is wanted; or for each change that apply(file) would make.

        Raises:
            ConfigError: the file cannot be read, or is wrong.
        """
        if file is None:
            return self._differences()
        return changes(self._desired, self._parse(one_file(path_of(file, "diff", "file"))))

    @table(
        "kept",
        TableColumn("name", "kept"),
        TableColumn("ready", kind="number", of="wanted"),
        TableColumn("range"),
        TableColumn("scaled", kind="long"),
        TableColumn("why", kind="problem"),
        TableColumn("detail", kind="problem"),
    )
    def kept_rows(self) -> list[dict[str, Any]]:
        """Return how all that is kept is, with the detail of what is not ready."""
        rows: list[dict[str, Any]] = []
        for one in self._newest_reports().values():
            range_ = "" if one.least is None else f"{one.least}-{one.most}"
            rows.append(msgspec.structs.asdict(one) | {"range": range_})
        return rows

    def on_receive(self, message: Any) -> Any:
        """Answer what `rr-actors apply` and `rr-actors keep` ask."""
        match message:
            case {"apply": str(text), "file": str(file)}:
                return self._apply({file: text.encode()})
            case {"diff": str(text), "file": str(file)}:
                return changes(self._desired, self._parse({file: text.encode()}))
            case {"diff": None}:
                return self._differences()
            case {"get": None}:
                return self.kept_rows()
            case _:
                raise UsageError(f"{self.registrar.name}: expected a question to a Keeper, got {shown(message)}")

    def _apply(self, sources: Sources) -> list[str]:
        before = self._desired
        is_kept = self._configuration.apply(sources)
        made = changes(before, self._desired)
        self._loop.tell(self._failures.clear)  # what failed is tried again at once
        self._loop.look_and_wait(_APPLY_S)
        return made if is_kept else [*made, "! this is not on disk yet: a restart now would not know of it"]

    def _differences(self) -> list[str]:
        behind = [one for one in self._newest_reports().values() if one.why]
        return [f"{one.name}: {_said(one)}" for one in behind]

    # -- servers ---------------------------------------------------------------------------------------------------

    @server("kept", recovery="keep")
    def load_kept(self, request: str) -> Kept:
        """Return how what is kept under this name is."""
        reports = self._newest_reports()
        if request not in reports:
            raise self._not_found("keep", request, reports)
        self._loop.wake()  # the looks that follow tell what changes until this is loaded
        return _kept(reports[request])

    @server("group", recovery="keep")
    async def load_group(self, request: str) -> None:
        """Load the members of a group, in their order."""
        if request not in self._desired.groups:
            raise self._not_found("group", request, self._desired.groups)
        for member in self._desired.groups[request].member:
            await self._load_part(member.server, member.request)

    @server("replica", recovery="keep")
    async def load_replica(self, request: Replica) -> None:
        """Load what is kept, as a part. It is cancelled, and its part is withdrawn, when the keeper withdraws it."""
        slot = request.keep, request.instance
        self._errors.pop(slot, None)
        try:
            for member in request.members or (request,):
                await self._load_part(member.server, member.request)
        except RrError as error:
            self._errors[slot] = error
            raise

    async def _load_part(self, server_id: str, request: Request) -> None:
        await self.registrar.load_async(server_id, NO_FIELDS if request is None else request, timeout_s=None)

    def _not_found(self, table: str, name: str, known: Any) -> NotFound:
        text = f"{self.registrar.name}: no {table} {shown(name)}: expected one of {few(known) or 'none'}"
        return NotFound(text + did_you_mean(name, known), id=name, known=tuple(known))

    # -- the loop ----------------------------------------------------------------------------------------------------

    def _look(self, now: float) -> float | None:
        """Compare once, and begin the steps; return when to look again, None if all is well."""
        desired = self._desired
        infos = self.registrar.resources()
        seen = list(self._seen(infos, now))
        held = Counter(one.keep for one in seen if one.phase == "held")
        counts = self._scaler.counts(desired.keeps.values(), held, now)
        if self._wanted is None or self._wanted[0] is not desired:
            self._tell_groups(infos, desired)
        if self._wanted is None or self._wanted[0] is not desired or self._wanted[1] != counts:
            self._wanted = desired, counts, desired.replicas(self._group_server, counts)
        replicas = self._wanted[2]
        wanted, requests = [one for one, _ in replicas], {one.slot: replica for one, replica in replicas}
        self._failures.keep_only(requests)
        self._note_losses(seen, now)
        steps = comparing.compare(wanted, seen, self._failures, now)
        self._is_full = False
        self._carry_out(steps, requests)
        ready: dict[str, list[str]] = {}
        for one in seen:
            if one.is_ready:
                ready.setdefault(one.keep, []).append(one.id)
        read_at = self._scaler.begin(ready, now)
        found = comparing.report(desired.keeps, wanted, seen, self._failures)
        self._reports = reports = {name: self._scaler.told(name, one) for name, one in found.items()}
        self._tell(infos, reports)
        times = [time_ for time_ in (steps.next_at, read_at) if time_ is not None]
        if any(info.server == "kept" and info.phase is Phase.LOADING for info in infos):
            times.append(now + _SOON_S)
        is_kept = self._configuration.catch_up() and self._scaler.catch_up()
        is_behind = self._is_full or not is_kept or bool(steps.release) or any(one.why for one in reports.values())
        if steps.next_at is not None or is_behind or any(isinstance(key, str) for key in self._loop.in_flight):
            times.append(now + _LOOK_S)
        return min(times, default=None)

    # -- what is there ---------------------------------------------------------------------------------------------

    def _seen(self, infos: list[ResourceInfo], now: float) -> Iterator[SeenReplica]:
        """Yield the replicas that are being loaded, that are held, and that nobody holds any more.

        What a load in flight has made is a part of that load, also if the registrar lists it as held already.
        """
        loading = dict[bytes, WantedReplica]()
        for step in self._loop.in_flight.values():
            if (one := step.what) is not None:
                loading[one.what] = one
                yield SeenReplica(one.keep, one.instance, one.what, "loading", is_slow=now - step.since >= _LOOK_S)
        by_id = {info.id: info for info in infos}
        held = set[str]()
        for query in self.registrar.queries():
            if query.server == "replica" and self._is_own(query):
                held.add(query.resource_id)
                one = self._held(query, by_id.get(query.resource_id))
                if one.what not in loading:
                    yield one
        for info in infos:
            if info.server == "replica" and info.id not in held and (what := encode(info.request)) not in loading:
                yield SeenReplica(info.request.keep, info.request.instance, what, "ending")

    def _is_own(self, query: Query) -> bool:
        return query.registrar == self.registrar.name and not query.parent

    def _held(self, query: Query, info: ResourceInfo | None) -> SeenReplica:
        replica: Replica = query.request
        if query.id not in self._what:
            self._what[query.id] = encode(replica)
        return SeenReplica(
            replica.keep,
            replica.instance,
            self._what[query.id],
            "releasing" if query.id in self._loop.in_flight else "held",
            query.id,
            State.FATAL if query.released else State(query.state),
            info.priority if info is not None and info.queries == (query.id,) else _priority(query),
            self._messages.get(query.id, ""),
            self._not_before.get(query.id, 0.0),
            self._stuck.get(query.id, ""),
        )

    def _note_losses(self, seen: list[SeenReplica], now: float) -> None:
        """Note each replica that has been lost, once, and forget what is not held any more."""
        held = {one.id for one in seen if one.id}
        for known in (self._held_since, self._messages, self._not_before, self._stuck, self._what):
            for id in [id for id in known if id not in held]:
                del known[id]
        for one in seen:
            if one.id and one.id not in self._held_since:
                self._held_since[one.id] = now
            if one.state is State.FATAL and one.id not in self._lost:
                self._lost.add(one.id)
                ran_s = now - self._held_since[one.id]
                self._failures.note(one.slot, now, ran_s=ran_s, reason=comparing.FAILING, text=one.message)
        self._lost &= held

    # -- steps -----------------------------------------------------------------------------------------------------

    def _carry_out(self, steps: ReplicaSteps, requests: dict[Slot, Replica]) -> None:
        for one in steps.withdraw:
            self._loop.withdraw(one.slot)
        for one in steps.release:
            if one.state is State.FATAL or self._mark_lost(one):
                self._release(one, [part.id for part in reversed(self._parts_of(one.id))])
        for one, priority in steps.prioritise:
            with self._unless_full(), contextlib.suppress(UsageError):  # gone, or the registrar has a `max_priority`
                self.registrar.set_priority(one.id, priority)
        for one in steps.load:
            self._load(one, requests[one.slot])

    def _load(self, one: WantedReplica, replica: Replica) -> None:
        place = f"{self.registrar.name}/replica"
        begin = functools.partial(
            self.registrar.load, place, replica, priority=one.priority, timeout_s=None, block=False
        )
        self._loop.begin(one.slot, one, begin, functools.partial(self._loaded, one))

    def _loaded(self, one: WantedReplica, ended: StepEnded) -> None:
        if ended.error is not None:
            known = self._errors.get(one.slot) or ended.error
            logger.info("%s %d: %s", one.keep, one.instance, text_of(known))
            self._failures.note(one.slot, time.monotonic(), reason=_reason_of(known), text=text_of(known))

    def _mark_lost(self, one: SeenReplica) -> bool:
        """Write that a replica is not to be used any more, before its parts go. Return whether that is on disk."""
        with self._unless_full():
            self._lost.add(one.id)
            with contextlib.suppress(UsageError):  # it has just gone
                self.registrar.send_status(one.id, Status(State.FATAL, "it is being released"))
            return True
        return False

    def _parts_of(self, id: str) -> list[Query]:
        """Return a replica's parts, in their order."""
        try:
            return self.registrar.children(id)
        except UnknownQuery:  # it has just gone
            return []

    def _registrar_of(self, name: str) -> Registrar:
        return registrar_in(self._rr_node, name, patient=False, owner=self)

    def _release(self, one: SeenReplica, parts: Sequence[str]) -> None:
        """Release a replica after its parts. If one cannot be unloaded, it may be running still, and stays a part."""
        if parts:
            release = functools.partial(self.registrar.unload, parts[0], timeout_s=_PART_S, block=False)
            self._loop.begin(one.id, None, release, functools.partial(self._part_released, one, parts[1:]))
        else:
            release = functools.partial(self.registrar.unload, one.id, timeout_s=None, block=False)
            self._loop.begin(one.id, None, release, functools.partial(self._released, one))

    def _part_released(self, one: SeenReplica, parts: Sequence[str], ended: StepEnded) -> None:
        if isinstance(ended.error, UnloadFailed):
            self._released(one, ended)
        else:  # a provider that does not run has it later: the release is owed
            self._release(one, parts)

    def _released(self, one: SeenReplica, ended: StepEnded) -> None:
        if ended.error is not None and not isinstance(ended.error, UnknownQuery):
            logger.warning("%s %d cannot be released: %s", one.keep, one.instance, text_of(ended.error))
            self._not_before[one.id] = time.monotonic() + self._backoff.maximum_s
            self._stuck[one.id] = text_of(ended.error)

    @contextlib.contextmanager
    def _unless_full(self) -> Generator[None]:
        """Do what is written to the catalog; if the disk is full, the next look does it again."""
        try:
            yield
        except CatalogError:  # the registrar has logged it
            self._is_full = True

    # -- what others hear ------------------------------------------------------------------------------------------

    def _hear(self, status: Status) -> None:
        """Note a status of a replica. It is about the replica alone: the keeper's own resources do not hear it."""
        self._loop.tell(functools.partial(self._messages.__setitem__, status.query_id, status.message))

    def _tell(self, infos: list[ResourceInfo], reports: dict[str, KeptReport]) -> None:
        """Tell the holders of `kept` what has changed."""
        for info in infos:
            if info.server != "kept" or info.phase is not Phase.LOADED or info.status is State.FATAL:
                continue
            report = reports.get(info.request, KeptReport(info.request, 0, 0, "not kept"))
            with self._unless_full(), contextlib.suppress(UsageError):  # it has just been unloaded
                self._tell_one(info, report)

    def _tell_one(self, info: ResourceInfo, report: KeptReport) -> None:
        said, state = _said(report), _state_of(report)
        is_new = info.response != _kept(report)
        if is_new:
            self.registrar.update_response(info, _kept(report), said)
        if state is State.OK:
            is_news = info.status in (State.WARNING, State.ERROR)
        else:
            is_news = is_new or info.status is not state or info.message != said
        if is_news:
            self.registrar.send_status(info, Status(state, said))

    def _tell_groups(self, infos: list[ResourceInfo], desired: Desired) -> None:
        """Tell the holders of each group whether it is still as the file says."""
        for info in infos:
            if info.server != "group" or info.phase is not Phase.LOADED or info.status is State.FATAL:
                continue
            members = desired.groups[info.request].member if info.request in desired.groups else ()
            wanted = [encode([member.server, member.request]) for member in members]
            with self._unless_full(), contextlib.suppress(UsageError):  # it has just been unloaded
                parts = self.registrar.children(info)
                if wanted != [encode([f"{part.registrar}/{part.server}", part.request]) for part in parts]:
                    self.registrar.send_status(info, Status(State.WARNING, _GROUP_CHANGED))
                elif info.message == _GROUP_CHANGED:
                    self.registrar.send_status(info, Status(State.OK, "the group is as it was loaded again"))

    def _newest_reports(self) -> dict[str, KeptReport]:
        """Return the reports of the last look, or, before the first, of nothing."""
        if self._reports is not None:
            return self._reports
        wanted = [one for one, _ in self._desired.replicas(self._group_server)]
        return comparing.report(self._desired.keeps, wanted, [], {})


def _priority(query: Query) -> int | None:
    try:
        return query.priority
    except UnknownQuery:  # it has just gone
        return 0


def _reason_of(error: BaseException) -> str:
    if isinstance(error, (UnknownServer, UnknownRegistrar, RegistrarDown)):
        return comparing.NONE_REGISTERED
    return comparing.OVER_CAPACITY if isinstance(error, OverCapacity) else comparing.FAILING


def _kept(report: KeptReport) -> Kept:
    return Kept(report.name, report.wanted, report.ready, report.why, report.least, report.most, report.scaled)


def _said(report: KeptReport) -> str:
    """Return a report as a text for people."""
    return ": ".join(filter(None, (f"{report.ready} of {report.wanted} ready", report.why, report.detail)))


def _state_of(report: KeptReport) -> State:
    if not report.why:
        return State.OK
    return State.ERROR if report.ready == 0 and report.is_hindered else State.WARNING
