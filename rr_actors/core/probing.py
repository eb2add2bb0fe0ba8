"""Probing: finding rings of loads that wait for one another. Edge chasing, after Chandy, Misra and Haas (1983).

The last edge of a ring is always a load that joins one under way (a first one has nothing to wait for yet), so a probe
starts there; and again when that load is sent again, as a probe may be lost with its link.
"""

from __future__ import annotations

from rr_actors.core import failures
from rr_actors.core.batch import Batch
from rr_actors.core.parking import parked_on
from rr_actors.core.releasing import request, withdraw
from rr_actors.messages import Probe
from rr_actors.records import Hold, Phase, Resource

_RING_LIMIT = 256


def probe(batch: Batch, message: Probe) -> None:
    """Pass a probe on along everything the query's resource waits for; at the waiter itself it has found a ring."""
    query = batch.catalog.queries.get(message.query_id)
    resource_id = query.resource_id if query is not None else parked_on(batch, message.query_id)
    if resource_id is not None:
        chase(batch, batch.catalog.resources[resource_id], message)


def chase(batch: Batch, resource: Resource, message: Probe) -> None:
    """As probe(), from this resource on."""
    catalog = batch.catalog
    ring = [*message.ring, catalog.origin_of(resource)]
    waits = resource.phase in (Phase.LOADING, Phase.QUEUED) or resource.id in catalog.recovering
    if not waits or len(ring) > _RING_LIMIT:
        return
    if resource.id == message.waiter:
        blocked = catalog.held.get(message.blocked)
        if blocked is not None and blocked.hold is Hold.PENDING:
            withdraw(batch, blocked, failures.circular(ring))
        return
    for held_id in catalog.parts_of(resource.id):
        held = catalog.held[held_id]
        if held.hold is Hold.PENDING:
            request(batch, held.registrar, Probe(held.id, message.waiter, message.blocked, ring))
