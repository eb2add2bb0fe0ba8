"""What a registrar decides as a provider: its resources, and the queries others hold on them.

A resource's life, by phase::

    (request) ─> LOADING ─> LOADED ─> UNLOADING ─> (gone)
         │          │ failed           │ failed
         │          └─> (gone)         └─> UNLOAD_FAILED ─> UNLOADING ...
         └─> QUEUED, while one of the same request is UNLOADING, then LOADING

FATAL is a status, not a phase: such a resource stays with those who hold it and is not found by new requests.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rr_actors.core.catalog import Batch
from rr_actors.core.commands import (
    ForceUnload,
    LingerOver,
    LoadDone,
    LoadErred,
    LoadOverdue,
    SetResponse,
    SetStatus,
    UnloadDone,
    UnloadErred,
    Unregister,
)
from rr_actors.core.effects import Answer, Effect, Happened, Reply, SetTimer, StartLoad, StartUnload
from rr_actors.core.releasing import release_parts, request, withdraw
from rr_actors.messages import (
    Failure,
    Fetch,
    Fetched,
    FetchedQuery,
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Noticed,
    NoticesHandled,
    Probe,
    Unload,
    Unloaded,
    UnloadRefused,
)
from rr_actors.records import Hold, Notice, Phase, Query, Resource, State

_replace = msgspec.structs.replace
_FETCH_CHUNK = 500
_RING_LIMIT = 256


# -- load ------------------------------------------------------------------------------------------------------------


def load(batch: Batch, message: Load) -> None:
    """Join the resource of an identical request, or begin a new one. `message.request` is canonical."""
    catalog = batch.catalog
    known = catalog.queries.get(message.query_id)
    if known is not None:
        _load_again(batch, message, known)
        return
    server = message.server
    if server not in catalog.servers or server in catalog.leaving:
        batch.cause(Reply(message.origin, LoadRefused(message.query_id, _unknown_server(batch, server))))
        return
    key = (server, message.request)
    resource_id = catalog.by_request.get(key)
    if resource_id is None:
        _load_first(batch, message)
        return
    if resource_id in catalog.recovering:
        _park(batch, resource_id, message)
        return
    resource = catalog.resources[resource_id]
    alone = resource_id not in catalog.holders
    batch.put(
        Query(message.query_id, resource_id, message.origin, message.parent, message.attempt, message.seq),
    )
    if resource.phase is Phase.LOADED:
        if alone:
            batch.cause(SetTimer("linger:" + resource_id, None, None))
        response = resource.response or b""
        batch.cause(Reply(message.origin, Loaded(message.query_id, resource_id, response)))
        return
    batch.note(catalog.waiting, message.query_id, resource_id)
    if alone and resource.phase is Phase.LOADING:
        _limit_load(batch, resource)
    if message.parent:
        chase(batch, resource, Probe(message.query_id, message.parent, message.query_id, []))


def _load_first(batch: Batch, message: Load) -> None:
    queued = (message.server, message.request) in batch.catalog.unloading
    phase = Phase.QUEUED if queued else Phase.LOADING
    resource = Resource(message.query_id, message.server, message.request, None, phase, State.OK, "", 1)
    batch.put(resource)
    batch.put(Query(message.query_id, resource.id, message.origin, message.parent, message.attempt, message.seq))
    batch.note(batch.catalog.waiting, message.query_id, resource.id)
    if not queued:
        start_load(batch, resource)


def _load_again(batch: Batch, message: Load, query: Query) -> None:
    """The same query once more: its answer was lost, or is still to come."""
    catalog = batch.catalog
    resource = catalog.resources[query.resource_id]
    if resource.id in catalog.recovering:
        _park(batch, resource.id, message)
    elif resource.phase in (Phase.LOADING, Phase.QUEUED):
        batch.note(catalog.waiting, query.id, resource.id)
    else:
        batch.cause(Reply(query.origin, Loaded(query.id, resource.id, resource.response or b"")))


def start_load(batch: Batch, resource: Resource) -> None:
    """Have the load callback run; without its server (yet) the resource waits for it to be registered."""
    if resource.server in batch.catalog.servers:
        batch.cause(StartLoad(resource))
        _limit_load(batch, resource)


def _limit_load(batch: Batch, resource: Resource) -> None:
    server = batch.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        name = batch.catalog.origin_of(resource)
        text = f"{name}: the load callback took longer than load_timeout_s={server.load_timeout_s:g} s"
        details: dict[str, Any] = {"server": name, "timeout_s": server.load_timeout_s}
        failure = Failure("LoadFailed", text, details, [(name, text)])
        overdue = LoadOverdue(resource.id, resource.attempt, failure)
        batch.cause(SetTimer("load:" + resource.id, server.load_timeout_s, overdue))


def load_done(batch: Batch, done: LoadDone) -> None:
    """Answer everybody who waits; if nobody does any more, release what came too late."""
    catalog = batch.catalog
    resource = _running(batch, done.resource_id, Phase.LOADING, done.attempt)
    if resource is None:
        return
    resource = _replace(resource, phase=Phase.LOADED, response=done.response)
    batch.put(resource)
    _end_limit(batch, resource)
    batch.cause(Happened("loaded", resource.id, resource.server, ""))
    holders = catalog.holders.get(resource.id)
    if not holders:
        retire(batch, resource)
        return
    for query_id in holders:
        if batch.forget(catalog.waiting, query_id) is not None:
            reply = Loaded(query_id, resource.id, done.response)
            batch.cause(Reply(catalog.queries[query_id].origin, reply))


def load_erred(batch: Batch, erred: LoadErred) -> None:
    """Leave nothing behind: the resource, its queries and what the callback had loaded go; then everybody hears."""
    catalog = batch.catalog
    resource = _running(batch, erred.resource_id, Phase.LOADING, erred.attempt)
    if resource is None:
        return
    after: list[Effect] = []
    for query in _queries_of(batch, resource):
        batch.forget(catalog.waiting, query.id)
        batch.drop(query)
        after.append(Reply(query.origin, LoadRefused(query.id, erred.failure)))
    after += _owners(batch, resource, None)
    batch.drop(resource)
    _end_limit(batch, resource)
    batch.cause(Happened("load_failed", resource.id, resource.server, erred.failure.message))
    release_parts(batch, resource.id, after)
    _settle(batch, resource.server, None)


def load_overdue(batch: Batch, overdue: LoadOverdue) -> None:
    """Refuse everybody who waits; the callback goes on, and what it brings is unloaded when it comes."""
    catalog = batch.catalog
    resource = _running(batch, overdue.resource_id, Phase.LOADING, overdue.attempt)
    if resource is None:
        return
    for query in _queries_of(batch, resource):
        batch.forget(catalog.waiting, query.id)
        batch.drop(query)
        batch.cause(Reply(query.origin, LoadRefused(query.id, overdue.failure)))


# -- unload ----------------------------------------------------------------------------------------------------------


def unload(batch: Batch, message: Unload) -> None:
    """Let one query go, and the resource with the last of them."""
    query = batch.catalog.queries.get(message.query_id)
    if query is None:
        batch.cause(Reply(message.origin, Unloaded(message.query_id)))
    elif query.origin != message.origin:
        text = f"query {query.id}: held by {query.origin!r}, not by {message.origin!r}"
        failure = Failure("NotHolder", text, {"query_id": query.id, "origin": query.origin, "caller": message.origin})
        batch.cause(Reply(message.origin, UnloadRefused(message.query_id, failure)))
    elif query.resource_id in batch.catalog.recovering:
        _park(batch, query.resource_id, message)
    else:
        _let_go(batch, query)


def _let_go(batch: Batch, query: Query) -> None:
    catalog = batch.catalog
    resource = catalog.resources[query.resource_id]
    last = len(catalog.holders[resource.id]) == 1
    batch.forget(catalog.waiting, query.id)
    if last and resource.phase is Phase.UNLOADING:
        return  # asked again: answered when it is done
    if last and resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED) and not _lingers(batch, resource):
        begin_unload(batch, resource)  # the query goes with the resource, and its holder is answered then
        return
    batch.drop(query)
    batch.cause(Reply(query.origin, Unloaded(query.id)))
    if last:
        _unheld(batch, resource)


def _unheld(batch: Batch, resource: Resource) -> None:
    """Nobody holds the resource any more."""
    if resource.phase is Phase.QUEUED:
        batch.drop(resource)
        _settle(batch, resource.server, None)
    elif resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED):
        retire(batch, resource)


def _lingers(batch: Batch, resource: Resource) -> bool:
    server = batch.catalog.servers.get(resource.server)
    warm = resource.phase is Phase.LOADED and resource.state is not State.FATAL
    wanted = resource.id not in batch.catalog.owners and resource.server not in batch.catalog.leaving
    return server is not None and server.linger_s > 0 and warm and wanted


def retire(batch: Batch, resource: Resource) -> None:
    """Keep an unheld resource warm, if its server says so, or unload it."""
    if _lingers(batch, resource):
        linger_s = batch.catalog.servers[resource.server].linger_s
        batch.cause(SetTimer("linger:" + resource.id, linger_s, LingerOver(resource.id)))
    else:
        begin_unload(batch, resource)


def linger_over(batch: Batch, over: LingerOver) -> None:
    """Unload what nobody came back for."""
    resource = batch.catalog.resources.get(over.resource_id)
    if resource is not None and resource.phase is Phase.LOADED and resource.id not in batch.catalog.holders:
        begin_unload(batch, resource)


def begin_unload(batch: Batch, resource: Resource) -> None:
    """Have the unload callback run."""
    resource = _replace(resource, phase=Phase.UNLOADING, tries=resource.tries + 1)
    batch.put(resource)
    batch.cause(SetTimer("linger:" + resource.id, None, None))
    if resource.server in batch.catalog.servers:
        batch.cause(StartUnload(resource))


def unload_done(batch: Batch, done: UnloadDone) -> None:
    """The resource is gone: release what it held, answer who waits, let a queued load of the same request begin."""
    resource = _running(batch, done.resource_id, Phase.UNLOADING, done.tries)
    if resource is None:
        return
    after: list[Effect] = []
    for query in _queries_of(batch, resource):
        batch.drop(query)
        after.append(Reply(query.origin, Unloaded(query.id)))
    after += _owners(batch, resource, None)
    batch.drop(resource)
    batch.cause(Happened("unloaded", resource.id, resource.server, ""))
    release_parts(batch, resource.id, after)
    _start_queued(batch, resource)
    _settle(batch, resource.server, None)


def unload_erred(batch: Batch, erred: UnloadErred) -> None:
    """Keep the resource, as it may still be running, and tell whoever unloaded it."""
    resource = _running(batch, erred.resource_id, Phase.UNLOADING, erred.tries)
    if resource is None:
        return
    batch.put(_replace(resource, phase=Phase.UNLOAD_FAILED, message=erred.failure.message))
    batch.cause(Happened("unload_failed", resource.id, resource.server, erred.failure.message))
    for query in _queries_of(batch, resource):
        batch.cause(Reply(query.origin, UnloadRefused(query.id, erred.failure)))
    for answer in _owners(batch, resource, erred.failure):
        batch.cause(answer)
    _start_queued(batch, resource)
    _settle(batch, resource.server, erred.failure)


def _start_queued(batch: Batch, gone: Resource) -> None:
    catalog = batch.catalog
    key = (gone.server, gone.request)
    queued = catalog.resources.get(catalog.by_request.get(key, ""))
    if queued is not None and queued.phase is Phase.QUEUED and key not in catalog.unloading:
        queued = _replace(queued, phase=Phase.LOADING)
        batch.put(queued)
        start_load(batch, queued)


def force_unload(batch: Batch, command: ForceUnload) -> None:
    """Take the resource from everybody who holds it; the owner is answered when it is gone."""
    resource = find_target(batch, command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, _unknown_target(batch, command.target)))
        return
    waiting = batch.catalog.owners.get(resource.id, ())
    batch.note(batch.catalog.owners, resource.id, (*waiting, command.ticket))
    _evict(batch, resource, command.event, "unloaded by its owner")


def _evict(batch: Batch, resource: Resource, event: str, why: str) -> None:
    origin = batch.catalog.origin_of(resource)
    for query in _queries_of(batch, resource):
        batch.drop(query)
        if batch.forget(batch.catalog.waiting, query.id) is not None:
            refusal = Failure("LoadFailed", f"{origin}: {why}", {"server": origin}, [(origin, why)])
            batch.cause(Reply(query.origin, LoadRefused(query.id, refusal)))
        elif resource.phase is Phase.UNLOADING:
            batch.cause(Reply(query.origin, Unloaded(query.id)))
        else:
            notify(batch, query, event, State.FATAL, why, origin, released=True)
    if resource.phase is Phase.QUEUED:
        for answer in _owners(batch, resource, None):
            batch.cause(answer)
        batch.drop(resource)
    elif resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED):
        begin_unload(batch, resource)


def unregister(batch: Batch, command: Unregister, event: str) -> None:
    """Take no more loads and release every query; the owner is answered when all resources are gone."""
    catalog = batch.catalog
    if command.name not in catalog.servers or command.name in catalog.leaving:
        batch.cause(Answer(command.ticket, _unknown_server(batch, command.name)))
        return
    batch.note(catalog.leaving, command.name, command.ticket)
    for resource_id in list(catalog.by_server.get(command.name, ())):
        _evict(batch, catalog.resources[resource_id], event, f"server {command.name!r} was unregistered")
    _settle(batch, command.name, None)


def _settle(batch: Batch, server: str, failure: Failure | None) -> None:
    """A server that is leaving has left when nothing of it is in motion."""
    catalog = batch.catalog
    if server not in catalog.leaving:
        return
    left = [catalog.resources[id] for id in catalog.by_server.get(server, ())]
    if all(resource.phase is Phase.UNLOAD_FAILED for resource in left):
        ticket = batch.forget(catalog.leaving, server)
        batch.forget(catalog.servers, server)
        batch.cause(Answer(ticket, failure))


def gone(batch: Batch, message: Gone) -> None:
    """Release everything a registrar held that will not come back."""
    catalog = batch.catalog
    for notice_id in list(catalog.notices_to.get(message.origin, ())):
        batch.drop(catalog.notices[notice_id])
    for query_id in list(catalog.by_origin.get(message.origin, ())):
        query = catalog.queries.get(query_id)
        if query is None:
            continue
        resource = catalog.resources[query.resource_id]
        batch.forget(catalog.waiting, query.id)
        batch.drop(query)
        if resource.id not in catalog.holders and resource.id not in catalog.recovering:
            _unheld(batch, resource)


# -- status ----------------------------------------------------------------------------------------------------------


def spread(
    batch: Batch,
    resource: Resource,
    event: str,
    state: State,
    message: str,
    source: str,
    response: bytes | None = None,
) -> None:
    """Note a status on the resource and tell every holder, once each."""
    lasting = State.FATAL if resource.state is State.FATAL else state
    resource = _replace(
        resource,
        state=lasting,
        message=message,
        response=resource.response if response is None else response,
    )
    batch.put(resource)
    batch.cause(Happened("status", resource.id, resource.server, f"{state} {message}".rstrip()))
    for query in _queries_of(batch, resource):
        notify(batch, query, event, state, message, source, response=response)
    loaded = resource.phase is Phase.LOADED and resource.id not in batch.catalog.recovering
    if lasting is State.FATAL and loaded and resource.id not in batch.catalog.holders:
        begin_unload(batch, resource)  # it lingered; nobody will be given it again


def notify(
    batch: Batch,
    query: Query,
    event: str,
    state: State,
    message: str,
    source: str,
    *,
    released: bool = False,
    response: bytes | None = None,
) -> None:
    """Put a status on its way to the query's holder; it stays on disk until the holder has dealt with it."""
    id = f"{event}:{query.id}"
    notice = Notice(id, query.id, query.origin, query.resource_id, event, state, message, source, released, response)
    batch.put(notice)
    _send_notice(batch, notice)


def _send_notice(batch: Batch, notice: Notice) -> None:
    catalog = batch.catalog
    if notice.origin in catalog.consumers:
        repeated = notice.id in catalog.told
        batch.note(catalog.told, notice.id, True)
        batch.cause(Reply(notice.origin, Noticed(notice, repeated)))


def set_status(batch: Batch, command: SetStatus) -> None:
    """The owner's word on a resource, to all who hold it."""
    resource = find_target(batch, command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, _unknown_target(batch, command.target)))
        return
    source = batch.catalog.origin_of(resource)
    spread(batch, resource, command.event, command.state, command.message, source)
    batch.cause(Answer(command.ticket, None))


def set_response(batch: Batch, command: SetResponse) -> None:
    """A late response: the stored one is replaced, every holder hears UPDATE with it."""
    resource = find_target(batch, command.target)
    if resource is None:
        batch.cause(Answer(command.ticket, _unknown_target(batch, command.target)))
    elif resource.phase in (Phase.LOADING, Phase.QUEUED):
        text = f"resource {resource.id}: still loading, its response is what the load callback returns"
        batch.cause(Answer(command.ticket, Failure("UsageError", text)))
    else:
        source = batch.catalog.origin_of(resource)
        spread(batch, resource, command.event, State.UPDATE, command.message, source, command.response)
        batch.cause(Answer(command.ticket, None))


def notices_handled(batch: Batch, message: NoticesHandled) -> None:
    """The holder has dealt with these."""
    for id in message.ids:
        notice = batch.catalog.notices.get(id)
        if notice is not None:
            batch.drop(notice)
            batch.forget(batch.catalog.told, id)


# -- what a consumer asks about itself -------------------------------------------------------------------------------


def fetch(batch: Batch, message: Fetch) -> None:
    """List the consumer's queries; on a new link (`resume`) send the notices it has not dealt with behind them."""
    catalog = batch.catalog
    queries = [catalog.queries[id] for id in catalog.by_origin.get(message.origin, ())]
    rows: list[FetchedQuery] = []
    for query in queries:
        resource = catalog.resources[query.resource_id]
        waits = resource.phase in (Phase.LOADING, Phase.QUEUED)
        response = None if waits else resource.response or b""
        place = (query.parent, query.attempt, query.seq, str(resource.state))
        rows.append(FetchedQuery(query.id, resource.server, resource.id, resource.request, response, *place))
    chunks = [rows[i : i + _FETCH_CHUNK] for i in range(0, len(rows), _FETCH_CHUNK)] or [[]]
    for i, chunk in enumerate(chunks):
        batch.cause(Reply(message.origin, Fetched(chunk, more=i < len(chunks) - 1)))
    if message.resume:
        batch.note(catalog.consumers, message.origin, True)
        for notice_id in list(catalog.notices_to.get(message.origin, ())):
            _send_notice(batch, catalog.notices[notice_id])


def probe(batch: Batch, message: Probe) -> None:
    """Pass a probe on along everything the query's resource waits for; at the waiter itself it has found a ring."""
    query = batch.catalog.queries.get(message.query_id)
    if query is not None:
        chase(batch, batch.catalog.resources[query.resource_id], message)


def chase(batch: Batch, resource: Resource, message: Probe) -> None:
    """Edge chasing: see messages.Probe."""
    catalog = batch.catalog
    ring = [*message.ring, catalog.origin_of(resource)]
    if resource.phase not in (Phase.LOADING, Phase.QUEUED) or len(ring) > _RING_LIMIT:
        return
    if resource.id == message.waiter:
        blocked = catalog.held.get(message.blocked)
        if blocked is not None and blocked.hold is Hold.PENDING:
            withdraw(batch, blocked, _circular(ring))
        return
    for held_id in catalog.parts_of(resource.id):
        held = catalog.held[held_id]
        if held.hold is Hold.PENDING:
            request(batch, held.registrar, Probe(held.id, message.waiter, message.blocked, ring))


def _circular(ring: list[str]) -> Failure:
    names = [*ring, ring[0]]
    return Failure("CircularDependency", f"a load would wait for itself: {' -> '.join(names)}", {"ring": ring})


# -- shared ----------------------------------------------------------------------------------------------------------


def find_target(batch: Batch, target: str) -> Resource | None:
    """The resource with this id, or the one the query with this id is on."""
    resource = batch.catalog.resources.get(target)
    if resource is None:
        query = batch.catalog.queries.get(target)
        resource = batch.catalog.resources[query.resource_id] if query is not None else None
    return resource


def _running(batch: Batch, resource_id: str, phase: Phase, run: int) -> Resource | None:
    """The resource, if it is still that run of its callback that has ended."""
    resource = batch.catalog.resources.get(resource_id)
    if resource is None or resource.phase is not phase:
        return None
    return resource if run == (resource.tries if phase is Phase.UNLOADING else resource.attempt) else None


def _queries_of(batch: Batch, resource: Resource) -> list[Query]:
    return [batch.catalog.queries[id] for id in batch.catalog.holders.get(resource.id, ())]


def _owners(batch: Batch, resource: Resource, failure: Failure | None) -> list[Effect]:
    return [Answer(ticket, failure) for ticket in batch.forget(batch.catalog.owners, resource.id) or ()]


def _end_limit(batch: Batch, resource: Resource) -> None:
    server = batch.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        batch.cause(SetTimer("load:" + resource.id, None, None))


def _park(batch: Batch, resource_id: str, message: Any) -> None:
    parked = batch.catalog.recovering[resource_id]
    batch.note(batch.catalog.recovering, resource_id, (*parked, message))


def _unknown_server(batch: Batch, server: str) -> Failure:
    catalog = batch.catalog
    known = sorted(name for name in catalog.servers if name not in catalog.leaving)
    text = (
        f"{catalog.name}/{server}: registrar {catalog.name!r} has no such server; it has {', '.join(known) or 'none'}"
    )
    return Failure("UnknownServer", text, {"server": f"{catalog.name}/{server}", "known": known})


def _unknown_target(batch: Batch, target: str) -> Failure:
    text = (
        f"{target}: {batch.catalog.name!r} serves no resource and no query of this id (never did, or unloaded already)"
    )
    return Failure("UnknownQuery", text, {"query_id": target})
