"""Rings: loads that would wait for one another, and resources that would hold themselves."""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.registrar.core.holding import break_ring
from rr_actors.registrar.core.notices import parked_on
from rr_actors.registrar.core.releasing import add_in_flight, parts_of, withdraw
from rr_actors.registrar.core.status_changes import is_busy
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import SendReply
from rr_actors.registrar.model.messages import Load, Probe, WaitedFor
from rr_actors.registrar.model.rows import LOADED, PENDING, QUEUED, RESTING, UNLOADING, Resource


def ring_of_holds(catalog: Catalog, message: Load, resource_id: str) -> list[str]:
    """Return the resources from one that is loaded to the parent of a Load that would make it its own part, or [].

    Such a ring of holds would never be released. Only rings within this registrar are seen here; those over several are
    found when they have closed (core/holding.py).
    """
    if message.origin != catalog.name or not message.parent or catalog.resources[resource_id].phase is not LOADED:
        return []
    ways = {message.parent: [message.parent]}
    left = [message.parent]
    while left:
        id = left.pop()
        if id == resource_id:
            return ways[id][::-1]
        for query in catalog.queries_of(id):
            if query.parent and query.origin == catalog.name and query.parent not in ways:
                ways[query.parent] = [*ways[id], query.parent]
                left.append(query.parent)
    return []


# Probing finds rings of loads that wait for one another, by edge chasing (Chandy, Misra and Haas 1983).
#
# The last edge of a ring is always a load that joins one in flight or waits for an unload. Any other new resource waits
# for nothing yet. So a probe starts at such a load. All other edges are known at their providers by then.
# Therefore a load may go by another connection than the probe that follows it. A link may break and lose a probe. The
# loads that wait at that provider are then sent again over the next link, and each starts another probe.
#
# A ring that closes at two places at once is found by two probes. Both have to end the same load, or nothing is left of
# the ring. So a probe that passes a newer load than its own goes on for that one: of each ring the newest load fails,
# the one with the greatest id.

_RING_LIMIT = 256


def look_for_ring(decision: Decision, resource: Resource, query_id: str, parent: str) -> None:
    """Look whether what this query waits for waits in turn for the resource that it is a part of."""
    if parent:
        chase(decision, resource, Probe(query_id, parent, query_id, []))


def probe(decision: Decision, message: Probe) -> None:
    """Pass a probe on to all that the query's resource waits for. Back at the waiter, it has found a ring."""
    query = decision.catalog.queries.get(message.query_id)
    resource_id = query.resource_id if query is not None else parked_on(decision.catalog, message.query_id)
    if resource_id is not None:
        go_on = _chase_holds if message.holds else chase
        go_on(decision, decision.catalog.resources[resource_id], message)


def _chase_holds(decision: Decision, resource: Resource, message: Probe) -> None:
    """Pass a probe on from this resource to all its parts, once. Back at the waiter, it has found a ring of holds."""
    catalog = decision.catalog
    ring = [*message.ring, catalog.origin_of(resource)]
    if resource.id == message.waiter:
        break_ring(decision, message.blocked, ring)
    elif len(ring) <= _RING_LIMIT and catalog.chased.get(resource.id) != message.blocked:
        decision.note(catalog.chased, resource.id, message.blocked)
        for held_id in parts_of(decision, resource.id):
            held = catalog.held[held_id]
            decision.request(held.registrar, replace(message, query_id=held.id, ring=ring))


def chase(decision: Decision, resource: Resource, message: Probe) -> None:
    """Pass a probe on from this resource to all that it waits for."""
    catalog = decision.catalog
    ring = [*message.ring, catalog.origin_of(resource)]
    waits = is_busy(catalog, resource) or resource.phase is UNLOADING or resource.phase in RESTING
    if not waits or len(ring) > _RING_LIMIT:
        return
    if resource.id == message.waiter:
        add_in_flight(decision, message.blocked)
        blocked = catalog.held.get(message.blocked)
        if blocked is not None and blocked.hold is PENDING:
            withdraw(decision, blocked, failures.circular(ring, blocked))
        return
    if resource.phase is QUEUED:
        for id in list(catalog.unloading.get((resource.server, resource.request), ())):
            chase(decision, catalog.resources[id], replace(message, ring=ring))
        if resource.tries:
            _chase_holders(decision, resource, replace(message, ring=ring))
    for held_id in parts_of(decision, resource.id):
        held = catalog.held[held_id]
        if held.hold is PENDING:
            own = Probe(held.id, resource.id, held.id, [])
            on = replace(message, query_id=held.id, ring=ring)
            decision.request(held.registrar, own if held.id > message.blocked else on)


def _chase_holders(decision: Decision, resource: Resource, message: Probe) -> None:
    """Pass a probe on from a load that waits in line to the one that has the exclusive resource, and to its whole."""
    catalog = decision.catalog
    for used in catalog.used((resource.server, resource.request)):
        if used.phase is UNLOADING:
            continue
        chase(decision, used, message)
        for query in catalog.queries_of(used.id):
            on = WaitedFor(query.id, message.waiter, message.blocked, message.ring)
            if query.parent and query.origin == catalog.name:
                awaited(decision, on)
            elif query.parent:
                decision.cause(SendReply(query.origin, on))


def awaited(decision: Decision, message: WaitedFor) -> None:
    """Pass a probe on to the whole of a query, as others wait until that releases the query's exclusive resource."""
    catalog = decision.catalog
    held = catalog.held.get(message.query_id) or catalog.in_flight.get(message.query_id)
    whole = None if held is None else catalog.resources.get(held.parent)
    if whole is not None:
        chase(decision, whole, Probe(message.query_id, message.waiter, message.blocked, message.ring))
