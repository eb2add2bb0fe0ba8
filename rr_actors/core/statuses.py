"""What a registrar decides as a provider about how its resources are: statuses and late responses, to every holder."""

from __future__ import annotations

import msgspec

from rr_actors.core import failures
from rr_actors.core.batch import Batch
from rr_actors.core.commands import SetResponse, SetStatus
from rr_actors.core.effects import Answer, Happened
from rr_actors.core.notices import notify
from rr_actors.core.unloading import begin_unload
from rr_actors.records import Phase, Resource, State

_replace = msgspec.structs.replace


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
    lasting = State.FATAL if resource.state is State.FATAL else state
    resource = _replace(
        resource,
        state=lasting,
        message=message,
        response=resource.response if response is None else response,
    )
    batch.put(resource)
    batch.cause(Happened("status", resource.id, resource.server, f"{state} {message}".rstrip()))
    for query in batch.catalog.queries_of(resource.id):
        notify(batch, query, event, state, message, source, response=response, repeated=repeated)
    loaded = resource.phase is Phase.LOADED and resource.id not in batch.catalog.recovering
    if lasting is State.FATAL and loaded and resource.id not in batch.catalog.holders:
        begin_unload(batch, resource)  # it lingered; nobody will be given it again


def set_status(batch: Batch, command: SetStatus) -> None:
    """The owner's word on a resource, to all who hold it."""
    resource = batch.catalog.find(command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, failures.unknown_target(batch.catalog, command.target)))
        return
    source = batch.catalog.origin_of(resource)
    spread(batch, resource, command.event, command.state, command.message, source)
    batch.cause(Answer(command.ticket, None))


def set_response(batch: Batch, command: SetResponse) -> None:
    """A late response: the stored one is replaced, every holder hears UPDATE with it."""
    resource = batch.catalog.find(command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, failures.unknown_target(batch.catalog, command.target)))
    elif resource.phase in (Phase.LOADING, Phase.QUEUED):
        batch.cause(Answer(command.ticket, failures.still_loading(resource)))
    else:
        source = batch.catalog.origin_of(resource)
        spread(batch, resource, command.event, State.UPDATE, command.message, source, command.response)
        batch.cause(Answer(command.ticket, None))
