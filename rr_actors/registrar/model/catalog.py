"""Catalog: a registrar's rows in memory, with the indexes over them; Decision: changes of it that can be undone.

decide() and what it calls read the catalog, and write to it through a Decision. No I/O here, no clock, no
randomness: the same messages in the same order give the same catalog and the same effects.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from operator import attrgetter
from typing import Any, TypeVar

import msgspec

from rr_actors.registrar.model.effects import Effect, StartStatus
from rr_actors.registrar.model.messages import Failure
from rr_actors.registrar.model.rows import (
    HELD,
    LOADED,
    LOADING,
    OWED,
    QUEUED,
    TABLE_OF,
    UNLOADING,
    Change,
    Content,
    Drop,
    Held,
    Notice,
    Peer,
    Put,
    Query,
    Resource,
    Row,
    ServerType,
    State,
    StoredServer,
    Table,
    content_of,
    is_own,
)

_JOINABLE = (LOADED, LOADING, QUEUED)
_MOVING = (LOADING, QUEUED, UNLOADING)

_seq, _origin, _server, _resource_id = map(attrgetter, ("seq", "origin", "server", "resource_id"))
_registrar, _parent, _query_id = map(attrgetter, ("registrar", "parent", "query_id"))
_EPOCH_BITS = 32

RequestKey = tuple[str, bytes]

ABSENT: Any = object()
"""In an Undo: there was nothing."""

Undo = list[tuple["Table | dict[Any, Any]", Any, Any]]
"""What was changed, in its order: the table, or the in-memory dict; the key; and what was there before."""


class Server(msgspec.Struct, frozen=True):
    """What the decisions need to know of a registered server; its callbacks are the server actor's."""

    name: str
    linger_s: float = 0.0
    load_timeout_s: float | None = None
    recovery: str = "keep"
    has_status: bool = False
    has_recover: bool = False
    types: bytes = b""  # of requests and responses, for consumers (rows.ServerType)


class Closing(msgspec.Struct, frozen=True):
    """Releases that go out one after another, newest first; when the last is done, `after` happens."""

    remaining: tuple[str, ...]
    after: tuple[Effect, ...]


class Hearing(msgspec.Struct, frozen=True):
    """A notice that is being dealt with: whose, by how many receivers still, and whether it was marked repeated.

    `ends`: the query that ends with it ("" for none).
    """

    provider: str
    receivers: int
    repeated: bool
    ends: str


class Catalog:
    """Everything one registrar knows.

    Rows, as on disk: `resources` and `queries` it serves, `held` queries of its own, `notices` to deliver, `peers` it
    has asked, `stored_servers`, `server_types`.  Indexes follow the rows.  The rest lives in memory only and can be
    lost in a crash, because those who wait ask again:

    - `deaths`: how the last processes of this registrar died, one after another, in words for people.
    - `servers`: registered now; those `leaving` take no new loads. `up`: providers whose link is reconciled, with the
      number of the Fetch that opened that link: what was decided for one link is not sent over another. On the next the
      provider is to hear Fetch, and until its answer nothing else.
      `consumers`: origins that have fetched their queries over a link that is still there.
    - `waiting`: queries whose Load has not been answered in this incarnation. `refused`: those whose Load was, lately.
      `unanswered`: queries whose Unload has come over the present link and has not been answered.
    - `recovering`: resources whose recover callback runs, with the messages parked until it is done.
    - `closings`, `closing_of`: releases in progress. `direct`: queries whose Load goes by a connection of their
      caller's thread that has not answered yet; False: it has ended by another way. `fresh`: those answered while the
      provider's link was down: a list it sent over the next may be older. `in_flight`: the rows of what threads have
      asked for by such connections, until something is decided about it; the threads add to it. `kept`: held queries
      that were owed for a while, until their unload failed. A second try may still succeed. And the statuses of that
      time were passed over, so a response that is sent again may be newer than the row's. Of other queries it is older.
    - `owners`: tickets of the owner's own calls that wait for a resource to be unloaded.
    - `told`: notices sent before (a second sending is marked repeated). `heard`: statuses received, by receiver (a
      query, or the resource that depends on it) and event, with the ids of the notices that wait for the receiver to
      have dealt with it. `hearing`: those notices. `deferred`: by resource, the statuses that its server hears when
      the load callback, or the recover callback, has returned. `next_to_hear`: by notice, the statuses of parts that
      the resource hears when those who listen to the part have heard them. `ending`: queries taken away whose holders
      are being told.
      `acked`: providers that were sent acknowledgements, or are to be, and may not have got them when a link is lost.

    Args:
        name: the registrar's.
        content: what is on disk; it is the catalog's own from now on.
        epoch: how often the catalog has been opened; running numbers and resource ids of different epochs differ.
    """

    def __init__(self, name: str, content: Content | None = None, epoch: int = 1) -> None:
        self.name = name
        self.epoch = epoch
        self.tables = content_of(()) if content is None else content
        self.resources: dict[str, Resource] = self.tables["resources"]
        self.queries: dict[str, Query] = self.tables["queries"]
        self.held: dict[str, Held] = self.tables["held"]
        self.notices: dict[str, Notice] = self.tables["notices"]
        self.peers: dict[str, Peer] = self.tables["peers"]
        self.stored_servers: dict[str, StoredServer] = self.tables["stored_servers"]
        self.server_types: dict[str, ServerType] = self.tables["server_types"]
        # indexes
        self.by_request: defaultdict[str, dict[bytes, str]] = defaultdict(dict)  # server -> request -> what it gets
        self.unloading: dict[RequestKey, Ids] = {}
        self.queued: dict[RequestKey, Ids] = {}
        self.moving: dict[str, bool] = {}  # resources that are loading, queued, or being unloaded
        self.by_server: dict[str, Ids] = {}
        self.holders: dict[str, Ids] = {}  # resource -> queries
        self.by_origin: dict[str, Ids] = {}  # origin -> queries
        self.notices_to: dict[str, Ids] = {}  # origin -> notices
        self.notices_on: dict[str, Ids] = {}  # query -> notices
        self.own_notices: dict[str, Ids] = {}  # resource -> notices that its own server has to hear first
        self.parts: dict[str, Ids] = {}  # resource -> held, those owed excepted
        self.outbound: dict[str, Ids] = {}  # provider -> held
        self.unsettled: dict[str, str] = {}  # held that are asked for or owed -> provider
        self._index: dict[Table, Callable[[Any, Any], None]] = {
            "resources": self._index_resource,
            "queries": self._index_query,
            "held": self._index_held,
            "notices": self._index_notice,
        }
        # in memory only
        self.deaths = ""
        self.servers: dict[str, Server] = {}
        self.up: dict[str, int] = {}
        self.waiting: dict[str, str] = {}
        self.refused: dict[str, Failure] = {}
        self.unanswered: dict[str, bool] = {}
        self.recovering: dict[str, tuple[Any, ...]] = {}
        self.closings: dict[int, Closing] = {}
        self.closing_of: dict[str, int] = {}
        self.owners: dict[str, tuple[Any, ...]] = {}
        self.told: dict[str, bool] = {}
        self.heard: dict[tuple[str, str, str], tuple[str, ...]] = {}
        self.hearing: dict[str, Hearing] = {}
        self.deferred: dict[str, tuple[StartStatus, ...]] = {}
        self.next_to_hear: dict[str, StartStatus] = {}
        self.listened: set[str] = set()  # queries and server ids that somebody listens to, who may deal with a status
        self.ending: dict[str, bool] = {}
        self.acked: dict[str, bool] = {}
        self.direct: dict[str, bool] = {}
        self.kept: dict[str, bool] = {}
        self.fresh: dict[str, bool] = {}
        self.in_flight: dict[str, Held] = {}
        self.leaving: dict[str, Any] = {}
        self.consumers: dict[str, bool] = {}
        self.closings_made = 0
        self.seq = 0
        self.unfinished: Undo | None = None  # of the decision that is being applied; None between decisions
        self._fill_indexes()
        self.told.update(dict.fromkeys(self.notices, True))
        self.seq = max(epoch << _EPOCH_BITS, max(map(_seq, self.held.values()), default=0))
        self.since = self.seq  # queries with a greater number were asked for by this Catalog: it knows all about them

    def _fill_indexes(self) -> None:
        """As putting each row in its place with set(); an index at a time, as there may be a million."""
        self._fill_by_phase()
        self.by_server = built(map(_server, self.resources.values()), self.resources)
        self.holders = built(map(_resource_id, self.queries.values()), self.queries)
        self.by_origin = built(map(_origin, self.queries.values()), self.queries)
        self.outbound = built(map(_registrar, self.held.values()), self.held)
        parts = {id: row for id, row in self.held.items() if row.parent and row.hold is not OWED}
        self.parts = built(map(_parent, parts.values()), parts)
        self.unsettled = {id: row.registrar for id, row in self.held.items() if row.hold is not HELD}
        own = {id: row for id, row in self.notices.items() if is_own(row)}
        sent = {id: row for id, row in self.notices.items() if id not in own} if own else self.notices
        self.own_notices = built(map(_resource_id, own.values()), own)
        self.notices_to = built(map(_origin, sent.values()), sent)
        self.notices_on = built(map(_query_id, sent.values()), sent)

    def _fill_by_phase(self) -> None:
        loaded, fatal, by_request = LOADED, State.FATAL, self.by_request
        for row in self.resources.values():
            if row.phase is not loaded:
                self._index_phase(None, row)
            elif row.state is not fatal:
                by_request[row.server][row.request] = row.id

    def roll_back(self) -> list[tuple[Table, str]]:
        """Undo the decision that was interrupted, wherever that was; returns the rows that it had begun to change.

        May be interrupted itself, and then begins again.
        """
        rows: list[tuple[Table, str]] = []
        for where, key, old in reversed(self.unfinished or ()):
            entries: dict[Any, Any]
            if isinstance(where, str):
                rows.append((where, key))
                entries = self.tables[where]
            else:
                entries = where
            if old is ABSENT:
                entries.pop(key, None)
            else:
                entries[key] = old
        for index in (self.by_request, self.unloading, self.queued, self.moving):
            index.clear()
        self._fill_indexes()
        return rows

    def next_seq(self, given: int = 0) -> int:
        """The running number of the next query this registrar asks for; one may have been given to it already."""
        number = given or self.seq + 1
        self.seq = max(self.seq, number)
        return number

    def new_resource_id(self, query_id: str) -> str:
        """The id of the resource that a query makes: its own, told apart from what it made before.

        A query makes a second one when its refusal was lost and it is sent again. What the first had loaded elsewhere
        must not be taken for the second's, also when a crash lies between: hence the epoch.
        """
        id = query_id if self.epoch <= 1 else f"{query_id}.{self.epoch}"
        number = 1
        free = id
        while free in self.resources:
            number += 1
            free = f"{id}+{number}"
        return free

    def joinable(self, server: str, request: bytes) -> str | None:
        """The id of the resource that an identical request gets: at most one."""
        requests = self.by_request.get(server)
        return None if requests is None else requests.get(request)

    def find(self, target: str) -> Resource | None:
        """The resource with this id, or the one the query with this id is on."""
        resource = self.resources.get(target)
        if resource is None:
            query = self.queries.get(target)
            resource = self.resources[query.resource_id] if query is not None else None
        return resource

    def queries_of(self, resource_id: str) -> list[Query]:
        """The queries on a resource."""
        return [self.queries[id] for id in self.holders.get(resource_id, ())]

    def holder_of(self, resource_id: str) -> str:
        """The registrar whose query on a resource is the oldest; "" if nobody holds it."""
        for query_id in self.holders.get(resource_id, ()):
            return self.queries[query_id].origin
        return ""

    def needs(self, provider: str) -> bool:
        """Whether a link to the provider is to be kept: something is asked, held, owed or to be acknowledged there."""
        return provider in self.outbound or provider in self.acked or (self.epoch > 1 and provider in self.peers)

    def set(self, table: Table, id: str, new: Any, undo: Undo | None = None) -> None:
        """Put the row in memory, or take it out (None), when it is noted in `undo` what was there."""
        rows = self.tables[table]
        old = rows.get(id)
        if undo is not None:
            undo.append((table, id, ABSENT if old is None else old))
        if new is None:
            rows.pop(id, None)
        else:
            rows[id] = new
        index = self._index.get(table)
        if index is not None and old is not new:
            index(old, new)

    def unsettled_at(self, provider: str) -> list[Held]:
        """What is asked for, or owed, at a provider."""
        return [self.held[id] for id, where in self.unsettled.items() if where == provider]

    def newest_first(self, held_ids: Iterable[str]) -> list[str]:
        """The ids of held queries in the order they are released in."""
        return sorted(held_ids, key=lambda id: self.held[id].seq, reverse=True)

    def parts_of(self, resource_id: str) -> list[str]:
        """What the resource holds elsewhere, newest first."""
        return self.newest_first(self.parts.get(resource_id, ()))

    def origin_of(self, resource: Resource) -> str:
        """The resource's server id, "registrar/server"."""
        return f"{self.name}/{resource.server}"

    # -- indexes ------------------------------------------------------------------------------------------------

    def _index_resource(self, old: Resource | None, new: Resource | None) -> None:
        self._index_phase(old, new)
        if old is None and new is not None:
            add(self.by_server, new.server, new.id)
        elif new is None and old is not None:
            discard(self.by_server, old.server, old.id)

    def _index_phase(self, old: Resource | None, new: Resource | None) -> None:
        if old is not None and old.phase in _MOVING:
            del self.moving[old.id]
            if new is not None and old.phase is LOADING and new.phase is LOADED and new.state is old.state:
                return  # the common change: requests find it as before
        if old is not None:
            key = (old.server, old.request)
            if self.joinable(*key) == old.id:
                del self.by_request[old.server][old.request]
                if not self.by_request[old.server]:
                    del self.by_request[old.server]
            if old.phase is UNLOADING:
                discard(self.unloading, key, old.id)
            elif old.phase is QUEUED:
                discard(self.queued, key, old.id)
        if new is not None:
            if new.phase in _MOVING:
                self.moving[new.id] = True
            if new.phase in _JOINABLE and new.state is not State.FATAL:
                self.by_request[new.server][new.request] = new.id
            elif new.phase is UNLOADING:
                add(self.unloading, (new.server, new.request), new.id)
            if new.phase is QUEUED:
                add(self.queued, (new.server, new.request), new.id)

    def _index_query(self, old: Query | None, new: Query | None) -> None:
        if old is not None:
            discard(self.holders, old.resource_id, old.id)
            discard(self.by_origin, old.origin, old.id)
        if new is not None:
            add(self.holders, new.resource_id, new.id)
            add(self.by_origin, new.origin, new.id)

    def _index_held(self, old: Held | None, new: Held | None) -> None:
        if new is not None and new.hold is not HELD:
            self.unsettled[new.id] = new.registrar
        elif old is not None and old.hold is not HELD:
            del self.unsettled[old.id]
        if old is not None:
            if new is not None and _stands_there(old, new):
                return
            discard(self.outbound, old.registrar, old.id)
            if old.parent:
                discard(self.parts, old.parent, old.id)
        if new is not None:
            add(self.outbound, new.registrar, new.id)
            if new.parent and new.hold is not OWED:
                add(self.parts, new.parent, new.id)

    def _index_notice(self, old: Notice | None, new: Notice | None) -> None:
        if old is not None and is_own(old):
            discard(self.own_notices, old.resource_id, old.id)
        elif old is not None:
            discard(self.notices_to, old.origin, old.id)
            discard(self.notices_on, old.query_id, old.id)
        if new is not None and is_own(new):
            add(self.own_notices, new.resource_id, new.id)
        elif new is not None:
            add(self.notices_to, new.origin, new.id)
            add(self.notices_on, new.query_id, new.id)


def _stands_there(old: Held, new: Held) -> bool:
    """Whether a new row is under the same keys as the old one: the common change, pending to held, and held to owed."""
    if new.registrar != old.registrar or new.parent != old.parent:
        return False
    return not new.parent or (new.hold is OWED) is (old.hold is OWED)


# -- indexes -----------------------------------------------------------------------------------------------------------
#
# Ids by a key. Most keys have one id; a million of those must be no burden. One id is a tuple: 48 bytes where a dict
# has 232, and nothing the garbage collector looks at twice. A key that has had more keeps its dict until it has none.

K = TypeVar("K")
_SOME = 2000

Ids = tuple[str] | dict[str, None]
"""Some ids, in the order in which they were added."""


def add(index: dict[K, Ids], key: K, id: str) -> None:
    """Put the id under the key."""
    ids = index.get(key)
    if ids is None:
        index[key] = (id,)
    elif type(ids) is dict:
        ids[id] = None
    elif id not in ids:
        index[key] = {**dict.fromkeys(ids), id: None}


def discard(index: dict[K, Ids], key: K, id: str) -> None:
    """Take the id away, and the key with the last of them."""
    ids = index.get(key)
    if ids is None or id not in ids:
        return
    if len(ids) == 1:
        del index[key]
    elif type(ids) is dict:
        del ids[id]


def built(keys: Iterable[K], ids: Collection[str]) -> dict[K, Ids]:
    """The index that adding all of them comes to; keys and ids go in pairs. Of ids in a dict no hash is made again."""
    keys = list(keys)
    if len(ids) > 1 and keys[0] == keys[-1] and keys.count(keys[0]) == len(keys):
        return {keys[0]: dict.fromkeys(ids)}
    if len(set(keys[:_SOME])) == len(keys[:_SOME]):  # each has its own, perhaps
        index: dict[K, Ids] = dict(zip(keys, zip(ids, strict=True), strict=True))
        if len(index) == len(ids):
            return index
    groups: defaultdict[K, list[str]] = defaultdict(list)
    for key, id in zip(keys, ids, strict=True):
        groups[key].append(id)
    return {key: dict.fromkeys(group) if len(group) > 1 else (group[0],) for key, group in groups.items()}


# -- changes that can be undone ----------------------------------------------------------------------------------------
#
# A Decision applies each change to memory at once, because the next message that it is about must see it. It notes how
# to undo a change before it makes it. The registrar commits the decision while it still has the lock, and undoes it if
# that fails.
#
# An interrupt (Ctrl-C) may come between any two instructions. What is noted then stays in `Catalog.unfinished`, and the
# next thread that has the lock rolls it back (Catalog.roll_back).


class Decision:
    """What some messages and commands change and cause. After close() or undo() it is over.

    `changes` must be on disk before any effect is acted upon. `later` are changes of rows that can be rebuilt from
    elsewhere, by table and id: they may reach the disk a moment after, and are written behind `changes`.
    """

    __slots__ = ("_counters", "_undo", "catalog", "changes", "effects", "later")

    def __init__(self, catalog: Catalog) -> None:
        self.catalog = catalog
        self.changes: list[Change] = []
        self.later: dict[tuple[Table, str], Change] = {}
        self.effects: list[Effect] = []
        self._undo: Undo = []
        self._counters = (catalog.seq, catalog.closings_made)
        catalog.unfinished = self._undo

    def put(self, row: Row) -> None:
        """Insert or replace a row, durably."""
        table, id = TABLE_OF[type(row)], row.id
        self.catalog.set(table, id, row, self._undo)
        self.changes.append(Put(row))
        if self.later:
            self.later.pop((table, id), None)  # older than this

    def drop(self, row: Row) -> None:
        """Remove a row, durably."""
        table = TABLE_OF[type(row)]
        self.catalog.set(table, row.id, None, self._undo)
        self.changes.append(Drop(table, row.id))
        if self.later:
            self.later.pop((table, row.id), None)

    def put_later(self, row: Row) -> None:
        """Insert or replace a row that could be rebuilt."""
        table = TABLE_OF[type(row)]
        self.catalog.set(table, row.id, row, self._undo)
        self.later[table, row.id] = Put(row)

    def drop_later(self, row: Row) -> None:
        """Remove a row that would be seen to be gone anyway."""
        table = TABLE_OF[type(row)]
        self.catalog.set(table, row.id, None, self._undo)
        self.later[table, row.id] = Drop(table, row.id)

    def put_here(self, row: Row) -> None:
        """Insert or replace a row in memory alone: it is on disk, or would mean nothing to the next incarnation."""
        self.catalog.set(TABLE_OF[type(row)], row.id, row, self._undo)

    def note(self, memory: dict[Any, Any], key: Any, value: Any) -> None:
        """Set an entry of one of the catalog's in-memory dicts."""
        self._undo.append((memory, key, memory.get(key, ABSENT)))
        memory[key] = value

    def forget(self, memory: dict[Any, Any], key: Any) -> Any:
        """Take an entry out of one of the catalog's in-memory dicts; returns it, or None."""
        if key not in memory:
            return None
        self._undo.append((memory, key, memory[key]))
        return memory.pop(key)

    def cause(self, effect: Effect) -> None:
        """Have this done once the changes are on disk."""
        self.effects.append(effect)

    def close(self) -> None:
        """The changes are on disk, or wait to be written: they stay."""
        self.catalog.unfinished = None

    def undo(self) -> None:
        """Take back everything: the catalog is as it was before the decision.

        Only what was applied completely: after an interrupt it is Catalog.roll_back() that does it.
        """
        for where, key, old in reversed(self._undo):
            if isinstance(where, str):
                self.catalog.set(where, key, None if old is ABSENT else old)
            elif old is ABSENT:
                where.pop(key, None)
            else:
                where[key] = old
        self.catalog.seq, self.catalog.closings_made = self._counters
        self.catalog.unfinished = None
        self._undo = []
        self.changes.clear()
        self.later.clear()
        self.effects.clear()


# -- changes that are written a moment later ---------------------------------------------------------------------------

Key = tuple[Table, str]


class Unsaved:
    """The last change of each row that waits to be written.

    What was never written need not be owed on disk: after a crash nobody here knows of it, and its provider says
    whether it is held. So a query that its holder releases within that time leaves nothing in the catalog. "Never
    written" is more than "waits to be written": a row that waits may be newer than one on disk.

    Attributes:
        some: the changes that wait, by table and id; but for `new`.
        new: by id the held queries of which no commit has written anything; None: it is released, and does not wait.
    """

    __slots__ = ("new", "some")

    def __init__(self) -> None:
        self.some: dict[Key, Change] = {}
        self.new: dict[str, Held | None] = {}

    def changes(self) -> list[Change]:
        """What waits."""
        if not self.new:
            return list(self.some.values())
        return [*self.some.values(), *(Put(row) for row in self.new.values() if row is not None)]

    def add(self, changes: Iterable[Change]) -> None:
        """These wait, in place of older ones of the same rows."""
        for change in changes:
            table, id = key_of(change)
            if table != "held" or id not in self.new:
                self.some[table, id] = change
            elif type(change) is Put and type(change.row) is Held:
                self.new[id] = change.row
            else:
                del self.new[id]

    def written(self, changes: Iterable[Change]) -> None:
        """These have been written; what waits of the same rows is older."""
        for change in changes:
            table, id = key_of(change)
            self.some.pop((table, id), None)
            if table == "held":
                self.new.pop(id, None)

    def row_written(self, row: Row) -> None:
        """As written(), of one row."""
        if self.some:
            self.some.pop((TABLE_OF[type(row)], row.id), None)
        if self.new:
            self.new.pop(row.id, None)

    def all_written(self) -> None:
        """Nothing waits any more."""
        if self.new:  # first: what is on disk is not new, and may be written again
            self.new = {id: None for id, row in self.new.items() if row is None}
        self.some.clear()

    def forget(self) -> None:
        """What waits is never written."""
        self.some.clear()
        self.new.clear()

    def drop(self, query_id: str) -> None:
        """A held query is gone."""
        if query_id in self.new:
            del self.new[query_id]
        else:
            self.some["held", query_id] = Drop("held", query_id)


def key_of(change: Change) -> Key:
    """The table and the id of the row that a change is of."""
    if isinstance(change, Put):
        return TABLE_OF[type(change.row)], change.row.id
    return change.table, change.id
