"""ServerActor: one kind of resource of one registrar. It runs its callbacks in workers, and says how they ended.

In the worker, a request and a response are decoded, the callback is called, and its result is encoded. The end of a run
is heard on the event loop; the end of one that goes well is heard first in the worker, which may deal with it.
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
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import Any

import msgspec

from rr_actors.actors.turns import CLOSED, Delivery, TurnActor
from rr_actors.base.errors import InvalidSpec, MailboxFull, NotSerializable, RrError, Unavailable, shown, text_of
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import Codec
from rr_actors.base.values.failure import failure_of
from rr_actors.base.values.type_shapes import digest_of
from rr_actors.registrar.core.callback_runs import deaths_of
from rr_actors.registrar.core.decide import Item
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import GRACE_S, Callback, ServerSpec, checked_callback
from rr_actors.registrar.engine.status import StatusMessage, status_of
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.commands import CallbackEnded
from rr_actors.registrar.model.effects import StartCallback
from rr_actors.registrar.model.messages import Load
from rr_actors.registrar.model.roles import BEGUN, HEALTH, LOAD, RECOVER, RELOAD, RESUME, STATUS, UNLOAD, USAGE, Role
from rr_actors.registrar.model.rows import UNLOADING, Notice, Resource
from rr_actors.registrar.servers.callback_context import Current, enter
from rr_actors.registrar.servers.on_demand_callbacks import HealthCallbacks, UsageCallbacks
from rr_actors.registrar.servers.request_titles import title_maker
from rr_actors.registrar.servers.server_base import (
    CallbackFailure,
    OnDemandRun,
    RunningCallback,
    failure_of_callback,
    load_failure,
    nothing,
    recorded_end,
    tell_stream,
)
from rr_actors.runtime.callback_errors import Raised, described_error
from rr_actors.runtime.thread_rules import on_loop, with_lock
from rr_actors.runtime.user_loop import COROUTINE, Done, closing
from rr_actors.runtime.workers import Gate, is_async
from rr_actors.wire.frames import ADVICE

logger = Log("rr_actors.server")

_ROW_BYTES = 1024  # room for the names and ids that are sent with a request, a response, or types

Message = StartCallback | OnDemandRun

_NEWEST = 500  # load callbacks of a server, of which the times are kept


class LoadTimes:
    """How many load callbacks of one server have ended since it was registered, and how long they took. Any thread.

    Attributes:
        loaded, failed: how many have returned, and raised.
        seconds: how long they took together; `own_seconds`: without the time in which they waited for their parts.
        longest_s: how long the longest took.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: deque[tuple[float, float]] = deque(maxlen=_NEWEST)
        self.loaded = self.failed = 0
        self.seconds = self.own_seconds = self.longest_s = 0.0

    def take(self, took_s: float, in_parts_s: float, *, failed: bool) -> None:
        """Count a callback that has ended, took so long, and waited so long of that for its parts."""
        own_s = max(0.0, took_s - in_parts_s)
        with self._lock:
            self.failed += failed
            self.loaded += not failed
            self.seconds += took_s
            self.own_seconds += own_s
            self.longest_s = max(self.longest_s, took_s)
            self._newest.append((took_s, own_s))

    def p95_s(self) -> tuple[float, float]:
        """Return the time within which 95 % of the newest 500 callbacks ended, and their own p95; 0.0 if none has."""
        with self._lock:
            newest = list(self._newest)
        return _p95(took_s for took_s, _ in newest), _p95(own_s for _, own_s in newest)


def _p95(times: Iterable[float]) -> float:
    in_order = sorted(times)
    return in_order[math.ceil(0.95 * len(in_order)) - 1] if in_order else 0.0


class ServerActor(TurnActor):
    """One server of a registrar, and a part of it: its mailbox takes StartCallback, and it sends CallbackEnded.

    Attributes:
        facts: what decisions know of it.
        usage, health: these two callbacks.
        inside: the callbacks that run now, each with the name of its role. From any thread.
        digest: of the types of requests and responses.
        title: returns the title of a request, given as canonical bytes; None: its requests have none.

    Raises:
        InvalidSpec: a callback has attributes that cannot be read.
        NotSerializable: the types are too long to be sent to consumers.
    """

    __slots__ = (
        "_on_demand",
        "_runs",
        "_runs_again",
        "digest",
        "facts",
        "health",
        "inside",
        "load_times",
        "origin",
        "registrar",
        "request",
        "response",
        "restored",
        "spec",
        "title",
        "usage",
    )
    gate: Gate | None = None

    def __init__(self, registrar: RegistrarBase, spec: ServerSpec, types: bytes) -> None:
        self.spec = spec
        self.restored = False  # whether it came from the catalog; then a second registration replaces it
        has = spec.status is not None, spec.recover is not None
        limits = spec.linger_s, spec.load_timeout_s, spec.recovery or "keep"
        checksum = zlib.crc32(types)
        idle = spec.idle == "pause", spec.paused_s
        grace_ms = round(1000 * (GRACE_S if spec.grace_s is None else spec.grace_s))
        times = spec.recover_timeout_s, *idle
        self.facts = Server(spec.name, *limits, *has, types, checksum, *times, spec.exclusive, grace_ms)
        self.registrar = registrar
        self.origin = f"{registrar.name}/{spec.name}"
        if (size := len(types) + _ROW_BYTES) > (limit := registrar.node.config.frame_limit_bytes):
            text = f"{self.origin}: types: {size} bytes are over the limit of {limit} (frame_limit_bytes)"
            raise NotSerializable(f"{text}: have a module that others can import, or raise the limit", path="types")
        self._runs_again = spec.recover is not None or self.facts.recovery != "keep"
        self.request = Codec(spec.request_type, f"{self.origin}: request")
        self.response = Codec(spec.response_type, f"{self.origin}: response")
        self.title = title_maker(spec, self.origin)
        self.digest = digest_of((self.request.shape, self.response.shape))
        self._runs: dict[Role, Callback] = {}
        for role in BEGUN.values():
            if not role.on_demand:
                self.add(role, self._arguments_of(role), self._result_of(role))
        self.usage = UsageCallbacks(self)
        self.health = HealthCallbacks(self)
        self._on_demand = {USAGE.name: self.usage, HEALTH.name: self.health}
        self.load_times = LoadTimes()
        self.inside: dict[int, str] = {}

    def add(self, role: Role, arguments: Callable[[Resource], tuple[Any, ...]], result: Callable[[Any], Any]) -> None:
        """Run callbacks of a role from now on.

        Args:
            arguments: returns what the callback is called with, in the worker.
            result: returns what is made of the callback's answer, in the worker.

        Raises:
            InvalidSpec: the callback has attributes that cannot be read.
        """
        what = f"{self.origin}: {role.option}"
        callback = getattr(self.spec, role.option)
        try:
            taking = nothing
            if callback is not None:
                taking = checked_callback(callback, role, self.spec.request_type, f"server {self.spec.name!r}")
            self._runs[role] = self._wrapped(taking, arguments, result)
        except Exception as error:
            expected = "a callable whose attributes can be read"
            text = f"{what}: expected {expected}, got {shown(callback)}: {text_of(error)}"
            raise InvalidSpec(text, field=role.option, expected=expected, got=callback) from None

    def _arguments_of(self, role: Role) -> Callable[[Resource], tuple[Any, ...]]:
        return self.request_and_response_of if "response" in role.arguments else self._request_of

    def _result_of(self, role: Role) -> Callable[[Any], Any]:
        """Return the function that makes the answer of a callback what CallbackEnded takes. It runs in the worker."""
        match role.answer:
            case "response":
                return self.response.encode
            case "new response":
                return lambda answer: None if answer is None else self.response.encode(answer, self.origin)
            case _:
                return nothing

    def _request_of(self, resource: Resource) -> tuple[Any]:
        return (self.request.decode(resource.request, self.origin),)

    def request_and_response_of(self, resource: Resource) -> tuple[Any, Any]:
        """Return the request and the response, as the arguments of a callback. In a worker."""
        request = self.request.decode(resource.request, self.origin)
        if resource.response is None:
            return request, None
        return request, self.response.decode(resource.response, self.origin, "response")

    def readable(self, load: Load) -> Load | c.RefuseLoad:
        """Return a consumer's Load with its request in canonical form, or the refusal of a request that cannot be read.

        A worker calls it if reading the request runs user code.
        """
        try:
            canonical = self.request.canonical(load.request, self.origin)
        except RrError as error:
            return c.RefuseLoad(load.origin, load.query_id, failure_of(error))
        return load if canonical == load.request else msgspec.structs.replace(load, request=canonical)

    def too_long(self, resource: Resource, response: bytes | None) -> NotSerializable | None:
        """Return the error for a response that, with its request, is too long for a frame; None if it is not."""
        limit = self.registrar.node.config.frame_limit_bytes
        size = len(resource.request) + len(response or b"")
        if size + _ROW_BYTES <= limit:
            return None
        why = f"request and response: {size} bytes are over the limit of {limit} (frame_limit_bytes, less {_ROW_BYTES})"
        return NotSerializable(f"{why}: {ADVICE}", path="response")

    # -- life ----------------------------------------------------------------------------------------------------

    @on_loop
    def begin(self) -> None:
        """Take messages, and be found at the path, from now on."""
        self.begin_life(self.registrar.node.dispatcher, self.registrar.node.hub)

    @on_loop
    def end(self) -> list[Message]:
        """Take no message any more, and probe nothing more; return the messages that waited. What runs goes on."""
        self.closed = True
        self.health.probes.close()
        left = [item[0] for item in self.waiting if isinstance(item, tuple)]
        self.end_life(CLOSED)
        return left

    # -- messages ------------------------------------------------------------------------------------------------

    @on_loop
    def handle(self, deliveries: Sequence[Delivery]) -> None:
        """Run the callbacks that the messages ask for."""
        for message, _ in deliveries:
            self.take(message)

    # -- start and end -------------------------------------------------------------------------------------------

    @on_loop
    def take(self, effect: Message) -> None:
        """Run the callback of a role for a resource, and post CallbackEnded.

        A missing unload or status callback has ended at once. Before on_start has returned, a callback goes on with
        work of before the last crash.
        """
        role, resource = BEGUN[effect.role], effect.resource
        if isinstance(effect, OnDemandRun):
            self._run(role, resource, resource.attempt, effect.done)
            return
        if role.on_demand:
            self._on_demand[effect.role].start(resource.id)
            return
        heard = None if effect.notice is None else self._received(effect.notice, repeated=effect.repeated)
        number = resource.tries if role is UNLOAD else resource.attempt
        run = RunningCallback(role, effect, number, heard, time.monotonic())
        if role in (UNLOAD, RELOAD, STATUS) and getattr(self.spec, role.option) is None:
            self._run_ended(run, None, None)
            return
        if not self.registrar.serving:  # it may end this process during its start
            self.registrar.node.on_resumed(f"the {role.name} callback of {self.origin} for resource {resource.id}")
        if role.alone:
            self.health.probes.when_free(resource.id, functools.partial(self._start, run))
        else:
            self._start(run)

    def _received(self, notice: Notice, *, repeated: bool) -> StatusMessage:
        audience = self.registrar.audience
        if audience is None:
            return status_of(notice, StatusMessage, repeated=repeated)
        return audience.received(notice, repeated=repeated)

    def _start(self, run: RunningCallback) -> None:
        role = run.role
        instead = LOAD if role is RECOVER and (run.effect.reload or self.spec.recover is None) else None
        at_once = functools.partial(self._ended_here, run) if role in (LOAD, UNLOAD) else None
        more = () if run.heard is None else (run.heard,)
        done = functools.partial(self._run_ended, run)
        self._run(role, run.effect.resource, run.number, done, *more, instead=instead, at_once=at_once)

    def _ended_here(self, run: RunningCallback, response: bytes | None) -> bool:
        """Decide the end in the thread that ran the callback; return False if the loop has to."""
        resource = run.effect.resource
        if run.role is LOAD:
            reports = self.registrar.progress
            if self.too_long(resource, response) is not None:
                return False
            if reports.loads and not reports.forget_sent(resource.id):
                return False
        self._streams_after(run, failed=False)
        took_s = time.monotonic() - run.began_s if run.role is LOAD else 0.0
        ended = CallbackEnded(run.role.name, resource.id, run.number, None, response, took_s=took_s)
        is_decided = self.registrar.decide_here(ended)
        if is_decided:
            self._count(run, took_s, failed=False)
        return is_decided

    def _count(self, run: RunningCallback, took_s: float, *, failed: bool) -> None:
        parts = self.registrar.part_times
        in_parts_s = parts.take(run.effect.resource.id) if parts.waits else 0.0
        if run.role is LOAD:
            self.load_times.take(took_s, in_parts_s, failed=failed)

    def _run_ended(self, run: RunningCallback, response: bytes | None, error: BaseException | None) -> None:
        role, resource = run.role, run.effect.resource
        if role.reports:
            self.registrar.progress.end(resource.id)
        if role.answer:
            error = error or self.too_long(resource, response)
        took_s = time.monotonic() - run.began_s if role is LOAD else 0.0
        self._count(run, took_s, failed=error is not None)
        if role is STATUS and error is not None:
            self.registrar.callback_failures += 1
        self._streams_after(run, failed=error is not None)
        failure = None if error is None else failure_of_callback(role, self.origin, resource, error)
        event = new_id() if role in (RECOVER, RELOAD, RESUME) else ""
        handled = run.heard is not None and run.heard.is_handled
        end = role.name, resource.id, run.number, failure, None if error is not None else response, event
        stopped = role is LOAD and type(error) is Raised and error.details.was_stopped
        self.registrar.post(CallbackEnded(*end, run.effect.notice, handled, took_s, stopped))

    def _streams_after(self, run: RunningCallback, *, failed: bool) -> None:
        """Let readers in to the streams that a callback has opened; close those of a resource that is gone."""
        publishers, id = self.registrar.publishers, run.effect.resource.id
        if run.role.reports and not failed:
            if publishers.streams:  # most registrars have none
                publishers.let_in(id, functools.partial(tell_stream, self, run.effect.resource))
        elif (run.role.reports and failed) or (run.role in (UNLOAD, RELOAD) and not failed):
            publishers.close(id)

    # -- how callbacks run -------------------------------------------------------------------------------------------

    @on_loop
    def _run(
        self,
        role: Role,
        resource: Resource,
        number: int,
        done: Done,
        *more: Any,
        instead: Role | None = None,
        at_once: Callable[[Any], bool] | None = None,
    ) -> None:
        """Run the callback of a role for a resource in a worker. If it needs room, it has room.

        Args:
            number: the number of the run, as decisions count it.
            done: called on the loop with the result, or the error.
            more: further arguments of the callback.
            instead: the role whose callback runs for this one.
            at_once: called with the result in the worker. If it returns True, `done` is not called.
        """
        registrar = self.registrar
        catalog = registrar.catalog
        holder = catalog.holder_of(resource.id)
        interrupted = role is UNLOAD and resource.response is None
        counts = role.counted and instead is None  # else a reload, whose attempts the row counts
        attempt = deaths_of(catalog, role.name, resource.id) + 1 if counts else number
        place = resource.id, attempt, holder, self.spec.name, registrar
        current = Current(*place, role, number, interrupted, resource.request, self._runs_again)
        run = self._runs[instead or role]
        if registrar.node.watched.level[0] > 1:
            done, at_once = recorded_end(self, role, resource, done, at_once)
        args = current, role, resource, *more
        patient = role.patient
        if (gate := self.gate) is not None:
            run = gate.around(run, enters=role.in_order)
            if not role.in_order:
                patient, done = True, functools.partial(_leave_first, gate, done)
        try:
            if role.in_order:
                registrar.workers.serial((role.name, resource.id), run, *args, done=done)
            else:
                registrar.workers.submit(run, *args, done=done, patient=patient, at_once=at_once)
        except (MailboxFull, Unavailable) as error:
            done(None, error)

    # -- in the worker -------------------------------------------------------------------------------------------

    def _wrapped(
        self, callback: Callback, arguments: Callable[[Resource], tuple[Any, ...]], result: Callable[[Any], Any]
    ) -> Callback:
        """Return a function that decodes the arguments, calls the callback, and encodes its result. Off the loop.

        It raises Raised for each error. A load that was told to stop, and is needed again, runs once more.
        """

        async def run_async(current: Current, role: Role, resource: Resource, *more: Any, begun: Any = None) -> Any:
            while not self._is_over(role, resource):
                self._enter_context(current, role, resource)
                try:
                    answer = result(await self._heeding(role, resource, begun or callback(*arguments(resource), *more)))
                except BaseException as error:
                    begun, again = None, self._runs_once_more(current, role, resource, error)
                    if again:
                        continue
                    raised = await described_error(error, self._describe if again is None else self._describe_stopped)
                else:
                    self._end_run(current, role, resource)
                    return answer
                raise raised from None
            return None

        def run(current: Current, role: Role, resource: Resource, *more: Any) -> Any:
            while not self._is_over(role, resource):
                self._enter_context(current, role, resource)
                try:
                    answer = callback(*arguments(resource), *more)
                    if type(answer) is COROUTINE:  # the callback is a wrapper or a lambda around an async function
                        return closing(answer, run_async(current, role, resource, *more, begun=answer))
                    answer = result(answer)
                except BaseException as error:
                    again = self._runs_once_more(current, role, resource, error)
                    if not again:
                        raise Raised(error, self._describe if again is None else self._describe_stopped) from None
                else:
                    self._end_run(current, role, resource)
                    return answer
            return None

        return run_async if is_async(callback) else run

    def _enter_context(self, current: Current, role: Role, resource: Resource) -> None:
        enter(current)
        self.inside[id(current)] = role.name
        if self.registrar.node.watched.level[0] > 1:
            again = f"attempt {current.attempt}" if current.attempt > 1 else ""
            self.registrar.recorder.callback("began", self.origin, role.name, resource.id, again)

    def _describe(self, error: BaseException) -> CallbackFailure:
        """Describe a callback's error. In the thread that ran the callback."""
        return CallbackFailure(load_failure(error, self.origin), failure_of(error, self.origin).trace)

    def _describe_stopped(self, error: BaseException) -> CallbackFailure:
        return self._describe(error)._replace(was_stopped=True)

    async def _heeding(self, role: Role, resource: Resource, answer: Awaitable[Any]) -> Any:
        """Await the answer of a callback. If it may be stopped, it is cancelled when nobody needs it any more."""
        task = asyncio.current_task()
        if role.phase is None or not role.reports or task is None:
            return await answer
        cancel = functools.partial(_cancel, asyncio.get_running_loop(), task)
        self.registrar.stop_event(resource.id, role.phase, resource.attempt, cancel)
        return await answer

    def _runs_once_more(self, current: Current, role: Role, resource: Resource, error: BaseException) -> bool | None:
        """Note that a run has ended by an error. If it was told to stop, return whether its result is needed again."""
        again = self._end_run(current, role, resource)
        if not again:
            return again
        if not isinstance(error, asyncio.CancelledError):
            return True if isinstance(error, Exception) else None
        if (task := asyncio.current_task()) is not None:
            while task.cancelling():
                task.uncancel()
        return True

    def _end_run(self, current: Current, role: Role, resource: Resource) -> bool | None:
        self.inside.pop(id(current), None)
        if role.phase is None or not role.reports:
            return None
        return self.registrar.end_run(resource.id, role.phase, resource.attempt)

    def _is_over(self, role: Role, resource: Resource) -> bool:
        """Return whether a callback must not begin any more: its registrar is closed, or its resource is unloaded.

        Of a closed registrar nothing is decided, so its callback's result does not matter.
        """
        registrar = self.registrar
        if registrar.closed or role is not STATUS:
            return registrar.closed
        left = registrar.catalog.resources.get(resource.id)
        return left is None or left.phase is UNLOADING


def _leave_first(gate: Gate, done: Done, result: Any, error: BaseException | None) -> None:
    """Call `done`; first leave the gate for a callback that got no thread, and so has not left it itself."""
    if error is not None and type(error) is not Raised:
        gate.leave()
    done(result, error)


def _cancel(loop: asyncio.AbstractEventLoop, task: asyncio.Task[Any]) -> None:
    with contextlib.suppress(RuntimeError):  # the loop is closed, and has cancelled its tasks
        loop.call_soon_threadsafe(task.cancel)


class RequestReader:
    """Reads the requests in the Loads of consumers, for the servers of one registrar.

    Args:
        server_of: returns a server by its name; None: there is none.
    """

    def __init__(
        self, registrar: RegistrarBase, consumers: Consumers, server_of: Callable[[str], ServerActor | None]
    ) -> None:
        self._registrar, self._consumers, self._server_of = registrar, consumers, server_of

    @on_loop
    def read_first(self, load: Load, sender: str) -> bool:
        """Have a worker read the request first if that runs user code, and return whether it does."""
        registrar, server = self._registrar, self._server_of(load.server)
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
            if self._server_of(load.server) is not server:  # unregistered meanwhile, and perhaps registered anew
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
        server = self._server_of(load.server)
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
