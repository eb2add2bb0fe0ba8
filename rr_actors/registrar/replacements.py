"""Replacements: a status callback puts a spare in the place of a part that failed.

A crash may come at any instruction. If the swap is not on disk by then, the status arrives and its callback runs again.
The callback finds the spare by its id, which is made of the ids of the part and of the status. A spare whose load had
not been answered is released, and loaded again under another id. After the swap, the
resource does not hold the part any more: its release is owed, and its statuses concern nobody.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

from rr_actors.base.errors import LoadError, UnknownQuery, UsageError
from rr_actors.base.names import ServerId, new_id
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.arguments import LoadOptions
from rr_actors.registrar.engine.status import next_spare
from rr_actors.registrar.loads import Loads, Unloads
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.failures import is_released
from rr_actors.registrar.model.rows import Held, Hold, Resource, priority_of
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.servers.callback_context import status_callback_of
from rr_actors.registrar.servers.server_actor import ServerActor


class _Found(NamedTuple):
    """A resource, its server, a part that it may hold, and the spares that it holds for this part, newest first."""

    resource: Resource
    server: ServerActor | None
    part: Held | None
    spares: list[Held]


class Replacements:
    """The replacements of one registrar. From any thread."""

    def __init__(self, loads: Loads, unloads: Unloads) -> None:
        self._actor, self._calls, self._views = loads.actor, loads.calls, loads.views
        self._loads = loads
        self._unloads = unloads

    def replace(
        self,
        status: Status,
        part_id: str,
        request: Any,
        target: ServerId | None,
        response: Callable[[Query], Any] | None,
        timeout_s: float | None,
    ) -> Query:
        """Load a spare, swap it for the part, and mark the status as handled, as Registrar.replace_part() says."""
        resource_id = status_callback_of(self._actor)
        if not resource_id:
            where = "expected to be called in a status callback of a server of this registrar"
            raise UsageError(f"registrar {self._actor.name!r}: replace_part: {where}")
        if not part_id:
            text = "the status is of the resource itself, and not of a part (its query_id is ''); part= names one"
            raise UsageError(f"registrar {self._actor.name!r}: replace_part: {text}")
        family = _family(part_id)
        found = self._calls.call(self._find, resource_id, part_id, family)
        if found.part is None:
            return self._replaced_before(status, part_id, found)
        place = target or ServerId(found.part.registrar, found.part.server)
        raw = encode(request)
        row = next((row for row in found.spares if (row.registrar, row.server, row.request) == (*place, raw)), None)
        if row is not None:  # an interrupted run of the callback has loaded the spare
            spare = self._calls.call(self._views.of, row)
        else:
            options = LoadOptions(timeout_s=timeout_s, priority=priority_of(found.part.priority), own=found.part.own)
            spare = self._load(status, family, place, raw, resource_id, options)
        self._swap(found, found.part, status, spare, family, response)
        status.handled()
        return spare

    def _load(
        self, status: Status, family: str, place: ServerId, request: bytes, resource_id: str, options: LoadOptions
    ) -> Query:
        """Load the spare by the next query whose load was not interrupted by a crash: such a query is released."""
        while True:
            id = _spare_id(family, place, request, next_spare(status))
            try:
                return self._loads.wait(place, request, resource_id, options, query_id=id)
            except LoadError as error:
                if not is_released(error):
                    raise

    def _find(self, resource_id: str, part_id: str, family: str) -> _Found:
        with self._actor.enter():
            catalog = self._actor.whole()
            resource = catalog.resources.get(resource_id)
            if resource is None:
                raise UnknownQuery(f"resource {resource_id}: unloaded already", query_id=part_id)
            parts = [catalog.held[id] for id in catalog.parts_of(resource_id)]
        held = [row for row in parts if row.hold is Hold.HELD]
        part = next((row for row in held if row.id == part_id), None)
        spares = [row for row in held if row.id.startswith(family)]
        return _Found(resource, self._actor.servers.get(resource.server), part, spares)

    def _replaced_before(self, status: Status, part_id: str, found: _Found) -> Query:
        if not found.spares:
            text = f"query {part_id}: resource {found.resource.id} does not hold this part any more"
            raise UnknownQuery(f"{text}: nothing is replaced", query_id=part_id)
        status.handled()
        return self._calls.call(self._views.of, found.spares[0])

    def _swap(
        self,
        found: _Found,
        part: Held,
        status: Status,
        spare: Query,
        family: str,
        response: Callable[[Query], Any] | None,
    ) -> None:
        resource = found.resource
        try:
            raw = None if response is None else encoded_response(response(spare), found.resource, found.server)
        except BaseException:
            self._unloads.begin(spare.id, None)
            raise
        others = tuple(row.id for row in self._calls.call(self._find, resource.id, "", family).spares)
        rest = tuple(id for id in others if id != spare.id)
        failed = "a part that failed" if part.id == status.query_id else f"{part.registrar}/{part.server}"
        text = f"{spare.server_id} takes the place of {failed}: {status.message}"
        swap = functools.partial(c.Swap, resource.id, part.id, spare.id, rest, new_id(), raw, text)
        self._calls.command(swap, f"replacing {part.id}")


def encoded_response(response: Any, resource: Resource | None, server: ServerActor | None) -> bytes:
    """Return the bytes of a new response of a resource.

    Raises:
        InvalidResponse, NotSerializable: the response has another type, or cannot travel.
    """
    if server is None:
        return encode(response, "response")
    raw = server.response.encode(response, server.origin)
    if resource is not None and (refusal := server.too_long(resource, raw)) is not None:
        raise refusal
    return raw


def _family(part_id: str) -> str:
    """Return the beginning of the ids of all spares for a part: UUIDv7 with the part's time, then a hash."""
    bits = hashlib.blake2b(part_id.encode(), digest_size=4).hexdigest()
    return f"{part_id[:12]}7{bits[:3]}8{bits[3:]}"


def _spare_id(family: str, place: ServerId, request: bytes, name: str) -> str:
    what = f"{place} {name} ".encode() + request
    return family + hashlib.blake2b(what, digest_size=16).hexdigest()[: 32 - len(family)]
