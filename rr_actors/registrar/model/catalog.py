"""Catalog: a registrar's rows in memory, with their indexes. Decision: changes of a catalog that can be undone.

decide() and the functions it calls read the catalog, and change it through a Decision. There is no I/O here, no clock
and no randomness: the same messages in the same order give the same catalog and the same effects.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from operator import attrgetter
from typing import Any, TypeVar

import msgspec

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model.effects import Connect, Effect, SendRequest
from rr_actors.registrar.model.messages import Loaded, Message
from rr_actors.registrar.model.rows import (
    HELD,
    HIGHEST,
    LOADED,
    LOADING,
    LOWEST,
    OWED,
    PAUSED,
    QUEUED,
    RESTING,
    STANDBY,
    TABLE_OF,
    UNLOAD_FAILED,
    UNLOADING,
    CallbackRun,
    Change,
    Content,
    Drop,
    Held,
    Hold,
    Notice,
    Peer,
    Put,
    Resource,
    Revocation,
    Row,
    ServedQuery,
    ServerType,
    State,
    StoredServer,
    Table,
    content_of,
    is_own,
)

_JOINABLE = (LOADED, LOADING, *RESTING)
_MOVING = (LOADING, QUEUED, UNLOADING)

_seq, _origin, _server, _resource_id = map(attrgetter, ("seq", "origin", "server", "resource_id"))
_registrar, _parent, _query_id = map(attrgetter, ("registrar", "parent", "query_id"))
_EPOCH_BITS = 32

RequestKey = tuple[str, bytes]

ABSENT: Any = object()
"""In an Undo, the old value of a key that was not there."""

Undo = list[tuple["Table | dict[Any, Any]", Any, Any]]
"""Changes in their order: the table or in-memory dict, the key, and the value before the change."""


class Server(msgspec.Struct, frozen=True):
    """The facts about a registered server that decisions need; its callbacks belong to the server actor."""

    name: str
    linger_s: float = 0.0
    load_timeout_s: float | None = None
    recovery: str = "keep"
    has_status: bool = False
    has_recover: bool = False
    types: bytes = b""  # the types of requests and responses, for consumers (rows.ServerType)
    types_checksum: int = 0
    recover_timeout_s: float | None = None
    pauses: bool = False
    paused_s: float | None = None
    exclusive: bool = False
    grace_ms: int = 0  # for the holder of an exclusive resource that a more urgent load takes away


class Closing(msgspec.Struct, frozen=True):
    """The releases of a resource's parts, newest first; `sent` are sent; the effects `after` follow the last."""

    ids: tuple[str, ...]
    sent: int
    after: tuple[Effect, ...]


class DueStatus(msgspec.Struct, frozen=True):
    """A status that the status callback of a resource has to hear: one about the resource, or about a part of it."""

    resource: Resource
    notice: Notice
    repeated: bool


class DeliveredNotice(msgspec.Struct, frozen=True):
    """A notice that its receivers are dealing with: its provider, how many receivers are left, whether it is repeated.

    `ends`: the query that ends when they have finished ("" for none).
    """

    provider: str
    receivers: int
    repeated: bool
    ends: str


class Catalog:
    """All that one registrar knows.

    Rows, as on disk: `resources` and `queries` that it serves, `held` queries of its own, `notices` to deliver, `peers`
    it has asked, `stored_servers`, `server_types`, `callback_runs`. Indexes follow the rows. All else is in memory
    only. A crash may lose it, because each caller that waits asks again:

    - `deaths`: how the last processes of this registrar died, one after another, in words for people.
    - `servers`: the servers registered now. `leaving`: those of them that take no new loads.
    - `up`: the providers whose link is reconciled, each with the number of the Fetch that opened the link. A message
      decided for one link is not sent over another: the first message on a new link is Fetch, and nothing follows
      before its answer. `consumers`: the origins that have fetched their queries over a link that is still open.
    - `waiting`: queries whose Load has not been answered in this incarnation. `refused`: queries whose Load was refused
      lately. `unanswered`: queries whose Unload has come over the present link and has not been answered.
    - `recovering`: resources whose recover callback runs, or that are reloaded, with the messages parked until that is
      done. `reloads`: tickets of the owner's calls that wait for a reload.
    - `early`: resources whose callbacks go on with work of before a crash when on_start has returned, and how
      (recovery.py). "" is in it until then.
    - `accused`: ids of the callback runs in which the process before has died, until they have ended without that.
    - `closings`: releases of parts in progress, by the query whose release has been sent.
    - `direct`: queries whose Load a thread has sent by its own connection, which has not answered yet; False: the query
      has ended by another way. `fresh`: queries that such a connection answered while the provider's link was down, and
      the epoch of the provider that did: a list of the same epoch over the next link may be older. `in_flight`: the
      rows of loads sent by such connections, until a decision concerns them; the threads add to it.
    - `joined`, `waited`: by server, how many loads have joined a resource that was loaded, and one that was not yet.
    - `kept`: held queries that were owed for a while, until their unload failed. A second try may still succeed.
      Statuses of that time were passed over, so for these a response that is sent again may be newer than the row's;
      for other queries it is older.
    - `unread`: resources that an earlier version stored, and that do not fit today's types, with the reason.
    - `owners`: tickets of the owner's own calls that wait for a resource to be unloaded.
    - `told`: notices sent before; a second sending is marked repeated. True: on its way, sent over the present link.
      `behind`: queries with more notices than `window`, and how many are on their way; others are sent later. `heard`:
      statuses received, by receiver (a query, or the resource that depends on it) and event, with the ids of the
      notices that wait for the receiver. `hearing`: these notices. `deferred`: by resource, the statuses that its
      server hears after its load or recover callback has returned. `next_to_hear`: by notice, the statuses of a part
      that the resource hears after the listeners of the part. `ending`: queries that were taken away and whose holders
      are still hearing of it.
    - `statuses`: by resource, how many runs of its status callback have been caused and have not ended. `late`: its
      own statuses that wait while `window` of them have not. `suspects`: ids of callback runs that wait for their turn,
      because they run one at a time. `trial`: the one whose turn it is. `refusing`: the ids of requests that are
      refused for a while, as their load was given up.
      `doubted`: queries that are lost because their provider is gone for good, whose catalog may still have them, and
      whose holders are to hear of it. Then they are in `ending`, with True.
    - `acked`: providers with acknowledgements sent, or to be sent, which a lost link may lose, or their notices.
    - `agreed`: providers that have no query from before this incarnation which is unknown here: they have listed what
      we hold there (True), or were never asked before (False). False, too, after such a provider is gone for good.
    - `touched`: resources whose priority this decision may change, with the priority before; None: nobody held them.
      `idle`: resources that idle since the timer was set that pauses or unloads them. `rising`: resources to be resumed
      when their parts are: the parts that have not said so, or None before they were asked.
      `unsent`: queries whose priority has changed while the provider's link was not reconciled.
      `listed`: by provider, the epoch of its run that made the last list. `lapsed`: by provider of another host, the
      epoch that it had in the last lease that is over.
    - `deserted`: resources that were loading when their last query ended, until the engine has looked at them.
    - `stirred`: requests for which resources are queued, until decide() has looked at the line (core/loads/lines.py).
      `said`: by queued resource, the place in line that its load was told. `timed`: queries with a timer for their
      wait there.
      `wait_limits`: by query of our own that is not answered, how many ms it may wait in line; the threads add to it.
    - `chased`: by resource, the query whose probe for rings of holds has passed it last.
    - `shut`: why this registrar loads nothing any more for others (False), or for itself (True): it is being closed.

    Args:
        name: the registrar's name.
        content: the rows on disk. From now on the catalog owns this object.
        epoch: how often the catalog has been opened. Running numbers and resource ids of different epochs differ.
    """

    window = 1000
    """How many notices of one query are on their way at most, and statuses of one resource to its own server."""
    max_priority = HIGHEST
    """The highest priority of a query that this registrar holds (RegistrarConfig.max_priority)."""

    backlog = 100_000
    """How many notices of one query, or statuses of one resource to its own server, wait here before older ones go."""

    def __init__(self, name: str, content: Content | None = None, epoch: int = 1) -> None:
        self.name = name
        self.epoch = epoch
        self.tables = content_of(()) if content is None else content
        self.resources: dict[str, Resource] = self.tables["resources"]
        self.queries: dict[str, ServedQuery] = self.tables["queries"]
        self.held: dict[str, Held] = self.tables["held"]
        self.notices: dict[str, Notice] = self.tables["notices"]
        self.peers: dict[str, Peer] = self.tables["peers"]
        self.stored_servers: dict[str, StoredServer] = self.tables["stored_servers"]
        self.server_types: dict[str, ServerType] = self.tables["server_types"]
        self.callback_runs: dict[str, CallbackRun] = self.tables["callback_runs"]
        self.revocations: dict[str, Revocation] = self.tables["revocations"]
        self.stirred: dict[RequestKey, bool] = {}
        self._fill_indexes()
        self._index: dict[Table, Callable[[Any, Any], None]] = {
            "resources": self._index_resource,
            "queries": self._index_query,
            "held": self._index_held,
            "notices": self._index_notice,
            "revocations": self._index_revocation,
        }
        # in memory only
        self.deaths = ""
        self.servers: dict[str, Server] = {}
        self.up: dict[str, int] = {}
        self.waiting: dict[str, str] = {}
        self.refused: dict[str, Failure] = {}
        self.unanswered: dict[str, bool] = {}
        self.recovering: dict[str, tuple[Any, ...]] = {}
        self.reloads: dict[str, Any] = {}
        self.early: dict[str, str] = {}
        self.accused: dict[str, bool] = {}
        self.closings: dict[str, Closing] = {}
        self.unread: dict[str, str] = {}
        self.owners: dict[str, tuple[Any, ...]] = {}
        self.chased: dict[str, str] = {}
        self.told: dict[str, bool] = dict.fromkeys(self.notices, False)
        self.behind: dict[str, int] = {}
        self.heard: dict[tuple[str, str, str], tuple[str, ...]] = {}
        self.hearing: dict[str, DeliveredNotice] = {}
        self.deferred: dict[str, tuple[DueStatus, ...]] = {}
        self.next_to_hear: dict[str, DueStatus] = {}
        self.listened: set[str] = set()  # queries and server ids with a listener, which may deal with a status
        self.ending: dict[str, bool] = {}
        self.doubted: dict[str, bool] = {}
        self.acked: dict[str, bool] = {}
        self.agreed: dict[str, bool] = {}
        self.touched: dict[str, int | None] = {}
        self.unsent: dict[str, bool] = {}
        self.listed: dict[str, int] = {}
        self.lapsed: dict[str, int] = {}
        self.idle: dict[str, bool] = {}
        self.rising: dict[str, tuple[str, ...] | None] = {}
        self.shut: dict[bool, Failure] = {}
        self.direct: dict[str, bool] = {}
        self.kept: dict[str, bool] = {}
        self.fresh: dict[str, int] = {}
        self.in_flight: dict[str, Held] = {}
        self.joined: dict[str, int] = {}
        self.waited: dict[str, int] = {}
        self.leaving: dict[str, Any] = {}
        self.statuses: dict[str, int] = {}
        self.late: dict[str, dict[str, DueStatus]] = {}
        self.suspects: dict[str, bool] = {}
        self.trial: dict[str, bool] = {}
        self.refusing: dict[str, bool] = {}
        self.consumers: dict[str, bool] = {}
        self.deserted: set[str] = set()
        self.said: dict[str, str] = {}
        self.timed: dict[str, bool] = {}
        self.wait_limits: dict[str, int] = {}
        self.unfinished: Undo | None = None  # how to undo the decision that is being applied; None between decisions
        # this Catalog asked for all queries with a greater number, and knows all about them
        self.since = max(epoch << _EPOCH_BITS, max(map(_seq, self.held.values()), default=0))

    def _fill_indexes(self) -> None:
        """Build the indexes that set() keeps for each row; one index at a time, as there may be a million rows."""
        self.by_request: defaultdict[str, dict[bytes, str]] = defaultdict(dict)  # server -> request -> resource to join
        self.unloading: dict[RequestKey, Ids] = {}  # also those that are revoked: the next of that request waits
        self.queued: dict[RequestKey, Ids] = {}
        self.lost: dict[RequestKey, Ids] = {}  # FATAL, or unload_failed: no other load joins these
        self.resting: dict[str, bool] = {}  # resources that are pausing, paused, or resuming
        self.moving: dict[str, bool] = {}  # resources that are loading, queued, or being unloaded
        loaded, fatal, by_request = LOADED, State.FATAL, self.by_request
        for row in self.resources.values():
            if row.phase is not loaded or row.state is fatal:
                self._index_phase(None, row)
            else:
                by_request[row.server][row.request] = row.id
        for revocation in self.revocations.values():
            self._index_revocation(None, revocation)
        self.by_server = built(map(_server, self.resources.values()), self.resources)
        self.holders = built(map(_resource_id, self.queries.values()), self.queries)  # resource -> queries
        self.by_origin = built(map(_origin, self.queries.values()), self.queries)  # origin -> queries
        ranked = {id: row for id, row in self.queries.items() if row.priority}
        self.ranked = built(map(_resource_id, ranked.values()), ranked)  # resource -> queries not of priority 0
        self.outbound = built(map(_registrar, self.held.values()), self.held)  # provider -> held
        parts = {id: row for id, row in self.held.items() if row.parent and row.hold is not OWED}
        self.parts = built(map(_parent, parts.values()), parts)  # resource -> held, without owed ones
        # held that is pending or owed -> provider; in the order of the calls that made it so
        self.unsettled = {id: row.registrar for id, row in self.held.items() if row.hold is not HELD}
        own = {id: row for id, row in self.notices.items() if is_own(row)}
        sent = {id: row for id, row in self.notices.items() if id not in own} if own else self.notices
        self.own_notices = built(map(_resource_id, own.values()), own)  # resource -> those its own server hears first
        self.notices_to = built(map(_origin, sent.values()), sent)  # origin -> notices
        self.notices_on = built(map(_query_id, sent.values()), sent)  # query -> notices

    def roll_back(self) -> list[tuple[Table, str]]:
        """Undo the decision that was interrupted, and return the rows that it had begun to change.

        An interrupt may stop this method, too. The next call then begins again.
        """
        rows: list[tuple[Table, str]] = []
        for where, key, old in reversed(self.unfinished or ()):
            if isinstance(where, str):
                rows.append((where, key))
            entries: dict[Any, Any] = self.tables[where] if isinstance(where, str) else where
            if old is ABSENT:
                entries.pop(key, None)
            else:
                entries[key] = old
        self._fill_indexes()
        return rows

    def new_resource_id(self, query_id: str) -> str:
        """Return a new id for the resource that a query makes: the query's own, or one made from that.

        A query makes a second resource when its refusal was lost and its Load is sent again. The parts that the first
        one had loaded must not be taken for the second's, not even after a crash in between. Therefore the id has the
        epoch in it.
        """
        id = free = query_id if self.epoch <= 1 else f"{query_id}.{self.epoch}"
        number = 1
        while free in self.resources:
            number += 1
            free = f"{id}+{number}"
        return free

    def joinable(self, server: str, request: bytes) -> str | None:
        """Return the id of the one resource that an identical request joins; None if there is none."""
        requests = self.by_request.get(server)
        id = None if requests is None else requests.get(request)
        if id is None and self.queued:
            queued = self.queued.get((server, request), ())
            id = next((id for id in queued if self.resources[id].state is not State.FATAL), None)
        return id

    def used(self, key: RequestKey) -> list[Resource]:
        """Return the resources of a request that are there, and not only QUEUED."""
        found = self.by_request.get(key[0], {}).get(key[1])
        apart = (*self.unloading.get(key, ()), *self.lost.get(key, ()))
        ids = dict.fromkeys(apart if found is None else (found, *apart))
        return [self.resources[id] for id in ids]

    def stir(self, resource: Resource) -> None:
        """Note that the line for this resource, if there is one, has to be looked at (core/loads/lines.py)."""
        key = (resource.server, resource.request)
        if key in self.queued:
            self.stirred[key] = True

    def find(self, target: str) -> Resource | None:
        """Return the resource with this id, or the resource of the query with this id."""
        resource = self.resources.get(target)
        if resource is None and (query := self.queries.get(target)) is not None:
            resource = self.resources[query.resource_id]
        return resource

    def queries_of(self, resource_id: str) -> list[ServedQuery]:
        """Return the queries on a resource."""
        return [self.queries[id] for id in self.holders.get(resource_id, ())]

    def priority_of(self, resource_id: str) -> int:
        """Return the priority of a resource: the highest of its queries; STANDBY if nobody holds it."""
        if resource_id in self.ranked:
            return max(self.queries[id].priority for id in self.holders[resource_id])
        return 0 if resource_id in self.holders else STANDBY

    def inherited(self, resource_id: str) -> int:
        """Return the priority that the parts of a resource inherit.

        A resource that is FATAL is lost, and needs them no more. A resource that its server pauses needs its parts
        until it is paused, and before it is resumed. One that could not be unloaded is not paused any more: its server
        may go and come back, and that changes nothing.
        """
        lost = self.resources.get(resource_id)
        if lost is not None and lost.state is State.FATAL:
            return STANDBY
        priority = min(self.priority_of(resource_id), self.max_priority)
        row = self.resources.get(resource_id) if priority <= STANDBY else None
        if row is not None and row.phase not in (PAUSED, UNLOAD_FAILED):
            server = self.servers.get(row.server)
            return LOWEST if server is not None and server.pauses else priority
        return priority

    def holder_of(self, resource_id: str) -> str:
        """Return the registrar whose query on a resource is the oldest; "" if nobody holds it."""
        for query_id in self.holders.get(resource_id, ()):
            return self.queries[query_id].origin
        return ""

    def needs(self, provider: str) -> bool:
        """Return whether a link is needed: the provider may have queries of ours, or is to get an acknowledgement."""
        unknown = provider in self.peers and (self.epoch > 1 or provider not in self.agreed)
        return unknown or provider in self.outbound or provider in self.acked

    def waits_for(self, provider: str) -> bool:
        """Return whether a load that the event loop has sent, or will send, waits for the provider."""
        unsettled = self.unsettled_at(provider)
        return any(held.hold is Hold.PENDING and held.id not in self.direct for held in unsettled)

    def last_number(self) -> int:
        """Return a running number that no query of this incarnation exceeds, and every one of the next does."""
        return max(self.since, after_epoch(self.epoch))

    def set(self, table: Table, id: str, new: Any, undo: Undo | None = None) -> None:
        """Put a row into memory, or remove it (None); note the old one in `undo` first."""
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
        """Return the queries that are pending or owed at a provider."""
        return [self.held[id] for id, where in self.unsettled.items() if where == provider]

    def newest_first(self, held_ids: Iterable[str]) -> list[str]:
        """Return the ids of held queries in the order in which they are released."""
        return sorted(held_ids, key=lambda id: self.held[id].seq, reverse=True)

    def parts_of(self, resource_id: str) -> list[str]:
        """Return the ids of the queries that a resource holds, newest first."""
        return self.newest_first(self.parts.get(resource_id, ()))

    def origin_of(self, resource: Resource) -> str:
        """Return the id of the server of a resource, "registrar/server"."""
        return f"{self.name}/{resource.server}"

    # -- indexes ------------------------------------------------------------------------------------------------

    def _index_resource(self, old: Resource | None, new: Resource | None) -> None:
        self._index_phase(old, new)
        if self.queued and (row := new or old) is not None:
            self.stir(row)
        if old is None and new is not None:
            add(self.by_server, new.server, new.id)
        elif new is None and old is not None:
            discard(self.by_server, old.server, old.id)

    def _index_phase(self, old: Resource | None, new: Resource | None) -> None:
        if old is not None and old.phase in _MOVING:
            del self.moving[old.id]
            if new is not None and old.phase is LOADING and new.phase is LOADED and new.state is old.state:
                return  # the common change: requests find the resource as before
        if old is not None:
            key = (old.server, old.request)
            if self.by_request[old.server].get(old.request) == old.id:
                del self.by_request[old.server][old.request]
            if not self.by_request[old.server]:
                del self.by_request[old.server]
            if old.phase in RESTING:
                self.resting.pop(old.id, None)
            if old.phase is UNLOADING:
                discard(self.unloading, key, old.id)
            elif old.phase is QUEUED:
                discard(self.queued, key, old.id)
            if _is_lost(old):
                discard(self.lost, key, old.id)
        if new is not None:
            key = (new.server, new.request)
            if new.phase in _MOVING:
                self.moving[new.id] = True
            if new.phase in RESTING:
                self.resting[new.id] = True
            if new.phase in _JOINABLE and new.state is not State.FATAL:
                self.by_request[new.server][new.request] = new.id
            elif new.phase is UNLOADING:
                add(self.unloading, key, new.id)
            if new.phase is QUEUED:
                add(self.queued, key, new.id)
            elif _is_lost(new):
                add(self.lost, key, new.id)

    def _index_revocation(self, old: Revocation | None, new: Revocation | None) -> None:
        row = new or old
        if row is not None and (resource := self.resources.get(row.id)) is not None:
            (discard if new is None else add)(self.unloading, (resource.server, resource.request), resource.id)
            self.stir(resource)

    def _index_query(self, old: ServedQuery | None, new: ServedQuery | None) -> None:
        if old is not None:
            discard(self.holders, old.resource_id, old.id)
            discard(self.by_origin, old.origin, old.id)
            if new is None and old.resource_id not in self.holders:
                resource = self.resources.get(old.resource_id)
                if resource is not None and resource.phase is LOADING:
                    self.deserted.add(resource.id)
            if old.priority:
                discard(self.ranked, old.resource_id, old.id)
        if new is not None:
            add(self.holders, new.resource_id, new.id)
            add(self.by_origin, new.origin, new.id)
            if new.priority:
                add(self.ranked, new.resource_id, new.id)
        if self.queued:
            for query in filter(None, (old, new)):
                if (resource := self.resources.get(query.resource_id)) is not None:
                    self.stir(resource)

    def _index_held(self, old: Held | None, new: Held | None) -> None:
        if new is not None and new.hold is not HELD:
            if old is not None and old.hold is not new.hold:  # a load was withdrawn: that is the newest call
                self.unsettled.pop(new.id, None)
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
        if old is not None and not old.origin:  # is_own(), without a call
            discard(self.own_notices, old.resource_id, old.id)
        elif old is not None:
            discard(self.notices_to, old.origin, old.id)
            discard(self.notices_on, old.query_id, old.id)
        if new is not None and not new.origin:
            add(self.own_notices, new.resource_id, new.id)
        elif new is not None:
            add(self.notices_to, new.origin, new.id)
            add(self.notices_on, new.query_id, new.id)


def loaded(catalog: Catalog, query_id: str, resource: Resource) -> Loaded:
    """Return the answer to a Load whose resource is loaded."""
    server = catalog.servers.get(resource.server)
    types = 0 if server is None else server.types_checksum
    return Loaded(query_id, resource.id, resource.response or b"", types, resource.state)


def after_epoch(epoch: int) -> int:
    """Return a number that is greater than the running numbers of this epoch, and not greater than those of the next.

    A running number has its epoch in its upper bits.
    """
    return (epoch + 1) << _EPOCH_BITS


def _is_lost(resource: Resource) -> bool:
    return (resource.state is State.FATAL and resource.phase is not QUEUED) or resource.phase is UNLOAD_FAILED


def _stands_there(old: Held, new: Held) -> bool:
    """Return whether both rows have the same index keys, which is the common case."""
    if new.registrar != old.registrar or new.parent != old.parent:
        return False
    return not new.parent or (new.hold is OWED) is (old.hold is OWED)


# -- indexes -----------------------------------------------------------------------------------------------------------
#
# Ids by a key. Most keys have one id, and there may be a million of them. One id is kept as a tuple: 48 bytes instead
# of a dict's 232, and the garbage collector does not look at it again. A key that has had several ids keeps its dict
# until it has none.

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
    """Remove the id from the key, and the key with its last id."""
    ids = index.get(key)
    if ids is None or id not in ids:
        return
    if len(ids) == 1:
        del index[key]
    elif type(ids) is dict:
        del ids[id]


def built(keys: Iterable[K], ids: Collection[str]) -> dict[K, Ids]:
    """Return the index that add() would make of these pairs. Ids in a dict are not hashed again."""
    if not ids:
        return {}
    keys = list(keys)
    if len(ids) > 1 and keys[0] == keys[-1] and keys.count(keys[0]) == len(keys):
        return {keys[0]: dict.fromkeys(ids)}
    if len(set(keys[:_SOME])) == len(keys[:_SOME]):  # perhaps each id has a key of its own
        index: dict[K, Ids] = dict(zip(keys, zip(ids, strict=True), strict=True))
        if len(index) == len(ids):
            return index
    groups: defaultdict[K, list[str]] = defaultdict(list)
    for key, id in zip(keys, ids, strict=True):
        groups[key].append(id)
    return {key: dict.fromkeys(group) if len(group) > 1 else (group[0],) for key, group in groups.items()}


# -- changes that can be undone ----------------------------------------------------------------------------------------
#
# A Decision applies each change to memory at once, because its next message must see the change. Before each change it
# notes how to undo it. The registrar commits the decision while it still has the lock, and undoes it if that fails.
#
# An interrupt (Ctrl-C) may come between any two instructions. The notes then stay in `Catalog.unfinished`, and the next
# thread that has the lock rolls the decision back (Catalog.roll_back).


class Decision:
    """The changes and effects of some messages and commands. close() or undo() ends it.

    `changes` must be on disk before any effect is carried out. `later` has, by table and id, changes of rows that can
    be rebuilt from another registrar: they are written behind `changes`, or a moment later.
    """

    __slots__ = ("_undo", "catalog", "changes", "effects", "later")

    def __init__(self, catalog: Catalog) -> None:
        self.catalog = catalog
        self.changes: list[Change] = []
        self.later: dict[tuple[Table, str], Change] = {}
        self.effects: list[Effect] = []
        self._undo: Undo = []
        catalog.unfinished = self._undo

    def put(self, row: Row) -> None:
        """Insert or replace a row; it is on disk before the effects."""
        table, id = TABLE_OF[type(row)], row.id
        self.catalog.set(table, id, row, self._undo)
        self.changes.append(Put(row))
        if self.later:
            self.later.pop((table, id), None)  # that change is older

    def drop(self, row: Row) -> None:
        """Remove a row; that is on disk before the effects."""
        table = TABLE_OF[type(row)]
        self.catalog.set(table, row.id, None, self._undo)
        self.changes.append(Drop(table, row.id))
        if self.later:
            self.later.pop((table, row.id), None)

    def put_later(self, row: Row) -> None:
        """Insert or replace a row that could be rebuilt; it may be written a moment later."""
        table = TABLE_OF[type(row)]
        self.catalog.set(table, row.id, row, self._undo)
        self.later[table, row.id] = Put(row)

    def drop_later(self, row: Row) -> None:
        """Remove a row that the next incarnation would find to be gone; that may be written a moment later."""
        table = TABLE_OF[type(row)]
        self.catalog.set(table, row.id, None, self._undo)
        self.later[table, row.id] = Drop(table, row.id)

    def put_here(self, row: Row) -> None:
        """Insert or replace a row in memory only: it is on disk already, or the next incarnation has no use for it."""
        self.catalog.set(TABLE_OF[type(row)], row.id, row, self._undo)

    def note(self, memory: dict[Any, Any], key: Any, value: Any) -> None:
        """Set an entry of one of the catalog's in-memory dicts."""
        self._undo.append((memory, key, memory.get(key, ABSENT)))
        memory[key] = value

    def forget(self, memory: dict[Any, Any], key: Any) -> Any:
        """Remove an entry of one of the catalog's in-memory dicts, and return it, or None."""
        if key not in memory:
            return None
        self._undo.append((memory, key, memory[key]))
        return memory.pop(key)

    def cause(self, effect: Effect) -> None:
        """Have the effect carried out once the changes are on disk."""
        self.effects.append(effect)

    def request(self, registrar: str, message: Message) -> None:
        """Send a message to a provider if its link is up; else have one made, which sends all open messages again."""
        self.cause(SendRequest(registrar, message) if registrar in self.catalog.up else Connect(registrar))

    def close(self) -> None:
        """Keep the changes: they are on disk, or wait to be written."""
        self.catalog.unfinished = None

    def undo(self) -> None:
        """Undo every change, so that the catalog is as it was before the decision.

        The decision must have been applied completely. Catalog.roll_back() undoes one that was interrupted.
        """
        for where, key, old in reversed(self._undo):
            if isinstance(where, str):
                self.catalog.set(where, key, None if old is ABSENT else old)
            elif old is ABSENT:
                where.pop(key, None)
            else:
                where[key] = old
        self.catalog.stirred.clear()  # as before each decision
        self.catalog.unfinished = None
        self._undo = []
        self.changes.clear()
        self.later.clear()
        self.effects.clear()


# -- changes that are written a moment later ---------------------------------------------------------------------------

Key = tuple[Table, str]


class Unsaved:
    """The last change of each row that waits to be written.

    A held row that was never written may also be written as owed a moment later: after a crash before that, this
    registrar does not know of the query, and its provider says whether it is held. So a query that is loaded and
    released within that time leaves nothing on disk. "Never written" says more than "waits to be written": a row that
    waits may replace an older one on disk.

    Attributes:
        some: the changes that wait, by table and id, except those of `new`.
        new: by id, the held or owed queries that no commit has written.
    """

    __slots__ = ("new", "some")

    def __init__(self) -> None:
        self.some: dict[Key, Change] = {}
        self.new: dict[str, Held] = {}

    def changes(self) -> list[Change]:
        """Return the changes that wait to be written."""
        return [*self.some.values(), *map(Put, self.new.values())]

    def add(self, changes: Iterable[Change]) -> None:
        """Have these changes wait, in place of older ones of the same rows."""
        for change in changes:
            table, id = key_of(change)
            if table != "held" or id not in self.new:
                self.some[table, id] = change
            elif type(change) is Put and type(change.row) is Held:
                self.new[id] = change.row
            else:
                del self.new[id]

    def row_written(self, row: Row) -> None:
        """Forget the changes of one row, which is on disk now."""
        if self.some:
            self.some.pop((TABLE_OF[type(row)], row.id), None)
        if self.new:
            self.new.pop(row.id, None)

    def clear(self) -> None:
        """Forget all waiting changes: they are on disk, or are never to be written."""
        self.new.clear()  # first: if an interrupt comes in between, `some` is only written once more
        self.some.clear()

    def doubt(self) -> None:
        """Note that the rows of `new` may be on disk, as a commit may have been interrupted behind its write."""
        self.some.update({("held", id): Put(row) for id, row in self.new.items()})
        self.new.clear()

    def drop(self, query_id: str) -> None:
        """Note that a held query is gone, so that its row is removed from the disk, if it is there."""
        if query_id in self.new:
            del self.new[query_id]
        else:
            self.some["held", query_id] = Drop("held", query_id)


def key_of(change: Change) -> Key:
    """Return the table and the id of the row that a change concerns."""
    if isinstance(change, Put):
        return TABLE_OF[type(change.row)], change.row.id
    return change.table, change.id
