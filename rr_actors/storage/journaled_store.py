"""JournaledStore: commits go to a journal, and from there, many together and in another thread, to the SQLite file.

A commit of SQLite's own is six locks and two or three writes; in a journal it is one write, as safe from SIGKILL. What
is put and dropped again meanwhile never gets into a table.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path

from rr_actors.base.errors import CatalogError
from rr_actors.base.scarcity import wanted_by
from rr_actors.registrar.model.rows import Change, Content, apply
from rr_actors.storage.image import Image, Mark
from rr_actors.storage.journal import End, Owner, Segment
from rr_actors.storage.sql_tables import net_of
from rr_actors.storage.sqlite_store import SqliteStore

_AT_MOST = 100_000  # changes in the journal: another thread is too slow in folding them

_log = logging.getLogger(__name__)


class JournaledStore:
    """A Store (store.py) that survives SIGKILL; made by `open_store` (opening.py). Commits from any thread.

    `tidy` brings the SQLite file up to date with the commits before it.
    """

    def __init__(self, tables: SqliteStore, image: Image) -> None:
        self._tables = tables
        self._image = image
        self._lock = threading.Lock()  # of what follows
        self._segment: Segment | None = None  # the one that is written, once there is something to write
        self._number = tables.folded
        self._end = End()  # of the segment before
        self._pending: list[Change] = []  # which are not in the tables
        self._closed = False
        self._tidying = threading.Lock()  # of the tables and their image, and:
        self._full: list[Segment] = []  # in which some of what is pending is

    @property
    def path(self) -> Path:
        """The catalog's SQLite file."""
        return self._tables.path

    @property
    def epoch(self) -> int:
        """How often this catalog has been opened, this time included."""
        return self._tables.epoch

    def load(self) -> Content:
        """Return every row; the caller may keep what it gets, and change it.

        Raises:
            CatalogDamaged: a row cannot be read.
        """
        with self._tidying:
            content = self._tables.load()
            with self._lock:
                changes = list(self._pending)
            apply(content, changes)
            return content

    def commit(self, changes: Sequence[Change]) -> None:
        """Write all changes in their order, atomically.

        Raises:
            CatalogError: it could not be written (disk full, I/O error), or too much waits in the journal that cannot
                be written to the SQLite file; nothing was.
            OverflowError: a number in it, or a row, is too large for SQLite; nothing was written.
            UnicodeEncodeError: a text in it has no UTF-8; nothing was written.
        """
        if not changes:
            return
        if len(self._pending) > _AT_MOST:
            self.tidy()
        with self._lock:
            try:
                if self._segment is None:
                    self._segment = self._new_segment()
                self._segment.append(changes)
            except OSError as error:
                wanted = wanted_by(error)
                advice = wanted or "Repair the disk"
                raise CatalogError(
                    f"{self.path}: expected to write {len(changes)} change(s) to its journal, got: {error.strerror};"
                    f" none of them is written. {advice}; then try again",
                    path=str(self.path),
                ) from error
            self._pending += changes

    def wants_tidying(self) -> bool:
        """Whether anything is in the journal alone."""
        return bool(self._pending)

    def tidy(self) -> None:
        """Fold what is in the journal into the SQLite file, and keep that one's -wal small. Nothing, once it is closed.

        Raises:
            CatalogError: it could not be done; it stays in the journal.
        """
        with self._tidying:
            if self._closed:
                return
            self._tables.keep_lock()
            self._fold()
            self._image.keep(self._tables)
            if self._tables.wants_tidying():
                self._tables.tidy()

    def close(self, *, erase: bool = False) -> None:
        """Release the lock; with `erase`, remove the catalog from disk as well.

        What cannot be folded in now is taken up at the next opening.

        Raises:
            CatalogError: it could not be removed; it is as it was, or gone but for files that do not matter.
        """
        with self._tidying:
            try:
                self._fold()
            except CatalogError as error:
                if not erase:
                    _log.warning("%s", error)
            finally:
                with self._lock:
                    segment, self._segment = self._segment, None
                    self._closed = True
                if segment is not None:  # nothing is in it, or it would be full
                    segment.remove()
                if erase:
                    self._image.remove()
                self._tables.close(erase=erase, settled=not self._pending)

    def _new_segment(self) -> Segment:
        if self._closed:
            raise CatalogError(f"{self.path}: expected an open catalog, got one that is closed", path=str(self.path))
        owner = Owner(self._tables.id, self._tables.epoch)
        segment = Segment(self._tables.folder, self.path, owner, self._number + 1, self._end)
        self._number += 1
        self._tables.note(self._number)
        return segment

    def _fold(self) -> None:
        changes: list[Change] = []
        try:
            with self._lock:
                self._end_segment()
                changes, self._pending = self._pending, []
            if changes:
                net, number = net_of(changes), self._full[-1].number
                self._image.add(net, Mark(self._tables.meta.opening, number))
                self._tables.fold(net, number)
        except BaseException:  # KeyboardInterrupt, too: a thread that commits too much folds for itself
            with self._lock:
                self._pending = changes + self._pending
            raise
        full, self._full = self._full, []
        for segment in full:
            segment.remove()

    def _end_segment(self) -> None:
        segment = self._segment
        if segment is not None and segment.end.records:
            self._end = segment.end
            self._full.append(segment)
            self._segment = None
            segment.close()
