"""Commands of a console: they change something. The answer is a sentence that says what was done. In a worker."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors.base.errors import ActorUnavailable, NotFound, UnknownQuery, UsageError, shown
from rr_actors.base.names import parse_server_id
from rr_actors.registrar.engine.status import Status
from rr_actors.registrar.pages import QueryRow, ResourceRow
from rr_actors.registrar.registrar import Registrar
from rr_actors.runtime.processes.lifeline import signal_if
from rr_actors.runtime.processes.process import signal_name
from rr_actors.supervision.core.specs import Supervisor, child_from_toml
from rr_actors.supervision.supervisor import Child, SupervisorRef
from rr_actors.system.console.client_registrars import ClientRegistrars, ask
from rr_actors.system.console.console_messages import (
    RESPONSE_LIMIT_BYTES,
    Answer,
    AskActor,
    Command,
    Done,
    Hold,
    Kill,
    Load,
    OpenRegistrar,
    Release,
    Restart,
    SendStatus,
    ShutDown,
    StartChild,
    Terminate,
    Unload,
)
from rr_actors.system.console.console_questions import View
from rr_actors.wire.name_service import Status as Presence

REGISTRAR = "console"
"""The registrar of the system that holds the resources that a console loads and keeps. The first such load opens it."""


class Commands:
    """The commands of the consoles of one system. From workers.

    Args:
        shut_down: stops the system, in a thread of its own.
    """

    def __init__(self, view: View, shut_down: Callable[[], None]) -> None:
        self._view = view
        self._shut_down = shut_down
        self._opening = threading.Lock()
        self.clients = ClientRegistrars()

    def carry_out(self, command: Command, is_gone: Callable[[], bool], connection: object) -> Answer:
        """Carry out a command, and return an answer that says what was done.

        Args:
            is_gone: returns whether the client has left.
            connection: the client's connection; a registrar that is opened for the client lives as long.

        Raises:
            RrError: the command cannot be carried out; nothing was changed, or the error says what was.
        """
        match command:
            case Load():
                return self._load(command, is_gone)
            case Unload():
                return self._unload(command)
            case SendStatus():
                return self._send_status(command)
            case Kill():
                return self._kill(command)
            case Terminate():
                return self._terminate(command)
            case Restart():
                return self._restart(command)
            case StartChild():
                return self._start(command)
            case ShutDown():
                return self._stop(command)
            case OpenRegistrar():
                return self.clients.open(self._view, command.name, connection)
            case Hold():
                return self.clients.hold(command)
            case Release():
                return self.clients.release(command)
            case AskActor():
                return ask(self._view.system, command)

    # -- resources ---------------------------------------------------------------------------------------------------

    def _load(self, command: Load, is_gone: Callable[[], bool]) -> Done:
        value = _json(command.request)
        server = parse_server_id(command.server)
        holder = command.holder or REGISTRAR
        if command.holder:
            self._view.registrar(holder)
        facts: dict[str, Any] = {"server": str(server), "holder": holder, "kept": command.keep}
        if command.dry_run:
            servers = self._view.registrar(server.registrar).servers()
            if str(server) not in servers:
                there = ", ".join(servers) or "none"
                raise NotFound(f"{server}: registrar {server.registrar!r} has no such server (it has: {there})")
            return Done(f"would load {server} {command.request}, held by {holder}", facts)
        query = self._holder(command.holder).load(str(server), value, timeout_s=command.timeout_s)
        facts |= {"query_id": query.id, "resource_id": query.resource_id, "response": _plain(query.response)}
        if command.keep and not is_gone():
            return Done(f"loaded {server}: {holder} holds it as query {query.id}", facts)
        query.unload(timeout_s=command.timeout_s)
        return Done(f"loaded {server} and released it again", facts | {"kept": False})

    def _holder(self, name: str) -> Registrar:
        if not name:
            with self._opening:
                if self._view.node.status_of(REGISTRAR) in (None, Presence.GONE, Presence.DORMANT):
                    return self._view.open_registrar(REGISTRAR)
        return self._view.system.registrar(name or REGISTRAR)

    def _unload(self, command: Unload) -> Done:
        found = self._view.find(command.id)
        if command.force:
            resource = _only_resource(command.id, found.resources)
            text = f"{resource.server} {resource.request} (resource {resource.id}) away from {_count(resource)}"
            if command.dry_run:
                return Done(f"would take {text}", {"resource_id": resource.id})
            registrar = self._view.registrar(resource.server.partition("/")[0])
            registrar.unload(resource.id, force=True, timeout_s=command.timeout_s)
            return Done(f"took {text}", {"resource_id": resource.id})
        query = self._only_query(command.id, found.queries, found.resources)
        text = f"query {query.id} of {query.origin} on {query.server} {query.request}"
        facts = {"query_id": query.id, "holder": query.origin, "server": query.server}
        if command.dry_run:
            return Done(f"would release {text}", facts)
        self._view.registrar(query.origin).unload(query.id, timeout_s=command.timeout_s)
        return Done(f"released {text}", facts)

    def _only_query(self, id: str, queries: list[QueryRow], resources: list[ResourceRow]) -> QueryRow:
        held = [row for row in queries if row.hold == "held"]
        if len(held) == 1:
            return held[0]
        if len(held) > 1:
            several = ", ".join(f"{row.id} of {row.origin}" for row in held)
            raise UsageError(f"{shown(id)}: several queries begin so: {several}; give more of the id")
        if resources:
            holders = ", ".join(f"{holder.query_id} of {holder.origin}" for holder in resources[0].holders) or "none"
            raise UnknownQuery(
                f"{shown(id)}: it is a resource, and its queries are: {holders}; release one of these, or take the "
                "resource away from all of them (--force)",
                query_id=id,
            )
        raise UnknownQuery(f"{shown(id)}: nobody holds a query of this id", query_id=id)

    def _send_status(self, command: SendStatus) -> Done:
        resource = _only_resource(command.id, self._view.find(command.id, command.registrar).resources)
        said = f"{command.state}: {command.message}" if command.message else command.state
        text = f"{resource.server} {resource.request} (resource {resource.id}): {said}"
        facts = {"resource_id": resource.id, "server": resource.server, "state": command.state}
        if command.dry_run:
            return Done(f"would tell {_count(resource)} of {text}", facts)
        registrar = self._view.registrar(resource.server.partition("/")[0])
        registrar.send_status(resource.id, Status(command.state, command.message))
        return Done(f"told {_count(resource)} of {text}", facts)

    # -- the tree ----------------------------------------------------------------------------------------------------

    def _kill(self, command: Kill) -> Done:
        path, supervisor, child = self._child(command.child)
        if child.pid is None:
            raise ActorUnavailable(f"{path}: it is {child.state}, and has no process to be killed", id=path)
        above, _, id = supervisor.path.rpartition("/")
        if child.pid == (SupervisorRef(above).which_child(id).pid if above else os.getpid()):
            raise UsageError(f"{path}: it runs in a thread of process {child.pid}, with others; terminate it instead")
        name = signal_name(command.signal)
        facts = {"path": path, "pid": child.pid, "signal": name}
        if command.dry_run:
            return Done(f"would send {name} to {path} (pid {child.pid})", facts)
        try:
            sent = signal_if(child.pid, command.signal, lambda: supervisor.which_child(child.id).pid == child.pid)
        except OSError as error:
            raise ActorUnavailable(f"{path}: {name} was not sent to {child.pid}: {error.strerror}", id=path) from error
        if not sent:
            raise ActorUnavailable(f"{path}: its process {child.pid} has ended", id=path)
        return Done(f"sent {name} to {path} (pid {child.pid})", facts)

    def _terminate(self, command: Terminate) -> Done:
        path, supervisor, child = self._child(command.child)
        facts = {"path": path, "was": child.state}
        if command.dry_run:
            return Done(f"would stop {path}, which is {child.state}", facts)
        supervisor.terminate_child(child.id)
        return Done(f"stopped {path}" if child.state != "stopped" else f"{path} was stopped already", facts)

    def _restart(self, command: Restart) -> Done:
        path, supervisor, child = self._child(command.child)
        spec = supervisor.get_childspec(child.id)
        if spec.restart == "temporary" or supervisor.describe()["strategy"] == "simple_one_for_one":
            raise UsageError(f"{path}: its supervisor forgets it when it stops; terminate it, and start a new one")
        facts = {"path": path, "was": child.state}
        if command.dry_run:
            return Done(f"would start {path} again, which is {child.state}", facts)
        if child.state != "stopped":
            supervisor.terminate_child(child.id)
        supervisor.restart_child(child.id)
        return Done(f"started {path} again", facts | {"pid": supervisor.which_child(child.id).pid})

    def _start(self, command: StartChild) -> Done:
        spec = child_from_toml(command.spec.encode(), command.file)
        supervisor = self._view.system.supervisor(command.supervisor or None)
        path = f"{supervisor.path}/{spec.id}"
        what = "supervisor" if isinstance(spec, Supervisor) else "worker"
        if command.dry_run:
            return Done(f"would start the {what} {path}", {"path": path})
        ref = supervisor.start_child(spec)
        if ref is None:
            return Done(f"{path}: its on_start said IGNORE, so it does not run", {"path": path, "pid": None})
        return Done(f"started the {what} {path}", {"path": path, "pid": ref.pid})

    def _stop(self, command: ShutDown) -> Done:
        name = self._view.system.name
        if command.dry_run:
            return Done(f"would stop system {name}", {"system": name})
        self._shut_down()
        return Done(f"system {name} is stopping", {"system": name})

    def _child(self, given: str) -> tuple[str, SupervisorRef, Child]:
        path = self._view.path_of(given)
        above, _, id = path.rpartition("/")
        if not above:
            raise UsageError(f"{path}: it is the root supervisor; to end it, shut the system down")
        supervisor = SupervisorRef(above)
        return path, supervisor, supervisor.which_child(id)


def _only_resource(id: str, resources: list[ResourceRow]) -> ResourceRow:
    if len(resources) > 1:
        several = ", ".join(f"{row.id} of {row.server}" for row in resources)
        raise UsageError(f"{shown(id)}: several resources begin so: {several}; give more of the id")
    if not resources:
        raise UnknownQuery(f"{shown(id)}: no registrar serves a resource of this id", query_id=id)
    return resources[0]


def _count(resource: ResourceRow) -> str:
    return f"{resource.holder_count} holder{'' if resource.holder_count == 1 else 's'}"


def _json(text: str) -> Any:
    try:
        return msgspec.json.decode(text)
    except (ValueError, RecursionError) as error:
        hint = "a text needs quotes of its own: '\"/dev/video0\"'"
        raise UsageError(f"request: expected JSON, got {shown(text)} ({error}); {hint}") from error


def _plain(value: Any) -> Any:
    """Return a value in the form that JSON gives it, or its text if JSON or an answer cannot hold it."""
    try:
        plain = msgspec.json.decode(msgspec.json.encode(value, enc_hook=repr))
        fits = len(msgspec.msgpack.encode(plain)) <= RESPONSE_LIMIT_BYTES
    except Exception:  # a user's value: keys that are no text, numbers that are too long
        return shown(value)
    return plain if fits else shown(value)
