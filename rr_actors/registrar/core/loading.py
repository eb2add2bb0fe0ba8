"""What a registrar decides as a provider about loads.

A resource's life, by phase::

    (request) ─> LOADING ─> LOADED ─> UNLOADING ─> (gone)
         │          │ failed           │ failed
         │          └─> (gone)         └─> UNLOAD_FAILED ─> UNLOADING ...
         └─> QUEUED, while one of the same request is UNLOADING, then LOADING

FATAL is a status, not a phase: such a resource stays with those who hold it and is not found by new requests.

A Load may come twice, by two ways, and the second after the first was refused: it is refused again, and not run.
"""

from __future__ import annotations

import msgspec

from rr_actors.registrar.core.callback_runs import end_limit, limit_load, running, start_load
from rr_actors.registrar.core.notices import drop_notices, drop_resource, park, parked_on, refuse, refuse_all
from rr_actors.registrar.core.releasing import add_in_flight, parts_of, release_parts, request, withdraw
from rr_actors.registrar.core.status_delivery import start_deferred
from rr_actors.registrar.core.unloading import answers_to_owners, retire, settle
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import LoadDone, LoadErred, LoadOverdue
from rr_actors.registrar.model.effects import Effect, Happened, Reply, SetTimer
from rr_actors.registrar.model.messages import Load, Loaded, LoadRefused, Probe
from rr_actors.registrar.model.rows import LOADED, LOADING, OK, PENDING, QUEUED, Query, Resource

_replace = msgspec.structs.replace
_NONE: dict[bytes, str] = {}
_WAITS = (LOADING, QUEUED)


def load(decision: Decision, message: Load) -> None:
    """Join the resource of an identical request, or begin a new one. `message.request` is canonical."""
    catalog = decision.catalog
    known = catalog.queries.get(message.query_id)
    if known is not None:
        _load_again(decision, message, known)
        return
    server = message.server
    refused = catalog.refused.get(message.query_id)
    if refused is not None:
        decision.cause(Reply(message.origin, LoadRefused(message.query_id, refused)))
        return
    if server not in catalog.servers or server in catalog.leaving:
        decision.cause(refuse(decision, message.origin, message.query_id, failures.unknown_server(catalog, server)))
        return
    resource_id = catalog.joinable(server, message.request)
    if resource_id is None:
        _load_first(decision, message)
    elif resource_id in catalog.recovering:
        park(decision, resource_id, message)
        _look_for_ring(decision, message, catalog.resources[resource_id])
    else:
        _join(decision, message, catalog.resources[resource_id])


def _load_first(decision: Decision, message: Load) -> None:
    catalog = decision.catalog
    queued = (message.server, message.request) in catalog.unloading
    phase = QUEUED if queued else LOADING
    resource_id = catalog.new_resource_id(message.query_id)
    resource = Resource(resource_id, message.server, message.request, None, phase, OK, "", 1)
    decision.put(resource)
    _begin_query(decision, message, resource_id)
    decision.note(catalog.waiting, message.query_id, resource_id)
    if not queued:
        start_load(decision, resource)


def _join(decision: Decision, message: Load, resource: Resource) -> None:
    catalog = decision.catalog
    alone = resource.id not in catalog.holders
    _begin_query(decision, message, resource.id)
    if resource.phase is LOADED:
        if alone:
            decision.cause(SetTimer("linger:" + resource.id, None, None))
        decision.cause(Reply(message.origin, Loaded(message.query_id, resource.id, resource.response or b"")))
        return
    decision.note(catalog.waiting, message.query_id, resource.id)
    if alone and resource.phase is LOADING:
        limit_load(decision, resource)
    _look_for_ring(decision, message, resource)


def join(catalog: Catalog, message: Load) -> Query | None:
    """Return the one row that a Load adds to the catalog if it is answered at once; None: load() is to decide it.

    The fast path, which decides as load() does: what is loaded and held by somebody gets one holder more, and nothing
    else follows.
    """
    resource_id = catalog.by_request.get(message.server, _NONE).get(message.request)
    resource = None if resource_id is None else catalog.resources[resource_id]
    if resource is None or resource.phase is not LOADED or resource.id not in catalog.holders:
        return None
    if message.server not in catalog.servers or message.server in catalog.leaving or resource.id in catalog.recovering:
        return None
    id = message.query_id
    if id in catalog.queries or id in catalog.refused or id in catalog.notices_on:
        return None
    return _query_of(message, resource.id)


def _load_again(decision: Decision, message: Load, query: Query) -> None:
    """The same query once more: its answer was lost, or is still to come."""
    catalog = decision.catalog
    resource = catalog.resources[query.resource_id]
    if resource.id in catalog.recovering:
        park(decision, resource.id, message)
    elif resource.phase in _WAITS:
        decision.note(catalog.waiting, query.id, resource.id)
        _look_for_ring(decision, message, resource)
    else:
        decision.cause(Reply(query.origin, Loaded(query.id, resource.id, resource.response or b"")))


def _look_for_ring(decision: Decision, message: Load, resource: Resource) -> None:
    if message.parent:
        chase(decision, resource, Probe(message.query_id, message.parent, message.query_id, []))


def _begin_query(decision: Decision, message: Load, resource_id: str) -> None:
    """The row. What was said about one of the same id before, which its origin has not held, is not about this one."""
    decision.put(_query_of(message, resource_id))
    if message.origin in decision.catalog.notices_to:
        drop_notices(decision, message.origin, message.query_id)


def _query_of(message: Load, resource_id: str) -> Query:
    return Query(message.query_id, resource_id, message.origin, message.parent, message.attempt, message.seq)


def load_done(decision: Decision, done: LoadDone) -> None:
    """Answer everybody who waits; if nobody does any more, release what came too late."""
    catalog = decision.catalog
    resource = running(catalog, done.resource_id, LOADING, done.attempt)
    if resource is None:
        return
    resource = _replace(resource, phase=LOADED, response=done.response)
    decision.put(resource)
    decision.cause(Happened("loaded", resource.id, resource.server, ""))
    end_limit(decision, resource)
    holders = catalog.holders.get(resource.id)
    if not holders:
        retire(decision, resource)
        start_deferred(decision, resource.id)
        return
    for query_id in holders:
        if decision.forget(catalog.waiting, query_id) is not None:
            reply = Loaded(query_id, resource.id, done.response)
            decision.cause(Reply(catalog.queries[query_id].origin, reply))
    for answer in answers_to_owners(decision, resource, None):
        decision.cause(answer)  # unloaded by force while it was loading: those who hold it now came after that
    start_deferred(decision, resource.id)


def load_erred(decision: Decision, erred: LoadErred) -> None:
    """Leave nothing behind: the resource, its queries and what the callback had loaded go; then everybody hears."""
    resource = running(decision.catalog, erred.resource_id, LOADING, erred.attempt)
    if resource is None:
        return
    after: list[Effect] = [*refuse_all(decision, resource, erred.failure), *answers_to_owners(decision, resource, None)]
    drop_resource(decision, resource)
    end_limit(decision, resource)
    decision.cause(Happened("load_failed", resource.id, resource.server, erred.failure.message))
    release_parts(decision, resource.id, after)
    start_deferred(decision, resource.id)
    settle(decision, resource.server)


def load_overdue(decision: Decision, overdue: LoadOverdue) -> None:
    """Refuse everybody who waits; the callback goes on, and what it brings is unloaded when it comes."""
    resource = running(decision.catalog, overdue.resource_id, LOADING, overdue.attempt)
    if resource is not None:
        for reply in refuse_all(decision, resource, overdue.failure):
            decision.cause(reply)


# Probing: finding rings of loads that wait for one another. Edge chasing, after Chandy, Misra and Haas (1983).
#
# The last edge of a ring is always a load that joins one in flight (a first one has nothing to wait for yet), so a
# probe starts there. All other edges are known at their providers by then, so it does not matter that a load may go by
# another connection than the probe that follows it. A probe may be lost with its link: all that waits there is then
# sent again over the next, and starts another.

_RING_LIMIT = 256


def probe(decision: Decision, message: Probe) -> None:
    """Pass a probe on along everything the query's resource waits for; at the waiter itself it has found a ring."""
    query = decision.catalog.queries.get(message.query_id)
    resource_id = query.resource_id if query is not None else parked_on(decision.catalog, message.query_id)
    if resource_id is not None:
        chase(decision, decision.catalog.resources[resource_id], message)


def chase(decision: Decision, resource: Resource, message: Probe) -> None:
    """As probe(), from this resource on."""
    catalog = decision.catalog
    ring = [*message.ring, catalog.origin_of(resource)]
    waits = resource.phase in (LOADING, QUEUED) or resource.id in catalog.recovering
    if not waits or len(ring) > _RING_LIMIT:
        return
    if resource.id == message.waiter:
        add_in_flight(decision, message.blocked)
        blocked = catalog.held.get(message.blocked)
        if blocked is not None and blocked.hold is PENDING:
            withdraw(decision, blocked, failures.circular(ring, blocked))
        return
    for held_id in parts_of(decision, resource.id):
        held = catalog.held[held_id]
        if held.hold is PENDING:
            request(decision, held.registrar, Probe(held.id, message.waiter, message.blocked, ring))
