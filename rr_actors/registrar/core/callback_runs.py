"""Runs of load and unload callbacks: start them, limit them, and check whether a run that ended still matters."""

from __future__ import annotations

from msgspec.structs import replace

from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.commands import LoadOverdue
from rr_actors.registrar.model.effects import SetTimer, StartLoad, StartUnload
from rr_actors.registrar.model.rows import LOADING, UNLOADING, Phase, Resource


def start_load(decision: Decision, resource: Resource) -> None:
    """Run the load callback; if the server is not registered (yet), the resource waits for it."""
    if resource.server in decision.catalog.servers:
        decision.cause(StartLoad(resource))
        limit_load(decision, resource)


def limit_load(decision: Decision, resource: Resource) -> None:
    """Set a timer for LoadOverdue, if the server limits its loads."""
    server = decision.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        failure = failures.overdue(decision.catalog, resource, server.load_timeout_s)
        overdue = LoadOverdue(resource.id, resource.attempt, failure)
        decision.cause(SetTimer("load:" + resource.id, server.load_timeout_s, overdue))


def end_limit(decision: Decision, resource: Resource) -> None:
    """Cancel the timer for LoadOverdue, as the load callback has ended."""
    server = decision.catalog.servers.get(resource.server)
    if server is not None and server.load_timeout_s is not None:
        decision.cause(SetTimer("load:" + resource.id, None, None))


def start_unload(decision: Decision, resource: Resource) -> None:
    """Run the unload callback, perhaps once more; if the server is not registered, the resource waits for it."""
    resource = replace(resource, phase=UNLOADING, tries=resource.tries + 1)
    decision.put(resource)
    if resource.server in decision.catalog.servers:
        decision.cause(StartUnload(resource))


def start_queued(decision: Decision, resource: Resource) -> None:
    """Load a QUEUED resource, if no resource of the same request is being unloaded any more."""
    if (resource.server, resource.request) not in decision.catalog.unloading:
        resource = replace(resource, phase=LOADING)
        decision.put(resource)
        start_load(decision, resource)


def running(catalog: Catalog, resource_id: str, phase: Phase, run: int) -> Resource | None:
    """Return the resource if `run` is the present run of its callback in `phase`; else None."""
    resource = catalog.resources.get(resource_id)
    if resource is None or resource.phase is not phase:
        return None
    return resource if run == (resource.tries if phase is UNLOADING else resource.attempt) else None
