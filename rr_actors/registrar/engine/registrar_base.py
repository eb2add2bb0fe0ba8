"""RegistrarBase: how a registrar, an actor, handles messages: decide, apply to memory, commit, end the turn, act.

The thread that has the turn decides. The changes are on disk before any effect of them leaves the process. If the
commit fails, nothing has happened.

The loop decides messages as it reads them, all messages of one read in one turn. The thread that ran a callback takes
the turn and decides its end, unless it has another callback to run. The loop carries out the effects, in the order of
the decisions. One effect is an exception: the answer to a direct line is sent by the thread that decided it.

A message waits in the mailbox only for these: the rest of its read; the effects that the loop is carrying out; a commit
that failed and is tried again a moment later; the loop's next turn, if many messages share a commit (durability
"power", or `save_on_modify=False`).
"""

from __future__ import annotations

import abc
import asyncio
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from rr_actors.actors.turns import Delivery, may_be_interrupted, runs_handlers
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, NotSerializable, UsageError, shortened
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import failure_of
from rr_actors.hosting.process_node import ProcessNode
from rr_actors.hosting.run_files import DECISIONS
from rr_actors.registrar.core.decide import Item, refuse_uncommitted
from rr_actors.registrar.engine.progress import ProgressListeners, ProgressReports
from rr_actors.registrar.engine.registrar_state import RegistrarState
from rr_actors.registrar.engine.status import StatusMessage
from rr_actors.registrar.links.recorder import Recorder
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.effects import AnswerCall, Effect
from rr_actors.registrar.model.messages import Gone, Leased, Load, Loaded, LoadRefused, Message, Noticed
from rr_actors.registrar.model.rows import Change, Held, Notice, Resource
from rr_actors.registrar.model.store import Store
from rr_actors.registrar.servers.part_times import PartTimes
from rr_actors.runtime.thread_rules import on_loop, with_lock
from rr_actors.runtime.workers import Gate
from rr_actors.streams.publishers import Publishers
from rr_actors.wire.transport import Exchange, Hello

logger = Log("rr_actors.registrar")

_RETRY_S = 0.25


class Runner(Protocol):
    """Carries out the effects of decisions."""

    def do(self, effects: Sequence[Effect]) -> None:
        """Carry out the effects in their order."""
        ...

    def by_thread(self, effects: Sequence[Effect]) -> Callable[[], None] | None:
        """Return a function that any thread may call to carry out the effects; None if the loop has to."""
        ...

    def close(self) -> None:
        """Carry out nothing more."""
        ...

    def let_in(self, key: str) -> None:
        """Let the time limit of a callback begin that has waited for room."""
        ...


class LoadReader(Protocol):
    """Reads the requests in the Loads of consumers."""

    def read_first(self, load: Load, sender: str) -> bool:
        """Have a worker read the request first if that runs user code, and return whether it does."""
        ...

    def read(self, load: Load, sender: str | None) -> Item:
        """Return the Load in canonical form, or its refusal. With the lock."""
        ...


class Audience(Protocol):
    """The listeners to the queries that a registrar holds."""

    @property
    def holder(self) -> object:
        """The Registrar that users call."""
        ...

    def hear(self, held: Held, notice: Notice, heard: Callable[[bool], None], *, repeated: bool) -> None:
        """Run the callbacks that listen to a query, for a status of it. They are the last, if it says "released".

        Then call `heard` on the loop, with whether one of them has dealt with the status.
        """
        ...

    def hears(self, query_id: str) -> bool:
        """Return whether callbacks for a query may begin now: it is not released, nor is the registrar closed."""
        ...

    def received(self, notice: Notice, *, repeated: bool) -> StatusMessage:
        """Return the status that a notice carries, for a callback of this registrar."""
        ...

    def forget(self, query_id: str) -> None:
        """Drop the listeners of a query that its holder has released: no callback for it begins from now on."""
        ...


class Opening(NamedTuple):
    """What a registrar is made of.

    Attributes:
        node: the process's.
        peers: the registrars of this process, by name.
        recorder: records messages and callbacks while somebody records.
        path: the path of the manager that serves it; without one, that of its process.
    """

    node: ProcessNode
    name: str
    config: RegistrarConfig
    store: Store
    peers: Mapping[str, RegistrarBase]
    recorder: Recorder
    path: str


class RegistrarBase(RegistrarState, abc.ABC):
    """What the parts of a registrar see of it. RegistrarActor has the parts, and does what they ask of each other.

    Attributes:
        progress, publishers, part_times: parts that the others use.
        runner: carries out the effects; `reader`: reads the requests.
        path: the path of the manager that serves it; without one, that of its process.
        serving: whether on_start has returned, and consumers are let in.
        on_happened: called on the loop after each event of a resource; None: nobody asks.
        listeners: those that hear how far a load has come.
        titles: of the servers whose requests have titles, what returns them.
        gate: lets one callback of a serial manager in at a time; None: they run side by side.
        outside: the timers' keys of callbacks that wait for room in a gate: their time limits have not begun.
    """

    progress: ProgressReports
    publishers: Publishers
    part_times: PartTimes
    runner: Runner
    reader: LoadReader

    def __init__(self, opening: Opening) -> None:
        self.node, name, config, store, self.peers, self.recorder, self.path = opening
        self.workers = self.node.dispatcher.workers
        loop, watched = self.node.dispatcher.loop, self.node.watched
        super().__init__(name, config, store, loop, self.workers, watched, self.recorder.decision)
        self.commits.watched = self.node.watched
        self.gathers = not self.commits.row_by_row
        self.serving = False
        self.audience: Audience | None = None
        self.on_happened: Callable[[], object] | None = None
        self.callback_failures = 0
        self.gate: Gate | None = None
        self.titles: dict[str, Callable[[bytes], str]] = {}
        self.outside: set[str] = set()
        self.listeners = ProgressListeners()
        self._effects: deque[list[Effect]] = deque()  # those of each decision, to be carried out on the loop
        self._failure = ""  # why the last commit failed
        self._was_logged = False  # whether the log has this reason
        self._defect: Exception | None = None  # of a turn, which ends this registrar
        self._changed = asyncio.Event()
        self._held_back: list[tuple[Message, str]] = []

    def title_of(self, resource: Resource) -> str:
        """Return the title of a resource's request, for people; "" if it has none. From any thread."""
        title = self.titles.get(resource.server)
        return "" if title is None else title(resource.request)

    # -- messages and commands ---------------------------------------------------------------------------------------

    @on_loop
    def receive(self, message: Message, sender: str, *, more: bool = False) -> None:
        """Take a message of another registrar. `more`: others follow, to be decided together with it."""
        if self.closed:
            return
        if not self.serving and type(message) is Noticed:
            self._held_back.append((message, sender))  # until on_start has returned
            return
        if type(message) is Load and self.reader.read_first(message, sender):
            return
        if type(message) is Gone:
            self.expel(message.origin)
        elif type(message) is Leased:
            self.fence(message.hosts)
        self.deliver(message, sender, more=more)

    @on_loop
    def hear_held_back(self) -> None:
        """Take the statuses that arrived before the registrar was ready."""
        held_back, self._held_back = self._held_back, []
        for message, sender in held_back:
            self.receive(message, sender)

    @on_loop
    def post(self, command: c.Command, *, more: bool = False) -> None:
        """Take a command. `more`: others follow, to be decided together with it."""
        if not self.closed:
            self.deliver(command, more=more or self.node.dispatcher.more)

    def commit_rows(self, changes: list[Change]) -> None:
        """Write rows that need no decision, such as stored servers, as run() does."""
        self.run(c.SetRows(changes))

    # -- the sender takes the turn -----------------------------------------------------------------------------------

    def decide_here(self, command: c.Command) -> bool:
        """Take the turn and decide a command in the calling thread. Return False if the loop has to decide it.

        If exactly one direct line waits, the calling thread sends the answer. The loop carries out all other effects,
        in order.
        """
        if self.closed or self.gathers or may_be_interrupted():  # in a fork nobody releases the lock
            return False
        with self.lock:
            effects = self._committed_here(command)
            if effects is None:
                return False
            answer = self.runner.by_thread(effects)
            if answer is None:
                self._effects.append(effects)
        if answer is None:
            self.node.dispatcher.hand_over(self.act)
        else:
            answer()
        return True

    def answer_here(self, command: Callable[[object], c.Command], done: Callable[[], object]) -> AnswerCall | None:
        """Take the turn and decide a command of the calling thread; return its answer, or None: the loop has to decide.

        The loop carries out all other effects, in order. A Ctrl-C behind the commit would lose them, so the main thread
        decides nothing here.

        Args:
            command: makes the command, without a ticket; called with the lock, so ids have the order of decisions.
            done: called on the loop when it has carried the effects out, if there is an answer.
        """
        if self.closed or self.gathers or runs_handlers():
            return None
        with self.lock:
            effects = self._committed_here(command(None))
            if effects is None:
                return None
            answer = next(effect for effect in effects if type(effect) is AnswerCall and effect.ticket is None)
            effects.remove(answer)
            self._effects.append(effects)
        self.node.dispatcher.hand_over(self._act_and_say, done)
        return answer

    def _act_and_say(self, done: Callable[[], object]) -> None:
        self.act()
        done()

    @with_lock
    def _committed_here(self, command: c.Command) -> list[Effect] | None:
        """Decide a command in the calling thread, and return the effects; None if the loop has to decide it."""
        if self.closed or self.waiting:
            return None
        try:
            return self.commit(((command, None),)).effects
        except Exception:  # a full disk, or a defect: the loop will meet it again, and report it
            return None

    def run(self, command: c.Command) -> None:
        """Decide a command now, before all that waits, and act; raise CatalogError if it cannot be committed."""
        with self.lock:
            self._effects.append(self.commit(((command, None),)).effects)
        if self.is_inside():
            self.node.dispatcher.call(self.act)
        else:
            self.act()

    async def next_change(self, timeout_s: float) -> None:
        """Wait until something has been decided, or for `timeout_s` seconds."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    @on_loop
    def drop_all(self) -> None:
        """Drop all that waits to be decided, and all effects that wait to be carried out."""
        self.waiting.clear()
        self._effects.clear()
        self.runner.close()

    # -- the handler: decide and commit; then act --------------------------------------------------------------------

    @with_lock
    def handle(self, deliveries: Sequence[Delivery]) -> None:
        """Decide messages and commands in their order, as one decision, and commit it."""
        failure = ""
        try:
            read = self.reader.read
            items: list[Item] = [item if type(item[0]) is not Load else read(*item) for item in deliveries]
            try:
                decision = self.commit(items)
                if decision.effects:
                    self._effects.append(decision.effects)
            except CatalogError as error:
                failure = str(error)
                self._not_committed(items, error)
            self._was_logged = bool(failure) and failure == self._failure
            self._failure = failure
        except Exception as error:
            self._defect = error

    def _not_committed(self, items: Sequence[Item], error: CatalogError) -> None:
        """Refuse the items that can be refused, and put the others back, to be decided again a little later."""
        noted = self.watched.level[0] >= DECISIONS
        if noted:
            self.notes.begin(self.whole(), items, self.watched.level[0])
        failure = failure_of(error)
        refusals, again = refuse_uncommitted(self.whole(), items, failure)
        refusals.close()  # this decision has effects only
        if noted:
            self.notes.refused(refusals, again, failure)
        self._effects.append(refusals.effects)
        if again:
            self.hold_up(again, _RETRY_S)

    @on_loop
    def follow(self) -> None:
        """Carry out the effects of all decisions in their order."""
        if self._failure and not self._was_logged:
            logger.error("%s: not committed, nothing was done: %s", self.name, self._failure)
        self._failure = "" if self.takes else self._failure
        try:
            if self._defect is not None:
                raise self._defect
            while self._effects:
                self.runner.do(self._effects.popleft())
        except Exception as error:
            self.fail(error)
        self._changed.set()

    def on_receive(self, message: Any) -> Any:
        """Refuse what a user sends by tell or ask.

        Raises:
            UsageError: always.
        """
        text = f"{self.actor_ref}: registrar {self.name!r} takes messages of registrars alone (load, unload)"
        raise UsageError(f"{text}, not {shortened(repr(message))}")

    # -- what its parts ask of each other ----------------------------------------------------------------------------

    @abc.abstractmethod
    def expel(self, origin: str) -> None:
        """Close the links of a consumer that does not come back, and ignore their messages."""

    @abc.abstractmethod
    def fence(self, hosts: Collection[str]) -> None:
        """Close the links of consumers of all hosts but these, and ignore their messages."""

    @abc.abstractmethod
    def refusal(self, loaded: Loaded, error: NotSerializable) -> LoadRefused:
        """Return the refusal that replaces an answer that is too long for a frame. On the loop."""

    @abc.abstractmethod
    def described(self, server: str, types: bytes) -> None:
        """Keep the types of a provider's server. On the loop."""

    @abc.abstractmethod
    def line(self, hello: Hello) -> Exchange:
        """Return a line for a thread of another registrar of this process."""

    @abc.abstractmethod
    def answer_at_once(self, message: Message, hello: Hello) -> Message | None:
        """Answer a registrar of this process without waiting. None: the message was not taken. From any thread."""

    @abc.abstractmethod
    def fail(self, error: Exception) -> None:
        """Close the registrar after a defect."""
