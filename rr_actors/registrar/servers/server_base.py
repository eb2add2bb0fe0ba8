"""ServerBase: what the parts of a server see of it; and what is said of a callback that has raised."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from rr_actors.base.errors import CircularDependency, GraphError, LoadFailed, OverCapacity, readable, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by_callback
from rr_actors.base.values.failure import Failure, failure_of
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.engine.server import ServerSpec
from rr_actors.registrar.model.roles import RECOVER, Role
from rr_actors.registrar.model.rows import Resource
from rr_actors.runtime.callback_errors import Raised, log_raised, traceback_of
from rr_actors.runtime.user_loop import Done

logger = Log("rr_actors.server")


def said(error: BaseException) -> str:
    """Return the text of an error; that of a callback's is made already."""
    return error.text if type(error) is Raised else text_of(error)


def failure_of_callback(role: Role, origin: str, resource: Resource, error: BaseException) -> Failure | None:
    """Log the error of a callback, and return the failure that decisions get; None: what waits goes on all the same."""
    match role.name:
        case "load":
            return load_failure(error, origin)
        case "unload":
            text = readable(f"{origin}: {said(error)}")
            trace = error.details[1] if type(error) is Raised else failure_of(error, origin).trace
            log_raised(logger, error, "%s; resource %s is kept as unload_failed", text, resource.id)
            text += "; the resource is kept as unload_failed, and may be unloaded again"
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
        return error.details[0]
    error = _alone(error)
    described = failure_of(error, origin)
    if isinstance(error, (CircularDependency, GraphError, OverCapacity)):
        return described
    if isinstance(error, LoadFailed):
        text, lines = described.message, error.traceback
    else:
        text, lines = text_of(error), traceback_of(error)
    details = {"server": origin, "traceback": lines}
    if wanted := wanted_by_callback(error):
        details["wanted"] = wanted
    return Failure("LoadFailed", readable(f"{origin}: {text}"), details, described.trace)


def _alone(error: BaseException) -> BaseException:
    """Return the only error of a group of errors, however deep; else return the error as it is."""
    if not isinstance(error, BaseExceptionGroup):
        return error
    group = cast("BaseExceptionGroup[BaseException]", error)
    return _alone(group.exceptions[0]) if len(group.exceptions) == 1 else group


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

    def submit(self, role: Role, resource: Resource, number: int, done: Done) -> None:
        """Run the callback of a role for a resource; `done` is called on the loop."""
        ...

    def request_and_response_of(self, resource: Resource) -> tuple[Any, Any]:
        """Return the request and the response, as the arguments of a callback. In a worker."""
        ...


def nothing(*_: Any) -> None:
    """Do nothing: the server has no such callback."""
