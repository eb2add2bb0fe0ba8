"""Failures: the errors with which decisions answer. Each names its object, what was expected, and what there is."""

from __future__ import annotations

from collections.abc import Sequence

from rr_actors.base.errors import LoadError, counted, did_you_mean, shortened, shown
from rr_actors.base.names import time_in
from rr_actors.base.values.canonical import shown_plain
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import Held, Hold, Resource, ServedQuery


def unknown_server(catalog: Catalog, server: str) -> Failure:
    """Return the failure of a request to a server that is not registered, or is leaving."""
    known = sorted(name for name in catalog.servers if name not in catalog.leaving)
    has = ", ".join(known) or "none"
    text = f"{catalog.name}/{shortened(server)}: registrar {catalog.name!r} has no such server"
    text += f"{did_you_mean(server, known) or ';'} it has {has}"
    return Failure("UnknownServer", text, {"server": f"{catalog.name}/{server}", "known": known})


def unknown_target(catalog: Catalog, target: str) -> Failure:
    """Return the failure of a call for an id that is neither a resource nor a query served here."""
    what = "serves no resource and no query of this id (never did, or unloaded already)"
    for held in catalog.held.values():
        if held.hold is Hold.HELD and target in (held.id, held.resource_id) and held.registrar != catalog.name:
            owner = held.registrar
            what = f"holds it, and does not serve it: call {owner!r}, which serves it as {owner}/{held.server}"
            break
    text = f"{shortened(target)}: {catalog.name!r} {what}"
    return Failure("UnknownQuery", text, {"query_id": target})


def unknown_query(catalog: Catalog, query_id: str) -> Failure:
    """Return the failure of a call for a query that this registrar does not hold."""
    text = f"query {shortened(query_id)}: {catalog.name!r} holds no such query (never did, or it is unloaded already)"
    return Failure("UnknownQuery", text, {"query_id": query_id})


def not_holder(query_id: str, origin: str, caller: str) -> Failure:
    """Return the failure of an Unload of another registrar's query."""
    text = f"query {query_id}: held by {origin!r}, not by {caller!r}; unload it there"
    return Failure("NotHolder", text, {"query_id": query_id, "origin": origin, "caller": caller})


def held_by_whole(query_id: str, whole: str) -> Failure:
    """Return the failure of an Unload from outside of a part, which would leave its whole without it, unheard."""
    text = f"query {query_id}: it is a part of {whole}; revoke its resource, or unload that with --force (force=True)"
    return Failure("UsageError", text, {"query_id": query_id, "whole": whole})


def no_response_yet(resource: Resource) -> Failure:
    """Return the failure of set_response() for a resource that has no response yet."""
    phase = resource.phase.replace("_", " ")
    text = f"resource {resource.id}: {phase}, and its load callback has not returned a response that could be replaced"
    return Failure("UsageError", text)


def not_revoked(resource: Resource, what: str) -> Failure:
    """Return the failure of revoke() for a resource that is not loaded, or is revoked already."""
    return Failure("UsageError", f"revoke: expected a resource that is loaded, got {resource.id}, which {what}")


def not_reloaded(catalog: Catalog, resource: Resource, what: str) -> Failure:
    """Return the failure of reload() for a resource that cannot be loaded again now."""
    text = (
        f"reload: expected a resource that is loaded, got {resource.id} of {catalog.origin_of(resource)}, which {what}"
    )
    return Failure("UsageError", text)


def not_swapped(catalog: Catalog, resource_id: str, part: str) -> Failure:
    """Return the failure of a swap of a part that its resource does not hold any more."""
    text = f"query {shortened(part)}: resource {resource_id} of {catalog.name!r} does not hold this part any more"
    return Failure("UnknownQuery", f"{text}, or not the spare: nothing is replaced", {"query_id": part})


def overdue(catalog: Catalog, resource: Resource, limit_s: float) -> Failure:
    """Return the failure of a load whose callback takes too long."""
    why = f"the load callback took longer than load_timeout_s={limit_s:g} s"
    return load_failed(catalog, resource, why, timeout_s=limit_s)


def interrupted(catalog: Catalog, resource: Resource, deaths: int, wait_s: float) -> Failure:
    """Return the failure of a load in whose attempts processes died; `wait_s`: for how long it is refused."""
    how = f" (it died of: {catalog.deaths})" if catalog.deaths else ""
    why = (
        f"the process died in each of {deaths} attempts of this load{how}; it is not begun again, and the"
        f" same request is refused for {wait_s:g} s"
    )
    return load_failed(catalog, resource, why)


def still_refused(catalog: Catalog, server: str, rounds: int, wait_s: float) -> Failure:
    """Return the failure of a load whose request was given up lately."""
    origin = f"{catalog.name}/{server}"
    times = "once" if rounds == 1 else f"{rounds} times"
    why = (
        f"given up {times}, as the process died in each attempt to load this request; it is refused for {wait_s:g} s"
        " from then on, and longer each time"
    )
    return Failure("LoadFailed", f"{origin}: {why}", {"server": origin}, [(origin, why)])


def not_run_again(catalog: Catalog, resource: Resource, role: str, deaths: int) -> str:
    """Say that a callback of a resource is not run any more, and what becomes of the resource."""
    what = f"{catalog.origin_of(resource)}: the process died in each of {deaths} runs of the {role} callback"
    return f"{what} for resource {resource.id}; it is not run again: {_BECOMES[role].format(id=resource.id)}"


_BECOMES = {
    "recover": "the resource is lost",
    "reload": "the resource is not reloaded, and may be unloaded in part",
    "health": "the resource is lost",
    "usage": "what the resource uses is not known",
    "pause": "the resource runs on, or is unloaded if nobody holds it",
    "resume": "the resource is lost",
    "status": "statuses of the resource go on to its holders without it",
    "unload": "the resource is kept as unload_failed; `rr-actors unload --force {id}` removes it without the callback",
}


def unload_given_up(catalog: Catalog, resource: Resource, deaths: int) -> Failure:
    """Return the failure of an unload whose callback is not run any more."""
    origin = catalog.origin_of(resource)
    text = not_run_again(catalog, resource, "unload", deaths)
    return Failure("UnloadFailed", text, {"resource_id": resource.id, "server": origin}, [(origin, text)])


def serverless(catalog: Catalog, resource: Resource) -> Failure:
    """Return the failure of an unload of a resource whose server is not registered."""
    origin = catalog.origin_of(resource)
    text = f"{origin}: resource {resource.id} {waits_for_server(catalog, resource)}; the release stays owed"
    return Failure("Unavailable", text)


def waits_for_server(catalog: Catalog, resource: Resource) -> str:
    """Say that a resource cannot be unloaded before its server is registered, and what else clears it."""
    origin = catalog.origin_of(resource)
    clears = f"register it, or clear it by `rr-actors unload --force {origin}`"
    return f"{WAITS_FOR_SERVER} {origin!r}, which is not registered: {clears}"


WAITS_FOR_SERVER = "waits for its server"


def unread(catalog: Catalog, resource: Resource) -> str:
    """Say that a resource is lost, as it does not fit the types of today."""
    why = catalog.unread[resource.id]
    return f"lost: {why}; its unload callback does not run, as it cannot have its request and response"


def recover_overdue(catalog: Catalog, resource: Resource, limit_s: float) -> Failure:
    """Return the failure of a recovery whose callback takes too long."""
    why = f"lost: the recover callback took longer than recover_timeout_s={limit_s:g} s"
    return load_failed(catalog, resource, why, timeout_s=limit_s)


def load_failed(catalog: Catalog, resource: Resource, why: str, **details: float) -> Failure:
    """Return the failure of a load of this resource for a reason that its callback has not raised."""
    origin = catalog.origin_of(resource)
    return Failure("LoadFailed", f"{origin}: {why}", {"server": origin, **details}, [(origin, why)])


def busy(catalog: Catalog, server: str, request: bytes, has: ServedQuery | None, waiting: int) -> Failure:
    """Return the failure of a load that may not wait (longer) for an exclusive resource.

    Args:
        has: the query that has it; None while nobody does.
        waiting: how many others wait.
    """
    origin = f"{catalog.name}/{server}"
    holder, since = holder_since(has)
    who = f"{holder} has it" if holder else "it is being unloaded"
    others = "" if not waiting else f", and {waiting} {'waits' if waiting == 1 else 'wait'} for it"
    what = f"{origin} with {shown(shown_plain(request))}"
    text = f"{what}: {who}{others}; give a longer wait_s, or a higher priority"
    details = {"server": origin, "holder": holder, "since": since, "waiting": waiting}
    return Failure("ResourceBusy", text, details, [(origin, f"{who}{others}")])


def holder_since(has: ServedQuery | None) -> tuple[str, float | None]:
    """Return the registrar that has a resource by this query, and when it asked for it, in seconds since 1970."""
    return ("", None) if has is None else (has.origin, time_in(has.id))


def left_behind(catalog: Catalog, resources: Sequence[Resource]) -> Failure:
    """Return the failure of the unregistration of a server, some of whose unload callbacks raised."""
    first = resources[0]
    origin = catalog.origin_of(first)
    text = f"{origin}: {counted(len(resources), 'resource')} of it could not be unloaded; {first.id}: {first.message}"
    return Failure("UnloadFailed", text, {"resource_id": first.id, "server": origin}, [(origin, first.message)])


def own_part(catalog: Catalog, ring: Sequence[str]) -> Failure:
    """Return the failure of a load that would make a resource its own part, directly or through its parts."""
    names = [catalog.origin_of(catalog.resources[id]) for id in ring]
    text = f"{names[0]}: resource {ring[0]} would be its own part: {' -> '.join([*names, names[0]])}"
    return Failure("CircularDependency", text, {"ring": names})


def circular(ring: list[str], blocked: Held) -> Failure:
    """Return the failure of a load that would wait for itself; `blocked`: the query that closes the ring."""
    names = " -> ".join([*ring, ring[0]])
    refused = f"{blocked.registrar}/{blocked.server} with {shown(shown_plain(blocked.request))}"
    text = f"a load would wait for itself: {names}; refused is the load of {refused}"
    return Failure("CircularDependency", text, {"ring": ring})


def ring_of_holds(ring: Sequence[str], held: Held) -> str:
    """Return why a resource loses a part that holds it, directly or through its own parts."""
    names = " -> ".join([ring[-1], *ring])
    return f"resource {held.parent} was its own part: {names}; released is its query {held.id} on {ring[0]}"


_RELEASED = {"released": True}
LET_GO = Failure("LoadError", "released before its load arrived", _RELEASED)
"""The failure of a Load that arrives after the Unload of the same query."""


def being_released(held: Held) -> Failure:
    """Return the failure of a load by a query that is being released."""
    return Failure("LoadError", f"{held.registrar}/{held.server}: it is being released", _RELEASED)


def is_released(error: LoadError) -> bool:
    """Return whether a load has failed because its query had been released: another query may ask for the same."""
    return "released" in error.details


def taken_before_heard(query_id: str) -> Failure:
    """Return the failure of a load whose query was taken away before its caller heard that it was held."""
    text = f"query {query_id}: taken away before its caller heard that it was held"
    return Failure("LoadError", text, {"query_id": query_id})


def withdrawn(held: Held, why: str) -> Failure:
    """Return the failure of a load that ends without an answer."""
    server = f"{held.registrar}/{held.server}"
    return Failure("LoadError", f"{server}: {why}", {"server": server})
