"""Explanations: sentences that say who holds a resource, for whom, since when, and why it waits; events as lines."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

from rr_actors.base.errors import UnknownQuery, shown
from rr_actors.registrar.pages import Holder, QueryRow, ResourceRow
from rr_actors.supervision.event_history import Record
from rr_actors.system.console.console_client import ConsoleClient
from rr_actors.system.console.console_messages import Event, Find, Found, Missed

_DEEP = 8  # resources above one another
_ID = re.compile(r"[0-9a-f]{12}7[0-9a-f]{19}")
_EARLIEST_S = 1_600_000_000.0  # an id that is no UUIDv7 gives another time


def explain(client: ConsoleClient, id: str) -> list[str]:
    """Return sentences about the query or resource whose id is, or begins with, `id`.

    Raises:
        UnknownQuery: no registrar has such an id.
    """
    found = client.ask(Find(id), Found)
    if not found.queries and not found.resources:
        hint = "; ".join(found.notes) or "rr-actors resources lists those that there are"
        raise UnknownQuery(f"{shown(id)}: no query and no resource has this id ({hint})", query_id=id)
    lines: list[str] = []
    for query in found.queries:
        lines += _of_query(query)
    for resource in found.resources:
        lines += _of_resource(client, resource)
    return [*lines, *(f"Not asked: {note}" for note in found.notes)]


def since(id: str) -> float | None:
    """Return when an id was made, in seconds since the epoch, if it is a UUIDv7; None for another kind of id."""
    if _ID.match(id) is None:
        return None
    at = int(id[:12], 16) / 1000
    return at if at > _EARLIEST_S else None


def ago(seconds: float) -> str:
    """Return a time span for people: "5 s", "3 min", "2 h 10 min", "4 days"."""
    minutes = round(seconds / 60)  # rounded before it is divided: else there would be "1 h 60 min"
    if round(seconds) < 60:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 2 * 24 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{seconds / 86_400:.0f} days"


def event_line(event: Event) -> str:
    """Return an event of the feed as a line for people: its time, kind, subject, and the facts that are not empty."""
    facts = {key: value for key, value in event.facts.items() if key not in ("kind", "traceback", "ready_s", "up_s")}
    subject = facts.pop("path", None) or facts.pop("server", "")
    rest = " ".join(f"{key}={value}" for key, value in facts.items() if value not in ("", None) and key != "registrar")
    return f"{_clock(event.at)}  {event.event:<12} {subject}  {rest}".rstrip()


def missed_line(missed: Missed) -> str:
    """Return a sentence that says how many events a reader of the feed has missed."""
    return f"missed {missed.count} events, up to number {missed.seq}: this reader was too slow"


def record_line(record: Record, above: str = "") -> str:
    """Return a record of the history as a line for people, without its traceback; its path from `above` on."""
    path = record.path.removeprefix(above).removeprefix("/")
    facts = str(record).partition(" ")[2].removeprefix(f"path={record.path}").strip()
    return f"{_clock(record.at)}  {record.event:<12} {path}{'  ' if path else ''}{facts}"


def _clock(at: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(at)) + f".{int(at % 1 * 1000):03}"


def _since(id: str) -> str:
    at = since(id)
    if at is None:
        return ""
    return f" since {time.strftime('%H:%M:%S', time.localtime(at))} ({ago(max(0.0, time.time() - at))})"


def _of_query(query: QueryRow) -> Iterator[str]:
    whose = f"resource {query.parent} of {query.origin}" if query.parent else "itself"
    what = f"{query.server} {query.request}"
    match query.hold:
        case "pending":
            yield f"Query {query.id}: {query.origin} has waited for {what}{_since(query.id)}, for {whose}."
        case "owed":
            yield f"Query {query.id}: {query.origin} has released {what}, and {query.server} does not know it yet."
        case _:
            yield f"Query {query.id}: {query.origin} holds {what}{_since(query.id)}, for {whose}."


def _of_resource(client: ConsoleClient, resource: ResourceRow) -> Iterator[str]:
    yield f"{_named(resource)} {_phase(resource)}"
    if resource.message and resource.state:
        yield f"Its last status was {resource.state}: {resource.message}"
    if not resource.holder_count:
        yield "Nobody holds it."
    for holder in resource.holders:
        yield from _of_holder(client, holder, "", {resource.id})
    if resource.holder_count > len(resource.holders):
        yield f"{resource.holder_count - len(resource.holders)} others hold it, too."
    for part in resource.parts:
        yield from _of_part(client, part, "", {resource.id})


def _named(resource: ResourceRow) -> str:
    return f"{resource.server} {resource.request} (resource {resource.id})"


def _phase(resource: ResourceRow) -> str:
    match resource.phase:
        case "queued":
            return "waits until an earlier resource of the same request is unloaded."
        case "loading":
            again = f", attempt {resource.attempt}" if resource.attempt > 1 else ""
            far = f", {resource.message} so far" if resource.message else ""
            return f"is being loaded{_since(resource.id)}{again}{far}: its load callback has not returned."
        case "unloading":
            return "is being unloaded: its unload callback has not returned."
        case "unload_failed":
            return f"could not be unloaded: its callback raised. Try again: rr-actors unload --force {resource.id}"
        case _:
            return f"is loaded{_since(resource.id)}, and {resource.state}."


def _of_holder(client: ConsoleClient, holder: Holder, indent: str, below: set[str]) -> Iterator[str]:
    """Say that a holder holds the resource; if that is for another resource, say who holds the other one."""
    if not holder.parent:
        yield f"{indent}{holder.origin} holds it{_since(holder.query_id)}, for itself (query {holder.query_id})."
        return
    above = client.ask(Find(holder.parent), Found).resources
    what = _named(above[0]) if above else f"its resource {holder.parent}"
    yield f"{indent}{holder.origin} holds it{_since(holder.query_id)}, for {what}."
    if above and holder.parent not in below and len(below) < _DEEP:
        for other in above[0].holders:
            yield from _of_holder(client, other, indent + "  ", below | {holder.parent})


def _of_part(client: ConsoleClient, part: str, indent: str, above: set[str]) -> Iterator[str]:
    """Say on which part a resource depends; if it waits for the part, say what that waits for."""
    found = client.ask(Find(part), Found)
    queries = [query for query in found.queries if query.id == part]
    if not queries:
        return
    query = queries[0]
    what = f"{query.server} {query.request}"
    if query.hold != "pending":
        yield f"{indent}It depends on {what} (query {query.id})."
        return
    yield f"{indent}It waits for {what}{_since(query.id)} (query {query.id})."
    for resource in found.resources:
        if resource.id in above or len(above) >= _DEEP:
            yield f"{indent}  {_named(resource)} waits for it in turn."
            continue
        yield f"{indent}  {_named(resource)} {_phase(resource)}"
        for other in resource.parts:
            yield from _of_part(client, other, indent + "  ", above | {resource.id})
