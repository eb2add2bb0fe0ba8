"""What a registrar decides as a consumer: its own queries at other registrars (and at itself).

A held row's life: PENDING (asked) -> HELD (loaded) -> OWED (released, not yet confirmed) -> gone. The provider's record
is the truth: rows here are written a moment later, except OWED ones that the provider does not know of yet.
"""

from __future__ import annotations

import msgspec

from rr_actors.core import serving
from rr_actors.core.catalog import Batch
from rr_actors.core.commands import (
    Ask,
    GiveUp,
    LinkLost,
    PeerGone,
    Reconcile,
    Release,
    ReleaseOverdue,
    StatusDone,
)
from rr_actors.core.effects import Hear, LoadResolved, StartStatus, UnloadResolved
from rr_actors.core.releasing import owe, provider_lost, released, request, withdraw
from rr_actors.messages import (
    Failure,
    FetchedQuery,
    Load,
    Loaded,
    LoadRefused,
    Noticed,
    NoticesHandled,
    Unload,
    Unloaded,
    UnloadRefused,
)
from rr_actors.records import Held, Hold, Notice, Peer, Phase, State

_replace = msgspec.structs.replace
_HEARD_LIMIT = 20_000


# -- load ------------------------------------------------------------------------------------------------------------


def ask(batch: Batch, command: Ask) -> None:
    """Ask a provider for something. That it is one of ours to look for after a crash is on disk before."""
    catalog = batch.catalog
    attempt = 0
    parent = command.parent
    if parent:
        resource = catalog.resources.get(parent)
        if resource is None:
            held = _pending(command, 0, 0)
            text = f"{command.registrar}/{command.server}: the resource {parent} that asks for it is gone"
            batch.cause(LoadResolved(held, Failure("LoadError", text, {"server": f"{held.registrar}/{held.server}"})))
            return
        attempt = resource.attempt
    held = _pending(command, attempt, catalog.next_seq())
    if command.registrar not in catalog.peers:
        batch.put(Peer(command.registrar))
    batch.put_later(held)
    request(batch, held.registrar, _load(batch, held))


def _pending(command: Ask, attempt: int, seq: int) -> Held:
    place = (command.registrar, command.server, command.request, None, "")
    return Held(command.query_id, *place, command.parent, attempt, seq, Hold.PENDING, State.OK)


def _load(batch: Batch, held: Held) -> Load:
    return Load(held.id, held.server, held.request, batch.catalog.name, held.parent, held.attempt, held.seq)


def loaded(batch: Batch, provider: str, message: Loaded) -> None:
    """The query is ours. One that we do not know of is let go again."""
    held = batch.catalog.held.get(message.query_id)
    if held is None:
        request(batch, provider, Unload(message.query_id, batch.catalog.name))
    elif held.hold is Hold.PENDING:
        held = _replace(held, hold=Hold.HELD, resource_id=message.resource_id, response=message.response)
        batch.put_later(held)
        batch.cause(LoadResolved(held, None))


def load_refused(batch: Batch, message: LoadRefused) -> None:
    """The query does not exist."""
    held = batch.catalog.held.get(message.query_id)
    if held is None:
        return
    if held.hold is Hold.PENDING:
        batch.drop_later(held)
        batch.cause(LoadResolved(held, message.failure))
    elif held.hold is Hold.OWED:
        _is_released(batch, held)


def give_up(batch: Batch, command: GiveUp) -> None:
    """Withdraw a load that is not answered yet."""
    held = batch.catalog.held.get(command.query_id)
    if held is not None and held.hold is Hold.PENDING:
        withdraw(batch, held, command.failure)


# -- unload ----------------------------------------------------------------------------------------------------------


def release(batch: Batch, command: Release) -> None:
    """Let a query go."""
    held = batch.catalog.held.get(command.query_id)
    if held is None or held.hold is Hold.OWED:
        name = batch.catalog.name
        text = f"query {command.query_id}: {name!r} holds no such query (never did, or it is unloaded already)"
        batch.cause(UnloadResolved(command.query_id, Failure("UnknownQuery", text, {"query_id": command.query_id})))
        return
    if held.hold is Hold.PENDING:
        text = f"{held.registrar}/{held.server}: unloaded while it was loading"
        batch.cause(LoadResolved(held, Failure("LoadError", text, {"server": f"{held.registrar}/{held.server}"})))
    batch.put_later(_replace(held, hold=Hold.OWED))
    request(batch, held.registrar, Unload(held.id, batch.catalog.name))


def release_overdue(batch: Batch, command: ReleaseOverdue) -> None:
    """The provider has not answered: see to it that the release is on disk before the caller goes on."""
    held = batch.catalog.held.get(command.query_id)
    if held is not None:
        batch.put(_replace(held, hold=Hold.OWED))
        batch.cause(UnloadResolved(command.query_id, command.failure))


def unloaded(batch: Batch, message: Unloaded) -> None:
    """A release is done."""
    held = batch.catalog.held.get(message.query_id)
    if held is not None and held.hold is Hold.OWED:
        _is_released(batch, held)


def _is_released(batch: Batch, held: Held) -> None:
    batch.drop_later(held)
    batch.cause(UnloadResolved(held.id, None))
    released(batch, held.id)


def unload_refused(batch: Batch, message: UnloadRefused) -> None:
    """The unload callback raised there: the query is ours again, unless nobody is left who could want it.

    What a resource that is gone still owes stays owed; it is sent again with the next link.
    """
    catalog = batch.catalog
    held = catalog.held.get(message.query_id)
    if held is None or held.hold is not Hold.OWED:
        return
    if not held.parent or held.parent in catalog.resources:
        batch.put_later(_replace(held, hold=Hold.HELD))
    batch.cause(UnloadResolved(held.id, message.failure))
    released(batch, held.id)


# -- status ----------------------------------------------------------------------------------------------------------


def noticed(batch: Batch, provider: str, message: Noticed) -> None:
    """A status for one of our queries."""
    held = batch.catalog.held.get(message.notice.query_id)
    if held is None or held.hold is Hold.OWED:
        request(batch, provider, NoticesHandled([message.notice.id]))
    else:
        _hear(batch, held, message.notice, provider, message.repeated)


def _hear(batch: Batch, held: Held, notice: Notice, provider: str, repeated: bool = False) -> None:
    """Tell who listens to the query; then the resource that depends on it, once however many ways the status took."""
    catalog = batch.catalog
    first = (held.id, notice.event) not in catalog.heard
    if first:
        _remember(batch, (held.id, notice.event))
        response = held.response if notice.response is None else notice.response
        if notice.released:
            batch.drop_later(held)
        else:
            batch.put_later(_replace(held, state=notice.state, response=response))
        batch.cause(Hear(held, notice, repeated))
    resource = catalog.resources.get(held.parent)
    if resource is None:
        _handled(batch, provider, notice)
        return
    place = (resource.id, notice.event)
    pending = catalog.heard.get(place)
    if pending is not None:  # by another way of the diamond, or sent again
        if pending:
            batch.note(catalog.heard, place, (*pending, (provider, notice.id)))
        else:
            _handled(batch, provider, notice)
        return
    server = catalog.servers.get(resource.server)
    if server is not None and server.has_status:
        batch.note(catalog.heard, place, ((provider, notice.id),))
        batch.cause(StartStatus(resource, notice, provider))
        return
    _remember(batch, place)
    serving.spread(batch, resource, notice.event, notice.state, notice.message, notice.source)
    _handled(batch, provider, notice)


def _remember(batch: Batch, place: tuple[str, str]) -> None:
    heard = batch.catalog.heard
    batch.note(heard, place, ())
    if len(heard) > _HEARD_LIMIT:
        for old in list(heard)[: _HEARD_LIMIT // 2]:
            if not heard[old]:
                del heard[old]  # so old that its notice was acknowledged long ago


def _handled(batch: Batch, provider: str, notice: Notice) -> None:
    if provider:
        request(batch, provider, NoticesHandled([notice.id]))


def status_done(batch: Batch, done: StatusDone) -> None:
    """The resource's status callback has run: pass the status on unless it was dealt with, then acknowledge it."""
    catalog = batch.catalog
    notice = done.notice
    place = (done.resource_id, notice.event)
    pending = catalog.heard.get(place) or ((done.provider, notice.id),)
    _remember(batch, place)
    resource = catalog.resources.get(done.resource_id)
    if resource is not None and not done.handled:
        serving.spread(batch, resource, notice.event, notice.state, notice.message, notice.source)
    for provider, notice_id in pending:
        if provider:
            request(batch, provider, NoticesHandled([notice_id]))


# -- links to providers ----------------------------------------------------------------------------------------------


def reconcile(batch: Batch, command: Reconcile) -> None:
    """A provider is back, or we are: agree on what we hold there, then send everything open again."""
    catalog = batch.catalog
    batch.note(catalog.up, command.registrar, command.epoch)
    theirs = {query.query_id for query in command.queries}
    for query in command.queries:
        _agree(batch, command.registrar, query)
    open_ids = sorted(catalog.outbound.get(command.registrar, ()), key=lambda id: catalog.held[id].seq)
    owed: list[Held] = []
    for id in open_ids:
        held = catalog.held[id]
        if held.hold is Hold.PENDING:
            request(batch, held.registrar, _load(batch, held))
        elif held.hold is Hold.OWED:
            owed.append(held)
        elif id not in theirs:
            _lose(batch, held, command.event, f"{held.registrar!r} does not have it any more")
    for held in reversed(owed):
        request(batch, held.registrar, Unload(held.id, catalog.name))


def _agree(batch: Batch, registrar: str, query: FetchedQuery) -> None:
    """One query of ours in a provider's catalog."""
    catalog = batch.catalog
    held = catalog.held.get(query.query_id)
    if held is None:
        parent = catalog.resources.get(query.parent)
        wanted = not query.parent or (parent is not None and parent.attempt == query.attempt)
        hold = Hold.OWED if not wanted else Hold.PENDING if query.response is None else Hold.HELD
        place = (registrar, query.server, query.request, query.response, query.resource_id)
        row = Held(query.query_id, *place, query.parent, query.attempt, query.seq, hold, State(query.state))
        catalog.seq = max(catalog.seq, query.seq)
        batch.put_later(row)
    elif held.hold is Hold.PENDING and query.response is not None:
        loaded(batch, registrar, Loaded(query.query_id, query.resource_id, query.response))
    elif held.hold is Hold.HELD and not held.resource_id:
        batch.put_later(_replace(held, resource_id=query.resource_id))


def _lose(batch: Batch, held: Held, event: str, why: str) -> None:
    """What we held is there no more: whoever depends on it hears FATAL, once for all that is lost with a provider."""
    source = f"{held.registrar}/{held.server}"
    place = (held.id, "", held.resource_id, event, State.FATAL, why, source, True)
    notice = Notice(f"{event}:{held.id}", *place)
    _hear(batch, held, notice, "")


def link_lost(batch: Batch, command: LinkLost) -> None:
    """Nothing is sent to this provider until it is reconciled again."""
    catalog = batch.catalog
    batch.forget(catalog.up, command.registrar)
    provider_lost(batch, command.registrar)


def peer_gone(batch: Batch, command: PeerGone) -> None:
    """A provider cannot be reached: who waits for a load hears at once; what is gone for good is lost."""
    catalog = batch.catalog
    for id in list(catalog.outbound.get(command.registrar, ())):
        held = catalog.held.get(id)
        if held is None:
            continue
        if held.hold is Hold.PENDING:
            batch.cause(LoadResolved(held, command.failure))
            if command.final:
                batch.drop_later(held)
            else:
                batch.put(_replace(held, hold=Hold.OWED))  # it may have had the request before it stopped
        elif not command.final:
            continue
        elif held.hold is Hold.OWED:
            _is_released(batch, held)
        else:
            _lose(batch, held, command.event, command.failure.message)
    if command.final and command.registrar not in catalog.outbound and command.registrar in catalog.peers:
        batch.drop(catalog.peers[command.registrar])


def begin_again(batch: Batch) -> None:
    """At the start of an incarnation: nobody waits any more, and interrupted loads start clean."""
    catalog = batch.catalog
    for held in list(catalog.held.values()):
        parent = catalog.resources.get(held.parent)
        if held.hold is Hold.PENDING:
            batch.drop_later(held)  # if the provider has it, reconciling brings it back or releases it
        elif held.hold is Hold.HELD and held.parent and (parent is None or parent.phase is Phase.LOADING):
            owe(batch, held)
