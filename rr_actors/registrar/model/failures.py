"""Failures: the errors that decisions themselves answer with. Each says who, what was expected, and what there is."""

from __future__ import annotations

from collections.abc import Sequence

from rr_actors.base.errors import did_you_mean, shortened, shown
from rr_actors.base.values.canonical import shown_plain
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.messages import Failure
from rr_actors.registrar.model.rows import Held, Resource


def unknown_server(catalog: Catalog, server: str) -> Failure:
    """No such server, or it is leaving."""
    known = sorted(name for name in catalog.servers if name not in catalog.leaving)
    has = ", ".join(known) or "none"
    text = f"{catalog.name}/{shortened(server)}: registrar {catalog.name!r} has no such server"
    text += f"{did_you_mean(server, known) or ';'} it has {has}"
    return Failure("UnknownServer", text, {"server": f"{catalog.name}/{server}", "known": known})


def unknown_target(catalog: Catalog, target: str) -> Failure:
    """Neither a resource nor a query that is served here."""
    what = "serves no resource and no query of this id (never did, or unloaded already)"
    text = f"{shortened(target)}: {catalog.name!r} {what}"
    return Failure("UnknownQuery", text, {"query_id": target})


def unknown_query(catalog: Catalog, query_id: str) -> Failure:
    """Not a query of this registrar's own."""
    text = f"query {shortened(query_id)}: {catalog.name!r} holds no such query (never did, or it is unloaded already)"
    return Failure("UnknownQuery", text, {"query_id": query_id})


def not_holder(query_id: str, origin: str, caller: str) -> Failure:
    """Another registrar's query."""
    text = f"query {query_id}: held by {origin!r}, not by {caller!r}; unload it there"
    return Failure("NotHolder", text, {"query_id": query_id, "origin": origin, "caller": caller})


def no_response_yet(resource: Resource) -> Failure:
    """There is no response that could be replaced."""
    phase = resource.phase.replace("_", " ")
    text = f"resource {resource.id}: {phase}, and its load callback has not returned a response that could be replaced"
    return Failure("UsageError", text)


def not_swapped(catalog: Catalog, resource_id: str, part: str) -> Failure:
    """A part that its resource does not hold any more cannot be replaced."""
    text = f"query {shortened(part)}: resource {resource_id} of {catalog.name!r} does not hold this part any more"
    return Failure("UnknownQuery", f"{text}, or not the spare: nothing is replaced", {"query_id": part})


def overdue(catalog: Catalog, resource: Resource, limit_s: float) -> Failure:
    """The load callback takes too long."""
    name = catalog.origin_of(resource)
    text = f"{name}: the load callback took longer than load_timeout_s={limit_s:g} s"
    return Failure("LoadFailed", text, {"server": name, "timeout_s": limit_s}, [(name, text)])


def interrupted(catalog: Catalog, resource: Resource) -> Failure:
    """The process died each time the load callback ran."""
    origin = catalog.origin_of(resource)
    how = f" (it died of: {catalog.deaths})" if catalog.deaths else ""
    text = f"the process died in each of {resource.attempt} attempts of this load{how}; it is not begun again"
    return Failure("LoadFailed", f"{origin}: {text}", {"server": origin}, [(origin, text)])


def evicted(catalog: Catalog, resource: Resource, why: str) -> Failure:
    """The resource was taken away while it was loading."""
    origin = catalog.origin_of(resource)
    return Failure("LoadFailed", f"{origin}: {why}", {"server": origin}, [(origin, why)])


def left_behind(catalog: Catalog, resources: Sequence[Resource]) -> Failure:
    """A server has left, and some of its unload callbacks raised."""
    first = resources[0]
    origin = catalog.origin_of(first)
    text = f"{origin}: {len(resources)} of its resources could not be unloaded; {first.id}: {first.message}"
    return Failure("UnloadFailed", text, {"resource_id": first.id, "server": origin}, [(origin, first.message)])


def circular(ring: list[str], blocked: Held) -> Failure:
    """A load would wait for itself. `blocked`: the query that closes the ring; only its request is known here."""
    names = " -> ".join([*ring, ring[0]])
    refused = f"{blocked.registrar}/{blocked.server} with {shown(shown_plain(blocked.request))}"
    text = f"a load would wait for itself: {names}; refused is the load of {refused}"
    return Failure("CircularDependency", text, {"ring": ring})


LET_GO = Failure("LoadError", "released before its load arrived")
"""A load that comes, or comes again, behind its own withdrawal."""


def taken_before_heard(query_id: str) -> Failure:
    """A load was answered, and what it got taken away, before its caller heard of either."""
    text = f"query {query_id}: taken away before its caller heard that it was held"
    return Failure("LoadError", text, {"query_id": query_id})


def withdrawn(held: Held, why: str) -> Failure:
    """A load ends unanswered."""
    server = f"{held.registrar}/{held.server}"
    return Failure("LoadError", f"{server}: {why}", {"server": server})
