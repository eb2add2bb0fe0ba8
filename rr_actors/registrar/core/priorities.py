"""The decisions about priorities: how a query's changes, and how those of a resource's parts follow.

A resource's priority is the highest of its queries. Its parts inherit it, unless their loads were given one of their
own. Functions that change the queries of a resource touch() it first. At the end of the decision settle() compares, and
tells the providers of the parts, so many changes of one decision are one. It goes on there in the same way, and stops
where the highest does not change.

The consumer's row says which priority is wanted, and is on disk first; the provider follows. Its answer, or its list
over a new link, says what it has. If that is not what is wanted, the consumer sends it again. So a change that a crash
or a lost link has lost, or that a repeated message has overtaken, is made good.
"""

from __future__ import annotations

from itertools import chain

from msgspec.structs import replace

from rr_actors.registrar.core.releasing import add_in_flight, parts_of
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import SetPriority
from rr_actors.registrar.model.effects import AnswerCall, Happened, SendReply, SendRequest, StartCallback
from rr_actors.registrar.model.messages import Reprioritise, Reprioritised
from rr_actors.registrar.model.rows import HELD, QUEUED, RESTING, STANDBY, UNLOADING, Held, State, shown_priority

# -- as a provider -----------------------------------------------------------------------------------------------------


def reprioritise(decision: Decision, message: Reprioritise) -> None:
    """Give a query another priority. A query that is gone needs none: its holder hears of that by itself."""
    query = decision.catalog.queries.get(message.query_id)
    if query is None or query.origin != message.origin:
        return
    if query.priority != message.priority:
        touch(decision, query.resource_id)
        decision.put(replace(query, priority=message.priority))
    resource = decision.catalog.resources[query.resource_id]
    if message.priority <= STANDBY or resource.phase not in RESTING or resource.state is State.FATAL:
        decision.cause(SendReply(query.origin, Reprioritised(query.id, message.priority)))


def touch(decision: Decision, resource_id: str) -> None:
    """Note that this decision may change the priority of a resource. To be called before it does."""
    catalog = decision.catalog
    if resource_id not in catalog.touched:
        before = catalog.priority_of(resource_id) if resource_id in catalog.holders else None
        decision.note(catalog.touched, resource_id, before)


def settle(decision: Decision) -> None:
    """Have the parts of each touched resource follow it. A resource that is being unloaded needs no parts any more."""
    catalog = decision.catalog
    for resource_id in list(catalog.touched):
        before = decision.forget(catalog.touched, resource_id)
        resource = catalog.resources.get(resource_id)
        if resource is None or resource.phase in (QUEUED, UNLOADING):
            continue
        now = catalog.priority_of(resource_id)
        if before not in (None, now) and resource_id in catalog.holders:
            decision.cause(Happened("priority", resource, shown_priority(now)))
        for id in list(catalog.parts.get(resource_id, ())):
            follow(decision, catalog.held[id])


# -- as a consumer -----------------------------------------------------------------------------------------------------


def follow(decision: Decision, held: Held) -> None:
    """Give a part that is held the priority of its resource, if the part inherits it. Its Load may have had another."""
    catalog = decision.catalog
    if held.hold is not HELD or held.own or held.id in catalog.ending or held.parent not in catalog.resources:
        return
    priority = catalog.inherited(held.parent)
    if priority != held.priority:
        held = replace(held, priority=priority)
        decision.put_later(held)  # the resource's queries say so, too
        tell(decision, held)


def tell(decision: Decision, held: Held) -> None:
    """Send the provider the priority that a query has here; over its next link, if that is not reconciled."""
    catalog = decision.catalog
    if held.registrar in catalog.up:
        decision.cause(SendRequest(held.registrar, Reprioritise(held.id, catalog.name, held.priority)))
    else:
        decision.note(catalog.unsent, held.id, True)


def tell_unsent(decision: Decision, provider: str) -> None:
    """Send what has changed since the last link to a provider: its list may be older."""
    catalog = decision.catalog
    for id in {*catalog.unsent, *chain.from_iterable(filter(None, catalog.rising.values()))}:
        held = catalog.held.get(id)
        if held is None or held.registrar == provider:
            decision.forget(catalog.unsent, id)
        if held is not None and held.registrar == provider:
            tell(decision, held)


def rise(decision: Decision) -> None:
    """Resume each resource whose parts have all said that they run, after it has asked them to."""
    catalog = decision.catalog
    for resource_id, parts in list(catalog.rising.items()):
        resource = catalog.resources[resource_id]
        asked = parts is None
        ids = parts_of(decision, resource_id) if parts is None else parts
        left = tuple(id for id in ids if _follows(catalog, id))
        if asked:
            for id in left:
                tell(decision, catalog.held[id])
        if left:
            decision.note(catalog.rising, resource_id, left)
        else:
            decision.forget(catalog.rising, resource_id)
            decision.cause(StartCallback("resume", resource))


def _follows(catalog: Catalog, query_id: str) -> bool:
    held = catalog.held.get(query_id)
    return held is not None and held.hold is HELD and not held.own and held.id not in catalog.ending


def set_priority(decision: Decision, command: SetPriority) -> None:
    """Give a query a priority of its own, on disk. Its provider hears of it now, or when it is back."""
    catalog = decision.catalog
    add_in_flight(decision, command.query_id)
    held = catalog.held.get(command.query_id)
    if held is None or held.hold is not HELD or held.id in catalog.ending:
        decision.cause(AnswerCall(command.ticket, failures.unknown_query(catalog, command.query_id)))
        return
    changes = held.priority != command.priority
    if changes or not held.own:
        held = replace(held, priority=command.priority, own=True)
        decision.put(held)
    if changes:
        tell(decision, held)
    decision.cause(AnswerCall(command.ticket, None))


def reprioritised(decision: Decision, message: Reprioritised) -> None:
    """Send the priority again if the provider has another one than this side."""
    catalog = decision.catalog
    held = catalog.held.get(message.query_id)
    if held is None or held.hold is not HELD:
        return
    if held.priority != message.priority:
        tell(decision, held)
    elif (parts := catalog.rising.get(held.parent)) is not None:
        decision.note(catalog.rising, held.parent, tuple(id for id in parts if id != held.id))
