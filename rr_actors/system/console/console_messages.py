"""What is said on a console's socket: requests, answers and the feed of events, as typed messages.

Each is a MessagePack map in a frame (rr_actors/wire/frames.py). A connection begins with Hello; after that each
request has one answer, in their order. After Follow only the feed comes. Nothing here is ever a pickle, and no message
has a key of the system.
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

VERSION = 2
SOCKET = "console.sock"
REQUEST_LIMIT_BYTES = 2**20
"""The longest request; a resource's request as JSON is the longest part of any."""
ANSWER_LIMIT_BYTES = 4 * 2**20
PAGE_LIMIT = 500
"""The most rows of a page."""

_Text = Annotated[str, msgspec.Meta(max_length=1000)]
_Long = Annotated[str, msgspec.Meta(max_length=900_000)]
_Offset = Annotated[int, msgspec.Meta(ge=0, le=2**40)]
_Limit = Annotated[int, msgspec.Meta(ge=1, le=PAGE_LIMIT)]
TIMEOUT_LIMIT_S = 86_400.0
"""The longest time limit of a command: a day."""
_Seconds = Annotated[float, msgspec.Meta(ge=0, le=TIMEOUT_LIMIT_S)]


class _Message(msgspec.Struct, frozen=True, tag_field="is", tag=str.lower, omit_defaults=True):
    """A request, an answer, or a part of the feed."""


# -- requests --------------------------------------------------------------------------------------------------------


class Hello(_Message, frozen=True):
    """The first message: which version of this protocol the client speaks."""

    version: int


class _Page(_Message, frozen=True):
    """A page of what there is with the text `match` in it."""

    match: _Text = ""
    offset: _Offset = 0
    limit: _Limit = PAGE_LIMIT


class ListChildren(_Page, frozen=True):
    """A page of the supervisor tree, each supervisor before its children: those with `match` in their paths."""


class ListRegistrars(_Page, frozen=True):
    """A page of the registrars, by name: those with `match` in their names."""


class ListResources(_Page, frozen=True):
    """A page of the resources of one registrar, or of all: those with `match` in id, server, request or status."""

    registrar: _Text = ""


class ListQueries(_Page, frozen=True):
    """A page of the queries that one registrar holds, or all: those with `match` in their ids, server or request."""

    registrar: _Text = ""


class Find(_Message, frozen=True):
    """The resources and queries of an id, or of the beginning of one: four characters or more."""

    id: _Text
    registrar: _Text = ""


class ListHistory(_Message, frozen=True):
    """The newest records of what happened to the child at a path and to all below it; of all children with ""."""

    path: _Text = ""
    limit: _Limit = 100


class ListDeadLetters(_Message, frozen=True):
    """The newest dead letters."""

    limit: _Limit = 100


class ListFigures(_Message, frozen=True):
    """What the system is measured by, as System.figures() returns it."""


def mentions(facts: dict[str, Any], text: str) -> bool:
    """Return whether one of these facts has the text in it: a path, a registrar, a server, an id ..."""
    return any(text in fact for fact in facts.values() if isinstance(fact, str))


class Follow(_Message, frozen=True):
    """Have the events of these kinds sent (of all with none), of whose facts one has the text `about` in it."""

    events: Annotated[list[_Text], msgspec.Meta(max_length=50)] = []
    about: _Text = ""


class BeginRecording(_Message, frozen=True):
    """Have everything recorded and sent from now on: events, callbacks, and the messages between registrars."""


class Load(_Message, frozen=True):
    """Load a resource.

    Attributes:
        server: "registrar/server".
        request: JSON.
        holder: the registrar that holds it; "" for the system's own one of the console.
        keep: hold it when this is answered. Otherwise it is released at once.
        dry_run: change nothing, and say what would be done.
    """

    server: _Text
    request: _Long
    holder: _Text = ""
    keep: bool = False
    timeout_s: _Seconds = 30.0
    dry_run: bool = False


class Unload(_Message, frozen=True):
    """Release a query of any holder; with `force` take a resource away from all its holders.

    `id` may be the beginning of one.
    """

    id: _Text
    force: bool = False
    timeout_s: _Seconds = 30.0
    dry_run: bool = False


class SendStatus(_Message, frozen=True):
    """Say how a resource is, in its owner's name. `id` may be the beginning of one, or a query's."""

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
    """Open a registrar for a client; it is closed, and all that it holds released, when this connection ends.

    In the system it is called "client.NAME"; Done's facts have that as `registrar`.
    """

    name: _Text


class Hold(_Message, frozen=True):
    """Load a resource with a client's registrar, by a request's canonical bytes."""

    registrar: _Text
    server: _Text
    request: Annotated[bytes, msgspec.Meta(max_length=900_000)]
    timeout_s: _Seconds = 30.0


class Release(_Message, frozen=True):
    """Release a query of a client's registrar."""

    registrar: _Text
    query_id: _Text
    timeout_s: _Seconds = 30.0


class AskActor(_Message, frozen=True):
    """Ask an actor of the tree, by its path or id; the message is plain data, as canonical bytes."""

    actor: _Text
    message: Annotated[bytes, msgspec.Meta(max_length=900_000)]
    timeout_s: _Seconds = 30.0


OfClient = Hold | Release | AskActor
Command = Load | Unload | SendStatus | Kill | Terminate | Restart | StartChild | ShutDown | OpenRegistrar | OfClient
PageRequest = ListChildren | ListRegistrars | ListResources | ListQueries
Question = PageRequest | Find | ListHistory | ListDeadLetters | ListFigures
Request = Hello | Follow | BeginRecording | Question | Command


# -- answers ---------------------------------------------------------------------------------------------------------


class Welcome(_Message, frozen=True):
    """The answer to Hello: the system, its process, and when it started (seconds since the epoch)."""

    version: int
    system: str
    pid: int
    state_dir: str
    since: float


class ChildRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """A place in the tree.

    Attributes:
        depth: 0 for the root.
        state: "running", "starting", "restarting", "stopped"; "unavailable": it does not answer, see `error`.
        pid: of the process that it lives in, while it runs.
        restarts: how often it was restarted, as far as its supervisor remembers.
        up_s: for how many seconds it has been ready.
        strategy: a supervisor's, with its restart intensity.
        max_restarts, recent_restarts: a supervisor's: how many restarts its window allows, and how many are in it.
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
    """A registrar: whether it is there, the servers that it has, and its counts (Registrar.stats)."""

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
    """What has the id. `notes`: registrars that could not be asked, and why."""

    resources: list[ResourceRow]
    queries: list[QueryRow]
    notes: list[str] = []


class Happenings(_Message, frozen=True):
    """Records of the tree, oldest first."""

    records: list[Record]


class Letters(_Message, frozen=True):
    """How many dead letters there were, and the newest of them, oldest first."""

    count: int
    letters: list[DeadLetter]


class Figures(_Message, frozen=True):
    """The figures of a moment."""

    figures: list[Figure]


class Done(_Message, frozen=True):
    """A command was carried out: a sentence that says what was done, and the same as plain data."""

    text: str
    facts: dict[str, Any] = {}


class Holding(_Message, frozen=True):
    """A client's registrar holds this query; `response` has the response's canonical bytes."""

    query_id: str
    resource_id: str
    response: bytes


class Replied(_Message, frozen=True):
    """What an actor has answered: plain data, as canonical bytes."""

    answer: bytes


class Refused(_Message, frozen=True):
    """The request failed; after this nothing of it is left to be done."""

    failure: Failure


class Following(_Message, frozen=True):
    """The answer to Follow: the number of the newest event. The feed begins with the one after that.

    To BeginRecording it is 0: entries have numbers of their own.
    """

    seq: int


# -- the feed --------------------------------------------------------------------------------------------------------


class Event(msgspec.Struct, frozen=True):
    """Something that happened.

    Attributes:
        seq: its number; they count all events of the system that the console heard, in their order.
        at: when, seconds since the epoch.
        event: what, as System.subscribe() calls it.
        facts: whose and how, plain data.
    """

    seq: int
    at: float
    event: str
    facts: dict[str, Any]


class Events(_Message, frozen=True):
    """Events that happened, oldest first."""

    events: list[Event]


class Entries(_Message, frozen=True):
    """What was recorded, in the order of arrival. `dropped`: for how many entries their processes had no room."""

    entries: list[Entry]
    dropped: int = 0


class Missed(_Message, frozen=True):
    """The reader was too slow: it has missed so many events, up to number `seq`. This is how the tree is now."""

    count: int
    seq: int
    tree: Children


Answer = (
    Welcome
    | Children
    | Registrars
    | Resources
    | Queries
    | Found
    | Happenings
    | Letters
    | Figures
    | Done
    | Holding
    | Replied
    | Refused
    | Following
    | Events
    | Entries
    | Missed
)
