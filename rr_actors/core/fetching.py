"""What a registrar decides as a provider when a consumer's link comes and goes."""

from __future__ import annotations

from rr_actors.core.catalog import Batch
from rr_actors.core.commands import ConsumerLost
from rr_actors.core.effects import Reply
from rr_actors.core.notices import send_notice
from rr_actors.core.parking import drop_parked
from rr_actors.messages import Fetch, Fetched, FetchedQuery
from rr_actors.records import Phase, Query

_CHUNK = 500


def fetch(batch: Batch, message: Fetch) -> None:
    """List the consumer's queries; on a new link (`resume`) send the notices it has not dealt with behind them.

    In that order: a notice for a query that the consumer has lost in a crash must find it again.
    """
    catalog = batch.catalog
    rows = [_fetched(batch, catalog.queries[id]) for id in catalog.by_origin.get(message.origin, ())]
    chunks = [rows[i : i + _CHUNK] for i in range(0, len(rows), _CHUNK)] or [[]]
    for i, chunk in enumerate(chunks):
        batch.cause(Reply(message.origin, Fetched(chunk, i < len(chunks) - 1, message.number)))
    if message.resume:
        drop_parked(batch, lambda parked: parked.origin == message.origin)  # sent again, if its incarnation lives
        for row in rows:  # an Unload that is not answered is sent again over the new link, and answered then
            batch.forget(catalog.letting, row.query_id)
        batch.note(catalog.consumers, message.origin, True)
        for notice_id in list(catalog.notices_to.get(message.origin, ())):
            send_notice(batch, catalog.notices[notice_id])


def _fetched(batch: Batch, query: Query) -> FetchedQuery:
    resource = batch.catalog.resources[query.resource_id]
    held = resource.phase in (Phase.LOADED, Phase.UNLOAD_FAILED)  # else it waits, or is being let go
    response = (resource.response or b"") if held else None
    place = (query.parent, query.attempt, query.seq, str(resource.state))
    return FetchedQuery(query.id, resource.server, resource.id, resource.request, response, *place)


def consumer_lost(batch: Batch, command: ConsumerLost) -> None:
    """The link is down: notices wait until there is a new one. What the consumer holds it keeps."""
    batch.forget(batch.catalog.consumers, command.origin)
