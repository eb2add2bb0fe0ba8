"""Recovery: a registrar goes on with all that was in progress when its process died, or stopped.

The first decision is `begin_again`, at the opening of the catalog. Then follows `register` for each server: each live
resource is recovered, kept, reloaded or lost, as the server's policy says. Then comes `begin_serving`, as on_start has
returned: an interrupted load, unload, pause or resumption runs again, as does a reload. Before that only recover
callbacks run, because the others may use what on_start makes. If on_start itself loads or unloads such a resource, its
callback runs at once (`begin_early`): on_start may wait for it.

An interrupted load whose resource nobody holds any more does not run again. Its unload callback runs, with no response.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core import holding
from rr_actors.registrar.core.callback_runs import (
    ATTEMPTS,
    LEAVE,
    MOVE,
    RELOAD,
    REST,
    awaits_trial,
    deaths_of,
    deaths_of_load,
    end_trial,
    give_up_request,
    health_waits_s,
    is_given_up,
    is_its_turn,
    limit_trial,
    note_begun,
    note_ended,
    refuse_for_a_while,
    run_id,
    start_load,
    waits_for_start,
)
from rr_actors.registrar.core.loads.loading import (
    end_reload,
    end_unload_first,
    is_reloaded,
    load,
    not_resumed,
    recover_in_turn,
    run_recover,
    run_unload_first,
    runs_on,
)
from rr_actors.registrar.core.notices import refuse_all
from rr_actors.registrar.core.status_changes import is_busy, limit_grace, spread, start_own
from rr_actors.registrar.core.status_delivery import start_deferred
from rr_actors.registrar.core.unloading import (
    balance,
    begin_unload,
    condemned,
    go_on,
    remove,
    retire,
    run_unload,
    unheld,
    unload,
)
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision, Server
from rr_actors.registrar.model.commands import (
    BeginRun,
    BeginServing,
    BeginTrial,
    CallbackEnded,
    CallbackOverdue,
    ForceUnload,
    Register,
    Reread,
    TrialOver,
    Unregister,
)
from rr_actors.registrar.model.effects import Acquitted, Died, SetTimer, StartCallback
from rr_actors.registrar.model.messages import Load, Unload
from rr_actors.registrar.model.rows import (
    NOT_BEGUN,
    PAUSED,
    PAUSING,
    RESTING,
    RESUMING,
    STANDBY,
    CallbackRun,
    Phase,
    Resource,
    ServerType,
    State,
    types_id,
)


def begin_again(decision: Decision) -> None:
    """Make the first decision of an incarnation, before any server is registered.

    A load that was interrupted is prepared for its next attempt; after ATTEMPTS of them it is refused and cleaned up.
    """
    holding.begin_again(decision)
    accused, given_up = _count_deaths(decision)
    for id in list(decision.catalog.moving):
        resource = decision.catalog.resources[id]
        if resource.phase is not Phase.LOADING or resource.tries == NOT_BEGUN:  # no server was there to begin it
            continue
        accused.append(run_id("load", id))
        deaths = deaths_of_load(decision.catalog, resource) + 1
        if (run := decision.catalog.callback_runs.get(run_id("load", id))) is not None:
            decision.put(replace(run, deaths=deaths))
        if deaths < ATTEMPTS:
            decision.put(replace(resource, attempt=resource.attempt + 1, tries=NOT_BEGUN))
        else:
            wait_s = give_up_request(decision, resource)
            failure = failures.interrupted(decision.catalog, resource, deaths, wait_s)
            given_up.append(failure.message)
            decision.effects += refuse_all(decision, resource, failure)
            # A part or all of it may be loaded. With the next number, the parts of the last attempt are released.
            decision.put(replace(resource, phase=Phase.UNLOADING, attempt=resource.attempt + 1))
            note_begun(decision, "unload", id, begun=False)
    for run in list(decision.catalog.callback_runs.values()):
        if run.id.startswith("request:"):
            refuse_for_a_while(decision, run.id)
    decision.note(decision.catalog.early, "", "")
    if accused:
        decision.cause(Died(tuple(_run_of(decision.catalog, id) for id in accused), tuple(given_up)))
    else:
        _acquit_health_callbacks(decision)
    for id in accused if not given_up else ():  # else the death is that of a callback which runs no more
        decision.note(decision.catalog.accused, id, True)


def end_process(decision: Decision) -> None:
    """Prepare for the next process, as this one ends cleanly: no callback that runs now is to blame.

    A load is prepared for its next attempt, so that the parts of this one are released. Else the number of its attempts
    says how many processes have died in it, so from now on a row does.
    """
    catalog = decision.catalog
    for run in [run for run in catalog.callback_runs.values() if run.begun]:
        decision.put(replace(run, begun=False))
    for resource in [catalog.resources[id] for id in catalog.moving]:
        if resource.phase is Phase.UNLOADING:
            note_begun(decision, "unload", resource.id, begun=False)
        elif resource.phase is Phase.LOADING and resource.tries != NOT_BEGUN:
            decision.put(CallbackRun(run_id("load", resource.id), deaths_of_load(catalog, resource)))
            decision.put(replace(resource, attempt=resource.attempt + 1, tries=NOT_BEGUN))


def _acquit_health_callbacks(decision: Decision) -> None:
    """Forget the deaths in health callbacks, as the last process has died without any callback."""
    runs = decision.catalog.callback_runs.values()
    innocent = [run for run in runs if run.id.startswith("health:") and 0 < run.deaths < ATTEMPTS]
    for run in innocent:
        decision.drop(run)
    if innocent:
        decision.cause(Acquitted())


def _count_deaths(decision: Decision) -> tuple[list[str], list[str]]:
    """Count the last process's death for each callback that ran in it; return their ids, and what runs no more."""
    catalog = decision.catalog
    unloads = [run_id("unload", id) for id in catalog.moving if catalog.resources[id].phase is Phase.UNLOADING]
    first = [CallbackRun(id, begun=True) for id in unloads if id not in catalog.callback_runs]
    accused: list[str] = []
    given_up: list[str] = []
    for run in [*(run for run in catalog.callback_runs.values() if run.begun), *first]:
        role, _, id = run.id.partition(":")
        resource = catalog.resources.get(id)
        if resource is None:
            decision.drop(run)
            continue
        deaths = run.deaths + 1
        decision.put(CallbackRun(run.id, deaths))
        accused.append(run.id)
        if deaths == ATTEMPTS:
            given_up.append(failures.not_run_again(catalog, resource, role, deaths))
    return accused, given_up


def _run_of(catalog: Catalog, run_id: str) -> str:
    role, _, id = run_id.partition(":")
    return f"the {role} callback of {catalog.origin_of(catalog.resources[id])} for resource {id}"


def register(decision: Decision, command: Register) -> None:
    """Add a server, and go on with its resources."""
    catalog = decision.catalog
    server = command.server
    decision.note(catalog.servers, server.name, server)
    for reread in command.reread:
        _reread(decision, reread, command.event)
    if command.digest:
        _note_types(decision, command)
    for resource in _to_recover(catalog, server):
        if catalog.resources.get(resource.id) is not resource:
            continue  # the end of another resource of the same request has begun its load
        if resource.id in catalog.unread:
            _lose_unread(decision, resource, command.event)
            continue
        match resource.phase:
            case Phase.LOADING | Phase.QUEUED | Phase.UNLOADING:
                if not waits_for_start(decision, resource, MOVE):
                    _move_again(decision, resource)
            case Phase.UNLOAD_FAILED:
                pass
            case _:
                _recover(decision, resource, server, command.event)
        if (left := catalog.resources.get(resource.id)) is not None and left.id not in catalog.recovering:
            _rest_again(decision, left, command.event)
    if "" not in catalog.early:
        start_own(decision, server.name)


def _move_again(decision: Decision, resource: Resource) -> None:
    """Run a load or unload again that a crash has interrupted, or one that has waited for its server."""
    match resource.phase:
        case Phase.LOADING if resource.tries == NOT_BEGUN:
            _interrupted(decision, resource)
        case Phase.LOADING:
            start_load(decision, resource)
        case Phase.QUEUED:
            decision.catalog.stir(resource)
        case _:
            run_unload(decision, resource)


# -- what waits until on_start has returned ----------------------------------------------------------------------------


def begin_serving(decision: Decision, command: BeginServing) -> None:
    """Begin all that has waited for on_start."""
    catalog = decision.catalog
    decision.forget(catalog.early, "")
    for revocation in catalog.revocations.values():
        limit_grace(decision, revocation)
    for resource_id in list(catalog.early):
        _begin_early(decision, resource_id, command.event)
    for name in catalog.servers:
        start_own(decision, name)
    catalog.stirred.update(dict.fromkeys(catalog.queued, True))


def begin_early(decision: Decision, item: object) -> None:
    """Before on_start has returned, begin what waits for that, and for what a load or unload of on_start waits."""
    catalog = decision.catalog
    ids: list[str | None] = []
    match item:
        case Load():
            query = catalog.queries.get(item.query_id)
            ids = [*catalog.unloading.get((item.server, item.request), ())]
            ids.append(catalog.joinable(item.server, item.request) if query is None else query.resource_id)
        case Unload() if (query := catalog.queries.get(item.query_id)) is not None:
            ids = [query.resource_id]
        case ForceUnload() if (resource := catalog.find(item.target)) is not None:
            ids = [resource.id]
        case Unregister():
            ids = [*catalog.by_server.get(item.name, ())]
        case _:
            pass
    for id in filter(None, ids):
        _begin_early(decision, id, f"early:{id}:{catalog.epoch}")


def _begin_early(decision: Decision, resource_id: str, event: str) -> None:
    catalog = decision.catalog
    what = decision.forget(catalog.early, resource_id)
    resource = catalog.resources.get(resource_id)
    server = None if resource is None else catalog.servers.get(resource.server)
    if what is None or resource is None or server is None:
        return
    if what == RELOAD and resource_id in catalog.recovering:
        recover_in_turn(decision, resource, server)
    elif what == MOVE and resource.phase in (Phase.LOADING, Phase.QUEUED, Phase.UNLOADING):
        _move_again(decision, resource)
    elif what == LEAVE and resource.id not in catalog.holders:
        _leave(decision, resource, server)
    elif resource.id not in catalog.recovering:
        _rest(decision, resource, event)


# -- recovery ----------------------------------------------------------------------------------------------------------


def _note_types(decision: Decision, command: Register) -> None:
    """Keep the digest of the types that all stored values fit, so that the next incarnation need not read them."""
    misfits = any(reread.misfit for reread in command.reread)
    row = ServerType(types_id(command.server.name), b"" if misfits else command.digest)
    known = decision.catalog.server_types.get(row.id)
    if known is None and decision.catalog.by_server.get(command.server.name):  # else there is nothing to read
        decision.put_later(row)
    elif known is not None and known != row:
        decision.put(row)


def _reread(decision: Decision, reread: Reread, event: str) -> None:
    """Give a stored resource the request and response that it has by today's types, or note that it does not fit."""
    resource = decision.catalog.resources.get(reread.resource_id)
    if resource is None:
        return
    if reread.misfit:
        decision.note(decision.catalog.unread, resource.id, reread.misfit)
        return
    changed = reread.response != resource.response
    resource = replace(resource, request=reread.request, response=reread.response)
    decision.put(resource)
    if changed and resource.phase is Phase.LOADED and resource.state is not State.FATAL:
        text, source = "brought up to date from an earlier version", decision.catalog.origin_of(resource)
        spread(decision, resource, event + ":upgrade", State.UPDATE, text, source, reread.response)


def _lose_unread(decision: Decision, resource: Resource, event: str) -> None:
    why = failures.unread(decision.catalog, resource)
    if resource.phase is Phase.LOADED and resource.id in decision.catalog.holders:
        if resource.state is not State.FATAL:
            spread(decision, resource, event, State.FATAL, why, decision.catalog.origin_of(resource))
        return
    if resource.phase in (Phase.QUEUED, Phase.LOADING):
        decision.effects += refuse_all(decision, resource, failures.load_failed(decision.catalog, resource, why))
    if resource.phase is Phase.QUEUED:
        unheld(decision, resource)
    elif resource.phase is not Phase.UNLOAD_FAILED:
        begin_unload(decision, resource)


def _interrupted(decision: Decision, resource: Resource) -> None:
    """Run an interrupted load again if somebody holds its resource; otherwise clean up what it left."""
    deaths = deaths_of_load(decision.catalog, resource)
    if resource.id not in decision.catalog.holders:
        unheld(decision, resource)
    elif deaths < ATTEMPTS - 1 or is_its_turn(decision, run_id("load", resource.id)):
        resource = replace(resource, tries=0)
        decision.put(resource)
        start_load(decision, resource)


def _to_recover(catalog: Catalog, server: Server) -> list[Resource]:
    """Return the server's resources that need a decision."""
    ids = catalog.by_server.get(server.name, ())
    if (
        server.recovery == "keep"
        and not (server.pauses or catalog.resting or server.has_recover)
        and not catalog.callback_runs  # a health callback may have been given up
    ):  # held resources, which are most, need no decision then
        moving, holders = catalog.moving, catalog.holders
        if len(holders) == len(catalog.resources):  # every resource is held
            ids = [id for id in {**moving, **catalog.unread} if id in ids]
        else:
            ids = [id for id in ids if id in moving or id in catalog.unread or id not in holders]
    return [catalog.resources[id] for id in ids]


def _recover(decision: Decision, resource: Resource, server: Server, event: str) -> None:
    has_recover, policy = server.has_recover, server.recovery
    if resource.id not in decision.catalog.holders:
        if not waits_for_start(decision, resource, LEAVE):
            _leave(decision, resource, server)
    elif resource.state is State.FATAL:
        return  # parts of an interrupted reload stay with it until its holders release it
    elif role := next((it for it in ("recover", "health") if is_given_up(decision.catalog, it, resource.id)), None):
        why = failures.not_run_again(decision.catalog, resource, role, deaths_of(decision.catalog, role, resource.id))
        spread(decision, resource, event, State.FATAL, why, decision.catalog.origin_of(resource))
    elif is_reloaded(decision.catalog, resource.id):
        _reload_again(decision, resource, server, event)
    elif has_recover or policy == "reload":
        decision.note(decision.catalog.recovering, resource.id, ())
        if has_recover or not waits_for_start(decision, resource, RELOAD):
            recover_in_turn(decision, resource, server)
    elif policy == "lost":
        why = "lost: its manager was restarted"
        spread(decision, resource, event, State.FATAL, why, decision.catalog.origin_of(resource))


def _reload_again(decision: Decision, resource: Resource, server: Server, event: str) -> None:
    """Go on with a reload that a crash has interrupted, unless three processes have died in its unload callback.

    Then it is recovered as after any crash. If it is only kept, it may be unloaded in part: its holders hear ERROR.
    """
    catalog = decision.catalog
    deaths = deaths_of(catalog, "reload", resource.id)
    if deaths < ATTEMPTS:
        decision.note(catalog.recovering, resource.id, ())
        if not waits_for_start(decision, resource, RELOAD):
            recover_in_turn(decision, resource, server)
        return
    end_reload(decision, resource.id, None)
    if server.has_recover or server.recovery != "keep":
        _recover(decision, resource, server, event)
    else:
        why = failures.not_run_again(catalog, resource, "reload", deaths)
        spread(decision, resource, event, State.ERROR, why, catalog.origin_of(resource))


def _leave(decision: Decision, resource: Resource, server: Server) -> None:
    """Unload a resource that nobody holds. It may be lost, unless it is kept: then it is kept warm, too."""
    if server.has_recover or server.recovery != "keep" or is_reloaded(decision.catalog, resource.id):
        begin_unload(decision, resource)
    else:
        retire(decision, resource)


# -- pauses ------------------------------------------------------------------------------------------------------------


def _rest_again(decision: Decision, resource: Resource, event: str) -> None:
    """Go on with a pause or resumption that a crash has interrupted, and with the time of an idle resource."""
    catalog = decision.catalog
    idles = resource.phase is Phase.LOADED and catalog.priority_of(resource.id) <= STANDBY
    if (idles or resource.phase in RESTING) and not waits_for_start(decision, resource, REST):
        _rest(decision, resource, event)


def _rest(decision: Decision, resource: Resource, event: str) -> None:
    """Do what _rest_again() does, as on_start has returned."""
    catalog = decision.catalog
    if resource.phase in (Phase.LOADED, PAUSED) and resource.id not in catalog.holders:
        retire(decision, resource)
    elif resource.phase in (PAUSING, RESUMING):
        role = "pause" if resource.phase is PAUSING else "resume"
        deaths = deaths_of(catalog, role, resource.id)
        if deaths < ATTEMPTS:
            go_on(decision, resource)
            return
        why = failures.not_run_again(catalog, resource, role, deaths)
        if role == "pause":
            runs_on(decision, resource)
        else:
            not_resumed(decision, resource, event, Failure("LoadFailed", why, {}))
    else:
        balance(decision, resource.id)


# -- health and usage callbacks: the disk has their runs, as the process may die in them ------------------------------


def begin_run(decision: Decision, command: BeginRun) -> None:
    """Run a health callback in which the process before may have died, or a usage callback."""
    role, id = command.role, command.resource.id
    wait_s = health_waits_s(deaths_of(decision.catalog, role, id)) if role == "health" and not command.waited else 0.0
    if wait_s:
        decision.cause(SetTimer(run_id(role, id), wait_s, replace(command, waited=True)))
    elif not awaits_trial(decision, role, id):
        _run(decision, role, command.resource)


def _run(decision: Decision, role: str, resource: Resource) -> None:
    if resource.id in decision.catalog.resources:
        note_begun(decision, role, resource.id)
    decision.cause(StartCallback(role, resource))


def run_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Note that the process lives after the callback."""
    note_ended(decision, ended.role, ended.resource_id)


# -- callbacks that run alone ------------------------------------------------------------------------------------------


def begin_trial(decision: Decision, command: BeginTrial) -> None:
    """Run a callback whose turn has come, if it still has to run."""
    catalog = decision.catalog
    if command.run_id not in catalog.trial:
        return
    limit_trial(decision, command.run_id)
    role, _, id = command.run_id.partition(":")
    resource = catalog.resources.get(id)
    server = None if resource is None else catalog.servers.get(resource.server)
    if resource is None or server is None:
        end_trial(decision, command.run_id)
        return
    match role:
        case "load" if resource.phase is Phase.LOADING and resource.tries == NOT_BEGUN and id in catalog.holders:
            _interrupted(decision, resource)
        case "unload" if resource.phase is Phase.UNLOADING:
            run_unload(decision, resource)
        case "reload" if id in catalog.recovering:
            run_unload_first(decision, resource)
        case "recover" if id in catalog.recovering:
            run_recover(decision, resource, server)
        case "pause" | "resume" if resource.phase in (PAUSING, RESUMING):
            go_on(decision, resource)
        case "health" | "usage":
            _run(decision, role, resource)
        case "status" if catalog.deferred.get(id) and not is_busy(catalog, resource):
            start_deferred(decision, id)
        case _:
            end_trial(decision, command.run_id)


def trial_over(decision: Decision, command: TrialOver) -> None:
    """Go on with the next callback, although this one has not ended."""
    end_trial(decision, command.run_id)


# -- ends --------------------------------------------------------------------------------------------------------------


def recover_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Keep a resource that lives; its holders hear an UPDATE if its response has changed, and FATAL if it is lost."""
    note_ended(decision, "recover", ended.resource_id)
    resource = _asked_after(decision, ended.resource_id, ended.run)
    if resource is None:
        return
    source, reloaded = decision.catalog.origin_of(resource), is_reloaded(decision.catalog, resource.id)
    if ended.failure is not None:
        spread(decision, resource, ended.event, State.FATAL, ended.failure.message, source)
    elif reloaded or (ended.response is not None and ended.response != resource.response):
        text = "reloaded" if reloaded else "recovered with a new response"
        spread(decision, resource, ended.event, State.UPDATE, text, source, ended.response)
    end_reload(decision, resource.id, ended.failure)
    _go_on(decision, resource.id)


def reload_ended(decision: Decision, ended: CallbackEnded) -> None:
    """Load a resource again whose unload callback has returned. If that raised, the resource stays, and is ERROR.

    One that was taken from its holders meanwhile is gone: it is not loaded again.
    """
    catalog = decision.catalog
    resource = _asked_after(decision, ended.resource_id, ended.run)
    if resource is None:
        return
    end_unload_first(decision, resource.id)
    if ended.failure is not None:
        source = catalog.origin_of(resource)
        spread(decision, resource, ended.event, State.ERROR, ended.failure.message, source)
        end_reload(decision, resource.id, ended.failure)
        _go_on(decision, resource.id)
    elif condemned(decision, resource):
        end_reload(decision, resource.id, failures.not_reloaded(catalog, resource, "was taken from its holders"))
        parked = decision.forget(catalog.recovering, resource.id)
        remove(decision, resource)
        _decide_parked(decision, parked)
    else:
        run_recover(decision, resource, catalog.servers[resource.server])


def recover_overdue(decision: Decision, overdue: CallbackOverdue) -> None:
    """Send the holders of a resource whose recover callback takes too long a FATAL status. The callback goes on."""
    resource = _asked_after(decision, overdue.resource_id, overdue.run)
    if resource is None:
        return
    end_trial(decision, run_id("recover", resource.id))
    event = f"overdue:{resource.id}:{decision.catalog.epoch}"
    source = decision.catalog.origin_of(resource)
    spread(decision, resource, event, State.FATAL, overdue.failure.message, source)
    end_reload(decision, resource.id, overdue.failure)
    _go_on(decision, resource.id)


def _asked_after(decision: Decision, resource_id: str, attempt: int) -> Resource | None:
    """Return the resource if this attempt of its recovery still runs. No decision removes it before that ends."""
    if resource_id not in decision.catalog.recovering:
        return None
    resource = decision.catalog.resources[resource_id]
    return resource if resource.attempt == attempt else None


def _go_on(decision: Decision, resource_id: str) -> None:
    """Decide what waited for the recovery of a resource: its owner's unload first, then the parked messages."""
    catalog = decision.catalog
    parked = decision.forget(catalog.recovering, resource_id)
    resource = catalog.resources[resource_id]
    server = catalog.servers.get(resource.server)
    if server is not None and server.recover_timeout_s is not None:
        decision.cause(SetTimer("recover:" + resource_id, None, None))
    if catalog.queued:
        catalog.stir(resource)
    if condemned(decision, resource):
        begin_unload(decision, resource)
    _decide_parked(decision, parked)
    if (left := catalog.resources.get(resource_id)) is not None:
        _rest_again(decision, left, f"rest:{resource_id}:{catalog.epoch}")
    start_deferred(decision, resource_id)


def _decide_parked(decision: Decision, parked: Sequence[Load | Unload]) -> None:
    for message in parked:
        if isinstance(message, Load):
            load(decision, message)
        else:
            unload(decision, message)
