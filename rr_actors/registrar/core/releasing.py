"""Releasing what a resource held elsewhere: newest first, one after another, and only then what waits for it.

The rows are made OWED in the batch that ends the resource, so a crash in between forgets nothing: what is owed is sent
again to each provider when the link to it is up. A provider that is down is not waited for.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Batch, Closing
from rr_actors.registrar.model.effects import Connect, Effect, LoadResolved, Request
from rr_actors.registrar.model.messages import Failure, Message, Unload
from rr_actors.registrar.model.rows import Held, Hold

_replace = msgspec.structs.replace


def request(batch: Batch, registrar: str, message: Message) -> None:
    """Send to a provider if the link is up; else have it made: reconciling sends everything open anyway."""
    if registrar in batch.catalog.up:
        batch.cause(Request(registrar, message))
    else:
        batch.cause(Connect(registrar))


def owe(batch: Batch, held: Held) -> Held:
    """Make the release of `held` owed, on disk. Whoever still waits for its load hears that it was withdrawn."""
    if held.hold is Hold.PENDING:
        batch.cause(LoadResolved(held, failures.withdrawn(held, "withdrawn, what asked for it is gone")))
    owed = _replace(held, hold=Hold.OWED)
    batch.put(owed)
    return owed


def withdraw(batch: Batch, held: Held, failure: Failure) -> None:
    """End a load that is not waited for any longer; if it still succeeds, it is released again."""
    batch.forget(batch.catalog.direct, held.id)
    batch.cause(LoadResolved(held, failure))
    batch.put(_replace(held, hold=Hold.OWED, resource_id=""))
    request(batch, held.registrar, Unload(held.id, batch.catalog.name))


def release_parts(batch: Batch, resource_id: str, after: Sequence[Effect], keep_attempt: int | None = None) -> None:
    """Release what the resource holds (with `keep_attempt`: except what that attempt loaded), then cause `after`."""
    catalog = batch.catalog
    ids: list[str] = []
    if resource_id in catalog.parts:  # most hold nothing
        ids = [id for id in catalog.parts_of(resource_id) if catalog.held[id].attempt != keep_attempt]
    for id in ids:
        owe(batch, catalog.held[id])
    if not ids:
        for effect in after:
            batch.cause(effect)
        return
    catalog.closings_made += 1
    number = catalog.closings_made
    batch.note(catalog.closings, number, Closing(tuple(ids), tuple(after)))
    _step(batch, number)


def released(batch: Batch, held_id: str) -> None:
    """The release of this part was answered, or cannot be: go on with the next."""
    catalog = batch.catalog
    number = batch.forget(catalog.closing_of, held_id)
    if number is not None:
        closing = catalog.closings[number]
        batch.note(catalog.closings, number, _replace(closing, remaining=closing.remaining[1:]))
        _step(batch, number)


def provider_lost(batch: Batch, registrar: str) -> None:
    """Nothing is answered by this provider now: do not wait for it."""
    catalog = batch.catalog
    waiting = [id for id in catalog.closing_of if id in catalog.held and catalog.held[id].registrar == registrar]
    for id in waiting:
        released(batch, id)


def _step(batch: Batch, number: int) -> None:
    catalog = batch.catalog
    closing = catalog.closings[number]
    remaining = closing.remaining
    while remaining:
        held = catalog.held.get(remaining[0])
        if held is not None and held.registrar in catalog.up:
            batch.note(catalog.closings, number, _replace(closing, remaining=remaining))
            batch.note(catalog.closing_of, held.id, number)
            batch.cause(Request(held.registrar, Unload(held.id, catalog.name)))
            return
        if held is not None:
            batch.cause(Connect(held.registrar))
        remaining = remaining[1:]
    batch.forget(catalog.closings, number)
    for effect in closing.after:
        batch.cause(effect)
