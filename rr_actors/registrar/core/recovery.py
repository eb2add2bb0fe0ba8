"""Taking up again what a catalog says was going on when its process died, or stopped.

At opening: `begin_again`. Then, as each server is registered: an interrupted load or unload runs again, and each live
resource is asked after, or kept, reloaded or given up as the server's policy says.

An interrupted load that nobody holds any more is not run again: its unload callback runs, with no response.
"""

from __future__ import annotations

import msgspec

from rr_actors.registrar.core import holding
from rr_actors.registrar.core.callback_runs import load_again, start_load, start_queued, start_unload
from rr_actors.registrar.core.loading import load
from rr_actors.registrar.core.notices import refuse_all
from rr_actors.registrar.core.releasing import release_parts
from rr_actors.registrar.core.status_changes import spread, start_own
from rr_actors.registrar.core.status_delivery import start_deferred
from rr_actors.registrar.core.unloading import begin_unload, condemned, retire, unheld, unload
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Batch, Catalog, Server
from rr_actors.registrar.model.commands import RecoverDone, RecoverErred, Register
from rr_actors.registrar.model.effects import StartRecover
from rr_actors.registrar.model.messages import Load, Unload
from rr_actors.registrar.model.rows import NOT_BEGUN, Phase, Resource, State

_replace = msgspec.structs.replace


ATTEMPTS = 3
"""How often a load is begun whose process dies each time. With the default restart intensity, once more would end the
supervisor: one request could take a whole tree down, and again at each start."""


def begin_again(batch: Batch) -> None:
    """The first decision of an incarnation, before any server is registered."""
    holding.begin_again(batch)
    for id in list(batch.catalog.moving):
        resource = batch.catalog.resources[id]
        if resource.phase is not Phase.LOADING:
            continue
        if resource.tries == NOT_BEGUN:  # its server was not there: not an attempt
            batch.note(batch.catalog.interrupted, id, True)
        elif resource.attempt < ATTEMPTS:
            batch.put(_replace(resource, attempt=resource.attempt + 1, tries=NOT_BEGUN))
            batch.note(batch.catalog.interrupted, id, True)
        else:
            for reply in refuse_all(batch, resource, failures.interrupted(batch.catalog, resource)):
                batch.cause(reply)
            # It may be half there, or wholly; what its last attempt loaded is told by the number, and released.
            batch.put(_replace(resource, phase=Phase.UNLOADING, attempt=resource.attempt + 1))


def register(batch: Batch, command: Register, event: str) -> None:
    """A server is there: take up its resources."""
    catalog = batch.catalog
    server = command.server
    batch.note(catalog.servers, server.name, server)
    for resource in _to_take_up(catalog, server):
        match resource.phase:
            case Phase.LOADING if resource.id in catalog.interrupted:
                _interrupted(batch, resource)
            case Phase.LOADING:
                start_load(batch, resource)
            case Phase.QUEUED:
                start_queued(batch, resource)
            case Phase.UNLOADING:
                start_unload(batch, resource)
            case Phase.LOADED:
                _recover(batch, resource, server.has_recover, server.recovery, event)
            case Phase.UNLOAD_FAILED:
                pass
    start_own(batch, server.name)


def _interrupted(batch: Batch, resource: Resource) -> None:
    """Run a load again that somebody holds; clean up what one has left that nobody wants."""
    if resource.id in batch.catalog.holders:
        load_again(batch, resource)
    else:
        unheld(batch, resource)


def _to_take_up(catalog: Catalog, server: Server) -> list[Resource]:
    """The server's resources that something is to be done about."""
    ids = catalog.by_server.get(server.name, ())
    if server.recovery == "keep" and not server.has_recover:  # nothing is asked about those that are held: most of them
        moving, holders = catalog.moving, catalog.holders
        if len(holders) == len(catalog.resources):  # all of them
            ids = [id for id in moving if id in ids]
        else:
            ids = [id for id in ids if id in moving or id not in holders]
    return [catalog.resources[id] for id in ids]


def _recover(batch: Batch, resource: Resource, has_recover: bool, policy: str, event: str) -> None:
    if resource.id not in batch.catalog.holders:
        if has_recover or policy != "keep":  # it may be lost, and nobody needs to know
            begin_unload(batch, resource)
        else:
            retire(batch, resource)
    elif resource.state is State.FATAL:
        return  # what an interrupted reload had loaded stays with it until its holders let go
    elif has_recover:
        batch.note(batch.catalog.recovering, resource.id, ())
        batch.cause(StartRecover(resource, reload=False))
    elif policy == "reload":
        again = _replace(resource, attempt=resource.attempt + 1)
        batch.put(again)
        batch.note(batch.catalog.recovering, resource.id, ())
        release_parts(batch, resource.id, (StartRecover(again, reload=True),), keep_attempt=again.attempt)
    elif policy == "lost":
        why = "lost: its manager was restarted"
        spread(batch, resource, event, State.FATAL, why, batch.catalog.origin_of(resource))


def recover_done(batch: Batch, done: RecoverDone) -> None:
    """It lives; a changed response is an UPDATE to its holders."""
    resource = _asked_after(batch, done.resource_id, done.attempt)
    if resource is None:
        return
    if done.response is not None and done.response != resource.response:
        source = batch.catalog.origin_of(resource)
        spread(batch, resource, done.event, State.UPDATE, "recovered with a new response", source, done.response)
    _go_on(batch, resource.id, batch.forget(batch.catalog.recovering, resource.id))


def recover_erred(batch: Batch, erred: RecoverErred) -> None:
    """It is lost: FATAL to its holders."""
    resource = _asked_after(batch, erred.resource_id, erred.attempt)
    if resource is None:
        return
    source = batch.catalog.origin_of(resource)
    spread(batch, resource, erred.event, State.FATAL, erred.failure.message, source)
    _go_on(batch, resource.id, batch.forget(batch.catalog.recovering, resource.id))


def _asked_after(batch: Batch, resource_id: str, attempt: int) -> Resource | None:
    """The resource, if it is being asked after; it cannot go as long as it is."""
    if resource_id not in batch.catalog.recovering:
        return None
    resource = batch.catalog.resources[resource_id]
    return resource if resource.attempt == attempt else None


def _go_on(batch: Batch, resource_id: str, parked: tuple[Load | Unload, ...]) -> None:
    """Do what came in while the resource was being asked after: first what its owner wants, then the rest in turn."""
    resource = batch.catalog.resources[resource_id]
    if condemned(batch, resource):
        begin_unload(batch, resource)
    for message in parked:
        if isinstance(message, Load):
            load(batch, message)
        else:
            unload(batch, message)
    _unless_held(batch, batch.catalog.resources.get(resource_id))
    start_deferred(batch, resource_id)


def _unless_held(batch: Batch, resource: Resource | None) -> None:
    if resource is not None and resource.phase is Phase.LOADED and resource.id not in batch.catalog.holders:
        retire(batch, resource)
