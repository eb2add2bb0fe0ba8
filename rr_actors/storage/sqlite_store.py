"""SqliteStore: a catalog in one SQLite file, in WAL mode, that any SQLite tool can read, also while it is open.

`application_id` says that the file is a catalog, `user_version` of which schema (sql_tables.py). Beside it are SQLite's
-wal and -shm while it is open, and its lock (catalog_lock.py).

A catalog that is there has been read before (opening.py).
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import sqlite3
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from rr_actors.base.errors import CatalogError, CatalogVersion
from rr_actors.base.folder import Folder
from rr_actors.registrar.model.rows import Change, Content, content_of
from rr_actors.storage import sql_tables
from rr_actors.storage.catalog_lock import CatalogLock, Reached
from rr_actors.storage.checked_records import Damage, damaged, errors_named
from rr_actors.storage.witness import Known, Witness

APPLICATION_ID = 0x52524143  # "RRAC"

_CACHE_KIB = 16 * 1024  # at most; holds the pages that 100,000 queries are spread over
_WAL_LIMIT_BYTES = 4 * 2**20  # what a huge commit leaves of the -wal after the next checkpoint
_SPARE_BYTES = 2**20  # of pages without rows, that the file may have beside as many as there are with rows
_TIDY_PAGES = 128  # written, about, after which another thread copies the -wal to the file; at 1000 a commit does it
_EACH_A_PAGE = 4  # so many changes that are committed together are on pages of their own
_SOME_A_PAGE = 8  # of more
_SHRINK = "VACUUM"
_BUSY_S = 1.0  # for a tool that has the file open; a process of this package never waits for another

_log = logging.getLogger(__name__)


class SqliteStore:
    """A Store (store.py) on one SQLite file; made by `open_store` (opening.py). Usable from any thread, one at a time.

    Args:
        folder, path: the catalog's directory, which is closed with this, and the file there, which is good.
        lock: held; it is released when this is closed.
        durability: "power": each commit waits for the disk.
        meta, changes: committed at once.
        content: what the file has then.
        witness: who notes outside of the directory that there is this catalog.

    Attributes:
        folder, path: as given.
        meta: what the catalog says of itself, as it is in the file.

    Raises:
        sqlite3.Error: it could not be written; the lock is still held.
    """

    def __init__(
        self,
        folder: Folder,
        path: Path,
        lock: CatalogLock,
        durability: Literal["process", "power"],
        meta: sql_tables.Meta,
        changes: sql_tables.Net,
        content: Content,
        witness: Witness | None = None,
    ) -> None:
        self.folder = folder
        self.path = path
        self.meta = meta
        self.epoch = meta.epoch
        self._witness = witness
        self._has_journal = durability != "power"
        self._lock = lock
        self._writing = threading.Lock()
        self._connection = sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        self._cursor = self._connection.cursor()
        try:
            self._cursor.execute(f"PRAGMA synchronous = {'FULL' if durability == 'power' else 'NORMAL'}")
            self._cursor.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            self._cursor.execute(f"PRAGMA journal_size_limit = {_WAL_LIMIT_BYTES}")
            self._write(changes, meta)
        except BaseException:
            self._cursor.close()
            self._connection.close()
            raise
        self.note(meta.folded)
        if witness is not None:
            witness.note(Known(meta.id, meta.epoch, str(path)))
        self._content: Content | None = content  # as read when it was opened; None once given away or out of date
        self._wal = files_of(path)[1]  # filled again from its beginning: its size does not tell how much is in it
        self._pages = 0  # written since it was copied, an estimate
        self._tidying = threading.Lock()
        self._closed = False

    def load(self) -> Content:
        if self._content is not None:
            content, self._content = self._content, None
            return content
        with errors_named(self.path):
            return sql_tables.read_all(self._connection)

    def is_too_large(self) -> bool:
        """Return whether the file has more free pages than used ones, and some, or the -wal is over its limit."""
        with errors_named(self.path):
            return self._has_too_many_pages() or self._wal_bytes() > _WAL_LIMIT_BYTES

    def _has_too_many_pages(self) -> bool:
        page, pages, free = (
            self._connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_size", "page_count", "freelist_count")
        )
        return page * free > page * (pages - free) + _SPARE_BYTES

    def commit(self, changes: Sequence[Change]) -> None:
        unwritten = "none of them is written. Make room on the disk, or repair it, and try again"
        number = self.meta.folded + 1  # with each commit: so every -wal says whose it is
        self._commit(sql_tables.net_of(changes), number, f"write {len(changes)} change(s)", unwritten)
        self.note(number)

    def _commit(self, changes: sql_tables.Net, number: int, expected: str, if_not: str) -> None:
        self._content = None
        self._pages += min(changes.count, _EACH_A_PAGE + changes.count // _SOME_A_PAGE)
        meta = msgspec.structs.replace(self.meta, folded=number)
        try:
            self._write(changes, meta)
        except sqlite3.Error as error:
            text = f"{self.path}: expected to {expected}, got: {error}; {if_not}"
            raise CatalogError(text, path=str(self.path)) from error
        self.meta = meta

    def note(self, number: int) -> None:
        """Note in the lock's file that this segment of the journal is begun, or this commit is in the tables."""
        self._lock.note(Reached(self.meta.id, self.epoch, number, in_tables=not self._has_journal))

    def keep_lock(self) -> None:
        """Notice that the lock's file was removed, as CatalogLock.keep()."""
        with errors_named(self.path):
            self._lock.keep()

    def fold(self, changes: sql_tables.Net, segment: int) -> None:
        """Write what is in a journal as commit() does, atomically with the number of its last segment."""
        unwritten = "they stay in the journal, and are safe there. Make room on the disk, or repair it"
        self._commit(changes, segment, f"take {changes.count} change(s) from its journal", unwritten)

    def _write(self, changes: sql_tables.Net, meta: sql_tables.Meta) -> None:
        cursor = self._cursor
        with self._writing:
            try:
                cursor.execute("BEGIN")
                cursor.execute(sql_tables.PUT_META, sql_tables.columns_of(meta))
                for sql, parameters in sql_tables.statements(changes):
                    cursor.execute(sql, parameters)
                cursor.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    if self._connection.in_transaction:  # after some errors SQLite has done it itself
                        cursor.execute("ROLLBACK")
                raise

    def wants_tidying(self) -> bool:
        """Whether much has been written since the last time."""
        return self._pages >= _TIDY_PAGES and not self._tidying.locked()

    def _wal_bytes(self) -> int:
        try:
            return os.stat(self._wal.name, dir_fd=self.folder.fd, follow_symlinks=False).st_size
        except OSError:  # it is not there
            return 0

    def tidy(self) -> None:
        """Copy what is in the -wal to the file, by a connection of its own: the fsyncs hold up no commit.

        A file with more free pages than used ones is written anew. So its size follows what it holds, and the cost is
        a part of what it cost to fill and empty those pages.
        """
        own = contextlib.ExitStack()
        with self._tidying, errors_named(self.path), own:
            if self._closed:
                return  # a file of that name, if there is one, is somebody else's
            self._lock.keep()
            self._pages = 0
            connection = sqlite3.connect(self.path, isolation_level=None, timeout=_BUSY_S)
            own.callback(connection.close)
            vacuumed = self._has_too_many_pages()
            if vacuumed:
                with self._writing:
                    self._connection.execute(_SHRINK)
            connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
            if vacuumed or self._wal_bytes() > _WAL_LIMIT_BYTES:
                connection.execute("PRAGMA busy_timeout = 0")  # if a tool reads just now, the next time will do
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    def close(self, *, erase: bool = False, settled: bool = True) -> None:
        """Close it as the contract says. `settled`: whether nothing is in a journal alone."""
        with self._tidying, errors_named(self.path):
            self._close(erase=erase, settled=settled)

    def _close(self, *, erase: bool, settled: bool) -> None:
        self._closed = True
        try:
            if erase:
                with contextlib.suppress(sqlite3.Error):  # a -wal that outlives its file must be empty
                    self._cursor.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            self._cursor.close()  # with a statement that has failed in it, SQLite would keep the files open
            self._connection.close()
            if erase:
                self._erase()
            elif settled and not self.folder.has(self._wal.name):
                self._lock.note(None)
        finally:
            try:
                self._lock.release(remove=erase)
            finally:
                self.folder.close()
        if erase:
            with contextlib.suppress(OSError):  # something else is in the directory
                self.path.parent.rmdir()

    def _erase(self) -> None:
        self._lock.note(None)  # without its file, all the others are damage
        segments = segments_among(self.folder.names(), self.path)
        for name in (*segments, *(file.name for file in files_of(self.path))):
            with contextlib.suppress(FileNotFoundError):
                self.folder.unlink(name)
        if self._witness is not None:
            self._witness.forget()


# -- its files ---------------------------------------------------------------------------------------------------

_NUMBER = re.compile(r"[1-9]\d{0,17}$")


def files_of(path: Path) -> list[Path]:
    """Return the catalog's file and those that SQLite has beside it while it is open."""
    return [path, path.with_name(path.name + "-wal"), path.with_name(path.name + "-shm")]


def segment_prefix(path: Path) -> str:
    """Return how the names of its journal's segments begin; their numbers follow."""
    return f"{path.stem}.journal."


def segments_among(names: Iterable[str], path: Path) -> list[str]:
    """Return those names that are a segment's of this catalog's journal, in their order."""
    prefix = segment_prefix(path)
    found = [name for name in names if name.startswith(prefix) and _NUMBER.match(name, len(prefix))]
    return sorted(found, key=lambda name: int(name[len(prefix) :]))


def create(folder: Folder, path: Path, durability: Literal["process", "power"], registrar: str) -> sql_tables.Meta:
    """Make an empty catalog beside its place and move it there: a crash leaves all of it or nothing.

    Returns what it says of itself.
    """
    meta = sql_tables.Meta(os.urandom(8).hex(), epoch=0, folded=0, registrar=registrar)
    new = path.with_name(path.name + ".new")
    for file in (*files_of(path)[1:], *files_of(new), new.with_name(new.name + "-journal")):
        with contextlib.suppress(FileNotFoundError):  # left by a crash
            folder.unlink(file.name)
    fd = folder.open(new.name, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    try:
        with contextlib.closing(sqlite3.connect(new, isolation_level=None)) as connection:
            connection.execute("PRAGMA synchronous = OFF")  # fsync once, below
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {sql_tables.SCHEMA_VERSION}")
            for sql in sql_tables.SCHEMA.values():
                connection.execute(sql)
            connection.execute(sql_tables.PUT_META, sql_tables.columns_of(meta))
            connection.execute("PRAGMA journal_mode = WAL").fetchall()
        os.fsync(fd)
    finally:
        os.close(fd)
    folder.rename(new.name, path.name)
    if durability == "power":
        os.fsync(folder.fd)
    return meta


# Reading the SQLite file of a catalog, all of it, through a read-only connection: not a byte of it changes.

NONE = sql_tables.Meta("", epoch=0, folded=0)
"""What a catalog says of itself that is not there."""

_MAGIC = b"SQLite format 3\0"
_WAL_MODE = b"\2\2"  # file format versions for writing and reading: a catalog is always in WAL mode
_HEADER_BYTES = 100


def read_catalog(folder: Folder, path: Path) -> tuple[sql_tables.Meta, Content]:
    """Return what the catalog says of itself, and its rows; epoch 0 and none if there is no file.

    SQLite opens its files by their names. They are looked at before, each of them; between the two, only who may write
    the directory can exchange them.

    Args:
        folder, path: the catalog's directory, and its file there.

    Raises:
        CatalogDamaged, CatalogVersion: see open_store; nothing is changed.
        Damage, sqlite3.Error, OSError: errors_named() makes a CatalogDamaged or a CatalogError of it.
    """
    file, wal, shm = files_of(path)
    there = folder.look(file.name)
    left = folder.look(wal.name)
    folder.look(shm.name)
    if there is None:
        if left is not None and left.st_size > 0:
            damaged(path, f"no such file, but {wal.name}, which belongs to it")
        return NONE, content_of(())
    with os.fdopen(folder.open(file.name), "rb") as header:
        _check_header(path, header.read(_HEADER_BYTES))
    # Without a -wal nobody has it open; SQLite then leaves none behind if it knows that the file does not change.
    uri = f"{path.as_uri()}?{'mode=ro' if left is not None else 'immutable=1'}"
    with contextlib.closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
        connection.execute("BEGIN")  # one state of it, if another process has it open
        schema = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        _check_version(path, version)
        if dict(schema) != sql_tables.SCHEMA:
            damaged(path, "other tables than a catalog has")
        problems = connection.execute("PRAGMA quick_check(1)").fetchall()
        if problems != [("ok",)]:
            damaged(path, f"one that SQLite finds damaged: {problems[0][0]}")
        return sql_tables.read_meta(connection), sql_tables.read_all(connection)


def check_under_wal(folder: Folder, path: Path, meta: sql_tables.Meta) -> None:
    """Check that a file that a -wal is about to change is the one that the -wal belongs to: nothing else says so.

    Nobody may have it open.

    Raises:
        Damage: it is another catalog's.
    """
    if folder.look(files_of(path)[1].name) is None:
        return
    uri = f"{path.as_uri()}?immutable=1"
    with contextlib.closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
        try:
            found = sql_tables.read_meta(connection)
        except (sqlite3.Error, Damage):  # a copying that was not finished: the -wal has what is missing
            return
    if found.id != meta.id:
        raise Damage(f"that of another registrar or system ({found.registrar or found.id}), with this one's -wal")


def _check_header(path: Path, header: bytes) -> None:
    if len(header) < _HEADER_BYTES or not header.startswith(_MAGIC):
        damaged(path, "a file that is not one of SQLite's" if header else "an empty file")
    application_id = int.from_bytes(header[68:72], "big")
    if application_id != APPLICATION_ID or header[18:20] != _WAL_MODE:
        damaged(path, "an SQLite file of something else")


def _check_version(path: Path, version: int) -> None:
    if version < 1:
        damaged(path, f"one of schema version {version}")
    if version != sql_tables.SCHEMA_VERSION:
        raise CatalogVersion(
            f"{path}: expected a catalog of version {sql_tables.SCHEMA_VERSION}, got version {version}; it is left as"
            " it is. Use the rr_actors that wrote it, or move it away to start with an empty catalog",
            path=str(path),
            expected=sql_tables.SCHEMA_VERSION,
            got=version,
        )
