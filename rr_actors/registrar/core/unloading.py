"""The decisions of a provider about unloads: queries that are released, and resources whose last query is gone."""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.callback_runs import (
    awaits_trial,
    deaths_of,
    is_given_up,
    note_begun,
    note_ended,
    running,
    start_unload,
)
from rr_actors.registrar.core.notices import (
    drop_notice,
    drop_notices,
    drop_parked,
    drop_query,
    drop_resource,
    end_revocation,
    notify,
    park,
    refuse,
    refuse_all,
    remember,
    send_notices,
)
from rr_actors.registrar.core.priorities import touch
from rr_actors.registrar.core.releasing import release_parts
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import CallbackEnded, ForceUnload, GraceOver, LingerOver, Unregister
from rr_actors.registrar.model.effects import AnswerCall, Effect, Happened, SendReply, SetTimer, StartCallback
from rr_actors.registrar.model.messages import Gone, Reprioritised, Unload, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import (
    LOADED,
    NOT_BEGUN,
    PAUSED,
    PAUSING,
    QUEUED,
    RESUMING,
    REVOKED,
    STANDBY,
    UNLOAD_FAILED,
    UNLOADING,
    Notice,
    Phase,
    Resource,
    ServedQuery,
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
        decision.cause(SendReply(message.origin, Unloaded(message.query_id)))
    elif query.origin != message.origin:
        refusal = UnloadRefused(message.query_id, failures.not_holder(query.id, query.origin, message.origin))
        decision.cause(SendReply(message.origin, refusal))
    elif query.resource_id in catalog.recovering:
        park(decision, query.resource_id, message)
    else:
        _release(decision, query)


def _release(decision: Decision, query: ServedQuery) -> None:
    catalog = decision.catalog
    resource = catalog.resources[query.resource_id]
    last = len(catalog.holders[resource.id]) == 1
    remember(decision, query.id, failures.LET_GO)
    again = last and resource.phase is UNLOADING
    if again or (last and resource.phase in (LOADED, UNLOAD_FAILED, PAUSED) and not _lingers(decision, resource)):
        decision.note(catalog.unanswered, query.id, True)  # answered when the resource is gone, and the query with it
        if not again:
            run_unload(decision, resource)
        if resource.server not in catalog.servers:  # the release stays owed, and its end is answered, too
            decision.cause(SendReply(query.origin, UnloadRefused(query.id, failures.serverless(catalog, resource))))
        return
    drop_query(decision, query)
    decision.cause(SendReply(query.origin, Unloaded(query.id)))
    if last:
        unheld(decision, resource)


def leave(catalog: Catalog, message: Unload) -> bool:
    """Return whether unload() will answer at once, and cause nothing else: other holders keep the resource.

    A thread of this process may then decide the Unload itself.
    """
    query = catalog.queries.get(message.query_id)
    if query is None or query.origin != message.origin or query.id in catalog.notices_on:
        return False
    if query.resource_id in catalog.recovering or query.resource_id in catalog.ranked:
        return False
    return len(catalog.holders[query.resource_id]) > 1


def unheld(decision: Decision, resource: Resource) -> None:
    """Decide about a resource that nobody holds any more: drop, keep warm or unload it, by its phase."""
    resource = stay_paused(decision, resource)
    if resource.phase is QUEUED:
        decision.effects += answers_to_owners(decision, resource, None)
        drop_resource(decision, resource)
        settle(decision, resource.server)
    elif resource.phase in (LOADED, UNLOAD_FAILED, PAUSED):
        retire(decision, resource)
    elif resource.tries == NOT_BEGUN and resource.server in decision.catalog.servers:
        # The load does not run again; the unload callback cleans up after the interrupted run.
        begin_unload(decision, replace(resource, tries=0))


def _lingers(decision: Decision, resource: Resource) -> bool:
    server = decision.catalog.servers.get(resource.server)
    if server is None or resource.state is State.FATAL or condemned(decision, resource):
        return False
    if resource.phase is LOADED:
        return server.linger_s > 0 or (server.pauses and not is_given_up(decision.catalog, "pause", resource.id))
    return resource.phase is PAUSED


def condemned(decision: Decision, resource: Resource) -> bool:
    """Return whether the owner has unloaded the resource by force, or unregistered its server."""
    return resource.id in decision.catalog.owners or resource.server in decision.catalog.leaving


def retire(decision: Decision, resource: Resource) -> None:
    """Keep an unheld resource warm if its server says so; otherwise unload it."""
    if _lingers(decision, resource):
        touch(decision, resource.id)
        decision.forget(decision.catalog.idle, resource.id)
        _wait(decision, resource)
    else:
        begin_unload(decision, resource)


def linger_over(decision: Decision, over: LingerOver) -> None:
    """Pause or unload a resource that has idled for long enough."""
    catalog = decision.catalog
    resource = catalog.resources.get(over.resource_id)
    if resource is None or resource.phase not in (LOADED, PAUSED) or catalog.priority_of(resource.id) > STANDBY:
        return
    if resource.id in catalog.recovering:  # the time begins anew when it is reloaded
        return
    server = catalog.servers.get(resource.server)
    if resource.phase is LOADED and server is not None and server.pauses and _may_pause(decision, resource):
        decision.put(replace(resource, phase=PAUSING))
        go_on(decision, catalog.resources[resource.id])
    elif resource.id not in catalog.holders:
        begin_unload(decision, resource)


# Pausing. A resource idles if all who hold it have it on standby, or nobody does.


def _may_pause(decision: Decision, resource: Resource) -> bool:
    return resource.state is not State.FATAL and not is_given_up(decision.catalog, "pause", resource.id)


def _wait(decision: Decision, resource: Resource) -> None:
    """Set the timer that pauses or unloads an idle resource, unless it runs."""
    catalog = decision.catalog
    server = catalog.servers[resource.server]
    wait_s = server.paused_s if resource.phase is PAUSED else server.linger_s
    if resource.id not in catalog.idle and wait_s is not None:
        decision.note(catalog.idle, resource.id, True)
        decision.cause(SetTimer("linger:" + resource.id, wait_s, LingerOver(resource.id)))


def balance(decision: Decision, resource_id: str) -> None:
    """Have an idle resource of a server that pauses wait for its pause, and resume a paused one that is needed."""
    catalog = decision.catalog
    resource = catalog.resources.get(resource_id)
    server = None if resource is None else catalog.servers.get(resource.server)
    if (
        resource is None
        or server is None
        or resource.phase not in (LOADED, PAUSED)
        or resource.id in catalog.recovering
    ):
        return
    paused = resource.phase is PAUSED
    if server.pauses and catalog.priority_of(resource.id) <= STANDBY:
        if _may_pause(decision, resource) and not (paused and resource.id in catalog.holders):
            _wait(decision, resource)
        elif paused:
            stop_waiting(decision, resource)
    elif paused:
        stop_waiting(decision, resource)
        if resource.state is State.FATAL:  # nobody is given it any more, so it does not run again
            return
        decision.put(replace(resource, phase=RESUMING))
        go_on(decision, catalog.resources[resource.id])
    elif server.pauses:
        stop_waiting(decision, resource)


def stop_waiting(decision: Decision, resource: Resource) -> None:
    """Cancel the timer that pauses or unloads an idle resource."""
    if decision.forget(decision.catalog.idle, resource.id):
        decision.cause(SetTimer("linger:" + resource.id, None, None))


def stay_paused(decision: Decision, resource: Resource) -> Resource:
    """End a resumption that waits for the resource's parts, as its callback has not begun; return the resource."""
    catalog = decision.catalog
    if resource.id not in catalog.rising:
        return resource
    decision.forget(catalog.rising, resource.id)
    note_ended(decision, "resume", resource.id)
    touch(decision, resource.id)
    resource = replace(resource, phase=PAUSED)
    decision.put(resource)
    return resource


def stay_lost(decision: Decision, resource: Resource, why: str) -> Resource:
    """Let nothing wait for the resumption of a FATAL resource, as it is not resumed; return the resource."""
    refuse_waiting(decision, resource, failures.load_failed(decision.catalog, resource, why))
    answer_wholes(decision, resource)
    return stay_paused(decision, resource)


def answer_wholes(decision: Decision, resource: Resource) -> None:
    """Say to each whole that may wait for this part that it runs, or that it will not."""
    for query in decision.catalog.queries_of(resource.id):
        if query.parent:
            decision.cause(SendReply(query.origin, Reprioritised(query.id, query.priority)))


def refuse_waiting(decision: Decision, resource: Resource, failure: Failure) -> None:
    """Refuse the loads that wait for a resource that is being paused or resumed; its other queries stay."""
    for query in decision.catalog.queries_of(resource.id):
        if query.id in decision.catalog.waiting:
            decision.cause(refuse(decision, query.origin, query.id, failure))
            drop_query(decision, query)


def go_on(decision: Decision, resource: Resource) -> None:
    """Run the pause callback; or the resume callback, when all parts have been resumed."""
    catalog = decision.catalog
    decision.forget(catalog.early, resource.id)
    decision.forget(catalog.idle, resource.id)
    touch(decision, resource.id)
    role = "pause" if resource.phase is PAUSING else "resume"
    if awaits_trial(decision, role, resource.id):
        return
    note_begun(decision, role, resource.id)
    if resource.phase is PAUSING:
        decision.cause(StartCallback("pause", resource))
    else:
        decision.note(catalog.rising, resource.id, None)


def begin_unload(decision: Decision, resource: Resource) -> None:
    """Cancel the linger timer, and run the unload callback."""
    decision.cause(SetTimer("linger:" + resource.id, None, None))
    run_unload(decision, resource)


def run_unload(decision: Decision, resource: Resource) -> None:
    """Run the unload callback, unless it has ended the process too often, or is not to run before its turn."""
    decision.forget(decision.catalog.early, resource.id)
    if resource.id in decision.catalog.unread:  # the callback cannot run without its request and response
        remove(decision, resource)
    elif is_given_up(decision.catalog, "unload", resource.id):
        deaths = deaths_of(decision.catalog, "unload", resource.id)
        _keep(decision, resource, failures.unload_given_up(decision.catalog, resource, deaths))
    elif awaits_trial(decision, "unload", resource.id):
        decision.put(replace(resource, phase=UNLOADING))
    else:
        start_unload(decision, resource)


def unload_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Remove the resource, release its parts, and answer all that wait. The next in line begins (core/loads/lines.py).

    If the callback raised, the resource may still be running: it is kept as unload_failed, and the Unloads that wait
    are refused.
    """
    resource = running(decision.catalog, ended.resource_id, UNLOADING, ended.run)
    if resource is not None and ended.failure is not None:
        note_ended(decision, "unload", resource.id)
        _keep(decision, resource, ended.failure)
    elif resource is not None:
        remove(decision, resource)


def remove(decision: Decision, resource: Resource) -> None:
    """Remove a resource that is unloaded, release its parts, and answer all that wait for its end."""
    after: list[Effect] = []
    for query in decision.catalog.queries_of(resource.id):
        drop_query(decision, query)
        after.append(SendReply(query.origin, Unloaded(query.id)))
    after += answers_to_owners(decision, resource, None)
    drop_resource(decision, resource)
    decision.cause(Happened("unloaded", resource, ""))
    release_parts(decision, resource.id, after)
    settle(decision, resource.server)


def _keep(decision: Decision, resource: Resource, failure: Failure) -> None:
    touch(decision, resource.id)  # it may have lost its holders, or its parts their priority
    end_revocation(decision, resource.id)
    decision.put(replace(resource, phase=UNLOAD_FAILED, message=failure.message))
    decision.cause(Happened("unload_failed", resource, failure.message, kept=True))
    for query in decision.catalog.queries_of(resource.id):
        if decision.forget(decision.catalog.unanswered, query.id):  # else its Unload comes again, for a second try
            remember(decision, query.id, failure)  # its holder does not release it any more
            decision.cause(SendReply(query.origin, UnloadRefused(query.id, failure)))
        send_notices(decision, query)  # the holder passed them over while it was releasing the query
    decision.effects += answers_to_owners(decision, resource, failure)
    settle(decision, resource.server, failure)


def answers_to_owners(decision: Decision, resource: Resource, failure: Failure | None) -> list[AnswerCall]:
    """Return the answers to the owner's calls that unloaded the resource by force."""
    return [AnswerCall(ticket, failure) for ticket in decision.forget(decision.catalog.owners, resource.id) or ()]


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
        decision.cause(AnswerCall(ticket, failure))


# The decisions of a provider that takes queries from their holders.


def force_unload(decision: Decision, command: ForceUnload) -> None:
    """Take a resource from all its holders and unload it; answer the owner when it is gone."""
    resource = decision.catalog.find(command.target)
    if resource is None:
        decision.cause(AnswerCall(command.ticket, failures.unknown_target(decision.catalog, command.target)))
        return
    waiting = decision.catalog.owners.get(resource.id, ())
    decision.note(decision.catalog.owners, resource.id, (*waiting, command.ticket))
    if command.clears and is_given_up(decision.catalog, "unload", resource.id):
        _take_away(decision, resource, command.event, command.why)
        remove(decision, resource)
    else:
        _evict(decision, resource, command.event, command.why)


def unregister(decision: Decision, command: Unregister) -> None:
    """Take no more loads for a server, and release all its queries; answer the owner when its resources are gone."""
    catalog = decision.catalog
    if command.name not in catalog.servers and command.name in catalog.by_server:
        _clear(decision, command)
        return
    if command.name not in catalog.servers or command.name in catalog.leaving:
        decision.cause(AnswerCall(command.ticket, failures.unknown_server(catalog, command.name)))
        return
    decision.note(catalog.leaving, command.name, command.ticket)
    for resource_id in list(catalog.by_server.get(command.name, ())):
        _evict(decision, catalog.resources[resource_id], command.event, f"server {command.name!r} was unregistered")
    settle(decision, command.name)


def _clear(decision: Decision, command: Unregister) -> None:
    """Remove all resources of a server that is not registered, without its callbacks."""
    why = f"server {command.name!r} is not registered any more"
    for resource_id in list(decision.catalog.by_server[command.name]):
        resource = decision.catalog.resources[resource_id]
        if resource.phase in (QUEUED, Phase.LOADING):
            decision.effects += refuse_all(decision, resource, failures.load_failed(decision.catalog, resource, why))
        else:
            _take_away(decision, resource, command.event, why)
        remove(decision, resource)
    decision.cause(AnswerCall(command.ticket, None))


def grace_over(decision: Decision, command: GraceOver) -> None:
    """Take a revoked resource from those that still hold it, and unload it."""
    catalog = decision.catalog
    resource, revocation = catalog.resources.get(command.resource_id), catalog.revocations.get(command.resource_id)
    if resource is None or revocation is None or revocation.event != command.event:
        return
    if resource.phase is not UNLOADING:
        decision.note(catalog.owners, resource.id, catalog.owners.get(resource.id, ()))  # condemned
        _evict(decision, resource, command.event + ":over", revocation.why, REVOKED)


def _evict(decision: Decision, resource: Resource, event: str, why: str, reason: str = "") -> None:
    match resource.phase:
        case Phase.QUEUED | Phase.LOADING:
            decision.effects += refuse_all(decision, resource, failures.load_failed(decision.catalog, resource, why))
            unheld(decision, resource)  # a running load goes on; the resource is unloaded when it returns
        case Phase.UNLOADING:
            for query in decision.catalog.queries_of(resource.id):
                drop_query(decision, query)
                decision.cause(SendReply(query.origin, Unloaded(query.id)))
        case _:
            refuse_waiting(decision, resource, failures.load_failed(decision.catalog, resource, why))
            _take_away(decision, resource, event, why, reason)
            resource = stay_paused(decision, resource)
            if resource.phase not in (PAUSING, RESUMING) and resource.id not in decision.catalog.recovering:
                begin_unload(decision, resource)  # else the end of the callback that runs unloads it


def _take_away(decision: Decision, resource: Resource, event: str, why: str, reason: str = "") -> None:
    source = decision.catalog.origin_of(resource)
    said = Notice(event, "", "", resource.id, event, State.FATAL, why, source, released=True, reason=reason)
    failure = failures.load_failed(decision.catalog, resource, why)
    for query in decision.catalog.queries_of(resource.id):
        if decision.catalog.refused.get(query.id) is failures.LET_GO:  # its holder passes over what was said before
            drop_notices(decision, query.origin, query.id)
        decision.drop(query)
        remember(decision, query.id, failure)
        notify(decision, query, said)


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
