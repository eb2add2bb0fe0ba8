"""Server: one kind of resource of one registrar. It runs its callbacks in workers and reports how they ended.

The context of a running callback says for which resource and which attempt it runs. A load inside the callback belongs
to that resource. The context is a contextvar: tasks and asyncio.to_thread inherit it. Threads that a callback starts by
hand do not; they pass ``parent=rr.current()``.
"""

from __future__ import annotations

import functools
import inspect
import logging
import typing
import zlib
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, NoReturn, cast

import msgspec

from rr_actors.base.checks import check_takes, examined, is_number
from rr_actors.base.errors import (
    CircularDependency,
    InvalidSpec,
    LoadFailed,
    MailboxFull,
    NotSerializable,
    RrError,
    Unavailable,
    UsageError,
    shortened,
    shown,
    text_of,
)
from rr_actors.base.names import check_name, new_id
from rr_actors.base.values.canonical import Codec
from rr_actors.registrar.core.callback_runs import running
from rr_actors.registrar.engine.progress import checked
from rr_actors.registrar.engine.status import status_of
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.messages import Failure, Load, failure_of, readable
from rr_actors.registrar.model.rows import LOADED, LOADING, UNLOADING, Notice, Phase, Resource
from rr_actors.runtime.callback_errors import Raised, described, log_raised, traceback_of
from rr_actors.runtime.user_loop import Done, closing, is_coroutine
from rr_actors.runtime.workers import is_async


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

    # `_registrar` is the actor of the serving registrar. `_phase` is the resource's phase until the callback returns:
    # LOADING, UNLOADING, or LOADED while it is being recovered. It is None in a status callback, for which nothing
    # waits.

    resource_id: str
    attempt: int
    origin: str
    server: str
    _registrar: Any
    _phase: Phase | None
    interrupted: bool = False

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
        if self._phase is not LOADING and self._phase is not LOADED:
            name, role = f"{self._registrar.name}/{self.server}", _ROLES[self._phase]
            raise UsageError(f"{name}: progress() in its {role} callback: only load and recover callbacks report it")
        self._registrar.progress.report(self.resource_id, number, words)


_current: ContextVar[Current | None] = ContextVar("rr_current", default=None)


def current() -> Current:
    """Return the context of the callback that this code runs in.

    Raises:
        UsageError: this code does not run in a callback.
    """
    context = _current.get()
    if context is None:
        raise UsageError("rr.current(): expected to be called in a load, unload, status or recover callback")
    return context


current_or_none: Callable[[], Current | None] = _current.get
"""Return the context of the callback that this code runs in; None outside of callbacks."""


def serving(current: Current) -> Any:
    """Return the actor of the registrar that runs the callback."""
    return current._registrar  # pyright: ignore[reportPrivateUsage]  # same file


def _phase_of(current: Current) -> Phase | None:
    return current._phase  # pyright: ignore[reportPrivateUsage]  # same file


def begin(current: Current) -> None:
    """Make current() return `current` in this context, which belongs to the callback."""
    _current.set(current)
    if serving(current).node.watched.recording:
        _record("began", current)


def _record(event: str, current: Current, detail: str = "") -> None:
    registrar = serving(current)
    role = _ROLES[_phase_of(current)]
    server = f"{registrar.name}/{current.server}"
    registrar.node.recorder.callback(event, server, role, current.resource_id, detail)


def status_callback_of(registrar: Any) -> str:
    """Return the id of the resource whose status callback this code runs in, if the registrar serves it; else ""."""
    me = _current.get()
    return me.resource_id if me is not None and _phase_of(me) is None and serving(me) is registrar else ""


_ROLES = {LOADING: "load", UNLOADING: "unload", LOADED: "recover", None: "status"}


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
    if me is None or (phase := _phase_of(me)) is None or serving(me).closed:
        return
    with serving(me).lock:
        catalog = serving(me).whole()
        is_running = running(catalog, me.resource_id, phase, me.attempt) is not None
        if not is_running or (phase is LOADED and me.resource_id not in catalog.recovering) or not waits_for(me):
            return
    name = serving(me).name
    whose = f"the callback that {_ROLES[phase]}s resource {me.resource_id} of {name}/{me.server}"
    text = f"{what} waits for {whose}, and is called in it: it would wait for itself; {instead}"
    raise UsageError(text, registrar=name, server=f"{name}/{me.server}", resource_id=me.resource_id)


# -- the server --------------------------------------------------------------------------------------------------------

logger = logging.getLogger("rr_actors.server")

Callback = Callable[..., Any]
RECOVERY = ("keep", "reload", "lost")
_ROW_BYTES = 1024  # room for the names and ids that are sent with a request, a response, or types
ARGUMENTS = {
    "load": ("request",),
    "unload": ("request", "response"),
    "status": ("request", "status"),
    "recover": ("request", "response"),
}
"""The arguments of each callback."""


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


class ServerActor:
    """Runs one server's callbacks, each in a worker (``async def`` ones as tasks), each with its context.

    The registrar tells it which callback to start; it posts LoadDone, LoadErred and so on back. Callbacks of different
    resources run at the same time; status callbacks of one resource run one after another.

    Raises:
        InvalidSpec: a callback has attributes that cannot be read.
        NotSerializable: the types are too long to be sent to consumers.
    """

    def __init__(self, registrar: Any, spec: ServerSpec, types: bytes) -> None:
        self.spec = spec
        self.restored = False  # whether it came from the catalog; then a second registration replaces it
        has = spec.status is not None, spec.recover is not None
        limits = spec.linger_s, spec.load_timeout_s, spec.recovery or "keep"
        self.facts = Server(spec.name, *limits, *has, types, zlib.crc32(types))  # what decisions need to know
        self.registrar = registrar
        self.origin = f"{registrar.name}/{spec.name}"
        if (size := len(types) + _ROW_BYTES) > (limit := registrar.node.config.frame_limit_bytes):
            text = f"{self.origin}: types: {size} bytes are over the limit of {limit} (frame_limit_bytes)"
            raise NotSerializable(f"{text}: have a module that others can import, or raise the limit", path="types")
        self.request = Codec(spec.request_type, f"{self.origin}: request")
        self.response = Codec(spec.response_type, f"{self.origin}: response")
        load, one, both = spec.load, self._request_of, self._request_and_response_of
        encoded = self.response.encode
        self._load = self._described(load, "load", one, encoded)
        self._unload = self._described(_or(spec.unload, _nothing), "unload", both, _nothing)
        self._recover = self._described(_or(spec.recover, load), "recover", both, encoded)
        self._status = self._described(_or(spec.status, _nothing), "status", one, _nothing)

    def _described(
        self,
        callback: Callback,
        role: str,
        arguments: Callable[[Resource], tuple[Any, ...]],
        result: Callable[[Any], Any],
    ) -> Callback:
        what = f"{self.origin}: {role}"
        try:
            wrapped = _wrap(callback, arguments, result)
        except Exception as error:
            expected = "a callable whose attributes can be read"
            text = f"{what}: expected {expected}, got {shown(callback)}: {text_of(error)}"
            raise InvalidSpec(text, field=role, expected=expected, got=callback) from None
        return described(wrapped, what, self._describe)

    def _describe(self, error: BaseException) -> tuple[Failure, list[tuple[str, str]]]:
        """Return the failure and the trace that describe a callback's error. In the thread that ran the callback."""
        return self.load_failure(error), failure_of(error, self.origin).trace

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

    def start_load(self, resource: Resource) -> None:
        """Run the load callback."""
        done = functools.partial(self._load_ended, resource)
        at_once = functools.partial(self._loaded, resource)
        self._submit(self._load, resource, resource.attempt, done, at_once=at_once)

    def _loaded(self, resource: Resource, response: bytes) -> bool:
        """Decide LoadDone in the thread that ran the callback; return False if the loop has to."""
        progress = self.registrar.progress
        if self.too_long(resource, response) is not None or progress.has_unsent(resource.id):
            return False
        progress.forget(resource.id)
        return self.registrar.monitor.decide_here(c.LoadDone(resource.id, resource.attempt, response))

    def _load_ended(self, resource: Resource, response: bytes, error: BaseException | None) -> None:
        self.registrar.progress.end(resource.id)
        error = error or self.too_long(resource, response)
        if error is None:
            self.registrar.post(c.LoadDone(resource.id, resource.attempt, response))
        else:
            self.registrar.post(c.LoadErred(resource.id, resource.attempt, self.load_failure(error)))

    def too_long(self, resource: Resource, response: bytes | None) -> NotSerializable | None:
        """Return the error for a response that, with its request, is too long for a frame; None if it is not."""
        limit = self.registrar.node.config.frame_limit_bytes
        size = len(resource.request) + len(response or b"")
        if size + _ROW_BYTES <= limit:
            return None
        why = f"request and response: {size} bytes are over the limit of {limit} (frame_limit_bytes, less {_ROW_BYTES})"
        return NotSerializable(f"{why}: give the name of a file, say, or raise the limit", path="response")

    def load_failure(self, error: BaseException) -> Failure:
        """Return the failure that consumers hear if a load callback raises; a group of one error is that error."""
        if type(error) is Raised:
            return error.details[0]
        error = _alone(error)
        described = failure_of(error, self.origin)
        if isinstance(error, CircularDependency):
            return described
        if isinstance(error, LoadFailed):
            text, lines = described.message, error.traceback
        else:
            text, lines = text_of(error), traceback_of(error)
        details = {"server": self.origin, "traceback": lines}
        return Failure("LoadFailed", readable(f"{self.origin}: {text}"), details, described.trace)

    # -- unload --------------------------------------------------------------------------------------------------

    def start_unload(self, resource: Resource) -> None:
        """Run the unload callback; without one, the resource counts as unloaded at once."""
        if self.spec.unload is None:
            self.registrar.post(c.UnloadDone(resource.id, resource.tries))
            return

        def at_once(_result: None) -> bool:
            return self.registrar.monitor.decide_here(c.UnloadDone(resource.id, resource.tries))

        done = functools.partial(self._unload_ended, resource)
        self._submit(self._unload, resource, resource.tries, done, patient=True, at_once=at_once)

    def _unload_ended(self, resource: Resource, _result: None, error: BaseException | None) -> None:
        if error is None:
            self.registrar.post(c.UnloadDone(resource.id, resource.tries))
            return
        trace = error.details[1] if type(error) is Raised else failure_of(error, self.origin).trace
        text = readable(f"{self.origin}: {_text_of(error)}")
        log_raised(logger, error, "%s; resource %s is kept as unload_failed", text, resource.id)
        text += "; the resource is kept as unload_failed, and may be unloaded again"
        failure = Failure("UnloadFailed", text, {"resource_id": resource.id, "server": self.origin}, trace)
        self.registrar.post(c.UnloadErred(resource.id, resource.tries, failure))

    # -- recover -------------------------------------------------------------------------------------------------

    def start_recover(self, resource: Resource, reload: bool) -> None:
        """Ask the recover callback whether the resource lives, or load the resource again."""
        run = self._load if reload or self.spec.recover is None else self._recover
        self._submit(run, resource, resource.attempt, functools.partial(self._recover_ended, resource), patient=True)

    def _recover_ended(self, resource: Resource, response: bytes | None, error: BaseException | None) -> None:
        self.registrar.progress.end(resource.id)
        error = error or self.too_long(resource, response)
        if error is None:
            self.registrar.post(c.RecoverDone(resource.id, resource.attempt, response, new_id()))
            return
        text = readable(f"lost: {self.origin}: {_text_of(error)}")
        logger.warning("%s (resource %s)", text, resource.id)
        failure = Failure("LoadFailed", text, {"server": self.origin})
        self.registrar.post(c.RecoverErred(resource.id, resource.attempt, failure, new_id()))

    # -- status --------------------------------------------------------------------------------------------------

    def start_status(self, resource: Resource, notice: Notice, *, repeated: bool) -> None:
        """Run the status callback for a status of the resource, or of one of its parts."""
        status = status_of(notice, repeated=repeated)

        def done(_result: None, error: BaseException | None) -> None:
            if error is not None:
                self.registrar.callback_failures += 1
                log_raised(logger, error, "%s: the status callback raised; the status goes on", self.origin)
            self.registrar.post(c.StatusDone(resource.id, notice, status.is_handled))

        self._submit(self._status, resource, resource.attempt, done, status, in_order=True)

    # -- how callbacks run ---------------------------------------------------------------------------------------

    def _submit(
        self,
        run: Callback,
        resource: Resource,
        attempt: int,
        done: Done,
        *more: Any,
        in_order: bool = False,
        patient: bool = False,
        at_once: Callable[[Any], bool] | None = None,
    ) -> None:
        holder = self.registrar.catalog.holder_of(resource.id)
        phase = None if in_order else resource.phase
        interrupted = phase is UNLOADING and resource.response is None
        current = Current(resource.id, attempt, holder, self.spec.name, self.registrar, phase, interrupted)
        workers = self.registrar.workers
        if self.registrar.node.watched.recording:
            done, at_once = _recorded(current, done, at_once)
        try:
            if in_order:
                workers.serial(("status", resource.id), run, current, resource, *more, done=done)
            else:
                workers.submit(run, current, resource, *more, done=done, patient=patient, at_once=at_once)
        except (MailboxFull, Unavailable) as error:
            done(None, error)

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
    if is_async(callback):

        async def run_async(current: Current, resource: Resource, *more: Any) -> Any:
            begin(current)
            return result(await callback(*arguments(resource), *more))

        return run_async

    def run(current: Current, resource: Resource, *more: Any) -> Any:
        begin(current)
        answer = callback(*arguments(resource), *more)
        if is_coroutine(answer):  # the callback is a wrapper or a lambda around an async function
            return closing(answer, _then(answer, result))
        return result(answer)

    return run


async def _then(answer: Any, result: Callable[[Any], Any]) -> Any:
    return result(await answer)


def _or(callback: Callback | None, other: Callback) -> Callback:
    return other if callback is None else callback


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


def checked_spec(spec: ServerSpec) -> ServerSpec:
    """Check what a server is registered with; read its types from the annotations of `load` if none are given.

    Raises:
        InvalidName, InvalidSpec: a field is wrong; the error says which.
    """
    name = check_name(spec.name, "server name")
    with examined(f"server {name!r}"):
        for field in ("load", "unload", "status", "recover"):
            callback = getattr(spec, field)
            if callable(callback):
                check_takes(callback, ARGUMENTS[field], f"server {name!r}", field)
            elif field == "load" or callback is not None:
                _invalid(name, field, "a callable", callback)
        if spec.recovery is not None and spec.recovery not in RECOVERY:
            _invalid(name, "recovery", "one of " + ", ".join(map(repr, RECOVERY)), spec.recovery)
        if not is_number(spec.linger_s) or spec.linger_s < 0:
            _invalid(name, "linger_s", "seconds, 0 or more", spec.linger_s)
        limit_s = spec.load_timeout_s
        if limit_s is not None and not (is_number(limit_s) and limit_s > 0):
            _invalid(name, "load_timeout_s", "seconds greater than 0, or None", limit_s)
        request, response = _annotated(spec.load)
        return msgspec.structs.replace(
            spec,
            name=name,
            request_type=request if spec.request_type is None else spec.request_type,
            response_type=response if spec.response_type is None else spec.response_type,
            linger_s=float(spec.linger_s),
        )


def _annotated(load: Callback) -> tuple[Any, Any]:
    """Return the request and response type in the annotations of a load callback, or None for each one not found."""
    try:
        hints = _hints(load)
        parameters = list(inspect.signature(load).parameters.values())
    except Exception:  # names that cannot be resolved, builtins without a signature: any plain value then
        return None, None
    request = hints.get(parameters[0].name) if parameters else None
    response = hints.get("return")
    return _plain(request), _plain(response)


def log_unread_types(spec: ServerSpec, server: str) -> None:
    """Log a warning if an annotation names a type that cannot be found: the values are plain then, and not checked."""
    if spec.request_type is not None or spec.response_type is not None:
        return  # the types were read, or given
    try:
        _hints(spec.load)
    except NameError as error:
        logger.warning(
            "%s: the annotations of its load callback cannot be read (%s): requests and responses are plain values, "
            "and not checked; import the type outside TYPE_CHECKING, or give request_type and response_type",
            server,
            error,
        )
    except Exception:  # no annotation was meant as a type: `load` is a builtin, say
        return


def _hints(load: Callback) -> dict[str, Any]:
    """Return annotations as types; look up names in text where the function is defined, and in the calling frames."""
    function = load.func if isinstance(load, functools.partial) else load
    if not inspect.isroutine(function):
        function = type(function).__call__  # a callable object's annotations are its method's
    try:
        return typing.get_type_hints(function, include_extras=True)
    except NameError:  # classes of a function's body: they are in the frames that led here
        names: dict[str, Any] = {}
        frame = inspect.currentframe()
        while frame is not None:
            names = {**frame.f_locals, **names}
            frame = frame.f_back
        return typing.get_type_hints(function, localns=names, include_extras=True)


def _plain(hint: Any) -> Any:
    return None if hint in (None, type(None), Any, object) else hint


def _invalid(name: str, field: str, expected: str, got: object) -> NoReturn:
    text = f"server {name!r}: {field}: expected {expected}, got {shown(got)} ({type(got).__name__})"
    raise InvalidSpec(text, field=field, expected=expected, got=got)
