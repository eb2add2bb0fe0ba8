"""The decisions of a provider about loads and reloads, and about the ends of pauses and resumptions.

A resource's life, by phase::

    (request) ─> LOADING ─> LOADED ─> UNLOADING ─> (gone)
         │          │ failed           │ failed
         │          └─> (gone)         └─> UNLOAD_FAILED ─> UNLOADING ...
         └─> QUEUED, while one of the same request is UNLOADING, then LOADING

FATAL is a status, not a phase. A FATAL resource stays with its holders, and new requests do not join it.

A Load may come twice, by two ways. If the first was refused, the second is refused again, and no callback runs.
"""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.callback_runs import (
    acquit,
    awaits_trial,
    end_limit,
    end_trial,
    forget_request,
    limit_load,
    note_begun,
    note_ended,
    refused_for_s,
    request_id,
    run_id,
    running,
    start_load,
)
from rr_actors.registrar.core.holding import break_ring
from rr_actors.registrar.core.notices import drop_notices, drop_resource, park, parked_on, refuse, refuse_all
from rr_actors.registrar.core.priorities import touch
from rr_actors.registrar.core.releasing import add_in_flight, parts_of, release_parts, withdraw
from rr_actors.registrar.core.status_changes import is_busy, spread
from rr_actors.registrar.core.status_delivery import start_deferred
from rr_actors.registrar.core.unloading import (
    answer_wholes,
    answers_to_owners,
    balance,
    begin_unload,
    refuse_waiting,
    retire,
    settle,
    stop_waiting,
)
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision, Server
from rr_actors.registrar.model.commands import CallbackEnded, CallbackOverdue, Reload
from rr_actors.registrar.model.effects import AnswerCall, Effect, Happened, SendReply, SetTimer, StartCallback
from rr_actors.registrar.model.messages import Load, Loaded, LoadRefused, Probe
from rr_actors.registrar.model.rows import (
    LOADED,
    LOADING,
    OK,
    PAUSED,
    PAUSING,
    PENDING,
    QUEUED,
    RESTING,
    RESUMING,
    STANDBY,
    UNLOADING,
    CallbackRun,
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
    if resource_id is None:
        _load_first(decision, message)
    elif ring := _ring_of_holds(catalog, message, resource_id):
        decision.cause(refuse(decision, message.origin, message.query_id, failures.own_part(catalog, ring)))
    elif resource_id in catalog.recovering:
        park(decision, resource_id, message)
        _look_for_ring(decision, message, catalog.resources[resource_id])
    else:
        _join(decision, message, catalog.resources[resource_id])


def _load_first(decision: Decision, message: Load) -> None:
    catalog = decision.catalog
    if catalog.refusing and (id := request_id(message.server, message.request)) in catalog.refusing:
        rounds = catalog.callback_runs[id].deaths
        failure = failures.still_refused(catalog, message.server, rounds, refused_for_s(rounds))
        decision.cause(refuse(decision, message.origin, message.query_id, failure))
        return
    queued = (message.server, message.request) in catalog.unloading
    phase = QUEUED if queued else LOADING
    resource_id = catalog.new_resource_id(message.query_id)
    resource = Resource(resource_id, message.server, message.request, None, phase, OK, "", 1)
    decision.put(resource)
    _begin_query(decision, message, resource_id)
    decision.note(catalog.waiting, message.query_id, resource_id)
    if queued:
        _look_for_ring(decision, message, resource)
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
    _look_for_ring(decision, message, resource)


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
    if catalog.shut or message.priority or resource.id in catalog.ranked:
        return None
    if message.parent and message.origin == catalog.name and _ring_of_holds(catalog, message, resource.id):
        return None
    id = message.query_id
    if id in catalog.queries or id in catalog.refused or id in catalog.notices_on:
        return None
    return _query_of(message, resource.id)


def _ring_of_holds(catalog: Catalog, message: Load, resource_id: str) -> list[str]:
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


def loaded(catalog: Catalog, query_id: str, resource: Resource) -> Loaded:
    """Return the answer to a Load whose resource is loaded."""
    server = catalog.servers.get(resource.server)
    types = 0 if server is None else server.types_checksum
    return Loaded(query_id, resource.id, resource.response or b"", types, resource.state)


def _load_again(decision: Decision, message: Load, query: ServedQuery) -> None:
    """Decide a Load of a known query: its answer was lost, or is still to come."""
    catalog = decision.catalog
    resource = catalog.resources[query.resource_id]
    if resource.id in catalog.recovering:
        park(decision, resource.id, message)
    elif is_busy(catalog, resource) or is_to_run(query, resource):
        decision.note(catalog.waiting, query.id, resource.id)
        _look_for_ring(decision, message, resource)
    else:
        decision.cause(SendReply(query.origin, loaded(catalog, query.id, resource)))


def is_to_run(query: ServedQuery, resource: Resource) -> bool:
    """Return whether a resource is paused, or about to be, and is resumed for this query."""
    return resource.phase in RESTING and query.priority > STANDBY and resource.state is not State.FATAL


def _look_for_ring(decision: Decision, message: Load, resource: Resource) -> None:
    if message.parent:
        chase(decision, resource, Probe(message.query_id, message.parent, message.query_id, []))


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


# Probing finds rings of loads that wait for one another, by edge chasing (Chandy, Misra and Haas 1983).
#
# The last edge of a ring is always a load that joins one in flight or waits for an unload. Any other new resource waits
# for nothing yet. So a probe starts at such a load. All other edges are known at their providers by then.
# Therefore a load may go by another connection than the probe that follows it. A link may break and lose a probe. The
# loads that wait at that provider are then sent again over the next link, and each starts another probe.

_RING_LIMIT = 256


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
    for held_id in parts_of(decision, resource.id):
        held = catalog.held[held_id]
        if held.hold is PENDING:
            decision.request(held.registrar, Probe(held.id, message.waiter, message.blocked, ring))


# -- reloads: a resource is loaded again for the same request, and its holders keep it ---------------------------------
#
# After a crash a server with recovery="reload" has its resources loaded again, by its load callback. On demand, the
# unload callback runs before (role "reload"). Then the parts of the last load are released, as they are when a resource
# is unloaded: some, like shares of a budget, cannot be there twice. The load callback asks for them again. Meanwhile
# the resource is in `recovering`: loads and unloads of it wait.
#
# On disk, a row "reload:ID" of callback_runs says that a reload on demand has begun. When the unload callback has
# returned, a row "recover:ID" is beside it. After a crash, the reload goes on with the callback that was interrupted.


def reload(decision: Decision, command: Reload) -> None:
    """Begin to reload a resource on demand; answer the owner when it is loaded again."""
    catalog = decision.catalog
    resource = catalog.find(command.target)
    if resource is None:
        decision.cause(AnswerCall(command.ticket, failures.unknown_target(catalog, command.target)))
    elif why := _why_not(catalog, resource):
        decision.cause(AnswerCall(command.ticket, failures.not_reloaded(catalog, resource, why)))
    else:
        stop_waiting(decision, resource)
        decision.forget(catalog.early, resource.id)
        decision.note(catalog.recovering, resource.id, ())
        decision.note(catalog.reloads, resource.id, command.ticket)
        if resource.phase is PAUSED:
            resource = replace(resource, phase=LOADED)
            decision.put(resource)
        decision.cause(Happened("reloading", resource, "", kept=True))
        run_unload_first(decision, resource)


def _why_not(catalog: Catalog, resource: Resource) -> str:
    """Return why a resource cannot be reloaded now; "" if it can."""
    if is_reloaded(catalog, resource.id):
        return "is being reloaded already"
    if resource.id in catalog.recovering:
        return "is recovering"
    if resource.id in catalog.revocations:
        return "is revoked"
    if resource.phase not in (LOADED, PAUSED):
        return f"is {resource.phase}"
    if resource.phase is PAUSED and catalog.priority_of(resource.id) > STANDBY:
        return "is about to be resumed"
    if resource.state is State.FATAL:
        return "is FATAL: its holders have heard that it is lost; release it, and load it anew"
    if resource.server not in catalog.servers:
        return failures.waits_for_server(catalog, resource)
    if resource.server in catalog.leaving:
        return "is being unloaded, with its server"
    return "will be unloaded, as its registrar is being closed" if catalog.shut else ""


def is_reloaded(catalog: Catalog, resource_id: str) -> bool:
    """Return whether a reload of the resource has begun on demand, and has not ended."""
    return bool(catalog.callback_runs) and run_id("reload", resource_id) in catalog.callback_runs


def recover_in_turn(decision: Decision, resource: Resource, server: Server) -> None:
    """Run the callback that the recovery or reload of a resource goes on with, unless it has to wait for its turn."""
    role = _role_of(decision.catalog, resource.id)
    if awaits_trial(decision, role, resource.id):
        return
    if role == "reload":
        run_unload_first(decision, resource)
    else:
        run_recover(decision, resource, server)


def _role_of(catalog: Catalog, resource_id: str) -> str:
    run = catalog.callback_runs.get(run_id("reload", resource_id))
    return "recover" if run is None or run_id("recover", resource_id) in catalog.callback_runs else "reload"


def run_unload_first(decision: Decision, resource: Resource) -> None:
    """Run the unload callback of a resource that is reloaded."""
    note_begun(decision, "reload", resource.id)
    decision.cause(StartCallback("reload", resource))


def end_unload_first(decision: Decision, resource_id: str) -> None:
    """Write that the unload callback of a resource that is reloaded has ended; the row of the reload stays."""
    id = run_id("reload", resource_id)
    acquit(decision, id)
    end_trial(decision, id)
    decision.put(CallbackRun(id))


def run_recover(decision: Decision, resource: Resource, server: Server) -> None:
    """Run the recover callback; without one, load the resource again, when the parts of its last load are released."""
    note_begun(decision, "recover", resource.id)
    if server.has_recover and not is_reloaded(decision.catalog, resource.id):
        decision.cause(StartCallback("recover", resource))
    else:
        resource = replace(resource, attempt=resource.attempt + 1, phase=LOADED)
        decision.put(resource)
        again = StartCallback("recover", resource, reload=True)
        release_parts(decision, resource.id, (again,), keep_attempt=resource.attempt)
    if server.recover_timeout_s is not None:
        failure = failures.recover_overdue(decision.catalog, resource, server.recover_timeout_s)
        overdue = CallbackOverdue("recover", resource.id, resource.attempt, failure)
        decision.cause(SetTimer("recover:" + resource.id, server.recover_timeout_s, overdue))


def end_reload(decision: Decision, resource_id: str, failure: Failure | None) -> None:
    """Write that a reload on demand has ended, if there is one, and answer the owner."""
    run = decision.catalog.callback_runs.get(run_id("reload", resource_id))
    if run is not None:
        decision.drop(run)
    ticket = decision.forget(decision.catalog.reloads, resource_id)
    if ticket is not None:
        decision.cause(AnswerCall(ticket, failure))


# -- the ends of pauses and resumptions; unloading.py has how they begin -----------------------------------------------


def pause_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Note that the resource is paused; it is resumed if it is needed by now. If the callback raised, it runs on.

    An idle one that nobody holds is unloaded then; one on standby is not paused again before it was needed once.
    """
    resource = running(decision.catalog, ended.resource_id, PAUSING, ended.run)
    if resource is None:
        return
    note_ended(decision, "pause", resource.id)
    if ended.failure is not None:
        decision.cause(Happened("pause_failed", resource, ended.failure.message, kept=True))
        runs_on(decision, resource)
        return
    touch(decision, resource.id)
    resource = replace(resource, phase=PAUSED)
    decision.put(resource)
    decision.cause(Happened("paused", resource, ""))
    if resource.id not in decision.catalog.holders:
        retire(decision, resource)
    else:
        _answer_owners(decision, resource)


def runs_on(decision: Decision, resource: Resource) -> None:
    """Let a resource run on that could not be paused."""
    catalog = decision.catalog
    resource = replace(resource, phase=LOADED)
    decision.put(resource)
    decision.note(catalog.idle, resource.id, True)  # no timer is set before it was needed
    _answer_loads(decision, resource)
    if resource.id not in catalog.holders:
        begin_unload(decision, resource)


def resume_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Answer all that wait for a resource that runs again; one that could not be resumed is lost."""
    catalog = decision.catalog
    resource = running(catalog, ended.resource_id, RESUMING, ended.run)
    if resource is None:
        return
    note_ended(decision, "resume", resource.id)
    if ended.failure is not None:
        not_resumed(decision, resource, ended.event, ended.failure)
        return
    touch(decision, resource.id)
    resource = replace(resource, phase=LOADED)
    decision.put(resource)
    decision.cause(Happened("resumed", resource, ""))
    if ended.response is not None and ended.response != resource.response:
        source = catalog.origin_of(resource)
        spread(decision, resource, ended.event, State.UPDATE, "resumed with a new response", source, ended.response)
        resource = catalog.resources[resource.id]
    _answer_loads(decision, resource)
    if resource.id not in catalog.holders:
        retire(decision, resource)


def _answer_loads(decision: Decision, resource: Resource) -> None:
    catalog = decision.catalog
    for query in catalog.queries_of(resource.id):
        if decision.forget(catalog.waiting, query.id) is not None:
            decision.cause(SendReply(query.origin, loaded(catalog, query.id, resource)))
    answer_wholes(decision, resource)
    _answer_owners(decision, resource)


def _answer_owners(decision: Decision, resource: Resource) -> None:
    """Answer an owner who has unloaded the resource: who holds it came after that, unless it is revoked."""
    catalog = decision.catalog
    if resource.id in catalog.holders and resource.id not in catalog.revocations:
        decision.effects += answers_to_owners(decision, resource, None)


def not_resumed(decision: Decision, resource: Resource, event: str, failure: Failure) -> None:
    """Refuse the loads that wait for a resource, and send its other holders a FATAL status."""
    catalog = decision.catalog
    resource = replace(resource, phase=LOADED)
    decision.put(resource)
    refuse_waiting(decision, resource, failure)
    _answer_loads(decision, resource)
    spread(decision, resource, event, State.FATAL, failure.message, catalog.origin_of(resource))
