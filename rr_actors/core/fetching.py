"""What a registrar decides as a provider when a consumer's link comes and goes."""

from __future__ import annotations

from rr_actors.core import spans
from rr_actors.core.batch import Batch
from rr_actors.core.catalog import Catalog
from rr_actors.core.commands import ConsumerLost
from rr_actors.core.effects import Reply
from rr_actors.core.notices import send_notice
from rr_actors.core.parking import drop_parked
from rr_actors.messages import Fetch, Fetched, FetchedQuery
from rr_actors.records import Query

_CHUNK = 500
_CHUNK_BYTES = 2**16  # of requests and responses: a frame must not be too long, however much is held


def fetch(batch: Batch, message: Fetch) -> None:
    """List the consumer's queries; on a new link (`resume`) send the notices it has not dealt with behind them.

    In that order: a notice for a query that the consumer has lost in a crash must find it again.
    """
    catalog = batch.catalog
    same, queries = spans.compared(catalog, message.origin, message.spans)
    rows: list[FetchedQuery] = []
    size = 0
    for query in queries:
        row = _fetched(catalog, query)
        more = len(row.request) + len(row.response or b"")
        if rows and (len(rows) == _CHUNK or size + more > _CHUNK_BYTES):
            batch.cause(Reply(message.origin, Fetched(rows, True, message.number, same)))
            rows, size = [], 0
        rows.append(row)
        size += more
    batch.cause(Reply(message.origin, Fetched(rows, False, message.number, same)))
    if message.resume:
        drop_parked(batch, lambda parked: parked.origin == message.origin)  # sent again, if its incarnation lives
        for id in list(catalog.letting):  # an Unload that is not answered is sent again over the new link
            query = catalog.queries.get(id)
            if query is None or query.origin == message.origin:
                batch.forget(catalog.letting, id)
        batch.note(catalog.consumers, message.origin, True)
        for notice_id in list(catalog.notices_to.get(message.origin, ())):
            send_notice(batch, catalog.notices[notice_id])


def _fetched(catalog: Catalog, query: Query) -> FetchedQuery:
    resource = catalog.resources[query.resource_id]
    place = (query.parent, query.attempt, query.seq, str(resource.state))
    response = spans.response_of(catalog, query)
    return FetchedQuery(query.id, resource.server, resource.id, resource.request, response, *place)


def consumer_lost(batch: Batch, command: ConsumerLost) -> None:
    """The link is down: notices wait until there is a new one. What the consumer holds it keeps."""
    batch.forget(batch.catalog.consumers, command.origin)
