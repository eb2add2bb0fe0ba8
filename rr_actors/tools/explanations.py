"""Explanations: who holds a resource, for whom, why it waits, how it is since when, and whom an actor waits for."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence

from rr_actors.actors.messaging.mailbox_looks import COUNTED, ON_START, MailboxInfo
from rr_actors.base.errors import NotFound, Unavailable, UnknownQuery, UsageError, counted, few, shown
from rr_actors.base.names import short_id, short_ids, time_in
from rr_actors.registrar.model.failures import WAITS_FOR_SERVER
from rr_actors.registrar.pages import HolderRow, QueryRow, ResourceRow
from rr_actors.streams.stream import StreamRow
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.console.console_messages import Found
from rr_actors.system.console.console_questions import Find, ListEvents, ListHistory
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.event_texts import ago, event_text

_MOST = 5  # things that one beginning of an id may name
_WELL = ("OK", "UPDATE")
_DEEP = 8  # resources above one another
_BEFORE = 5  # events that came before a state
_NAMES_KEPT = 10_000
_names: dict[str, str] = {}  # of resources, by their ids


def explain(connection: ConsoleConnection, id: str) -> list[str]:
    """Return sentences about the query or resource whose id or name is `id`, or whose id begins or ends so.

    Raises:
        UnknownQuery: no registrar has such an id.
        UsageError: more than five ids have `id` in them.
    """
    found = connection.ask(Find(id))
    if not found.queries and not found.resources:
        hint = "; ".join(found.notes) or "rr-actors resources lists those that there are"
        raise UnknownQuery(f"{shown(id)}: no query and no resource has this id ({hint})", query_id=id)
    line = _line_of(found)
    resources = [row for row in found.resources if row not in line]
    if len(found.queries) + len(resources) > _MOST:
        ids = short_ids(row.id for row in (*found.resources, *found.queries))
        several = few(f"{ids[row.id]} ({row.name})" for row in (*found.resources, *found.queries))
        raise UsageError(f"{shown(id)}: several ids have this in them: {several}; give more of the id")
    lines: list[str] = []
    for query in found.queries:
        lines += _of_query(connection, query)
    for resource in resources:
        lines += _of_resource(connection, resource)
    for waiting in line:
        holder = waiting.holders[0]
        said = f" ({waiting.message})" if waiting.message else ""
        lines.append(f"{holder.origin} {_waits('it', holder.query_id)}{_priority(holder.priority)}{said}.")
    return [*lines, *(f"Not asked: {note}" for note in found.notes)]


def _line_of(found: Found) -> list[ResourceRow]:
    """Return the rows of the loads that wait for another of these resources, the most urgent and oldest first."""
    line = [row for row in found.resources if row.phase == "queued" and row.holders]
    if found.queries or len(line) == len(found.resources):  # the id names a load that waits
        return []
    return sorted(line, key=lambda row: (math.inf if row.priority is None else -row.priority, row.id))


def name_of_resource(ask: Callable[[Find], Found], id: str, registrar: str) -> str:
    """Return the name of a registrar's resource; it is asked for once, because a resource keeps its name."""
    if (name := _names.get(id)) is None:
        found = [row.name for row in ask(Find(id, registrar)).resources if row.id == id]
        name = found[0] if found else f"resource {short_id(id)}"
        if found:
            if len(_names) >= _NAMES_KEPT:
                _names.clear()
            _names[id] = name
    return name


def seconds_text(seconds: float) -> str:
    """Return a duration for people: "0.4 ms", "120 ms", "3.2 s", "5 min"."""
    if seconds < 0.001:
        return f"{seconds * 1000:.1f} ms"
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 60 else ago(seconds)


def _since(id: str) -> str:
    return _since_time(time_in(id))


def _since_time(at: float | None) -> str:
    if at is None:
        return ""
    return f" since {time.strftime('%H:%M:%S', time.localtime(at))} ({ago(max(0.0, time.time() - at))})"


def _holds(what: str, query_id: str) -> str:
    since = _since(query_id)
    return f"has held {what}{since}" if since else f"holds {what}"


def _waits(what: str, query_id: str) -> str:
    since = _since(query_id)
    return f"has waited for {what}{since}" if since else f"waits for {what}"


def _of_query(connection: ConsoleConnection, query: QueryRow) -> Iterator[str]:
    whose = name_of_resource(connection.ask, query.parent, query.origin) if query.parent else "itself"
    said = f"Query {short_id(query.id)}: {query.origin}"
    match query.hold:
        case "pending":
            yield f"{said} {_waits(query.name, query.id)}, for {whose}."
        case "owed":
            yield f"{said} has released {query.name}, and {query.server} does not know it yet."
        case _:
            yield f"{said} {_holds(query.name, query.id)}, for {whose}{_priority(query.priority)}."


def _of_resource(connection: ConsoleConnection, resource: ResourceRow) -> Iterator[str]:
    yield f"{_named(resource)} {_phase(resource)}"
    if resource.message.startswith(WAITS_FOR_SERVER):
        yield f"It {resource.message}."
    elif resource.revoked:
        when = "when its holders have released it, or at the deadline"
        yield f"It is revoked ({resource.message}): it is unloaded {when}."
    elif resource.message and resource.phase in ("loaded", "unloading", "paused"):
        yield f"Its last status was {resource.state}: {resource.message}"
    yield from _past_of(connection, resource)
    if not resource.holder_count:
        yield "Nobody holds it."
    elif resource.priority is None:
        yield "Nobody needs it now: all its holders have it on standby."
    elif resource.priority:
        yield f"Its priority is {resource.priority}, the highest of its holders."
    for holder in resource.holders:
        yield from _of_holder(connection, holder, "", {resource.id})
    if resource.holder_count > len(resource.holders):
        yield f"It has {counted(resource.holder_count - len(resource.holders), 'more holder')}."
    for stream in connection.streams(resource.server.partition("/")[0], resource.id).rows:
        by = f"is read by {readers_text(stream)}" if stream.readers else "has no reader"
        yield f"Its stream {stream.info.name!r} {by}."
    for part in resource.parts:
        yield from _of_part(connection, part, "", {resource.id})


def _past_of(connection: ConsoleConnection, resource: ResourceRow) -> Iterator[str]:
    """Say since when a resource has its state, and what happened before to it and to the child that serves it."""
    events = [
        one for one in connection.ask(ListEvents(resource.id)).events if one.facts.get("resource_id") == resource.id
    ]
    since = None
    for event in reversed([one for one in events if one.event == "status"]):
        if event.facts["detail"].partition(" ")[0] != resource.state:
            break
        since = event.at
    if since is not None:
        with contextlib.suppress(NotFound):  # an application's registrar is no child
            events += connection.ask(ListHistory(resource.server.partition("/")[0])).events
        yield from _past("It", resource.state, since, events)


def past_of_child(connection: ConsoleConnection, id: str) -> Iterator[str]:
    """Say since when a child has its state, and what happened to it before; nothing of what is no child."""
    with contextlib.suppress(NotFound):
        events = connection.ask(ListHistory(id)).events
        path = min((one.path for one in events), key=len, default="")
        own = [one for one in events if one.path == path and one.facts.get("state") is not None]
        if len(own) > 1 and path.rpartition("/")[2] == id.rpartition("/")[2]:
            yield from _past(path, own[-1].facts["state"], own[-1].at, own)


def _past(what: str, state: str, since: float, events: Sequence[Event]) -> Iterator[str]:
    yield f"{what} has been {state}{_since_time(since)}."
    before = sorted((one for one in events if one.at < since), key=lambda one: one.at)[-_BEFORE:]
    if before:
        yield "Before that:"
        yield from (f"  {event_text(one.at, one.event, one.facts)}" for one in before)


def readers_text(stream: StreamRow) -> str:
    """Return who reads a stream: "app (process 12), planner (process 13, missed 4)"."""
    return ", ".join(
        f"{one.registrar} (process {one.pid}{f', missed {one.missed}' if one.missed else ''})" for one in stream.readers
    )


def bytes_text(row: StreamRow) -> str:
    """Return how many bytes a stream has in a second: "173.8 MiB/s"; "" if nobody reads it."""
    return f"{row.info.bytes_per_s / 2**20:.1f} MiB/s" if row.readers else ""


def rate_text(row: StreamRow) -> str:
    """Return how many frames a stream has in a second: "29.3/s"."""
    return f"{row.info.rate_hz:.1f}/s"


def age_text(row: StreamRow) -> str:
    """Return how old a stream's newest frame is: "16 ms", or "no frame"."""
    if (age_s := row.info.age_s) is None:
        return "no frame"
    return f"{age_s * 1000:.0f} ms" if age_s < 1 else ago(age_s)


def _named(resource: ResourceRow) -> str:
    return f"{resource.name} ({short_id(resource.id)})"


def _phase(resource: ResourceRow) -> str:
    match resource.phase:
        case "queued":
            place = f": {resource.message}" if resource.message else ""
            return f"waits until an earlier resource of the same request is unloaded{place}."
        case "loading":
            again = f", attempt {resource.attempt}" if resource.attempt > 1 else ""
            far = f", {resource.message} so far" if resource.message else ""
            return f"is being loaded{_since(resource.id)}{again}{far}: its load callback has not returned."
        case "unloading":
            if resource.message.startswith(WAITS_FOR_SERVER):
                return "is to be unloaded."
            return "is being unloaded: its unload callback has not returned."
        case "unload_failed":
            verb = f"`rr-actors unload --force {short_id(resource.id)}`"
            again = f"{verb} tries again, or removes it if its callback runs no more."
            return f"could not be unloaded: {resource.message}. {again}"
        case "pausing":
            return "is being paused, as nobody needs it now: its pause callback has not returned."
        case "paused" if resource.state == "FATAL":
            return "is paused, and FATAL: it does not run again."
        case "paused":
            return "is paused, as nobody needs it now. A load resumes it."
        case "reloading":
            return "is being unloaded and loaded again: its callbacks have not returned."
        case "resuming":
            return "is being resumed: its parts are, or its resume callback has not returned."
        case _:
            since = _since(resource.id)
            return f"{f'has been loaded{since}' if since else 'is loaded'}; its state is {resource.state}."


def _of_holder(connection: ConsoleConnection, holder: HolderRow, indent: str, below: set[str]) -> Iterator[str]:
    """Say that a holder holds the resource; if that is for another resource, say who holds the other one."""
    if holder.unheard:
        yield f"{indent}{holder.origin} has not dealt with {holder.unheard} of its statuses."
    if not holder.parent:
        query = f"(query {short_id(holder.query_id)}){_priority(holder.priority)}"
        yield f"{indent}{holder.origin} {_holds('it', holder.query_id)}, for itself {query}."
        return
    above = connection.ask(Find(holder.parent)).resources
    what = _named(above[0]) if above else f"its resource {short_id(holder.parent)}"
    yield f"{indent}{holder.origin} {_holds('it', holder.query_id)}, for {what}{_priority(holder.priority)}."
    if above and holder.parent not in below and len(below) < _DEEP:
        for other in above[0].holders:
            yield from _of_holder(connection, other, indent + "  ", below | {holder.parent})


def _priority(priority: int | None) -> str:
    return ", on standby" if priority is None else f", with priority {priority}" if priority else ""


def _of_part(connection: ConsoleConnection, part: str, indent: str, above: set[str]) -> Iterator[str]:
    """Say on which part a resource depends; if it waits for the part, or the part is not well, say why."""
    found = connection.ask(Find(part))
    queries = [query for query in found.queries if query.id == part]
    if not queries:
        return
    query = queries[0]
    if query.hold == "pending":
        yield f"{indent}It has waited for {query.name}{_since(query.id)} (query {short_id(query.id)})."
    elif query.state in _WELL:
        yield f"{indent}It depends on {query.name} (query {short_id(query.id)})."
        return
    else:
        yield f"{indent}It depends on {query.name} (query {short_id(query.id)}), which is {query.state}."
    for resource in found.resources:
        if resource.id in above or len(above) >= _DEEP:
            if query.hold == "pending":
                yield f"{indent}  {_named(resource)} waits for it in turn."
            continue
        if query.hold == "pending":
            yield f"{indent}  {_named(resource)} {_phase(resource)}"
        elif resource.message:
            yield f"{indent}  Its last status was {resource.state}: {resource.message}"
        for other in resource.parts:
            yield from _of_part(connection, other, indent + "  ", above | {resource.id})


# -- actors -----------------------------------------------------------------------------------------------------------

Look = Callable[[str], MailboxInfo]
_RING = 20  # actors that wait for one another


def mailbox_lines(found: MailboxInfo) -> Iterator[str]:
    """Yield lines about a mailbox: how full it is, what waits since when, and what is handled since when."""
    yield f"{found.path}: {_count(found.length)}, at most {found.limit:,}{', paused' if found.is_paused else ''}"
    if found.oldest is not None:
        yield f"    oldest: {found.oldest}{_for(found.oldest.since_s)}"
        first = f" (of the first {COUNTED})" if found.length > COUNTED else ""
        yield f"    types: {_types(found)}{first}"
    yield f"    handles: {'nothing' if found.handled is None else f'{found.handled}{_for(found.handled.since_s)}'}"
    if found.waits_for:
        yield f"    waits for: {', '.join(found.waits_for)}"


def explain_actor(look: Look, id: str) -> list[str]:
    """Return sentences about what an actor does, whom it waits for, and so on; none if no actor has this id or path.

    Args:
        look: returns the mailbox of the actor of an id or path, or raises NotFound.
    """
    if " " in id:  # the name of a resource
        return []
    try:
        found = look(id)
    except NotFound:
        return []
    return list(_explained(look, found))


def _explained(look: Look, found: MailboxInfo) -> Iterator[str]:
    yield f"{found.path} {_doing(found)}."
    if found.length:
        waited = _for(None if found.oldest is None else found.oldest.since_s)
        oldest = waited and f", the oldest{waited}"
        yield f"In its mailbox {_count(found.length)}{oldest}: {_types(found)}."
    yield from _asked(look, found, [found.path])


def _asked(look: Look, found: MailboxInfo, above: list[str]) -> Iterator[str]:
    """Say for whom an actor waits, and what that one does; `above` are the actors that wait for this one."""
    for target in found.waits_for:
        waits = f"{found.path} waits for {target}"
        if target in above:
            ring = " → ".join((*above[above.index(target) :], target))
            yield f"{waits}: that is a ring of asks, {ring}. It lasts until the time limit of one of them."
            continue
        try:
            asked = look(target)
        except (NotFound, Unavailable) as error:
            yield f"{waits}: {error}."
            continue
        waiting = f"; in its mailbox {_count(asked.length)}" if asked.length else ""
        yield f"{waits}, which {_doing(asked)}{waiting}."
        if len(above) < _RING:
            yield from _asked(look, asked, [*above, target])


def _doing(found: MailboxInfo) -> str:
    doing = found.handled
    if doing is None:
        return "is paused, and handles nothing" if found.is_paused else "handles nothing"
    paused = "is paused, and " if found.is_paused else ""
    if doing.type == ON_START:
        return f"{paused}has been in its on_start{_for(doing.since_s)}"
    kind = f"`{doing.type}`" if doing.type else "a message"
    sender = f" from {doing.sender}" if doing.sender else ""
    return f"{paused}has been handling {kind}{sender}{_for(doing.since_s)}"


def _types(found: MailboxInfo) -> str:
    return ", ".join(f"{count} {kind or 'of unknown type'}" for kind, count in found.types.items())


def _count(count: int) -> str:
    return "no message waits" if not count else f"{counted(count, 'message')} {'waits' if count == 1 else 'wait'}"


def _for(seconds: float | None) -> str:
    return "" if seconds is None else f" for {seconds_text(seconds)}"
