"""The queries that a registrar holds at providers: its loads in flight, and the release of a resource's parts.

Parts are released newest first, one after another; the effects that wait for that come last. The rows become OWED in
the decision that ends the resource, so a crash in between forgets nothing: an owed release is sent again when the link
to its provider is up. Releases do not wait for a provider that is down.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Closing, Decision
from rr_actors.registrar.model.effects import Connect, Effect, LoadResolved, Request
from rr_actors.registrar.model.messages import Failure, Message, Unload
from rr_actors.registrar.model.rows import Held, Hold, Peer


def request(decision: Decision, registrar: str, message: Message) -> None:
    """Send a message to a provider if its link is up; else have the link made, which sends all open messages again."""
    if registrar in decision.catalog.up:
        decision.cause(Request(registrar, message))
    else:
        decision.cause(Connect(registrar))


def look_there(decision: Decision, provider: str) -> None:
    """Write that this provider has to be found at the next start."""
    if provider not in decision.catalog.peers:
        decision.put(Peer(provider))


def add_in_flight(decision: Decision, query_id: str) -> None:
    """Add the row of a load in flight, if the query is one, because a decision is about to concern it.

    The caller's own thread has sent this load and waits for the answer. Until a decision concerns the query, nothing
    else needs its row.
    """
    held = decision.forget(decision.catalog.in_flight, query_id)
    if held is not None:
        look_there(decision, held.registrar)
        decision.put_here(held)
        decision.note(decision.catalog.direct, query_id, True)


def add_all_in_flight(decision: Decision, provider: str = "", parent: str = "") -> None:
    """Add the rows of all loads in flight; with `provider` or `parent`, only of those."""
    for held in list(decision.catalog.in_flight.values()):
        if provider in ("", held.registrar) and parent in ("", held.parent):
            add_in_flight(decision, held.id)


def parts_of(decision: Decision, resource_id: str) -> list[str]:
    """Return the queries that the resource holds or has asked for, newest first."""
    add_all_in_flight(decision, parent=resource_id)
    return decision.catalog.parts_of(resource_id)


def owe(decision: Decision, held: Held, why: str) -> None:
    """Make the query owed, on disk. A caller that still waits for its load hears why the load ends."""
    if held.hold is Hold.PENDING:
        decision.forget(decision.catalog.direct, held.id)
        decision.cause(LoadResolved(held, failures.withdrawn(held, why)))
    decision.put(replace(held, hold=Hold.OWED))


def withdraw(decision: Decision, held: Held, failure: Failure) -> None:
    """End a load that nobody waits for any longer. If it succeeds later, the provider releases it."""
    decision.forget(decision.catalog.direct, held.id)
    decision.cause(LoadResolved(held, failure))
    decision.put(replace(held, hold=Hold.OWED, resource_id=""))
    request(decision, held.registrar, Unload(held.id, decision.catalog.name))


def release_parts(
    decision: Decision, resource_id: str, after: Sequence[Effect], keep_attempt: int | None = None
) -> None:
    """Release the parts of the resource, then cause `after`; with `keep_attempt`, keep the parts of that attempt."""
    catalog = decision.catalog
    ids = [id for id in parts_of(decision, resource_id) if catalog.held[id].attempt != keep_attempt]
    for id in ids:
        owe(decision, catalog.held[id], "withdrawn, what asked for it is gone")
    _release_next(decision, ids, tuple(after))


def released(decision: Decision, held_id: str) -> None:
    """Go on with the next part, because the release of this one was answered, or cannot be."""
    closing = decision.forget(decision.catalog.closings, held_id)
    if closing is not None:
        _release_next(decision, closing.remaining, closing.after)


def provider_lost(decision: Decision, registrar: str) -> None:
    """Go on with all releases that wait for this provider, because it does not answer now."""
    catalog = decision.catalog
    waiting = [id for id in catalog.closings if id in catalog.held and catalog.held[id].registrar == registrar]
    for id in waiting:
        released(decision, id)


def _release_next(decision: Decision, ids: Sequence[str], after: tuple[Effect, ...]) -> None:
    """Send the release of the first of these parts whose provider is up; if there is none, cause `after`."""
    catalog = decision.catalog
    for place, id in enumerate(ids, 1):
        held = catalog.held.get(id)
        if held is not None and held.registrar in catalog.up:
            decision.note(catalog.closings, id, Closing(tuple(ids[place:]), after))
            decision.cause(Request(held.registrar, Unload(id, catalog.name)))
            return
        if held is not None:
            decision.cause(Connect(held.registrar))
    decision.effects += after
