"""The queries that a registrar holds at providers: its loads in flight, and the release of a resource's parts.

Parts are released newest first, one after another; the effects that wait for that come last. The rows become OWED in
the decision that ends the resource, so a crash in between forgets nothing: an owed release is sent again when the link
to its provider is up. Releases do not wait for a provider that is down.

The last part is about a catalog that nobody has open.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from msgspec.structs import replace

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.callback_runs import run_id
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Closing, Decision, after_epoch
from rr_actors.registrar.model.effects import Connect, Effect, LoadResolved, SendRequest
from rr_actors.registrar.model.messages import Unload
from rr_actors.registrar.model.rows import (
    LOADED,
    LOADING,
    OWED,
    QUEUED,
    RESTING,
    UNLOADING,
    CallbackRun,
    Change,
    Content,
    Drop,
    Held,
    Hold,
    Peer,
    Put,
    Resource,
    Table,
    is_own,
)


def look_there(decision: Decision, provider: str) -> None:
    """Write that this provider has to be found at the next start."""
    if provider not in decision.catalog.peers:
        decision.put(Peer(provider))
        if provider not in decision.catalog.agreed:
            decision.note(decision.catalog.agreed, provider, False)


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
        held = replace(held, resource_id="")
    decision.put(replace(held, hold=Hold.OWED))


def withdraw(decision: Decision, held: Held, failure: Failure) -> None:
    """End a load that nobody waits for any longer. If it succeeds later, the provider releases it."""
    decision.forget(decision.catalog.direct, held.id)
    decision.cause(LoadResolved(held, failure))
    decision.put(replace(held, hold=Hold.OWED, resource_id=""))
    decision.request(held.registrar, Unload(held.id, decision.catalog.name))


def release_parts(
    decision: Decision, resource_id: str, after: Sequence[Effect], keep_attempt: int | None = None
) -> None:
    """Release the parts of the resource, then cause `after`; with `keep_attempt`, keep the parts of that attempt."""
    catalog = decision.catalog
    ids = [id for id in parts_of(decision, resource_id) if catalog.held[id].attempt != keep_attempt]
    for id in ids:
        owe(decision, catalog.held[id], "withdrawn, what asked for it is gone")
    _release_next(decision, Closing(tuple(ids), 0, tuple(after)))


def released(decision: Decision, held_id: str) -> None:
    """Go on with the next part, because the release of this one was answered, or cannot be."""
    closing = decision.forget(decision.catalog.closings, held_id)
    if closing is not None:
        _release_next(decision, closing)


def provider_lost(decision: Decision, registrar: str) -> None:
    """Go on with all releases that wait for this provider, because it does not answer now."""
    catalog = decision.catalog
    waiting = [id for id in catalog.closings if id in catalog.held and catalog.held[id].registrar == registrar]
    for id in waiting:
        released(decision, id)


def _release_next(decision: Decision, closing: Closing) -> None:
    """Send the release of the next part whose provider is up; if there is none, cause `after`."""
    catalog = decision.catalog
    for place in range(closing.sent, len(closing.ids)):
        id = closing.ids[place]
        held = catalog.held.get(id)
        if held is not None and held.registrar in catalog.up:
            decision.note(catalog.closings, id, replace(closing, sent=place + 1))
            decision.cause(SendRequest(held.registrar, Unload(id, catalog.name)))
            return
        if held is not None:
            decision.cause(Connect(held.registrar))
    decision.effects += closing.after


# A registrar that is given up: released while it is dormant, or deleted. Nobody has its catalog open.
#
# The changes are made in two steps, each a commit of its own. In between, the providers hear of it.

_SERVED: tuple[Table, ...] = ("resources", "queries", "callback_runs", "stored_servers", "revocations")


def owing(content: Content, epoch: int) -> list[Change]:
    """Return the changes by which all that the registrar holds is owed, and nothing that it serves is used any more.

    If it is opened again, it releases what it owes, and what its providers have besides. It unloads what it serves,
    which has lost its parts: nobody is given that any more.
    """
    changes: list[Change] = [Put(replace(row, hold=OWED, resource_id="")) for row in content["held"].values()]
    changes += [Put(replace(row, released=after_epoch(epoch))) for row in content["peers"].values()]
    asked: set[str] = set()  # resources of which nobody has had an answer
    for resource in content["resources"].values():
        if resource.phase is LOADED or resource.phase in RESTING:
            changes += _to_unload(content, resource)
        elif resource.phase is LOADING:  # as recovery.begin_again() does when it gives up a load
            asked.add(resource.id)
            changes += _to_unload(content, replace(resource, attempt=resource.attempt + 1, tries=0))
        elif resource.phase is QUEUED:
            asked.add(resource.id)
            changes.append(Drop("resources", resource.id))
    changes += [Drop("queries", query.id) for query in content["queries"].values() if query.resource_id in asked]
    for notice in content["notices"].values():
        id = notice.resource_id
        if id in asked and (content["resources"][id].phase is QUEUED or not is_own(notice)):
            changes.append(Drop("notices", notice.id))
    return changes


def _to_unload(content: Content, resource: Resource) -> list[Change]:
    run = content["callback_runs"].get(run_id("unload", resource.id), CallbackRun(run_id("unload", resource.id)))
    return [Put(replace(resource, phase=UNLOADING)), Put(replace(run, begun=False))]  # it has not begun


def forgetting(content: Content, name: str, down: Collection[str], *, clear: bool = False) -> list[Change]:
    """Return the changes by which nothing is left of what other registrars have decided since.

    Args:
        name: the registrar's name. If it is one of its own consumers, it has to release that when it is opened again.
        down: the registrars that have not decided that this one is gone.
        clear: nothing is left of what the registrar serves, either.
    """
    consumers = {query.origin for query in content["queries"].values()}
    staying = {*down} - {name} if clear else {*down, *(consumers & {name})}
    held = [row.id for row in content["held"].values() if row.registrar not in staying]
    peers = [id for id in content["peers"] if id not in staying]
    sent = [row for row in content["notices"].values() if row.origin and row.origin not in staying]
    heard = [row.id for row in sent if row.query_id not in content["queries"]]  # others stay as long as their query
    notices = list(content["notices"]) if clear else heard
    return [
        *(Drop("held", id) for id in held),
        *(Drop("peers", id) for id in peers),
        *(Drop("notices", id) for id in notices),
        *(Drop(table, id) for table in _SERVED if clear for id in content[table]),
    ]
