"""The decisions of a consumer about statuses: which receivers hear one, and when the provider may forget it.

A notice has up to two receivers: the listeners of the query, and the resource that depends on the query. The listeners
hear it at once. The resource hears it after them, if none has handled it, and not before its load has returned. Each
receiver hears an event once, by however many ways it comes. The notice is acknowledged when both have dealt with it. If
a crash comes before that, the provider sends it again, marked as repeated.
"""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.registrar.core.holding import end_direct, end_release
from rr_actors.registrar.core.releasing import add_in_flight, request
from rr_actors.registrar.core.status_changes import is_busy, own_done, spread, start_status
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision, Hearing
from rr_actors.registrar.model.commands import Heard, StatusDone
from rr_actors.registrar.model.effects import Hear, LoadResolved, StartStatus
from rr_actors.registrar.model.messages import Noticed, NoticesHandled, Unload
from rr_actors.registrar.model.rows import Held, Hold, Notice, State, is_own

_REMEMBERED = 20_000
_SWEPT_EVERY = 1024

Place = tuple[str, str, str]  # "query" or "resource", its id, the event


def noticed(decision: Decision, provider: str, message: Noticed) -> None:
    """Decide about a status of one of this registrar's queries: pass it on, pass it over, or end the query."""
    catalog, notice = decision.catalog, message.notice
    add_in_flight(decision, notice.query_id)
    held = catalog.held.get(notice.query_id)
    if held is None:
        _acknowledge(decision, provider, notice.id)
    elif held.resource_id and held.resource_id != notice.resource_id:
        # It is about an earlier resource of the query, and was held back until on_start returned.
        _acknowledge(decision, provider, notice.id)
    elif held.hold is Hold.OWED:
        if notice.released:
            if held.resource_id:
                end_release(decision, held)
            else:  # withdrawn: its Load may have been sent again since, so only the provider's answer can end it
                request(decision, held.registrar, Unload(held.id, catalog.name))
            _acknowledge(decision, provider, notice.id)
        # else the provider drops the notice with the query, or sends it again if the unload fails
    elif held.hold is Hold.PENDING and notice.released and held.id not in catalog.direct:
        # its Load was sent again since, and gets an answer of its own; this notice is about the time before
        decision.put_here(replace(held, state=State.OK, response=None))
        _acknowledge(decision, provider, notice.id)
    elif notice.id in catalog.hearing:
        pass  # a second sending; the notice is acknowledged when its receivers have dealt with it
    elif held.id in catalog.ending:
        _acknowledge(decision, provider, notice.id)  # its holders know that they have lost it
    else:
        _hear(decision, held, notice, provider, message.repeated)


def _hear(decision: Decision, held: Held, notice: Notice, provider: str, repeated: bool) -> None:
    catalog = decision.catalog
    receivers = 0
    heard_all = held.hold is Hold.HELD and held.id not in catalog.kept
    if repeated and notice.response is not None and heard_all:
        notice = replace(notice, response=held.response)  # reconciling has brought the newest
    place = ("query", held.id, notice.event)
    listened = False
    if place not in catalog.heard:
        receivers += 1
        listened = is_listened(catalog, held)
        response = held.response if notice.response is None else notice.response
        put = decision.put_here if held.hold is Hold.PENDING else decision.put_later
        put(replace(held, state=notice.state, response=response))
        if notice.released:
            decision.note(catalog.ending, held.id, True)
        decision.note(catalog.heard, place, (notice.id,))
        decision.cause(Hear(held, notice, repeated))
    resource = catalog.resources.get(held.parent)
    if resource is not None:
        receivers += _concerns(decision, StartStatus(resource, notice, repeated), listened=listened)
    ends = held.id if notice.released else ""
    if receivers:
        decision.note(catalog.hearing, notice.id, Hearing(provider, receivers, repeated, ends))
    else:
        _end(decision, ends)
        _acknowledge(decision, provider, notice.id)


def _concerns(decision: Decision, start: StartStatus, *, listened: bool) -> bool:
    """Have the resource hear each event once, after listeners that hear it now; return whether the notice waits."""
    catalog, resource, notice = decision.catalog, start.resource, start.notice
    place = ("resource", resource.id, notice.event)
    waiting = catalog.heard.get(place)
    if waiting is not None:  # the event has come by another part before, or the notice is sent again
        if waiting and notice.id not in waiting:
            decision.note(catalog.heard, place, (*waiting, notice.id))
        return bool(waiting)
    server = catalog.servers.get(resource.server)
    if server is None or not (server.has_status or listened or is_busy(catalog, resource)):
        _remember(decision, place)
        spread(decision, resource, notice.event, notice.state, notice.message, notice.source, repeated=start.repeated)
        return False
    decision.note(catalog.heard, place, (notice.id,))
    if listened:
        decision.note(catalog.next_to_hear, notice.id, start)
    else:
        start_status(decision, start)
    return True


def is_listened(catalog: Catalog, held: Held) -> bool:
    """Return whether anybody listens to the query or to its server: the resource hears a status only after them."""
    return held.id in catalog.listened or f"{held.registrar}/{held.server}" in catalog.listened


def heard(decision: Decision, command: Heard) -> None:
    """Note that the listeners of a query have heard an event; the resource is next, unless one has handled it."""
    catalog = decision.catalog
    place = ("query", command.query_id, command.event)
    for notice_id in catalog.heard.get(place, ()):
        start = decision.forget(catalog.next_to_hear, notice_id)
        if start is not None and not command.handled and start.resource.id in catalog.resources:
            start_status(decision, start)
        elif start is not None:
            _dealt_with(decision, ("resource", start.resource.id, command.event))
    _dealt_with(decision, place)


def start_deferred(decision: Decision, resource_id: str) -> None:
    """Have the resource hear the deferred statuses, as its load or recover callback has returned."""
    catalog = decision.catalog
    for start in decision.forget(catalog.deferred, resource_id) or ():
        resource = catalog.resources.get(resource_id)
        server = None if resource is None else catalog.servers.get(resource.server)
        if resource is None or server is None:
            status_done(decision, StatusDone(resource_id, start.notice, handled=False))
        else:
            start_status(decision, start)


def status_done(decision: Decision, done: StatusDone) -> None:
    """Note that the resource has heard a status; send it to the holders, unless it was handled."""
    catalog = decision.catalog
    notice = done.notice
    if is_own(notice):
        own_done(decision, notice, handled=done.handled)
        return
    resource = catalog.resources.get(done.resource_id)
    if resource is not None and not done.handled:
        hearing = catalog.hearing.get(notice.id)
        repeated = hearing is not None and hearing.repeated
        spread(decision, resource, notice.event, notice.state, notice.message, notice.source, repeated=repeated)
    _dealt_with(decision, ("resource", done.resource_id, notice.event))


def _dealt_with(decision: Decision, place: Place) -> None:
    catalog = decision.catalog
    waiting = catalog.heard.get(place, ())
    _remember(decision, place)
    for notice_id in waiting:
        hearing = catalog.hearing.get(notice_id)
        if hearing is None:
            continue
        if hearing.receivers > 1:
            decision.note(catalog.hearing, notice_id, replace(hearing, receivers=hearing.receivers - 1))
        else:
            decision.forget(catalog.hearing, notice_id)
            _end(decision, hearing.ends)
            _acknowledge(decision, hearing.provider, notice_id)


def _end(decision: Decision, held_id: str) -> None:
    """Remove a query that was taken away, when its holders know; on disk before the notice is acknowledged."""
    catalog = decision.catalog
    decision.forget(catalog.ending, held_id)
    held = catalog.held.get(held_id)
    if held is not None and held.hold is not Hold.OWED:
        if held.hold is Hold.PENDING and held_id not in catalog.direct:
            # Its thread's line broke, and the load waits for the link.
            failure = failures.withdrawn(held, "taken away before the answer to its load came")
            decision.cause(LoadResolved(held, failure))
        end_direct(decision, held_id)
        decision.forget(catalog.kept, held_id)
        decision.drop(held)


def _remember(decision: Decision, place: Place) -> None:
    catalog, heard = decision.catalog, decision.catalog.heard
    decision.note(heard, place, ())
    if len(heard) % _SWEPT_EVERY == 0:
        for old, pending in list(heard.items()):
            kind, id, _ = old
            if not pending and id not in (catalog.held if kind == "query" else catalog.resources):
                decision.forget(heard, old)
    if len(heard) > _REMEMBERED:
        for old in list(heard)[: _REMEMBERED // 2]:
            if not heard[old]:
                decision.forget(heard, old)  # so old that its notice was acknowledged long ago


def _acknowledge(decision: Decision, provider: str, notice_id: str) -> None:
    if provider:
        decision.note(decision.catalog.acked, provider, True)
        request(decision, provider, NoticesHandled([notice_id]))
