"""A provider's messages that answer no request at once: notices, answers to parked loads, refusals."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import Reply
from rr_actors.registrar.model.messages import Failure, Load, LoadRefused, Noticed, NoticesHandled, Unload
from rr_actors.registrar.model.rows import Notice, Query, Resource, is_own

# Notices: statuses on their way to the holders of queries. A notice is a row until its holder has dealt with it.


def notify(decision: Decision, query: Query, said: Notice, *, repeated: bool = False) -> None:
    """Add a notice for the query's holder with what `said` says of the resource, and send it."""
    notice = replace(said, id=f"{said.event}:{query.id}", query_id=query.id, origin=query.origin)
    decision.put(notice)
    if repeated:  # the holder may have got this status before a crash
        decision.note(decision.catalog.told, notice.id, True)
    send_notice(decision, notice)


def send_notice(decision: Decision, notice: Notice) -> None:
    """Send a notice if its holder has a link; otherwise the notice waits for the holder's next link."""
    catalog = decision.catalog
    if notice.origin in catalog.consumers:
        repeated = notice.id in catalog.told
        decision.note(catalog.told, notice.id, True)
        decision.cause(Reply(notice.origin, Noticed(notice, repeated)))


def own_notices(decision: Decision, resource_id: str) -> list[Notice]:
    """Return the notices that a resource's own server has to hear before the holders do, oldest first."""
    catalog = decision.catalog
    return [catalog.notices[id] for id in sorted(catalog.own_notices.get(resource_id, ()))]


def drop_resource(decision: Decision, resource: Resource) -> None:
    """Remove a resource, and the notices about it that its server has not heard."""
    for notice in own_notices(decision, resource.id):
        drop_notice(decision, notice)
    deferred = decision.forget(decision.catalog.deferred, resource.id) or ()
    of_parts = tuple(start for start in deferred if not is_own(start.notice))
    if of_parts:
        decision.note(decision.catalog.deferred, resource.id, of_parts)  # their notices have to be acknowledged
    decision.drop(resource)


def notices_handled(decision: Decision, message: NoticesHandled) -> None:
    """Drop the notices that their holder has dealt with."""
    for id in message.ids:
        notice = decision.catalog.notices.get(id)
        if notice is not None:
            drop_notice(decision, notice)


def drop_notice(decision: Decision, notice: Notice) -> None:
    """Drop a notice, which need not be sent (again)."""
    decision.drop(notice)
    decision.forget(decision.catalog.told, notice.id)


def drop_query(decision: Decision, query: Query) -> None:
    """Remove a query that its holder has released, and the notices about it that the holder has not heard."""
    decision.forget(decision.catalog.waiting, query.id)
    decision.forget(decision.catalog.unanswered, query.id)
    decision.drop(query)
    drop_notices(decision, query.origin, query.id)


def drop_notices(decision: Decision, origin: str, query_id: str) -> None:
    """Drop all notices about a query."""
    for notice in _notices_of(decision, origin, query_id):
        drop_notice(decision, notice)


def send_notices(decision: Decision, query: Query) -> None:
    """Send all notices about a query again."""
    for notice in _notices_of(decision, query.origin, query.id):
        send_notice(decision, notice)


def _notices_of(decision: Decision, origin: str, query_id: str) -> list[Notice]:
    catalog = decision.catalog
    if query_id not in catalog.notices_on:
        return []
    notices = [catalog.notices[id] for id in catalog.notices_on[query_id]]
    return [notice for notice in notices if notice.origin == origin]


# Refusals of loads: the answer is remembered, so that the same Load gets it again if it comes once more.

_REMEMBERED = 4096


def refuse(decision: Decision, origin: str, query_id: str, failure: Failure) -> Reply:
    """Return the answer to a Load that has failed, and remember it."""
    remember(decision, query_id, failure)
    return Reply(origin, LoadRefused(query_id, failure))


def remember(decision: Decision, query_id: str, failure: Failure) -> None:
    """Remember the failure that a query's Load gets from now on; forget the oldest ones beyond the limit."""
    refused = decision.catalog.refused
    decision.note(refused, query_id, failure)
    if len(refused) > _REMEMBERED:
        for old in list(refused)[: _REMEMBERED // 2]:
            decision.forget(refused, old)


def refuse_all(decision: Decision, resource: Resource, failure: Failure) -> list[Reply]:
    """Return the answers to all that wait for a resource that failed or is taken away, and remove their queries."""
    replies: list[Reply] = []
    for query in decision.catalog.queries_of(resource.id):
        replies.append(refuse(decision, query.origin, query.id, failure))
        drop_query(decision, query)
    return replies


# Parking: a message for a resource that is being recovered waits until the recover callback has returned.

Parked = Load | Unload


def park(decision: Decision, resource_id: str, message: Parked) -> None:
    """Keep a message until the resource's recover callback has returned."""
    recovering = decision.catalog.recovering
    decision.note(recovering, resource_id, (*recovering[resource_id], message))


def drop_parked(decision: Decision, unwanted: Callable[[Parked], bool]) -> None:
    """Forget parked messages that nobody waits for any more, or that are sent again."""
    recovering = decision.catalog.recovering
    for resource_id, parked in list(recovering.items()):
        left = tuple(message for message in parked if not unwanted(message))
        if len(left) < len(parked):
            decision.note(recovering, resource_id, left)


def parked_on(catalog: Catalog, query_id: str) -> str | None:
    """Return the id of the resource for which a query's Load is parked."""
    for resource_id, parked in catalog.recovering.items():
        if any(isinstance(message, Load) and message.query_id == query_id for message in parked):
            return resource_id
    return None
