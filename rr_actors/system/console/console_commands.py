"""Commands of a console: they change something. The answer is a sentence that says what was done."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import Annotated, Any, Literal

import msgspec

from rr_actors.actors.mailbox_refs import MailboxRef
from rr_actors.actors.messaging.ask_cycles import asking_as
from rr_actors.actors.messaging.mailbox_looks import MailboxInfo
from rr_actors.actors.refs import Timeout
from rr_actors.base.errors import (
    ActorUnavailable,
    NotFound,
    NotSerializable,
    Unavailable,
    UnknownQuery,
    UsageError,
    counted,
    few,
    shown,
)
from rr_actors.base.names import CONNECTED, check_name, parse_server_id, short_id, short_ids
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.base.values.failure import error_of
from rr_actors.registrar.arguments import LoadOptions, server_target
from rr_actors.registrar.model.failures import held_by_whole
from rr_actors.registrar.model.rows import HIGHEST, LOWEST
from rr_actors.registrar.pages import QueryRow, ResourceRow
from rr_actors.registrar.queries import Status, response_bytes
from rr_actors.registrar.registrar import load_bytes
from rr_actors.runtime.processes.lifeline import signal_if
from rr_actors.runtime.processes.process import signal_name
from rr_actors.supervision.core.foreseen import What
from rr_actors.supervision.core.specs import Supervisor, child_from_toml
from rr_actors.supervision.supervisor import Child, SupervisorRef
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.asking import actor_calls
from rr_actors.system.console.connected_registrars import Caller
from rr_actors.system.console.console_view import REGISTRAR, Command, Verb, View
from rr_actors.system.snapshots import preview_in

# -- resources -------------------------------------------------------------------------------------------------------


class Load(Command[c.Done], frozen=True):
    """Load a resource.

    Attributes:
        server: "registrar/server".
        request: the request as JSON.
        holder: the registrar that holds the resource; "": the console's own registrar.
        keep: hold the resource after the answer. Otherwise it is released at once.
        dry_run: change nothing; the answer says what would be done.
    """

    server: c.Text
    request: c.Long
    holder: c.Text = ""
    keep: bool = False
    timeout_s: c.Seconds = 30.0
    dry_run: bool = False
    priority: c.Priority = 0

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        value = _json(self.request)
        server = parse_server_id(self.server)
        holder = self.holder or REGISTRAR
        if self.holder:
            view.registrar(holder)
        facts: dict[str, Any] = {"server": str(server), "holder": holder, "kept": self.keep}
        if self.dry_run:
            servers = view.registrar(server.registrar).servers()
            if str(server) not in servers:
                there = ", ".join(servers) or "none"
                raise NotFound(f"{server}: registrar {server.registrar!r} has no such server (it has: {there})")
            return c.Done(f"would load {server} {self.request}, held by {holder}", facts)
        query = view.holder(self.holder).load(str(server), value, timeout_s=self.timeout_s, priority=self.priority)
        facts |= {"query_id": query.id, "resource_id": query.resource_id, "response": _plain(query.response)}
        if self.keep and not caller.is_gone:
            return c.Done(f"loaded {server}: {holder} holds it as query {short_id(query.id)}", facts)
        query.unload(timeout_s=self.timeout_s)
        return c.Done(f"loaded {server} and released it again", facts | {"kept": False})


def priority_from(what: str, text: str) -> int | None:
    """Return the priority that a person has typed; None for "standby".

    Raises:
        UsageError: it is none.
    """
    if text == "standby":
        return None
    with contextlib.suppress(ValueError):
        if LOWEST <= (number := int(text)) <= HIGHEST:
            return number
    raise UsageError(f"{what}: expected a whole number from {LOWEST} to {HIGHEST}, or standby, got {shown(text)}")


class GivePriority(Command[c.Done], frozen=True):
    """Give a query of any holder a priority. `id` may be the beginning or end of an id."""

    id: c.Text
    priority: c.Priority
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        found = view.find(self.id)
        query = _only_query(self.id, found.queries, found.resources, "name one of these")
        said = "standby" if self.priority is None else f"priority {self.priority}"
        text = f"{said} to query {short_id(query.id)} of {query.origin} on {query.name}"
        facts = {"query_id": query.id, "holder": query.origin, "server": query.server, "priority": self.priority}
        if self.dry_run:
            return c.Done(f"would give {text}", facts)
        view.registrar(query.origin).set_priority(query.id, self.priority)
        return c.Done(f"gave {text}", facts)


class Unload(Command[c.Done], frozen=True):
    """Release a query of any holder; with `force` take a resource away from all its holders.

    `id` may be the beginning or end of an id, or the name of a resource with one holder.
    """

    id: c.Text
    force: bool = False
    timeout_s: c.Seconds = 30.0
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        if self.force and "/" in self.id and " " not in self.id:
            return _clear(view, self.id, self.dry_run)
        found = view.find(self.id)
        if self.force:
            resource = _only_resource(self.id, found.resources)
            text = f"{resource.name} ({short_id(resource.id)}) away from {_count(resource)}"
            if self.dry_run:
                return c.Done(f"would take {text}", {"resource_id": resource.id})
            registrar = view.registrar(resource.server.partition("/")[0])
            registrar.unload(resource.id, force=True, timeout_s=self.timeout_s)
            return c.Done(f"took {text}", {"resource_id": resource.id})
        if " " in self.id and len(found.resources) == 1 and found.resources[0].holder_count == 1:
            found = view.find(found.resources[0].holders[0].query_id)
        query = _only_query(self.id, found.queries, found.resources)
        if query.parent and (wholes := view.find(query.parent).resources):
            raise error_of(held_by_whole(short_id(query.id), wholes[0].name))
        text = f"query {short_id(query.id)} of {query.origin} on {query.name}"
        facts = {"query_id": query.id, "holder": query.origin, "server": query.server}
        if self.dry_run:
            return c.Done(f"would release {text}", facts)
        view.registrar(query.origin).unload(query.id, timeout_s=self.timeout_s)
        return c.Done(f"released {text}", facts)


def _clear(view: View, server: str, dry_run: bool) -> c.Done:
    """Remove all resources of a server that is not registered."""
    name, _, local = server.partition("/")
    registrar = view.registrar(name)
    if server in registrar.servers():
        raise UsageError(f"{server}: the server is registered: unload its resources one by one, by their ids")
    text = f"all resources of {server}, which is not registered"
    if not dry_run:
        registrar.unregister_server(local)
    return c.Done(f"would remove {text}" if dry_run else f"removed {text}", {"server": server})


_RELEASED = "release one of these, or take the resource away from all of them (--force)"


def _only_query(id: str, queries: list[QueryRow], resources: list[ResourceRow], instead: str = _RELEASED) -> QueryRow:
    held = [row for row in queries if row.hold == "held"]
    if len(held) == 1:
        return held[0]
    if len(held) > 1:
        ids = short_ids(row.id for row in held)
        several = few(f"{ids[row.id]} of {row.origin}" for row in held)
        raise UsageError(f"{shown(id)}: several queries have this in their ids: {several}; give more of the id")
    if resources:
        ids = short_ids(holder.query_id for holder in resources[0].holders)
        holders = few(f"{ids[holder.query_id]} of {holder.origin}" for holder in resources[0].holders) or "none"
        text = f"{shown(id)}: it is a resource, and its queries are: {holders}; {instead}"
        raise UnknownQuery(text, query_id=id)
    raise UnknownQuery(f"{shown(id)}: nobody holds a query of this id", query_id=id)


class SendStatus(Command[c.Done], frozen=True):
    """Send a status of a resource in its owner's name. `id` may also be a part of its id, its name, or a query's id."""

    id: c.Text
    state: Literal["OK", "UPDATE", "WARNING", "ERROR", "FATAL"]
    message: c.Long = ""
    registrar: c.Text = ""
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        resource = _only_resource(self.id, view.find(self.id, self.registrar).resources)
        said = f"{self.state}: {self.message}" if self.message else self.state
        text = f"{resource.name} ({short_id(resource.id)}): {said}"
        facts = {"resource_id": resource.id, "server": resource.server, "state": self.state}
        if self.dry_run:
            return c.Done(f"would tell {_count(resource)} of {text}", facts)
        registrar = view.registrar(resource.server.partition("/")[0])
        registrar.send_status(resource.id, Status(self.state, self.message))
        return c.Done(f"told {_count(resource)} of {text}", facts)


class Revoke(Command[c.Done], frozen=True):
    """Take a resource away from its holders in its owner's name, the highest first, and wait until it is unloaded.

    `id` may also be a part of its id, its name, or a query's id.
    """

    id: c.Text
    why: c.Long
    grace_s: c.Seconds = 5.0
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        resource = _only_resource(self.id, view.find(self.id).resources)
        text = f"{resource.name} ({short_id(resource.id)}) from {_count(resource)}"
        facts = {"resource_id": resource.id, "server": resource.server}
        if self.dry_run:
            return c.Done(f"would revoke {text}", facts)
        registrar = view.registrar(resource.server.partition("/")[0])
        registrar.revoke(resource.id, self.why, grace_s=self.grace_s)
        return c.Done(f"revoked {text}", facts)


class Reload(Command[c.Done], frozen=True):
    """Unload a resource and load it again for the same request, in its owner's name; its holders keep it.

    `id` may also be a part of its id, its name, or a query's id.
    """

    id: c.Text
    timeout_s: c.Seconds = 30.0
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        resource = _only_resource(self.id, view.find(self.id).resources)
        holders = resource.held_by or "nobody"
        more = resource.holder_count - len(resource.holders)
        text = f"{resource.name} ({short_id(resource.id)}), held by {holders}{f' and {more} more' if more else ''}"
        facts = {"resource_id": resource.id, "server": resource.server, "holders": resource.holder_count}
        if self.dry_run:
            return c.Done(f"would reload {text}", facts)
        registrar = view.registrar(resource.server.partition("/")[0])
        registrar.reload(resource.id, timeout_s=self.timeout_s)
        return c.Done(f"reloaded {text}", facts)


def _only_resource(id: str, resources: list[ResourceRow]) -> ResourceRow:
    if len(resources) > 1:
        ids = short_ids(row.id for row in resources)
        several = few(f"{ids[row.id]} ({row.name})" for row in resources)
        raise UsageError(f"{shown(id)}: several resources have this in their ids: {several}; give more of the id")
    if not resources:
        raise UnknownQuery(f"{shown(id)}: no registrar serves a resource of this id", query_id=id)
    return resources[0]


def _count(resource: ResourceRow) -> str:
    return counted(resource.holder_count, "holder")


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
        fits = len(msgspec.msgpack.encode(plain)) <= c.RESPONSE_LIMIT_BYTES
    except Exception:  # a user's value: keys that are no text, numbers that are too long
        return shown(value)
    return plain if fits else shown(value)


# -- the tree --------------------------------------------------------------------------------------------------------


class Kill(Command[c.Done], frozen=True):
    """Send a signal to the process of a child, given by its path or, if only one has it, its id."""

    child: c.Text
    signal: Annotated[int, msgspec.Meta(ge=1, le=64)] = 9
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        path, supervisor, child = _child(view, self.child)
        if child.pid is None:
            raise ActorUnavailable(f"{path}: it is {child.state}, and has no process to be killed", id=path)
        above, _, id = supervisor.path.rpartition("/")
        if child.pid == (SupervisorRef(above).which_child(id).pid if above else os.getpid()):
            raise UsageError(f"{path}: it runs in a thread of process {child.pid}, with others; terminate it instead")
        name = signal_name(self.signal)
        restart = supervisor.get_childspec(child.id).restart
        facts = {"path": path, "pid": child.pid, "signal": name, "restart": restart}
        if self.dry_run:
            text = f"would send {name} to {path} (pid {child.pid})"
            if self.signal != signal.SIGKILL:
                return c.Done(text, facts)
            return _foretold(view, text, facts, path, "kill")
        try:
            sent = signal_if(child.pid, self.signal, lambda: supervisor.which_child(child.id).pid == child.pid)
        except OSError as error:
            raise ActorUnavailable(f"{path}: {name} was not sent to {child.pid}: {error.strerror}", id=path) from error
        if not sent:
            raise ActorUnavailable(f"{path}: its process {child.pid} has ended", id=path)
        return c.Done(f"sent {name} to {path} (pid {child.pid})", facts)


class Terminate(Command[c.Done], frozen=True):
    """Stop a child, as its supervisor does; its specification stays, unless it is temporary."""

    child: c.Text
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        path, supervisor, child = _child(view, self.child)
        facts = {"path": path, "was": child.state}
        if self.dry_run:
            return _foretold(view, f"would stop {path}, which is {child.state}", facts, path, "stop")
        supervisor.terminate_child(child.id)
        return c.Done(f"stopped {path}" if child.state != "stopped" else f"{path} was stopped already", facts)


class Restart(Command[c.Done], frozen=True):
    """Stop a child if it runs, and start it."""

    child: c.Text
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        try:
            path, supervisor, child = _child(view, self.child)
        except (NotFound, UsageError) as error:
            if not (found := _resources_of(view, self.child)):
                raise
            text = f"{shown(self.child)}: expected a child of the tree, got a resource, {found[0].name}"
            raise UsageError(f"{text}; `rr-actors reload {found[0].id}` unloads it and loads it again") from error
        spec = supervisor.get_childspec(child.id)
        is_dynamic = supervisor.describe()["strategy"] == "simple_one_for_one"
        if spec.restart == "temporary" or (is_dynamic and child.state != "stopped"):
            raise UsageError(f"{path}: its supervisor forgets it when it stops; terminate it, and start a new one")
        facts = {"path": path, "was": child.state}
        if self.dry_run:
            return _foretold(view, f"would start {path} again, which is {child.state}", facts, path, "restart")
        if child.state != "stopped":
            supervisor.terminate_child(child.id)
        supervisor.restart_child(child.id)
        return c.Done(f"started {path} again", facts | {"pid": supervisor.which_child(child.id).pid})


def _foretold(view: View, text: str, facts: dict[str, Any], path: str, what: What) -> c.Done:
    """Say what would happen to the tree and the resources."""
    preview = preview_in(view.node, view.system.supervisor().path, path, what)
    texts = [text, *preview.sentences()]
    if (took := _last_start_s(view, path)) is not None:
        texts.append(f"its last start took {took:.2g} s")
    resources, heard = preview.resources[: c.PAGE_LIMIT], preview.heard[: c.PAGE_LIMIT]  # an answer has a limit
    left_out = len(preview.resources) - len(resources), len(preview.heard) - len(heard)
    shown_part = msgspec.structs.replace(preview, resources=resources, heard=heard)
    would = msgspec.to_builtins(shown_part) | dict(zip(("resources_left_out", "heard_left_out"), left_out, strict=True))
    return c.Done("; ".join(texts), facts | {"would": would})


def _last_start_s(view: View, path: str) -> float | None:
    """Return how many seconds the newest start of a child took; None if that is not remembered."""
    starts = [event for event in view.history(path) if event.path == path and event.event in ("started", "restarted")]
    return starts[-1].facts.get("ready_s") if starts else None


def _resources_of(view: View, id: str) -> list[ResourceRow]:
    """Return the resources that an id may mean; none if it is no id of any."""
    try:
        return view.find(id).resources
    except (NotFound, UsageError):
        return []


class StartChild(Command[c.Done], frozen=True):
    """Add a child to the supervisor at a path ("": the root), from a TOML text as Supervisor.from_toml reads it.

    With an `id`, a child of a dynamic supervisor: `spec` has its arguments, as a JSON list.
    """

    spec: c.Long
    supervisor: c.Text = ""
    file: c.Text = "the specification"
    dry_run: bool = False
    id: c.Text = ""

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        supervisor = view.system.supervisor(self.supervisor or None)
        spec = _arguments(self.spec) if self.id else child_from_toml(self.spec.encode(), self.file)
        path = f"{supervisor.path}/{self.id if isinstance(spec, list) else spec.id}"
        what = "supervisor" if isinstance(spec, Supervisor) else "worker"
        if self.dry_run:
            return c.Done(f"would start the {what} {path}", {"path": path})
        ref = supervisor.start_child(spec, id=self.id or None)
        if ref is None:
            return c.Done(f"{path}: its on_start said IGNORE, so it does not run", {"path": path, "pid": None})
        return c.Done(f"started the {what} {path}", {"path": path, "pid": ref.pid})


def _arguments(text: str) -> list[Any]:
    try:
        return msgspec.json.decode(text, type=list[Any])
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise UsageError(f"arguments: expected a JSON list, got {shown(text)}: {error}") from error


class BackUp(Command[c.Done], frozen=True):
    """Back up the system to a directory, given by its absolute path, as System.backup() does."""

    directory: c.Text
    timeout_s: c.Seconds = 30.0
    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        if self.dry_run:
            return c.Done(f"would back up system {view.system.name} to {self.directory}", {"directory": self.directory})
        backup = view.system.backup(self.directory, timeout_s=self.timeout_s)
        return c.Done(backup.told(self.directory), backup.facts(self.directory))


class ShutDown(Command[c.Done], frozen=True):
    """Stop the whole system, in order, as System.stop() does."""

    dry_run: bool = False

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        name = view.system.name
        if self.dry_run:
            return c.Done(f"would stop system {name}", {"system": name})
        view.shut_down()
        return c.Done(f"system {name} is stopping", {"system": name})


def _child(view: View, given: str) -> tuple[str, SupervisorRef, Child]:
    path = view.path_of(given)
    above, _, id = path.rpartition("/")
    if not above:
        raise UsageError(f"{path}: it is the root supervisor; to end it, shut the system down")
    supervisor = SupervisorRef(above)
    return path, supervisor, supervisor.which_child(id)


# -- mailboxes, in a system for debugging ----------------------------------------------------------------------------


class PauseActor(Command[c.Done], frozen=True):
    """Keep the messages of an actor in its mailbox."""

    actor: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        found = view.at_mailbox(self.actor, MailboxRef.pause)
        busy = f"; it still handles {found.handled}" if found.handled is not None else ""
        return c.Done(f"paused {found.path}: {found.length} wait{busy}", _mailbox_facts(found))


class ResumeActor(Command[c.Done], frozen=True):
    """Have a paused actor handle its messages again."""

    actor: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        found = view.at_mailbox(self.actor, MailboxRef.resume)
        return c.Done(f"resumed {found.path}: {found.length} waited", _mailbox_facts(found))


class StepActor(Command[c.Done], frozen=True):
    """Have a paused actor handle one message."""

    actor: c.Text
    timeout_s: c.Seconds = 30.0

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        stepped = view.at_mailbox(self.actor, lambda mailbox: mailbox.step(self.timeout_s))
        found = view.at_mailbox(self.actor, MailboxRef.look)
        facts = _mailbox_facts(found) | {"type": None if stepped is None else stepped.type}
        if stepped is None:
            return c.Done(f"{found.path} handled nothing: no message waits", facts)
        return c.Done(f"{found.path} handled {stepped}; {found.length} wait", facts)


def _mailbox_facts(found: MailboxInfo) -> dict[str, object]:
    return {"path": found.path, "waiting": found.length, "is_paused": found.is_paused}


# -- connected programs -----------------------------------------------------------------------------------------------


class OpenRegistrar(Command[c.Done], frozen=True):
    """Open a registrar for a connected program. When this socket ends, it is closed, and its queries are released.

    In the system it is called "connection.NAME"; Done's facts have this name as `registrar`.
    """

    name: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        name = check_name(CONNECTED + check_name(self.name, "registrar name"), "registrar name")
        view.connected.open(caller, name, view.open_registrar)
        return c.Done(f"opened registrar {name}", {"registrar": name})


class Hold(Command[c.Holding], frozen=True):
    """Load a resource with a connected program's registrar, by a request's canonical bytes.

    If the connection ends, or makes another request, after the answer and before its Keep, the query is released.
    """

    registrar: c.Text
    server: c.Text
    request: c.Value
    timeout_s: c.Seconds = 30.0
    priority: c.Priority = 0
    wait_s: c.Seconds | None = None

    def _carry_out(self, view: View, caller: Caller) -> c.Holding:
        opened = view.connected.named(self.registrar)
        registrar = opened.registrar
        options = LoadOptions(on_status=opened.hear, priority=self.priority, own=True, wait_s=self.wait_s)
        target = server_target(self.server, view.node)
        query = load_bytes(registrar, str(target), self.request, "", options, timeout_s=self.timeout_s)
        response = response_bytes(query)
        if len(response) > c.RESPONSE_LIMIT_BYTES:
            registrar.unload(query.id, timeout_s=self.timeout_s)
            text = f"a response of {len(response)} bytes is over a connection's limit of {c.RESPONSE_LIMIT_BYTES}"
            raise NotSerializable(f"{self.server}: {text}; give the name of a file, say", path="response")
        opened.watch(query, view.node)
        there = str(target) if "/" in target.registrar else ""
        return c.Holding(query.id, query.resource_id, response, query.state, there)


class Release(Command[c.Done], frozen=True):
    """Release a query of a program's registrar, or all its queries at a server; or all, if it names neither."""

    registrar: c.Text
    query_id: c.Text = ""
    server: c.Text = ""
    timeout_s: c.Seconds = 30.0

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        registrar = view.connected.named(self.registrar).registrar
        if self.query_id:
            registrar.unload(self.query_id, timeout_s=self.timeout_s)
        elif self.server:
            registrar.unload_client(self.server, timeout_s=self.timeout_s)
        else:
            registrar.unload_all(timeout_s=self.timeout_s)
        return c.Done(f"released {self.query_id or self.server or 'all'}")


class AwaitStatuses(Verb[c.Statuses], frozen=True):
    """Wait for statuses of the queries of the registrar that was opened by this connection. The answer has no limit.

    A system that is stopping answers, too: its end is the next that the program hears.
    """

    registrar: c.Text

    def _carry_out(self, view: View, caller: Caller) -> c.Statuses:
        return c.Statuses(view.connected.named(self.registrar, caller).take())


class AskActor(Command[c.Replied], frozen=True):
    """Ask an actor of the tree, by its path or id; the message is plain data, as canonical bytes.

    `asker`: the name that the actor's handler sees, a registrar of this program or "connection.pid-" and its process.
    """

    actor: c.Text
    message: c.Value
    timeout_s: c.Seconds = 30.0
    asker: c.Text = ""

    def _carry_out(self, view: View, caller: Caller) -> c.Replied:
        message = ANY.decode(self.message, self.actor, "message")
        ref = view.system.ref(self.actor)
        name = view.connected.asking(caller, self.asker)
        try:
            with asking_as(name):
                answer = ref.ask(message, timeout=self.timeout_s)
        except Timeout as late:
            text = f"{self.actor}: it has not answered within {self.timeout_s:g} s; a later answer reaches nobody"
            raise Unavailable(text) from late
        except Exception as error:
            raise actor_calls.as_heard_outside(self.actor, error) from error
        return c.Replied(encode(answer, f"answer of {self.actor}"))


ANY = Codec(None, "message")
