"""What a registrar decides as a provider when it takes queries from their holders."""

from __future__ import annotations

from rr_actors.core import failures
from rr_actors.core.batch import Batch
from rr_actors.core.commands import ForceUnload, Unregister
from rr_actors.core.effects import Answer, Reply
from rr_actors.core.notices import drop_notice, drop_query, notify
from rr_actors.core.parking import drop_parked
from rr_actors.core.refusing import refuse_all, remember
from rr_actors.core.unloading import begin_unload, settle, unheld
from rr_actors.messages import Gone, Unloaded
from rr_actors.records import Phase, Resource, State


def force_unload(batch: Batch, command: ForceUnload) -> None:
    """Take the resource from everybody who holds it; the owner is answered when it is gone."""
    resource = batch.catalog.find(command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, failures.unknown_target(batch.catalog, command.target)))
        return
    waiting = batch.catalog.owners.get(resource.id, ())
    batch.note(batch.catalog.owners, resource.id, (*waiting, command.ticket))
    _evict(batch, resource, command.event, command.why)


def unregister(batch: Batch, command: Unregister, event: str) -> None:
    """Take no more loads and release every query; the owner is answered when all resources are gone."""
    catalog = batch.catalog
    if command.name not in catalog.servers or command.name in catalog.leaving:
        batch.cause(Answer(command.ticket, failures.unknown_server(catalog, command.name)))
        return
    batch.note(catalog.leaving, command.name, command.ticket)
    for resource_id in list(catalog.by_server.get(command.name, ())):
        _evict(batch, catalog.resources[resource_id], event, f"server {command.name!r} was unregistered")
    settle(batch, command.name)


def _evict(batch: Batch, resource: Resource, event: str, why: str) -> None:
    match resource.phase:
        case Phase.QUEUED | Phase.LOADING:
            _refuse_holders(batch, resource, why)
        case Phase.LOADED | Phase.UNLOAD_FAILED:
            source = batch.catalog.origin_of(resource)
            failure = failures.evicted(batch.catalog, resource, why)
            for query in batch.catalog.queries_of(resource.id):
                batch.drop(query)
                remember(batch, query.id, failure)
                notify(batch, query, event, State.FATAL, why, source, released=True)
            if resource.id not in batch.catalog.recovering:  # else when it is known whether it lives
                begin_unload(batch, resource)
        case Phase.UNLOADING:
            for query in batch.catalog.queries_of(resource.id):
                drop_query(batch, query)
                batch.cause(Reply(query.origin, Unloaded(query.id)))


def _refuse_holders(batch: Batch, resource: Resource, why: str) -> None:
    """Those who wait hear it. A load under way goes on, and what it brings is unloaded then."""
    for reply in refuse_all(batch, resource, failures.evicted(batch.catalog, resource, why)):
        batch.cause(reply)
    unheld(batch, resource)


def gone(batch: Batch, message: Gone) -> None:
    """Release everything a registrar held that will not come back."""
    catalog = batch.catalog
    drop_parked(batch, lambda parked: parked.origin == message.origin)
    for query_id in list(catalog.by_origin.get(message.origin, ())):
        query = catalog.queries.get(query_id)
        if query is not None:
            resource = catalog.resources[query.resource_id]
            drop_query(batch, query)
            if resource.id not in catalog.holders and resource.id not in catalog.recovering:
                unheld(batch, resource)
    for notice_id in list(catalog.notices_to.get(message.origin, ())):
        drop_notice(batch, catalog.notices[notice_id])
