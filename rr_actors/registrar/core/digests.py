"""Spans: a consumer's list of queries in digests, so that only what differs is sent when a link comes.

The consumer cuts what it holds at a provider into spans of its running numbers and tells the digest of each. The
provider makes the same digests of what it has, and lists the queries of the spans that differ, and of those behind the
last. In a span that does not differ there is nothing to agree on: the same queries with the same resources, responses
and states. Where one side has anything that the other has not (a load in flight, one that is owed), the span differs.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Iterator
from hashlib import sha256
from operator import attrgetter
from typing import Any, TypeVar

import msgspec

from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import Held, Hold, Query, Resource

R = TypeVar("R")

LENGTH = 1024
"""Queries in a span: with one that differs, so many are listed."""

_HELD = Hold.HELD
_number, _id, _resource_id = map(attrgetter, ("seq", "id", "resource_id"))
_response, _state = map(attrgetter, ("response", "state"))
_FACTS = (_id, _resource_id, _response, _state)
_DIGEST_BYTES = 16
_FIRST, _LAST = -1, 2**63 - 1  # below and above all running numbers
_encode = msgspec.msgpack.Encoder().encode

Spans = list[tuple[int, bytes]]
"""The last running number of each, in their order, and its digest."""

Bounds = list[tuple[int, int]]
"""Spans that do not differ: from above a number, up to a number; in their order."""


class Known(msgspec.Struct, frozen=True):
    """What is held at a provider: the rows, and what is said of them."""

    rows: list[Held]
    spans: Spans


def held_at(catalog: Catalog, provider: str) -> list[Held]:
    """What is held at a provider, in the order of its table, or of the index.

    Pending and owed queries are left out: they differ.
    """
    return [row for row in _rows(catalog.held, catalog.outbound.get(provider, ())) if row.hold is _HELD]


def known(rows: list[Held], before: Known | None = None) -> Known:
    """What is said of rows that are held at a provider; the digests are those of `before` if it is still the same."""
    return before if before is not None and rows == before.rows else Known(rows, list(cut(rows)))


def cut(rows: list[Held]) -> Iterator[tuple[int, bytes]]:
    """The spans, each when it is asked for: a million rows take most of a second."""
    oldest_first = sorted(rows, key=_number)
    for begin in range(0, len(rows), LENGTH):
        some = oldest_first[begin : begin + LENGTH]
        yield some[-1].seq, _digest([list(map(fact, some)) for fact in _FACTS])


def compared(catalog: Catalog, origin: str, spans: Spans) -> tuple[Bounds, list[Query]]:
    """Compare what a consumer has told with the catalog: where nothing differs, and the queries elsewhere."""
    queries = sorted(_rows(catalog.queries, catalog.by_origin.get(origin, ())), key=_number)
    resource_ids = list(map(_resource_id, queries))
    resources = _resources(catalog, resource_ids)
    same: Bounds = []
    differing: list[Query] = []
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
        same[-1] = (same[-1][0], _LAST)  # nothing is behind the last, either
    return same, differing + queries[begin:]


def split(catalog: Catalog, provider: str, same: Bounds) -> tuple[list[Held], list[Held]]:
    """What is held where nothing differs, as far as anything is still noted about it; and all else, oldest first.

    What is held with a greater number than any that was told has come meanwhile, by a line of its own or behind the
    provider's look at its own; it is where nothing differs if the provider has said that nothing was there.
    """
    held = catalog.held
    bounds = [number for bound in same for number in bound]

    def is_agreed(row: Held) -> bool:
        return row.hold is _HELD and bisect_left(bounds, row.seq) % 2 == 1

    noted = [held[id] for id in catalog.kept if id in held]
    if same == [(_FIRST, _LAST)]:
        others = catalog.unsettled_at(provider)
    else:
        rows = _rows(held, catalog.outbound.get(provider, ()))
        others = [row for row in rows if row.hold is not _HELD or bisect_left(bounds, row.seq) % 2 == 0]
    others.sort(key=_number)
    return [row for row in noted if row.registrar == provider and is_agreed(row)], others


def _rows(table: dict[str, R], ids: Collection[str]) -> Iterable[R]:
    """The rows with these ids, which are those of some in the table or, often, of all."""
    return table.values() if len(ids) == len(table) else map(table.__getitem__, ids)


def response_of(catalog: Catalog, query: Query) -> bytes | None:
    """What is said of a query's response: None while its resource is loading, or being released."""
    resource = catalog.resources[query.resource_id]
    return None if resource.id in catalog.moving else resource.response or b""


def _resources(catalog: Catalog, ids: list[str]) -> list[Resource]:
    """Those with these ids. Often queries are on one each, in the same order: then none is looked for."""
    resources = catalog.resources
    if len(ids) == len(resources) and ids == list(resources):
        return list(resources.values())
    return list(map(resources.__getitem__, ids))


def _facts(catalog: Catalog, queries: list[Query], ids: list[str], resources: list[Resource]) -> list[list[Any]]:
    """What is said of queries on resources with these ids, as their holder has it."""
    responses = list(map(_response, resources))
    if catalog.moving:
        responses = [None if row.id in catalog.moving else row.response for row in resources]
    return [list(map(_id, queries)), ids, responses, list(map(_state, resources))]


def _digest(facts: list[list[Any]]) -> bytes:
    return sha256(_encode(facts)).digest()[:_DIGEST_BYTES]
