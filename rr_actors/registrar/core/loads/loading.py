"""The decisions of a provider about loads.

A resource's life, by phase::

    (request) ─> LOADING ─> LOADED ─> UNLOADING ─> (gone)
         │          │ failed           │ failed
         │          └─> (gone)         └─> UNLOAD_FAILED ─> UNLOADING ...
         └─> QUEUED, while one of the same request is UNLOADING, or another has the exclusive one; then LOADING

FATAL is a status, not a phase. A FATAL resource stays with its holders, and new requests do not join it.

A Load may come twice, by two ways. If the first was refused, the second is refused again, and no callback runs.
"""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.callback_runs import (
    acquit,
    end_limit,
    end_trial,
    forget_request,
    limit_load,
    refused_for_s,
    request_id,
    run_id,
    running,
    start_load,
)
from rr_actors.registrar.core.loads import lines
from rr_actors.registrar.core.loads.load_rings import look_for_ring, ring_of_holds
from rr_actors.registrar.core.notices import drop_notices, drop_resource, loaded, park, refuse, refuse_all
from rr_actors.registrar.core.priorities import touch
from rr_actors.registrar.core.releasing import release_parts
from rr_actors.registrar.core.status_changes import is_busy
from rr_actors.registrar.core.status_delivery import start_deferred
from rr_actors.registrar.core.unloading import answers_to_owners, balance, retire, settle
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import CallbackEnded, CallbackOverdue
from rr_actors.registrar.model.effects import Effect, Happened, SendReply, SetTimer
from rr_actors.registrar.model.messages import Load, LoadRefused
from rr_actors.registrar.model.rows import (
    LOADED,
    LOADING,
    OK,
    PAUSED,
    PAUSING,
    QUEUED,
    RESTING,
    STANDBY,
    Resource,
    ServedQuery,
    State,
)

LONG_S = 1.0
"""A load callback that took so long is kept in the system's memory."""
_NONE: dict[bytes, str] = {}


def load(decision: Decision, message: Load) -> None:
    """Let a Load join the resource of an identical request, or begin a new one. `message.request` is canonical."""
    catalog = decision.catalog
    known = catalog.queries.get(message.query_id)
    if known is not None:
        _load_again(decision, message, known)
        return
    server = message.server
    refused = catalog.refused.get(message.query_id)
    if refused is not None:
        decision.cause(SendReply(message.origin, LoadRefused(message.query_id, refused)))
        return
    if catalog.shut:
        decision.cause(refuse(decision, message.origin, message.query_id, catalog.shut[False]))
        return
    if server not in catalog.servers or server in catalog.leaving:
        decision.cause(refuse(decision, message.origin, message.query_id, failures.unknown_server(catalog, server)))
        return
    resource_id = catalog.joinable(server, message.request)
    if catalog.servers[server].exclusive and lines.is_taken(catalog, message):
        _wait_in_line(decision, message)
    elif resource_id is None:
        _load_first(decision, message)
    elif ring := ring_of_holds(catalog, message, resource_id):
        decision.cause(refuse(decision, message.origin, message.query_id, failures.own_part(catalog, ring)))
    elif resource_id in catalog.recovering:
        park(decision, resource_id, message)
        look_for_ring(decision, catalog.resources[resource_id], message.query_id, message.parent)
    else:
        _join(decision, message, catalog.resources[resource_id])


def _wait_in_line(decision: Decision, message: Load) -> None:
    catalog = decision.catalog
    used = catalog.used((message.server, message.request))
    ring = next(filter(None, (ring_of_holds(catalog, message, resource.id) for resource in used)), None)
    if ring:
        decision.cause(refuse(decision, message.origin, message.query_id, failures.own_part(catalog, ring)))
    elif message.wait_ms == 0:
        lines.refuse_at_once(decision, message)
    else:
        _load_first(decision, message, lines.number_in(catalog, (message.server, message.request)))
        lines.limit_wait(decision, message)


def _load_first(decision: Decision, message: Load, number: int = 0) -> None:
    """Begin a new resource, or have it wait; `number` is its place in the line of an exclusive one."""
    catalog = decision.catalog
    if catalog.refusing and (id := request_id(message.server, message.request)) in catalog.refusing:
        rounds = catalog.callback_runs[id].deaths
        failure = failures.still_refused(catalog, message.server, rounds, refused_for_s(rounds))
        decision.cause(refuse(decision, message.origin, message.query_id, failure))
        return
    queued = number > 0 or (message.server, message.request) in catalog.unloading
    phase = QUEUED if queued else LOADING
    resource_id = catalog.new_resource_id(message.query_id)
    resource = Resource(resource_id, message.server, message.request, None, phase, OK, "", 1, number)
    decision.put(resource)
    _begin_query(decision, message, resource_id)
    decision.note(catalog.waiting, message.query_id, resource_id)
    if queued:
        look_for_ring(decision, resource, message.query_id, message.parent)
    else:
        start_load(decision, resource)


def _join(decision: Decision, message: Load, resource: Resource) -> None:
    catalog = decision.catalog
    alone = resource.id not in catalog.holders
    if alone or message.priority or resource.id in catalog.ranked:
        touch(decision, resource.id)
    _begin_query(decision, message, resource.id)
    if resource.phase is LOADED or (resource.phase in (PAUSING, PAUSED) and message.priority <= STANDBY):
        decision.note(catalog.joined, message.server, catalog.joined.get(message.server, 0) + 1)
        if alone:
            decision.forget(catalog.idle, resource.id)
            decision.cause(SetTimer("linger:" + resource.id, None, None))
        decision.cause(SendReply(message.origin, loaded(catalog, message.query_id, resource)))
        return
    decision.note(catalog.waiting, message.query_id, resource.id)
    decision.note(catalog.waited, message.server, catalog.waited.get(message.server, 0) + 1)
    if alone and resource.phase is LOADING:
        limit_load(decision, resource)
    look_for_ring(decision, resource, message.query_id, message.parent)


def join(catalog: Catalog, message: Load) -> ServedQuery | None:
    """Return the one row that a Load adds if it can be answered at once; None if load() has to decide it.

    This fast path decides as load() does: a resource that is loaded and held gets one more holder, and nothing else
    changes.
    """
    resource_id = catalog.by_request.get(message.server, _NONE).get(message.request)
    resource = None if resource_id is None else catalog.resources[resource_id]
    if resource is None or resource.phase is not LOADED or resource.id not in catalog.holders:
        return None
    if message.server not in catalog.servers or message.server in catalog.leaving or resource.id in catalog.recovering:
        return None
    if catalog.shut or message.priority or resource.id in catalog.ranked or catalog.servers[message.server].exclusive:
        return None
    if message.parent and message.origin == catalog.name and ring_of_holds(catalog, message, resource.id):
        return None
    id = message.query_id
    if id in catalog.queries or id in catalog.refused or id in catalog.notices_on:
        return None
    return _query_of(message, resource.id)


def _load_again(decision: Decision, message: Load, query: ServedQuery) -> None:
    """Decide a Load of a known query: its answer was lost, or is still to come."""
    catalog = decision.catalog
    resource = catalog.resources[query.resource_id]
    if resource.id in catalog.recovering:
        park(decision, resource.id, message)
    elif is_busy(catalog, resource) or is_to_run(query, resource):
        decision.note(catalog.waiting, query.id, resource.id)
        if resource.phase is QUEUED and resource.tries:
            lines.limit_wait(decision, message)
        look_for_ring(decision, resource, message.query_id, message.parent)
    else:
        decision.cause(SendReply(query.origin, loaded(catalog, query.id, resource)))


def is_to_run(query: ServedQuery, resource: Resource) -> bool:
    """Return whether a resource is paused, or about to be, and is resumed for this query."""
    return resource.phase in RESTING and query.priority > STANDBY and resource.state is not State.FATAL


def _begin_query(decision: Decision, message: Load, resource_id: str) -> None:
    """Add the query's row, and drop notices about an earlier query of the same id, which its origin has not held."""
    decision.put(_query_of(message, resource_id))
    if message.origin in decision.catalog.notices_to:
        drop_notices(decision, message.origin, message.query_id)


def _query_of(message: Load, resource_id: str) -> ServedQuery:
    return ServedQuery(
        message.query_id,
        resource_id,
        message.origin,
        message.parent,
        message.attempt,
        message.seq,
        message.priority,
        message.own,
    )


def load_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Answer all consumers that wait; unload the resource if nobody holds it any more."""
    catalog = decision.catalog
    resource = running(catalog, ended.resource_id, LOADING, ended.run)
    if resource is None:
        return
    if ended.stopped and resource.id in catalog.holders:  # somebody has asked again since it ended
        start_load(decision, resource)
        return
    if ended.failure is not None:
        _load_failed(decision, resource, ended.failure)
        return
    resource = replace(resource, phase=LOADED, response=ended.response)
    decision.put(resource)
    is_long = ended.took_s >= LONG_S
    decision.cause(Happened("loaded", resource, f"took {ended.took_s:.1f} s" if is_long else "", kept=is_long))
    end_limit(decision, resource)
    if catalog.callback_runs or catalog.trial or catalog.accused:
        _ended(decision, resource)
    holders = catalog.holders.get(resource.id)
    if holders:
        for query_id in holders:
            if decision.forget(catalog.waiting, query_id) is not None:
                decision.cause(SendReply(catalog.queries[query_id].origin, loaded(catalog, query_id, resource)))
        # The owner may have unloaded it while it was loading; its present holders came after that.
        if catalog.owners:
            decision.effects += answers_to_owners(decision, resource, None)
        if resource.id in catalog.ranked:
            balance(decision, resource.id)
    else:
        retire(decision, resource)
    if catalog.deferred or catalog.late:
        start_deferred(decision, resource.id)


def _load_failed(decision: Decision, resource: Resource, failure: Failure) -> None:
    """Remove the resource and its queries, release what the callback had loaded, and only then answer all that wait."""
    after: list[Effect] = [*refuse_all(decision, resource, failure), *answers_to_owners(decision, resource, None)]
    drop_resource(decision, resource)
    end_limit(decision, resource)
    _ended(decision, resource)
    decision.cause(Happened("load_failed", resource, failure.message, kept=True))
    release_parts(decision, resource.id, after)
    settle(decision, resource.server)


def _ended(decision: Decision, resource: Resource) -> None:
    """Note that the load callback has ended, and the process lives."""
    id = run_id("load", resource.id)
    acquit(decision, id)
    end_trial(decision, id)
    if decision.catalog.callback_runs and (run := decision.catalog.callback_runs.get(id)) is not None:
        decision.drop(run)
    forget_request(decision, resource)


def load_overdue(decision: Decision, overdue: CallbackOverdue) -> None:
    """Refuse all consumers that wait. The callback goes on; the resource is unloaded when it returns."""
    resource = running(decision.catalog, overdue.resource_id, LOADING, overdue.run)
    if resource is not None:
        decision.effects += refuse_all(decision, resource, overdue.failure)
