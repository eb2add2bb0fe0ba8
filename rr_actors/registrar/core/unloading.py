"""The decisions of a provider about unloads: queries that are released, and resources whose last query is gone."""

from __future__ import annotations

from msgspec.structs import replace

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
from rr_actors.registrar.model.catalog import Decision
from rr_actors.registrar.model.commands import ForceUnload, LingerOver, UnloadDone, UnloadErred, Unregister
from rr_actors.registrar.model.effects import Answer, Effect, Happened, Reply, SetTimer
from rr_actors.registrar.model.messages import Failure, Gone, Unload, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import (
    LOADED,
    NOT_BEGUN,
    QUEUED,
    UNLOAD_FAILED,
    UNLOADING,
    Notice,
    Phase,
    Query,
    Resource,
    State,
)


def unload(decision: Decision, message: Unload) -> None:
    """Release one query, and unload the resource with its last query."""
    catalog = decision.catalog
    query = catalog.queries.get(message.query_id)
    if query is None:
        drop_parked(decision, lambda parked: parked.query_id == message.query_id)
        remember(decision, message.query_id, failures.LET_GO)  # its Load may still come, by another way
        drop_notices(decision, message.origin, message.query_id)  # they say that it was taken away: no longer needed
        decision.cause(Reply(message.origin, Unloaded(message.query_id)))
    elif query.origin != message.origin:
        refusal = UnloadRefused(message.query_id, failures.not_holder(query.id, query.origin, message.origin))
        decision.cause(Reply(message.origin, refusal))
    elif query.resource_id in catalog.recovering:
        park(decision, query.resource_id, message)
    else:
        _release(decision, query)


def _release(decision: Decision, query: Query) -> None:
    catalog = decision.catalog
    resource = catalog.resources[query.resource_id]
    last = len(catalog.holders[resource.id]) == 1
    remember(decision, query.id, failures.LET_GO)
    again = last and resource.phase is UNLOADING
    if again or (last and resource.phase in (LOADED, UNLOAD_FAILED) and not _lingers(decision, resource)):
        decision.note(catalog.unanswered, query.id, True)  # answered when the resource is gone, and the query with it
        if not again:
            start_unload(decision, resource)
        return
    drop_query(decision, query)
    decision.cause(Reply(query.origin, Unloaded(query.id)))
    if last:
        unheld(decision, resource)


def unheld(decision: Decision, resource: Resource) -> None:
    """Decide about a resource that nobody holds any more: drop, keep warm or unload it, by its phase."""
    if resource.phase is QUEUED:
        decision.effects += answers_to_owners(decision, resource, None)
        drop_resource(decision, resource)
        settle(decision, resource.server)
    elif resource.phase in (LOADED, UNLOAD_FAILED):
        retire(decision, resource)
    elif resource.tries == NOT_BEGUN and resource.server in decision.catalog.servers:
        # The load does not run again; the unload callback cleans up after the interrupted run.
        begin_unload(decision, replace(resource, tries=0))


def _lingers(decision: Decision, resource: Resource) -> bool:
    server = decision.catalog.servers.get(resource.server)
    warm = resource.phase is LOADED and resource.state is not State.FATAL
    return server is not None and server.linger_s > 0 and warm and not condemned(decision, resource)


def condemned(decision: Decision, resource: Resource) -> bool:
    """Return whether the owner has unloaded the resource by force, or unregistered its server."""
    return resource.id in decision.catalog.owners or resource.server in decision.catalog.leaving


def retire(decision: Decision, resource: Resource) -> None:
    """Keep an unheld resource warm if its server says so; otherwise unload it."""
    if _lingers(decision, resource):
        linger_s = decision.catalog.servers[resource.server].linger_s
        decision.cause(SetTimer("linger:" + resource.id, linger_s, LingerOver(resource.id)))
    else:
        begin_unload(decision, resource)


def linger_over(decision: Decision, over: LingerOver) -> None:
    """Unload a resource that nobody has loaded again while it was kept warm."""
    resource = decision.catalog.resources.get(over.resource_id)
    if resource is not None and resource.phase is LOADED and resource.id not in decision.catalog.holders:
        begin_unload(decision, resource)


def begin_unload(decision: Decision, resource: Resource) -> None:
    """Cancel the linger timer, and run the unload callback."""
    decision.cause(SetTimer("linger:" + resource.id, None, None))
    start_unload(decision, resource)


def unload_done(decision: Decision, done: UnloadDone) -> None:
    """Remove the resource, release its parts, answer all that wait, and start a queued load of the same request."""
    resource = running(decision.catalog, done.resource_id, UNLOADING, done.tries)
    if resource is None:
        return
    after: list[Effect] = []
    for query in decision.catalog.queries_of(resource.id):
        drop_query(decision, query)
        after.append(Reply(query.origin, Unloaded(query.id)))
    after += answers_to_owners(decision, resource, None)
    drop_resource(decision, resource)
    decision.cause(Happened("unloaded", resource.id, resource.server, ""))
    release_parts(decision, resource.id, after)
    _next_in_queue(decision, resource)
    settle(decision, resource.server)


def unload_erred(decision: Decision, erred: UnloadErred) -> None:
    """Keep the resource as unload_failed, as it may still be running, and refuse the Unloads that wait."""
    resource = running(decision.catalog, erred.resource_id, UNLOADING, erred.tries)
    if resource is None:
        return
    decision.put(replace(resource, phase=UNLOAD_FAILED, message=erred.failure.message))
    decision.cause(Happened("unload_failed", resource.id, resource.server, erred.failure.message))
    for query in decision.catalog.queries_of(resource.id):
        if decision.forget(decision.catalog.unanswered, query.id):  # else its Unload comes again, for a second try
            decision.cause(Reply(query.origin, UnloadRefused(query.id, erred.failure)))
        send_notices(decision, query)  # the holder passed them over while it was releasing the query
    decision.effects += answers_to_owners(decision, resource, erred.failure)
    _next_in_queue(decision, resource)
    settle(decision, resource.server, erred.failure)


def _next_in_queue(decision: Decision, gone: Resource) -> None:
    catalog = decision.catalog
    if catalog.queued:
        for id in list(catalog.queued.get((gone.server, gone.request), ())):
            start_queued(decision, catalog.resources[id])


def answers_to_owners(decision: Decision, resource: Resource, failure: Failure | None) -> list[Answer]:
    """Return the answers to the owner's calls that unloaded the resource by force."""
    return [Answer(ticket, failure) for ticket in decision.forget(decision.catalog.owners, resource.id) or ()]


def settle(decision: Decision, server: str, failure: Failure | None = None) -> None:
    """End the unregistration of a server when none of its resources is in motion any more."""
    catalog = decision.catalog
    if server not in catalog.leaving:
        return
    left = [catalog.resources[id] for id in catalog.by_server.get(server, ())]
    if all(resource.phase is UNLOAD_FAILED for resource in left):
        ticket = decision.forget(catalog.leaving, server)
        decision.forget(catalog.servers, server)
        if (stored := catalog.stored_servers.get(server)) is not None:
            decision.drop(stored)
        if left and failure is None:
            failure = failures.left_behind(catalog, left)
        decision.cause(Answer(ticket, failure))


# The decisions of a provider that takes queries from their holders.


def force_unload(decision: Decision, command: ForceUnload) -> None:
    """Take a resource from all its holders and unload it; answer the owner when it is gone."""
    resource = decision.catalog.find(command.target)
    if resource is None:
        decision.cause(Answer(command.ticket, failures.unknown_target(decision.catalog, command.target)))
        return
    waiting = decision.catalog.owners.get(resource.id, ())
    decision.note(decision.catalog.owners, resource.id, (*waiting, command.ticket))
    _evict(decision, resource, command.event, command.why)


def unregister(decision: Decision, command: Unregister) -> None:
    """Take no more loads for a server, and release all its queries; answer the owner when its resources are gone."""
    catalog = decision.catalog
    if command.name not in catalog.servers or command.name in catalog.leaving:
        decision.cause(Answer(command.ticket, failures.unknown_server(catalog, command.name)))
        return
    decision.note(catalog.leaving, command.name, command.ticket)
    for resource_id in list(catalog.by_server.get(command.name, ())):
        _evict(decision, catalog.resources[resource_id], command.event, f"server {command.name!r} was unregistered")
    settle(decision, command.name)


def _evict(decision: Decision, resource: Resource, event: str, why: str) -> None:
    match resource.phase:
        case Phase.QUEUED | Phase.LOADING:
            decision.effects += refuse_all(decision, resource, failures.load_failed(decision.catalog, resource, why))
            unheld(decision, resource)  # a running load goes on; the resource is unloaded when it returns
        case Phase.LOADED | Phase.UNLOAD_FAILED:
            source = decision.catalog.origin_of(resource)
            said = Notice(event, "", "", resource.id, event, State.FATAL, why, source, released=True)
            failure = failures.load_failed(decision.catalog, resource, why)
            for query in decision.catalog.queries_of(resource.id):
                decision.drop(query)
                remember(decision, query.id, failure)
                notify(decision, query, said)
            if resource.id not in decision.catalog.recovering:  # else the end of its recovery unloads it
                begin_unload(decision, resource)
        case Phase.UNLOADING:
            for query in decision.catalog.queries_of(resource.id):
                drop_query(decision, query)
                decision.cause(Reply(query.origin, Unloaded(query.id)))


def gone(decision: Decision, message: Gone) -> None:
    """Release every query of a registrar that does not come back."""
    catalog = decision.catalog
    drop_parked(decision, lambda parked: parked.origin == message.origin)
    for query_id in list(catalog.by_origin.get(message.origin, ())):
        query = catalog.queries[query_id]
        resource = catalog.resources[query.resource_id]
        drop_query(decision, query)
        if resource.id not in catalog.holders and resource.id not in catalog.recovering:
            unheld(decision, resource)
    for notice_id in list(catalog.notices_to.get(message.origin, ())):
        drop_notice(decision, catalog.notices[notice_id])
