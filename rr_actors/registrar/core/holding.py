"""The decisions of a consumer about its own queries at other registrars (and at itself).

A held row's life: PENDING (asked) -> HELD (loaded) -> OWED (released, not yet confirmed) -> gone. The provider's record
is the truth, so rows here are written a moment later. OWED rows are not: the provider does not know of the release yet.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from rr_actors.base.errors import shortened
from rr_actors.registrar.core import releasing
from rr_actors.registrar.core.priorities import follow
from rr_actors.registrar.core.releasing import add_in_flight, look_there, released, withdraw
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import ABSENT, Catalog, Decision, Unsaved, add, discard
from rr_actors.registrar.model.commands import AskProvider, GiveUp, Got, Release, ReleaseOverdue, SendAgain
from rr_actors.registrar.model.effects import Connect, LoadResolved, Receive, RingBroken, UnloadResolved
from rr_actors.registrar.model.messages import (
    NO_LIMIT,
    Load,
    Loaded,
    LoadRefused,
    Noticed,
    Probe,
    Unload,
    Unloaded,
    UnloadRefused,
)
from rr_actors.registrar.model.rows import HELD, OK, OWED, PENDING, Held, Notice, Phase, State

# -- load ----------------------------------------------------------------------------------------------------------


def ask(decision: Decision, command: AskProvider) -> None:
    """Ask a provider for a query. The provider's Peer row is on disk before the request is sent."""
    catalog = decision.catalog
    attempt, priority = 0, command.priority
    parent = command.parent
    if True in catalog.shut and not parent:  # a resource may still load a part: it releases all of them at its end
        decision.cause(LoadResolved(pending(command), catalog.shut[True]))
        return
    if parent:
        resource = catalog.resources.get(parent)
        if resource is None:
            held = pending(command)
            why = f"the resource {shortened(parent)} that asks for it is gone"
            decision.cause(LoadResolved(held, failures.withdrawn(held, why)))
            return
        attempt = resource.attempt
        if not command.own:
            priority = catalog.inherited(parent)
        if (known := catalog.held.get(command.query_id)) is not None:
            if known.hold is HELD:
                decision.cause(LoadResolved(known, None))
            elif known.hold is OWED:
                decision.cause(LoadResolved(known, failures.being_released(known)))
            return
    held = pending(command, attempt, priority)
    look_there(decision, command.registrar)
    decision.put_here(held)
    decision.request(held.registrar, load_of(decision, held))


def hold(catalog: Catalog, unsaved: Unsaved, answer: Loaded | Got) -> bool:
    """Decide Got by the fast path, with the same result as got(); return False if got() has to decide it.

    The fast path is for a load that no decision has concerned, from a provider whose link is up: it adds one row.
    """
    id = answer.query_id
    asked = catalog.in_flight.get(id)
    if asked is None or asked.registrar not in catalog.up:
        return False
    parent = asked.parent
    if parent and ((not asked.own and catalog.inherited(parent) != asked.priority) or _may_close_ring(catalog, parent)):
        return False
    place = (asked.id, asked.registrar, asked.server, asked.request, answer.response, answer.resource_id)
    row = Held(*place, parent, asked.attempt, asked.seq, HELD, answer.state, asked.priority, asked.own)
    catalog.unfinished = [(catalog.in_flight, id, asked), ("held", id, ABSENT)]
    catalog.held[id] = row
    add(catalog.outbound, asked.registrar, id)
    if parent:
        add(catalog.parts, parent, id)
    unsaved.new[id] = row
    del catalog.in_flight[id]
    catalog.unfinished = None
    return True


def got(decision: Decision, command: Got) -> None:
    """Take the answer to a load that came on the connection of its caller's thread."""
    catalog, id = decision.catalog, command.query_id
    add_in_flight(decision, id)
    decision.forget(catalog.direct, id)
    held = catalog.held.get(id)
    if held is None:  # the query was loaded and taken away, and its holders know: the load itself succeeded
        taken = _unknown(id)
        decision.cause(LoadResolved(replace(taken, resource_id=command.resource_id, response=command.response), None))
        return
    if held.hold is PENDING and 0 < command.run <= catalog.lapsed.get(held.registrar, 0):
        decision.request(held.registrar, load_of(decision, held))  # the answer is of a lease that is over
        return
    if held.registrar not in catalog.up:
        decision.note(catalog.fresh, id, command.run)
        decision.cause(Connect(held.registrar))
    elif held.hold is PENDING and 0 < command.run < catalog.listed.get(held.registrar, 0):
        return  # an earlier run has said it, whose catalog was deleted: the link has asked for the query again
    if held.hold is not HELD:  # else reconciling has made it HELD before
        answer = Loaded(id, command.resource_id, command.response, state=command.state)
        loaded(decision, held.registrar, answer)
    # The row is as it was before: loaded() has caused its own LoadResolved.
    if held.hold is HELD or (held.hold is PENDING and id in catalog.ending):
        decision.cause(LoadResolved(held, None))


def send_again(decision: Decision, command: SendAgain) -> None:
    """Send a load or unload again by the link, as its thread's line broke; the provider knows it by its id."""
    add_in_flight(decision, command.query_id)
    held = decision.catalog.held.get(command.query_id)
    decision.forget(decision.catalog.direct, command.query_id)
    if held is None or (held.hold is PENDING and held.id in decision.catalog.ending):  # it was taken away
        failure = failures.taken_before_heard(command.query_id)
        decision.cause(LoadResolved(held or _unknown(command.query_id), failure))
    elif held.hold is PENDING:
        decision.request(held.registrar, load_of(decision, held))
    elif held.hold is HELD:
        decision.cause(LoadResolved(held, None))
    else:
        decision.put(held)  # the disk may not have it as owed yet
        decision.request(held.registrar, Unload(held.id, decision.catalog.name))


def _unknown(query_id: str) -> Held:
    """Return a row for a query that was taken away, and whose own row went when its holders had heard of that."""
    return Held(query_id, "", "", b"", None, "", "", 0, 0, PENDING, State.FATAL)


def pending(ask: AskProvider, attempt: int = 0, priority: int = 0) -> Held:
    """Return the row of a query that is asked for."""
    place = (ask.query_id, ask.registrar, ask.server, ask.request)
    return Held(*place, None, "", ask.parent, attempt, ask.seq, PENDING, OK, priority, ask.own)


def load_of(decision: Decision, held: Held) -> Load:
    """Return the Load that asks for a query; it is the same the first time and every time."""
    catalog = decision.catalog
    place = (held.id, held.server, held.request, catalog.name, held.parent)
    wait_ms = catalog.wait_limits.get(held.id, NO_LIMIT)
    return Load(*place, held.attempt, held.seq, held.priority, held.own, wait_ms)


def loaded(decision: Decision, provider: str, message: Loaded) -> None:
    """Mark a query as held, or release it if this registrar does not want it.

    A query without a row is not wanted. Nor is a new resource of a query that is being taken away: its Load was sent
    again after its provider crashed, though its caller's own connection had answered it.
    """
    add_in_flight(decision, message.query_id)
    held = decision.catalog.held.get(message.query_id)
    another = held is not None and (held.hold is PENDING or held.resource_id != message.resource_id)
    if held is None or (another and held.id in decision.catalog.ending):
        decision.request(provider, Unload(message.query_id, decision.catalog.name))
    elif held.hold is PENDING:
        if held.resource_id not in ("", message.resource_id):
            held = asked_anew(held)
        response = message.response if held.response is None else held.response  # an UPDATE has come before it
        state = message.state if held.response is None and held.state is OK else held.state  # a status may be newer
        held = replace(held, hold=HELD, resource_id=message.resource_id, response=response, state=state)
        decision.put_later(held)
        decision.cause(LoadResolved(held, None))
        if held.parent:
            follow(decision, held)
            if _may_close_ring(decision.catalog, held.parent):
                decision.request(provider, Probe(held.id, held.parent, held.id, [], holds=True))


# Rings of holds: a resource that is its own part would never be released.
#
# What a load callback loads is held before its own resource is. So a ring has a part that a loaded resource has loaded,
# in a status callback or a thread. Of these, take the one that was answered last: all other parts of the ring are held
# by then. So a probe that starts at its answer finds the ring. Where the resource is no part of any other, none starts.


def _may_close_ring(catalog: Catalog, parent: str) -> bool:
    """Return whether a new part of this resource may hold it: it is loaded, and itself a part."""
    resource = catalog.resources.get(parent)
    is_loaded = resource is not None and resource.phase is not Phase.LOADING
    return is_loaded and any(query.parent for query in catalog.queries_of(parent))


def break_ring(decision: Decision, query_id: str, ring: list[str]) -> None:
    """Release the part that closes a ring of holds. Its holder hears FATAL, as of any part that is taken away."""
    held = decision.catalog.held.get(query_id)
    if held is None or held.hold is not HELD or held.id in decision.catalog.ending:
        return
    why = failures.ring_of_holds(ring, held)
    decision.cause(RingBroken(why))
    lose(decision, held, f"ring:{held.id}", why)
    decision.request(held.registrar, Unload(held.id, decision.catalog.name))


def asked_anew(held: Held) -> Held:
    """Return the row of a query that is asked for without what statuses of an earlier resource have brought to it."""
    return replace(held, resource_id="", response=None, state=OK)


def load_refused(decision: Decision, message: LoadRefused) -> None:
    """Remove the row of a query that does not exist. If it is held, it was taken away since, and a notice says so.

    Such a notice may also wait for a query whose answer was lost with its link, or come behind the refusal of a query
    that was being released: the entry in `acked` has a link opened for it, also when this one is lost. While its
    caller's own connection has neither answered nor broken (`direct`), nothing is decided: its answer may say that the
    query is loaded.
    """
    held = decision.catalog.held.get(message.query_id)
    if held is None:
        return
    if held.registrar not in decision.catalog.up or held.hold is OWED:
        decision.note(decision.catalog.acked, held.registrar, True)
    if held.hold is PENDING and not decision.catalog.direct.get(held.id):
        decision.drop_later(held)
        decision.cause(LoadResolved(held, message.failure))
    elif held.hold is OWED:
        end_release(decision, held)


def end_direct(decision: Decision, query_id: str) -> None:
    """Note that the row of a query goes while its caller's own connection has not answered."""
    if query_id in decision.catalog.direct:
        decision.note(decision.catalog.direct, query_id, False)


def given_up(catalog: Catalog, command: GiveUp) -> LoadResolved | None:
    """Return what ends the wait of a load's caller while GiveUp cannot be written; None if the load has ended."""
    held = catalog.held.get(command.query_id) or catalog.in_flight.get(command.query_id)
    if held is not None and held.hold is not PENDING and not (command.unheard and held.hold is HELD):
        return None
    return LoadResolved(held or _unknown(command.query_id), command.failure)


def give_up(decision: Decision, command: GiveUp) -> None:
    """Withdraw a load that is not answered yet, or whose answer nobody has heard."""
    add_in_flight(decision, command.query_id)
    held = decision.catalog.held.get(command.query_id)
    decision.forget(decision.catalog.direct, command.query_id)
    if held is None:
        decision.cause(LoadResolved(_unknown(command.query_id), command.failure))
    elif held.hold is PENDING or (command.unheard and held.hold is HELD):
        withdraw(decision, held, command.failure)


# -- unload --------------------------------------------------------------------------------------------------------


def release(decision: Decision, command: Release) -> None:
    """Release a query, and write that it is owed before the provider hears of it.

    Otherwise a crash could leave it held here and not at the provider, and it would seem lost.
    """
    held = decision.catalog.held.get(command.query_id)
    if held is None or held.hold is OWED:
        decision.cause(UnloadResolved(command.query_id, failures.unknown_query(decision.catalog, command.query_id)))
        return
    releasing.owe(decision, held, "unloaded while it was loading")
    decision.request(held.registrar, Unload(held.id, decision.catalog.name))


def owe(catalog: Catalog, unsaved: Unsaved, query_id: str, write: Callable[[Held], bool]) -> bool:
    """Decide Release by the fast path, with the same result as release(); return False if release() has to decide it.

    If the disk has anything of the query, write(row) writes the owed row first, or returns False. If the disk has
    nothing, the row is written a moment later, unless the query is gone by then: after an earlier crash the provider
    says whether the query is held.

    release() decides queries from before a crash: a list that their provider made earlier may arrive after the answer,
    and would bring them back.
    """
    held = catalog.held.get(query_id)
    if held is None or held.hold is not HELD or held.seq <= catalog.since:
        return False
    if query_id in catalog.kept or query_id in catalog.ending:
        return False
    row = replace(held, hold=OWED)
    catalog.unfinished = [("held", query_id, held)]
    if query_id in unsaved.new:
        unsaved.new[query_id] = row
    elif not write(row):
        catalog.unfinished = None
        return False
    catalog.held[query_id] = row
    catalog.unsettled[query_id] = row.registrar
    if row.parent:
        discard(catalog.parts, row.parent, query_id)
    catalog.unfinished = None
    return True


def forget_released(catalog: Catalog, unsaved: Unsaved, query_id: str) -> bool:
    """Decide Unloaded by the fast path, as unloaded() does; return False if unloaded() has to decide it."""
    row = catalog.held.get(query_id)
    if row is None:
        return True
    if row.hold is not OWED or query_id in catalog.direct or query_id in catalog.closings or query_id in catalog.kept:
        return False
    catalog.unfinished = [("held", query_id, row)]
    del catalog.held[query_id], catalog.unsettled[query_id]
    discard(catalog.outbound, row.registrar, query_id)
    unsaved.drop(query_id)
    catalog.unfinished = None
    return True


def release_overdue(decision: Decision, command: ReleaseOverdue) -> None:
    """Fail an unload that its provider has not answered in time; the release stays owed."""
    held = decision.catalog.held.get(command.query_id)
    if held is not None and held.hold is OWED:
        decision.put(held)  # the disk may not have it as owed yet
        decision.cause(UnloadResolved(command.query_id, command.failure))


def unloaded(decision: Decision, provider: str, message: Unloaded) -> None:
    """End a release that the provider has confirmed. A query that is HELD again is lost.

    That happens if the unload was tried twice: the first time it failed, and the query was held again.
    """
    held = decision.catalog.held.get(message.query_id)
    if held is None:
        return
    if held.hold is OWED:
        end_release(decision, held)
    elif held.hold is HELD:
        lose(decision, held, f"{provider}:{held.seq}", "unloaded after all")


def end_release(decision: Decision, held: Held) -> None:
    """Remove the row of an owed query that its provider does not have any more."""
    end_direct(decision, held.id)
    decision.drop_later(held)
    decision.forget(decision.catalog.kept, held.id)
    decision.cause(UnloadResolved(held.id, None))
    released(decision, held.id)


def unload_refused(decision: Decision, message: UnloadRefused) -> None:
    """Hold a query again whose unload callback raised, if anybody could want it.

    A withdrawn query stays owed. So does one whose resource is gone or was loaded anew. Their Unload is sent again over
    the next link.
    """
    catalog = decision.catalog
    held = catalog.held.get(message.query_id)
    if held is None or held.hold is not OWED:
        return
    if may_be_held_again(catalog, held) and message.failure.kind != "Unavailable":  # else it is unloaded later
        decision.note(catalog.kept, held.id, True)
        decision.put(again := replace(held, hold=HELD))
        follow(decision, again)
    decision.cause(UnloadResolved(held.id, message.failure))
    released(decision, held.id)


def may_be_held_again(catalog: Catalog, held: Held) -> bool:
    """Return whether an owed query is held again if its unload fails."""
    parent = catalog.resources.get(held.parent)
    wanted = not held.parent or (parent is not None and parent.attempt == held.attempt)
    return wanted and bool(held.resource_id)


def lose(decision: Decision, held: Held, event: str, why: str) -> None:
    """Give the holders of a query a notice that it is lost, as though its provider had sent one.

    The notice is marked as repeated if the query is from before a crash: its holders may have heard it before.
    """
    if held.id in decision.catalog.ending:
        return
    source = f"{held.registrar}/{held.server}"
    place = (held.id, decision.catalog.name, held.resource_id, event, State.FATAL, why, source, True)
    repeated = held.seq <= decision.catalog.since
    decision.cause(Receive("", Noticed(Notice(f"{event}:{held.id}", *place), repeated)))


# -- crash ---------------------------------------------------------------------------------------------------------


def begin_again(decision: Decision) -> None:
    """Clean up at the start of an incarnation: drop pending rows, and owe the parts of interrupted loads."""
    catalog = decision.catalog
    for held in list(catalog.held.values()):
        parent = catalog.resources.get(held.parent)
        if held.hold is PENDING:
            decision.drop_later(held)  # if the provider has the query, reconciling takes it back or releases it
        elif held.hold is HELD and held.parent and (parent is None or parent.phase is Phase.LOADING):
            decision.put(replace(held, hold=OWED))
