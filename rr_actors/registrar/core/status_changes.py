"""The decisions of a provider about statuses of its resources and about new responses, for every holder.

A status that the owner sets goes to the status callback of the resource's server first. The resource's row has it at
once. A notice of the server's own (rows.is_own) says that the callback has to run. The commit that drops this notice
adds the notices for the holders, unless the callback has handled the status. A status that a status callback sets on
its own resource goes to the holders directly.

A status callback does not run while the load or recover callback of its resource runs: before these return, there is no
response that it may replace. Until then the status is deferred.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

from msgspec.structs import replace

from rr_actors.registrar.core.callback_runs import awaits_trial, is_given_up, note_begun
from rr_actors.registrar.core.notices import drop_notice, drop_superseded, notify, own_notices
from rr_actors.registrar.core.priorities import touch
from rr_actors.registrar.core.releasing import owe
from rr_actors.registrar.core.unloading import begin_unload, stay_lost
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision, DueStatus
from rr_actors.registrar.model.commands import GraceOver, Revoke, SetResponse, SetStatus, Swap
from rr_actors.registrar.model.effects import AnswerCall, Happened, SetTimer, StartCallback
from rr_actors.registrar.model.messages import Unload
from rr_actors.registrar.model.rows import (
    LOADED,
    RESTING,
    REVOKED,
    Held,
    Hold,
    Notice,
    Phase,
    Resource,
    Revocation,
    State,
)

# -- to the holders ------------------------------------------------------------------------------------------------


def spread(
    decision: Decision,
    resource: Resource,
    event: str,
    state: State,
    message: str,
    source: str,
    response: bytes | None = None,
    *,
    repeated: bool = False,
) -> None:
    """Note a status on the resource, and send it once to every holder."""
    said = Notice(event, "", "", resource.id, event, state, message, source, False, response)
    _tell_holders(decision, _note(decision, resource, said), said, repeated=repeated)


def _note(decision: Decision, resource: Resource, said: Notice) -> Resource:
    lasting = State.FATAL if resource.state is State.FATAL else said.state
    if lasting is not resource.state and lasting is State.FATAL:
        touch(decision, resource.id)  # it needs its parts no more
    response = resource.response if said.response is None else said.response
    is_new = (lasting, said.message) != (resource.state, resource.message)  # else it would fill the memory
    resource = replace(resource, state=lasting, message=said.message, response=response)
    decision.put(resource)
    decision.cause(Happened("status", resource, f"{said.state} {said.message}".rstrip(), said, is_new))
    if lasting is State.FATAL and resource.phase in RESTING:
        return stay_lost(decision, resource, said.message)
    return resource


def _tell_holders(decision: Decision, resource: Resource, said: Notice, *, repeated: bool = False) -> None:
    for query in decision.catalog.queries_of(resource.id):
        notify(decision, query, said, repeated=repeated)
    _end_if_unwanted(decision, resource)


def _end_if_unwanted(decision: Decision, resource: Resource) -> None:
    loaded = resource.phase in (Phase.LOADED, Phase.PAUSED) and resource.id not in decision.catalog.recovering
    if resource.state is State.FATAL and loaded and resource.id not in decision.catalog.holders:
        begin_unload(decision, resource)  # it lingered; no new request will join it


# -- revocations -------------------------------------------------------------------------------------------------------
#
# A holder hears that a resource is revoked as a FATAL status. When it has heard that, it lets the resource go. A
# resource that depends on it is revoked itself, unless its status callback has put another in its place, or has handled
# the status. So the highest are unloaded first, and each part after the last of its wholes. Each step is one decision:
# the notice is acknowledged in the same commit that owes the release, or has the row of the next revocation.


def revoke(decision: Decision, command: Revoke) -> None:
    """Revoke a resource; answer the owner when it is gone."""
    catalog = decision.catalog
    resource = catalog.find(command.target)
    if resource is None:
        decision.cause(AnswerCall(command.ticket, failures.unknown_target(catalog, command.target)))
    elif resource.id in catalog.revocations:
        decision.cause(AnswerCall(command.ticket, failures.not_revoked(resource, "is revoked already")))
    elif not is_revocable(catalog, resource):
        phase = "recovering" if resource.id in catalog.recovering else resource.phase
        decision.cause(AnswerCall(command.ticket, failures.not_revoked(resource, f"is {phase}")))
    else:
        decision.note(catalog.owners, resource.id, (*catalog.owners.get(resource.id, ()), command.ticket))
        begin_revocation(decision, resource, Revocation(resource.id, command.event, command.why, command.grace_ms))


def is_revocable(catalog: Catalog, resource: Resource) -> bool:
    """Return whether a resource is loaded, so that its holders can be asked to release it."""
    loaded = resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED, *RESTING)
    return loaded and resource.id not in catalog.recovering


def begin_revocation(decision: Decision, resource: Resource, revocation: Revocation, source: str = "") -> None:
    """Ask the holders of a resource to release it; `source`: the server where that began, if it is another."""
    decision.put(revocation)
    limit_grace(decision, revocation)
    decision.cause(Happened("revoked", resource, revocation.why, kept=True))
    source = source or decision.catalog.origin_of(resource)
    place = (revocation.event, "", "", resource.id, revocation.event, State.FATAL, revocation.why, source)
    said = Notice(*place, reason=REVOKED, grace_ms=revocation.grace_ms)
    resource = _note(decision, resource, said)
    _tell_holders(decision, resource, said)
    if resource.phase is Phase.UNLOAD_FAILED and resource.id not in decision.catalog.holders:
        begin_unload(decision, resource)


def limit_grace(decision: Decision, revocation: Revocation) -> None:
    """Set the timer for the forced unload of a revoked resource."""
    over = GraceOver(revocation.id, revocation.event)
    decision.cause(SetTimer("revoke:" + revocation.id, revocation.grace_ms / 1000, over))


def pass_revocation_on(decision: Decision, resource: Resource, notice: Notice, *, handled: bool) -> None:
    """Have a resource give up a revoked part: only the part, if that is `handled`; else the resource is revoked, too.

    What is lost needs no part, and its holders have heard so: it gives up the part alone. They may hold it for long
    still, for example until they have found something else, which may need just what the part has. If the resource does
    not hold the part any more, there is nothing to do: it has put another in its place.
    """
    catalog = decision.catalog
    parts = [catalog.held[id] for id in catalog.parts_of(resource.id)]
    revoked = [held for held in parts if held.resource_id == notice.resource_id and held.hold is not Hold.OWED]
    if not revoked or resource.id in catalog.revocations:
        return
    if handled or (resource.state is State.FATAL and not _may_revive(catalog, resource)):
        for held in revoked:
            let_go(decision, held)
    elif is_revocable(catalog, resource):
        event = f"{notice.event.partition(':')[0]}:{resource.id}"
        revocation = Revocation(resource.id, event, notice.message, notice.grace_ms)
        begin_revocation(decision, resource, revocation, notice.source)


def let_go(decision: Decision, held: Held) -> None:
    """Release a query whose holder has heard that the resource is revoked. It is not held again."""
    owe(decision, held, "its resource is revoked")
    decision.put(replace(held, hold=Hold.OWED, resource_id=""))
    decision.request(held.registrar, Unload(held.id, decision.catalog.name))


# -- to the server of the resource ---------------------------------------------------------------------------------


def start_status(decision: Decision, due: DueStatus) -> None:
    """Run the status callback of the resource; defer it while the load or recover callback runs, or until its turn."""
    catalog = decision.catalog
    resource = catalog.resources[due.resource.id]
    if is_busy(catalog, resource) or awaits_trial(decision, "status", resource.id):
        deferred = catalog.deferred
        decision.note(deferred, resource.id, (*deferred.get(resource.id, ()), due))
        return
    if is_heard_by(catalog, resource):
        if resource.id not in catalog.statuses:
            note_begun(decision, "status", resource.id)
        decision.note(catalog.statuses, resource.id, catalog.statuses.get(resource.id, 0) + 1)
    decision.cause(StartCallback("status", resource, due.notice, due.repeated))


def start_in_turn(decision: Decision, due: DueStatus) -> None:
    """Run the status callback for a status of its own resource; if a window of runs has been caused, when these end."""
    catalog, id = decision.catalog, due.resource.id
    late = catalog.late.get(id)
    if late is None and catalog.statuses.get(id, 0) + len(catalog.deferred.get(id, ())) < catalog.window:
        start_status(decision, due)
        return
    if late is None:
        late = {}
        decision.note(catalog.late, id, late)
    decision.note(late, due.notice.id, due)
    if len(late) > catalog.backlog:
        oldest = list(islice(late, catalog.window))
        drop_superseded(decision, [catalog.notices[old] for old in oldest])
        for old in oldest:
            if old not in catalog.notices:
                decision.forget(late, old)


def is_heard_by(catalog: Catalog, resource: Resource) -> bool:
    """Return whether a status callback runs for statuses of the resource and of its parts."""
    server = catalog.servers.get(resource.server)
    return server is not None and server.has_status and not is_given_up(catalog, "status", resource.id)


def is_busy(catalog: Catalog, resource: Resource) -> bool:
    """Return whether the load or recover callback of the resource has not returned yet."""
    return resource.phase in (Phase.QUEUED, Phase.LOADING) or resource.id in catalog.recovering


def start_own(decision: Decision, server: str) -> None:
    """Run the server's status callback again for the notices of its own that it had not dealt with before a crash.

    Newer notices are left out: the callback has run for them, or still runs, even if the server was unregistered
    meanwhile.
    """
    catalog = decision.catalog
    for resource_id in list(catalog.own_notices):
        resource = catalog.resources[resource_id]
        if resource.server == server:
            for notice in own_notices(decision, resource_id):
                if decision.forget(catalog.told, notice.id) is None:
                    continue
                if is_given_up(catalog, "status", resource_id):
                    own_done(decision, notice, handled=False)
                else:
                    start_in_turn(decision, DueStatus(resource, notice, repeated=True))


def own_done(decision: Decision, notice: Notice, *, handled: bool) -> None:
    """Note that the status callback has run for a status of its own resource: send it to the holders, unless handled.

    A new response is sent to the holders even then; and the newest one, as the callback may have replaced it once more.
    """
    resource = decision.catalog.resources.get(notice.resource_id)
    if resource is None or notice.id not in decision.catalog.notices:
        return
    drop_notice(decision, notice)
    if handled and notice.response is None:
        _end_if_unwanted(decision, resource)
    else:
        if notice.state is State.FATAL and resource.state is not State.FATAL:  # a swap has revived it meanwhile
            resource = _note(decision, resource, notice)
        newest = None if notice.response is None else resource.response
        _tell_holders(decision, resource, replace(notice, response=newest))


# -- calls of the owner --------------------------------------------------------------------------------------------


def set_status(decision: Decision, command: SetStatus) -> None:
    """Set a status of a resource: its server hears it first, then all holders."""
    resource = decision.catalog.find(command.target)
    if resource is None:
        decision.cause(AnswerCall(command.ticket, failures.unknown_target(decision.catalog, command.target)))
        return
    _say(decision, resource, command, command.state, None)
    decision.cause(AnswerCall(command.ticket, None))


def set_response(decision: Decision, command: SetResponse) -> None:
    """Replace the response of a resource, and send it to every holder with an UPDATE."""
    resource = decision.catalog.find(command.target)
    if resource is None:
        decision.cause(AnswerCall(command.ticket, failures.unknown_target(decision.catalog, command.target)))
    elif resource.response is None:  # it is loading, or it is an interrupted load that is being cleaned up
        decision.cause(AnswerCall(command.ticket, failures.no_response_yet(resource)))
    else:
        _say(decision, resource, command, State.UPDATE, command.response)
        decision.cause(AnswerCall(command.ticket, None))


def swap(decision: Decision, command: Swap) -> None:
    """Put a spare in the place of a part: one commit has the spare held, the part owed, and the new response."""
    catalog = decision.catalog
    resource = catalog.resources.get(command.resource_id)
    part, spare = (_part(catalog, command.resource_id, id) for id in (command.part, command.spare))
    if resource is None or resource.phase not in (LOADED, *RESTING) or part is None or spare is None:
        _release(decision, command.resource_id, (command.spare,))
        failure = failures.not_swapped(catalog, command.resource_id, command.part)
        decision.cause(AnswerCall(command.ticket, failure))
        return
    decision.put(spare)  # the disk may not have it yet
    _release(decision, resource.id, (command.part, *command.others))
    resource = _revived(decision, resource)
    if command.response is not None:
        said = SetResponse(resource.id, command.event, command.response, command.message, None, resource.id)
        _say(decision, resource, said, State.UPDATE, command.response)
    decision.cause(AnswerCall(command.ticket, None))


def _revived(decision: Decision, resource: Resource) -> Resource:
    """Return the resource as it is with its spare: not lost any more, if its status callback still hears the FATAL.

    If a new request has got another resource meanwhile, it stays FATAL: of each request, one resource is given away.
    """
    catalog = decision.catalog
    if not _may_revive(catalog, resource) or resource.id in catalog.revocations:
        return resource
    if resource.phase is not LOADED or catalog.joinable(resource.server, resource.request) is not None:
        return resource
    touch(decision, resource.id)  # it needs its parts again
    resource = replace(resource, state=State.UPDATE)
    decision.put(resource)
    return resource


def _may_revive(catalog: Catalog, resource: Resource) -> bool:
    """Return whether a resource is FATAL, and its status callback has not dealt with that yet."""
    own = (catalog.notices[id].state for id in catalog.own_notices.get(resource.id, ()))
    return resource.state is State.FATAL and State.FATAL in own


def _part(catalog: Catalog, resource_id: str, query_id: str) -> Held | None:
    held = catalog.held.get(query_id)
    return held if held is not None and held.hold is Hold.HELD and held.parent == resource_id else None


def _release(decision: Decision, resource_id: str, ids: Iterable[str]) -> None:
    """Release parts so that they are not held again, even if their unload callback raises."""
    for id in ids:
        if (held := _part(decision.catalog, resource_id, id)) is not None:
            decision.put(replace(held, hold=Hold.OWED, resource_id=""))
            decision.request(held.registrar, Unload(held.id, decision.catalog.name))


def _say(
    decision: Decision, resource: Resource, command: SetStatus | SetResponse, state: State, response: bytes | None
) -> None:
    source = decision.catalog.origin_of(resource)
    event, message = command.event, command.message
    said = Notice(f"{event}:", "", "", resource.id, event, state, message, source, False, response)
    resource = _note(decision, resource, said)
    if command.callback_of == resource.id or not is_heard_by(decision.catalog, resource):
        _tell_holders(decision, resource, said)
    else:
        decision.put(said)
        start_in_turn(decision, DueStatus(resource, said, repeated=False))
