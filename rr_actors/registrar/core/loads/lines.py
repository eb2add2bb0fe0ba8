"""Lines: loads that wait for a resource which they cannot join, and who is next.

A load waits while the resource of an identical request is unloaded. A resource of an exclusive server has one holder at
a time: every other load of the request waits for it. Each load that waits has a resource of its own, which is QUEUED.
So the line is made of rows, and after a crash it is as it was. Its order is by priority. Among equals it is that in
which the loads have come: an exclusive resource that is QUEUED has its number in `tries`.

`arrange` looks at a line at the end of each decision that has changed a row of its request. It does what follows from
the rows alone, so no decision has to say that somebody waits.
"""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.registrar.core.callback_runs import limit_load, start_load
from rr_actors.registrar.core.loads.load_rings import look_for_ring
from rr_actors.registrar.core.notices import drop_resource, end_wait, refuse, refuse_all
from rr_actors.registrar.core.priorities import touch
from rr_actors.registrar.core.status_changes import begin_revocation, is_revocable
from rr_actors.registrar.core.unloading import begin_unload, condemned, unheld
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision, RequestKey, Server, loaded
from rr_actors.registrar.model.commands import WaitOver
from rr_actors.registrar.model.effects import InLine, SendReply, SetTimer
from rr_actors.registrar.model.messages import NO_LIMIT, Load
from rr_actors.registrar.model.rows import (
    LOADED,
    LOADING,
    PAUSED,
    QUEUED,
    RESTING,
    STANDBY,
    UNLOAD_FAILED,
    UNLOADING,
    Resource,
    Revocation,
    ServedQuery,
    State,
    shown_priority,
)

_TOLD = 10
"""How many of a line hear each change of their place; those behind them hear their place when they come."""

# -- those who come ------------------------------------------------------------------------------------------------


def is_taken(catalog: Catalog, message: Load) -> bool:
    """Return whether a Load has to wait in line: somebody has the exclusive resource, or waits for it already."""
    key = (message.server, message.request)
    return key in catalog.queued or any(not _is_free(catalog, resource) for resource in _in_use(catalog, key))


def number_in(catalog: Catalog, key: RequestKey) -> int:
    """Return the number of the next load that comes into a line."""
    return 1 + max((catalog.resources[id].tries for id in catalog.queued.get(key, ())), default=0)


def limit_wait(decision: Decision, message: Load) -> None:
    """Set the timer for the end of a load's time in line, unless it runs already."""
    if message.wait_ms != NO_LIMIT and message.query_id not in decision.catalog.timed:
        decision.note(decision.catalog.timed, message.query_id, True)
        over = WaitOver(message.query_id)
        decision.cause(SetTimer("line:" + message.query_id, message.wait_ms / 1000, over))


def refuse_at_once(decision: Decision, message: Load) -> None:
    """Refuse a load that may not wait."""
    failure = _busy(decision.catalog, (message.server, message.request))
    decision.cause(refuse(decision, message.origin, message.query_id, failure))


def wait_over(decision: Decision, over: WaitOver) -> None:
    """Refuse a load that has waited in line for as long as it may; one that has got the resource goes on."""
    catalog = decision.catalog
    decision.forget(catalog.timed, over.query_id)
    query = catalog.queries.get(over.query_id)
    resource = None if query is None else catalog.resources[query.resource_id]
    if resource is not None and resource.phase is QUEUED:
        failure = _busy(catalog, (resource.server, resource.request), resource)
        decision.effects += refuse_all(decision, resource, failure)
        unheld(decision, resource)


# -- who is next ---------------------------------------------------------------------------------------------------


def arrange(decision: Decision) -> None:
    """Do in each line that has changed what follows: give the resource to the first, or ask its holder for it."""
    catalog = decision.catalog
    while catalog.stirred:
        key = next(iter(catalog.stirred))
        del catalog.stirred[key]
        server = catalog.servers.get(key[0])
        if server is None or key not in catalog.queued:  # a server that is not registered begins nothing
            continue
        if server.exclusive:
            _arrange_exclusive(decision, server, key)
        elif key not in catalog.unloading:
            for id in list(catalog.queued[key]):
                _give(decision, catalog.resources[id])


def _arrange_exclusive(decision: Decision, server: Server, key: RequestKey) -> None:
    catalog = decision.catalog
    line, used = line_of(catalog, key), _in_use(catalog, key)
    first = line[0]
    if all(_is_free(catalog, resource) for resource in used):
        if not _give(decision, first):
            return
        line, used = line[1:], _in_use(catalog, key)
        if any(query.parent for resource in used for query in catalog.queries_of(resource.id)):
            _look_for_rings(decision, line)  # those who wait do so for another whole now
    else:
        for resource in used:
            _take_from(decision, server, resource, first)
    _say_places(decision, line, used)


def line_of(catalog: Catalog, key: RequestKey) -> list[Resource]:
    """Return the resources of a line: the most urgent first, and among equals the one that came first."""
    line = [catalog.resources[id] for id in catalog.queued.get(key, ())]
    return sorted(line, key=lambda resource: (-catalog.priority_of(resource.id), resource.tries))


def _in_use(catalog: Catalog, key: RequestKey) -> list[Resource]:
    """Return the resources of a request that keep others waiting.

    One that could not be unloaded does not: its holder has released it, and could do so for ever.
    """
    return [resource for resource in catalog.used(key) if resource.phase is not UNLOAD_FAILED]


def _is_free(catalog: Catalog, resource: Resource) -> bool:
    """Return whether a resource is there, or will be, and nobody holds it: the next load may have it."""
    idle = resource.phase in (LOADED, LOADING, *RESTING) and resource.state is not State.FATAL
    return idle and resource.id not in catalog.holders and resource.id not in catalog.recovering


def _give(decision: Decision, first: Resource) -> bool:
    """Begin the load of a queued resource, or give its holders the one that is there. Return whether that is done.

    Before on_start has returned, a load of before a crash is not begun.
    """
    catalog = decision.catalog
    if first.id in catalog.early:
        return False
    kept = catalog.by_request.get(first.server, {}).get(first.request)
    if kept is not None and condemned(decision, catalog.resources[kept]):
        return False
    if kept is not None and _is_spoken_of(catalog, first):
        if kept not in catalog.holders:
            if catalog.resources[kept].phase in (LOADED, PAUSED):  # else the end of its callback does so
                begin_unload(decision, catalog.resources[kept])
            return False
        kept = None  # its server is not exclusive
    if kept is not None:
        _hand_over(decision, first, catalog.resources[kept])
        return True
    resource = replace(first, phase=LOADING, tries=0)
    decision.put(resource)
    end_wait(decision, first)
    start_load(decision, resource)
    return True


def _is_spoken_of(catalog: Catalog, first: Resource) -> bool:
    """Return whether a status of the queued resource itself is on its way to those who wait for it."""
    said = first.state is not State.OK or first.id in catalog.own_notices
    return said or any(id in catalog.notices_on for id in catalog.holders.get(first.id, ()))


def _hand_over(decision: Decision, first: Resource, resource: Resource) -> None:
    """Move the queries of a queued resource to one that is there."""
    catalog = decision.catalog
    decision.forget(catalog.idle, resource.id)
    decision.cause(SetTimer("linger:" + resource.id, None, None))
    touch(decision, resource.id)
    for query in catalog.queries_of(first.id):
        decision.put(replace(query, resource_id=resource.id))
        runs = resource.phase is LOADED or (resource.phase in RESTING and query.priority <= STANDBY)
        if runs and resource.id not in catalog.recovering:
            decision.forget(catalog.waiting, query.id)
            decision.cause(SendReply(query.origin, loaded(catalog, query.id, resource)))
        else:
            decision.note(catalog.waiting, query.id, resource.id)
    if resource.phase is LOADING:
        limit_load(decision, resource)
    drop_resource(decision, first)


def _take_from(decision: Decision, server: Server, resource: Resource, first: Resource) -> None:
    """Revoke a resource whose holder needs it less than the first in line does."""
    catalog = decision.catalog
    priority, had = catalog.priority_of(first.id), catalog.priority_of(resource.id)
    if had >= priority or not is_revocable(catalog, resource):
        return
    if resource.id in catalog.revocations or condemned(decision, resource) or "" in catalog.early:
        return
    whose = f"{catalog.holder_of(first.id)} waits for it with {shown_priority(priority)}"
    why = f"{whose}; its holder has {shown_priority(had)}"
    begin_revocation(decision, resource, Revocation(resource.id, f"line:{resource.id}", why, server.grace_ms))


def look_again(decision: Decision, origin: str) -> None:
    """Look for rings through what this registrar holds, as a WaitedFor may have been lost with its last link."""
    catalog = decision.catalog
    for query in [catalog.queries[id] for id in catalog.by_origin.get(origin, ())]:
        resource = catalog.resources[query.resource_id]
        if query.parent and resource.phase is not QUEUED:
            _look_for_rings(decision, line_of(catalog, (resource.server, resource.request)))


def _look_for_rings(decision: Decision, line: list[Resource]) -> None:
    for resource in line:
        for query in decision.catalog.queries_of(resource.id):
            look_for_ring(decision, resource, query.id, query.parent)


# -- what they hear ------------------------------------------------------------------------------------------------


def _say_places(decision: Decision, line: list[Resource], used: list[Resource]) -> None:
    catalog = decision.catalog
    has = _who_has_it(catalog, used)
    holder, since = failures.holder_since(_query_on(catalog, used))
    before = ""
    for place, resource in enumerate(line, 1):
        if place <= _TOLD or resource.id not in catalog.said:
            text = f"{_ordinal(place)} in line{before}; {has}"
            if catalog.said.get(resource.id) != text:
                decision.note(catalog.said, resource.id, text)
                decision.cause(InLine(resource.id, text, holder, since))
        before = f", behind {catalog.holder_of(resource.id)}"


def _who_has_it(catalog: Catalog, used: list[Resource]) -> str:
    holder = next(filter(None, (catalog.holder_of(resource.id) for resource in used)), "")
    if not holder:
        return "nobody has it: it is being unloaded"
    leaves = any(resource.id in catalog.revocations for resource in used)
    going = any(resource.phase is UNLOADING for resource in used)
    return f"{holder} {'is to release it' if leaves else 'releases it' if going else 'has it'}"


def _ordinal(number: int) -> str:
    ending = "th" if 10 <= number % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def _busy(catalog: Catalog, key: RequestKey, own: Resource | None = None) -> failures.Failure:
    used = _in_use(catalog, key)
    others = [resource for resource in line_of(catalog, key) if resource is not own]
    return failures.busy(catalog, *key, _query_on(catalog, used), len(others))


def _query_on(catalog: Catalog, used: list[Resource]) -> ServedQuery | None:
    """Return the oldest query on what keeps others waiting; None while nobody holds that."""
    return next((query for resource in used for query in catalog.queries_of(resource.id)), None)
