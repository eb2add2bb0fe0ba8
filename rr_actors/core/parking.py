"""Parking: what comes in for a resource that is being asked after waits until it is known whether it lives."""

from __future__ import annotations

from collections.abc import Callable

from rr_actors.core.batch import Batch
from rr_actors.messages import Load, Unload

Parked = Load | Unload


def park(batch: Batch, resource_id: str, message: Parked) -> None:
    """Keep a message until then."""
    recovering = batch.catalog.recovering
    batch.note(recovering, resource_id, (*recovering[resource_id], message))


def drop_parked(batch: Batch, unwanted: Callable[[Parked], bool]) -> None:
    """Forget messages that nobody waits for any more, or that are sent again."""
    recovering = batch.catalog.recovering
    for resource_id, parked in list(recovering.items()):
        left = tuple(message for message in parked if not unwanted(message))
        if len(left) < len(parked):
            batch.note(recovering, resource_id, left)


def parked_on(batch: Batch, query_id: str) -> str | None:
    """The resource that a query's Load waits for here."""
    for resource_id, parked in batch.catalog.recovering.items():
        if any(isinstance(message, Load) and message.query_id == query_id for message in parked):
            return resource_id
    return None
