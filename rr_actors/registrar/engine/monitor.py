"""A registrar is a monitor: decide, apply to memory, commit, give the lock back, act.

The thread that brings a message decides it, under the registrar's lock. Its changes are on disk before anything of them
leaves. If the commit fails, nothing has happened. The four parts of this file:

- RegistrarState: the catalog in memory, its lock, and the fast paths for one row.
- Monitor: what comes in, and in which order it is decided.
- CommitLog: what of the catalog is on disk, and what is still to be written.
- EffectRunner: what the decisions want done, once it is on disk.

No code of a user's, no pickling and no sending of messages happens under the lock. A thread that has it never waits,
and never takes another registrar's.

    with state.enter():
        catalog = state.whole()
        ...

A thread may be interrupted (Ctrl-C) between any two instructions. The next thread that has the lock rolls an
interrupted decision back, before it reads anything: so all begin with whole().
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
from rr_actors.registrar.core.loading import join
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import ABSENT, Catalog, Decision, Unsaved
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.messages import (
    Gone,
    Load,
    Loaded,
    Message,
    Noticed,
    error_of,
    failure_of,
)
from rr_actors.registrar.model.rows import OK, OWED, PENDING, Change, Content, Drop, Held, Put, Row
from rr_actors.runtime import interpreter
from rr_actors.runtime.workers import Workers
from rr_actors.storage.store import Store

LoadWaiter = Callable[[Held | None, RrError | None], None]
UnloadWaiter = Callable[[RrError | None], None]


class _OpenLocks:
    """Those of this process's registrars: whether the calling thread has each. Replaced as a whole, on the loop."""

    def __init__(self) -> None:
        self.owned: tuple[Callable[[], bool], ...] = ()


_open_locks = _OpenLocks()


def is_deciding() -> bool:
    """Return whether the calling thread decides for any registrar of this process: a finalizer (__del__), which the
    garbage collector runs anywhere, may find it so, and then must not wait."""
    for is_owned in _open_locks.owned:  # noqa: SIM110 - any() takes longer
        if is_owned():
            return True
    return False


def answered_by_line(_error: RrError | None) -> None:
    """How an unload ended that a thread does by a line of its own: it hears there."""


class RegistrarState:
    """The catalog of one registrar, in memory and on disk.

    Args:
        store: its catalog's storage, open.

    Attributes:
        lock: of the thread that decides, or reads more than one entry. Taken by enter().
        is_inside: whether the calling thread has the lock; see is_deciding().
        closed: nothing is decided any more.
        waiting: what has come in and is not decided yet (monitor.py). What a thread brings waits behind it.
        row_by_row: whether what is decided by itself is written by itself.
        sequence: the running numbers of what is asked: it is released newest first.
        loads, unloads: who hears how a load, or a release, ended, by query.
    """

    def __init__(
        self, name: str, config: RegistrarConfig, store: Store, loop: AbstractEventLoop, workers: Workers
    ) -> None:
        self.name = name
        self.config = config
        self.lock = threading.RLock()
        self.is_inside: Callable[[], bool] = self.lock._is_owned  # type: ignore[attr-defined]  # as in threading
        self._commits = CommitLog(name, config, store, loop, workers, self.lock)
        self.catalog = Catalog(name, self._commits.content(), store.epoch)
        self.epoch = store.epoch
        self.row_by_row = self._commits.row_by_row
        self.waiting: deque[tuple[Any, str | None]] = deque()
        self.sequence = itertools.count(self.catalog.seq + 1)
        self.loads: dict[str, LoadWaiter] = {}
        self.unloads: dict[str, UnloadWaiter] = {}
        self.closed = False
        self._why_down = "closed"

    def lock_in_use(self, *, in_use: bool) -> None:
        """Have is_deciding() look at the lock from now on, or no more. On the loop."""
        others = tuple(owned for owned in _open_locks.owned if owned != self.is_inside)
        _open_locks.owned = (*others, self.is_inside) if in_use else others

    def enter(self) -> AbstractContextManager[object]:
        """Return the lock, for a `with` statement.

        Raises:
            RegistrarDown: closed, or this process is a fork of the registrar's: there, nobody might give the lock back.
        """
        if self.closed:
            raise self.down()
        return self.lock

    def whole(self) -> Catalog:
        """Return the catalog; first roll back a decision that an interrupt left unfinished. With the lock."""
        catalog = self.catalog
        if catalog.unfinished is not None:
            self._roll_back(catalog)
        return catalog

    def commit(self, items: Iterable[Item]) -> Decision:
        """Decide these, and write what that has changed, or note it to be written a moment later.

        Raises:
            CatalogError: not written; nothing has happened, and nobody has seen any of it.
        """
        with self.lock:
            try:
                decision = decide(self.whole(), items)
                try:
                    self._commits.commit(decision)
                except CatalogError:
                    decision.undo()
                    raise
                decision.close()
            except CatalogError:
                raise
            except BaseException:  # an interrupt, or a defect: at any instruction
                self.whole()
                raise
            return decision

    def join(self, load: Load) -> Loaded | None:
        """Decide a Load by the fast path, and write it; None: it is to be decided as any message.

        The same for the loop and for a thread of this process that loads.
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
                if not self._commits.commit_row(query):
                    catalog.unfinished = None
                    return None
                catalog.set("queries", query.id, query)
                catalog.unfinished = None
            except Exception:  # as the decision will find, and say: a full disk, or a defect
                catalog.unfinished = None
                return None
            except BaseException:
                self.whole()
                raise
            resource = catalog.resources[query.resource_id]
            return Loaded(query.id, resource.id, resource.response or b"")

    # -- fast paths of the thread that loads and releases by a line of its own ---------------------------------------

    def begin_directly(self, query: Any, request: bytes, ended: LoadWaiter) -> Load | None:
        """Note that the calling thread is about to ask for a query. None: the loop has to, as the parent is gone, say.

        Args:
            query: what it asks for.
            ended: hears how the load ends, if it ends by another way than the thread's.
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
        """Take up what a thread has loaded; False: it is to be decided, as Got."""
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            if self.waiting:
                return False
            try:
                held = holding.hold(catalog, self._commits.unsaved, answer)
                if held:
                    self.loads.pop(answer.query_id, None)
                    if not self._commits.saving:
                        self._commits.save_soon()
            except BaseException:
                self.whole()
                raise
            return held

    def forget_refused(self, query_id: str) -> bool:
        """Forget what a thread has asked for, and was refused; False: the loop is to end it, which may know of it."""
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
        """Have a query owed that a thread releases by a line of its own; False: it is to be decided as any command.

        On disk, unless nothing of it is: after a crash its provider says what became of it. After True the thread must
        tell the provider, and then give the answer to forget_released(), or leave it to the registrar's actor.
        """
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            if self.waiting or self.closed or query_id in self.unloads:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            row = holding.owed(catalog, query_id)
            if row is None:
                return False
            try:
                if not holding.owe(catalog, self._commits.unsaved, row, self._commits.commit_row):
                    return False
            except CatalogError:  # as the decision will find, and say
                return False
            except BaseException:
                self.whole()
                raise
            self.unloads[query_id] = answered_by_line
            return True

    def forget_released(self, query_id: str) -> bool:
        """After owe(): forget a query that its provider has released; False: that is to be decided as any message."""
        if self.closed:
            return False
        with self.lock:
            if self.waiting:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            try:
                gone = holding.forget_released(catalog, self._commits.unsaved, query_id)
                if gone:
                    self.unloads.pop(query_id, None)
                    if not self._commits.saving:
                        self._commits.save_soon()
            except BaseException:
                self.whole()
                raise
            return gone

    def _roll_back(self, catalog: Catalog) -> None:
        self._commits.restore(catalog)
        catalog.unfinished = None

    def down(self) -> RegistrarDown:
        """The error for callers when it is closed."""
        return RegistrarDown(f"registrar {self.name!r}: {self._why_down}", registrar=self.name, status="stopped")


# -- what comes in -----------------------------------------------------------------------------------------------------
#
# The loop decides what it reads as it reads it, all messages of one read as one decision. The thread that ran a
# callback decides what follows from its end, unless it has another to run. What the decisions cause is done on the
# loop, in the order of the decisions; only the answer to one direct line is given by the thread that has decided it.
#
# Messages wait only while something else has to be first: the rest of the same read; what is done now (then they follow
# it); a commit that failed, and is tried again a moment later; and where many share a commit (durability "power", or
# `save_on_modify=False`) until the loop's next turn.

logger = logging.getLogger("rr_actors.registrar")

_AT_ONCE = 128  # with more, those who wait for the first answers do not wait for the last ones
_RETRY_S = 0.25


class Monitor:
    """That of one registrar. On the loop, but for decide_here.

    Args:
        registrar: its actor, whose servers, links and callers EffectRunner deals with.
    """

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._state: RegistrarState = registrar
        self._dispatcher = registrar.node.dispatcher
        self._runner = EffectRunner(registrar)
        self._effects: deque[list[Effect]] = deque()  # of each decision, to be done on the loop
        self._waiting = self._state.waiting
        self._gathers = not self._state.row_by_row
        self._busy = False  # deciding, or acting: what comes in meanwhile follows
        self._scheduled = False  # there will be a turn
        self._held_up = False  # what could not be committed is tried again later, and nothing before it
        self._failure = ""  # why, as it has been logged
        self._changed = asyncio.Event()
        self._held_back: list[tuple[Message, str]] = []

    # -- what comes in -----------------------------------------------------------------------------------------------

    def receive(self, message: Message, sender: str, *, more: bool = False) -> None:
        """A message of another registrar has arrived; on the loop. `more`: others follow, to be decided together."""
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
        """Whether a worker reads a request, and its Load is decided then: since to read it runs a user's code."""
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
            if self._state.closed or link_of(sender) is not link:  # it is sent again over the next
                return
            if servers.get(load.server) is not server:  # it is another's, or nobody's
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
        """Whether what a Load is decided by is known without reading its request; with the lock."""
        catalog = self._state.whole()
        known = catalog.queries.get(load.query_id)
        if known is not None:
            return known.resource_id not in catalog.recovering  # there it may have to be loaded anew
        return load.query_id in catalog.refused or catalog.joinable(load.server, load.request) is not None

    def hear_held_back(self) -> None:
        """Decide the statuses that came before the registrar was ready."""
        held_back, self._held_back = self._held_back, []
        for message, sender in held_back:
            self.receive(message, sender)

    def put(self, what: Any, sender: str | None = None, *, more: bool = False) -> None:
        """Decide a message, behind what waits, and act; with `more` in the loop's next turn, or with what follows."""
        if not (self._waiting or self._busy or self._held_up or more or self._gathers or self._state.is_inside()):
            self._busy = True
            try:
                self._decide(((what, sender),))
                self._do_effects()
            finally:
                self._busy = False
            if self._waiting:
                self._decide_waiting()
            return
        self._waiting.append((what, sender))
        if self._busy or self._held_up:
            return
        if more or self._gathers or self._state.is_inside():
            if not self._scheduled:
                self._scheduled = True
                self._dispatcher.loop.call_soon(self._turn)
        else:
            self._decide_waiting()

    def decide_here(self, command: c.Command) -> bool:
        """Decide a command in the thread that brings it, and answer by that if a direct line waits; False: not so.

        What else follows is done on the loop, in its order.
        """
        state = self._state
        if state.closed or self._gathers or interpreter.possible():  # in a fork nobody gives the lock back
            return False
        with state.lock:
            if state.closed or self._waiting:
                return False
            try:
                decision = state.commit(((command, None),))
            except Exception:  # as the loop will find, and say: a full disk, or a defect
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
        """Decide a command now, whatever waits, commit that, and act.

        Raises:
            CatalogError: not committed; nothing has happened.
        """
        with self._state.lock:
            self._effects.append(self._state.commit(((command, None),)).effects)
        if self._state.is_inside():
            self._dispatcher.call(self.act)
        else:
            self.act()

    async def next_change(self, timeout_s: float) -> None:
        """Return when something has been decided, or after `timeout_s` seconds."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    def close(self) -> None:
        """Decide nothing more, and act on nothing later."""
        self._waiting.clear()
        self._effects.clear()
        self._runner.close()

    # -- taking up ---------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        self._scheduled = False
        self._decide_waiting()

    def _decide_waiting(self) -> None:
        if self._busy:
            return
        self._busy = True
        try:
            while self._waiting and not self._held_up:
                with self._state.lock:  # no thread decides anything between what waits and what it comes to
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
        failed: CatalogError | None = None
        try:
            with self._state.lock:  # until what could not be committed waits again: no thread overtakes it
                try:
                    decision = self._state.commit(
                        [item if type(item[0]) is not Load else self._readable(*item) for item in items]
                    )
                    if decision.effects:
                        self._effects.append(decision.effects)
                except CatalogError as error:
                    failed = error
                    self._not_committed(items, error)
            failure = "" if failed is None else str(failed)
            if failure and failure != self._failure:
                logger.error("%s: not committed, nothing was done: %s", self._state.name, failure)
            self._failure = failure if self._held_up else ""
        except Exception as error:
            self._registrar.fail(error)

    def _readable(self, load: Load, sender: str | None) -> Item:
        """As ServerActor.readable(), which a worker has done already where it runs a user's code."""
        server = self._registrar.servers.get(load.server)
        if server is None or self._is_read(load) or server.request.runs_code(load.request):
            return load, sender
        read = server.readable(load)
        return read, sender if type(read) is Load else None

    def _not_committed(self, items: Sequence[Item], error: CatalogError) -> None:
        """Nothing of these has happened: refuse what can be refused, and do the rest again a little later."""
        refusals, again = refuse_uncommitted(self._state.whole(), items, failure_of(error))
        refusals.close()  # it changes nothing
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
        """Do what has been decided, in the order of the decisions; and decide what comes in meanwhile behind it."""
        if self._busy:  # it follows what is done now
            return
        self._busy = True
        try:
            self._do_effects()
        finally:
            self._busy = False
        self._decide_waiting()

    def _do_effects(self) -> None:
        try:
            while self._effects:
                self._runner.do(self._effects.popleft())
        except Exception as error:
            self._registrar.fail(error)
        self._changed.set()


# -- what is on disk ---------------------------------------------------------------------------------------------------

_SAVE_SOON_S = 0.05
_TIDY_SOON_S = 0.1  # after the last commit
_TIDY_AT_LAST_S = 2.0  # after the first
_TIDY_AGAIN_S = 1.0


class CommitLog:
    """Commits decisions to the store: at once what must be there, a moment later what could be rebuilt.

    With save_on_modify off everything is written each save interval, and at closing. Commits are made by any thread,
    with the lock.

    Attributes:
        unsaved: what waits to be written; saving: whether it will be a moment later.
        row_by_row: whether what is decided by itself is written by itself: now, and without waiting for the disk.
        lock: the registrar's. It is held around a decision, from its beginning to commit().
        watched: the system's: while somebody records, commits are timed.
        count: how many commits there were; `timed`: of these, and `timed_s` how many seconds they took.
    """

    def __init__(
        self,
        name: str,
        config: RegistrarConfig,
        store: Store,
        loop: AbstractEventLoop,
        workers: Workers,
        lock: AbstractContextManager[Any],
    ) -> None:
        self.lock = lock
        self._name = name
        self._store = store
        self._loop = loop
        self._workers = workers
        self._at_once = config.save_on_modify
        self.row_by_row = config.save_on_modify and config.durability != "power"
        self._delay_s = _SAVE_SOON_S if config.save_on_modify else config.save_interval_s
        self.unsaved = Unsaved()
        self.saving = False  # from when it is to be done until it is
        self._save_timer: TimerHandle | None = None
        self._tidying = False  # the same
        self._tidy_timer: TimerHandle | None = None
        self.count = 0
        self.timed = 0
        self.timed_s = 0.0
        self.watched: Any = None
        self._closed = False

    def content(self) -> Content:
        """Return what is on disk. Save what is unsaved first; with save_on_modify off, forget it instead.

        Raises:
            CatalogError: what may be written a moment later was not; nothing is forgotten.
        """
        if self._at_once:
            self._save()
        self.unsaved.forget()
        return self._store.load()

    def commit(self, decision: Decision) -> None:
        """Write a decision's changes, or note them for later; older ones that wait are written before.

        Raises:
            CatalogError: nothing was written.
        """
        if decision.changes and self._at_once:
            unsaved, later = self.unsaved, decision.later.values()
            if unsaved.some or unsaved.new or later:
                self._write([*unsaved.changes(), *decision.changes, *later])
                unsaved.all_written()
                unsaved.written(later)
            else:
                self._write(decision.changes)
            if unsaved.new:  # some were released before they were written; what these changes are of is on disk now
                unsaved.written(decision.changes)
        elif decision.changes or decision.later:
            self.unsaved.add(decision.changes)
            self.unsaved.add(decision.later.values())
            self.save_soon()

    def commit_row(self, row: Row) -> bool:
        """Write one row now; False: it is one of many that are written together. From any thread, with the lock.

        Raises:
            CatalogError: it was not written.
        """
        if self.row_by_row:
            self._write([Put(row)])
            self.unsaved.row_written(row)
        return self.row_by_row

    def restore(self, catalog: Catalog) -> None:
        """Roll back a decision that was interrupted. From any thread, with the lock.

        It may have been written, or not: the rows that it began to change are written as they were, a moment later.
        """
        for table, id in catalog.roll_back():
            row = catalog.tables[table].get(id)
            if row is None and table == "held" and id in self.unsaved.new:
                self.unsaved.drop(id)
                continue
            pending = type(row) is Held and row.hold is PENDING  # never on disk
            self.unsaved.add([Drop(table, id) if row is None or pending else Put(row)])
        self.save_soon()

    def save(self) -> None:
        """Write what has not been written yet, so that other tools, too, read it.

        Raises:
            CatalogError: it was not, and stays noted.
        """
        self._save()
        self._store.tidy()

    def _save(self) -> None:
        with self.lock:
            if changes := self.unsaved.changes():
                self._write(changes)
                self.unsaved.all_written()

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
        """Have what is unsaved written a moment later. From any thread, with the lock."""
        if not self.saving:
            self.saving = True
            self._on_loop(self._save_after, self._delay_s)

    def _on_loop(self, fn: Callable[..., object], *args: Any) -> None:
        """Commits are made in other threads, too."""
        with contextlib.suppress(RuntimeError):  # it has ended: closing writes what there is to be written
            self._loop.call_soon_threadsafe(fn, *args)

    # -- on the loop -------------------------------------------------------------------------------------------------

    def _tidy_when_quiet(self) -> None:
        """What comes and goes meanwhile needs no tidying, and the threads that wait for a commit have the processor."""
        self._look(self._loop.time() + _TIDY_AT_LAST_S)

    def _look(self, at_last: float, commits: int = -1) -> None:
        if self._closed:
            return
        if commits == self.count or self._loop.time() >= at_last:
            with contextlib.suppress(Unavailable):  # the process is closing, and this soon after it
                self._workers.submit(self._store.tidy, done=self._tidied, patient=True)
        else:
            self._tidy_timer = self._loop.call_later(_TIDY_SOON_S, self._look, at_last, self.count)

    def _tidied(self, _result: None, error: BaseException | None) -> None:
        self._tidying = False
        if error is not None:
            logger.warning("%s: %s; tried again later", self._name, error)
        if not self._closed and self._store.wants_tidying():
            self._tidying = True
            if error is None:
                self._tidy_when_quiet()
            else:
                self._tidy_timer = self._loop.call_later(_TIDY_AGAIN_S, self._look, 0.0)

    def close(self, *, erase: bool) -> None:
        """Write what is unsaved and give the store back; with `erase`, remove it. What cannot be done is logged."""
        self._closed = True
        for timer in (self._save_timer, self._tidy_timer):
            if timer is not None:
                timer.cancel()
        try:
            self._save()
        except Exception:  # a defect, too: it has ended the registrar, and the store is given back all the same
            logger.exception("%s: could not save at closing", self._name)
        finally:
            self._close_store(erase=erase)

    def _close_store(self, *, erase: bool) -> None:
        try:
            with self.lock:
                self._store.close(erase=erase)
        except CatalogError:
            logger.exception("%s: its catalog could not be closed, or removed", self._name)

    def _save_after(self, delay_s: float) -> None:
        if not self._closed:
            self._save_timer = self._loop.call_later(delay_s, self._save_now)

    def _save_now(self) -> None:
        self.saving = False  # first: what is to be written from now on is written later
        try:
            self._save()
        except CatalogError as error:
            logger.error("%s: %s; tried again later", self._name, error)
            self.saving = True
            self._save_after(_RETRY_S)


# -- what the decisions want done --------------------------------------------------------------------------------------
#
# One method for each kind of effect.

_CALLBACKS = frozenset((e.StartLoad, e.StartUnload, e.StartRecover, e.StartStatus, e.Hear))


class EffectRunner:
    """The hands of a registrar's actor. On the loop."""

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
        """Do them in their order. What links carry leaves at the end, each link's messages in one go.

        Decisions have events before answers, some of which leave at once, by lines: a process that is killed when it
        has answered has sent the event. And threads are woken for all callbacks together, as the first might be done
        and asleep again before the second comes.
        """
        methods = self._methods
        if len(effects) > 1 and not _CALLBACKS.isdisjoint(map(type, effects)):
            self._workers.gather()
            try:
                for effect in effects:
                    methods[type(effect)](effect)
            finally:
                self._workers.go()
        else:
            for effect in effects:
                methods[type(effect)](effect)
        self._registrar.consumers.flush()
        if self._dirty:
            dirty, self._dirty = self._dirty, {}
            for link in dirty.values():
                link.flush()

    def by_thread(self, effects: Sequence[Effect]) -> Callable[[], None] | None:
        """What does them in any thread; None: they need the loop. From any thread, with the lock.

        That is the answer to one direct line, which has no order with anything else. What watchers hear comes
        before the answer, so it is the loop that answers while there are any.
        """
        answer: e.Reply | None = None
        for effect in effects:
            if type(effect) is e.Reply and answer is None:
                answer = effect
            elif type(effect) is not e.Happened or self._registrar.node.watched:
                return None
        return _nothing if answer is None else self._registrar.consumers.by_line(answer.message)

    def close(self) -> None:
        """Let nothing fire any more."""
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
            return  # decided for a link before this one: when this is reconciled, what is open is sent again
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
            self._registrar.post(c.StatusDone(effect.resource.id, effect.notice, effect.provider, handled=False))
        else:
            server.start_status(effect.resource, effect.notice, effect.provider, repeated=effect.repeated)

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

    # -- who waits and who listens -------------------------------------------------------------------------------

    def _load_resolved(self, effect: e.LoadResolved) -> None:
        held = effect.held
        if effect.failure is not None:
            self._forget(held.id)
        waiter = self._registrar.loads.pop(held.id, None)
        if waiter is not None:
            waiter(held, None if effect.failure is None else error_of(effect.failure))

    def _unload_resolved(self, effect: e.UnloadResolved) -> None:
        held = self._registrar.catalog.held.get(effect.query_id)
        if effect.failure is None or (held is not None and held.hold is OWED):  # else it is held, or will be again
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
    """What is done where nothing is to be done."""
