"""SqliteTables: a catalog's SQLite file, in WAL mode, that any SQLite tool can read, also while it is open.

`application_id` marks the file as a catalog, `user_version` is its schema's version (sql_tables.py). Beside it are
its lock (catalog_lock.py), and SQLite's -wal and -shm while it is open: of a new one, from the first folding on.

opening.py has read and checked an existing catalog before a store is made.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import sqlite3
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from rr_actors.base.errors import CatalogError, CatalogVersion
from rr_actors.base.folder import Folder, make_directories
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.model.rows import Content, content_of
from rr_actors.storage import sql_tables
from rr_actors.storage.catalog_lock import CatalogLock, Reached
from rr_actors.storage.damage import Damage, damaged, errors_named
from rr_actors.storage.witness import LastOpening, Witness, segment_prefix
from rr_actors.storage.write_ahead import Spare, leftovers

APPLICATION_ID = 0x52524143  # "RRAC"

_CACHE_KIB = 16 * 1024  # at most; holds the pages of 100,000 queries
_WAL_LIMIT_BYTES = 4 * 2**20  # the size of the -wal after the checkpoint that follows a huge commit
_SPARE_BYTES = 2**20  # free pages that the file may have, in addition to as many as it has used ones
_TIDY_PAGES = 192  # after about so many written pages another thread copies the -wal; no commit does it
_EACH_A_PAGE = 4  # the estimate for a commit: its first 4 changes write a page each,
_SOME_A_PAGE = 8  # and each 8 changes write one more
_SHRINK = "VACUUM"
_SYNCHRONOUS = "PRAGMA synchronous = NORMAL"  # the -wal is synced before it is copied; until then the journal has all
_BUSY_S = 1.0  # the wait for a tool that has the file open; processes of this package never wait for each other

_log = Log(__name__)


class SqliteTables:
    """The SQLite file that a journal is folded into, and the notes of it. Usable from any thread, one at a time.

    Args:
        folder, path: the catalog's directory, which close() closes, and its checked file there.
        lock: the lock, already held; close() releases it.
        durability: "power": a power cut loses neither the changes nor the opening. What is folded later is in the
            journal, too, until the disk has it.
        meta, changes: committed at once; an older schema is migrated in the same commit. Without changes there is no
            file yet, or it has this meta row already; SQLite makes or opens it when it is used first.
        content: the file's content after that.
        witness: the record of this catalog outside of its directory.
        settled: the number of the last commit that the file has without its -wal.
        spare: what a crash has left of it.

    Attributes:
        folder, path, settled: as given; then as it is.
        meta: the meta row in the file.
        is_synced: whether a power cut loses no commit.
        is_made: whether there is a file.

    Raises:
        sqlite3.Error: the changes could not be written; the lock is still held.
    """

    def __init__(
        self,
        folder: Folder,
        path: Path,
        lock: CatalogLock,
        durability: Literal["process", "power"],
        meta: sql_tables.Meta,
        changes: sql_tables.Net | None,
        content: Content,
        witness: Witness | None = None,
        *,
        settled: int = 0,
        spare: Spare | None = None,
    ) -> None:
        self.folder = folder
        self.settled = settled
        self.place = folder.place
        self.path = path
        self.meta = meta
        self.epoch = meta.epoch
        self.is_made = has_file(folder, path)
        self._witness = witness
        self.is_synced = durability == "power"
        self._spare = spare or Spare(folder, path, synced=self.is_synced)
        self._lock = lock
        self._writing = threading.Lock()
        self._opened: sqlite3.Cursor | None = None
        self._closed = False
        self._wal = f"{path.name}-wal"
        if changes is not None:
            try:
                version = sql_tables.version_of(self._connection)
                if self.is_synced:
                    self._cursor.execute("PRAGMA synchronous = FULL")
                self._write(changes, meta, sql_tables.migration_from(version, content))
                self._cursor.execute(_SYNCHRONOUS)
            except BaseException:
                self._close_file()
                raise
        self.note(meta.folded, needed=not self.is_made)  # the opening is counted nowhere else
        if self.is_made:
            self.note_outside()
        self._content: Content | None = content  # as read at the opening; None once returned or out of date
        self._pages = 0  # an estimate of the pages written since the last copy
        self._tidying = threading.Lock()

    @property
    def _cursor(self) -> sqlite3.Cursor:
        if self._opened is None:
            if self._closed:
                raise sqlite3.ProgrammingError("the catalog is closed")
            if not self.is_made:
                self._make()
            uri = f"{self.path.as_uri()}?mode=rw"  # never an empty file in place of one that was removed
            connection = sqlite3.connect(uri, uri=True, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
            self._opened = cursor = connection.cursor()
            try:
                cursor.execute(_SYNCHRONOUS)
                cursor.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
                cursor.execute(f"PRAGMA journal_size_limit = {_WAL_LIMIT_BYTES}")
                cursor.execute("PRAGMA wal_autocheckpoint = 0")  # tidy() copies the -wal
            except BaseException:
                self._close_file()
                raise
        return self._opened

    @property
    def _connection(self) -> sqlite3.Connection:
        return self._cursor.connection

    def _make(self) -> None:
        if not has_file(self.folder, self.path):
            create(self.folder, self.path, self.meta)
        elif not self._is_its_file():  # else an interrupt came just after it was made
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.path))
        self.is_made = True

    def _is_its_file(self) -> bool:
        try:
            return read_catalog(self.folder, self.path)[0].id == self.meta.id
        except (CatalogError, Damage, sqlite3.Error):
            return False

    def note_outside(self) -> None:
        """Record outside of its directory that the catalog has something, so that it is missed if it is removed."""
        if self._witness is not None:
            known = LastOpening(self.meta.id, self.epoch, str(self.path))
            self._witness.note(known, synced=self.is_synced)

    def forget_outside(self) -> None:
        """Remove that record, because the catalog has nothing, and no file."""
        if self._witness is not None:
            self._witness.forget(self.epoch)

    def reopen(self) -> None:
        """Close the file, because its -wal is damaged; the next use opens it as after a crash.

        SQLite then takes what is before the damage. `meta` says what the file has for certain.
        """
        with self._tidying, self._writing, errors_named(self.path):
            self.meta = msgspec.structs.replace(self.meta, folded=self.settled)
            self._content = None
            self._close_file()
            self.folder.discard(files_of(self.path)[2].name)
            self._spare.recover(self.settled)

    def _close_file(self) -> None:
        """Close the file. SQLite copies nothing of the -wal at this: tidy() does, which checks it."""
        cursor, self._opened = self._opened, None
        if cursor is None:
            return
        connection = cursor.connection
        with contextlib.ExitStack() as others:
            if self._wal_bytes():  # then another has the file open, and that one cannot write it
                reader = sqlite3.connect(f"{self.path.as_uri()}?mode=ro", uri=True)
                others.callback(reader.close)
                with contextlib.suppress(sqlite3.Error):
                    reader.execute("PRAGMA schema_version").fetchall()
            cursor.close()  # a failed statement in it would keep SQLite's files open
            connection.close()
        self._spare.close()

    def load(self) -> Content:
        if self._content is not None:
            content, self._content = self._content, None
            return content
        if not self.is_made:
            return content_of(())
        with errors_named(self.path):
            return sql_tables.read_all(self._connection)

    def is_too_large(self) -> bool:
        """Return whether the file has more free pages than used ones, and some, or the -wal is over its limit."""
        if self._opened is None:
            return False
        with errors_named(self.path):
            return self._has_too_many_pages() or self._wal_bytes() > _WAL_LIMIT_BYTES

    def _has_too_many_pages(self) -> bool:
        page, pages, free = (
            self._connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_size", "page_count", "freelist_count")
        )
        return page * free > page * (pages - free) + _SPARE_BYTES

    def note(self, number: int, *, needed: bool = False) -> None:
        """Have CatalogLock.note() note that a segment of the journal is begun."""
        folded = self.meta.folded if self.is_made else 0
        reached = Reached(self.meta.id, self.epoch, number, self.is_made, folded, self.settled)
        self._lock.note(reached, needed=needed)

    def keep_lock(self) -> None:
        """Take the lock again if its file was removed, as CatalogLock.keep() does."""
        with errors_named(self.path):
            self._lock.keep()

    def fold(self, changes: sql_tables.Net, segment: int) -> None:
        """Write the changes of a journal, atomically with the number of its last segment.

        Raises:
            CatalogError: the file could not be written; nothing was.
        """
        self._content = None
        self._pages += 1 + min(changes.count, _EACH_A_PAGE + changes.count // _SOME_A_PAGE)  # 1: of the meta row
        meta = msgspec.structs.replace(self.meta, folded=segment)  # each folding writes it: so every -wal has the id
        try:
            self._write(changes, meta)
        except (sqlite3.Error, OSError) as error:
            raise CatalogError(
                f"{self.path}: expected to take {changes.count} change(s) from its journal, got: {error}; they stay in"
                " the journal, and are safe there. Make room on the disk, or repair it",
                path=str(self.path),
            ) from error
        self.meta = meta

    def _settle(self, number: int) -> None:
        """Note that the file has all up to this commit without its -wal."""
        if self._spare.remove():  # otherwise the next opening must know that it is of use
            self.settled = number

    def _write(self, changes: sql_tables.Net, meta: sql_tables.Meta, migration: sql_tables.Statements = ()) -> None:
        with self._writing:
            cursor = self._cursor
            try:
                cursor.execute("BEGIN")
                for sql, parameters in migration:
                    cursor.execute(sql, parameters)
                cursor.execute(sql_tables.PUT_META, sql_tables.columns_of(meta))
                for sql, parameters in sql_tables.statements(changes):
                    cursor.execute(sql, parameters)
                cursor.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    if cursor.connection.in_transaction:  # after some errors SQLite has rolled back itself
                        cursor.execute("ROLLBACK")
                raise

    def wants_tidying(self) -> bool:
        """Return whether about _TIDY_PAGES pages were written since the last tidy(), and none is running."""
        return self._pages >= _TIDY_PAGES and not self._tidying.locked()

    def _wal_bytes(self) -> int:
        try:
            return os.stat(self._wal, dir_fd=self.folder.fd, follow_symlinks=False).st_size
        except OSError:  # it is not there
            return 0

    def tidy(self) -> None:
        """Copy the -wal into the file and empty it, by a separate connection: the fsyncs delay no commit.

        A copy of the -wal is kept until that is done, and SQLite checks the copy before. A tool that reads the file can
        hold up the end of this; then the next call does it.

        A file with more free pages than used ones is written anew. So its size follows its content, at a fraction of
        the cost of filling and emptying those pages.

        Raises:
            CatalogDamaged: the -wal is not what was written to it; it is not copied.
        """
        own = contextlib.ExitStack()
        with self._tidying, errors_named(self.path), own:
            if self._closed or not self.place.is_there():
                return  # a file of that name may belong to another store by now
            self._lock.keep()
            self._pages = 0
            connection = sqlite3.connect(self.path, isolation_level=None, timeout=_BUSY_S)
            own.callback(connection.close)
            is_too_large = self._has_too_many_pages()
            with self._writing:
                if is_too_large:
                    self._connection.execute(_SHRINK)
                number = self.meta.folded
                if frames := self._spare.frames():
                    self._spare.make(number, frames)
            if frames:
                connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
                connection.execute("PRAGMA busy_timeout = 0")  # while a tool reads the file, the next tidy() does it
                ((is_busy, *_),) = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                if is_busy:
                    return
            self._settle(number)

    def copy(self, content: Content, path: Path) -> None:
        write_copy(path, self.meta, content)

    def close(self, *, erase: bool = False, settled: bool = True) -> None:
        """Close the store as the contract says. `settled`: whether the journal has no change of its own."""
        if not erase and self._wal_bytes():
            try:
                self.tidy()
            except CatalogError as error:
                _log.warning("%s; the next opening does it", error)
        with self._tidying, errors_named(self.path):
            self._closed = True
            with self.folder:
                try:
                    # First the record outside: a crash in the middle leaves a catalog that nobody misses, or none.
                    erase = erase and (self._witness is None or self._witness.forget(self.epoch))
                    if erase and self._opened is not None:
                        with contextlib.suppress(sqlite3.Error):  # a -wal that outlives its file must be empty
                            self._cursor.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                    self._close_file()
                    if erase:
                        self._erase()
                    elif settled and self.is_made and not self.folder.has(self._wal) and self._spare.is_gone():
                        self._lock.note(None)
                finally:
                    self._lock.release(remove=erase)
            if erase:
                with contextlib.suppress(OSError):  # something else is in the directory, or it is being opened again
                    self.path.parent.rmdir()

    def _erase(self) -> None:
        self._lock.note(None)  # a noted catalog without its file would count as damaged
        first, *others = (file.name for file in files_of(self.path))
        self._unlink(*segments_among(self.folder.names(), self.path), *leftovers(self.path), *others)
        if self.is_synced:  # after a power cut, too, nothing outlives the file that belongs to it
            os.fsync(self.folder.fd)
        self._unlink(first)

    def _unlink(self, *names: str) -> None:
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                self.folder.unlink(name)


# -- its files ---------------------------------------------------------------------------------------------------

_ENDINGS = ("", "-wal", "-shm", ".spare-wal")
_NUMBER = re.compile(r"[1-9]\d{0,17}$")


def files_of(path: Path) -> list[Path]:
    """Return the catalog's file, and the files that there are beside it while it is open."""
    return [path.with_name(path.name + ending) for ending in _ENDINGS]


def files_among(names: Sequence[str], path: Path) -> list[str]:
    """Return the names that belong to files_of() this catalog, or to its journal."""
    files = (path.name + ending for ending in _ENDINGS)
    return [name for name in files if name in names] + segments_among(names, path)


def has_file(folder: Folder, path: Path) -> bool:
    """Return whether the catalog has its SQLite file. A tool that looks before it is made leaves an empty one."""
    found = folder.look(path.name)
    return found is not None and found.st_size > 0


def segments_among(names: Iterable[str], path: Path) -> list[str]:
    """Return the names that belong to segments of this catalog's journal, by their numbers."""
    prefix = segment_prefix(path)
    found = [name for name in names if name.startswith(prefix) and _NUMBER.match(name, len(prefix))]
    return sorted(found, key=lambda name: int(name[len(prefix) :]))


def write_copy(path: Path, meta: sql_tables.Meta, content: Content) -> None:
    """Make a catalog with this meta row and these rows, in a directory of its own; it is on the disk at the end.

    Raises:
        CatalogError: it cannot be written.
    """
    with errors_named(path):
        make_directories(path.parent, synced=True)
        with Folder.at(path.parent) as folder:
            create(folder, path, meta, content)
            os.fsync(folder.fd)


def create(folder: Folder, path: Path, meta: sql_tables.Meta, content: Content | None = None) -> None:
    """Make a catalog with this meta row, under another name, and rename it: a crash leaves all of it or nothing.

    The caller syncs the directory, where a power cut must leave it.

    SQLite makes it in memory, and it is written at once.

    Args:
        content: its other rows; None: it has none.
    """
    new = path.with_name(path.name + ".new")
    for file in (*files_of(path)[1:], *files_of(new), new.with_name(new.name + "-journal")):
        if folder.has(file.name):  # left by a crash
            folder.unlink(file.name)
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.deserialize(_without_meta())
        connection.execute(sql_tables.PUT_META, sql_tables.columns_of(meta))
        if content is not None:
            connection.execute("BEGIN")
            for sql, parameters in sql_tables.statements(sql_tables.Net(content, {}, 0)):
                connection.execute(sql, parameters)
            connection.execute("COMMIT")
        image = connection.serialize()
    image = image[: _WAL_MODE_AT.start] + _WAL_MODE + image[_WAL_MODE_AT.stop :]
    try:
        with folder.open(new.name, os.O_CREAT | os.O_EXCL | os.O_WRONLY) as file:
            at = 0
            while at < len(image):
                at += os.pwrite(file.fileno(), image[at:], at)
            os.fsync(file.fileno())
        folder.rename(new.name, path.name)
    except BaseException:
        folder.discard(new.name)
        raise


@functools.cache
def _without_meta() -> bytes:
    """Return the bytes of a catalog's file whose tables are all empty, but for the mark of WAL mode."""
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {sql_tables.SCHEMA_VERSION}")
        for sql in sql_tables.SCHEMA.values():
            connection.execute(sql)
        return connection.serialize()


# Reading all of a catalog's SQLite file through a read-only connection: the file does not change.

NONE = sql_tables.Meta("", epoch=0, folded=0)
"""The meta row of a catalog that does not exist."""

_MAGIC = b"SQLite format 3\0"
_WAL_MODE_AT = slice(18, 20)
_WAL_MODE = b"\2\2"  # file format versions for writing and reading: a catalog is always in WAL mode
_HEADER_BYTES = 100


def read_catalog(folder: Folder, path: Path) -> tuple[sql_tables.Meta, Content]:
    """Return the catalog's meta row and its rows; NONE and no rows if there is no file.

    SQLite opens its files by their names. Each file is checked before; between the check and the opening, only a user
    that may write the directory can exchange it.

    Args:
        folder, path: the catalog's directory, and its file there.

    Raises:
        CatalogDamaged, CatalogVersion: as open_store() describes; nothing is changed.
        Damage, sqlite3.Error, OSError: errors_named() turns these into a CatalogDamaged or a CatalogError.
    """
    file, wal, shm, _ = files_of(path)
    there = folder.look(file.name)
    left = folder.look(wal.name)
    folder.look(shm.name)
    if there is None:
        if left is not None and left.st_size > 0:
            damaged(path, f"no such file, but {wal.name}, which belongs to it")
        return NONE, content_of(())
    with folder.open(file.name) as header:
        _check_header(path, header.read(_HEADER_BYTES))
    # Without a -wal no process has the file open; with "immutable" SQLite makes no -wal of its own.
    uri = f"{path.as_uri()}?{'mode=ro' if left is not None else 'immutable=1'}"
    with contextlib.closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as connection:
        connection.execute("BEGIN")  # shows one state of the file, even if another process writes it
        schema = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
        version = sql_tables.version_of(connection)
        _check_version(path, version)
        if dict(schema) != sql_tables.schema_of(version):
            damaged(path, "other tables than a catalog has")
        problems = connection.execute("PRAGMA quick_check(1)").fetchall()
        if problems != [("ok",)]:
            damaged(path, f"one that SQLite finds damaged: {problems[0][0]}")
        return sql_tables.read_meta(connection), sql_tables.read_all(connection)


def _check_header(path: Path, header: bytes) -> None:
    if len(header) < _HEADER_BYTES or not header.startswith(_MAGIC):
        damaged(path, "a file that is not one of SQLite's" if header else "an empty file")
    application_id = int.from_bytes(header[68:72], "big")
    if application_id != APPLICATION_ID or header[_WAL_MODE_AT] != _WAL_MODE:
        damaged(path, "an SQLite file of something else")


def _check_version(path: Path, version: int) -> None:
    if version < 1:
        damaged(path, f"one of schema version {version}")
    if not sql_tables.OLDEST_VERSION <= version <= sql_tables.SCHEMA_VERSION:
        age = "a newer" if version > sql_tables.SCHEMA_VERSION else "an older"
        raise CatalogVersion(
            f"{path}: expected a catalog of version {sql_tables.SCHEMA_VERSION}, got version {version} of {age}"
            " rr_actors; it is left as it is. Use the rr_actors that wrote it, or move it away to start with an empty"
            " catalog",
            path=str(path),
            expected=sql_tables.SCHEMA_VERSION,
            got=version,
        )
