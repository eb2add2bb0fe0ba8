"""Runs of load and unload callbacks: starting them, limiting them, and telling whether one that ended still matters."""

from __future__ import annotations

import msgspec

from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import LoadOverdue
from rr_actors.registrar.model.effects import SetTimer, StartLoad, StartUnload
from rr_actors.registrar.model.rows import LOADING, UNLOADING, Phase, Resource

_replace = msgspec.structs.replace


def start_load(decision: Decision, resource: Resource) -> None:
    """Have the load callback run; without its server (yet) the resource waits for it to be registered."""
    if resource.server in decision.catalog.servers:
        decision.cause(StartLoad(resource))
        limit_load(decision, resource)


def load_again(decision: Decision, resource: Resource) -> None:
    """Run the load callback of a load again that a crash has interrupted; its server is there."""
    resource = _replace(resource, tries=0)
    decision.put(resource)
    start_load(decision, resource)


def limit_load(decision: Decision, resource: Resource) -> None:
    """Have LoadOverdue come, if the server limits its loads."""
    server = decision.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        failure = failures.overdue(decision.catalog, resource, server.load_timeout_s)
        overdue = LoadOverdue(resource.id, resource.attempt, failure)
        decision.cause(SetTimer("load:" + resource.id, server.load_timeout_s, overdue))


def end_limit(decision: Decision, resource: Resource) -> None:
    """The load callback has ended."""
    server = decision.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        decision.cause(SetTimer("load:" + resource.id, None, None))


def start_unload(decision: Decision, resource: Resource) -> None:
    """Have the unload callback run (once more); without its server the resource waits for it to be registered."""
    resource = _replace(resource, phase=UNLOADING, tries=resource.tries + 1)
    decision.put(resource)
    if resource.server in decision.catalog.servers:
        decision.cause(StartUnload(resource))


def start_queued(decision: Decision, resource: Resource) -> None:
    """Let a QUEUED resource load, if nothing of the same request is being unloaded any more."""
    if (resource.server, resource.request) not in decision.catalog.unloading:
        resource = _replace(resource, phase=LOADING)
        decision.put(resource)
        start_load(decision, resource)


def running(catalog: Catalog, resource_id: str, phase: Phase, run: int) -> Resource | None:
    """The resource, if it is still that run of its callback that has ended."""
    resource = catalog.resources.get(resource_id)
    if resource is None or resource.phase is not phase:
        return None
    return resource if run == (resource.tries if phase is UNLOADING else resource.attempt) else None
