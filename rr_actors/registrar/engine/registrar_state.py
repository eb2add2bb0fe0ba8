"""The catalog of one registrar, in memory and on disk, and the decisions of senders that take the registrar's turn.

The lock of the actor (actors/turns.py) guards the catalog.

    with state.enter():
        catalog = state.whole()
        ...

An interrupt (Ctrl-C) may stop a thread between any two instructions, and so may a defect. The next thread that takes
the lock rolls the unfinished decision back before it reads anything. Therefore every use of the catalog begins with
whole().
"""

from __future__ import annotations

import itertools
import threading
from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Protocol

from rr_actors.actors.turns import TurnActor, may_be_interrupted
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, RegistrarDown, RrError
from rr_actors.hosting.run_files import DECISIONS, Watched
from rr_actors.registrar.core import holding
from rr_actors.registrar.core.callback_runs import is_unwanted
from rr_actors.registrar.core.decide import Item, decide
from rr_actors.registrar.core.loads.loading import join
from rr_actors.registrar.core.unloading import leave
from rr_actors.registrar.decisions.decision_notes import DecisionNotes, Send
from rr_actors.registrar.engine.commit_log import CommitLog
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.catalog import ABSENT, Catalog, Decision, loaded
from rr_actors.registrar.model.messages import NO_LIMIT, Load, Loaded, Unload, Unloaded
from rr_actors.registrar.model.rows import LOADING, OK, PENDING, Drop, Held, Phase, Put, Resource
from rr_actors.registrar.model.store import Store
from rr_actors.runtime.thread_rules import with_lock
from rr_actors.runtime.workers import Workers

LoadWaiter = Callable[[Held | None, RrError | None], None]
UnloadWaiter = Callable[[RrError | None], None]


def answered_by_line(_error: RrError | None) -> None:
    """Do nothing: this waiter marks an unload whose thread reads the answer on its own direct line."""


class StopEvent(threading.Event):
    """Says that nobody needs the result of a run of a callback any more.

    `cancel`: called when it is set. `is_told`: whether the registrar has set it. User code may set it, too: to end its
    own run, and not because the result is not needed.
    """

    cancel: Callable[[], object] | None = None
    is_told = False

    def tell(self) -> None:
        """Say so for the registrar."""
        self.is_told = True
        self.set()

    def set(self) -> None:
        """Say so."""
        super().set()
        if self.cancel is not None:
            self.cancel()


class AskedHere(Protocol):
    """The query that a thread is about to load."""

    @property
    def id(self) -> str: ...
    @property
    def registrar(self) -> str: ...
    @property
    def server(self) -> str: ...
    @property
    def parent(self) -> str: ...


class RegistrarState(TurnActor):
    """The catalog of one registrar, in memory and on disk.

    Attributes:
        lock: the turn, held by the thread that decides, or that reads more than one entry. enter() returns it.
        commits: the disk, and which changes are still to be written.
        sequence: the running numbers of queries, in the order in which they are asked for. Releases go newest first.
        loads, unloads: by query, the callback that hears how its load, or its release, ended.
        stops: by resource, phase and attempt of a callback that runs, the event that tells it to stop.
        watched: who watches the system. While a recording wants decisions, all go by commit(), which notes them.
        notes: the notes of them.
    """

    taken_by_senders = True

    def __init__(
        self,
        name: str,
        config: RegistrarConfig,
        store: Store,
        loop: AbstractEventLoop,
        workers: Workers,
        watched: Watched,
        send_note: Send,
    ) -> None:
        self.watched = watched
        self.notes = DecisionNotes(name, send_note)
        self.name = name
        self.config = config
        self.commits = CommitLog(name, config, store, loop, workers, self.lock)
        self.epoch = store.epoch
        self.catalog = self.stored_catalog()
        self.sequence = itertools.count(self.catalog.since + 1)
        self.loads: dict[str, LoadWaiter] = {}
        self.unloads: dict[str, UnloadWaiter] = {}
        self._stops: dict[str, dict[tuple[Phase, int], StopEvent]] = {}  # of runs of callbacks, by resource
        self._loads_over: dict[str, threading.Event] = {}  # set when a load is over, by resource
        self._why_down = "closed"

    def stored_catalog(self) -> Catalog:
        """Return the catalog that is on disk.

        Raises:
            CatalogError: it cannot be read, or unsaved changes could not be written before.
        """
        catalog = Catalog(self.name, self.commits.content(), self.epoch)
        catalog.max_priority = self.config.max_priority
        return catalog

    def enter(self) -> AbstractContextManager[object]:
        """Return the lock, for a `with` statement.

        Raises:
            RegistrarDown: the registrar is closed, or this process is a fork of the registrar's process: there the
                thread that had the lock does not exist, so nobody would release it.
        """
        if self.closed:
            raise self.down()
        return self.lock

    @with_lock
    def whole(self) -> Catalog:
        """Return the catalog, and roll back a decision that an interrupt left unfinished."""
        catalog = self.catalog
        if catalog.unfinished is not None:
            self.commits.restore(catalog)
            self.notes.doubt()
            catalog.unfinished = None
        return catalog

    def commit(self, items: Iterable[Item]) -> Decision:
        """Decide the items in their order, and write the changes now, or note them to be written a moment later.

        Raises:
            CatalogError: the changes were not written. Nothing has happened, and no other thread has seen any of it.
        """
        with self.lock:
            noted = self.watched.level[0] >= DECISIONS
            if noted:
                items = self.notes.begin(self.whole(), items, self.watched.level[0])
            try:
                decision = decide(self.whole(), items)
            except Exception as error:
                if noted:
                    self.notes.raised(error)
                raise
            try:
                self.commits.commit(decision)
            except CatalogError as error:
                if noted:
                    self.notes.undone(decision, error)
                decision.undo()
                raise
            decision.close()
            if noted:
                self.notes.committed(decision)
            if self._stops:
                self._stop_unwanted(decision)
            if self._loads_over:
                self._say_loads_over()
            self.catalog.deserted.clear()
            return decision

    def stop_event(
        self, resource_id: str, phase: Phase, attempt: int, cancel: Callable[[], object] | None = None
    ) -> threading.Event:
        """Return the event that is set when nobody needs this run of a callback any more, or the registrar is closed.

        It is the same one as long as the callback runs.

        Args:
            cancel: called when it is set, with the lock; at once if it is set already.
        """
        with self.lock:
            stop = self._stops.setdefault(resource_id, {}).setdefault((phase, attempt), StopEvent())
            stop.cancel = cancel or stop.cancel
            catalog = self.whole()
            unwanted = self.closed or is_unwanted(catalog, resource_id, phase, attempt)
            if unwanted:
                stop.tell()
            resource = catalog.resources.get(resource_id)
            if unwanted is None or resource is None or resource.attempt != attempt:  # it cannot be needed again
                self.end_run(resource_id, phase, attempt)
            return stop

    def end_run(self, resource_id: str, phase: Phase, attempt: int) -> bool | None:
        """Forget the event of a run that ends. If it was told, return whether somebody needs the result again."""
        if resource_id not in self._stops:
            return None
        with self.lock:
            runs = self._stops.get(resource_id, {})
            stop = runs.pop((phase, attempt), None)
            if not runs:
                self._stops.pop(resource_id, None)
            if stop is None or not stop.is_told:
                return None
            return not self.closed and is_unwanted(self.whole(), resource_id, phase, attempt) is False

    @with_lock
    def _stop_unwanted(self, decision: Decision) -> None:
        catalog = self.whole()
        rows = [change.row for change in decision.changes if type(change) is Put]
        gone = [change.id for change in decision.changes if type(change) is Drop and change.table == "resources"]
        for id in (*(row.id for row in rows if type(row) is Resource), *gone, *catalog.deserted):
            for (phase, attempt), stop in self._stops.get(id, {}).items():
                if not stop.is_told and is_unwanted(catalog, id, phase, attempt):
                    stop.tell()

    def load_over(self, resource_id: str) -> threading.Event:
        """Return the event that is set when the load of a resource is over, or the registrar is closed."""
        with self.lock:
            event = self._loads_over.setdefault(resource_id, threading.Event())
            self._say_loads_over()
            return event

    @with_lock
    def _say_loads_over(self) -> None:
        catalog = self.whole()
        for id in list(self._loads_over):
            resource = catalog.resources.get(id)
            loads = resource is not None and (resource.phase is LOADING or id in catalog.recovering)
            if self.closed or not loads:
                self._loads_over.pop(id).set()

    def stop_callbacks(self) -> None:
        """Tell all callbacks to stop that have asked for their event, and those who wait for the end of a load."""
        with self.lock:
            for event in self._loads_over.values():
                event.set()
            self._loads_over.clear()
            for runs in self._stops.values():
                for stop in runs.values():
                    stop.tell()
            self._stops.clear()

    def held_at(self, provider: str) -> list[Held] | None:
        """Return the rows held at a provider; None while messages wait that could change them."""
        with self.lock:
            return None if self.waiting else digests.held_at(self.whole(), provider)

    def down(self) -> RegistrarDown:
        """Return the error that callers of a closed registrar get."""
        return RegistrarDown(f"registrar {self.name!r}: {self._why_down}", registrar=self.name, status="stopped")

    # -- decisions about one row: the sender takes the turn ------------------------------------------------------------

    def join(self, load: Load) -> Loaded | None:
        """Decide a Load by the fast path, and write its row. Return None if it has to be decided like any message.

        The loop calls it, and a thread of this process that loads.
        """
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            query = None if self.waiting or self.watched.level[0] >= DECISIONS else join(catalog, load)
            if query is None:
                return None
            try:
                catalog.unfinished = [("queries", query.id, ABSENT)]
                written = self.commits.commit_row(query)
                if written:
                    catalog.set("queries", query.id, query)
                    catalog.joined[load.server] = catalog.joined.get(load.server, 0) + 1
                catalog.unfinished = None
            except Exception:  # a defect: decide() will meet it again, and report it
                return None
            if not written:
                return None
            return loaded(catalog, query.id, catalog.resources[query.resource_id])

    def leave(self, unload: Unload) -> Unloaded | None:
        """Decide an Unload of a resource that others hold, too. Return None if the loop has to decide it.

        A thread of this process calls it. If it is interrupted behind the commit, the query is released, and the thread
        does not get the answer.
        """
        with self.lock:
            if self.waiting or self.closed or not leave(self.whole(), unload):
                return None
            try:
                self.commit(((unload, unload.origin),))
            except Exception:  # a full disk, or a defect: the loop will meet it again, and report it
                return None
            return Unloaded(unload.query_id)

    def begin_directly(
        self, query: AskedHere, request: bytes, ended: LoadWaiter, priority: int = 0, own: bool = False
    ) -> Load | None:
        """Note a load that the calling thread is about to send; return None if the loop has to send or refuse it.

        If the load ends by another way than the thread's, `ended` hears how. `own`: the caller gave a priority.
        """
        id, registrar, server, parent = query.id, query.registrar, query.server, query.parent
        attempt, seq = 0, next(self.sequence)
        if self.catalog.shut or self.watched.level[0] >= DECISIONS:
            return None
        if not parent:
            self.loads[id] = ended  # without the lock: the id is new, and each dict takes it in one step
            asked = Held(id, registrar, server, request, None, "", "", 0, seq, PENDING, OK, priority, own)
            self.catalog.in_flight[id] = asked
        elif may_be_interrupted():
            return None
        else:
            with self.enter():
                resource = self.whole().resources.get(parent)
                if resource is None:
                    return None
                attempt = resource.attempt
                if not own:
                    priority = self.catalog.inherited(parent)
                self.loads[id] = ended
                asked = Held(id, registrar, server, request, None, "", parent, attempt, seq, PENDING, OK, priority, own)
                self.catalog.in_flight[id] = asked
        wait_ms = self.catalog.wait_limits.get(id, NO_LIMIT)
        return Load(id, server, request, self.name, parent, attempt, seq, priority, own, wait_ms)

    def hold(self, answer: Loaded | c.Got) -> bool:
        """Add the row of a query that a thread has loaded. Return False if the answer has to be decided, as Got."""
        if self.closed or may_be_interrupted():
            return False
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            if self.waiting or self.watched.level[0] >= DECISIONS:
                return False
            held = holding.hold(catalog, self.commits.unsaved, answer)
            if held:
                self.loads.pop(answer.query_id, None)
                if not self.commits.saving:
                    self.commits.save_soon()
            return held

    def forget_refused(self, query_id: str) -> bool:
        """Forget a load that was refused to its thread. Return False if the loop may know of it, and has to end it."""
        if may_be_interrupted():
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
        if self.closed or may_be_interrupted():
            return False
        with self.lock:
            if self.waiting or self.closed or query_id in self.unloads or self.watched.level[0] >= DECISIONS:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            is_owed = holding.owe(catalog, self.commits.unsaved, query_id, self.commits.commit_row)
            if is_owed:
                self.unloads[query_id] = answered_by_line
            return is_owed

    def forget_released(self, query_id: str) -> bool:
        """Forget a query that its provider has released after owe(); return False if Unloaded has to be decided."""
        if self.closed:
            return False
        with self.lock:
            if self.waiting or self.watched.level[0] >= DECISIONS:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            gone = holding.forget_released(catalog, self.commits.unsaved, query_id)
            if gone:
                self.unloads.pop(query_id, None)
                if not self.commits.saving:
                    self.commits.save_soon()
            return gone
