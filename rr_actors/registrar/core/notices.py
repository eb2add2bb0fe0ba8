"""What a provider tells consumers unasked, later, or in refusal: notices, deferred loads, refused loads."""

from __future__ import annotations

from collections.abc import Callable

from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import Reply
from rr_actors.registrar.model.messages import Failure, Load, LoadRefused, Noticed, NoticesHandled, Unload
from rr_actors.registrar.model.rows import Notice, Query, Resource, State, is_own

# Notices: statuses on their way to the holders of queries. Rows, until the holder says it has dealt with them.


def notify(
    decision: Decision,
    query: Query,
    event: str,
    state: State,
    message: str,
    source: str,
    *,
    released: bool = False,
    response: bytes | None = None,
    repeated: bool = False,
) -> None:
    """Put a status on its way to the query's holder."""
    id = f"{event}:{query.id}"
    notice = Notice(id, query.id, query.origin, query.resource_id, event, state, message, source, released, response)
    decision.put(notice)
    if repeated:  # what it comes from may have come this way before a crash
        decision.note(decision.catalog.told, id, True)
    send_notice(decision, notice)


def send_notice(decision: Decision, notice: Notice) -> None:
    """Send it, if the holder is there; else it waits for the holder's next link."""
    catalog = decision.catalog
    if notice.origin in catalog.consumers:
        repeated = notice.id in catalog.told
        decision.note(catalog.told, notice.id, True)
        decision.cause(Reply(notice.origin, Noticed(notice, repeated)))


def own_notices(decision: Decision, resource_id: str) -> list[Notice]:
    """What the server of a resource has to hear of it before its holders do, oldest first."""
    catalog = decision.catalog
    return [catalog.notices[id] for id in sorted(catalog.own_notices.get(resource_id, ()))]


def drop_resource(decision: Decision, resource: Resource) -> None:
    """End a resource: what its server has not heard about it is of no interest any more."""
    for notice in own_notices(decision, resource.id):
        drop_notice(decision, notice)
    deferred = decision.forget(decision.catalog.deferred, resource.id) or ()
    of_parts = tuple(start for start in deferred if not is_own(start.notice))
    if of_parts:
        decision.note(decision.catalog.deferred, resource.id, of_parts)  # they have to be acknowledged
    decision.drop(resource)


def notices_handled(decision: Decision, message: NoticesHandled) -> None:
    """The holder has dealt with these."""
    for id in message.ids:
        notice = decision.catalog.notices.get(id)
        if notice is not None:
            drop_notice(decision, notice)


def drop_notice(decision: Decision, notice: Notice) -> None:
    """It need not be told (again)."""
    decision.drop(notice)
    decision.forget(decision.catalog.told, notice.id)


def drop_query(decision: Decision, query: Query) -> None:
    """End a query that its holder has released: what it has not heard it does not want to hear."""
    decision.forget(decision.catalog.waiting, query.id)
    decision.forget(decision.catalog.unanswered, query.id)
    decision.drop(query)
    drop_notices(decision, query.origin, query.id)


def drop_notices(decision: Decision, origin: str, query_id: str) -> None:
    """Nothing more is to be told about this query."""
    for notice in _notices_of(decision, origin, query_id):
        drop_notice(decision, notice)


def send_notices(decision: Decision, query: Query) -> None:
    """Tell again what has not been dealt with."""
    for notice in _notices_of(decision, query.origin, query.id):
        send_notice(decision, notice)


def _notices_of(decision: Decision, origin: str, query_id: str) -> list[Notice]:
    catalog = decision.catalog
    if query_id not in catalog.notices_on:
        return []
    notices = [catalog.notices[id] for id in catalog.notices_on[query_id]]
    return [notice for notice in notices if notice.origin == origin]


# Refusing loads: the answer, and the memory of it, so that the same Load coming once more gets it again.

_REMEMBERED = 4096


def refuse(decision: Decision, origin: str, query_id: str, failure: Failure) -> Reply:
    """The answer to a Load that has failed."""
    remember(decision, query_id, failure)
    return Reply(origin, LoadRefused(query_id, failure))


def remember(decision: Decision, query_id: str, failure: Failure) -> None:
    """The answer that its Load gets from now on."""
    refused = decision.catalog.refused
    decision.note(refused, query_id, failure)
    if len(refused) > _REMEMBERED:
        for old in list(refused)[: _REMEMBERED // 2]:
            decision.forget(refused, old)


def refuse_all(decision: Decision, resource: Resource, failure: Failure) -> list[Reply]:
    """The answers to all who wait for a resource that has failed, or is taken away; their queries go."""
    replies: list[Reply] = []
    for query in decision.catalog.queries_of(resource.id):
        replies.append(refuse(decision, query.origin, query.id, failure))
        drop_query(decision, query)
    return replies


# Parking: what comes in for a resource that is being asked after waits until it is known whether it lives.

Parked = Load | Unload


def park(decision: Decision, resource_id: str, message: Parked) -> None:
    """Keep a message until then."""
    recovering = decision.catalog.recovering
    decision.note(recovering, resource_id, (*recovering[resource_id], message))


def drop_parked(decision: Decision, unwanted: Callable[[Parked], bool]) -> None:
    """Forget messages that nobody waits for any more, or that are sent again."""
    recovering = decision.catalog.recovering
    for resource_id, parked in list(recovering.items()):
        left = tuple(message for message in parked if not unwanted(message))
        if len(left) < len(parked):
            decision.note(recovering, resource_id, left)


def parked_on(catalog: Catalog, query_id: str) -> str | None:
    """The resource that a query's Load waits for here."""
    for resource_id, parked in catalog.recovering.items():
        if any(isinstance(message, Load) and message.query_id == query_id for message in parked):
            return resource_id
    return None
