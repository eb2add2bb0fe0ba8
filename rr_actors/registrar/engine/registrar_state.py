"""RegistrarState: what one registrar knows, and the lock of whoever reads or changes it.

A registrar is a monitor. Whoever brings a message decides it under the lock: decide, apply to memory, commit. Then the
lock is given back, and what the decision causes is done. No callback of a user's, no pickling and no write to a socket
happens under the lock. A thread that has it never waits, and never takes another registrar's.

    with state.enter():
        catalog = state.whole()
        ...

A thread may be interrupted (Ctrl-C) between any two instructions. A batch that was interrupted is rolled back by the
next thread that has the lock, before that reads anything: so all begin with whole().
"""

from __future__ import annotations

import threading
from asyncio import AbstractEventLoop
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, RegistrarDown, RrError
from rr_actors.registrar.core import holding
from rr_actors.registrar.core.loading import join
from rr_actors.registrar.engine.commit_log import Ledger
from rr_actors.registrar.model.catalog import ABSENT, Catalog
from rr_actors.registrar.model.commands import Got
from rr_actors.registrar.model.messages import Load, Loaded
from rr_actors.registrar.model.transaction import Batch
from rr_actors.runtime import interpreter
from rr_actors.runtime.workers import Workers
from rr_actors.storage.store import Store

UnloadWaiter = Callable[[RrError | None], None]


def answered_by_line(_error: RrError | None) -> None:
    """How an unload ended that a thread does by a line of its own: it hears there."""


class RegistrarState:
    """The catalog of one registrar, in memory and on disk.

    Args:
        store: its catalog's storage, open.

    Attributes:
        lock: of whoever decides, or reads more than one entry. Taken by enter().
        is_inside: whether the calling thread has the lock: a finalizer that the garbage collector runs may find it so.
        closed: nothing is decided any more.
        waiting: what has come in and is not decided yet (monitor.py). What a thread brings waits behind it.
        row_by_row: whether what is decided by itself is written by itself.
        unloads: who hears how a release ended, by query.
    """

    def __init__(
        self, name: str, config: RegistrarConfig, store: Store, loop: AbstractEventLoop, workers: Workers
    ) -> None:
        self.name = name
        self.config = config
        self.lock = threading.RLock()
        self.is_inside: Callable[[], bool] = self.lock._is_owned  # type: ignore[attr-defined]  # as in threading
        self._ledger = Ledger(name, config, store, loop, workers, self.lock)
        self.catalog = Catalog(name, self._ledger.content(), store.epoch)
        self.epoch = store.epoch
        self.row_by_row = self._ledger.row_by_row
        self.waiting: deque[tuple[Any, str | None]] = deque()
        self.unloads: dict[str, UnloadWaiter] = {}
        self.closed = False
        self._why_down = "closed"

    def enter(self) -> AbstractContextManager[object]:
        """Return the lock, for a `with` statement.

        Raises:
            RegistrarDown: closed, or this process is a fork of the registrar's: there, nobody might give the lock back.
        """
        if self.closed:
            raise self.down()
        return self.lock

    def whole(self) -> Catalog:
        """Return the catalog between two batches. With the lock."""
        catalog = self.catalog
        if catalog.unfinished is not None:
            self._roll_back(catalog)
        return catalog

    def commit(self, work: Callable[..., object], *args: Any) -> Batch:
        """Have work(batch, *args) decide, and write what it has changed, or note it to be written a moment later.

        Raises:
            CatalogError: not written; nothing has happened, and nobody has seen any of it.
        """
        with self.lock:
            batch = Batch(self.whole())
            try:
                work(batch, *args)
                self._ledger.commit(batch)
                batch.close()
            except CatalogError:
                batch.undo()
                raise
            except BaseException:  # an interrupt, or a defect: at any instruction
                self.whole()
                raise
            return batch

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
                if not self._ledger.commit_row(query):
                    catalog.unfinished = None
                    return None
                catalog.set("queries", query.id, query)
                catalog.unfinished = None
            except Exception:  # as the batch will find, and say: a full disk, or a defect
                catalog.unfinished = None
                return None
            except BaseException:
                self.whole()
                raise
            resource = catalog.resources[query.resource_id]
            return Loaded(query.id, resource.id, resource.response or b"")

    # -- fast paths of the thread that loads and lets go by a line of its own ----------------------------------------

    def hold(self, got: Got) -> bool:
        """Take up what a thread has loaded; False: it is to be decided as any command."""
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            if self.waiting:
                return False
            try:
                held = holding.hold(catalog, self._ledger.unsaved, got)
                if held and not self._ledger.saving:
                    self._ledger.save_soon()
            except BaseException:
                self.whole()
                raise
            return held

    def owe(self, query_id: str) -> bool:
        """Have a query owed that a thread lets go by a line of its own; False: it is to be decided as any command.

        On disk, unless nothing of it is: after a crash its provider says what became of it. After True the thread must
        tell the provider, and then give the answer to let_go(), or leave it to the registrar's actor.
        """
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            if self.waiting or self.closed or query_id in self.unloads:
                return False
            catalog = self.whole()
            row = holding.owed(catalog, query_id)
            if row is None:
                return False
            try:
                if not holding.owe(catalog, self._ledger.unsaved, row, self._ledger.commit_row):
                    return False
            except CatalogError:  # as the batch will find, and say
                return False
            except BaseException:
                self.whole()
                raise
            self.unloads[query_id] = answered_by_line
            return True

    def let_go(self, query_id: str) -> bool:
        """Forget a query that its provider has let go; False: that is to be decided as any message."""
        if self.closed or interpreter.possible():
            return False
        with self.lock:
            if self.waiting:
                return False
            catalog = self.whole()
            try:
                gone = holding.let_go(catalog, self._ledger.unsaved, query_id)
                if gone:
                    self.unloads.pop(query_id, None)
                    if not self._ledger.saving:
                        self._ledger.save_soon()
            except BaseException:
                self.whole()
                raise
            return gone

    def _roll_back(self, catalog: Catalog) -> None:
        self._ledger.restore(catalog)
        catalog.unfinished = None

    def down(self) -> RegistrarDown:
        """The error for whoever wants something of it when it is closed."""
        return RegistrarDown(f"registrar {self.name!r}: {self._why_down}", registrar=self.name, status="stopped")
