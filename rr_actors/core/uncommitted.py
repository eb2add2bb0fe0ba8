"""Uncommitted: what becomes of a wake-up's messages and commands when their changes could not be written.

Nothing of them has happened. Who can be told so is told; the rest is done again, in its order, and what comes later
waits behind it, as the order of messages is relied upon.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rr_actors.core import commands as c
from rr_actors.core import holding
from rr_actors.core.batch import Batch
from rr_actors.core.effects import Answer, LoadResolved, UnloadResolved
from rr_actors.core.refusing import refuse
from rr_actors.messages import Failure, Load
from rr_actors.records import Hold


def refuse_uncommitted(
    batch: Batch, items: Iterable[tuple[Any, str | None]], failure: Failure
) -> list[tuple[Any, str | None]]:
    """Refuse what can be refused, for `failure`; return what is to be done again.

    Causes effects alone, no changes: it needs no room on the disk.

    Args:
        batch: a new one; that of the items has been undone.
        items: messages and who sent them, commands and None.
    """
    again: list[tuple[Any, str | None]] = []
    for item, sender in items:
        match item:
            case Load() if item.query_id not in batch.catalog.queries:
                batch.cause(refuse(batch, item.origin, item.query_id, failure))
            case c.Ask(direct=False):
                batch.cause(LoadResolved(holding.pending(item, 0, 0), failure))
            case c.Release():
                batch.cause(UnloadResolved(item.query_id, failure))
            case c.ReleaseOverdue():
                held = batch.catalog.held.get(item.query_id)
                if held is not None and held.hold is Hold.OWED:  # as it was before, and it is late already
                    batch.cause(UnloadResolved(item.query_id, item.failure))
            case c.SetStatus() | c.SetResponse() | c.ForceUnload() | c.Unregister():
                batch.cause(Answer(item.ticket, failure))
            case _:
                again.append((item, sender))
    return again
