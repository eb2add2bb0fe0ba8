"""Server: one kind of resource of one registrar. It runs its callbacks in workers and reports how they ended.

The context of a running callback says for which resource and which attempt it runs. A load inside the callback belongs
to that resource. The context is a contextvar: tasks and asyncio.to_thread inherit it. Threads that a callback starts by
hand do not; they pass ``parent=rr.current()``.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import threading
import time
import zlib
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextvars import ContextVar
from typing import Any, NoReturn, cast

import msgspec

from rr_actors.base.checks import check_takes, examined, is_number, wrong_label
from rr_actors.base.errors import (
    CircularDependency,
    GraphError,
    InvalidResponse,
    InvalidSpec,
    LoadFailed,
    MailboxFull,
    NameTaken,
    NotSerializable,
    OverCapacity,
    RrError,
    Unavailable,
    UsageError,
    is_a,
    readable,
    shortened,
    shown,
    text_of,
)
from rr_actors.base.names import check_name, named, new_id, short_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import Codec, encode, shown_plain, text_of_value
from rr_actors.base.values.failure import Failure, failure_of
from rr_actors.base.values.type_shapes import digest_of
from rr_actors.registrar.core.callback_runs import deaths_of, is_given_up, running
from rr_actors.registrar.core.decide import Item
from rr_actors.registrar.engine.fields import annotated_types, by_fields, field_names, hints_of
from rr_actors.registrar.engine.progress import checked
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.status import Status, status_of
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.failures import not_run_again
from rr_actors.registrar.model.health import WELL, Health, ProbeCounts, ProbeResult, first_counts, judged
from rr_actors.registrar.model.messages import Described, Load
from rr_actors.registrar.model.rows import (
    LOADED,
    LOADING,
    PAUSED,
    PAUSING,
    RESUMING,
    UNLOADING,
    Notice,
    Phase,
    Resource,
    State,
)
from rr_actors.runtime.callback_errors import Raised, described, log_raised, traceback_of
from rr_actors.runtime.thread_rules import on_loop, with_lock
from rr_actors.runtime.time_limits import Probes
from rr_actors.runtime.user_loop import COROUTINE, Done, closing
from rr_actors.runtime.workers import Gate, is_async
from rr_actors.streams.publisher import Publisher
from rr_actors.streams.stream import StreamNews
from rr_actors.wire.frames import ADVICE
from rr_actors.wire.name_service import LABELS_BYTES


class Role(msgspec.Struct, frozen=True, eq=False):
    """One kind of callback of a server; ROLES has all of them.

    Attributes:
        name: its field in ServerSpec.
        arguments: what the callback is called with.
        phase: the phase of the resource until the callback returns; None: nothing waits for it.
        reports: whether it may report progress.
        patient: whether it waits for a free thread however many do so; else it is refused then.
        in_order: whether the callbacks of one resource run one after another.
        counted: the name under which core/callback_runs.py counts the processes that died in its runs; "" for a load or
            unload, whose rows count their runs themselves.
    """

    name: str
    arguments: tuple[str, ...]
    phase: Phase | None = None
    reports: bool = False
    patient: bool = False
    in_order: bool = False
    counted: str = ""


LOAD = Role("load", ("request",), LOADING, reports=True)
UNLOAD = Role("unload", ("request", "response"), UNLOADING, patient=True)
STATUS = Role("status", ("request", "status"), in_order=True, counted="status")
RECOVER = Role("recover", ("request", "response"), LOADED, reports=True, patient=True, counted="recover")
UPGRADE = Role("upgrade", ("request", "response"))
USAGE = Role("usage", ("request", "response"), patient=True, counted="usage")
PROBE = Role("probe", ("request", "response"), patient=True, counted="health")
PAUSE = Role("pause", ("request", "response"), PAUSING, patient=True, counted="pause")
RESUME = Role("resume", ("request", "response"), RESUMING, patient=True, counted="resume")
ROLES = {role.name: role for role in (LOAD, UNLOAD, STATUS, RECOVER, UPGRADE, USAGE, PROBE, PAUSE, RESUME)}


class Current(msgspec.Struct, frozen=True):
    """The call of a callback, as the callback may know it.

    Attributes:
        resource_id: the resource that the callback loads, unloads, or hears about.
        attempt: 1 at first; more if a crash interrupted an earlier attempt.
        origin: the name of the registrar that holds the resource: of its present holders, the one that asked first.
        server: the server's name, as it was registered.
        interrupted: in an unload callback, whether the load callback never returned; the response is None then. The
            load was withdrawn or given up after a crash. Nothing, a part or all of the resource may have been loaded.
    """

    # `_registrar` is the actor of the serving registrar. `_run` is the number of the run in decisions: of a load,
    # a recovery, a pause or a resumption its load's, of an unload its own.

    resource_id: str
    attempt: int
    origin: str
    server: str
    _registrar: RegistrarBase
    _role: Role
    _run: int
    interrupted: bool = False
    _request: bytes = b""
    _runs_again: bool = True  # a callback runs after a crash of the manager

    @property
    def name(self) -> str:
        """The resource's name for people, its server and its request, shortened: `cameras/camera "/dev/video7"`."""
        return named(f"{self._registrar.name}/{self.server}", text_of_value(self._request))

    def progress(self, fraction: float, text: str = "") -> None:
        """Report how far the load has come, in its load or recover callback, from any thread.

        All consumers that wait for the load hear it (`progress=` of Registrar.load). At most ten reports a second are
        sent: the newest ones, and always the last. A report does not wait, may be lost, and is not kept.

        Args:
            fraction: from 0.0 to 1.0.
            text: what the callback does now, for people; at most 500 characters.

        Raises:
            UsageError: `fraction` or `text` is something else, or this is an unload or status callback.
        """
        number, words = checked(fraction, text)
        if not self._role.reports:
            what = f"{self._registrar.name}/{self.server}: progress() in its {self._role.name} callback"
            allowed = " and ".join(role.name for role in ROLES.values() if role.reports)
            raise UsageError(f"{what}: only {allowed} callbacks report it")
        self._registrar.progress.report(self.resource_id, number, words)

    @property
    def stopping(self) -> threading.Event:
        """The event that tells a load or recover callback that it may give up: nobody needs its result any more.

        It is set when all who waited for the load have withdrawn it, and when the callback is overdue. It is set when
        the registrar is closed, as when its process stops. The callback is not interrupted: it waits or asks, as in
        ``while not rr.current().stopping.wait(0.1)``, cleans up, and raises. If the load succeeds, it is not set. An
        ``async def`` callback need not ask: it is cancelled then.

        If somebody asks for the resource again before a stopped callback has raised, the callback runs once more.

        Raises:
            UsageError: this is another callback.
        """
        phase = self._role.phase
        if phase is None or not self._role.reports:
            what = f"{self._registrar.name}/{self.server}: stopping in its {self._role.name} callback"
            raise UsageError(f"{what}: only load and recover callbacks have it")
        return self._registrar.stop_event(self.resource_id, phase, self._run)

    @property
    def loaded(self) -> threading.Event:
        """The event that is set when the load is over, for a thread that its load or recover callback has started.

        The response is on disk then, and can be replaced (`update_response`). It is set as well when the load has
        failed, or the registrar is closed: what the thread calls then raises.

        Raises:
            UsageError: this is another callback.
        """
        if not self._role.reports:
            what = f"{self._registrar.name}/{self.server}: loaded in its {self._role.name} callback"
            raise UsageError(f"{what}: only load and recover callbacks have it")
        return self._registrar.load_over(self.resource_id)

    def open_stream(self, name: str = "stream") -> Publisher:
        """Open a stream of the resource, in its load or recover callback: its holders read it with Query.stream().

        It is closed when the unload callback has returned. After a crash of the manager, open it again in the callback
        that runs then: those who read it go on. With recovery="keep" and no recover callback, none runs: the log says
        so, and the iterations of those who read it end with Unavailable, thirty seconds after a crash.

        Raises:
            InvalidName: `name` is none.
            NameTaken: the resource has a stream of this name. `.name`
            UsageError: no load or recover callback of the resource runs here.
            Unavailable: there can be no socket or no thread for it.
        """
        if not self._role.reports or _current.get() is not self:
            place = "outside" if self._role.reports else "in"
            what = f"{self._registrar.name}/{self.server}: open_stream() {place} its {self._role.name} callback"
            raise UsageError(f"{what}: only load and recover callbacks open streams, while they run")
        once = "" if self._runs_again else f"{self._registrar.name}/{self.server}"
        return self._registrar.publishers.open(self.resource_id, name, once)


_current: ContextVar[Current | None] = ContextVar("rr_current", default=None)


def current() -> Current:
    """Return the context of the callback that this code runs in.

    Raises:
        UsageError: this code does not run in a callback.
    """
    context = _current.get()
    if context is None:
        expected = "expected to be called in a load, unload, status or recover callback, or in one for usage"
        raise UsageError(f"rr.current(): {expected}")
    return context


current_or_none: Callable[[], Current | None] = _current.get
"""Return the context of the callback that this code runs in; None outside of callbacks."""


def serving(current: Current) -> RegistrarBase:
    """Return the actor of the registrar that runs the callback."""
    return current._registrar  # pyright: ignore[reportPrivateUsage]  # same file


def _run_of(current: Current) -> int:
    return current._run  # pyright: ignore[reportPrivateUsage]  # same file


def _role_of(current: Current) -> Role:
    return current._role  # pyright: ignore[reportPrivateUsage]  # same file


def begin(current: Current) -> None:
    """Make current() return `current` in this context, which belongs to the callback."""
    _current.set(current)
    if serving(current).node.watched.level[0] > 1:
        _record("began", current)


def _record(event: str, current: Current, detail: str = "") -> None:
    registrar = serving(current)
    server = f"{registrar.name}/{current.server}"
    registrar.recorder.callback(event, server, _role_of(current).name, current.resource_id, detail)


def status_callback_of(registrar: RegistrarBase) -> str:
    """Return the id of the resource whose status callback this code runs in, if the registrar serves it; else ""."""
    me = _current.get()
    return me.resource_id if me is not None and _role_of(me) is STATUS and serving(me) is registrar else ""


def check_not_measuring(registrar: RegistrarBase) -> None:
    """Raise UsageError in a usage callback of the registrar: it would ask for its own end."""
    me = _current.get()
    if me is not None and _role_of(me) is USAGE and serving(me) is registrar:
        text = f"{registrar.name}/{me.server}: usage() in its usage callback: it would wait for itself"
        raise UsageError(text, registrar=registrar.name, resource_id=me.resource_id)


def check_not_own(what: str, waits_for: Callable[[Current], bool], instead: str) -> None:
    """Raise if `what` would wait for the callback that this code runs in.

    A task that runs on after its callback has returned may wait.

    Args:
        waits_for: whether the call waits for such a callback while that runs. Called with the lock of its registrar.
        instead: what to do instead, for the error's text.

    Raises:
        UsageError: the call would wait for itself. `.registrar`, `.server`, `.resource_id`
    """
    me = _current.get()
    if me is None or (phase := _role_of(me).phase) is None or serving(me).closed:
        return
    with serving(me).lock:
        catalog = serving(me).whole()
        is_running = running(catalog, me.resource_id, phase, _run_of(me)) is not None
        if not is_running or (phase is LOADED and me.resource_id not in catalog.recovering) or not waits_for(me):
            return
    name = serving(me).name
    whose = f"the callback that {_role_of(me).name}s resource {me.resource_id} of {name}/{me.server}"
    text = f"{what} waits for {whose}, and is called in it: it would wait for itself; {instead}"
    raise UsageError(text, registrar=name, server=f"{name}/{me.server}", resource_id=me.resource_id)


# -- the server --------------------------------------------------------------------------------------------------------

logger = Log("rr_actors.server")

Callback = Callable[..., Any]
RECOVERY = ("keep", "reload", "lost")
_MOST_NUMBERS = 50
_NEWEST = 500  # load callbacks of a server, of which the times are kept
_TOO_GREAT = 2**63  # as a console's answer has room for
RECOVER_S = 30.0
"""How long a recover callback may take, if its server says nothing else."""

Labels = Mapping[str, Mapping[str, str | int | float | bool]]
"""What the resources of a server provide, by kind: `{"range": {"rate_hz": 30}}`."""

_NO_HEALTH = Health()
_CAREFUL_S = 60.0  # so long after its start, a process writes down which health callbacks run
_ROW_BYTES = 1024  # room for the names and ids that are sent with a request, a response, or types


class ServerSpec(msgspec.Struct, frozen=True):
    """The callbacks and settings that a server is registered with; Registrar.register_server describes them."""

    name: str
    load: Callback
    unload: Callback | None = None
    status: Callback | None = None
    recover: Callback | None = None
    request_type: Any = None
    response_type: Any = None
    linger_s: float = 0.0
    load_timeout_s: float | None = None
    recovery: str | None = None  # None: "keep", as nothing was said
    recover_timeout_s: float | None = RECOVER_S
    upgrade: Callback | None = None
    usage: Callback | None = None
    idle: str = "unload"
    paused_s: float | None = None
    pause: Callback | None = None
    resume: Callback | None = None
    health: Health | None = None
    probe: Callback | None = None
    provides: Labels | None = None
    at_once: int | None = None  # None: as many as ask

    @property
    def labels(self) -> str:
        """What it provides, as JSON; "" for nothing."""
        return msgspec.json.encode(self.provides).decode() if self.provides else ""


class Usages(dict[str, dict[str, float]]):
    """What resources use: by resource id, the numbers that the usage callback of its server has returned.

    Attributes:
        failures: by resource id, why a usage is not known: its callback raised, has not returned in time, or returned
            something else than a dict of finite numbers.
    """

    def __init__(self, usages: Mapping[str, dict[str, float]], failures: dict[str, str]) -> None:
        super().__init__(usages)
        self.failures = failures


Measured = dict[str, float] | str | None
"""The usage of a resource, or why it is not known; None if the resource is not loaded any more."""


class LoadTimes:
    """How many load callbacks of one server have ended since it was registered, and how long they took. Any thread.

    Attributes:
        loaded, failed: how many have returned, and raised.
        seconds: how long they took together.
        longest_s: how long the longest took.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: deque[float] = deque(maxlen=_NEWEST)
        self.loaded = self.failed = 0
        self.seconds = self.longest_s = 0.0

    def take(self, began_s: float, *, failed: bool) -> None:
        """Count a callback that began at this time of the monotonic clock, and has ended now."""
        took_s = time.monotonic() - began_s
        with self._lock:
            self.failed += failed
            self.loaded += not failed
            self.seconds += took_s
            self.longest_s = max(self.longest_s, took_s)
            self._newest.append(took_s)

    def p95_s(self) -> float:
        """Return the time within which 95 % of the newest 500 callbacks ended; 0.0 if none has ended."""
        with self._lock:
            newest = sorted(self._newest)
        return newest[math.ceil(0.95 * len(newest)) - 1] if newest else 0.0


class ServerActor:
    """Runs one server's callbacks, each in a worker (``async def`` ones as tasks), each with its context.

    The registrar tells it which callback to start; it posts LoadDone, LoadErred and so on back. Callbacks of different
    resources run at the same time, unless its manager is serial, or it has `at_once`; status callbacks of one resource
    run one after another.

    Raises:
        InvalidSpec: a callback has attributes that cannot be read.
        NotSerializable: the types are too long to be sent to consumers.
    """

    def __init__(self, registrar: RegistrarBase, spec: ServerSpec, types: bytes) -> None:
        self.spec = spec
        self.restored = False  # whether it came from the catalog; then a second registration replaces it
        has = spec.status is not None, spec.recover is not None
        limits = spec.linger_s, spec.load_timeout_s, spec.recovery or "keep"
        checksum = zlib.crc32(types)
        idle = spec.idle == "pause", spec.paused_s
        self.facts = Server(spec.name, *limits, *has, types, checksum, spec.recover_timeout_s, *idle)  # for decisions
        self.registrar = registrar
        self.origin = f"{registrar.name}/{spec.name}"
        self._runs_again = spec.recover is not None or self.facts.recovery != "keep"
        if (size := len(types) + _ROW_BYTES) > (limit := registrar.node.config.frame_limit_bytes):
            text = f"{self.origin}: types: {size} bytes are over the limit of {limit} (frame_limit_bytes)"
            raise NotSerializable(f"{text}: have a module that others can import, or raise the limit", path="types")
        self.request = Codec(spec.request_type, f"{self.origin}: request")
        self.response = Codec(spec.response_type, f"{self.origin}: response")
        self.digest = digest_of((self.request.shape, self.response.shape))
        one, both = self._request_of, self._request_and_response_of
        encoded = self.response.encode
        self._runs = {
            LOAD: self._described(LOAD, one, encoded),
            UNLOAD: self._described(UNLOAD, both, _nothing),
            RECOVER: self._described(RECOVER, both, encoded),
            STATUS: self._described(STATUS, one, _nothing),
            USAGE: self._described(USAGE, both, self._numbers),
            PAUSE: self._described(PAUSE, both, _nothing),
            RESUME: self._described(RESUME, both, self._new_response),
            PROBE: self._described(PROBE, self._probe_arguments, self._found),
        }
        self.load_times = LoadTimes()
        self._measuring: dict[str, Future[Measured]] = {}
        health = spec.health or _NO_HEALTH
        loop, rounds = registrar.node.dispatcher.loop, (health.every_s, health.timeout_s)
        self.probes = Probes(loop, *rounds, self._probed, self._probe, self._probe_late)
        self._health, self._counts = health, dict[str, ProbeCounts]()  # by resource
        self._inherited = self._held_before() if spec.health else frozenset[str]()
        self._careful_until = math.inf
        self._gate = registrar.gate or (None if spec.at_once is None else Gate(spec.at_once))

    def _described(
        self, role: Role, arguments: Callable[[Resource], tuple[Any, ...]], result: Callable[[Any], Any]
    ) -> Callback:
        what = f"{self.origin}: {role.name}"
        callback = getattr(self.spec, role.name) or _nothing
        try:
            taking = checked_callback(callback, role, self.spec.request_type, f"server {self.spec.name!r}")
            wrapped = _wrap(taking, arguments, result)
        except Exception as error:
            expected = "a callable whose attributes can be read"
            text = f"{what}: expected {expected}, got {shown(callback)}: {text_of(error)}"
            raise InvalidSpec(text, field=role.name, expected=expected, got=callback) from None
        return described(wrapped, what, self._describe)

    def _describe(self, error: BaseException) -> tuple[Failure, list[tuple[str, str]]]:
        """Return the failure and the trace that describe a callback's error. In the thread that ran the callback."""
        return self.load_failure(error), failure_of(error, self.origin).trace

    # -- what an earlier version stored --------------------------------------------------------------------------

    def reread(self, resources: Iterable[Resource], digest: bytes) -> tuple[c.Reread, ...]:
        """Read stored requests and responses by today's types; return what differs. Not on the loop: users' code runs.

        What does not fit goes through the upgrade callback, if there is one. With an unchanged digest of the types only
        users' code, such as a __post_init__, may read a value in another way than before.
        """
        if digest and digest == self.digest:
            resources = (it for it in resources if self._runs_code(it))
        return tuple(found for resource in resources if (found := self._reread(resource)) is not None)

    def _runs_code(self, resource: Resource) -> bool:
        response = resource.response
        return self.request.runs_code(resource.request) or (response is not None and self.response.runs_code(response))

    def _reread(self, resource: Resource) -> c.Reread | None:
        place, response = resource.id, resource.response
        try:
            request = self.request.today(resource.request)
            if response is not None:
                self.response.decode(response, "", "response")
        except RrError as error:
            misfit = f"{error.message}, stored by an earlier version"
        else:
            return None if request == resource.request else c.Reread(place, request, response)
        if self.spec.upgrade is not None:
            try:
                return self._upgraded(resource, self.spec.upgrade)
            except Exception as error:
                text = readable(text_of(error))
                logger.exception("%s: the upgrade callback raised for resource %s", self.origin, place)
                misfit += f", and the upgrade callback raised {text}"
        logger.error("%s: resource %s is lost: %s", self.origin, place, misfit)
        return c.Reread(place, resource.request, response, misfit)

    def _upgraded(self, resource: Resource, upgrade: Callback) -> c.Reread:
        old = None if resource.response is None else shown_plain(resource.response)
        request, response = upgrade(shown_plain(resource.request), old)
        new = self.request.canonical(encode(request), self.origin)
        answer = None if resource.response is None else self.response.encode(response, self.origin)
        if (error := self.too_long(msgspec.structs.replace(resource, request=new), answer)) is not None:
            raise error
        return c.Reread(resource.id, new, answer)

    # -- load ----------------------------------------------------------------------------------------------------

    def readable(self, load: Load) -> Load | c.RefuseLoad:
        """Return a consumer's Load with its request in canonical form, or the refusal of a request that cannot be read.

        A worker calls it if reading the request runs user code.
        """
        try:
            canonical = self.request.canonical(load.request, self.origin)
        except RrError as error:
            return c.RefuseLoad(load.origin, load.query_id, failure_of(error))
        return load if canonical == load.request else msgspec.structs.replace(load, request=canonical)

    @on_loop
    def start_load(self, resource: Resource) -> None:
        """Run the load callback."""
        began_s = time.monotonic()
        done = functools.partial(self._load_ended, resource, began_s)
        at_once = functools.partial(self._loaded, resource, began_s)
        self._submit(LOAD, resource, resource.attempt, done, at_once=at_once)

    def _loaded(self, resource: Resource, began_s: float, response: bytes) -> bool:
        """Decide LoadDone in the thread that ran the callback; return False if the loop has to."""
        reports = self.registrar.progress
        if self.too_long(resource, response) is not None or (reports.loads and not reports.forget_sent(resource.id)):
            return False
        self._let_in(resource)
        is_decided = self.registrar.decide_here(c.LoadDone(resource.id, resource.attempt, response))
        if is_decided:
            self.load_times.take(began_s, failed=False)
        return is_decided

    def _load_ended(self, resource: Resource, began_s: float, response: bytes, error: BaseException | None) -> None:
        self.registrar.progress.end(resource.id)
        error = error or self.too_long(resource, response)
        self.load_times.take(began_s, failed=error is not None)
        if error is None:
            self._let_in(resource)
            self.registrar.post(c.LoadDone(resource.id, resource.attempt, response))
        else:
            self.registrar.publishers.close(resource.id)
            self.registrar.post(c.LoadErred(resource.id, resource.attempt, self.load_failure(error)))

    def _let_in(self, resource: Resource) -> None:
        """Let readers in to the streams that a callback has opened."""
        if self.registrar.publishers.streams:  # most registrars have none
            self.registrar.publishers.let_in(resource.id, functools.partial(self._tell, resource))

    def _tell(self, resource: Resource, news: StreamNews) -> None:
        """Tell the watchers of the system what has happened to a stream. From any thread."""
        node = self.registrar.node
        if not node.watched.level[0]:
            return
        facts = {"registrar": self.registrar.name, "server": self.origin, "resource_id": resource.id}
        facts |= {"request": text_of_value(resource.request), "stream": news.stream.name, "detail": news.stream.name}
        if (before := news.before) is not None:
            instead = f"{before.name} of resource {short_id(before.resource_id)}"
            facts["detail"] += f", read by {news.reader} instead of {instead}"
            facts |= {"reader": news.reader, "before": f"{before.resource_id}/{before.name}"}
        with contextlib.suppress(Unavailable):  # the loop has ended
            node.dispatcher.call(functools.partial(node.emit, news.what, **facts))

    def too_long(self, resource: Resource, response: bytes | None) -> NotSerializable | None:
        """Return the error for a response that, with its request, is too long for a frame; None if it is not."""
        limit = self.registrar.node.config.frame_limit_bytes
        size = len(resource.request) + len(response or b"")
        if size + _ROW_BYTES <= limit:
            return None
        why = f"request and response: {size} bytes are over the limit of {limit} (frame_limit_bytes, less {_ROW_BYTES})"
        return NotSerializable(f"{why}: {ADVICE}", path="response")

    def load_failure(self, error: BaseException) -> Failure:
        """Return the failure that consumers hear if a load callback raises; a group of one error is that error."""
        if type(error) is Raised:
            return error.details[0]
        error = _alone(error)
        described = failure_of(error, self.origin)
        if isinstance(error, (CircularDependency, GraphError, OverCapacity)):
            return described
        if isinstance(error, LoadFailed):
            text, lines = described.message, error.traceback
        else:
            text, lines = text_of(error), traceback_of(error)
        details = {"server": self.origin, "traceback": lines}
        return Failure("LoadFailed", readable(f"{self.origin}: {text}"), details, described.trace)

    # -- unload --------------------------------------------------------------------------------------------------

    @on_loop
    def start_unload(self, resource: Resource) -> None:
        """Run the unload callback; without one, the resource counts as unloaded at once."""
        if self.spec.unload is None:
            self.registrar.publishers.close(resource.id)
            self.registrar.post(c.UnloadDone(resource.id, resource.tries))
            return

        def at_once(_result: None) -> bool:
            self.registrar.publishers.close(resource.id)
            return self.registrar.decide_here(c.UnloadDone(resource.id, resource.tries))

        done = functools.partial(self._unload_ended, resource)
        start = functools.partial(self._submit, UNLOAD, resource, resource.tries, done, at_once=at_once)
        self.probes.when_free(resource.id, start)

    def _unload_ended(self, resource: Resource, _result: None, error: BaseException | None) -> None:
        if error is None:
            self.registrar.publishers.close(resource.id)
            self.registrar.post(c.UnloadDone(resource.id, resource.tries))
            return
        trace = error.details[1] if type(error) is Raised else failure_of(error, self.origin).trace
        text = readable(f"{self.origin}: {_text_of(error)}")
        log_raised(logger, error, "%s; resource %s is kept as unload_failed", text, resource.id)
        text += "; the resource is kept as unload_failed, and may be unloaded again"
        failure = Failure("UnloadFailed", text, {"resource_id": resource.id, "server": self.origin}, trace)
        self.registrar.post(c.UnloadErred(resource.id, resource.tries, failure))

    # -- recover -------------------------------------------------------------------------------------------------

    @on_loop
    def start_recover(self, resource: Resource, reload: bool) -> None:
        """Ask the recover callback whether the resource lives, or load the resource again."""
        run = self._runs[LOAD] if reload or self.spec.recover is None else None
        self._submit(RECOVER, resource, resource.attempt, functools.partial(self._recover_ended, resource), run=run)

    def _recover_ended(self, resource: Resource, response: bytes | None, error: BaseException | None) -> None:
        self.registrar.progress.end(resource.id)
        error = error or self.too_long(resource, response)
        if error is None:
            self._let_in(resource)
            self.registrar.post(c.RecoverDone(resource.id, resource.attempt, response, new_id()))
            return
        self.registrar.publishers.close(resource.id)
        text = readable(f"lost: {self.origin}: {_text_of(error)}")
        logger.warning("%s (resource %s)", text, resource.id)
        failure = Failure("LoadFailed", text, {"server": self.origin})
        self.registrar.post(c.RecoverErred(resource.id, resource.attempt, failure, new_id()))

    # -- pause and resume ----------------------------------------------------------------------------------------

    @on_loop
    def start_pause(self, resource: Resource) -> None:
        """Run the pause callback."""
        done = functools.partial(self._pause_ended, resource)
        self.probes.when_free(resource.id, functools.partial(self._submit, PAUSE, resource, resource.attempt, done))

    def _pause_ended(self, resource: Resource, _result: None, error: BaseException | None) -> None:
        if error is None:
            self.registrar.post(c.PauseDone(resource.id, resource.attempt))
            return
        text = readable(f"{self.origin}: pause: {_text_of(error)}")
        log_raised(logger, error, "%s; resource %s runs on", text, resource.id)
        failure = Failure("LoadFailed", text, {"server": self.origin})
        self.registrar.post(c.PauseErred(resource.id, resource.attempt, failure))

    @on_loop
    def start_resume(self, resource: Resource) -> None:
        """Run the resume callback; without one, as the server does not pause any more, the resource runs."""
        self._submit(RESUME, resource, resource.attempt, functools.partial(self._resume_ended, resource))

    def _new_response(self, answer: Any, where: str = "") -> bytes | None:
        return None if answer is None else self.response.encode(answer, where or self.origin)

    def _resume_ended(self, resource: Resource, response: bytes | None, error: BaseException | None) -> None:
        error = error or self.too_long(resource, response)
        if error is None:
            self.registrar.post(c.ResumeDone(resource.id, resource.attempt, response, new_id()))
            return
        text = readable(f"lost: {self.origin}: resume: {_text_of(error)}")
        logger.warning("%s (resource %s)", text, resource.id)
        failure = Failure("LoadFailed", text, {"server": self.origin})
        self.registrar.post(c.ResumeErred(resource.id, resource.attempt, failure, new_id()))

    # -- status --------------------------------------------------------------------------------------------------

    @on_loop
    def start_status(self, resource: Resource, notice: Notice, *, repeated: bool) -> None:
        """Run the status callback for a status of the resource, or of one of its parts."""
        status = status_of(notice, repeated=repeated)

        def done(_result: None, error: BaseException | None) -> None:
            if error is not None:
                self.registrar.callback_failures += 1
                log_raised(logger, error, "%s: the status callback raised; the status goes on", self.origin)
            self.registrar.post(c.StatusDone(resource.id, notice, status.is_handled))

        self._submit(STATUS, resource, resource.attempt, done, status)

    # -- usage ---------------------------------------------------------------------------------------------------

    @on_loop
    def measure(self, resource: Resource) -> Future[Measured]:
        """Have the usage callback run; the future gets its numbers, or why there are none; None if it is unloaded.

        While a callback runs, no other one begins for the same resource: one that hangs takes one thread.
        """
        known = self._measuring.get(resource.id)
        if known is not None:
            return known
        future = Future[Measured]()
        catalog = self.registrar.catalog
        if is_given_up(catalog, "usage", resource.id):
            future.set_result(not_run_again(catalog, resource, "usage", deaths_of(catalog, "usage", resource.id)))
            return future
        self._measuring[resource.id] = future
        self.registrar.post(c.BeginRun("usage", resource.id, self.spec.name))
        return future

    @on_loop
    def start_usage(self, resource_id: str) -> None:
        """Run a usage callback that the disk has."""
        future = self._measuring.get(resource_id) or Future[Measured]()

        def done(numbers: dict[str, float] | None, error: BaseException | None) -> None:
            self._measuring.pop(resource_id, None)
            self.registrar.post(c.RunEnded("usage", resource_id))
            left = self.registrar.catalog.resources.get(resource_id)
            if left is None or left.phase not in (LOADED, PAUSED):
                future.set_result(None)
            else:
                future.set_result(numbers if error is None else f"{self.origin}: usage: {readable(_text_of(error))}")

        resource = self.registrar.catalog.resources.get(resource_id)
        if resource is None:
            done(None, None)
        else:
            self._submit(USAGE, resource, resource.attempt, done)

    def _numbers(self, answer: object) -> dict[str, float]:
        expected = f"a dict of at most {_MOST_NUMBERS} finite numbers by name"
        numbers = cast("dict[Any, Any] | None", answer if is_a(answer, dict) else None)
        if numbers is None or len(numbers) > _MOST_NUMBERS:
            got = cast("object", answer)
            text = f"expected {expected}, got {shown(got)} ({type(got).__name__})"
            raise InvalidResponse(text, server=self.origin, path="", expected=expected)
        for name, number in numbers.items():
            if type(name) is not str or not is_number(number) or abs(number) >= _TOO_GREAT:
                text = f"expected {expected}, got {shown(number)} ({type(number).__name__}) as {shown(name)}"
                raise InvalidResponse(text, server=self.origin, path=shown(name), expected=expected)
        return {name: number + 0 for name, number in numbers.items()}  # of the plain types: they travel

    # -- health --------------------------------------------------------------------------------------------------

    @on_loop
    def open_probes(self) -> None:
        """Begin to probe. Before on_start has returned, the health callback may lack what that makes."""
        if self.spec.health is not None:
            self._careful_until = time.monotonic() + _CAREFUL_S
            self.probes.open()

    @on_loop
    def _probed(self) -> list[str]:
        """Return the resources of the next round, and forget the results of the others."""
        with self.registrar.lock:
            ids = list(self.registrar.whole().by_server.get(self.spec.name, ()))
        ids = [id for id in ids if self._is_probed(id)]
        self._counts = {id: counts for id in ids if (counts := self._counts.get(id)) is not None}
        return ids

    def _is_probed(self, resource_id: str) -> bool:
        catalog = self.registrar.catalog
        resource = catalog.resources.get(resource_id)
        lives = resource is not None and resource.phase is LOADED and resource.state is not State.FATAL
        return lives and resource_id not in catalog.recovering and resource_id not in catalog.revocations

    @on_loop
    def _probe(self, ids: Sequence[str]) -> None:
        """Have the health callback run for each of these resources."""
        self.registrar.workers.threads.gather()
        try:
            for id in ids:
                resource = self.registrar.catalog.resources.get(id)
                if resource is not None and self._is_suspect(id):
                    self.registrar.post(c.BeginRun("health", id, self.spec.name))
                elif resource is None:
                    self.probes.ended(id)
                else:
                    self._submit(PROBE, resource, resource.attempt, functools.partial(self._probe_ended, id))
        finally:
            self.registrar.workers.threads.go()

    def _held_before(self) -> frozenset[str]:
        with self.registrar.lock:
            return frozenset(self.registrar.whole().by_server.get(self.spec.name, ()))

    def _is_suspect(self, resource_id: str) -> bool:
        """Return whether the process before may have died in this callback: the disk has its next runs first.

        A row for each run would cost too much for ever. The first death of a process in a health callback counts as any
        other crash does.
        """
        return resource_id in self._inherited and time.monotonic() < self._careful_until

    @on_loop
    def start_probe(self, resource_id: str) -> None:
        """Run a health callback that the disk has."""
        resource = self.registrar.catalog.resources.get(resource_id)
        if not self.probes.is_waiting(resource_id):  # for a server of this name that was here before
            self.registrar.post(c.RunEnded("health", resource_id))
        elif resource is None:
            self.probes.ended(resource_id)
        else:
            done = functools.partial(self._suspect_ended, resource_id)
            self._submit(PROBE, resource, resource.attempt, done)

    def _suspect_ended(self, resource_id: str, found: ProbeResult | None, error: BaseException | None) -> None:
        self.registrar.post(c.RunEnded("health", resource_id))
        self._probe_ended(resource_id, found, error)

    def _probe_arguments(self, resource: Resource) -> tuple[Any, Any]:
        if not self.probes.begins(resource.id, self._is_probed):
            raise Unavailable(f"{self.origin}: resource {resource.id} is not probed now")
        return self._request_and_response_of(resource)

    def _found(self, answer: object) -> ProbeResult:
        if answer is None:
            return WELL
        status = answer if is_a(answer, Status) else None
        state = answer if status is None else status.state
        if not is_a(state, State) or state is State.UPDATE:
            expected = "None, or the State OK, WARNING, ERROR or FATAL, or a Status with one"
            text = f"expected {expected}, got {shown(answer)} ({type(answer).__name__})"
            raise InvalidResponse(text, server=self.origin, path="", expected=expected)
        return ProbeResult(State(state), "" if status is None else status.message)

    def _probe_ended(self, resource_id: str, found: ProbeResult | None, error: BaseException | None) -> None:
        if self.probes.ended(resource_id):
            self._judge(resource_id, found or ProbeResult(State.ERROR, "" if error is None else _text_of(error)), error)

    def _probe_late(self, resource_id: str) -> None:
        self._judge(resource_id, ProbeResult(State.ERROR, f"not returned within {self._health.timeout_s:g} s"))

    def _judge(self, resource_id: str, found: ProbeResult, error: BaseException | None = None) -> None:
        """Count a result, and set the status of the resource if its state changes by that."""
        if self.registrar.closed or not self._is_probed(resource_id):
            return
        counts = self._counts.get(resource_id) or first_counts(self.registrar.catalog.resources[resource_id].state)
        self._counts[resource_id], state = judged(self._health, counts, found, self.probes.ran_s())
        if state is None:
            return
        text = readable(f"health: {found.message or found.state}")
        if error is not None:
            log_raised(logger, error, "%s: %s; resource %s has the state %s", self.origin, text, resource_id, state)
        self.registrar.post(c.SetStatus(resource_id, new_id(), state, text, _nothing))

    # -- how callbacks run ---------------------------------------------------------------------------------------

    def _submit(
        self,
        role: Role,
        resource: Resource,
        number: int,
        done: Done,
        *more: Any,
        run: Callback | None = None,
        at_once: Callable[[Any], bool] | None = None,
    ) -> None:
        catalog = self.registrar.catalog
        holder = catalog.holder_of(resource.id)
        interrupted = role is UNLOAD and resource.response is None
        counts = role.counted and run is None  # else a reload, whose attempts the row counts
        attempt = deaths_of(catalog, role.counted, resource.id) + 1 if counts else number
        place = resource.id, attempt, holder, self.spec.name, self.registrar
        current = Current(*place, role, number, interrupted, resource.request, self._runs_again)
        run = self._runs[role] if run is None else run
        workers, gate = self.registrar.workers, self._gate
        if self.registrar.node.watched.level[0] > 1:
            done, at_once = _recorded(current, done, at_once)
        try:
            if role.in_order:
                run = run if gate is None else gate.around(run, enters=True)
                workers.serial((role.name, resource.id), run, current, resource, *more, done=done)
            elif gate is None:
                workers.submit(run, current, resource, *more, done=done, patient=role.patient, at_once=at_once)
            else:
                self._enter(gate, role, run, (current, resource, *more), done, at_once)
        except (MailboxFull, Unavailable) as error:
            done(None, error)

    def _enter(
        self,
        gate: Gate,
        role: Role,
        run: Callback,
        args: tuple[Any, ...],
        done: Done,
        at_once: Callable[[Any], bool] | None,
    ) -> None:
        """Run a callback when it has room in the gate. It needs no thread before."""
        registrar, key = self.registrar, f"{role.name}:{args[1].id}"
        inside = gate.around(run, enters=False)
        registrar.outside.add(key)

        def ended(result: Any, error: BaseException | None) -> None:
            if error is not None and type(error) is not Raised:  # it got no thread, and so has not left the gate
                gate.leave()
            done(result, error)

        def begin() -> bool:
            registrar.outside.discard(key)
            call = registrar.node.dispatcher.call
            try:
                call(registrar.runner.let_in, key)
                registrar.workers.submit(inside, *args, done=ended, patient=True, at_once=at_once)
            except Unavailable as error:
                with contextlib.suppress(Unavailable):  # the process ends
                    call(done, None, error)
                return False
            return True

        gate.enter(begin)

    def _request_of(self, resource: Resource) -> tuple[Any]:
        return (self.request.decode(resource.request, self.origin),)

    def _request_and_response_of(self, resource: Resource) -> tuple[Any, Any]:
        request = self.request.decode(resource.request, self.origin)
        if resource.response is None:
            return request, None
        return request, self.response.decode(resource.response, self.origin, "response")


def _recorded(
    current: Current, done: Done, at_once: Callable[[Any], bool] | None
) -> tuple[Done, Callable[[Any], bool] | None]:
    """Return `done` and `at_once` changed to record the callback's end first, and only once."""
    ended: list[bool] = []

    def recorded(result: Any, error: BaseException | None) -> None:
        if not ended:
            _record("ended", current, "" if error is None else readable(shortened(_text_of(error))))
        done(result, error)

    def recorded_at_once(result: Any) -> bool:
        ended.append(True)
        _record("ended", current)
        return at_once is not None and at_once(result)

    return recorded, None if at_once is None else recorded_at_once


def _wrap(
    callback: Callback, arguments: Callable[[Resource], tuple[Any, ...]], result: Callable[[Any], Any]
) -> Callback:
    """Return a function that decodes the arguments, calls the callback, and encodes its result. Off the loop."""

    async def run_async(current: Current, resource: Resource, *more: Any, begun: Any = None) -> Any:
        while not _is_over(current):
            begin(current)
            try:
                answer = result(await _heeding(current, begun or callback(*arguments(resource), *more)))
            except BaseException as error:
                begun = None
                if not _may_run_again(current, error):
                    raise
            else:
                _end_run(current)
                return answer
        return None

    def run(current: Current, resource: Resource, *more: Any) -> Any:
        while not _is_over(current):
            begin(current)
            try:
                answer = callback(*arguments(resource), *more)
                if type(answer) is COROUTINE:  # the callback is a wrapper or a lambda around an async function
                    return closing(answer, run_async(current, resource, *more, begun=answer))
                answer = result(answer)
            except BaseException as error:
                if not _may_run_again(current, error):
                    raise
            else:
                _end_run(current)
                return answer
        return None

    return run_async if is_async(callback) else run


async def _heeding(current: Current, answer: Awaitable[Any]) -> Any:
    """Await the answer of a callback. If it may be stopped, it is cancelled when nobody needs it any more."""
    role, task = _role_of(current), asyncio.current_task()
    if role.phase is None or not role.reports or task is None:
        return await answer
    cancel = functools.partial(_cancel, asyncio.get_running_loop(), task)
    serving(current).stop_event(current.resource_id, role.phase, _run_of(current), cancel)
    return await answer


def _cancel(loop: asyncio.AbstractEventLoop, task: asyncio.Task[Any]) -> None:
    with contextlib.suppress(RuntimeError):  # the loop is closed, and has cancelled its tasks
        loop.call_soon_threadsafe(task.cancel)


def _may_run_again(current: Current, error: BaseException) -> bool:
    """Note that a run has ended by an error; return whether it was told to stop, and its result is needed again."""
    if not _end_run(current):
        return False
    if not isinstance(error, asyncio.CancelledError):
        return isinstance(error, Exception)
    if (task := asyncio.current_task()) is not None:
        while task.cancelling():
            task.uncancel()
    return True


def _end_run(current: Current) -> bool:
    role = _role_of(current)
    if role.phase is None or not role.reports:
        return False
    return serving(current).end_run(current.resource_id, role.phase, _run_of(current))


def _is_over(current: Current) -> bool:
    """Return whether a callback must not begin any more: its registrar is closed, or its resource is being unloaded.

    Of a closed registrar nothing is decided, so its callback's result does not matter.
    """
    registrar = serving(current)
    if registrar.closed or _role_of(current) is not STATUS:
        return registrar.closed
    resource = registrar.catalog.resources.get(current.resource_id)
    return resource is None or resource.phase is UNLOADING


def _text_of(error: BaseException) -> str:
    return error.text if type(error) is Raised else text_of(error)


def _alone(error: BaseException) -> BaseException:
    """Return the only error of a group of errors, however deep; else return the error as it is."""
    if not isinstance(error, BaseExceptionGroup):
        return error
    group = cast("BaseExceptionGroup[BaseException]", error)
    return _alone(group.exceptions[0]) if len(group.exceptions) == 1 else group


def _nothing(*_: Any) -> None:
    return None


class Servers:
    """The servers of one registrar, by name; get() returns None if there is none."""

    def __init__(self, registrar: RegistrarBase, consumers: Consumers) -> None:
        self._registrar = registrar
        self._consumers = consumers
        self._by_name: dict[str, ServerActor] = {}
        self.get: Callable[[str], ServerActor | None] = self._by_name.get

    def names(self) -> list[str]:
        """Return the names of all servers, in the order in which they were registered."""
        return list(self._by_name)

    @on_loop
    def register(self, server: ServerActor, reread: tuple[c.Reread, ...] = ()) -> None:
        """Add a server, and go on with its resources; raise NameTaken if there is a server of that name."""
        registrar, name = self._registrar, server.spec.name
        old = self._by_name.get(name)
        if old is not None and not old.restored:
            text = f"server {server.origin}: registered already; unregister it first, or take another name"
            raise NameTaken(text, name=name)
        registrar.node.directory.put_labels(registrar.name, name, server.spec.labels)
        self._by_name[name] = server
        if old is not None:
            old.probes.close()
        self._consumers.tell_all(Described(name, server.facts.types))
        if old is None:
            registrar.post(c.Register(server.facts, new_id(), reread, server.digest))
        else:
            registrar.catalog.servers[name] = server.facts
        if registrar.serving:
            server.open_probes()

    @on_loop
    def open_probes(self) -> None:
        """Begin to probe, as on_start has returned."""
        for server in self._by_name.values():
            server.open_probes()

    @on_loop
    def close(self) -> None:
        """Probe nothing more."""
        for server in self._by_name.values():
            server.probes.close()

    @on_loop
    def register_again(self) -> None:
        """Register all servers again, in a catalog that was read anew."""
        for server in self._by_name.values():
            self._registrar.post(c.Register(server.facts, new_id()))

    @on_loop
    def unregister(self, name: str, done: Callable[[RrError | None], None]) -> None:
        """Remove a server when all its resources are released; `done` hears how that ended."""
        registrar = self._registrar

        def ended(error: RrError | None) -> None:
            if name not in registrar.catalog.servers and (server := self._by_name.pop(name, None)) is not None:
                server.probes.close()
                registrar.node.directory.put_labels(registrar.name, name, "")
            done(error)

        registrar.post(c.Unregister(name, new_id(), ended))

    # -- requests that consumers have sent ----------------------------------------------------------------------------

    @on_loop
    def read_first(self, load: Load, sender: str) -> bool:
        """Have a worker read the request first if that runs user code, and return whether it does."""
        registrar, server = self._registrar, self.get(load.server)
        if server is None or not server.request.runs_code(load.request):
            return False
        with registrar.lock:
            if self._is_read(load):
                return False
        link_of = self._consumers.link_of
        link = link_of(sender)

        def done(read: Load | c.RefuseLoad, error: BaseException | None) -> None:
            if registrar.closed or link_of(sender) is not link:  # the consumer sends it again over the next link
                return
            if self.get(load.server) is not server:  # unregistered meanwhile, and perhaps registered anew
                registrar.receive(load, sender)
                return
            if error is not None:
                read = c.RefuseLoad(sender, load.query_id, failure_of(error))
            registrar.deliver(read, sender if type(read) is Load else None)
            registrar.progress.greet(sender, load.query_id)

        try:
            registrar.workers.submit(server.readable, load, done=done)
        except MailboxFull as error:
            done(load, error)
        except Unavailable:  # this process is stopping
            pass
        return True

    @with_lock
    def read(self, load: Load, sender: str | None) -> Item:
        """Return the Load in canonical form, or its refusal; a worker has read it already if that runs user code."""
        server = self.get(load.server)
        if server is None or self._is_read(load) or server.request.runs_code(load.request):
            return load, sender
        read = server.readable(load)
        return read, sender if type(read) is Load else None

    @with_lock
    def _is_read(self, load: Load) -> bool:
        """Return whether the Load can be decided without reading its request."""
        catalog = self._registrar.whole()
        known = catalog.queries.get(load.query_id)
        if known is not None:
            return known.resource_id not in catalog.recovering  # such a resource may have to be loaded anew
        return load.query_id in catalog.refused or catalog.joinable(load.server, load.request) is not None


def checked_callback(callback: Callback, role: Role, request_type: Any, who: str) -> Callback:
    """Return a function that takes the arguments of the role: the callback itself, unless it takes fields.

    Raises:
        InvalidSpec: the callback takes others.
    """
    names = field_names(request_type)
    if names is not None:
        return by_fields(callback, role.name, role.arguments, names, who)
    check_takes(callback, role.arguments, who, role.name)
    return callback


def checked_spec(spec: ServerSpec) -> ServerSpec:
    """Check what a server is registered with; read its types from the annotations of `load` if none are given.

    Raises:
        InvalidName, InvalidSpec: a field is wrong; the error says which.
    """
    name = check_name(spec.name, "server name")
    who = f"server {name!r}"
    with examined(who):
        request, response = annotated_types(spec.load, who) if callable(spec.load) else (None, None)
        request = request if spec.request_type is None else spec.request_type
        for field, role in ROLES.items():
            callback = getattr(spec, field)
            if callable(callback):
                checked_callback(callback, role, request, who)
            elif field == "load" or callback is not None:
                _invalid(name, field, "a callable", callback)
        if spec.upgrade is not None and is_async(spec.upgrade):
            _invalid(name, "upgrade", "a function that is not async", spec.upgrade)
        if spec.recovery is not None and spec.recovery not in RECOVERY:
            _invalid(name, "recovery", "one of " + ", ".join(map(repr, RECOVERY)), spec.recovery)
        if not is_number(spec.linger_s) or spec.linger_s < 0:
            _invalid(name, "linger_s", "seconds, 0 or more", spec.linger_s)
        _check_idle(name, spec)
        if spec.health is not None and not is_a(spec.health, Health):
            _invalid(name, "health", "an rr.Health or None", spec.health)
        if spec.at_once is not None and (type(spec.at_once) is not int or spec.at_once < 1):
            _invalid(name, "at_once", "a whole number of at least 1, or None", spec.at_once)
        for field in ("load_timeout_s", "recover_timeout_s"):
            limit_s = getattr(spec, field)
            if limit_s is not None and not (is_number(limit_s) and limit_s > 0):
                _invalid(name, field, "seconds greater than 0, or None", limit_s)
        return msgspec.structs.replace(
            spec,
            name=name,
            request_type=request,
            response_type=response if spec.response_type is None else spec.response_type,
            linger_s=float(spec.linger_s),
            provides=_checked_labels(name, spec.provides),
        )


def _checked_labels(name: str, provides: object) -> Labels | None:
    """Return the labels as plain dicts, which can travel."""
    if provides is None:
        return None
    expected = "a dict of kinds, each with a dict of what it provides"
    if not is_a(provides, Mapping):
        _invalid(name, "provides", expected, provides)
    found: dict[object, Any] = {}
    for kind, labels in cast("Mapping[object, object]", provides).items():
        if not is_a(kind, str) or not kind:
            _invalid(name, "provides", "kinds, each a text", kind)
        if not is_a(labels, Mapping):
            _invalid(name, f"provides.{kind}", expected, labels)
        if (wrong := wrong_label(cast("Mapping[str, object]", labels))) is not None:
            _invalid(name, ".".join(filter(None, ("provides", kind, wrong.key))), wrong.expected, wrong.got)
        found[kind] = dict(cast("Mapping[object, object]", labels))
    if (size := len(msgspec.json.encode(found))) > LABELS_BYTES:
        _invalid(name, "provides", f"at most {LABELS_BYTES} bytes as JSON", size)
    return cast("Labels", found)


def _check_idle(name: str, spec: ServerSpec) -> None:
    if spec.idle not in ("unload", "pause"):
        _invalid(name, "idle", "'unload' or 'pause'", spec.idle)
    if spec.paused_s is None:
        return
    if not is_number(spec.paused_s) or spec.paused_s < 0:
        _invalid(name, "paused_s", "seconds, 0 or more, or None", spec.paused_s)
    if spec.idle != "pause":
        _invalid(name, "paused_s", "None, as idle is not 'pause'", spec.paused_s)


def checked_whole(spec: ServerSpec) -> ServerSpec:
    """Check that a server has the callbacks that its options need, and no others; all are known now.

    Raises:
        InvalidSpec: pause, resume or the health callback is missing, or never called.
    """
    if spec.health is not None and spec.probe is None:
        _invalid(spec.name, "probe", "a callable, the health callback, as there is a health", spec.probe)
    if spec.health is None and spec.probe is not None:
        _invalid(spec.name, "probe", "health=rr.Health(...), without which it is never called", spec.probe)
    for field in ("pause", "resume"):
        callback = getattr(spec, field)
        if spec.idle == "pause" and callback is None:
            _invalid(spec.name, field, "a callable, as idle is 'pause'", callback)
        if spec.idle != "pause" and callback is not None:
            _invalid(spec.name, field, "idle='pause', without which it is never called", callback)
    return spec


def log_unread_types(spec: ServerSpec, server: str) -> None:
    """Log a warning if an annotation names a type that cannot be found: the values are plain then, and not checked."""
    if spec.request_type is not None or spec.response_type is not None:
        return  # the types were read, or given
    try:
        hints_of(spec.load)
    except NameError as error:
        logger.warning(
            "%s: the annotations of its load callback cannot be read (%s): requests and responses are plain values, "
            "and not checked; import the type outside TYPE_CHECKING, or give request_type and response_type",
            server,
            error,
        )
    except Exception:  # no annotation was meant as a type: `load` is a builtin, say
        return


def _invalid(name: str, field: str, expected: str, got: object) -> NoReturn:
    text = f"server {name!r}: {field}: expected {expected}, got {shown(got)} ({type(got).__name__})"
    raise InvalidSpec(text, field=field, expected=expected, got=got)
