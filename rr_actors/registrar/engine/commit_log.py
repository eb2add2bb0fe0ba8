"""The disk: which changes of a registrar's catalog are on it, and which are still to be written."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from asyncio import AbstractEventLoop, TimerHandle
from collections.abc import Callable, Sequence
from typing import Any

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogError, Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.hosting.run_files import Watched
from rr_actors.registrar.model.catalog import Catalog, Decision, Unsaved
from rr_actors.registrar.model.rows import PENDING, Change, Content, Drop, Held, Put, Row
from rr_actors.registrar.model.store import Store
from rr_actors.runtime.interpreter import HURRIED_S, turns
from rr_actors.runtime.thread_rules import on_loop, with_lock
from rr_actors.runtime.workers import Workers

logger = Log("rr_actors.registrar")

_RETRY_S = 0.25
_SAVE_SOON_S = 0.05
_TIDY_SOON_S = 0.1  # after the last commit
_TIDY_AT_LAST_S = 2.0  # after the first
_TIDY_AGAIN_S = 1.0
_SAY_AGAIN_S = 1.0  # twice as long after each line about one failure,
_SAY_AT_LEAST_S = 60.0  # up to this


class _Activity:
    """The number of commits of all registrars of this process, roughly: they count without a common lock."""

    commits = 0


_activity = _Activity()


class _Repeated:
    """Says when a failure that is tried again and again is to be logged: at once, then more and more rarely."""

    def __init__(self) -> None:
        self._after_s = 0.0
        self._next = 0.0

    def is_due(self, now: float) -> bool:
        """Return whether to log a failure at the time `now`."""
        if self._after_s and now < self._next:
            return False
        self._after_s = min(2 * self._after_s or _SAY_AGAIN_S, _SAY_AT_LEAST_S)
        self._next = now + self._after_s
        return True

    def is_over(self) -> bool:
        """Note that there was no failure this time; return whether there had been one."""
        was, self._after_s = self._after_s, 0.0
        return was > 0


class CommitLog:
    """Commits decisions to the store: changes that must survive a crash now, others a moment later.

    With save_on_modify off, all changes are written once each save interval, and at closing. Any thread may commit,
    with the lock.

    Args:
        lock: the registrar's. A thread holds it from the beginning of a decision to the end of commit().

    Attributes:
        store: where the catalog is on disk.
        unsaved: the changes that wait to be written; saving: whether a timer to write them is set.
        row_by_row: whether a row is committed by itself: now, and without waiting for the disk.
        watched: who watches the system: during a recording, commits are timed.
        count: the number of commits; `timed`: how many of them were timed, and `timed_s` the seconds that those took.
    """

    def __init__(
        self,
        name: str,
        config: RegistrarConfig,
        store: Store,
        loop: AbstractEventLoop,
        workers: Workers,
        lock: threading.RLock,
    ) -> None:
        self.lock = lock
        self._name = name
        self.store = store
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
        self.watched: Watched | None = None
        self._closed = False
        self._not_tidied = _Repeated()
        self._not_saved = _Repeated()

    def content(self) -> Content:
        """Return the rows on disk. Write unsaved changes first; with save_on_modify off, forget them instead.

        Raises:
            CatalogError: the unsaved changes could not be written, and are kept; or the rows could not be read.
        """
        if self._at_once:
            self._save()
        self.unsaved.clear()
        return self.store.load()

    @with_lock
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

    @with_lock
    def commit_row(self, row: Row) -> bool:
        """Write one row now, or return False: decide() has to write it, or reports why that fails."""
        if not self.row_by_row:
            return False
        try:
            self._write([Put(row)])
        except CatalogError:
            return False
        self.unsaved.row_written(row)
        return True

    @with_lock
    def restore(self, catalog: Catalog) -> None:
        """Roll back a decision that was interrupted.

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
        self.store.tidy()

    def _save(self) -> None:
        with self.lock:
            if changes := self.unsaved.changes():
                self._write(changes)
                self.unsaved.clear()

    @with_lock
    def _write(self, changes: Sequence[Change]) -> None:
        began = time.perf_counter() if self.watched is not None and self.watched.level[0] > 1 else 0.0
        if turns.hurried_s:
            self._write_hurried(changes)
        else:
            self.store.commit(changes)
        if began:
            self.timed_s += time.perf_counter() - began
            self.timed += 1
        self.count += 1
        _activity.commits += 1
        if not self._tidying and self.store.wants_tidying():
            self._tidying = True
            self._on_loop(self._tidy_when_quiet)

    @with_lock
    def _write_hurried(self, changes: Sequence[Change]) -> None:
        """Write changes, which releases Python's lock for a moment, and get the lock back soon."""
        interval_s = sys.getswitchinterval()
        if interval_s != turns.hurried_s:  # otherwise another thread commits, too
            turns.interval_s = interval_s
        try:
            sys.setswitchinterval(HURRIED_S)
            self.store.commit(changes)
        finally:
            sys.setswitchinterval(turns.interval_s)

    @with_lock
    def save_soon(self) -> None:
        """Have the unsaved changes written a moment later."""
        if not self.saving:
            self.saving = True
            self._on_loop(self._save_after, self._delay_s)

    def _on_loop(self, fn: Callable[..., object], *args: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended: close() writes the unsaved changes
            self._loop.call_soon_threadsafe(fn, *args)

    # -- on the loop -------------------------------------------------------------------------------------------------

    @on_loop
    def _tidy_when_quiet(self) -> None:
        """Tidy the store after a pause in the commits of this process: no thread then waits for the processor.

        A registrar of a chain makes one commit, and is quiet while the registrars behind it load.
        """
        self._look(self._loop.time() + _TIDY_AT_LAST_S)

    @on_loop
    def _look(self, at_last: float, commits: int = -1) -> None:
        if self._closed:
            return
        if commits == _activity.commits or self._loop.time() >= at_last:
            with contextlib.suppress(Unavailable):  # the process is stopping, and soon closes this registrar
                self._workers.submit(self.store.upkeep, done=self._tidied, patient=True)
        else:
            self._loop.call_later(_TIDY_SOON_S, self._look, at_last, _activity.commits)

    @on_loop
    def _tidied(self, _result: None, error: BaseException | None) -> None:
        self._tidying = False
        if error is None and self._not_tidied.is_over():
            logger.info("%s: its SQLite file takes changes again", self._name)
        elif error is not None and self._not_tidied.is_due(self._loop.time()):
            logger.warning("%s: %s; tried again each second", self._name, error)
        if not self._closed and self.store.wants_tidying():
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
                    self.store.close(erase=erase)
            except CatalogError:
                logger.exception("%s: its catalog could not be closed, or removed", self._name)

    @on_loop
    def _save_after(self, delay_s: float) -> None:
        if not self._closed:
            self._save_timer = self._loop.call_later(delay_s, self._save_now)

    @on_loop
    def _save_now(self) -> None:
        self.saving = False  # first: a change from now on needs another save
        try:
            self._save()
        except CatalogError as error:
            if self._not_saved.is_due(self._loop.time()):
                logger.error("%s: %s; tried again several times a second", self._name, error)
            self.saving = True
            self._save_after(_RETRY_S)
        else:
            if self._not_saved.is_over():
                logger.info("%s: its changes are written again", self._name)
