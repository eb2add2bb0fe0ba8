"""Listings: what a registrar holds and serves at one moment, read from its catalog or asked of others.

The rows are picked on the loop; their bytes are decoded, by users' types, in the thread that asks.
"""

from __future__ import annotations

from typing import cast

from rr_actors.actors.calls import Calls
from rr_actors.actors.registrar import RegistrarActor
from rr_actors.actors.replies import Reply
from rr_actors.actors.server import ServerActor
from rr_actors.arguments import resource_target, target_id
from rr_actors.errors import UnknownQuery, is_a, shortened
from rr_actors.messages import FetchedQuery
from rr_actors.names import check_name
from rr_actors.queries import Query, ResourceInfo
from rr_actors.records import Held, Hold, Phase, Resource, State
from rr_actors.views import PLAIN, Views


class Listings:
    """The listings of one registrar. From any thread; Registrar's methods of the same names have the promises."""

    def __init__(self, actor: RegistrarActor, calls: Calls, views: Views) -> None:
        self._actor = actor
        self._calls = calls
        self._views = views

    # -- what it holds -------------------------------------------------------------------------------------------

    def queries(self) -> list[Query]:
        """Every query it holds, oldest first."""
        return self._calls.call(self._queries_now)

    def _queries_now(self) -> list[Query]:
        with self._actor.enter():
            held = [row for row in self._actor.whole().held.values() if row.hold is Hold.HELD]
        return [self._views.of(row) for row in sorted(held, key=lambda row: row.seq)]

    def fetch_queries(self, registrar: str, timeout_s: float | None) -> list[Query]:
        """The queries it holds at a provider, as that one has them."""
        self._calls.check_open()
        check_name(registrar, "registrar name")
        future: Reply[list[FetchedQuery]] = Reply()

        def fetched(queries: list[FetchedQuery] | None, error: Exception | None) -> None:
            if not future.done():
                future.set(queries) if error is None else future.set_exception((type(error), error, None))

        self._calls.dispatcher.call(lambda: self._actor.client(registrar).fetch(fetched))
        rows = self._calls.finish(future, timeout_s, f"fetching from {registrar!r}")
        return [self._fetched_view(registrar, row) for row in rows]

    def _fetched_view(self, registrar: str, row: FetchedQuery) -> Query:
        place = (registrar, row.server, row.request, row.response, row.resource_id, row.parent, row.attempt, row.seq)
        held = Held(row.query_id, *place, Hold.HELD, State(row.state))
        return self._views.seen(held)

    def children(self, target: Query | ResourceInfo | str) -> list[Query]:
        """The queries that a resource depends on, oldest first."""
        id = target_id(target)
        provider = cast("Query", target).registrar if is_a(target, Query) else self._provider_of(id)
        if provider in (None, self._actor.name):
            return self._calls.call(self._children_now, id)
        return self._calls.ask_other(provider, "children", resource_target(target))

    def _provider_of(self, id: str) -> str | None:
        held = self._actor.catalog.held.get(id)
        return None if held is None else held.registrar

    def _children_now(self, target: str) -> list[Query]:
        with self._actor.enter():
            catalog = self._actor.whole()
            resource_id = target
            if target in catalog.queries and target not in catalog.resources:
                resource_id = catalog.queries[target].resource_id
            if resource_id not in catalog.resources and resource_id not in catalog.parts:
                text = f"{shortened(target)}: {self._actor.name!r} serves no resource and no query of this id"
                raise UnknownQuery(text, query_id=target)
            parts = [catalog.held[id] for id in reversed(catalog.parts_of(resource_id))]
        return [self._views.of(held) for held in parts]

    def clients(self) -> list[str]:
        """The servers it holds something at."""
        rows = self._calls.call(self._held_now)
        return sorted({f"{row.registrar}/{row.server}" for row in rows if row.hold is not Hold.OWED})

    def _held_now(self) -> list[Held]:
        with self._actor.enter():
            return list(self._actor.whole().held.values())

    def owed(self) -> list[str]:
        """The ids of queries let go whose provider does not know it yet."""
        return [row.id for row in self._calls.call(self._held_now) if row.hold is Hold.OWED]

    # -- what it serves ------------------------------------------------------------------------------------------

    def resources(self) -> list[ResourceInfo]:
        """Every resource it serves."""
        rows = self._calls.call(self._resources_now)
        return [self._info(*row) for row in rows]

    def _resources_now(self) -> list[tuple[Resource, ServerActor | None, tuple[str, ...], tuple[str, ...]]]:
        rows: list[tuple[Resource, ServerActor | None, tuple[str, ...], tuple[str, ...]]] = []
        with self._actor.enter():
            catalog = self._actor.whole()
            for resource in catalog.resources.values():
                query_ids = tuple(catalog.holders.get(resource.id, ()))
                holders = tuple(catalog.queries[id].origin for id in query_ids)
                rows.append((resource, self._actor.servers.get(resource.server), holders, query_ids))
        return rows

    def _info(
        self, resource: Resource, server: ServerActor | None, holders: tuple[str, ...], queries: tuple[str, ...]
    ) -> ResourceInfo:
        request = (server.request if server else PLAIN).show(resource.request)
        response = None
        if resource.response is not None:
            response = (server.response if server else PLAIN).show(resource.response)
        state = str(resource.state if resource.phase is Phase.LOADED else resource.phase)
        facts = (state, resource.phase, resource.state, resource.message, resource.attempt)
        return ResourceInfo(resource.id, resource.server, request, response, *facts, holders, queries)

    def servers(self) -> list[str]:
        """The servers registered here."""
        names = self._calls.call(self._actor.servers.names)
        return sorted(f"{self._actor.name}/{name}" for name in names)

    # -- how much ------------------------------------------------------------------------------------------------

    def stats(self) -> dict[str, int]:
        """Counts of this moment."""
        return self._calls.call(self._stats_now)

    def _stats_now(self) -> dict[str, int]:
        actor = self._actor
        with actor.enter():
            holds = [row.hold for row in actor.whole().held.values()]
        return {
            "resources": len(actor.catalog.resources),
            "queries": holds.count(Hold.HELD),
            "owed": holds.count(Hold.OWED),
            "loading": holds.count(Hold.PENDING) + len(actor.catalog.in_flight),
            "unloading": len(actor.unloads),
            "notices": len(actor.catalog.notices),
            "callback_failures": actor.callback_failures,
        }
