"""Pages: a few of a registrar's resources or queries at a time, as plain text, for those who look at a running system.

A registrar may serve 100,000 resources, and a screen shows fifty. So the process that has them picks the rows, and only
those travel. The thread that asks lists the rows under the registrar's lock, and searches and decodes them without it.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable
from typing import Any, Literal, TypeVar

import msgspec

from rr_actors.base.values.canonical import shown_plain
from rr_actors.registrar.engine.progress import shown_progress
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.messages import readable
from rr_actors.registrar.model.rows import Held, Phase, Resource

HOLDERS_SHOWN = 20
"""How many holders, and how many dependencies, a resource's row has; it says how many there are."""
_CELL = 400  # characters of a request or response
_PREFIX = 4  # characters of an id that are enough to look for it
_FOUND = 20

_VALUE = re.compile(r"""["'{}()\[\],:]|\A[-+.\deE]+\Z""")  # more than a string's inside, or a number

_Row = TypeVar("_Row", Resource, Held)
_Found = TypeVar("_Found")


class Wanted(msgspec.Struct, frozen=True):
    """Which page: `limit` rows from number `offset` on, of those that have the text `match` in them.

    With "id" the rows of the resource, or of the query, whose id is `match` or begins with it.
    """

    what: Literal["resources", "queries", "id"]
    match: str = ""
    offset: int = 0
    limit: int = 100


class Holder(msgspec.Struct, frozen=True):
    """A query on a resource: whose it is, and for which of its holder's own resources; "" for none."""

    query_id: str
    origin: str
    parent: str


class ResourceRow(msgspec.Struct, frozen=True):
    """A resource as its provider sees it.

    Attributes:
        server: "registrar/server".
        request, response: JSON, cut if it is long; Python's text of what JSON does not have.
        phase: "queued", "loading", "loaded", "unloading" or "unload_failed".
        state, message: of its last status. While it is loading, `message` says how far that has come ("50% opening").
        holders: the first 20 queries on it; `holder_count`: how many there are.
        parts: the ids of the first 20 queries that it depends on; `part_count`: how many there are.
    """

    id: str
    server: str
    request: str
    response: str
    phase: str
    state: str
    message: str
    attempt: int
    holders: list[Holder]
    holder_count: int
    parts: list[str]
    part_count: int

    @property
    def condition(self) -> str:
        """The state of its last status; before it is loaded, and when it is not any more, its phase."""
        return self.state if self.phase == "loaded" else self.phase


class QueryRow(msgspec.Struct, frozen=True):
    """A query as its holder sees it.

    Attributes:
        origin: the registrar that holds it.
        server: "registrar/server".
        parent: the origin's resource that depends on it; "" for none.
        hold: "pending" (asked for), "held", or "owed" (released, and its provider does not know yet).
    """

    id: str
    origin: str
    server: str
    resource_id: str
    parent: str
    request: str
    hold: str
    state: str


class Page(msgspec.Struct, frozen=True):
    """The rows that were wanted, and how many there are in all."""

    total: int
    resources: list[ResourceRow] = []
    queries: list[QueryRow] = []


def page_of(actor: RegistrarActor, wanted: Wanted) -> Page:
    """Return a page of what a registrar serves or holds. From any thread.

    Raises:
        RegistrarDown: it is closed.
    """
    match wanted.what:
        case "resources":
            chosen, total = _chosen(_read(actor, lambda catalog: list(catalog.resources.values())), wanted, actor.name)
            return Page(total, resources=_resource_rows(actor, chosen))
        case "queries":
            held, total = _chosen(_read(actor, lambda catalog: list(catalog.held.values())), wanted, actor.name)
            return Page(total, queries=[_query_row(actor.name, row) for row in held])
        case "id":
            resources, queries = _of_id(actor, wanted.match)
            rows = _resource_rows(actor, resources)
            return Page(len(resources) + len(queries), rows, [_query_row(actor.name, row) for row in queries])


def _read(actor: RegistrarActor, reader: Callable[[Catalog], _Found]) -> _Found:
    """What the reader returns of the catalog, with nothing decided meanwhile."""
    actor.settle()
    with actor.enter():
        return reader(actor.whole())


def _chosen(rows: list[_Row], wanted: Wanted, name: str) -> tuple[list[_Row], int]:
    if wanted.match:
        text, raw = wanted.match, wanted.match.encode("utf-8", "replace")
        decodes = _may_be_more_than_a_string(text)

        def matches(row: Resource | Held) -> bool:
            if raw in row.request or any(text in value for value in _texts(row, name)):
                return True
            return decodes and text in text_of_value(row.request)

        rows = [row for row in rows if matches(row)]
    return rows[wanted.offset : wanted.offset + wanted.limit], len(rows)


def _may_be_more_than_a_string(text: str) -> bool:
    """Whether a text may be in a request as it is shown, and not in its bytes; to decode a request takes 5 us."""
    return _VALUE.search(text) is not None or any(text in word for word in ("true", "false", "null"))


def _texts(row: Resource | Held, name: str) -> tuple[str, ...]:
    if isinstance(row, Held):
        return row.id, f"{row.registrar}/{row.server}", row.resource_id, row.parent, row.hold, row.state
    return row.id, f"{name}/{row.server}", row.phase, row.state, row.message


def _of_id(actor: RegistrarActor, id: str) -> tuple[list[Resource], list[Held]]:
    """The resource and the query of this id; else those whose ids begin so, or that a query of such an id is on."""

    def exactly(catalog: Catalog) -> tuple[list[Resource], list[Held]]:
        resource, held = catalog.find(id), catalog.held.get(id)
        return [resource] if resource is not None else [], [held] if held is not None else []

    found = _read(actor, exactly)
    if any(found) or len(id) < _PREFIX:
        return found
    resources, queries, held = _read(
        actor, lambda catalog: (list(catalog.resources), list(catalog.queries), list(catalog.held))
    )
    named = list(_beginning(id, [*resources, *queries])), list(_beginning(id, held))

    def rows(catalog: Catalog) -> tuple[list[Resource], list[Held]]:
        served = {row.id: row for name in named[0] if (row := catalog.find(name)) is not None}
        return list(served.values()), [row for name in named[1] if (row := catalog.held.get(name)) is not None]

    return _read(actor, rows)


def _beginning(text: str, ids: Iterable[str]) -> Iterable[str]:
    return itertools.islice((id for id in ids if id.startswith(text)), _FOUND)


def _resource_rows(actor: RegistrarActor, resources: list[Resource]) -> list[ResourceRow]:
    def around(catalog: Catalog, resource: Resource) -> tuple[list[Holder], int, list[str], int]:
        queries, parts = catalog.holders.get(resource.id, ()), catalog.parts_of(resource.id)
        first = [catalog.queries[id] for id in itertools.islice(queries, HOLDERS_SHOWN)]
        holders = [Holder(query.id, query.origin, query.parent) for query in first]
        return holders, len(queries), list(reversed(parts))[:HOLDERS_SHOWN], len(parts)

    neighbours = _read(actor, lambda catalog: [around(catalog, resource) for resource in resources])
    return [_resource_row(actor, *both) for both in zip(resources, neighbours, strict=True)]


def _resource_row(
    actor: RegistrarActor, row: Resource, around: tuple[list[Holder], int, list[str], int]
) -> ResourceRow:
    state = row.state if row.phase is Phase.LOADED else ""
    message = row.message
    if row.phase is Phase.LOADING and (progress := actor.progress.newest(row.id)) is not None:
        message = shown_progress(*progress)
    texts = text_of_value(row.request), text_of_value(row.response), row.phase.value, str(state), message
    return ResourceRow(row.id, f"{actor.name}/{row.server}", *texts, row.attempt, *around)


def _query_row(name: str, row: Held) -> QueryRow:
    server, request = f"{row.registrar}/{row.server}", text_of_value(row.request)
    return QueryRow(row.id, name, server, row.resource_id, row.parent, request, row.hold.value, row.state.value)


def text_of_value(raw: bytes | None) -> str:
    """Return a request's or response's bytes as text: JSON where JSON has it; "" for none."""
    if raw is None:
        return ""
    value: Any = shown_plain(raw)
    if value is None and raw != b"\xc0":
        return f"<{len(raw)} bytes>"
    return shortened_json(value, _CELL)


def shortened_json(value: Any, limit: int) -> str:
    """Return a value as JSON of at most `limit` characters; as Python shows it where JSON has no form of it."""
    try:
        text = msgspec.json.encode(value, enc_hook=repr).decode()
    except Exception:  # keys that are no text, numbers that are too long, nested too deeply
        text = repr(value)
    text = readable(text)
    return text if len(text) <= limit else text[: limit - 1] + "…"
