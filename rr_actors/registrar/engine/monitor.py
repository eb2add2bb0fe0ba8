"""A registrar is a monitor: decide, apply to memory, commit, release the lock, act.

The thread that brings a message decides it under the registrar's lock. The changes are on disk before any effect of
them leaves the process. If the commit fails, nothing has happened. This file has four parts:

- RegistrarState: the catalog in memory, its lock, and the fast paths for one row.
- Monitor: takes messages and commands, and decides them in their order.
- CommitLog: knows which changes are on disk and which are still to be written.
- EffectRunner: carries out the effects of a decision once it is on disk.

Under the lock no user code runs, nothing is pickled and no message is sent. A thread that has the lock never waits, and
never takes the lock of another registrar.

    with state.enter():
        catalog = state.whole()
        ...

An interrupt (Ctrl-C) may stop a thread between any two instructions, and so may a defect. The next thread that takes
the lock rolls the unfinished decision back before it reads anything. Therefore every use of the catalog begins with
whole().
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import logging
import threading
import time
from asyncio import AbstractEventLoop, TimerHandle
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, MailboxFull, RegistrarDown, RrError, Unavailable
from rr_actors.registrar.core import holding
from rr_actors.registrar.core.decide import Item, decide, refuse_uncommitted
from rr_actors.registrar.core.loading import join, loaded
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import ABSENT, Catalog, Decision, Unsaved
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.messages import Gone, Load, Loaded, Message, Noticed, error_of, failure_of
from rr_actors.registrar.model.rows import OK, OWED, PENDING, Change, Content, Drop, Held, Put, Row
from rr_actors.runtime import interpreter
from rr_actors.runtime.workers import Workers
from rr_actors.storage.store import Store

LoadWaiter = Callable[[Held | None, RrError | None], None]
UnloadWaiter = Callable[[RrError | None], None]


class _OpenLocks:
    """The locks of this process's registrars: for each, a function that says whether the calling thread has it.

    The tuple is replaced as a whole, on the loop.
    """

    def __init__(self) -> None:
        self.owned: tuple[Callable[[], bool], ...] = ()


_open_locks = _OpenLocks()


def is_deciding() -> bool:
    """Return whether the calling thread has the lock of any registrar of this process.

    A finalizer (__del__) must not wait if so: the garbage collector runs it anywhere, also in the middle of a decision.
    """
    for is_owned in _open_locks.owned:  # noqa: SIM110 - any() takes longer
        if is_owned():
            return True
    return False


def answered_by_line(_error: RrError | None) -> None:
    """Do nothing: this waiter marks an unload whose thread reads the answer on its own direct line."""


class RegistrarState:
    """The catalog of one registrar, in memory and on disk.

    Attributes:
        lock: held by the thread that decides, or that reads more than one entry. enter() returns it.
        is_inside: whether the calling thread has the lock; is_deciding() asks it.
        closed: whether the registrar is closed; then nothing is decided any more.
        waiting: the messages and commands that are not decided yet (Monitor). A new one of a thread waits behind them.
        sequence: the running numbers of queries, in the order in which they are asked for. Releases go newest first.
        loads, unloads: by query, the callback that hears how its load, or its release, ended.
    """

    def __init__(
        self, name: str, config: RegistrarConfig, store: Store, loop: AbstractEventLoop, workers: Workers
    ) -> None:
        self.name = name
        self.config = config
        self._commits = CommitLog(name, config, store, loop, workers)
        self.lock = self._commits.lock
        self.is_inside: Callable[[], bool] = self.lock._is_owned  # type: ignore[attr-defined]  # as in threading
        self.catalog = Catalog(name, self._commits.content(), store.epoch)
        self.epoch = store.epoch
        self.waiting: deque[tuple[Any, str | None]] = deque()
        self.sequence = itertools.count(self.catalog.since + 1)
        self.loads: dict[str, LoadWaiter] = {}
        self.unloads: dict[str, UnloadWaiter] = {}
        self.closed = False
        self._why_down = "closed"

    def lock_in_use(self, *, in_use: bool) -> None:
        """Have is_deciding() ask this lock from now on, or no longer. On the loop."""
        others = tuple(owned for owned in _open_locks.owned if owned != self.is_inside)
        _open_locks.owned = (*others, self.is_inside) if in_use else others

    def enter(self) -> AbstractContextManager[object]:
        """Return the lock, for a `with` statement.

        Raises:
            RegistrarDown: the registrar is closed, or this process is a fork of the registrar's process: there the
                thread that had the lock does not exist, so nobody would release it.
        """
        if self.closed:
            raise self.down()
        return self.lock

    def whole(self) -> Catalog:
        """Return the catalog, and roll back a decision that an interrupt left unfinished. With the lock."""
        catalog = self.catalog
        if catalog.unfinished is not None:
            self._commits.restore(catalog)
            catalog.unfinished = None
        return catalog

    def commit(self, items: Iterable[Item]) -> Decision:
        """Decide the items in their order, and write the changes now, or note them to be written a moment later.

        Raises:
            CatalogError: the changes were not written. Nothing has happened, and no other thread has seen any of it.
        """
        with self.lock:
            decision = decide(self.whole(), items)
            try:
                self._commits.commit(decision)
            except CatalogError:
                decision.undo()
                raise
            decision.close()
            return decision

    def join(self, load: Load) -> Loaded | None:
        """Decide a Load by the fast path, and write its row. Return None if it has to be decided like any message.

        The loop calls it, and a thread of this process that loads.
        """
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            query = None if self.waiting else join(catalog, load)
            if query is None:
                return None
            try:
                catalog.unfinished = [("queries", query.id, ABSENT)]
                written = self._commits.commit_row(query)
                if written:
                    catalog.set("queries", query.id, query)
                catalog.unfinished = None
            except Exception:  # a defect: decide() will meet it again, and report it
                return None
            if not written:
                return None
            return loaded(catalog, query.id, catalog.resources[query.resource_id])

    # -- fast paths of a thread that loads and releases by its own direct line ---------------------------------------

    def begin_directly(self, query: Any, request: bytes, ended: LoadWaiter) -> Load | None:
        """Note a load that the calling thread is about to send; return None if the loop has to send it.

        If the load ends by another way than the thread's, `ended` hears how.
        """
        id, registrar, server, parent = query.id, query.registrar, query.server, query.parent
        attempt, seq = 0, next(self.sequence)
        if not parent:
            self.loads[id] = ended  # without the lock: the id is new, and each dict takes it in one step
            self.catalog.in_flight[id] = Held(id, registrar, server, request, None, "", "", 0, seq, PENDING, OK)
        elif interpreter.possible():
            return None
        else:
            with self.enter():
                resource = self.whole().resources.get(parent)
                if resource is None:
                    return None
                attempt = resource.attempt
                self.loads[id] = ended
                asked = Held(id, registrar, server, request, None, "", parent, attempt, seq, PENDING, OK)
                self.catalog.in_flight[id] = asked
        return Load(id, server, request, self.name, parent, attempt, seq)

    def hold(self, answer: Loaded | c.Got) -> bool:
        """Add the row of a query that a thread has loaded. Return False if the answer has to be decided, as Got."""
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            if self.waiting:
                return False
            held = holding.hold(catalog, self._commits.unsaved, answer)
            if held:
                self.loads.pop(answer.query_id, None)
                if not self._commits.saving:
                    self._commits.save_soon()
            return held

    def forget_refused(self, query_id: str) -> bool:
        """Forget a load that was refused to its thread. Return False if the loop may know of it, and has to end it."""
        if interpreter.possible():
            return False
        with self.lock:
            catalog = self.whole()
            if query_id not in catalog.in_flight:
                return False
            self.loads.pop(query_id, None)
            del catalog.in_flight[query_id]
            return True

    def owe(self, query_id: str) -> bool:
        """Mark as owed a query that a thread releases by its own line; return False if Release has to be decided.

        The row is written, a moment later if the disk has nothing of the query: after an earlier crash the provider
        says whether it is still held. After True the thread must tell the provider. It then passes the answer to
        forget_released(), or leaves the release to the registrar's actor.
        """
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            if self.waiting or self.closed or query_id in self.unloads:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            is_owed = holding.owe(catalog, self._commits.unsaved, query_id, self._commits.commit_row)
            if is_owed:
                self.unloads[query_id] = answered_by_line
            return is_owed

    def forget_released(self, query_id: str) -> bool:
        """Forget a query that its provider has released after owe(); return False if Unloaded has to be decided."""
        if self.closed:
            return False
        with self.lock:
            if self.waiting:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            gone = holding.forget_released(catalog, self._commits.unsaved, query_id)
            if gone:
                self.unloads.pop(query_id, None)
                if not self._commits.saving:
                    self._commits.save_soon()
            return gone

    def down(self) -> RegistrarDown:
        """Return the error that callers of a closed registrar get."""
        return RegistrarDown(f"registrar {self.name!r}: {self._why_down}", registrar=self.name, status="stopped")


# -- messages and commands ---------------------------------------------------------------------------------------------
#
# The loop decides messages as it reads them, all messages of one read as one decision. The thread that ran a callback
# decides its end, unless it has another callback to run. The loop carries out the effects, in the order of the
# decisions. One effect is an exception: the answer to a direct line is sent by the thread that decided it.
#
# A message waits only for these: the rest of its read; the effects that the loop is carrying out; a commit that failed
# and is tried again a moment later; the loop's next turn, if many messages share a commit (durability "power", or
# `save_on_modify=False`).

logger = logging.getLogger("rr_actors.registrar")

_AT_ONCE = 128  # messages in one decision at most: callers get the first answers before the last ones are decided
_RETRY_S = 0.25


class Monitor:
    """Decides the messages and commands of one registrar's actor in their order. On the loop, except decide_here()."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._state: RegistrarState = registrar
        self._dispatcher = registrar.node.dispatcher
        self._runner = EffectRunner(registrar)
        self._effects: deque[list[Effect]] = deque()  # those of each decision, to be carried out on the loop
        self._waiting = self._state.waiting
        self._gathers = not registrar._commits.row_by_row  # many messages share a commit
        self._busy = False  # the loop is deciding or acting: a new message waits until it has finished
        self._scheduled = False  # a turn of the loop is scheduled
        self._held_up = False  # a commit failed and is tried again later; nothing is decided before that
        self._failure = ""  # the reason, as it was logged
        self._changed = asyncio.Event()
        self._held_back: list[tuple[Message, str]] = []

    # -- messages and commands ---------------------------------------------------------------------------------------

    def receive(self, message: Message, sender: str, *, more: bool = False) -> None:
        """Decide a message of another registrar. On the loop. `more`: others follow, to be decided together with it."""
        if self._state.closed:
            return
        if not self._registrar.serving and type(message) is Noticed:
            self._held_back.append((message, sender))  # until on_start has returned
            return
        if type(message) is Load and self._is_read_first(message, sender):
            return
        if type(message) is Gone:
            self._registrar.consumers.expel(message.origin)
        self.put(message, sender, more=more)

    def _is_read_first(self, load: Load, sender: str) -> bool:
        """Have a worker read the request first if that runs user code, and return whether it does."""
        servers = self._registrar.servers
        server = servers.get(load.server)
        if server is None or not server.request.runs_code(load.request):
            return False
        with self._state.lock:
            if self._is_read(load):
                return False
        link_of = self._registrar.consumers.link_of
        link = link_of(sender)

        def done(read: Load | c.RefuseLoad, error: BaseException | None) -> None:
            if self._state.closed or link_of(sender) is not link:  # the consumer sends it again over the next link
                return
            if servers.get(load.server) is not server:  # unregistered meanwhile, and perhaps registered anew
                self.receive(load, sender)
                return
            if error is not None:
                read = c.RefuseLoad(sender, load.query_id, failure_of(error))
            self.put(read, sender if type(read) is Load else None)
            self._registrar.progress.greet(sender, load.query_id)

        try:
            self._registrar.workers.submit(server.readable, load, done=done)
        except MailboxFull as error:
            done(load, error)
        except Unavailable:  # this process is stopping
            pass
        return True

    def _is_read(self, load: Load) -> bool:
        """Return whether the Load can be decided without reading its request. With the lock."""
        catalog = self._state.whole()
        known = catalog.queries.get(load.query_id)
        if known is not None:
            return known.resource_id not in catalog.recovering  # such a resource may have to be loaded anew
        return load.query_id in catalog.refused or catalog.joinable(load.server, load.request) is not None

    def hear_held_back(self) -> None:
        """Decide the statuses that arrived before the registrar was ready."""
        held_back, self._held_back = self._held_back, []
        for message, sender in held_back:
            self.receive(message, sender)

    def put(self, what: Any, sender: str | None = None, *, more: bool = False) -> None:
        """Decide a message or command behind those that wait, and act; with `more`, in the loop's next turn."""
        later = more or self._gathers or self._state.is_inside()
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

    def decide_here(self, command: c.Command) -> bool:
        """Decide a command in the calling thread. Return False if the loop has to decide it.

        If exactly one direct line waits, the calling thread sends the answer. The loop carries out all other effects,
        in order.
        """
        state = self._state
        if state.closed or self._gathers or interpreter.possible():  # in a fork nobody releases the lock
            return False
        with state.lock:
            if state.closed or self._waiting:
                return False
            try:
                decision = state.commit(((command, None),))
            except Exception:  # a full disk, or a defect: the loop will meet it again, and report it
                return False
            answer = self._runner.by_thread(decision.effects)
            if answer is None:
                self._effects.append(decision.effects)
        if answer is None:
            self._dispatcher.hand_over(self.act)
        else:
            answer()
        return True

    def run(self, command: c.Command) -> None:
        """Decide a command now, before all that waits, and act; raise CatalogError if it cannot be committed."""
        with self._state.lock:
            self._effects.append(self._state.commit(((command, None),)).effects)
        if self._state.is_inside():
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
                with self._state.lock:  # no thread may decide anything between taking the messages and deciding them
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
        failure = ""
        try:
            with self._state.lock:  # held until items that were not committed wait again: no thread overtakes them
                try:
                    decision = self._state.commit(
                        [item if type(item[0]) is not Load else self._readable(*item) for item in items]
                    )
                    if decision.effects:
                        self._effects.append(decision.effects)
                except CatalogError as error:
                    failure = str(error)
                    self._not_committed(items, error)
            if failure and failure != self._failure:
                logger.error("%s: not committed, nothing was done: %s", self._state.name, failure)
            self._failure = failure if self._held_up else ""
        except Exception as error:
            self._registrar.fail(error)

    def _readable(self, load: Load, sender: str | None) -> Item:
        """Return the Load in canonical form, or its refusal; a worker has read it already if that runs user code."""
        server = self._registrar.servers.get(load.server)
        if server is None or self._is_read(load) or server.request.runs_code(load.request):
            return load, sender
        read = server.readable(load)
        return read, sender if type(read) is Load else None

    def _not_committed(self, items: Sequence[Item], error: CatalogError) -> None:
        """Refuse the items that can be refused, and put the others back, to be decided again a little later."""
        refusals, again = refuse_uncommitted(self._state.whole(), items, failure_of(error))
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


# -- the disk ----------------------------------------------------------------------------------------------------------

_SAVE_SOON_S = 0.05
_TIDY_SOON_S = 0.1  # after the last commit
_TIDY_AT_LAST_S = 2.0  # after the first
_TIDY_AGAIN_S = 1.0


class CommitLog:
    """Commits decisions to the store: changes that must survive a crash now, others a moment later.

    With save_on_modify off, all changes are written once each save interval, and at closing. Any thread may commit,
    with the lock.

    Attributes:
        unsaved: the changes that wait to be written; saving: whether a timer to write them is set.
        row_by_row: whether a row is committed by itself: now, and without waiting for the disk.
        lock: the registrar's lock. A thread holds it from the beginning of a decision to the end of commit().
        watched: who watches the system: during a recording, commits are timed.
        count: the number of commits; `timed`: how many of them were timed, and `timed_s` the seconds that those took.
    """

    def __init__(
        self, name: str, config: RegistrarConfig, store: Store, loop: AbstractEventLoop, workers: Workers
    ) -> None:
        self.lock = threading.RLock()
        self._name = name
        self._store = store
        self._loop = loop
        self._workers = workers
        self._at_once = config.save_on_modify
        self.row_by_row = config.save_on_modify and config.durability != "power"
        self._delay_s = _SAVE_SOON_S if config.save_on_modify else config.save_interval_s
        self.unsaved = Unsaved()
        self.saving = False  # from when a save is asked for until it begins
        self._save_timer: TimerHandle | None = None
        self._tidying = False  # from when tidying is asked for until it has ended
        self.count = 0
        self.timed = 0
        self.timed_s = 0.0
        self.watched: Any = None
        self._closed = False

    def content(self) -> Content:
        """Return the rows on disk. Write unsaved changes first; with save_on_modify off, forget them instead.

        Raises:
            CatalogError: the unsaved changes could not be written, and are kept; or the rows could not be read.
        """
        if self._at_once:
            self._save()
        self.unsaved.clear()
        return self._store.load()

    def commit(self, decision: Decision) -> None:
        """Write the changes of a decision behind older unsaved ones, or note them to be written later.

        Raises:
            CatalogError: nothing was written.
        """
        if decision.changes and self._at_once:
            unsaved, later = self.unsaved, decision.later.values()
            if unsaved.some or unsaved.new or later:
                self._write([*unsaved.changes(), *decision.changes, *later])
                unsaved.clear()
            else:
                self._write(decision.changes)
        elif decision.changes or decision.later:
            self.unsaved.add(decision.changes)
            self.unsaved.add(decision.later.values())
            self.save_soon()

    def commit_row(self, row: Row) -> bool:
        """Write one row now, or return False: decide() has to write it, or reports why that fails. With the lock."""
        if not self.row_by_row:
            return False
        try:
            self._write([Put(row)])
        except CatalogError:
            return False
        self.unsaved.row_written(row)
        return True

    def restore(self, catalog: Catalog) -> None:
        """Roll back a decision that was interrupted. From any thread, with the lock.

        The interrupt came before the write or after it. Therefore the rows that the decision began to change are
        written as they were before, a moment later, and no row counts as never written.
        """
        self.unsaved.doubt()
        for table, id in catalog.roll_back():
            row = catalog.tables[table].get(id)
            pending = type(row) is Held and row.hold is PENDING  # a pending row is never on disk
            self.unsaved.add([Drop(table, id) if row is None or pending else Put(row)])
        self.save_soon()

    def save(self) -> None:
        """Write the unsaved changes, and tidy the store, so that other tools can read all of it.

        Raises:
            CatalogError: the changes were not written, and stay unsaved.
        """
        self._save()
        self._store.tidy()

    def _save(self) -> None:
        with self.lock:
            if changes := self.unsaved.changes():
                self._write(changes)
                self.unsaved.clear()

    def _write(self, changes: Sequence[Change]) -> None:
        if self.watched is not None and self.watched.level[0] > 1:
            began = time.perf_counter()
            interpreter.hurried(self._store.commit, changes)
            self.timed_s += time.perf_counter() - began
            self.timed += 1
        else:
            interpreter.hurried(self._store.commit, changes)
        self.count += 1
        if not self._tidying and self._store.wants_tidying():
            self._tidying = True
            self._on_loop(self._tidy_when_quiet)

    def save_soon(self) -> None:
        """Have the unsaved changes written a moment later. From any thread, with the lock."""
        if not self.saving:
            self.saving = True
            self._on_loop(self._save_after, self._delay_s)

    def _on_loop(self, fn: Callable[..., object], *args: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended: close() writes the unsaved changes
            self._loop.call_soon_threadsafe(fn, *args)

    # -- on the loop -------------------------------------------------------------------------------------------------

    def _tidy_when_quiet(self) -> None:
        """Tidy the store after a pause in the commits, when no thread that waits for one needs the processor."""
        self._look(self._loop.time() + _TIDY_AT_LAST_S)

    def _look(self, at_last: float, commits: int = -1) -> None:
        if self._closed:
            return
        if commits == self.count or self._loop.time() >= at_last:
            with contextlib.suppress(Unavailable):  # the process is stopping, and soon closes this registrar
                self._workers.submit(self._store.tidy, done=self._tidied, patient=True)
        else:
            self._loop.call_later(_TIDY_SOON_S, self._look, at_last, self.count)

    def _tidied(self, _result: None, error: BaseException | None) -> None:
        self._tidying = False
        if error is not None:
            logger.warning("%s: %s; tried again later", self._name, error)
        if not self._closed and self._store.wants_tidying():
            self._tidying = True
            if error is None:
                self._tidy_when_quiet()
            else:
                self._loop.call_later(_TIDY_AGAIN_S, self._look, 0.0)

    def close(self, *, erase: bool) -> None:
        """Write unsaved changes and close the store; with `erase`, remove it. Log every failure."""
        self._closed = True
        if self._save_timer is not None:
            self._save_timer.cancel()
        try:
            self._save()
        except Exception:  # a CatalogError, or a defect that has ended the registrar: close the store all the same
            logger.exception("%s: could not save at closing", self._name)
        finally:
            try:
                with self.lock:
                    self._store.close(erase=erase)
            except CatalogError:
                logger.exception("%s: its catalog could not be closed, or removed", self._name)

    def _save_after(self, delay_s: float) -> None:
        if not self._closed:
            self._save_timer = self._loop.call_later(delay_s, self._save_now)

    def _save_now(self) -> None:
        self.saving = False  # first: a change from now on needs another save
        try:
            self._save()
        except CatalogError as error:
            logger.error("%s: %s; tried again later", self._name, error)
            self.saving = True
            self._save_after(_RETRY_S)


# -- effects -----------------------------------------------------------------------------------------------------------
#
# One method for each kind of effect.

_CALLBACKS = frozenset((e.StartLoad, e.StartUnload, e.StartRecover, e.StartStatus, e.Hear))


class EffectRunner:
    """Carries out the effects that decisions cause, for a registrar's actor. On the loop."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._loop = registrar.node.dispatcher.loop
        self._workers = registrar.node.dispatcher.workers
        self._timers: dict[str, TimerHandle] = {}
        self._dirty: dict[int, Any] = {}
        self._methods: dict[type, Callable[[Any], None]] = {
            e.Reply: self._reply,
            e.Request: self._request,
            e.Connect: self._connect,
            e.StartLoad: self._start_load,
            e.StartUnload: self._start_unload,
            e.StartRecover: self._start_recover,
            e.StartStatus: self._start_status,
            e.SetTimer: self._set_timer,
            e.LoadResolved: self._load_resolved,
            e.UnloadResolved: self._unload_resolved,
            e.Receive: self._receive,
            e.Hear: self._hear,
            e.Answer: self._answer,
            e.Happened: self._happened,
        }

    def do(self, effects: Sequence[Effect]) -> None:
        """Carry out the effects in their order, and flush each link once, at the end.

        A decision has its events before its answers, some of which leave at once, by direct lines. A process that is
        killed after an answer has therefore sent the event. Worker threads are woken once for all callbacks: otherwise
        the first callback might end, and its thread sleep again, before the second is submitted.
        """
        methods = self._methods
        if len(effects) > 1 and not _CALLBACKS.isdisjoint(map(type, effects)):
            self._workers.threads.gather()
            try:
                for effect in effects:
                    methods[type(effect)](effect)
            finally:
                self._workers.threads.go()
        else:
            for effect in effects:
                methods[type(effect)](effect)
        self._registrar.consumers.flush()
        if self._dirty:
            dirty, self._dirty = self._dirty, {}
            for link in dirty.values():
                link.flush()

    def by_thread(self, effects: Sequence[Effect]) -> Callable[[], None] | None:
        """Return a function that any thread may call to carry out the effects; None if the loop has to. With the lock.

        A thread may send only the answer to one direct line, which has no order with other messages. Watchers hear of
        an event before the answer, so while anybody watches, the loop sends both.
        """
        answer: e.Reply | None = None
        for effect in effects:
            if type(effect) is e.Reply and answer is None:
                answer = effect
            elif type(effect) is not e.Happened or self._registrar.node.watched:
                return None
        return _nothing if answer is None else self._registrar.consumers.by_line(answer.message)

    def close(self) -> None:
        """Cancel all timers."""
        for timer in self._timers.values():
            timer.cancel()

    # -- messages ------------------------------------------------------------------------------------------------

    def _reply(self, effect: e.Reply) -> None:
        self._registrar.consumers.send(effect.origin, effect.message)

    def _request(self, effect: e.Request) -> None:
        client = self._registrar.client(effect.registrar)
        link = client.link
        if link is None:
            client.want()
            return
        if self._registrar.catalog.up.get(effect.registrar) != client.opened:
            return  # decided for an earlier link: reconciling this one sends all open messages again
        try:
            if type(effect.message) is Load:
                client.describe(effect.message.server)
            link.send(effect.message)
        except RrError as error:
            self._not_sent(effect, error)
            return
        if self._registrar.node.watched.level[0] > 1:
            self._registrar.node.recorder.message("sent", self._registrar.name, effect.registrar, effect.message)
        self._dirty[id(link)] = link

    def _not_sent(self, effect: e.Request, error: RrError) -> None:
        if type(effect.message) is Load:
            self._registrar.post(c.GiveUp(effect.message.query_id, failure_of(error)))
            return
        name = self._registrar.name
        logger.error("%s: %s; closing the link, what is open is sent again over the next", name, error)
        link = self._registrar.client(effect.registrar).link
        if link is not None:
            link.close()

    def _connect(self, effect: e.Connect) -> None:
        self._registrar.client(effect.registrar).want()

    def _receive(self, effect: e.Receive) -> None:
        self._registrar.monitor.receive(effect.message, effect.sender)

    # -- callbacks -----------------------------------------------------------------------------------------------

    def _start_load(self, effect: e.StartLoad) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is not None:
            server.start_load(effect.resource)

    def _start_unload(self, effect: e.StartUnload) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is not None:
            server.start_unload(effect.resource)

    def _start_recover(self, effect: e.StartRecover) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is not None:
            server.start_recover(effect.resource, effect.reload)

    def _start_status(self, effect: e.StartStatus) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is None or server.spec.status is None:
            self._registrar.post(c.StatusDone(effect.resource.id, effect.notice, handled=False))
        else:
            server.start_status(effect.resource, effect.notice, repeated=effect.repeated)

    # -- timers --------------------------------------------------------------------------------------------------

    def _set_timer(self, effect: e.SetTimer) -> None:
        old = self._timers.pop(effect.key, None)
        if old is not None:
            old.cancel()
        if effect.delay_s is not None:
            fire = functools.partial(self._timer_fired, effect.key, effect.command)
            self._timers[effect.key] = self._loop.call_later(effect.delay_s, fire)

    def _timer_fired(self, key: str, command: c.Command) -> None:
        self._timers.pop(key, None)
        self._registrar.post(command)

    # -- waiting callers and listeners ---------------------------------------------------------------------------

    def _load_resolved(self, effect: e.LoadResolved) -> None:
        held = effect.held
        if effect.failure is not None:
            self._forget(held.id)
        waiter = self._registrar.loads.pop(held.id, None)
        if waiter is not None:
            waiter(held, None if effect.failure is None else error_of(effect.failure))

    def _unload_resolved(self, effect: e.UnloadResolved) -> None:
        held = self._registrar.catalog.held.get(effect.query_id)
        if effect.failure is None or (held is not None and held.hold is OWED):  # else the query is held, or will be
            self._forget(effect.query_id)
        waiter = self._registrar.unloads.pop(effect.query_id, None)
        if waiter is not None:
            waiter(None if effect.failure is None else error_of(effect.failure))

    def _hear(self, effect: e.Hear) -> None:
        audience = self._registrar.audience
        if audience is None:
            self._heard(effect, False)
            return
        audience.hear(effect.held, effect.notice, functools.partial(self._heard, effect), repeated=effect.repeated)
        if effect.notice.released:
            audience.forget(effect.held.id)

    def _heard(self, effect: e.Hear, handled: bool) -> None:
        self._registrar.post(c.Heard(effect.held.id, effect.notice.event, handled))

    def _forget(self, query_id: str) -> None:
        if self._registrar.audience is not None:
            self._registrar.audience.forget(query_id)

    def _answer(self, effect: e.Answer) -> None:
        effect.ticket(None if effect.failure is None else error_of(effect.failure))

    def _happened(self, effect: e.Happened) -> None:
        if self._registrar.node.watched:
            name = self._registrar.name
            facts = {"resource_id": effect.resource_id, "detail": effect.detail}
            self._registrar.node.emit(effect.what, registrar=name, server=f"{name}/{effect.server}", **facts)


def _nothing() -> None:
    """Do nothing: the decision has no answer to send."""
