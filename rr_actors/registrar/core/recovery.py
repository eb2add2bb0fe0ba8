"""Recovery: a registrar goes on with all that was in progress when its process died, or stopped.

The first decision is `begin_again`, at the opening of the catalog. Then follows `register` for each server: an
interrupted load or unload runs again, and each live resource is recovered, kept, reloaded or lost, as the server's
policy says.

An interrupted load whose resource nobody holds any more does not run again. Its unload callback runs, with no response.
"""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.registrar.core import holding
from rr_actors.registrar.core.callback_runs import start_load, start_queued, start_unload
from rr_actors.registrar.core.loading import load
from rr_actors.registrar.core.notices import refuse_all
from rr_actors.registrar.core.releasing import release_parts
from rr_actors.registrar.core.status_changes import spread, start_own
from rr_actors.registrar.core.status_delivery import start_deferred
from rr_actors.registrar.core.unloading import begin_unload, condemned, retire, unheld, unload
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision, Server
from rr_actors.registrar.model.commands import RecoverDone, RecoverErred, Register
from rr_actors.registrar.model.effects import StartRecover
from rr_actors.registrar.model.messages import Load
from rr_actors.registrar.model.rows import NOT_BEGUN, Phase, Resource, State

ATTEMPTS = 3
"""How often a load begins whose process dies each time. With the default restart intensity, one more death would end
the supervisor: one request could take a whole tree down, and again at each start."""


def begin_again(decision: Decision) -> None:
    """Make the first decision of an incarnation, before any server is registered.

    A load that was interrupted is prepared for its next attempt; after ATTEMPTS of them it is refused and cleaned up.
    """
    holding.begin_again(decision)
    for id in list(decision.catalog.moving):
        resource = decision.catalog.resources[id]
        if resource.phase is not Phase.LOADING or resource.tries == NOT_BEGUN:  # no server was there to begin it
            continue
        if resource.attempt < ATTEMPTS:
            decision.put(replace(resource, attempt=resource.attempt + 1, tries=NOT_BEGUN))
        else:
            decision.effects += refuse_all(decision, resource, failures.interrupted(decision.catalog, resource))
            # A part or all of it may be loaded. With the next number, the parts of the last attempt are released.
            decision.put(replace(resource, phase=Phase.UNLOADING, attempt=resource.attempt + 1))


def register(decision: Decision, command: Register) -> None:
    """Add a server, and go on with its resources."""
    catalog = decision.catalog
    server = command.server
    decision.note(catalog.servers, server.name, server)
    for resource in _to_recover(catalog, server):
        match resource.phase:
            case Phase.LOADING if resource.tries == NOT_BEGUN:
                _interrupted(decision, resource)
            case Phase.LOADING:
                start_load(decision, resource)
            case Phase.QUEUED:
                start_queued(decision, resource)
            case Phase.UNLOADING:
                start_unload(decision, resource)
            case Phase.LOADED:
                _recover(decision, resource, server.has_recover, server.recovery, command.event)
            case Phase.UNLOAD_FAILED:
                pass
    start_own(decision, server.name)


def _interrupted(decision: Decision, resource: Resource) -> None:
    """Run an interrupted load again if somebody holds its resource; otherwise clean up what it left."""
    if resource.id in decision.catalog.holders:
        resource = replace(resource, tries=0)
        decision.put(resource)
        start_load(decision, resource)
    else:
        unheld(decision, resource)


def _to_recover(catalog: Catalog, server: Server) -> list[Resource]:
    """Return the server's resources that need a decision."""
    ids = catalog.by_server.get(server.name, ())
    if server.recovery == "keep" and not server.has_recover:  # held resources, which are most, need no decision then
        moving, holders = catalog.moving, catalog.holders
        if len(holders) == len(catalog.resources):  # every resource is held
            ids = [id for id in moving if id in ids]
        else:
            ids = [id for id in ids if id in moving or id not in holders]
    return [catalog.resources[id] for id in ids]


def _recover(decision: Decision, resource: Resource, has_recover: bool, policy: str, event: str) -> None:
    if resource.id not in decision.catalog.holders:
        if has_recover or policy != "keep":  # it may be lost, so it is not kept warm
            begin_unload(decision, resource)
        else:
            retire(decision, resource)
    elif resource.state is State.FATAL:
        return  # parts of an interrupted reload stay with it until its holders release it
    elif has_recover:
        decision.note(decision.catalog.recovering, resource.id, ())
        decision.cause(StartRecover(resource, reload=False))
    elif policy == "reload":
        again = replace(resource, attempt=resource.attempt + 1)
        decision.put(again)
        decision.note(decision.catalog.recovering, resource.id, ())
        release_parts(decision, resource.id, (StartRecover(again, reload=True),), keep_attempt=again.attempt)
    elif policy == "lost":
        why = "lost: its manager was restarted"
        spread(decision, resource, event, State.FATAL, why, decision.catalog.origin_of(resource))


def recover_done(decision: Decision, done: RecoverDone) -> None:
    """Keep a resource that lives; send its holders an UPDATE if its response has changed."""
    resource = _asked_after(decision, done.resource_id, done.attempt)
    if resource is None:
        return
    if done.response is not None and done.response != resource.response:
        source = decision.catalog.origin_of(resource)
        spread(decision, resource, done.event, State.UPDATE, "recovered with a new response", source, done.response)
    _go_on(decision, resource.id)


def recover_erred(decision: Decision, erred: RecoverErred) -> None:
    """Send the holders of a lost resource a FATAL status."""
    resource = _asked_after(decision, erred.resource_id, erred.attempt)
    if resource is None:
        return
    source = decision.catalog.origin_of(resource)
    spread(decision, resource, erred.event, State.FATAL, erred.failure.message, source)
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
    if condemned(decision, resource):
        begin_unload(decision, resource)
    for message in parked:
        if isinstance(message, Load):
            load(decision, message)
        else:
            unload(decision, message)
    left = catalog.resources.get(resource_id)
    if left is not None and left.phase is Phase.LOADED and resource_id not in catalog.holders:
        retire(decision, left)
    start_deferred(decision, resource_id)
