"""Refusing loads: the answer, and the memory of it, so that the same Load coming once more gets it again."""

from __future__ import annotations

from rr_actors.core.batch import Batch
from rr_actors.core.effects import Reply
from rr_actors.core.notices import drop_query
from rr_actors.messages import Failure, LoadRefused
from rr_actors.records import Resource

_REMEMBERED = 4096


def refuse(batch: Batch, origin: str, query_id: str, failure: Failure) -> Reply:
    """The answer to a Load that has failed."""
    remember(batch, query_id, failure)
    return Reply(origin, LoadRefused(query_id, failure))


def remember(batch: Batch, query_id: str, failure: Failure) -> None:
    """The answer that its Load gets from now on."""
    refused = batch.catalog.refused
    batch.note(refused, query_id, failure)
    if len(refused) > _REMEMBERED:
        for old in list(refused)[: _REMEMBERED // 2]:
            batch.forget(refused, old)


def refuse_all(batch: Batch, resource: Resource, failure: Failure) -> list[Reply]:
    """The answers to all who wait for a resource that has failed, or is taken away; their queries go."""
    replies: list[Reply] = []
    for query in batch.catalog.queries_of(resource.id):
        replies.append(refuse(batch, query.origin, query.id, failure))
        drop_query(batch, query)
    return replies
