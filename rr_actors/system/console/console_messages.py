"""The messages on a console's socket: requests, answers and the feed of events, as types.

Each message is a MessagePack map in a frame (rr_actors/wire/frames.py). A connection begins with Hello. After that each
request but Keep has one answer, in the order of the requests. After Follow only the feed comes. No message is ever a
pickle, and none has a key of the system.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from rr_actors.actors.messaging.dead_letters import DeadLetter
from rr_actors.registrar.model.messages import Failure
from rr_actors.registrar.model.recorded import Entry
from rr_actors.registrar.pages import QueryRow, ResourceRow
from rr_actors.supervision.event_history import Record
from rr_actors.system.recording.figures import Figure

VERSION = 3
SOCKET = "console.sock"
REQUEST_LIMIT_BYTES = 2**20
"""The longest request. The longest part of any is a resource's request as JSON."""
ANSWER_LIMIT_BYTES = 4 * 2**20
RESPONSE_LIMIT_BYTES = ANSWER_LIMIT_BYTES - 1024
"""The longest response of a resource: an answer has other texts, too."""
PAGE_LIMIT = 500
"""The most rows of a page."""

_Text = Annotated[str, msgspec.Meta(max_length=1000)]
_Long = Annotated[str, msgspec.Meta(max_length=900_000)]
VALUE_LIMIT_BYTES = 900_000
"""The longest request of a resource, or message to an actor, of a client."""
_Value = Annotated[bytes, msgspec.Meta(max_length=VALUE_LIMIT_BYTES)]
_Offset = Annotated[int, msgspec.Meta(ge=0, le=2**40)]
_Limit = Annotated[int, msgspec.Meta(ge=1, le=PAGE_LIMIT)]
TIMEOUT_LIMIT_S = 86_400.0
"""The longest time limit of a command: a day."""
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=TIMEOUT_LIMIT_S)]


class _Message(msgspec.Struct, frozen=True, tag_field="is", tag=str.lower, omit_defaults=True):
    """A request, an answer, or a part of the feed."""


# -- requests --------------------------------------------------------------------------------------------------------


class Hello(_Message, frozen=True):
    """The first message: the version of this protocol that the client speaks."""

    version: int


class _Page(_Message, frozen=True):
    """A page of the rows that have the text `match` in them: at most `limit`, and as many as have room in an answer."""

    match: _Text = ""
    offset: _Offset = 0
    limit: _Limit = PAGE_LIMIT


class ListChildren(_Page, frozen=True):
    """A page of the supervisor tree, each supervisor before its children: the rows with `match` in their paths."""


class ListRegistrars(_Page, frozen=True):
    """A page of the registrars, by name: the rows with `match` in their names."""


class ListResources(_Page, frozen=True):
    """A page of the resources of one registrar, or of all: the rows with `match` in id, server, request or status."""

    registrar: _Text = ""


class ListQueries(_Page, frozen=True):
    """A page of the queries that one registrar holds, or all: the rows with `match` in ids, server or request."""

    registrar: _Text = ""


class Find(_Message, frozen=True):
    """The resources and queries of an id, or of the beginning of an id, of four characters or more."""

    id: _Text
    registrar: _Text = ""


class ListHistory(_Message, frozen=True):
    """The newest records of the child at a path and of all below it; with "", of all children."""

    path: _Text = ""
    limit: _Limit = 100


class ListDeadLetters(_Message, frozen=True):
    """The newest dead letters."""

    limit: _Limit = 100


class ListFigures(_Message, frozen=True):
    """The figures of the system, as System.figures() returns them."""


def mentions(facts: dict[str, Any], text: str) -> bool:
    """Return whether one of these facts contains the text: a path, a registrar, a server, an id ..."""
    return any(text in fact for fact in facts.values() if isinstance(fact, str))


class Follow(_Message, frozen=True):
    """Have events sent: of these kinds (or of all, if none is given), with the text `about` in one of their facts."""

    events: Annotated[list[_Text], msgspec.Meta(max_length=50)] = []
    about: _Text = ""


class BeginRecording(_Message, frozen=True):
    """Have everything recorded and sent from now on: events, callbacks, and the messages between registrars."""


class Load(_Message, frozen=True):
    """Load a resource.

    Attributes:
        server: "registrar/server".
        request: the request as JSON.
        holder: the registrar that holds the resource; "": the console's own registrar.
        keep: hold the resource after the answer. Otherwise it is released at once.
        dry_run: change nothing; the answer says what would be done.
    """

    server: _Text
    request: _Long
    holder: _Text = ""
    keep: bool = False
    timeout_s: _Seconds = 30.0
    dry_run: bool = False


class Unload(_Message, frozen=True):
    """Release a query of any holder; with `force` take a resource away from all its holders.

    `id` may be the beginning of an id.
    """

    id: _Text
    force: bool = False
    timeout_s: _Seconds = 30.0
    dry_run: bool = False


class SendStatus(_Message, frozen=True):
    """Send a status of a resource in its owner's name. `id` may be the beginning of an id, or a query's id."""

    id: _Text
    state: Literal["OK", "UPDATE", "WARNING", "ERROR", "FATAL"]
    message: _Long = ""
    registrar: _Text = ""
    dry_run: bool = False


class Kill(_Message, frozen=True):
    """Send a signal to the process of a child, given by its path or, if only one has it, its id."""

    child: _Text
    signal: Annotated[int, msgspec.Meta(ge=1, le=64)] = 9
    dry_run: bool = False


class Terminate(_Message, frozen=True):
    """Stop a child, as its supervisor does; its specification stays, unless it is temporary."""

    child: _Text
    dry_run: bool = False


class Restart(_Message, frozen=True):
    """Stop a child if it runs, and start it."""

    child: _Text
    dry_run: bool = False


class StartChild(_Message, frozen=True):
    """Add a child to the supervisor at a path ("": the root), from a TOML text as Supervisor.from_toml reads it."""

    spec: _Long
    supervisor: _Text = ""
    file: _Text = "the specification"
    dry_run: bool = False


class ShutDown(_Message, frozen=True):
    """Stop the whole system, in order, as System.stop() does."""

    dry_run: bool = False


class OpenRegistrar(_Message, frozen=True):
    """Open a registrar for a client. When this connection ends, it is closed, and its queries are released.

    In the system it is called "client.NAME"; Done's facts have this name as `registrar`.
    """

    name: _Text


class Hold(_Message, frozen=True):
    """Load a resource with a client's registrar, by a request's canonical bytes.

    If the connection ends, or makes another request, after the answer and before its Keep, the query is released.
    """

    registrar: _Text
    server: _Text
    request: _Value
    timeout_s: _Seconds = 30.0


class Keep(_Message, frozen=True):
    """Keep the query of the last Holding, because the client has received it. A Keep has no answer."""


class Release(_Message, frozen=True):
    """Release a query of a client's registrar."""

    registrar: _Text
    query_id: _Text
    timeout_s: _Seconds = 30.0


class AskActor(_Message, frozen=True):
    """Ask an actor of the tree, by its path or id; the message is plain data, as canonical bytes."""

    actor: _Text
    message: _Value
    timeout_s: _Seconds = 30.0


OfClient = OpenRegistrar | Hold | Release | AskActor
Command = Load | Unload | SendStatus | Kill | Terminate | Restart | StartChild | ShutDown | OfClient
PageRequest = ListChildren | ListRegistrars | ListResources | ListQueries
Question = PageRequest | Find | ListHistory | ListDeadLetters | ListFigures
Request = Hello | Follow | BeginRecording | Keep | Question | Command


# -- answers ---------------------------------------------------------------------------------------------------------


class Welcome(_Message, frozen=True):
    """The answer to Hello: the system, its process, and when it started (seconds since the epoch)."""

    version: int
    system: str
    pid: int
    state_dir: str
    since: float


class ChildRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """A row of the tree: a supervisor or another child.

    Attributes:
        depth: 0 for the root.
        state: "running", "starting", "restarting", "stopped"; "unavailable": it does not answer, see `error`.
        pid: the id of the process that it lives in, while it runs.
        restarts: how often it was restarted, as far as its supervisor remembers.
        up_s: for how many seconds it has been ready.
        strategy: of a supervisor: its strategy and restart intensity.
        max_restarts, recent_restarts: of a supervisor: how many restarts its window allows, and how many are in it.
    """

    path: str
    depth: int
    type: str
    state: str
    pid: int | None = None
    restarts: int = 0
    up_s: float | None = None
    strategy: str = ""
    error: str = ""
    max_restarts: int = 0
    recent_restarts: int = 0


class RegistrarRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """A registrar: its status, its servers, and its counts (Registrar.stats)."""

    name: str
    status: str
    servers: list[str] = []
    counts: dict[str, int] = {}
    error: str = ""


class Children(_Message, frozen=True):
    """A page of the tree."""

    total: int
    rows: list[ChildRow]


class Registrars(_Message, frozen=True):
    """A page of the registrars."""

    total: int
    rows: list[RegistrarRow]


class Resources(_Message, frozen=True):
    """A page of resources. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[ResourceRow]
    notes: list[str] = []


class Queries(_Message, frozen=True):
    """A page of queries. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[QueryRow]
    notes: list[str] = []


class Found(_Message, frozen=True):
    """The resources and queries of an id. `notes`: registrars that could not be asked, and why."""

    resources: list[ResourceRow]
    queries: list[QueryRow]
    notes: list[str] = []


class Happenings(_Message, frozen=True):
    """Records of the tree, oldest first. `left_out`: how many older ones have no room in the answer."""

    records: list[Record]
    left_out: int = 0


class Letters(_Message, frozen=True):
    """The number of dead letters so far, and the newest of them, oldest first."""

    count: int
    letters: list[DeadLetter]


class Figures(_Message, frozen=True):
    """The figures of the system at one moment."""

    figures: list[Figure]


class Done(_Message, frozen=True):
    """The answer to a command that was carried out: a sentence that says what was done, and the same as plain data."""

    text: str
    facts: dict[str, Any] = {}


class Holding(_Message, frozen=True):
    """The answer to Hold: the query that the client's registrar holds now, and the response's canonical bytes."""

    query_id: str
    resource_id: str
    response: bytes


class Replied(_Message, frozen=True):
    """The answer to AskActor: the actor's answer, plain data, as canonical bytes."""

    answer: bytes


class Refused(_Message, frozen=True):
    """The answer to a request that failed. The system does nothing more for this request."""

    failure: Failure


class Following(_Message, frozen=True):
    """The answer to Follow: the number of the newest event. The feed begins with the next one.

    As the answer to BeginRecording it has 0, because entries have numbers of their own.
    """

    seq: int


# -- the feed --------------------------------------------------------------------------------------------------------


class Event(msgspec.Struct, frozen=True):
    """Something that happened.

    Attributes:
        seq: its number. The numbers count all events of the system that the console heard, in their order.
        at: its time, in seconds since the epoch.
        event: its kind, as in System.subscribe().
        facts: the other keys of the event, as plain data.
    """

    seq: int
    at: float
    event: str
    facts: dict[str, Any]


class Events(_Message, frozen=True):
    """Events that happened, oldest first."""

    events: list[Event]


class Entries(_Message, frozen=True):
    """Recorded entries, in the order of arrival. `dropped`: how many entries their processes had no room for."""

    entries: list[Entry]
    dropped: int = 0


class Missed(_Message, frozen=True):
    """A notice that the reader was too slow: it missed `count` events, up to number `seq`.

    `tree` is the first page of the tree as it is now; ListChildren asks for the others.
    """

    count: int
    seq: int
    tree: Children


OfQuestion = Children | Registrars | Resources | Queries | Found | Happenings | Letters | Figures
OfCommand = Done | Holding | Replied
Answer = Welcome | OfQuestion | OfCommand | Refused | Following | Events | Entries | Missed
