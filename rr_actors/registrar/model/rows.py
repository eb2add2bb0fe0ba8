"""The rows of a catalog, and the changes that are committed to it.

Rows are frozen: a change puts a new row in the place of the old one. Each class says what its table means; core/ says
which messages change it. A store writes rows without knowing their meaning (store.py).
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Annotated, Any, Literal, final

import msgspec

Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
"""A number that a catalog can hold. It is checked when it is decoded, as a peer's bytes may have any number."""


class State(enum.StrEnum):
    """The state that a status gives a resource (thesis: status codes).

    Attributes:
        OK: it can be used; also after a WARNING or an ERROR.
        UPDATE: it can be used, and its response is another one.
        WARNING: it can be used, but something is amiss.
        ERROR: it does not work now.
        FATAL: it is lost for good. The next load of its request gets a fresh one.
    """

    OK = "OK"
    UPDATE = "UPDATE"
    WARNING = "WARNING"
    ERROR = "ERROR"
    FATAL = "FATAL"


class Phase(enum.StrEnum):
    """The phase of a resource's life. A QUEUED one waits until an UNLOADING one of the same request is gone.

    A server that pauses its idle resources takes them LOADED -> PAUSING -> PAUSED -> RESUMING -> LOADED.
    """

    QUEUED = "queued"
    LOADING = "loading"
    LOADED = "loaded"
    UNLOADING = "unloading"
    UNLOAD_FAILED = "unload_failed"
    PAUSING = "pausing"
    PAUSED = "paused"
    RESUMING = "resuming"


class Hold(enum.StrEnum):
    """A consumer's view of its query: asked for, held, or released and owed to the provider."""

    PENDING = "pending"
    HELD = "held"
    OWED = "owed"


# To look up an enum's member takes 0.1 µs before Python 3.12. The code of each load and unload uses these names.
OK = State.OK
QUEUED, LOADING, LOADED, UNLOADING, UNLOAD_FAILED, PAUSING, PAUSED, RESUMING = Phase
PENDING, HELD, OWED = Hold


RESTING = (PAUSING, PAUSED, RESUMING)
"""The phases of a loaded resource that may not be running."""

LOWEST, HIGHEST = -1000, 1000
"""The priorities that a load may be given."""
STANDBY = LOWEST - 1
"""The priority of a query on standby, and of a resource that nobody holds: they have none (None, for users)."""


def priority_of(number: int) -> int | None:
    """Return a row's priority as users have it: None for STANDBY."""
    return None if number <= STANDBY else number


def shown_priority(priority: int) -> str:
    """Return the words for a priority: "priority 5", or "standby"."""
    return "standby" if priority <= STANDBY else f"priority {priority}"


NOT_BEGUN = -1
"""Resource.tries of a load that a crash has interrupted, until its server is registered and it begins again."""


class Resource(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One thing that a server of this registrar loaded for one distinct request. `request` is its canonical bytes.

    Its id is that of the query that made it; after a restart it is longer (Catalog.new_resource_id). `attempt` counts
    the runs of its load callback: it tells which parts an earlier, interrupted run has loaded. `tries` counts the runs
    of its unload callback; it is NOT_BEGUN while the present attempt of the load has not begun. While an exclusive
    resource is QUEUED, `tries` is its number in the line (core/loads/lines.py). `state` and `message` are those of its
    last status.
    """

    id: str
    server: str
    request: bytes
    response: bytes | None
    phase: Phase
    state: State
    message: str
    attempt: Int64
    tries: Int64 = 0


class ServedQuery(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One hold on a resource of this registrar, by `origin` (a registrar's name).

    `parent` is the origin's resource that depends on it ("" for none), and `attempt` that resource's attempt when it
    asked. `seq` is the origin's running number; releases go newest first by it. `priority` is the last that the origin
    has sent; `own`: the load was given one, so that the query does not inherit that of `parent`.
    """

    id: str
    resource_id: str
    origin: str
    parent: str
    attempt: Int64
    seq: Int64
    priority: Int64 = 0
    own: bool = False


class Held(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One query of this registrar at a provider, as this side knows it; its server is "`registrar`/`server`".

    The provider's Query row can rebuild it, except while it is OWED: only this side knows of the release.

    `priority` is what the provider is to have, too. While the row is PENDING, it is that of the Load. Without `own`, a
    query with a `parent` inherits that resource's priority.
    """

    id: str
    registrar: str
    server: str
    request: bytes
    response: bytes | None
    resource_id: str
    parent: str
    attempt: Int64
    seq: Int64
    hold: Hold
    state: State
    priority: Int64 = 0
    own: bool = False


class Notice(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A status on its way to `origin` about its query; dropped when the origin has dealt with it.

    `event` is the same on all ways of the status through the graph, and `source` is the server where it began.
    `released`: the provider took the query away (forced unload). `response`: a new response of the resource (late
    response). `reason`: REVOKED, or "" for an ordinary status; then the resource is unloaded by force in `grace_ms`.

    A notice without `origin` and `query_id` is for the server of the resource itself: its status callback runs first.
    It is dropped in the commit that adds the notices for the holders, or when the callback has dealt with the status.
    """

    id: str
    query_id: str
    origin: str
    resource_id: str
    event: str
    state: State
    message: str
    source: str
    released: bool = False
    response: bytes | None = None
    reason: str = ""
    grace_ms: Int64 = 0


REVOKED = "revoked"
"""Notice.reason of a resource whose holders are to release it."""


def is_revocation(notice: Notice) -> bool:
    """Return whether the notice asks its holder to let the resource go, and has not taken it away yet."""
    return notice.reason == REVOKED and not notice.released


def is_own(notice: Notice) -> bool:
    """Return whether the notice is for the server of the resource itself, and not for a holder."""
    return not notice.origin


class Peer(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A registrar that this one has asked for something: after a crash its queries are looked for there.

    `released`: queries with this running number or a smaller one are not wanted, as this registrar was closed since.
    """

    id: str
    released: Int64 = 0


class StoredServer(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A server registered through a handle of another process, with its callbacks by value (cloudpickle)."""

    id: str
    blob: bytes


class ServerType(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Request and response type of a provider's server (id "registrar/server"), cloudpickled, to decode its values.

    For a registrar's own server (types_id) it has a digest of the types that all stored values were read with.
    """

    id: str
    blob: bytes


def types_id(server: str) -> str:
    """Return the id of the ServerType of a registrar's own server."""
    return f"types:{server}"


class CallbackRun(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The deaths of processes in runs of one callback of a resource, or of all attempts of one request.

    Its id is "role:resource id". `begun`: a run has begun, and has not ended. It is on disk before the callback runs,
    except in two cases: the rows of a load and of a first unload say that themselves, by their phase. The row goes when
    a run ends. After too many deaths (callback_runs.ATTEMPTS) it stays with the resource: the callback runs no more.

    With the role "request", the id goes on with a server and a digest of a request, and `deaths` counts how often its
    load was given up.
    """

    id: str
    deaths: Int64 = 0
    begun: bool = False


class Revocation(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The resource of this id is revoked: no new request joins it, and in `grace_ms` it is unloaded by force.

    `event` and `why` are those of the status that its holders hear. The row goes with the resource, or when its unload
    fails. A crash begins the grace again.
    """

    id: str
    event: str
    why: str
    grace_ms: Int64


Row = Resource | ServedQuery | Held | Notice | Peer | StoredServer | ServerType | CallbackRun | Revocation
Table = Literal[
    "resources", "queries", "held", "notices", "peers", "stored_servers", "server_types", "callback_runs", "revocations"
]

TABLES: dict[Table, type[Row]] = {
    "resources": Resource,
    "queries": ServedQuery,
    "held": Held,
    "notices": Notice,
    "peers": Peer,
    "stored_servers": StoredServer,
    "server_types": ServerType,
    "callback_runs": CallbackRun,
    "revocations": Revocation,
}
TABLE_OF: dict[type[Row], Table] = {cls: table for table, cls in TABLES.items()}


def key_of_row(row: Row) -> tuple[Table, str]:
    """Return the table and the id of a row."""
    return TABLE_OF[type(row)], row.id


Content = dict[Table, dict[str, Any]]
"""All rows of a catalog, by table and id. It has every table."""


def content_of(rows: Iterable[Row]) -> Content:
    """Return the rows by table and id."""
    content: Content = {table: {} for table in TABLES}
    for row in rows:
        content[TABLE_OF[type(row)]][row.id] = row
    return content


def rows_of(content: Content) -> list[Row]:
    """Return all rows of the content, one table after another."""
    return [row for rows in content.values() for row in rows.values()]


@final
class Put(msgspec.Struct, frozen=True, gc=False):
    """Insert the row, or replace the one with the same id."""

    row: Row


class Drop(msgspec.Struct, frozen=True, gc=False):
    """Remove the row with this id, if it is there."""

    table: Table
    id: str


Change = Put | Drop


def apply(content: Content, changes: Iterable[Change]) -> None:
    """Make the changes in the content."""
    for change in changes:
        if isinstance(change, Put):
            content[TABLE_OF[type(change.row)]][change.row.id] = change.row
        else:
            content[change.table].pop(change.id, None)
