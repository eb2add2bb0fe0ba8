"""The decisions of a consumer about statuses: which receivers hear one, and when the provider may forget it.

A notice has up to two receivers: the listeners of the query, and the resource that depends on the query. The listeners
hear it at once. The resource hears it after them, if none has handled it, and not before its load has returned. Each
receiver hears an event once, by however many ways it comes. The notice is acknowledged when both have dealt with it. If
a crash comes before that, the provider sends it again, marked as repeated.
"""

from __future__ import annotations

from itertools import islice

from msgspec.structs import replace

from rr_actors.registrar.core.callback_runs import is_given_up, note_ended
from rr_actors.registrar.core.holding import asked_anew, end_release, may_be_held_again
from rr_actors.registrar.core.notices import acknowledge, dealt_with, end_query, remember_heard
from rr_actors.registrar.core.releasing import add_in_flight
from rr_actors.registrar.core.status_changes import (
    is_busy,
    is_heard_by,
    let_go,
    own_done,
    pass_revocation_on,
    spread,
    start_status,
)
from rr_actors.registrar.model.catalog import Catalog, Decision, DeliveredNotice, DueStatus
from rr_actors.registrar.model.commands import CallbackEnded, Heard
from rr_actors.registrar.model.effects import Hear
from rr_actors.registrar.model.messages import Noticed, Unload
from rr_actors.registrar.model.rows import Held, Hold, Notice, Resource, State, is_own, is_revocation


def noticed(decision: Decision, provider: str, message: Noticed) -> None:
    """Decide about a status of one of this registrar's queries: pass it on, pass it over, or end the query."""
    catalog, notice = decision.catalog, message.notice
    if notice.query_id in catalog.in_flight:
        add_in_flight(decision, notice.query_id)
    held = catalog.held.get(notice.query_id)
    doubted = not provider and decision.forget(catalog.doubted, notice.query_id) is not None
    if held is None:
        acknowledge(decision, provider, notice.id)
    elif held.hold is not Hold.PENDING and held.resource_id not in ("", notice.resource_id):
        # It is about an earlier resource of the query, and was held back until on_start returned.
        acknowledge(decision, provider, notice.id)
    elif held.hold is Hold.OWED:
        if notice.released and not doubted:
            if held.resource_id:
                end_release(decision, held)
            else:  # withdrawn: its Load may have been sent again since, so only the provider's answer can end it
                decision.request(held.registrar, Unload(held.id, catalog.name))
            acknowledge(decision, provider, notice.id)
        elif not may_be_held_again(catalog, held):
            if is_revocation(notice):  # its unload has failed, and is to be tried again
                decision.request(held.registrar, Unload(held.id, catalog.name))
            acknowledge(decision, provider, notice.id)
        # else the provider drops the notice with the query, or sends it again if the unload fails
    elif held.hold is Hold.PENDING and notice.released and held.id not in catalog.direct:
        # its Load was sent again since, and gets an answer of its own; this notice is about the time before
        decision.put_here(asked_anew(held))
        acknowledge(decision, provider, notice.id)
    elif notice.id in catalog.hearing:
        pass  # a second sending; the notice is acknowledged when its receivers have dealt with it
    elif held.id in catalog.ending:
        if not notice.released:  # else the provider drops it when the row is gone from the disk: see end_query()
            acknowledge(decision, provider, notice.id)
    else:
        _hear(decision, held, notice, provider, message.repeated, doubted=doubted)


def _hear(decision: Decision, held: Held, notice: Notice, provider: str, repeated: bool, *, doubted: bool) -> None:
    catalog = decision.catalog
    if held.hold is Hold.PENDING and held.resource_id not in ("", notice.resource_id):
        held = asked_anew(held)
    receivers = 0
    place = ("query", held.id, notice.event)
    listened = False
    if place not in catalog.heard:
        receivers += 1
        listened = is_listened(catalog, held)
        response = held.response if notice.response is None else notice.response
        put = decision.put_here if held.hold is Hold.PENDING else decision.put_later
        lasting = State.FATAL if held.state is State.FATAL else notice.state
        put(replace(held, state=lasting, response=response, resource_id=notice.resource_id))
        if notice.released:
            decision.note(catalog.ending, held.id, doubted)
        decision.note(catalog.heard, place, (notice.id,))
        decision.cause(Hear(held, notice, repeated))
    resource = catalog.resources.get(held.parent)
    if resource is not None:
        receivers += _concerns(decision, DueStatus(resource, notice, repeated), listened=listened)
    ends = held.id if notice.released else ""
    if receivers:
        decision.note(catalog.hearing, notice.id, DeliveredNotice(provider, receivers, repeated, ends))
    else:
        end_query(decision, ends, provider)
        acknowledge(decision, provider, notice.id)


def _concerns(decision: Decision, due: DueStatus, *, listened: bool) -> bool:
    """Have the resource hear each event once, after listeners that hear it now; return whether the notice waits."""
    catalog, resource, notice = decision.catalog, due.resource, due.notice
    place = ("resource", resource.id, notice.event)
    waiting = catalog.heard.get(place)
    if waiting is not None:  # the event has come by another part before, or the notice is sent again
        if waiting and notice.id not in waiting:
            decision.note(catalog.heard, place, (*waiting, notice.id))
        return bool(waiting)
    known = resource.server in catalog.servers
    if not known or not (is_heard_by(catalog, resource) or listened or is_busy(catalog, resource)):
        remember_heard(decision, place)
        _pass_on(decision, resource, notice, handled=False, repeated=due.repeated)
        return False
    decision.note(catalog.heard, place, (notice.id,))
    if listened:
        decision.note(catalog.next_to_hear, notice.id, due)
    else:
        _start(decision, due)
    return True


def _start(decision: Decision, due: DueStatus) -> None:
    """Have the resource hear a status now; without its callback, if that has ended the process too often."""
    if is_given_up(decision.catalog, "status", due.resource.id):
        _heard_it(decision, due.resource.id, due.notice, handled=False)
    else:
        start_status(decision, due)


def is_listened(catalog: Catalog, held: Held) -> bool:
    """Return whether anybody listens to the query or to its server: the resource hears a status only after them."""
    return held.id in catalog.listened or f"{held.registrar}/{held.server}" in catalog.listened


def heard(decision: Decision, command: Heard) -> None:
    """Note that the listeners of a query have heard an event; the resource is next, unless one has handled it."""
    catalog = decision.catalog
    place = ("query", command.query_id, command.event)
    for notice_id in catalog.heard.get(place, ()):
        due = decision.forget(catalog.next_to_hear, notice_id)
        if due is not None and not command.handled and due.resource.id in catalog.resources:
            _start(decision, due)
        elif due is not None:
            if command.handled and (resource := catalog.resources.get(due.resource.id)) is not None:
                _pass_on(decision, resource, due.notice, handled=True, repeated=False)
            dealt_with(decision, ("resource", due.resource.id, command.event))
    held = catalog.held.get(command.query_id)
    if command.revoked and held is not None and held.hold is not Hold.OWED and not held.parent:
        let_go(decision, held)
    dealt_with(decision, place)


def start_deferred(decision: Decision, resource_id: str) -> None:
    """Have the resource hear the deferred statuses, as its load or recover callback has returned."""
    catalog = decision.catalog
    for due in decision.forget(catalog.deferred, resource_id) or ():
        resource = catalog.resources.get(resource_id)
        if resource is None or resource.server not in catalog.servers:
            _heard_it(decision, resource_id, due.notice, handled=False)
        else:
            _start(decision, due)
    _start_late(decision, resource_id)


def status_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Note that the status callback has run for a status, or that the server has none."""
    statuses, id = decision.catalog.statuses, ended.resource_id
    if (left := statuses.get(id, 0)) > 1:
        decision.note(statuses, id, left - 1)
    elif decision.forget(statuses, id):
        note_ended(decision, "status", id)
        resource = decision.catalog.resources.get(id)
        if decision.catalog.deferred and resource is not None and not is_busy(decision.catalog, resource):
            start_deferred(decision, id)  # it awaited its trial, and has not died this time
    if ended.notice is not None:
        _heard_it(decision, id, ended.notice, handled=ended.handled)
    if decision.catalog.late:
        _start_late(decision, id)


def _start_late(decision: Decision, resource_id: str) -> None:
    """Run the status callback for the resource's own statuses that wait for runs to end, if half a window has ended."""
    catalog = decision.catalog
    late, resource = catalog.late.get(resource_id), catalog.resources.get(resource_id)
    free = catalog.window - catalog.statuses.get(resource_id, 0) - len(catalog.deferred.get(resource_id, ()))
    if late is None or resource is None or free * 2 < catalog.window:
        return
    for notice_id in list(islice(late, free)):
        due = decision.forget(late, notice_id)
        _start(decision, replace(due, resource=resource))
    if not late:
        decision.forget(catalog.late, resource_id)


def _heard_it(decision: Decision, resource_id: str, notice: Notice, *, handled: bool) -> None:
    """Note that the resource has heard a status; send it to the holders, unless it was handled."""
    catalog = decision.catalog
    if is_own(notice):
        own_done(decision, notice, handled=handled)
        return
    resource = catalog.resources.get(resource_id)
    if resource is not None:
        hearing = catalog.hearing.get(notice.id)
        repeated = hearing is not None and hearing.repeated
        _pass_on(decision, resource, notice, handled=handled, repeated=repeated)
    dealt_with(decision, ("resource", resource_id, notice.event))


def _pass_on(decision: Decision, resource: Resource, notice: Notice, *, handled: bool, repeated: bool) -> None:
    """Send a part's status to the holders of the resource, unless it was handled. A revocation has its own way."""
    if is_revocation(notice):
        pass_revocation_on(decision, resource, notice, handled=handled)
    elif not handled:
        spread(decision, resource, notice.event, notice.state, notice.message, notice.source, repeated=repeated)
