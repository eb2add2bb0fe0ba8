"""The decisions of consumer and provider when the link between them opens and breaks, and when a lease is over.

A lease is between two hosts (docs/decisions/0110-leases-between-hosts.md). Both sides decide for themselves: the
registrars of the consumer's host have taken what they hold as lost, before the provider's host releases it.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import groupby
from operator import attrgetter

from msgspec.structs import replace

from rr_actors.base.names import CONNECTED
from rr_actors.registrar.core.holding import asked_anew, end_release, load_of, loaded, lose
from rr_actors.registrar.core.loads.lines import look_again
from rr_actors.registrar.core.loads.loading import is_to_run
from rr_actors.registrar.core.notices import drop_notice, drop_parked, send_notices_to
from rr_actors.registrar.core.priorities import follow, tell, tell_unsent
from rr_actors.registrar.core.releasing import add_all_in_flight, look_there, provider_lost, released
from rr_actors.registrar.core.unloading import gone
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.catalog import Decision
from rr_actors.registrar.model.commands import (
    BeginClosing,
    ConsumerLost,
    EndClosing,
    LeaseOver,
    LinkLost,
    PeerGone,
    Reconcile,
)
from rr_actors.registrar.model.effects import Connect, LoadResolved, SendReply, SendRequest, UnloadResolved
from rr_actors.registrar.model.messages import Fetch, Fetched, FetchedQuery, Gone, Leased, Loaded, Released, Unload
from rr_actors.registrar.model.rows import Held, Hold, State
from rr_actors.registrar.model.store import is_needed

# -- as a consumer -------------------------------------------------------------------------------------------------
#
# The provider's list says which of our queries it has. Our own rows of this incarnation say which of these we want: we
# may have released some since.


def reconcile(decision: Decision, command: Reconcile) -> None:
    """Agree with a provider, over a new link, on the queries held there; then send all open messages again."""
    catalog = decision.catalog
    if catalog.in_flight:
        add_all_in_flight(decision, command.registrar)  # the provider may have dropped those sent before this link
    decision.note(catalog.up, command.registrar, command.link)
    decision.note(catalog.listed, command.registrar, command.run)
    theirs = {query.query_id for query in command.queries}
    for held in catalog.unsettled_at(command.registrar):
        if held.hold is Hold.PENDING and held.resource_id:
            # An earlier link brought this. It may have lost the news that the query was taken away. The list is newer:
            # if it does not have the query, the query is loaded anew.
            decision.put_here(asked_anew(held))
    for query in command.queries:
        _agree(decision, command.registrar, query)
    decision.note(catalog.agreed, command.registrar, True)
    if command.notices:  # if this link is lost before them, they come over the next, and then the provider forgets them
        decision.note(catalog.acked, command.registrar, True)
    if command.registrar not in catalog.peers:  # the list has brought the first row there, or a thread's line does
        look_there(decision, command.registrar)
    agreed, differing = digests.split(catalog, command.registrar, command.same)
    for held in agreed:
        decision.forget(catalog.kept, held.id)
    for held in differing:
        if held.id not in theirs and catalog.fresh.get(held.id) != command.run:
            kept = held.id in catalog.kept  # the answer to the second try was lost
            why = "unloaded after all" if kept else f"{held.registrar!r} does not have it any more"
            lose(decision, held, command.event, why)
    for id in list(catalog.fresh):
        if id not in catalog.held or catalog.held[id].registrar == command.registrar:
            decision.forget(catalog.fresh, id)
    if catalog.unsent or catalog.rising:
        tell_unsent(decision, command.registrar)
    _send_open(decision, command.registrar)


def _send_open(decision: Decision, provider: str) -> None:
    """Send open Loads and Unloads in the order of the calls; among Unloads in a row, that of the newest query first.

    A load may need what was released before it, and a resource stays loaded if it was asked for again before that.
    """
    for hold, rows in groupby(decision.catalog.unsettled_at(provider), attrgetter("hold")):
        if hold is Hold.PENDING:
            for held in rows:
                decision.request(provider, load_of(decision, held))
        else:
            for held in sorted(rows, key=attrgetter("seq"), reverse=True):
                decision.request(provider, Unload(held.id, decision.catalog.name))


def _agree(decision: Decision, registrar: str, query: FetchedQuery) -> None:
    """Take over what a provider's list says of one query."""
    held = decision.catalog.held.get(query.query_id)
    if held is not None and held.hold is not Hold.PENDING and held.priority != query.priority:
        tell(decision, held)
    if held is None:
        _take_back(decision, registrar, query)
    elif held.hold is Hold.PENDING and query.response is not None and not query.waits:  # else its Load is sent again
        decision.put_here(replace(held, state=State(query.state)))
        loaded(decision, registrar, Loaded(query.query_id, query.resource_id, query.response))
    elif held.hold is Hold.HELD and query.response is not None:
        now = replace(
            held,
            request=query.request,
            resource_id=query.resource_id,
            response=query.response,
            state=State(query.state),
        )
        decision.forget(decision.catalog.kept, held.id)
        if now != held:  # a crash came after a status was acknowledged, and before the row was written
            decision.put_later(now)


def _take_back(decision: Decision, registrar: str, query: FetchedQuery) -> None:
    """Add a row for a query that only the provider knows: hold it again, or release it.

    It may be from before a crash, its row not written yet; or the provider missed its release. It is released in five
    cases. It has no response: then its load was never acknowledged. It is of an earlier attempt of its parent: the
    parent does not have it any more. It is of this incarnation: then we have released it, as otherwise we would have
    its row. This registrar was closed since: that releases what a provider has that was away then, except for the parts
    of a resource that could not be unloaded. This registrar is a client's, which begins anew in each run of the
    system: a program that reconnects loads what it still wants.
    """
    catalog = decision.catalog
    peer = catalog.peers.get(registrar)
    parent = catalog.resources.get(query.parent)
    kept = not query.parent or (parent is not None and parent.attempt == query.attempt)
    wanted = kept and query.response is not None and query.seq <= catalog.since
    wanted = wanted and (parent is not None or peer is None or query.seq > peer.released)
    wanted = wanted and not catalog.name.startswith(CONNECTED)
    hold, resource_id = (Hold.HELD, query.resource_id) if wanted else (Hold.OWED, "")  # as though withdrawn
    place = (registrar, query.server, query.request, query.response, resource_id)
    facts = (query.attempt, query.seq, hold, State(query.state), query.priority, query.own)
    held = Held(query.query_id, *place, query.parent, *facts)
    decision.put_later(held)
    if held.parent:
        follow(decision, held)


def link_lost(decision: Decision, command: LinkLost) -> None:
    """Note that a link is lost: nothing is sent to its provider until that is reconciled again.

    Requests that this decision has made before, for the lost link, are dropped, too. Over the next link they might
    reach a provider that was restarted and does not know that it has answered them.
    """
    catalog = decision.catalog
    kept = [e for e in decision.effects if not (isinstance(e, SendRequest) and e.registrar == command.registrar)]
    if len(kept) < len(decision.effects):
        decision.effects = [*kept, Connect(command.registrar)]
    decision.forget(catalog.up, command.registrar)
    if catalog.closings:
        provider_lost(decision, command.registrar)
    if command.registrar in catalog.outbound and not catalog.waits_for(command.registrar):
        decision.cause(Connect(command.registrar))  # rows of direct lines may have been added only since the loss


def peer_gone(decision: Decision, command: PeerGone) -> None:
    """Fail the loads that wait for a provider that cannot be reached; if it is gone for good, lose what it had.

    Unless it is known to have nothing, all of that is owed to it: its catalog may still have it, and it may be started
    again under its name, in this run of the system or in a later one.
    """
    catalog, provider = decision.catalog, command.registrar
    unsure = False
    if command.final:
        add_all_in_flight(decision, provider)
    asked = catalog.agreed.get(provider, False)  # else no link was up since it was gone, so nothing was sent there
    for id in list(catalog.outbound.get(provider, ())):
        held = catalog.held[id]
        if command.final:
            decision.forget(catalog.fresh, id)
            decision.forget(catalog.unsent, id)
        if held.hold is Hold.PENDING and id in catalog.direct:
            unsure = True
            continue  # its thread's line breaks, and then the link asks for it
        if held.hold is Hold.PENDING:
            decision.cause(LoadResolved(held, command.failure))
            if command.empty or (command.final and not asked):
                decision.drop_later(held)
            else:
                # It may have had the request before it stopped.
                decision.put(replace(held, hold=Hold.OWED, resource_id=""))
        elif not command.final:
            continue
        elif held.hold is Hold.HELD:
            if not command.empty and id not in catalog.ending:
                decision.note(catalog.doubted, id, True)
            lose(decision, held, command.event, command.failure.message)
        elif command.empty:
            end_release(decision, held)
        else:  # it has not heard of the release, and may be back, perhaps in the next system
            decision.put(held)  # the disk may not have it as owed yet
            decision.cause(UnloadResolved(id, command.failure))
            released(decision, id)
    if not command.final:
        return
    if (decision.forget(catalog.acked, provider) or unsure) and not command.empty:
        decision.forget(catalog.agreed, provider)  # a lost acknowledgement or load: a notice or query may be there
    known = provider in catalog.agreed
    if known:
        decision.note(catalog.agreed, provider, False)
    if (known or command.empty) and provider not in catalog.outbound and provider in catalog.peers:
        decision.drop(catalog.peers[provider])


def lease_over(decision: Decision, command: LeaseOver) -> None:
    """Lose all that is held at a provider of another host. It may still have that: the releases are owed.

    Loads that wait go on waiting: the next link asks for them again. An answer of the lease that is over may still be
    on its way to a thread; got() passes it over.
    """
    catalog, provider = decision.catalog, command.registrar
    add_all_in_flight(decision, provider)
    decision.note(catalog.lapsed, provider, command.run)
    for id in list(catalog.outbound.get(provider, ())):
        held = catalog.held[id]
        decision.forget(catalog.fresh, id)
        if held.hold is Hold.HELD and id not in catalog.ending:
            decision.note(catalog.doubted, id, True)
            lose(decision, held, command.event, command.why)
    decision.cause(Connect(provider))


def begin_closing(decision: Decision, command: BeginClosing) -> None:
    """Load nothing from now on: who would release it?"""
    decision.note(decision.catalog.shut, command.own, command.failure)


def end_closing(decision: Decision, _command: EndClosing) -> None:
    """Owe all releases that are left. Forget the providers that have nothing of this registrar, and unneeded types.

    A provider that was away since this registrar was opened may have queries that are unknown here; one that is away
    now may not have got an acknowledgement. The Peer row stays, and says that all is released. A consumer with a link
    has its notices, or finds at its next start that the query is gone. Others hear them when both are started again.
    """
    catalog = decision.catalog
    add_all_in_flight(decision)  # a Load may be on its way, on its thread's line
    for held in list(catalog.held.values()):
        if held.parent not in catalog.resources:  # its release has failed; if it does so again, nobody wants it back
            decision.put(replace(held, hold=Hold.OWED, resource_id=""))
    for peer in list(catalog.peers.values()):
        away = catalog.agreed.get(peer.id) is True and peer.id not in catalog.up
        if peer.id not in catalog.agreed or (away and peer.id in catalog.acked):
            decision.put(replace(peer, released=catalog.last_number()))
        elif peer.id not in catalog.outbound:
            decision.drop(peer)
    for origin in {**catalog.consumers, catalog.name: ""}:
        for notice in [catalog.notices[id] for id in catalog.notices_to.get(origin, ())]:
            if notice.query_id not in catalog.queries:
                drop_notice(decision, notice)
    if not is_needed(catalog.tables):  # so nothing is left, and the store makes no file for it
        for types in list(catalog.server_types.values()):
            decision.drop(types)


# -- as a provider -------------------------------------------------------------------------------------------------

_CHUNK = 500
_CHUNK_BYTES = 2**16  # requests and responses of one message: a frame must not be too long, however much is held


def fetch(decision: Decision, message: Fetch) -> None:
    """List the consumer's queries; on a new link (`resume`), then send the notices that it has not dealt with.

    The order matters: the consumer may have lost a query in a crash, and a notice for it must find its row again.
    """
    catalog = decision.catalog
    same, queries = digests.compared(catalog, message.origin, message.spans)
    rows: list[FetchedQuery] = []
    size = 0
    for query in queries:
        resource = catalog.resources[query.resource_id]
        unanswered = resource.id in catalog.moving or query.id in catalog.waiting
        response = None if unanswered else resource.response or b""
        waits = resource.id in catalog.recovering or is_to_run(query, resource)
        place = (query.parent, query.attempt, query.seq, str(resource.state), query.priority, query.own, waits)
        row = FetchedQuery(query.id, resource.server, resource.id, resource.request, response, *place)
        more = len(row.request) + len(response or b"")
        if rows and (len(rows) == _CHUNK or size + more > _CHUNK_BYTES):
            decision.cause(SendReply(message.origin, Fetched(rows, True, message.number, same)))
            rows, size = [], 0
        rows.append(row)
        size += more
    notices = message.resume and bool(catalog.notices_to.get(message.origin))
    decision.cause(SendReply(message.origin, Fetched(rows, False, message.number, same, notices)))
    if message.resume:
        drop_parked(decision, lambda parked: parked.origin == message.origin)  # a consumer that lives sends them again
        for id in list(catalog.unanswered):  # the consumer sends these Unloads again over the new link
            query = catalog.queries.get(id)
            if query is None or query.origin == message.origin:
                decision.forget(catalog.unanswered, id)
        decision.note(catalog.consumers, message.origin, True)
        send_notices_to(decision, message.origin)
        if catalog.queued:
            look_again(decision, message.origin)


def consumer_lost(decision: Decision, command: ConsumerLost) -> None:
    """Note that a consumer's link is down: its notices wait for a new link, and its queries stay."""
    decision.forget(decision.catalog.consumers, command.origin)


def is_fenced(origin: str, leased: Collection[str]) -> bool:
    """Return whether a consumer is of another host, which has no lease."""
    host, slash, _ = origin.partition("/")
    return bool(slash) and host not in leased


def leased(decision: Decision, sender: str, message: Leased) -> None:
    """Release what registrars of hosts without a lease hold, and say that this is on disk."""
    catalog = decision.catalog
    parked = [one.origin for waiting in catalog.recovering.values() for one in waiting]
    for origin in dict.fromkeys([*catalog.by_origin, *catalog.notices_to, *parked]):
        if is_fenced(origin, message.hosts):
            gone(decision, Gone(origin))
    decision.cause(SendReply(sender, Released(message.number)))
