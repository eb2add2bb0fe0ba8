"""The messages on a console's socket: rows, answers, the feed of events, and what begins a connection.

Each message is a MessagePack map in a frame (rr_actors/wire/frames.py). A connection begins with Hello. After that each
request but Keep has one answer, in the order of the requests. After Follow only the feed comes. No message is ever a
pickle, and none has a key of the system. The requests are in console_questions.py and console_commands.py.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from rr_actors.actors.actor_tables import TableColumn
from rr_actors.actors.messaging.dead_letters import DeadLetter
from rr_actors.actors.messaging.mailbox_looks import MailboxInfo
from rr_actors.base.names import named
from rr_actors.base.reporting.tracebacks import ProcessStacks
from rr_actors.base.values.failure import Failure
from rr_actors.hosting.forwarded_logs import LogLine
from rr_actors.registrar.model.recorded import Entry
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.pages import LoadRow, QueryRow, ResourceRow, ServerRow
from rr_actors.streams.stream import StreamRow
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.figures import Figure
from rr_actors.wire.name_service import HostInfo

VERSION = 8
SOCKET = "console.sock"
REQUEST_LIMIT_BYTES = 2**20
"""The longest request. The longest part of any is a resource's request as JSON."""
ANSWER_LIMIT_BYTES = 4 * 2**20
RESPONSE_LIMIT_BYTES = ANSWER_LIMIT_BYTES - 1024
"""The longest response of a resource: an answer has other texts, too."""
PAGE_LIMIT = 500
"""The most rows of a page."""
SERVERS_LIMIT = 1000
"""The most servers of an answer."""

Text = Annotated[str, msgspec.Meta(max_length=1000)]
Long = Annotated[str, msgspec.Meta(max_length=900_000)]
VALUE_LIMIT_BYTES = 900_000
"""The longest request of a resource, or message to an actor, of a connected program."""
Value = Annotated[bytes, msgspec.Meta(max_length=VALUE_LIMIT_BYTES)]
Offset = Annotated[int, msgspec.Meta(ge=0, le=2**40)]
Limit = Annotated[int, msgspec.Meta(ge=1, le=PAGE_LIMIT)]
TIMEOUT_LIMIT_S = 86_400.0
"""The longest time limit of a command: a day."""
Priority = Annotated[int, msgspec.Meta(ge=-1000, le=1000)] | None
"""As load() takes it; None: on standby."""
Seconds = Annotated[float, msgspec.Meta(ge=0, le=TIMEOUT_LIMIT_S)]


class Message(msgspec.Struct, frozen=True, tag_field="is", tag=str.lower, omit_defaults=True):
    """A request, an answer, or a part of the feed."""


# -- requests --------------------------------------------------------------------------------------------------------


class Hello(Message, frozen=True):
    """The first message: the version of this protocol that the sender speaks.

    `program`: what all sockets of one rr.Connection have in common; "" if this is its only one.
    """

    version: int
    program: Text = ""


def mentions(facts: dict[str, Any], text: str) -> bool:
    """Return whether one of these facts contains the text: a path, a registrar, a server, an id ..."""
    return any(text in fact for fact in facts.values() if isinstance(fact, str))


class Follow(Message, frozen=True):
    """Have events sent: of these kinds (or of all, if none is given), with the text `about` in one of their facts."""

    events: Annotated[list[Text], msgspec.Meta(max_length=50)] = []
    about: Text = ""


class BeginRecording(Message, frozen=True):
    """Have everything recorded and sent from now on: events, callbacks, and the messages between registrars.

    `decisions`: what the registrars decide, too.
    """

    decisions: bool = False


class Keep(Message, frozen=True):
    """Keep the query of the last Holding, because the program has received it. A Keep has no answer."""


# -- answers ---------------------------------------------------------------------------------------------------------


class Welcome(Message, frozen=True):
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
        excused_restarts: of a supervisor: how many more are in it as soon as callbacks that ran then end well.
        note: what an operator should know of a manager: that its configuration file is wrong, for instance.
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
    excused_restarts: int = 0
    note: str = ""

    @property
    def id(self) -> str:
        """The last part of the path."""
        return self.path.rpartition("/")[2]


class RegistrarRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """A registrar: its status, its servers, and its counts (Registrar.stats)."""

    name: str
    status: str
    servers: list[str] = []
    counts: dict[str, int] = {}
    error: str = ""


class Children(Message, frozen=True):
    """A page of the tree."""

    total: int
    rows: list[ChildRow]


class Registrars(Message, frozen=True):
    """A page of the registrars."""

    total: int
    rows: list[RegistrarRow]


class Resources(Message, frozen=True):
    """A page of resources. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[ResourceRow]
    notes: list[str] = []


class QueryPage(Message, frozen=True):
    """A page of queries. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[QueryRow]
    notes: list[str] = []


class Servers(Message, frozen=True):
    """The servers with their counts: the first 1,000. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[ServerRow]
    notes: list[str] = []


class HostRows(Message, frozen=True):
    """The other hosts. `host`: the system's own name among them."""

    host: str
    rows: list[HostInfo]


class Response(Message, frozen=True):
    """The whole response of a resource, as JSON; "" if there is no such resource, or its load has not returned."""

    text: str


class Loads(Message, frozen=True):
    """A page of the queries whose loads wait, oldest first for each holder, and how often loads of each server waited.

    `notes`: registrars that could not be asked, and why.
    """

    total: int
    rows: list[QueryRow]
    servers: list[LoadRow]
    notes: list[str] = []


class UsageRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """What a resource uses now: the numbers of its usage callback, if its server has one, or why they are not known.

    `request` is JSON, cut if it is long.
    """

    id: str
    server: str
    request: str
    usage: dict[str, float] = {}
    failure: str = ""
    title: str = ""

    @property
    def name(self) -> str:
        """Its server and its request or title, shortened for people."""
        return named(self.server, self.title or self.request)


class Usages(Message, frozen=True):
    """A page of resources with their usage. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[UsageRow]
    notes: list[str] = []


class Streams(Message, frozen=True):
    """A page of open streams. `notes`: registrars that could not be asked, and why."""

    total: int
    rows: list[StreamRow]
    notes: list[str] = []


class Found(Message, frozen=True):
    """The resources and queries of an id. `notes`: registrars that could not be asked, and why."""

    resources: list[ResourceRow]
    queries: list[QueryRow]
    notes: list[str] = []


class Happenings(Message, frozen=True):
    """Events that the system remembers, oldest first. `left_out`: how many older ones have no room in the answer."""

    events: list[Event]
    left_out: int = 0


class ChildLog(Message, frozen=True):
    """The last log lines of a child, oldest first, also of processes that it had before.

    Attributes:
        path: the child's.
        total: how many lines are kept that the question is about; the newest of them are here.
        note: why a child has no lines of its own: it has no process of its own; "" for another.
    """

    path: str
    total: int
    lines: list[LogLine]
    note: str = ""


class ChildStacks(Message, frozen=True):
    """Where the threads are of the process in which a child runs."""

    path: str
    stacks: ProcessStacks


class MailboxSeen(Message, frozen=True):
    """The mailbox of an actor."""

    mailbox: MailboxInfo


class Letters(Message, frozen=True):
    """The number of dead letters so far, and the newest of them, oldest first."""

    count: int
    letters: list[DeadLetter]


class Figures(Message, frozen=True):
    """The figures of the system at one moment."""

    figures: list[Figure]


class ServerFound(Message, frozen=True):
    """The answer to FindServer: the id of the server, "registrar/server"."""

    id: str


class AllStreams(Message, frozen=True):
    """The answer to HasAllStreams."""

    are_open: bool


class Done(Message, frozen=True):
    """The answer to a command that was carried out: a sentence that says what was done, and the same as plain data."""

    text: str
    facts: dict[str, Any] = {}


class Holding(Message, frozen=True):
    """The answer to Hold: the query that the program's registrar holds now, and the response's canonical bytes.

    server: the id of the server if that is of another host, say behind a route; "": it is the one that was asked for.
    """

    query_id: str
    resource_id: str
    response: bytes
    state: State = State.OK
    server: str = ""


class Heard(msgspec.Struct, frozen=True, omit_defaults=True, tag=True):
    """A status of a query, as its on_status callback gets it, and what else is new of the query.

    Its fields up to `deadline_s` are those of Status, by the same names.

    Attributes:
        response: the canonical bytes of the newest response, if the status is an UPDATE.
        released: whether the provider has taken the resource away.
    """

    query_id: str
    resource_id: str
    state: str
    message: str = ""
    source: str = ""
    repeated: bool = False
    reason: str = ""
    deadline_s: float | None = None
    response: bytes | None = None
    released: bool = False


class Dropped(msgspec.Struct, frozen=True, tag=True):
    """A query is not held any more: its registrar has released it, by whatever call. No status comes for it."""

    query_id: str


class Statuses(Message, frozen=True):
    """The answer to AwaitStatuses: what has happened to the queries since the last one, oldest first."""

    statuses: list[Heard | Dropped]


class Replied(Message, frozen=True):
    """The answer to AskActor and CallActor: the actor's answer, plain data, as canonical bytes."""

    answer: bytes


class MethodRow(msgspec.Struct, frozen=True):
    """A method of an actor that may be called from outside: its name, also with its parameters, and its docstring."""

    name: str
    signature: str
    help: str


class Methods(Message, frozen=True):
    """The answer to ListMethods."""

    rows: list[MethodRow]


class Refused(Message, frozen=True):
    """The answer to a request that failed. The system does nothing more for this request."""

    failure: Failure


class Following(Message, frozen=True):
    """The answer to Follow: the number of the newest event. The feed begins with the next one.

    As the answer to BeginRecording it has 0, because entries have numbers of their own.
    """

    seq: int


# -- the feed --------------------------------------------------------------------------------------------------------


class Events(Message, frozen=True):
    """Events that happened, oldest first."""

    events: list[Event]


class Entries(Message, frozen=True):
    """Recorded entries, in the order of arrival. `dropped`: how many entries their processes had no room for."""

    entries: list[Entry]
    dropped: int = 0


class Missed(Message, frozen=True):
    """A notice that the reader was too slow: it missed `count` events, up to number `seq`.

    `tree` is the first page of the tree as it is now; ListChildren asks for the others.
    """

    count: int
    seq: int
    tree: Children


class ShownTable(msgspec.Struct, frozen=True):
    """A table that the actor at a path declares."""

    actor: str
    name: str
    columns: tuple[TableColumn, ...]


class TableRow(msgspec.Struct, frozen=True):
    """A row of the table of this number in the answer: its fields, plain data, as canonical bytes."""

    table: int
    facts: bytes


class TablePage(Message, frozen=True):
    """The answer to ListTables. `notes`: which actors could not be asked, and why."""

    total: int
    tables: list[ShownTable] = []
    rows: list[TableRow] = []
    notes: list[str] = []
