"""The messages between registrars. Requests are imperative, facts are in the past tense.

Every message is a frozen msgspec Struct, encoded as a MessagePack array behind its tag. Decoding checks the types, so a
peer's bytes can make no other objects. Request and response bytes inside are canonical MessagePack
(base/values/canonical.py).

Consumer to provider: Load, Unload, Fetch, Describe, NoticesHandled, Probe, Gone, Reprioritise. Provider to consumer:
Loaded, LoadRefused, Unloaded, UnloadRefused, Fetched, Described, Noticed, Progressed, Reprioritised, WaitedFor. The
sender of a request sends it again, with the same id, until it is answered. So every message may arrive twice
(docs/consistency.md says what the second one does). A Fetch with `resume` opens a link, and comes once on each.
"""

from __future__ import annotations

import msgspec

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model.rows import Int64, Notice, State

NO_LIMIT = -1
"""Load.wait_ms of a load that gives no limit of its own."""


class Load(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=1):
    """Give `origin` a query with this id on the resource for this request; load that if it is not loaded.

    `wait_ms`: how long it may wait in line for an exclusive resource; NO_LIMIT: as long as its caller waits.
    """

    query_id: str
    server: str
    request: bytes
    origin: str
    parent: str
    attempt: Int64
    seq: Int64
    priority: Int64 = 0
    own: bool = False
    wait_ms: Int64 = NO_LIMIT


class Loaded(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=2):
    """The query is held, and is on disk in the provider's catalog.

    `types`: the checksum (CRC-32) of the types in Described with which the response is to be read. `state`: that of
    the resource's last status.
    """

    query_id: str
    resource_id: str
    response: bytes
    types: int = 0
    state: State = State.OK


class LoadRefused(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """The query does not exist, and has left nothing."""

    query_id: str
    failure: Failure


class Unload(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=4):
    """Release the query. A query that does not exist counts as released."""

    query_id: str
    origin: str


class Unloaded(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=5):
    """The query is gone. If it was the last, the unload callback has run and the resource's parts are released."""

    query_id: str


class UnloadRefused(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """The unload callback raised: the query is still held, and its resource is unload_failed."""

    query_id: str
    failure: Failure


class Fetch(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """List all queries that `origin` holds here; with `resume`, then send the notices it has not dealt with.

    `number` comes back in the answer, because the answer to a dead incarnation may reach the next one. `spans`: the
    digests of the queries that `origin` knows (registrar/model/digests.py). Then the answer lists only the queries that
    differ.
    """

    origin: str
    resume: bool = False
    number: int = 0
    spans: list[tuple[int, bytes]] = []


class FetchedQuery(msgspec.Struct, frozen=True, array_like=True):
    """One query in Fetched. `response` is None while its resource is loading, or being unloaded.

    `waits`: the resource is being recovered, or is still to be resumed for this query: a load is answered after that.
    """

    query_id: str
    server: str
    resource_id: str
    request: bytes
    response: bytes | None
    parent: str
    attempt: Int64
    seq: Int64
    state: str
    priority: Int64 = 0
    own: bool = False
    waits: bool = False


class Fetched(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """The queries that the receiver holds at the sender at that moment; with `more`, other parts of the list follow.

    `same`: the ranges of running numbers in which nothing differs from Fetch, and which are not listed. `notices`: some
    follow, perhaps of queries that the receiver does not know.
    """

    queries: list[FetchedQuery]
    more: bool = False
    number: int = 0
    same: list[tuple[int, int]] = []
    notices: bool = False


class Describe(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """Send the types of this server's requests and responses."""

    server: str


class Described(msgspec.Struct, frozen=True, array_like=True, tag=10):
    """The server's types by cloudpickle. A receiver unpickles them only if its peer has the same key."""

    server: str
    blob: bytes


class Noticed(msgspec.Struct, frozen=True, array_like=True, tag=11):
    """A status for a query. `repeated`: it may have been heard before the provider crashed."""

    notice: Notice
    repeated: bool = False


class NoticesHandled(msgspec.Struct, frozen=True, array_like=True, tag=12):
    """The notices with these ids have been dealt with; where that matters, it is on disk."""

    ids: list[str]


class Probe(msgspec.Struct, frozen=True, array_like=True, tag=13):
    """Edge chasing (Chandy, Misra, Haas 1983): does the resource of `query_id` wait, directly or not, for `waiter`?

    `waiter` is a resource that is being loaded, and `blocked` the query on which it waits. `ring` holds the
    "registrar/server" names passed so far. A probe that comes to the waiter has found a ring. On its way it goes on for
    the newest query that it passes (core/loads/load_rings.py).

    `holds`: does it hold `waiter`, directly or not? That one is loaded, and holds `blocked` as a part.
    """

    query_id: str
    waiter: str
    blocked: str
    ring: list[str]
    holds: bool = False


class Gone(msgspec.Struct, frozen=True, array_like=True, tag=14):
    """The registrar `origin` does not come back: release every query that it holds here."""

    origin: str


class Progressed(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=15):
    """The progress of a load for which these queries of the receiver wait. May be lost.

    `in_line`: it waits for an exclusive resource, and `text` is its place. `holder`: the registrar that has that, "" if
    none does; `since`: when that one asked for it, in seconds since 1970.
    """

    query_ids: list[str]
    resource_id: str
    server: str
    fraction: float
    text: str
    in_line: bool = False
    holder: str = ""
    since: float | None = None


class Reprioritise(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=16):
    """The query has this priority now."""

    query_id: str
    origin: str
    priority: Int64


class Reprioritised(msgspec.Struct, frozen=True, array_like=True, gc=False, tag=17):
    """The query's row has this priority, on disk. If that is not what the holder wants, it sends that again."""

    query_id: str
    priority: Int64


class WaitedFor(msgspec.Struct, frozen=True, array_like=True, tag=18):
    """Does the whole of this query, which the receiver holds, wait for `waiter`? As Probe, for an exclusive resource.

    Others wait for that until the whole releases it.
    """

    query_id: str
    waiter: str
    blocked: str
    ring: list[str]


class Leased(msgspec.Struct, frozen=True, array_like=True, tag=19):
    """The other hosts that have a lease: release what registrars of all other hosts hold here. From the gateway alone.

    The answer is Released with the same number, when that is on disk.
    """

    hosts: list[str]
    number: Int64


class Released(msgspec.Struct, frozen=True, array_like=True, tag=20):
    """What registrars of hosts without a lease held is released, on disk."""

    number: Int64


def retired(name: str) -> str:
    """Return the origin of a link on which the registrar `name` is said to be gone; no registrar's name has a colon."""
    return f"{name}:retired"


Message = (
    Load
    | Loaded
    | LoadRefused
    | Unload
    | Unloaded
    | UnloadRefused
    | Fetch
    | Fetched
    | Describe
    | Described
    | Noticed
    | NoticesHandled
    | Probe
    | Gone
    | Progressed
    | Reprioritise
    | Reprioritised
    | WaitedFor
    | Leased
    | Released
)
