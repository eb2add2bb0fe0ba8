"""Pages: a few of a registrar's resources or queries at a time, as plain text, for tools that show a running system.

A registrar may serve 100,000 resources, and a screen shows fifty. So the registrar's process searches, sorts and cuts
the rows, and sends only the wanted ones. The calling thread lists the rows under the registrar's lock, and searches and
decodes them without it. What it needs of each row's neighbours it reads for a few hundred rows at a time.
"""

from __future__ import annotations

import heapq
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Literal, TypeVar

import msgspec
from msgspec.structs import replace

from rr_actors.base.names import named
from rr_actors.base.values.canonical import json_of, shown_plain, text_of_value
from rr_actors.registrar.core.callback_runs import run_id
from rr_actors.registrar.core.foretelling import End, foretell_restart, foretell_statuses, known_of
from rr_actors.registrar.core.loads.loading import is_reloaded
from rr_actors.registrar.engine.progress import shown_progress
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import STANDBY, Held, Hold, Notice, Phase, Resource, State, priority_of
from rr_actors.streams.stream import StreamRow

HOLDERS_SHOWN = 20
"""How many holders, and how many dependencies, a resource's row lists at most. It also has their total numbers."""
_PART = 4  # characters that a search for the beginning or end of an id needs
_FOUND = 20
_AT_ONCE = 200  # rows of which the neighbours are read while the lock is held
_RUN = 5000  # names that are sorted by one call of C, which lets no other thread run

_VALUE = re.compile(r"""["'{}()\[\],:\\]|\A[-+.\deE]+\Z""")  # JSON or Python punctuation, or a number

CONDITIONS = (
    "FATAL", "ERROR", "unload_failed", "revoked", "WARNING", "loading", "reloading", "resuming", "queued", "unloading",
    "pausing", "paused", "UPDATE", "OK",
)  # fmt: skip
"""What a ResourceRow.condition may be, the worst first."""

RELOADING = "reloading"
"""The phase, for people, of a resource that is loaded again on demand."""

_STATES = frozenset(str(state).lower() for state in State)
_TROUBLE = frozenset((State.WARNING, State.ERROR, State.FATAL))
_TAKEN = frozenset(("loaded", "pausing", "paused", "resuming"))  # phases of which a revocation says more

_Row = TypeVar("_Row", Resource, Held)
_Found = TypeVar("_Found")
_Sorted = TypeVar("_Sorted")


What = Literal["resources", "queries", "id", "servers", "loads", "streams", "response", "titles", "foretold"]


class Wanted(msgspec.Struct, frozen=True):
    """The page to return: `limit` rows from number `offset` on, of the rows that contain the text `match`.

    Responses are not searched. With "id", the rows of the resource and the query with this id, or with
    this beginning or end of an id. With "servers", all servers with their counts. With "loads", how often and how long
    loads of each server wait, and the queries whose loads wait now. With "streams", the open streams. With "response",
    the whole response of the resource with this id. With "foretold", what the registrar would do.

    Attributes:
        sort: one of RESOURCE_ORDERS or STREAM_ORDERS, or "trouble": those first where it began, the worst
            first; among equals, and with "", rows are as the registrar has them.
        states, holder: only resources in one of these states, in small letters, and with a holder of this name.
        ids: with "titles": of queries that are served here.
        end: with "foretold": after its process has ended so, and was started again; None: about these notices.
        notices, provider: with "foretold": notices of queries that it holds, and the registrar that sends them.
    """

    what: What
    match: str = ""
    offset: int = 0
    limit: int = 100
    sort: str = ""
    states: tuple[str, ...] = ()
    holder: str = ""
    ids: tuple[str, ...] = ()
    end: End | None = None
    provider: str = ""
    notices: tuple[Notice, ...] = ()


def priority_text(priority: int | None) -> str:
    """Return the text for a priority: "5", or "standby"."""
    return "standby" if priority is None else str(priority)


class HolderRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """A query on a resource, with its holder, and the holder's resource that depends on it; "" for none.

    `unheard`: how many statuses the holder has not dealt with. `priority`: None for standby.
    """

    query_id: str
    origin: str
    parent: str
    unheard: int = 0
    priority: int | None = 0


class ResourceRow(msgspec.Struct, frozen=True):
    """A resource as its provider sees it.

    Attributes:
        server: "registrar/server".
        request, response: as JSON, cut if it is long. What JSON does not have is shown as in Python.
        phase: "queued", "loading", "loaded", "reloading", "unloading", "unload_failed", "pausing", "paused" or
            "resuming".
        state, message: of the last status. While the resource is loading, `message` is its progress ("50% opening"),
            and while it is queued, its place in line; if it could not be unloaded, the reason.
        holders: the first 20 queries on it; `holder_count`: how many there are.
        parts: the ids of the first 20 queries that it depends on; `part_count`: how many there are.
        part_resources: the ids of the resources that those are on, of those that are loaded.
        title: of the request; "" if its server gives none.
        priority: the highest of its holders; None: all have it on standby, or nobody holds it.
        revoked: its holders are to release it, because its owner has revoked it, or one of its parts is revoked.
    """

    id: str
    server: str
    request: str
    response: str
    phase: str
    state: str
    message: str
    attempt: int
    holders: list[HolderRow]
    holder_count: int
    parts: list[str]
    part_count: int
    priority: int | None = 0
    revoked: bool = False
    part_resources: list[str] = []
    title: str = ""

    @property
    def text(self) -> str:
        """Its request for people: the title, if it has one."""
        return self.title or self.request

    @property
    def name(self) -> str:
        """Its server and its request or title, shortened for people."""
        return named(self.server, self.text)

    @property
    def condition(self) -> str:
        """The state of the last status while the resource is loaded, else its phase; "revoked" while it is that."""
        return _condition(self.phase, self.state, revoked=self.revoked)

    @property
    def needed(self) -> str:
        """The priority as a text: "5", or "standby"; "" if nobody holds it."""
        return priority_text(self.priority) if self.holder_count else ""

    @property
    def held_by(self) -> str:
        """The names of the first holders, each once."""
        return ", ".join(dict.fromkeys(holder.origin for holder in self.holders))


def _condition(phase: str, state: str, *, revoked: bool) -> str:
    if revoked and phase in _TAKEN:
        return "revoked"
    return state if phase == "loaded" else phase


class QueryRow(msgspec.Struct, frozen=True):
    """A query as its holder sees it.

    Attributes:
        origin: the registrar that holds it.
        server: "registrar/server".
        parent: the origin's resource that depends on it; "" for none.
        hold: "pending" (asked for), "held", or "owed" (released, and its provider does not know yet).
        priority: None for standby.
        said: in a page of loads, the last report of the load callback that it waits for: "50% opening".
        title: of the request, which its provider knows; "" if it has none.
    """

    id: str
    origin: str
    server: str
    resource_id: str
    parent: str
    request: str
    hold: str
    state: str
    priority: int | None = 0
    said: str = ""
    title: str = ""

    @property
    def text(self) -> str:
        """Its request for people: the title, if it has one."""
        return self.title or self.request

    @property
    def name(self) -> str:
        """The name of the resource that it is on."""
        return named(self.server, self.text)


class ServerRow(msgspec.Struct, frozen=True):
    """A server with its resources counted; or a registrar, for what it holds itself.

    Attributes:
        server: "registrar/server"; for what a registrar holds itself, "registrar".
        states: how many resources are in each state (ResourceRow.condition).
        holds: how many queries they hold at each "registrar/server".
        runs: how many of its callbacks run now, by their roles, "load" for instance.
        waiting: how many messages wait in its mailbox, of callbacks that have no room yet.
    """

    server: str
    states: dict[str, int] = {}
    holds: dict[str, int] = {}
    runs: dict[str, int] = {}
    waiting: int = 0


class LoadRow(msgspec.Struct, frozen=True):
    """How often and how long loads of one server waited, since the server was registered.

    Attributes:
        server: "registrar/server".
        loads: loads that have begun: those that ran the load callback, and those that shared its result.
        shared: loads that shared: they joined a resource that was loaded, or was being loaded.
        waited: loads that were not answered at once, because the load callback had to end first.
        failed: load callbacks that raised.
        loading: loads that wait now.
        mean_s, longest_s: how long load callbacks took, in seconds.
        p95_s: the time within which 95 % of the newest 500 of them ended.
        seconds: how long all of them took together.
        own_mean_s, own_p95_s: the same as mean_s and p95_s, without the time in which they waited for their parts.
    """

    server: str
    loads: int
    shared: int
    waited: int
    failed: int
    loading: int
    mean_s: float
    p95_s: float
    longest_s: float
    seconds: float
    own_mean_s: float = 0.0
    own_p95_s: float = 0.0


class ForeseenResource(msgspec.Struct, frozen=True):
    """What would become of a resource.

    Attributes:
        id: its id.
        name: its server and its request or title, shortened for people.
        becomes: "recovered" by its recover callback, "loaded again", "lost" or "unloaded"; or the state that it would
            have: "ERROR".
        message: of the status that its holders would hear.
    """

    id: str
    name: str
    becomes: str
    message: str = ""


class ForeseenStatus(msgspec.Struct, frozen=True):
    """A status that the holder of a query would hear.

    Attributes:
        holder: the registrar that holds the query.
        query_id: the query's id.
        name: the resource's.
        state, message: the status.
        listens: whether an on_status callback would hear it; else only `query.state` would say it.
    """

    holder: str
    query_id: str
    name: str
    state: str
    message: str = ""
    listens: bool = False


class ForetoldPage(msgspec.Struct, frozen=True):
    """What a registrar would do: with its resources, of which `kept` stay as they are, and which statuses it hears.

    `notices`: those that it would send to the holders of its resources.
    """

    resources: tuple[ForeseenResource, ...] = ()
    kept: int = 0
    heard: tuple[ForeseenStatus, ...] = ()
    notices: tuple[Notice, ...] = ()


class RowPage(msgspec.Struct, frozen=True):
    """The wanted rows, and how many rows match in all. `response`: as JSON.

    Attributes:
        said: with "loads", the last reports of this registrar's own load callbacks, by the queries that wait for them.
        counts: of rows that are sorted by a number, how many have each number, the most first.
        keys: the number of each row, if they are sorted by one.
        titles: of the requests of the queries that were asked for, and are known.
    """

    total: int
    resources: list[ResourceRow] = []
    queries: list[QueryRow] = []
    servers: list[ServerRow] = []
    loads: list[LoadRow] = []
    streams: list[StreamRow] = []
    response: str = ""
    said: dict[str, str] = {}
    counts: list[tuple[float, int]] = []
    keys: list[float] = []
    titles: dict[str, str] = {}
    foretold: ForetoldPage = ForetoldPage()


STREAM_ORDERS: dict[str, Callable[[StreamRow], float]] = {
    "rate": lambda row: row.info.rate_hz,
    "bytes": lambda row: row.info.bytes_per_s,
    "readers": lambda row: row.info.consumers,
    "missed": lambda row: row.info.missed,
}
"""The numbers by which streams are sorted."""
LOAD_ORDERS: dict[str, Callable[[LoadRow], float]] = {
    "loads": lambda row: row.loads,
    "shared": lambda row: row.shared,
    "waited": lambda row: row.waited,
    "failed": lambda row: row.failed,
    "waiting now": lambda row: row.loading * 2**53 + row.loads,
    "mean": lambda row: row.mean_s,
    "p95": lambda row: row.p95_s,
    "longest": lambda row: row.longest_s,
    "own mean": lambda row: row.own_mean_s,
    "own p95": lambda row: row.own_p95_s,
}
"""The numbers by which servers are sorted; of those where as many loads wait, the one with more loads comes first."""
RESOURCE_ORDERS = ("resource", "state", "priority", "holders")
"""The orders of resources: by server and request, the worst state, the highest priority, or the most holders first."""


def page_of(actor: RegistrarActor, wanted: Wanted) -> RowPage:
    """Return a page of what a registrar serves or holds. From any thread.

    Raises:
        RegistrarDown: the registrar is closed.
    """
    match wanted.what:
        case "resources":
            rows = _matching(_read(actor, lambda catalog: list(catalog.resources.values())), wanted.match, actor)
            rows, counts, keys = _in_order(actor, _of_state_and_holder(actor, rows, wanted), wanted.sort)
            here = slice(wanted.offset, wanted.offset + wanted.limit)
            return RowPage(len(rows), _resource_rows(actor, rows[here]), counts=counts, keys=keys[here])
        case "queries":
            held = _matching(_read(actor, lambda catalog: list(catalog.held.values())), wanted.match, actor)
            shown = held[wanted.offset : wanted.offset + wanted.limit]
            return RowPage(len(held), queries=[_query_row(actor.name, row) for row in shown])
        case "id":
            resources, queries = _of_id(actor, wanted.match)
            rows = _resource_rows(actor, resources)
            return RowPage(len(resources) + len(queries), rows, [_query_row(actor.name, row) for row in queries])
        case "servers":
            servers = _server_rows(actor)
            return RowPage(len(servers), servers=servers)
        case "loads":
            waiting = _matching(waiting_loads(actor), wanted.match, actor)
            loads = [row for row in load_rows(actor) if wanted.match in row.server]
            queries = [_query_row(actor.name, row) for row in waiting[wanted.offset : wanted.offset + wanted.limit]]
            return RowPage(len(waiting), queries=queries, loads=loads, said=actor.progress.said())
        case "streams":
            streams, counts, keys = _stream_rows(actor, wanted.match), list[tuple[float, int]](), list[float]()
            if (key := STREAM_ORDERS.get(wanted.sort)) is not None:
                streams, counts, keys = _by_number(streams, map(key, streams))
            here = slice(wanted.offset, wanted.offset + wanted.limit)
            return RowPage(len(streams), streams=streams[here], counts=counts, keys=keys[here])
        case "titles":
            known = _read(
                actor, lambda catalog: {id: row for id in wanted.ids if (row := catalog.find(id)) is not None}
            )
            return RowPage(len(known), titles={id: actor.title_of(row) for id, row in known.items()})
        case "foretold":
            found = _foretold(actor, wanted)
            return RowPage(len(found.resources) + found.kept, foretold=found)
        case "response":
            row = _read(actor, lambda catalog: catalog.find(wanted.match))
            raw = None if row is None else row.response
            return RowPage(int(raw is not None), response="" if raw is None else json_of(shown_plain(raw)))


def _foretold(actor: RegistrarActor, wanted: Wanted) -> ForetoldPage:
    """Return what a registrar would do. Only the copy of what it knows is made under its lock."""
    known = _read(actor, known_of)
    if wanted.end is not None:
        found = foretell_restart(known, wanted.end)
    else:
        found = foretell_statuses(known, wanted.provider, wanted.notices)
    return ForetoldPage(
        tuple(
            ForeseenResource(
                one.resource.id,
                named(
                    f"{actor.name}/{one.resource.server}",
                    actor.title_of(one.resource) or text_of_value(one.resource.request),
                ),
                one.becomes,
                one.message,
            )
            for one in found.fates
        ),
        found.kept,
        tuple(
            ForeseenStatus(
                actor.name,
                one.query_id,
                named(one.server, text_of_value(one.request)),
                one.state,
                one.message,
                one.listens,
            )
            for one in found.heard
        ),
        found.notices,
    )


def _stream_rows(actor: RegistrarActor, match: str) -> list[StreamRow]:
    rows: list[StreamRow] = []
    publishers = actor.publishers.all()
    ids = {publisher.stream.resource_id for publisher in publishers}
    resources = _read(actor, lambda catalog: {id: row for id in ids if (row := catalog.find(id)) is not None})
    for publisher in publishers:
        if (resource := resources.get(publisher.stream.resource_id)) is not None:
            server, request = f"{actor.name}/{resource.server}", text_of_value(resource.request)
            texts = resource.id, publisher.name, f"{server} {request}", actor.title_of(resource)
            if any(match in text for text in texts):
                rows.append(replace(publisher.row(server, request), title=actor.title_of(resource)))
    return sorted(rows, key=lambda row: (row.info.server, row.request, row.info.name))


def _server_rows(actor: RegistrarActor) -> list[ServerRow]:
    resources, held, names, revoked, runs = _read(
        actor,
        lambda catalog: (
            list(catalog.resources.values()),
            list(catalog.held.values()),
            list(catalog.servers),
            set(catalog.revocations),
            set(catalog.callback_runs),
        ),
    )
    states: dict[str, Counter[str]] = {name: Counter() for name in names}
    holds: dict[str, Counter[str]] = {}
    homes: dict[str, str] = {}
    for row in resources:
        homes[row.id] = row.server
        phase = RELOADING if run_id("reload", row.id) in runs else row.phase.value
        condition = _condition(phase, str(row.state), revoked=row.id in revoked)
        states.setdefault(row.server, Counter())[condition] += 1
    for query in held:
        if query.hold is not Hold.OWED:
            holds.setdefault(homes.get(query.parent, ""), Counter())[f"{query.registrar}/{query.server}"] += 1
    rows = [
        ServerRow(f"{actor.name}/{name}", dict(states[name]), dict(holds.get(name, {})), *_doing(actor, name))
        for name in states
    ]
    return [*rows, ServerRow(actor.name, {}, dict(holds[""]))] if "" in holds else rows


def _doing(actor: RegistrarActor, name: str) -> tuple[dict[str, int], int]:
    """Return the callbacks of a server that run now, by their roles, and how many wait in its mailbox."""
    server = actor.servers.get(name)
    return ({}, 0) if server is None else (dict(Counter(list(server.inside.values()))), len(server.waiting))


def load_rows(actor: RegistrarActor) -> list[LoadRow]:
    """Return how often and how long loads of each server of a registrar waited. From any thread.

    Raises:
        RegistrarDown: the registrar is closed.
    """
    with actor.enter():
        catalog = actor.whole()
        joined, waited = dict(catalog.joined), dict(catalog.waited)
        resources = [catalog.resources.get(id) for id in catalog.waiting.values()]
    loading = Counter(row.server for row in resources if row is not None)
    running = Counter(row.server for row in {row.id: row for row in resources if row is not None}.values())
    rows: list[LoadRow] = []
    for name in actor.servers.names():
        if (server := actor.servers.get(name)) is None:  # another thread has just unregistered it
            continue
        times, late = server.load_times, waited.get(name, 0)
        shared, ended = joined.get(name, 0) + late, times.loaded + times.failed
        begun = ended + running[name]
        counts = begun + shared, shared, begun + late, times.failed, loading[name]
        mean_s, own_mean_s = (each / ended if ended else 0.0 for each in (times.seconds, times.own_seconds))
        p95_s, own_p95_s = times.p95_s()
        seconds = mean_s, p95_s, times.longest_s, times.seconds, own_mean_s, own_p95_s
        rows.append(LoadRow(f"{actor.name}/{name}", *counts, *seconds))
    return rows


def counted_loads(rows: Iterable[LoadRow]) -> dict[str, int]:
    """Return how many loads these servers had together, and how many of them were shared."""
    rows = list(rows)
    return {"loads": sum(row.loads for row in rows), "shared": sum(row.shared for row in rows)}


def waiting_loads(actor: RegistrarActor) -> list[Held]:
    """Return the queries of a registrar whose loads wait, oldest first. From any thread.

    Unlike for other pages, loads on direct connections stay there: to look at what waits makes no load slower.

    Raises:
        RegistrarDown: the registrar is closed.
    """
    with actor.enter():
        catalog = actor.whole()
        settled = [catalog.held[id] for id in catalog.unsettled]
        rows = [row for row in settled if row.hold is Hold.PENDING] + list(catalog.in_flight.values())
    return sorted(rows, key=lambda row: row.id)


def _read(actor: RegistrarActor, reader: Callable[[Catalog], _Found]) -> _Found:
    """Return what `reader` returns of the catalog. The lock keeps all decisions out meanwhile."""
    actor.settle()
    with actor.enter():
        return reader(actor.whole())


def _matching(rows: list[_Row], text: str, actor: RegistrarActor) -> list[_Row]:
    """Return the rows of a registrar that have the text in them, or in the titles of the requests that it serves."""
    if not text:
        return rows
    raw, in_json = text.encode("utf-8", "replace"), json_of(text)[1:-1]
    # To decode a request takes 5 us. It must be done if the text may be in it though its bytes are not.
    decodes = _VALUE.search(text) is not None or any(text in word for word in ("true", "false", "null"))

    def matches(row: Resource | Held) -> bool:
        if any(text in value for value in _texts(row, actor.name)):
            return True
        if isinstance(row, Resource) and text in actor.title_of(row):
            return True
        if not (decodes or raw in row.request):
            return False
        request = json_of(shown_plain(row.request))  # a number or a length may be the same byte as a letter
        return text in request or in_json in request

    return [row for row in rows if matches(row)]


def _of_state_and_holder(actor: RegistrarActor, rows: list[Resource], wanted: Wanted) -> list[Resource]:
    def is_chosen(catalog: Catalog, row: Resource) -> bool:
        said = {_condition_in(catalog, row).lower(), str(row.state).lower() if row.phase is Phase.LOADED else ""}
        if wanted.states and not said.intersection(wanted.states):
            return False
        queries = catalog.holders.get(row.id, ()) if wanted.holder else ()
        return not wanted.holder or any(catalog.queries[id].origin == wanted.holder for id in queries)

    if wanted.states and not (wanted.holder or _STATES.issuperset(wanted.states)):
        return list(itertools.compress(rows, _of_each(actor, rows, is_chosen)))
    if wanted.states:  # of a few states that the rows have themselves: 100,000 rows without the lock
        chosen = {state for state in State if str(state).lower() in wanted.states}
        rows = [row for row in rows if row.state in chosen and row.phase is Phase.LOADED]
    if not wanted.holder:
        return rows
    return list(itertools.compress(rows, _of_each(actor, rows, is_chosen)))


def _began_here(catalog: Catalog, row: Resource) -> bool:
    """Return whether no part of a resource is in trouble, so that its own trouble began here."""
    parts = (catalog.held.get(id) for id in catalog.parts_of(row.id))
    return all(part is None or part.state not in _TROUBLE for part in parts)


_ORDERS: dict[str, Callable[[Catalog, Resource], float]] = {
    "trouble": lambda catalog, row: 100 * _began_here(catalog, row) - CONDITIONS.index(_condition_in(catalog, row)),
    "state": lambda catalog, row: -CONDITIONS.index(_condition_in(catalog, row)),
    "priority": lambda catalog, row: STANDBY - 1 if row.id not in catalog.holders else catalog.priority_of(row.id),
    "holders": lambda catalog, row: len(catalog.holders.get(row.id, ())),
}


def _condition_in(catalog: Catalog, row: Resource) -> str:
    return _condition(_phase_in(catalog, row), str(row.state), revoked=row.id in catalog.revocations)


def _phase_in(catalog: Catalog, row: Resource) -> str:
    return RELOADING if is_reloaded(catalog, row.id) else row.phase.value


def _of_each(
    actor: RegistrarActor, rows: Sequence[Resource], fact: Callable[[Catalog, Resource], _Found]
) -> list[_Found]:
    """Return a fact of each resource. The lock is held for a few hundred of them at a time."""

    def facts(part: Sequence[Resource], catalog: Catalog) -> list[_Found]:
        return [fact(catalog, row) for row in part]

    begins = range(0, len(rows), _AT_ONCE)
    return [one for begin in begins for one in _read(actor, partial(facts, rows[begin : begin + _AT_ONCE]))]


def _in_order(
    actor: RegistrarActor, rows: list[Resource], sort: str
) -> tuple[list[Resource], list[tuple[float, int]], list[float]]:
    """Return resources in the order `sort`, with the counts and keys of a RowPage, if they are sorted by a number."""
    if (key := _ORDERS.get(sort)) is not None:
        return _by_number(rows, _of_each(actor, rows, key))
    if sort == "resource":
        named = [(row.server, text_of_value(row.request), at) for at, row in enumerate(rows)]
        parts = [sorted(named[begin : begin + _RUN]) for begin in range(0, len(named), _RUN)]
        rows = [rows[at] for *_, at in heapq.merge(*parts)]
    return rows, [], []


def _by_number(
    rows: Iterable[_Sorted], keys: Iterable[float]
) -> tuple[list[_Sorted], list[tuple[float, int]], list[float]]:
    """Return the rows by their keys, the highest first, with the counts and keys of a RowPage.

    Many rows have few keys. So only the keys are sorted: other threads run meanwhile.
    """
    having: dict[float, list[_Sorted]] = {}
    for row, key in zip(rows, keys, strict=True):
        having.setdefault(key, []).append(row)
    counts = [(key, len(having[key])) for key in sorted(having, reverse=True)]
    return [row for key, _ in counts for row in having[key]], counts, [key for key, n in counts for _ in range(n)]


def _texts(row: Resource | Held, name: str) -> tuple[str, ...]:
    if isinstance(row, Held):
        return row.id, f"{row.registrar}/{row.server}", row.resource_id, row.parent, row.hold, row.state
    return row.id, f"{name}/{row.server}", row.phase, row.state, row.message


def _of_id(actor: RegistrarActor, id: str) -> tuple[list[Resource], list[Held]]:
    """Return the resource and the query of an id; else the first of those whose ids begin or end with it.

    The id of a query that is served here stands for its resource.
    """

    def rows(catalog: Catalog, served: list[str], held: list[str]) -> tuple[list[Resource], list[Held]]:
        resources = {row.id: row for name in served if (row := catalog.find(name)) is not None}
        return list(resources.values()), [row for name in held if (row := catalog.held.get(name)) is not None]

    found = _read(actor, lambda catalog: rows(catalog, [id], [id]))
    if any(found) or len(id) < _PART:
        return found
    served, held = _read(actor, lambda catalog: ([*catalog.resources, *catalog.queries], list(catalog.held)))
    served, held = _with_part(id, served), _with_part(id, held)
    return _read(actor, lambda catalog: rows(catalog, served, held))


def _with_part(text: str, ids: Iterable[str]) -> list[str]:
    return list(itertools.islice((id for id in ids if id.startswith(text) or id.endswith(text)), _FOUND))


def _resource_rows(actor: RegistrarActor, resources: list[Resource]) -> list[ResourceRow]:
    def around(
        catalog: Catalog, resource: Resource
    ) -> tuple[str, tuple[list[HolderRow], int, list[str], int, int | None, bool, list[str]]]:
        queries, parts = catalog.holders.get(resource.id, ()), catalog.parts_of(resource.id)
        first = [catalog.queries[id] for id in itertools.islice(queries, HOLDERS_SHOWN)]
        unheard = [len(catalog.notices_on.get(query.id, ())) for query in first]
        holders = [
            HolderRow(query.id, query.origin, query.parent, n, priority_of(query.priority))
            for query, n in zip(first, unheard, strict=True)
        ]
        priority = priority_of(catalog.priority_of(resource.id))
        shown = list(reversed(parts))[:HOLDERS_SHOWN]
        below = [catalog.held[id].resource_id for id in shown if id in catalog.held]
        revoked = resource.id in catalog.revocations
        return _phase_in(catalog, resource), (holders, len(queries), shown, len(parts), priority, revoked, below)

    neighbours = _of_each(actor, resources, around)
    rows: list[ResourceRow] = []
    for row, (phase, others) in zip(resources, neighbours, strict=True):
        state = str(row.state) if row.phase is Phase.LOADED else ""
        message = row.message
        if row.phase in (Phase.LOADING, Phase.QUEUED) and (progress := actor.progress.newest(row.id)) is not None:
            message = shown_progress(*progress)
        elif row.server not in actor.catalog.servers:
            message = failures.waits_for_server(actor.catalog, row)
        texts = text_of_value(row.request), text_of_value(row.response), phase, state, message
        rows.append(
            ResourceRow(row.id, f"{actor.name}/{row.server}", *texts, row.attempt, *others, actor.title_of(row))
        )
    return rows


def _query_row(name: str, row: Held) -> QueryRow:
    server, request = f"{row.registrar}/{row.server}", text_of_value(row.request)
    facts = row.hold.value, row.state.value, priority_of(row.priority)
    return QueryRow(row.id, name, server, row.resource_id, row.parent, request, *facts)
