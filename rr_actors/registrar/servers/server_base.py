"""ServerBase: what the parts of a server see of it; and what is said of a callback that has raised."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, cast

import msgspec

from rr_actors.base.errors import (
    CircularDependency,
    GraphError,
    LoadFailed,
    OverCapacity,
    ResourceBusy,
    Unavailable,
    readable,
    shortened,
    text_of,
)
from rr_actors.base.names import short_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by_callback
from rr_actors.base.values.canonical import text_of_value
from rr_actors.base.values.failure import Failure, failure_of
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import ServerSpec
from rr_actors.registrar.engine.status import StatusMessage
from rr_actors.registrar.model.effects import StartCallback
from rr_actors.registrar.model.roles import RECOVER, Role
from rr_actors.registrar.model.rows import Resource
from rr_actors.runtime.callback_errors import Raised, log_raised, traceback_of
from rr_actors.runtime.user_loop import Done
from rr_actors.streams.stream import Stream, StreamHappening

logger = Log("rr_actors.server")


class CallbackFailure(NamedTuple):
    """What is known of the error of a callback. `was_stopped`: it was told to stop, as nobody needed its result."""

    failure: Failure
    trace: list[tuple[str, str]]
    was_stopped: bool = False


def said(error: BaseException) -> str:
    """Return the text of an error; that of a callback's is made already."""
    return error.text if type(error) is Raised else text_of(error)


_LEFT_BY = {
    "unload": ("is kept as unload_failed", "unloaded"),
    "reload": ("is not loaded again, as its unload callback raised", "reloaded"),
}
"""By role: what an unload callback that raised leaves behind, and what may be tried again."""


def failure_of_callback(role: Role, origin: str, resource: Resource, error: BaseException) -> Failure | None:
    """Log the error of a callback, and return the failure that decisions get; None: what waits goes on all the same."""
    match role.name:
        case "load":
            return load_failure(error, origin)
        case "unload" | "reload":
            text = readable(f"{origin}: {said(error)}")
            trace = error.details.trace if type(error) is Raised else failure_of(error, origin).trace
            becomes, again = _LEFT_BY[role.name]
            log_raised(logger, error, "%s; resource %s %s", text, resource.id, becomes)
            text += f"; the resource {becomes}, and may be {again} again"
            return Failure("UnloadFailed", text, {"resource_id": resource.id, "server": origin}, trace)
        case "pause":
            text = readable(f"{origin}: pause: {said(error)}")
            log_raised(logger, error, "%s; resource %s runs on", text, resource.id)
        case "status":
            log_raised(logger, error, "%s: the status callback raised; the status goes on", origin)
            return None
        case _:
            during = "" if role is RECOVER else f" {role.name}:"
            text = readable(f"lost: {origin}:{during} {said(error)}")
            logger.warning("%s (resource %s)", text, resource.id)
    return Failure("LoadFailed", text, {"server": origin})


def load_failure(error: BaseException, origin: str) -> Failure:
    """Return the failure that consumers hear if a load callback raises; a group of one error is that error."""
    if type(error) is Raised:
        return error.details.failure
    error = _alone(error)
    described = failure_of(error, origin)
    if isinstance(error, (CircularDependency, GraphError, OverCapacity, ResourceBusy)):
        return described
    if isinstance(error, LoadFailed):
        text, lines = described.message, error.traceback
    else:
        text, lines = text_of(error), traceback_of(error)
    details = {"server": origin, "traceback": lines}
    try:
        if wanted := wanted_by_callback(error):
            details["wanted"] = wanted
    except Exception as odd:  # of the error's own class, whose attributes may be missing, or raise
        logger.debug("%s: its error does not say what was wanting: %s", origin, text_of(odd))
    return Failure("LoadFailed", readable(f"{origin}: {text}"), details, described.trace)


def _alone(error: BaseException) -> BaseException:
    """Return the only error of a group of errors, however deep; else return the error as it is."""
    if not isinstance(error, BaseExceptionGroup):
        return error
    group = cast("BaseExceptionGroup[BaseException]", error)
    return _alone(group.exceptions[0]) if len(group.exceptions) == 1 else group


class OnDemandRun(msgspec.Struct, frozen=True, gc=False):
    """Run a usage or health callback for a resource.

    Attributes:
        role: its name.
        done: called on the loop with the result, or the error.
    """

    role: str
    resource: Resource
    done: Done


class RunningCallback(msgspec.Struct, frozen=True, gc=False):
    """One run of a callback.

    Attributes:
        number: its number, as decisions count it.
        heard: of a status callback: the status.
        began_s: when it began, by the monotonic clock.
    """

    role: Role
    effect: StartCallback
    number: int
    heard: StatusMessage | None
    began_s: float


class ServerBase(Protocol):
    """A server, as its parts see it.

    Attributes:
        origin: its id, "registrar/server".
    """

    registrar: RegistrarBase
    spec: ServerSpec
    origin: str

    def add(self, role: Role, arguments: Callable[[Resource], tuple[Any, ...]], result: Callable[[Any], Any]) -> None:
        """Run callbacks of a role from now on."""
        ...

    def deliver(self, message: OnDemandRun) -> None:
        """Take a message, on the loop: run a callback."""
        ...

    def request_and_response_of(self, resource: Resource) -> tuple[Any, Any]:
        """Return the request and the response, as the arguments of a callback. In a worker."""
        ...


def nothing(*_: Any) -> None:
    """Do nothing: the server has no such callback."""


def recorded_end(
    server: ServerBase, role: Role, resource: Resource, done: Done, at_once: Callable[[Any], bool] | None
) -> tuple[Done, Callable[[Any], bool] | None]:
    """Return `done` and `at_once` of a callback changed to record its end first, and only once."""
    record = functools.partial(server.registrar.recorder.callback, "ended", server.origin, role.name, resource.id)
    ended: list[bool] = []

    def recorded(result: Any, error: BaseException | None) -> None:
        if not ended:
            record("" if error is None else readable(shortened(said(error))))
        done(result, error)

    def recorded_at_once(result: Any) -> bool:
        ended.append(True)
        record()
        return at_once is not None and at_once(result)

    return recorded, None if at_once is None else recorded_at_once


def tell_stream(
    server: ServerBase, resource: Resource, what: StreamHappening, stream: Stream, reader: str, before: Stream | None
) -> None:
    """Tell the watchers of the system what has happened to a stream. From any thread."""
    node = server.registrar.node
    if not node.watched.level[0]:
        return
    facts = {"registrar": server.registrar.name, "server": server.origin, "resource_id": resource.id}
    facts |= {"request": text_of_value(resource.request), "stream": stream.name, "detail": stream.name}
    if title := server.registrar.title_of(resource):
        facts["title"] = title
    if before is not None:
        instead = f"{before.name} of resource {short_id(before.resource_id)}"
        facts["detail"] += f", read by {reader} instead of {instead}"
        facts |= {"reader": reader, "before": f"{before.resource_id}/{before.name}"}
    with contextlib.suppress(Unavailable):  # the loop has ended
        node.dispatcher.call(functools.partial(node.emit, what, **facts))
