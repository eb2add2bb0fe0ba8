"""Spans: a consumer's list of queries in digests, so that a new link carries only the queries that differ.

The consumer sorts the queries that it holds at a provider by their running numbers, cuts them into spans, and sends the
digest of each span. The provider makes the same digests of its own rows. It lists the queries of the spans that differ,
and those behind the last span. In a span that does not differ, both sides have the same queries with the same
resources, responses, states and priorities. If one side has a query that the other has not (a load in flight, an owed
release), the span differs.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Iterator
from hashlib import sha256
from operator import attrgetter
from typing import Any, TypeVar

import msgspec

from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import HELD, Held, Resource, ServedQuery

R = TypeVar("R")

LENGTH = 1024
"""The queries in a span: if one of them differs, all are listed."""

_number, _id, _resource_id = map(attrgetter, ("seq", "id", "resource_id"))
_response, _state = map(attrgetter, ("response", "state"))
_priority = attrgetter("priority")
_FACTS = (_id, _resource_id, _response, _state, _priority)
_DIGEST_BYTES = 16
_FIRST, _LAST = -1, 2**63 - 1  # below and above all running numbers
_encode = msgspec.msgpack.Encoder().encode

Spans = list[tuple[int, bytes]]
"""The last running number of each span, and its digest, in order."""

Bounds = list[tuple[int, int]]
"""Spans that do not differ, in order: the number before the first query, and the last number."""


class HeldRows(msgspec.Struct, frozen=True):
    """The rows held at a provider, and their spans."""

    rows: list[Held]
    spans: Spans


def held_at(catalog: Catalog, provider: str) -> list[Held]:
    """Return the rows that are HELD at a provider, in the order of the table, or of the index.

    Pending and owed queries are left out: their spans differ anyway.
    """
    return [row for row in _rows(catalog.held, catalog.outbound.get(provider, ())) if row.hold is HELD]


def known(rows: list[Held], before: HeldRows | None = None) -> HeldRows:
    """Return the rows with their digests. If the rows are those of `before`, its digests are reused."""
    return before if before is not None and rows == before.rows else HeldRows(rows, list(cut(rows)))


def cut(rows: list[Held]) -> Iterator[tuple[int, bytes]]:
    """Yield the spans of the rows, each when it is asked for: a million rows take most of a second."""
    oldest_first = sorted(rows, key=_number)
    for begin in range(0, len(rows), LENGTH):
        some = oldest_first[begin : begin + LENGTH]
        yield some[-1].seq, _digest([list(map(fact, some)) for fact in _FACTS])


def compared(catalog: Catalog, origin: str, spans: Spans) -> tuple[Bounds, list[ServedQuery]]:
    """Compare a consumer's spans with the catalog; return the bounds where nothing differs, and all other queries."""
    queries = sorted(_rows(catalog.queries, catalog.by_origin.get(origin, ())), key=_number)
    resource_ids = list(map(_resource_id, queries))
    resources = _resources(catalog, resource_ids)
    same: Bounds = []
    differing: list[ServedQuery] = []
    begin, above = 0, _FIRST
    for last, digest in spans:
        end = bisect_right(queries, last, begin, key=_number)
        cut = slice(begin, end)
        if _digest(_facts(catalog, queries[cut], resource_ids[cut], resources[cut])) != digest:
            differing += queries[cut]
        elif same and same[-1][1] == above:
            same[-1] = (same[-1][0], last)
        else:
            same.append((above, last))
        begin, above = end, last
    if begin == len(queries) and same and same[-1][1] == above:
        same[-1] = (same[-1][0], _LAST)  # and there is no query behind the last span
    return same, differing + queries[begin:]


def split(catalog: Catalog, provider: str, same: Bounds) -> tuple[list[Held], list[Held]]:
    """Return, of the rows HELD at a provider, the `kept` ones within `same`, and all outside of it, oldest first.

    Rows within `same` agree with the provider; the caller has a note to remove only for the `kept` ones. A row whose
    number is greater than all that Fetch told came meanwhile: by a thread's own line, or after the provider compared.
    It counts as agreed if the provider has said that it has nothing behind the last span.
    """
    bounds = [number for bound in same for number in bound]  # a number within one has an odd place among them
    kept = [catalog.held[id] for id in catalog.kept if id in catalog.held]
    kept = [row for row in kept if row.registrar == provider and row.hold is HELD]
    agreed = [row for row in kept if bisect_left(bounds, row.seq) % 2 == 1]
    if same == [(_FIRST, _LAST)]:
        return agreed, []
    others = [row for row in held_at(catalog, provider) if bisect_left(bounds, row.seq) % 2 == 0]
    return agreed, sorted(others, key=_number)


def _rows(table: dict[str, R], ids: Collection[str]) -> Iterable[R]:
    """Return the rows with these ids: some rows of the table or, often, all of them."""
    return table.values() if len(ids) == len(table) else map(table.__getitem__, ids)


def _resources(catalog: Catalog, ids: list[str]) -> list[Resource]:
    """Return the resources with these ids. If each resource has one query, in the same order, no id is looked up."""
    resources = catalog.resources
    if len(ids) == len(resources) and ids == list(resources):
        return list(resources.values())
    return list(map(resources.__getitem__, ids))


def _facts(catalog: Catalog, queries: list[ServedQuery], ids: list[str], resources: list[Resource]) -> list[list[Any]]:
    """Return the facts about these queries that a digest covers, in the form in which their holder has them."""
    responses = list(map(_response, resources))
    if catalog.moving:
        responses = [None if row.id in catalog.moving else row.response for row in resources]
    return [list(map(_id, queries)), ids, responses, list(map(_state, resources)), list(map(_priority, queries))]


def _digest(facts: list[list[Any]]) -> bytes:
    return sha256(_encode(facts)).digest()[:_DIGEST_BYTES]
