"""Ledger: what of a registrar's catalog is on disk, and what is still to be written."""

from __future__ import annotations

import contextlib
import logging
from asyncio import AbstractEventLoop, TimerHandle
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, Unavailable
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import Change, Content, Drop, Held, Hold, Put, Row
from rr_actors.registrar.model.transaction import Batch
from rr_actors.registrar.model.unsaved import Unsaved
from rr_actors.runtime import interpreter
from rr_actors.runtime.workers import Workers
from rr_actors.storage.store import Store

logger = logging.getLogger("rr_actors.registrar")

_SAVE_SOON_S = 0.05
_TIDY_SOON_S = 0.1  # after the last commit
_TIDY_AT_LAST_S = 2.0  # after the first
_TIDY_AGAIN_S = 1.0
_RETRY_S = 0.25


class Ledger:
    """Commits batches to the store: at once what must be there, a moment later what could be rebuilt.

    With save_on_modify off everything is written each save interval, and at closing. Commits are made by any thread,
    with the lock.

    Attributes:
        unsaved: what waits to be written; saving: whether it will be a moment later.
        row_by_row: whether what is decided by itself is written by itself: now, and without waiting for the disk.
        lock: the registrar's. It is held around a batch, from its beginning to commit().
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
        self._commits = 0
        self._closed = False

    def content(self) -> Content:
        """What is on disk: everything, or with save_on_modify off what was saved; the rest is forgotten.

        Raises:
            CatalogError: what may be written a moment later was not; nothing is forgotten.
        """
        if self._at_once:
            self._save()
        self.unsaved.forget()
        return self._store.load()

    def commit(self, batch: Batch) -> None:
        """Write a batch's changes, or note them for later; older ones that wait are written before.

        Raises:
            CatalogError: nothing was written.
        """
        if batch.changes and self._at_once:
            unsaved, later = self.unsaved, batch.later.values()
            if unsaved.some or later:
                self._write([*unsaved.some.values(), *batch.changes, *later])
                unsaved.all_written()
                unsaved.written(later)
            else:
                self._write(batch.changes)
            if unsaved.new:
                unsaved.written(batch.changes)
        elif batch.changes or batch.later:
            self.unsaved.add(batch.changes)
            self.unsaved.add(batch.later.values())
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
        """Roll back a batch that was interrupted. From any thread, with the lock.

        It may have been written, or not: the rows that it began to change are written as they were, a moment later.
        """
        for table, id in catalog.roll_back():
            row = catalog.tables[table].get(id)
            if row is None and table == "held" and id in self.unsaved.new:
                self.unsaved.drop(id)
                continue
            pending = type(row) is Held and row.hold is Hold.PENDING  # never on disk
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
            if self.unsaved.some:
                self._write(list(self.unsaved.some.values()))
                self.unsaved.all_written()

    def _write(self, changes: Sequence[Change]) -> None:
        interpreter.hurried(self._store.commit, changes)
        self._commits += 1
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
        """What comes and goes meanwhile needs no tidying, and whoever waits for a commit has the processor."""
        self._look(self._loop.time() + _TIDY_AT_LAST_S)

    def _look(self, at_last: float, commits: int = -1) -> None:
        if self._closed:
            return
        if commits == self._commits or self._loop.time() >= at_last:
            with contextlib.suppress(Unavailable):  # the process is closing, and this soon after it
                self._workers.submit(self._store.tidy, done=self._tidied, patient=True)
        else:
            self._tidy_timer = self._loop.call_later(_TIDY_SOON_S, self._look, at_last, self._commits)

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
