"""A provider's messages that answer no request at once: notices, answers to parked loads, refusals.

The last part is a consumer's: when all receivers of a notice have dealt with it, its provider may forget it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice

from msgspec.structs import replace

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.callback_runs import forget_runs
from rr_actors.registrar.core.holding import end_direct
from rr_actors.registrar.core.priorities import touch
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import FellBehind, InLine, LoadResolved, SendReply, SetTimer
from rr_actors.registrar.model.messages import Load, LoadRefused, Noticed, NoticesHandled, Unload
from rr_actors.registrar.model.rows import Hold, Notice, Resource, ServedQuery, State, is_own

_HEARD_REMEMBERED = 20_000
_SWEPT_EVERY = 1024

Place = tuple[str, str, str]  # "query" or "resource", its id, the event

# Notices: statuses on their way to the holders of queries. A notice is a row until its holder has dealt with it.
#
# Of one query, a window of notices is on the way at a time (Catalog.window), oldest first. The others wait here until
# the holder has dealt with half of these. So a slow holder has few of them in memory, and only its own wait. If more
# wait than Catalog.backlog, the oldest are dropped, which newer ones have made out of date.


def notify(decision: Decision, query: ServedQuery, said: Notice, *, repeated: bool = False) -> None:
    """Add a notice for the query's holder with what `said` says of the resource, and send it in its turn."""
    catalog = decision.catalog
    notice = replace(said, id=f"{said.event}:{query.id}", query_id=query.id, origin=query.origin)
    decision.put(notice)
    if repeated and notice.id not in catalog.told:  # the holder may have got this status before a crash
        decision.note(catalog.told, notice.id, False)
    before = len(catalog.notices_on[query.id]) - 1
    if before >= catalog.backlog:
        oldest = [catalog.notices[id] for id in islice(catalog.notices_on[query.id], 2 * catalog.window)]
        drop_superseded(decision, [old for old in oldest if not catalog.told.get(old.id)])
    if query.id in catalog.behind or query.origin not in catalog.consumers:
        return
    if before < catalog.window:
        _send_notice(decision, notice)
    else:
        decision.note(catalog.behind, query.id, before)
        decision.cause(FellBehind(query.origin, query.resource_id, query.id, before))


def drop_superseded(decision: Decision, oldest: list[Notice]) -> None:
    """Drop the oldest notices that wait for one receiver, but no FATAL, no loss, and not the last response."""
    dropped, response = 0, False
    for notice in reversed(oldest):
        if notice.state is State.FATAL or (notice.response is not None and not response):
            response = response or notice.response is not None
        else:
            drop_notice(decision, notice)
            dropped += 1
    if dropped:
        decision.cause(FellBehind(oldest[0].origin, oldest[0].resource_id, oldest[0].query_id, 0, dropped))


def send_notices_to(decision: Decision, origin: str) -> None:
    """Send the oldest notices for each query of a consumer over its new link; the others in their turn."""
    catalog = decision.catalog
    sent: dict[str, int] = {}
    for notice in [catalog.notices[id] for id in catalog.notices_to.get(origin, ())]:
        count = sent.get(notice.query_id, 0)
        if count < catalog.window:
            sent[notice.query_id] = count + 1
            decision.forget(catalog.behind, notice.query_id)
            _send_notice(decision, notice)
        else:
            decision.note(catalog.behind, notice.query_id, count)
            if catalog.told.get(notice.id):
                decision.note(catalog.told, notice.id, False)


def _send_notice(decision: Decision, notice: Notice) -> None:
    catalog = decision.catalog
    repeated = notice.id in catalog.told
    if repeated and notice.response is not None and (resource := catalog.resources.get(notice.resource_id)) is not None:
        notice = replace(notice, response=resource.response)  # its holder may have heard of a newer one
    decision.note(catalog.told, notice.id, True)
    decision.cause(SendReply(notice.origin, Noticed(notice, repeated)))


def _send_more(decision: Decision, query_id: str) -> None:
    """Fill the window of a query that is behind, if half of it is free."""
    catalog = decision.catalog
    on_way = catalog.behind.get(query_id, catalog.window)
    if on_way * 2 > catalog.window:
        return
    for notice in [catalog.notices[id] for id in catalog.notices_on[query_id]]:
        if notice.origin not in catalog.consumers:
            return  # its next link brings them
        if not catalog.told.get(notice.id):
            if on_way == catalog.window:
                decision.note(catalog.behind, query_id, on_way)
                return
            _send_notice(decision, notice)
            on_way += 1
    decision.forget(catalog.behind, query_id)


def own_notices(decision: Decision, resource_id: str) -> list[Notice]:
    """Return the notices that a resource's own server has to hear before the holders do, oldest first."""
    catalog = decision.catalog
    return [catalog.notices[id] for id in sorted(catalog.own_notices.get(resource_id, ()))]


def drop_resource(decision: Decision, resource: Resource) -> None:
    """Remove a resource, and the notices about it that its server has not heard; acknowledge those of its parts."""
    for notice in own_notices(decision, resource.id):
        drop_notice(decision, notice)
    for start in decision.forget(decision.catalog.deferred, resource.id) or ():
        if not is_own(start.notice):
            dealt_with(decision, ("resource", resource.id, start.notice.event))
    forget_runs(decision, resource.id)
    end_wait(decision, resource)
    if decision.catalog.chased:
        decision.forget(decision.catalog.chased, resource.id)
    end_revocation(decision, resource.id)
    decision.drop(resource)


def end_wait(decision: Decision, resource: Resource) -> None:
    """Note that a load does not wait in line for this resource any more."""
    if decision.catalog.said and decision.forget(decision.catalog.said, resource.id):
        decision.cause(InLine(resource.id, ""))


def end_revocation(decision: Decision, resource_id: str) -> None:
    """Forget that a resource is revoked: it is gone, or cannot be unloaded."""
    if (revocation := decision.catalog.revocations.get(resource_id)) is not None:
        decision.drop(revocation)
        decision.cause(SetTimer("revoke:" + resource_id, None, None))


def notices_handled(decision: Decision, message: NoticesHandled) -> None:
    """Drop the notices that their holder has dealt with.

    With the one that says that a query was taken away go those before it: the holder has dealt with them, or passed
    them over while it was releasing the query.
    """
    for id in message.ids:
        notice = decision.catalog.notices.get(id)
        if notice is None:
            continue
        drop_notice(decision, notice)
        if notice.released and notice.query_id not in decision.catalog.queries:
            drop_notices(decision, notice.origin, notice.query_id)
        else:
            _send_more(decision, notice.query_id)


def drop_notice(decision: Decision, notice: Notice) -> None:
    """Drop a notice, which need not be sent (again)."""
    catalog = decision.catalog
    decision.drop(notice)
    sent = decision.forget(catalog.told, notice.id)
    if notice.query_id in catalog.behind:
        if notice.query_id not in catalog.notices_on:
            decision.forget(catalog.behind, notice.query_id)
        elif sent:
            decision.note(catalog.behind, notice.query_id, catalog.behind[notice.query_id] - 1)


def drop_query(decision: Decision, query: ServedQuery) -> None:
    """Remove a query that its holder has released, and the notices about it that the holder has not heard."""
    decision.forget(decision.catalog.waiting, query.id)
    decision.forget(decision.catalog.unanswered, query.id)
    if decision.catalog.timed and decision.forget(decision.catalog.timed, query.id):
        decision.cause(SetTimer("line:" + query.id, None, None))
    if query.resource_id in decision.catalog.ranked:
        touch(decision, query.resource_id)
    decision.drop(query)
    drop_notices(decision, query.origin, query.id)


def drop_notices(decision: Decision, origin: str, query_id: str) -> None:
    """Drop all notices about a query."""
    for notice in _notices_of(decision, origin, query_id):
        drop_notice(decision, notice)


def send_notices(decision: Decision, query: ServedQuery) -> None:
    """Send the notices about a query again that are on their way."""
    for notice in _notices_of(decision, query.origin, query.id):
        if decision.catalog.told.get(notice.id) and notice.origin in decision.catalog.consumers:
            _send_notice(decision, notice)


def _notices_of(decision: Decision, origin: str, query_id: str) -> list[Notice]:
    catalog = decision.catalog
    if query_id not in catalog.notices_on:
        return []
    notices = [catalog.notices[id] for id in catalog.notices_on[query_id]]
    return [notice for notice in notices if notice.origin == origin]


# Refusals of loads: the answer is remembered, so that the same Load gets it again if it comes once more.

_REMEMBERED = 4096


def refuse(decision: Decision, origin: str, query_id: str, failure: Failure) -> SendReply:
    """Return the answer to a Load that has failed, and remember it."""
    remember(decision, query_id, failure)
    return SendReply(origin, LoadRefused(query_id, failure))


def remember(decision: Decision, query_id: str, failure: Failure) -> None:
    """Remember the failure that a query's Load gets from now on; forget the oldest ones beyond the limit."""
    refused = decision.catalog.refused
    decision.note(refused, query_id, failure)
    if len(refused) > _REMEMBERED:
        for old in list(refused)[: _REMEMBERED // 2]:
            decision.forget(refused, old)


def refuse_all(decision: Decision, resource: Resource, failure: Failure) -> list[SendReply]:
    """Return the answers to all that wait for a resource that failed or is taken away, and remove their queries."""
    replies: list[SendReply] = []
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


# Notices at the consumer.


def dealt_with(decision: Decision, place: Place) -> None:
    """Note that a receiver has dealt with an event; acknowledge the notices of which it was the last receiver."""
    catalog = decision.catalog
    waiting = catalog.heard.get(place, ())
    remember_heard(decision, place)
    for notice_id in waiting:
        hearing = catalog.hearing.get(notice_id)
        if hearing is None:
            continue
        if hearing.receivers > 1:
            decision.note(catalog.hearing, notice_id, replace(hearing, receivers=hearing.receivers - 1))
        else:
            decision.forget(catalog.hearing, notice_id)
            end_query(decision, hearing.ends, hearing.provider)
            acknowledge(decision, hearing.provider, notice_id)


def end_query(decision: Decision, held_id: str, provider: str) -> None:
    """Remove a query that was taken away, when its holders know; on disk before the notice is acknowledged.

    A provider that is gone for good may still have the query in its catalog: the release is owed. If this registrar has
    found by itself that the query is lost (`provider` is ""), its provider may have a notice of that: an Unload has it
    drop that.
    """
    catalog = decision.catalog
    doubted = decision.forget(catalog.ending, held_id)
    held = catalog.held.get(held_id)
    if held is not None and held.hold is not Hold.OWED:
        if held.hold is Hold.PENDING and held_id not in catalog.direct:
            # Its thread's line broke, and the load waits for the link.
            failure = failures.withdrawn(held, "taken away before the answer to its load came")
            decision.cause(LoadResolved(held, failure))
        end_direct(decision, held_id)
        decision.forget(catalog.kept, held_id)
        decision.forget(catalog.unsent, held_id)
        if doubted:
            decision.put(replace(held, hold=Hold.OWED, resource_id=""))
            decision.request(held.registrar, Unload(held_id, catalog.name))
        else:
            decision.drop(held)
            if not provider and held.registrar in catalog.up:
                decision.request(held.registrar, Unload(held_id, catalog.name))


def remember_heard(decision: Decision, place: Place) -> None:
    """Remember that no notice waits for this receiver of an event; forget the oldest ones beyond the limit."""
    catalog, heard = decision.catalog, decision.catalog.heard
    decision.note(heard, place, ())
    if len(heard) % _SWEPT_EVERY == 0:
        for old, pending in list(heard.items()):
            kind, id, _ = old
            if not pending and id not in (catalog.held if kind == "query" else catalog.resources):
                decision.forget(heard, old)
    if len(heard) > _HEARD_REMEMBERED:
        for old in list(heard)[: _HEARD_REMEMBERED // 2]:
            if not heard[old]:
                decision.forget(heard, old)  # so old that its notice was acknowledged long ago


def acknowledge(decision: Decision, provider: str, notice_id: str) -> None:
    """Say to a notice's provider that its receivers have dealt with it; this registrar's own has no provider."""
    if provider:
        decision.note(decision.catalog.acked, provider, True)
        decision.request(provider, NoticesHandled([notice_id]))
