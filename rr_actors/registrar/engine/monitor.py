"""A registrar is a monitor: decide, apply to memory, commit, release the lock, act.

The thread that brings a message decides it under the registrar's lock. The changes are on disk before any effect of
them leaves the process. If the commit fails, nothing has happened.

The loop decides messages as it reads them, all messages of one read as one decision. The thread that ran a callback
decides its end, unless it has another callback to run. The loop carries out the effects, in the order of the
decisions. One effect is an exception: the answer to a direct line is sent by the thread that decided it.

A message waits only for these: the rest of its read; the effects that the loop is carrying out; a commit that failed
and is tried again a moment later; the loop's next turn, if many messages share a commit (durability "power", or
`save_on_modify=False`).
"""

from __future__ import annotations

import abc
import asyncio
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, NotSerializable
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import failure_of
from rr_actors.hosting.process_node import ProcessNode
from rr_actors.registrar.core.decide import Item, refuse_uncommitted
from rr_actors.registrar.engine.progress import ProgressListeners, ProgressReports
from rr_actors.registrar.engine.registrar_state import DirectPaths, may_be_interrupted, runs_handlers
from rr_actors.registrar.links.recorder import Recorder
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.effects import AnswerCall, Effect
from rr_actors.registrar.model.messages import Gone, Load, Loaded, LoadRefused, Message, Noticed
from rr_actors.registrar.model.rows import Change, Held, Notice
from rr_actors.registrar.model.store import Store
from rr_actors.runtime.thread_rules import any_thread, on_loop, with_lock
from rr_actors.streams.publishers import Publishers
from rr_actors.wire.transport import Exchange, Hello

logger = Log("rr_actors.registrar")

_AT_ONCE = 128  # messages in one decision at most: callers get the first answers before the last ones are decided
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


class Reader(Protocol):
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

    def forget(self, query_id: str) -> None:
        """Drop the listeners of a query that its holder has released: no callback for it begins from now on."""
        ...


class Opening(NamedTuple):
    """What a registrar is made of.

    Attributes:
        node: the process's.
        peers: the registrars of this process, by name.
        recorder: records messages and callbacks while somebody records.
    """

    node: ProcessNode
    name: str
    config: RegistrarConfig
    store: Store
    peers: Mapping[str, RegistrarBase]
    recorder: Recorder


class RegistrarBase(DirectPaths, abc.ABC):
    """What the parts of a registrar see of it. RegistrarActor has the parts, and does what they ask of each other.

    Attributes:
        monitor, progress, publishers: three parts that the others use.
        path: the path of the manager that serves it; without one, that of its process.
        serving: whether on_start has returned, and consumers are let in.
        on_happened: called on the loop after each event of a resource; None: nobody asks.
        listeners: those that hear how far a load has come.
    """

    monitor: RegistrarMonitor
    progress: ProgressReports
    publishers: Publishers

    def __init__(self, opening: Opening) -> None:
        self.node, name, config, store, self.peers, self.recorder = opening
        self.workers = self.node.dispatcher.workers
        super().__init__(name, config, store, self.node.dispatcher.loop, self.workers)
        self.commits.watched = self.node.watched
        self.path = self.node.path
        self.serving = False
        self.audience: Audience | None = None
        self.on_happened: Callable[[], object] | None = None
        self.callback_failures = 0
        self.listeners = ProgressListeners()

    @on_loop
    def post(self, command: c.Command, *, more: bool = False) -> None:
        """Have the monitor decide a command. `more`: others follow, to be decided together with it."""
        if not self.closed:
            self.monitor.put(command, more=more or self.node.dispatcher.more)

    def commit_rows(self, changes: list[Change]) -> None:
        """Write rows that need no decision, such as stored servers, as RegistrarMonitor.run() does."""
        self.monitor.run(c.SetRows(changes))

    def gathers(self) -> bool:
        """Return whether many messages share a commit."""
        return not self.commits.row_by_row

    @abc.abstractmethod
    def expel(self, origin: str) -> None:
        """Close the links of a consumer that does not come back, and ignore their messages."""

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
    def fail(self, error: Exception) -> None:
        """Close the registrar after a defect."""


@on_loop
class RegistrarMonitor:
    """Decides the messages and commands of one registrar's actor in their order."""

    def __init__(self, registrar: RegistrarBase, runner: Runner, reader: Reader) -> None:
        self._registrar = registrar
        self._dispatcher = registrar.node.dispatcher
        self._runner = runner
        self._reader = reader
        self._effects: deque[list[Effect]] = deque()  # those of each decision, to be carried out on the loop
        self._waiting = registrar.waiting
        self._gathers = registrar.gathers()  # many messages share a commit
        self._busy = False  # the loop is deciding or acting: a new message waits until it has finished
        self._scheduled = False  # a turn of the loop is scheduled
        self._held_up = False  # a commit failed and is tried again later; nothing is decided before that
        self._failure = ""  # the reason, as it was logged
        self._changed = asyncio.Event()
        self._held_back: list[tuple[Message, str]] = []

    # -- messages and commands ---------------------------------------------------------------------------------------

    def receive(self, message: Message, sender: str, *, more: bool = False) -> None:
        """Decide a message of another registrar. `more`: others follow, to be decided together with it."""
        if self._registrar.closed:
            return
        if not self._registrar.serving and type(message) is Noticed:
            self._held_back.append((message, sender))  # until on_start has returned
            return
        if type(message) is Load and self._reader.read_first(message, sender):
            return
        if type(message) is Gone:
            self._registrar.expel(message.origin)
        self.put(message, sender, more=more)

    def hear_held_back(self) -> None:
        """Decide the statuses that arrived before the registrar was ready."""
        held_back, self._held_back = self._held_back, []
        for message, sender in held_back:
            self.receive(message, sender)

    def put(self, what: Message | c.Command, sender: str | None = None, *, more: bool = False) -> None:
        """Decide a message or command behind those that wait, and act; with `more`, in the loop's next turn."""
        later = more or self._gathers or self._registrar.is_inside()
        if not (later or self._waiting or self._busy or self._held_up):
            self._busy = True
            try:
                self._decide(((what, sender),))
                self._do_effects()
            finally:
                self._busy = False
            if self._waiting:
                self.decide_waiting()
            return
        self._waiting.append((what, sender))
        if self._busy or self._held_up:
            return
        if not later:
            self.decide_waiting()
        elif not self._scheduled:
            self._scheduled = True
            self._dispatcher.loop.call_soon(self._turn)

    @any_thread
    def decide_here(self, command: c.Command) -> bool:
        """Decide a command in the calling thread. Return False if the loop has to decide it.

        If exactly one direct line waits, the calling thread sends the answer. The loop carries out all other effects,
        in order.
        """
        if self._registrar.closed or self._gathers or may_be_interrupted():  # in a fork nobody releases the lock
            return False
        with self._registrar.lock:
            effects = self._committed_here(command)
            if effects is None:
                return False
            answer = self._runner.by_thread(effects)
            if answer is None:
                self._effects.append(effects)
        if answer is None:
            self._dispatcher.hand_over(self.act)
        else:
            answer()
        return True

    @any_thread
    def answer_here(self, command: Callable[[object], c.Command], done: Callable[[], object]) -> AnswerCall | None:
        """Decide a command of the calling thread, and return its answer; None if the loop has to decide it.

        The loop carries out all other effects, in order. A Ctrl-C behind the commit would lose them, so the main thread
        decides nothing here.

        Args:
            command: makes the command, without a ticket; called with the lock, so ids have the order of decisions.
            done: called on the loop when it has carried the effects out, if there is an answer.
        """
        if self._registrar.closed or self._gathers or runs_handlers():
            return None
        with self._registrar.lock:
            effects = self._committed_here(command(None))
            if effects is None:
                return None
            answer = next(effect for effect in effects if type(effect) is AnswerCall and effect.ticket is None)
            effects.remove(answer)
            self._effects.append(effects)
        self._dispatcher.hand_over(self._act_and_say, done)
        return answer

    def _act_and_say(self, done: Callable[[], object]) -> None:
        self.act()
        done()

    @with_lock
    def _committed_here(self, command: c.Command) -> list[Effect] | None:
        """Decide a command in the calling thread, and return the effects; None if the loop has to decide it."""
        if self._registrar.closed or self._waiting:
            return None
        try:
            return self._registrar.commit(((command, None),)).effects
        except Exception:  # a full disk, or a defect: the loop will meet it again, and report it
            return None

    def run(self, command: c.Command) -> None:
        """Decide a command now, before all that waits, and act; raise CatalogError if it cannot be committed."""
        with self._registrar.lock:
            self._effects.append(self._registrar.commit(((command, None),)).effects)
        if self._registrar.is_inside():
            self._dispatcher.call(self.act)
        else:
            self.act()

    async def next_change(self, timeout_s: float) -> None:
        """Wait until something has been decided, or for `timeout_s` seconds."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    def close(self) -> None:
        """Drop all that waits to be decided, and all effects that wait to be carried out."""
        self._waiting.clear()
        self._effects.clear()
        self._runner.close()

    # -- deciding ----------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        self._scheduled = False
        self.decide_waiting()

    def decide_waiting(self) -> None:
        """Decide the messages and commands that wait for others, to be decided together with them."""
        if self._busy:
            return
        self._busy = True
        try:
            while self._waiting and not self._held_up:
                with (
                    self._registrar.lock
                ):  # no thread may decide anything between taking the messages and deciding them
                    count = min(len(self._waiting), _AT_ONCE)
                    self._decide([self._waiting.popleft() for _ in range(count)])
                self._do_effects()
                if count == _AT_ONCE and self._waiting:
                    self._scheduled = True
                    self._dispatcher.loop.call_soon(self._turn)
                    return
        finally:
            self._busy = False

    def _decide(self, items: Sequence[Item]) -> None:
        registrar, failure = self._registrar, ""
        try:
            with registrar.lock:  # held until items that were not committed wait again: no thread overtakes them
                try:
                    decision = registrar.commit(
                        [item if type(item[0]) is not Load else self._reader.read(*item) for item in items]
                    )
                    if decision.effects:
                        self._effects.append(decision.effects)
                except CatalogError as error:
                    failure = str(error)
                    self._not_committed(items, error)
            if failure and failure != self._failure:
                logger.error("%s: not committed, nothing was done: %s", self._registrar.name, failure)
            self._failure = failure if self._held_up else ""
        except Exception as error:
            self._registrar.fail(error)

    def _not_committed(self, items: Sequence[Item], error: CatalogError) -> None:
        """Refuse the items that can be refused, and put the others back, to be decided again a little later."""
        refusals, again = refuse_uncommitted(self._registrar.whole(), items, failure_of(error))
        refusals.close()  # this decision has effects only
        self._effects.append(refusals.effects)
        if again:
            self._waiting.extendleft(reversed(again))
            self._held_up = True
            self._dispatcher.loop.call_later(_RETRY_S, self._try_again)

    def _try_again(self) -> None:
        self._held_up = False
        self._turn()

    # -- acting ------------------------------------------------------------------------------------------------------

    def act(self) -> None:
        """Carry out the effects of all decisions in their order, then decide the messages that arrived meanwhile."""
        if self._busy:  # the loop carries them out after the present ones
            return
        self._busy = True
        try:
            self._do_effects()
        finally:
            self._busy = False
        self.decide_waiting()

    def _do_effects(self) -> None:
        try:
            while self._effects:
                self._runner.do(self._effects.popleft())
        except Exception as error:
            self._registrar.fail(error)
        self._changed.set()
