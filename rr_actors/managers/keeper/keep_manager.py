"""Keeper: the manager that keeps what a file wants.

Each replica is a resource of the keeper's own server `replica`, and what is kept is its part. So the catalog alone
says what is there, also after a crash. One thread looks, compares (comparing.py), and begins the steps. All else that
happens only wakes it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, cast

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import (
    CatalogError,
    ConfigError,
    MailboxFull,
    NotFound,
    OverCapacity,
    RegistrarDown,
    RrError,
    UnknownQuery,
    UnknownRegistrar,
    UnknownServer,
    UsageError,
    did_you_mean,
    few,
    shown,
    text_of,
)
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import read_bytes
from rr_actors.base.values.canonical import encode
from rr_actors.managers.keeper import comparing
from rr_actors.managers.keeper.comparing import Failure, Report, Seen, Slot, Steps, Wanted
from rr_actors.managers.keeper.desired import Desired, Replica, Request, changes, parse_desired
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.registrar.declarations import server
from rr_actors.registrar.engine.status import Status
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import Phase, State
from rr_actors.registrar.queries import Query, ResourceInfo
from rr_actors.registrar.registrar import NO_FIELDS
from rr_actors.supervision.core.specs import Backoff

logger = Log("rr_actors.managers.keeper")

BACKOFF = Backoff(delay_s=0.1, factor=2.0, maximum_s=5.0, jitter=0.0)
_SOON_S = 0.05  # so long after a look the next one, while a holder's response is on its way
_LOOK_S = 1.0  # while something is not as it is wanted, it looks so often: not every end is announced
_APPLY_S = 30.0


class Kept(msgspec.Struct, frozen=True):
    """The response: how what is kept under a name is. It changes with each UPDATE.

    Attributes:
        name: the name in the file.
        wanted, ready: how many replicas.
        why: why others are not ready: "none registered", "over capacity", "failing", "all failing", "waits for NAME",
            "loading", or several of them; "" if all are.
    """

    name: str
    wanted: int
    ready: int
    why: str = ""


class _Record(msgspec.Struct):
    """What apply() has set, and the text of the file that it replaced."""

    replaced: str = ""
    text: str = ""
    file: str = ""


class _Loading(msgspec.Struct):
    """A load that has not been answered."""

    wanted: Wanted
    future: Reply[Query]
    since: float


class _Failed:
    """The message that the thread has failed with an error."""

    __match_args__ = ("error",)

    def __init__(self, error: Exception) -> None:
        self.error = error


class Keeper(Manager):
    """Keeps what a TOML file wants: loads what is missing or lost, and releases what is not wanted.

    Serves `kept`: a request is a name of the file, and the response is a Kept. Its holders hear WARNING while replicas
    are not ready, and ERROR when none is, for a reason that time alone does not end. Serves `group`: a request is the
    name of a group of the file, whose members are loaded as parts. Kubernetes calls such a manager a controller.
    """

    def __init__(self, file: str | os.PathLike[str], backoff: Backoff = BACKOFF) -> None:
        """Read what is to be kept from a TOML file. `backoff`: the waiting times before a replica is loaded again.

        Raises:
            ConfigError: the file cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
        """
        self._file = str(Path(file).absolute())
        self._text = read_bytes(self._file)
        self._configured = parse_desired(self._text, self._file)
        self._backoff = backoff
        self._happened: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._loading: dict[Slot, _Loading] = {}
        self._releasing: set[str] = set()
        self._not_before: dict[str, float] = {}
        self._failures: dict[Slot, Failure] = {}
        self._errors: dict[Slot, RrError] = {}  # of load callbacks: they know more than what their callers hear
        self._held_since: dict[str, float] = {}
        self._messages: dict[str, str] = {}
        self._lost: set[str] = set()
        self._is_full = False  # something of the last look could not be written
        self._what: dict[str, bytes] = {}  # by query, as its replica does not change
        self._wanted: tuple[Desired, list[tuple[Wanted, Replica]]] | None = None
        self._reports: dict[str, Report] | None = None

    def on_start(self) -> None:
        """Go on with what is held."""
        self.registrar.on_status(f"{self.registrar.name}/replica", self._hear)
        threading.Thread(target=self._run, name="keeper", daemon=True).start()

    def on_stop(self) -> None:
        """Begin no more steps."""
        self._happened.put(None)

    # -- messages --------------------------------------------------------------------------------------------------

    def apply(self, file: str | os.PathLike[str]) -> list[str]:
        """Keep what another TOML file wants instead, also after a restart, until the first file changes.

        Return a line for each change, when the steps that follow from it have begun: "~ camera: replicas 3 -> 1".

        Raises:
            ConfigError: the file cannot be read, or is wrong. Nothing has changed.
        """
        path = str(Path(file).absolute())
        return self._apply(read_bytes(path), path)

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
        path = str(Path(file).absolute())
        return changes(self._desired, parse_desired(read_bytes(path), path))

    def on_receive(self, message: Any) -> Any:
        """Answer what `rr-actors apply` and `rr-actors keep` ask."""
        match message:
            case {"apply": str(text), "file": str(file)}:
                return self._apply(text.encode(), file)
            case {"diff": str(text), "file": str(file)}:
                return changes(self._desired, parse_desired(text.encode(), file))
            case {"diff": None}:
                return self._differences()
            case _Failed(error):
                raise error
            case {"get": None}:
                return [msgspec.structs.asdict(report) for report in self._newest_reports().values()]
            case _:
                raise UsageError(f"{self.registrar.name}: expected a question to a Keeper, got {shown(message)}")

    def _apply(self, data: bytes, file: str) -> list[str]:
        wanted = parse_desired(data, file)
        made = changes(self._desired, wanted)
        self._record.now = _Record(self._text.decode(), data.decode(), file)
        self._record.save()
        done = threading.Event()
        self._desired = wanted
        self._happened.put(lambda: self._failures.clear())  # what failed is tried again at once
        self._happened.put(lambda: self._look(done))
        done.wait(_APPLY_S)
        return made

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
        self._happened.put(lambda: None)  # the looks that follow tell what changes until this is loaded
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
            await self._load_part(request.server, request.request)
        except RrError as error:
            self._errors[slot] = error
            raise

    async def _load_part(self, server_id: str, request: Request) -> None:
        await self.registrar.load_async(server_id, NO_FIELDS if request is None else request, timeout_s=None)

    def _not_found(self, table: str, name: str, known: Any) -> NotFound:
        text = f"{self.registrar.name}: no {table} {shown(name)}: expected one of {few(known) or 'none'}"
        return NotFound(text + did_you_mean(name, known), id=name, known=tuple(known))

    # -- the thread that looks -------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Look, and look again after each thing that happens, until the registrar is closed."""
        try:
            wait_s = self._look()
            while True:
                for happened in self._all_that_happened(wait_s):
                    if happened is None:
                        return
                    happened()
                wait_s = self._look()
        except RegistrarDown:
            return
        except Exception as error:  # a fault in here: the manager is to end with it, and to be started again
            self.actor_ref.tell(_Failed(error))

    def _all_that_happened(self, wait_s: float | None) -> Iterator[Callable[[], object] | None]:
        with contextlib.suppress(queue.Empty):
            yield self._happened.get(timeout=wait_s)
            while True:
                yield self._happened.get_nowait()

    def _look(self, done: threading.Event | None = None) -> float | None:
        """Compare once, and begin the steps; return after how many seconds to look again, None if all is well."""
        desired, now = self._desired, time.monotonic()
        if self._wanted is None or self._wanted[0] is not desired:
            self._wanted = desired, desired.replicas(f"{self.registrar.name}/group")
        replicas = self._wanted[1]
        wanted, requests = [one for one, _ in replicas], {one.slot: replica for one, replica in replicas}
        infos = self.registrar.resources()
        seen = list(self._seen(infos))
        self._failures = {slot: failed for slot, failed in self._failures.items() if slot in requests}
        self._note_losses(seen, now)
        steps = comparing.compare(wanted, seen, self._failures, now)
        self._is_full = False
        self._carry_out(steps, requests)
        reports = comparing.report(desired.keeps, wanted, seen, self._failures)
        self._reports = reports
        self._tell(infos, reports)
        if done is not None:
            done.set()
        if any(info.server == "kept" and info.phase is Phase.LOADING for info in infos):
            return _SOON_S
        if steps.next_at is not None:
            return min(_LOOK_S, max(0.0, steps.next_at - now))
        is_behind = any(one.why for one in reports.values()) or bool(steps.release or self._releasing)
        return _LOOK_S if is_behind or self._is_full else None

    # -- what is there ---------------------------------------------------------------------------------------------

    def _seen(self, infos: list[ResourceInfo]) -> Iterator[Seen]:
        """Yield the replicas that are held, that are being loaded, and that nobody holds any more."""
        for loading in self._loading.values():
            one, is_slow = loading.wanted, time.monotonic() - loading.since >= _LOOK_S
            yield Seen(one.keep, one.instance, one.what, "loading", is_slow=is_slow)
        by_id = {info.id: info for info in infos}
        queries = [query for query in self.registrar.queries() if query.server == "replica" and self._is_own(query)]
        for query in queries:
            yield self._held(query, by_id.get(query.resource_id))
        held = {query.resource_id for query in queries}
        started = {loading.wanted.what for loading in self._loading.values()}
        for info in infos:
            if info.server == "replica" and info.id not in held and (what := encode(info.request)) not in started:
                yield Seen(info.request.keep, info.request.instance, what, "ending")

    def _is_own(self, query: Query) -> bool:
        return query.registrar == self.registrar.name and not query.parent

    def _held(self, query: Query, info: ResourceInfo | None) -> Seen:
        replica: Replica = query.request
        if query.id not in self._what:
            self._what[query.id] = encode(replica)
        return Seen(
            replica.keep,
            replica.instance,
            self._what[query.id],
            "releasing" if query.id in self._releasing else "held",
            query.id,
            State.FATAL if query.released else State(query.state),
            info.priority if info is not None and info.queries == (query.id,) else _priority(query),
            self._messages.get(query.id, ""),
            self._not_before.get(query.id, 0.0),
        )

    def _note_losses(self, seen: list[Seen], now: float) -> None:
        """Note each replica that has been lost, once, and forget what is not held any more."""
        held = {one.id for one in seen if one.id}
        for known in (self._held_since, self._messages, self._not_before, self._what):
            for id in [id for id in known if id not in held]:
                del known[id]
        for one in seen:
            if one.id and one.id not in self._held_since:
                self._held_since[one.id] = now
            if one.state is State.FATAL and one.id not in self._lost:
                self._lost.add(one.id)
                self._note_failed(one.slot, now - self._held_since[one.id], comparing.FAILING, one.message)
        self._lost &= held

    def _note_failed(self, slot: Slot, ran_s: float, reason: str, text: str) -> None:
        before, now = self._failures.get(slot), time.monotonic()
        self._failures[slot] = comparing.failure(before, ran_s, now, reason, text, self._backoff)

    # -- steps -----------------------------------------------------------------------------------------------------

    def _carry_out(self, steps: Steps, requests: dict[Slot, Replica]) -> None:
        for one in steps.withdraw:
            self._loading[one.slot].future.cancel()
        for one in steps.release:
            self._release(one)
        for one, priority in steps.prioritise:
            with self._unless_full(), contextlib.suppress(UsageError):  # gone, or the registrar has a `max_priority`
                self.registrar.set_priority(one.id, priority)
        for one in steps.load:
            self._load(one, requests[one.slot])

    def _load(self, one: Wanted, replica: Replica) -> None:
        place = f"{self.registrar.name}/replica"
        try:
            loading = self.registrar.load(place, replica, priority=one.priority, timeout_s=None, block=False)
        except (UsageError, MailboxFull) as error:  # of a priority over the registrar's `max_priority`, for instance
            self._note_failed(one.slot, 0.0, comparing.FAILING, text_of(error))
            return
        future = cast("Reply[Query]", loading)
        self._loading[one.slot] = _Loading(one, future, time.monotonic())
        future.add_done_callback(lambda _: self._happened.put(lambda: self._loaded(one, future)))

    def _loaded(self, one: Wanted, future: Reply[Query]) -> None:
        del self._loading[one.slot]
        if not future.cancelled() and (error := future.exception()) is not None:
            known = self._errors.get(one.slot) or error
            logger.info("%s %d: %s", one.keep, one.instance, text_of(known))
            self._note_failed(one.slot, 0.0, _reason_of(known), text_of(known))

    def _release(self, one: Seen) -> None:
        self._releasing.add(one.id)
        try:
            future = cast("Reply[None]", self.registrar.unload(one.id, timeout_s=None, block=False))
        except UnknownQuery:  # it has just gone
            self._releasing.discard(one.id)
            return
        future.add_done_callback(lambda _: self._happened.put(lambda: self._released(one, future)))

    def _released(self, one: Seen, future: Reply[None]) -> None:
        self._releasing.discard(one.id)
        error = future.exception()
        if error is not None and not isinstance(error, UnknownQuery):
            logger.warning("%s %d cannot be released: %s", one.keep, one.instance, text_of(error))
            self._not_before[one.id] = time.monotonic() + self._backoff.maximum_s

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
        self._happened.put(lambda: self._messages.__setitem__(status.query_id, status.message))

    def _tell(self, infos: list[ResourceInfo], reports: dict[str, Report]) -> None:
        """Tell the holders of `kept` what has changed."""
        for info in infos:
            if info.server != "kept" or info.phase is not Phase.LOADED or info.status is State.FATAL:
                continue
            report = reports.get(info.request, Report(info.request, 0, 0, "not kept"))
            with self._unless_full(), contextlib.suppress(UsageError):  # it has just been unloaded
                self._tell_one(info, report)

    def _tell_one(self, info: ResourceInfo, report: Report) -> None:
        is_new = info.response != _kept(report)
        if is_new:
            self.registrar.update_response(info, _kept(report), _said(report))
        state = _state_of(report)
        if state is State.OK:
            is_news = info.status in (State.WARNING, State.ERROR)
        else:
            is_news = is_new or info.status is not state
        if is_news:
            self.registrar.send_status(info, Status(state, _said(report)))

    def _newest_reports(self) -> dict[str, Report]:
        """Return the reports of the last look, or, before the first, of nothing."""
        if self._reports is not None:
            return self._reports
        wanted = [one for one, _ in self._desired.replicas(f"{self.registrar.name}/group")]
        return comparing.report(self._desired.keeps, wanted, [], {})

    # -- what is wanted --------------------------------------------------------------------------------------------

    @functools.cached_property
    def _record(self) -> KeptRecord[_Record]:
        return KeptRecord(self.registrar.directory / "keeper.json", _Record)

    @functools.cached_property
    def _desired(self) -> Desired:
        """What is wanted: by the file, or by the one that was applied since."""
        record = self._record.now
        if record.file and record.replaced == self._text.decode():
            with contextlib.suppress(ConfigError):  # written by another version
                return parse_desired(record.text.encode(), record.file)
        return self._configured


def _priority(query: Query) -> int | None:
    try:
        return query.priority
    except UnknownQuery:  # it has just gone
        return 0


def _reason_of(error: BaseException) -> str:
    if isinstance(error, (UnknownServer, UnknownRegistrar, RegistrarDown)):
        return comparing.NONE_REGISTERED
    return comparing.OVER_CAPACITY if isinstance(error, OverCapacity) else comparing.FAILING


def _kept(report: Report) -> Kept:
    return Kept(report.name, report.wanted, report.ready, report.why)


def _said(report: Report) -> str:
    """Return a report as a text for people."""
    return ": ".join(filter(None, (f"{report.ready} of {report.wanted} ready", report.why, report.detail)))


def _state_of(report: Report) -> State:
    if not report.why:
        return State.OK
    return State.ERROR if report.ready == 0 and report.is_hindered else State.WARNING
