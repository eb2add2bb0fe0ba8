"""What a registrar decides as a provider about unloads: queries let go, and resources whose last query is gone."""

from __future__ import annotations

import msgspec

from rr_actors.registrar.core.callback_runs import running, start_queued, start_unload
from rr_actors.registrar.core.notices import (
    drop_notice,
    drop_notices,
    drop_parked,
    drop_query,
    drop_resource,
    notify,
    park,
    refuse_all,
    remember,
    send_notices,
)
from rr_actors.registrar.core.releasing import release_parts
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Batch
from rr_actors.registrar.model.commands import ForceUnload, LingerOver, UnloadDone, UnloadErred, Unregister
from rr_actors.registrar.model.effects import Answer, Effect, Happened, Reply, SetTimer
from rr_actors.registrar.model.messages import Failure, Gone, Unload, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import Phase, Query, Resource, State

_replace = msgspec.structs.replace


def unload(batch: Batch, message: Unload) -> None:
    """Let one query go, and the resource with the last of them."""
    catalog = batch.catalog
    query = catalog.queries.get(message.query_id)
    if query is None:
        drop_parked(batch, lambda parked: parked.query_id == message.query_id)
        remember(batch, message.query_id, failures.LET_GO)  # its Load may be slower, by another way
        drop_notices(batch, message.origin, message.query_id)  # that it was taken away: of no interest any more
        batch.cause(Reply(message.origin, Unloaded(message.query_id)))
    elif query.origin != message.origin:
        refusal = UnloadRefused(message.query_id, failures.not_holder(query, message.origin))
        batch.cause(Reply(message.origin, refusal))
    elif query.resource_id in catalog.recovering:
        park(batch, query.resource_id, message)
    else:
        _let_go(batch, query)


def _let_go(batch: Batch, query: Query) -> None:
    catalog = batch.catalog
    resource = catalog.resources[query.resource_id]
    last = len(catalog.holders[resource.id]) == 1
    batch.note(catalog.letting, query.id, True)
    remember(batch, query.id, failures.LET_GO)
    if last and resource.phase is Phase.UNLOADING:
        return  # asked again: answered when it is done
    if last and resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED) and not _lingers(batch, resource):
        start_unload(batch, resource)  # the query goes with the resource, and its holder is answered then
        return
    drop_query(batch, query)
    batch.cause(Reply(query.origin, Unloaded(query.id)))
    if last:
        unheld(batch, resource)


def unheld(batch: Batch, resource: Resource) -> None:
    """Nobody holds the resource any more."""
    if resource.phase is Phase.QUEUED:
        for answer in answers_to_owners(batch, resource, None):
            batch.cause(answer)
        drop_resource(batch, resource)
        settle(batch, resource.server)
    elif resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED):
        retire(batch, resource)
    elif resource.server in batch.catalog.servers and batch.forget(batch.catalog.interrupted, resource.id):
        begin_unload(batch, _replace(resource, tries=0))  # not run again: what the interrupted run left is cleaned up


def _lingers(batch: Batch, resource: Resource) -> bool:
    server = batch.catalog.servers.get(resource.server)
    warm = resource.phase is Phase.LOADED and resource.state is not State.FATAL
    return server is not None and server.linger_s > 0 and warm and not condemned(batch, resource)


def condemned(batch: Batch, resource: Resource) -> bool:
    """Its owner wants it gone, by itself or with its server."""
    return resource.id in batch.catalog.owners or resource.server in batch.catalog.leaving


def retire(batch: Batch, resource: Resource) -> None:
    """Keep an unheld resource warm, if its server says so, or unload it."""
    if _lingers(batch, resource):
        linger_s = batch.catalog.servers[resource.server].linger_s
        batch.cause(SetTimer("linger:" + resource.id, linger_s, LingerOver(resource.id)))
    else:
        begin_unload(batch, resource)


def linger_over(batch: Batch, over: LingerOver) -> None:
    """Unload what nobody came back for."""
    resource = batch.catalog.resources.get(over.resource_id)
    if resource is not None and resource.phase is Phase.LOADED and resource.id not in batch.catalog.holders:
        begin_unload(batch, resource)


def begin_unload(batch: Batch, resource: Resource) -> None:
    """Have the unload callback run."""
    batch.cause(SetTimer("linger:" + resource.id, None, None))
    start_unload(batch, resource)


def unload_done(batch: Batch, done: UnloadDone) -> None:
    """The resource is gone: release what it held, answer who waits, let a queued load of the same request begin."""
    resource = running(batch.catalog, done.resource_id, Phase.UNLOADING, done.tries)
    if resource is None:
        return
    after: list[Effect] = []
    for query in batch.catalog.queries_of(resource.id):
        drop_query(batch, query)
        after.append(Reply(query.origin, Unloaded(query.id)))
    after += answers_to_owners(batch, resource, None)
    drop_resource(batch, resource)
    batch.cause(Happened("unloaded", resource.id, resource.server, ""))
    release_parts(batch, resource.id, after)
    _next_in_queue(batch, resource)
    settle(batch, resource.server)


def unload_erred(batch: Batch, erred: UnloadErred) -> None:
    """Keep the resource, as it may still be running, and tell whoever unloaded it."""
    resource = running(batch.catalog, erred.resource_id, Phase.UNLOADING, erred.tries)
    if resource is None:
        return
    batch.put(_replace(resource, phase=Phase.UNLOAD_FAILED, message=erred.failure.message))
    batch.cause(Happened("unload_failed", resource.id, resource.server, erred.failure.message))
    for query in batch.catalog.queries_of(resource.id):
        if batch.forget(batch.catalog.letting, query.id):  # else its Unload is on its way again, and tries again
            batch.cause(Reply(query.origin, UnloadRefused(query.id, erred.failure)))
        send_notices(batch, query)  # a holder that is letting go does not listen
    for answer in answers_to_owners(batch, resource, erred.failure):
        batch.cause(answer)
    _next_in_queue(batch, resource)
    settle(batch, resource.server, erred.failure)


def _next_in_queue(batch: Batch, gone: Resource) -> None:
    catalog = batch.catalog
    if catalog.queued:
        for id in list(catalog.queued.get((gone.server, gone.request), ())):
            start_queued(batch, catalog.resources[id])


def answers_to_owners(batch: Batch, resource: Resource, failure: Failure | None) -> list[Answer]:
    """Those who unloaded it by force are answered."""
    return [Answer(ticket, failure) for ticket in batch.forget(batch.catalog.owners, resource.id) or ()]


def settle(batch: Batch, server: str, failure: Failure | None = None) -> None:
    """A server that is leaving has left when nothing of it is in motion."""
    catalog = batch.catalog
    if server not in catalog.leaving:
        return
    left = [catalog.resources[id] for id in catalog.by_server.get(server, ())]
    if all(resource.phase is Phase.UNLOAD_FAILED for resource in left):
        ticket = batch.forget(catalog.leaving, server)
        batch.forget(catalog.servers, server)
        if left and failure is None:
            failure = failures.left_behind(catalog, left)
        batch.cause(Answer(ticket, failure))


# What a registrar decides as a provider when it takes queries from their holders.


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
