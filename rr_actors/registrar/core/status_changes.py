"""What a registrar decides as a provider about how its resources are: statuses and late responses, to every holder.

What the owner says of a resource goes to the status callback of its server first. The row of the resource has it at
once. A notice of its own (records.is_own) says that the callback has to run; the commit that drops it makes the notices
for the holders, unless the callback has dealt with the status. What a status callback itself says of its resource goes
to the holders directly.

A status callback does not run while the load callback, or the recover callback, of its resource does: only when that
has returned there is a response that it may replace. Until then the status is deferred.
"""

from __future__ import annotations

import msgspec

from rr_actors.registrar.core.notices import drop_notice, notify, own_notices
from rr_actors.registrar.core.unloading import begin_unload
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Batch, Catalog
from rr_actors.registrar.model.commands import SetResponse, SetStatus
from rr_actors.registrar.model.effects import Answer, Happened, StartStatus
from rr_actors.registrar.model.rows import Notice, Phase, Resource, State

_replace = msgspec.structs.replace


# -- to the holders ------------------------------------------------------------------------------------------------


def spread(
    batch: Batch,
    resource: Resource,
    event: str,
    state: State,
    message: str,
    source: str,
    response: bytes | None = None,
    *,
    repeated: bool = False,
) -> None:
    """Note a status on the resource and tell every holder, once each."""
    resource = _note(batch, resource, state, message, response)
    said = Notice(event, "", "", resource.id, event, state, message, source, False, response)
    _tell_holders(batch, resource, said, repeated=repeated)


def _note(batch: Batch, resource: Resource, state: State, message: str, response: bytes | None) -> Resource:
    lasting = State.FATAL if resource.state is State.FATAL else state
    resource = _replace(
        resource,
        state=lasting,
        message=message,
        response=resource.response if response is None else response,
    )
    batch.put(resource)
    batch.cause(Happened("status", resource.id, resource.server, f"{state} {message}".rstrip()))
    return resource


def _tell_holders(batch: Batch, resource: Resource, said: Notice, *, repeated: bool = False) -> None:
    what = (said.event, said.state, said.message, said.source)
    for query in batch.catalog.queries_of(resource.id):
        notify(batch, query, *what, response=said.response, repeated=repeated)
    _end_if_unwanted(batch, resource)


def _end_if_unwanted(batch: Batch, resource: Resource) -> None:
    loaded = resource.phase is Phase.LOADED and resource.id not in batch.catalog.recovering
    if resource.state is State.FATAL and loaded and resource.id not in batch.catalog.holders:
        begin_unload(batch, resource)  # it lingered; nobody will be given it again


# -- to the server of the resource ---------------------------------------------------------------------------------


def start_status(batch: Batch, start: StartStatus) -> None:
    """Have the status callback of the resource run; when its load or recover callback has returned, if that runs."""
    resource = batch.catalog.resources[start.resource.id]
    if is_busy(batch.catalog, resource):
        deferred = batch.catalog.deferred
        batch.note(deferred, resource.id, (*deferred.get(resource.id, ()), start))
    else:
        batch.cause(_replace(start, resource=resource))


def is_busy(catalog: Catalog, resource: Resource) -> bool:
    """Return whether its load callback, or its recover callback, has not returned yet."""
    return resource.phase in (Phase.QUEUED, Phase.LOADING) or resource.id in catalog.recovering


def start_own(batch: Batch, server: str) -> None:
    """A server is there: have its status callback hear what it has not dealt with before a crash.

    Not what was said since: its callback has run for that, or does still, though it was unregistered meanwhile.
    """
    catalog = batch.catalog
    for resource_id in list(catalog.own_notices):
        resource = catalog.resources[resource_id]
        if resource.server == server:
            for notice in own_notices(batch, resource_id):
                if batch.forget(catalog.told, notice.id):
                    start_status(batch, StartStatus(resource, notice, "", repeated=True))


def own_done(batch: Batch, notice: Notice, *, handled: bool) -> None:
    """The status callback has run for what was said of its own resource: tell the holders, unless it is handled.

    A new response they need whatever the callback says; and the newest, as it may have replaced it once more.
    """
    resource = batch.catalog.resources.get(notice.resource_id)
    if resource is None or notice.id not in batch.catalog.notices:
        return
    drop_notice(batch, notice)
    if handled and notice.response is None:
        _end_if_unwanted(batch, resource)
    else:
        newest = None if notice.response is None else resource.response
        _tell_holders(batch, resource, _replace(notice, response=newest))


# -- what the owner says -------------------------------------------------------------------------------------------


def set_status(batch: Batch, command: SetStatus) -> None:
    """The owner's word on a resource, to its server and to all who hold it."""
    resource = batch.catalog.find(command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, failures.unknown_target(batch.catalog, command.target)))
        return
    _say(batch, resource, command, command.state, None)
    batch.cause(Answer(command.ticket, None))


def set_response(batch: Batch, command: SetResponse) -> None:
    """A late response: the stored one is replaced, every holder hears UPDATE with it."""
    resource = batch.catalog.find(command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, failures.unknown_target(batch.catalog, command.target)))
    elif resource.phase in (Phase.LOADING, Phase.QUEUED):
        batch.cause(Answer(command.ticket, failures.still_loading(resource)))
    else:
        _say(batch, resource, command, State.UPDATE, command.response)
        batch.cause(Answer(command.ticket, None))


def _say(
    batch: Batch, resource: Resource, command: SetStatus | SetResponse, state: State, response: bytes | None
) -> None:
    source = batch.catalog.origin_of(resource)
    event, message = command.event, command.message
    resource = _note(batch, resource, state, message, response)
    said = Notice(f"{event}:", "", "", resource.id, event, state, message, source, False, response)
    server = batch.catalog.servers.get(resource.server)
    if server is None or not server.has_status or command.callback_of == resource.id:
        _tell_holders(batch, resource, said)
    else:
        batch.put(said)
        start_status(batch, StartStatus(resource, said, "", repeated=False))
