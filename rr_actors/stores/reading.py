"""Reading the SQLite file of a catalog, all of it, through a read-only connection: not a byte of it changes."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rr_actors.errors import CatalogVersion
from rr_actors.folder import Folder
from rr_actors.records import Content, content_of
from rr_actors.stores import sqlite, tables
from rr_actors.stores.damage import Damage, damaged

NONE = tables.Meta("", epoch=0, folded=0)
"""What a catalog says of itself that is not there."""

Known = Callable[[tables.Meta], Content | None]
"""Of what a catalog says of itself, the rows, if they are known from elsewhere; else they are read."""

_MAGIC = b"SQLite format 3\0"
_WAL_MODE = b"\2\2"  # file format versions for writing and reading: a catalog is always in WAL mode
_HEADER_BYTES = 100
_LARGE_BYTES = 4 * 2**20  # of a catalog that is checked and read at the same time


def read_catalog(folder: Folder, path: Path, known: Known = lambda _: None) -> tuple[tables.Meta, Content]:
    """Return what the catalog says of itself, and its rows; epoch 0 and none if there is no file.

    SQLite opens its files by their names. They are looked at before, each of them; between the two, only who may write
    the directory can exchange them.

    Args:
        folder, path: the catalog's directory, and its file there.
        known: the rows, if they are known from elsewhere; else they are read.

    Raises:
        CatalogDamaged, CatalogVersion: see open_store; nothing is changed.
        Damage, sqlite3.Error, OSError: errors_named() makes a CatalogDamaged or a CatalogError of it.
    """
    file, wal, shm = sqlite.files_of(path)
    there = folder.look(file.name)
    left = folder.look(wal.name)
    folder.look(shm.name)
    if there is None:
        if left is not None and left.st_size > 0:
            damaged(path, f"no such file, but {wal.name}, which belongs to it")
        return NONE, content_of(())
    with os.fdopen(folder.open(file.name), "rb") as header:
        _check_header(path, header.read(_HEADER_BYTES))
    # Without a -wal nobody has it open; SQLite then leaves none behind if it is told that the file does not change.
    uri = f"{path.as_uri()}?{'mode=ro' if left is not None else 'immutable=1'}"
    with contextlib.closing(_connect_to_read(uri)) as connection:
        connection.execute("BEGIN")  # one state of it, if another process has it open
        schema = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        _check_version(path, version)
        if dict(schema) != tables.SCHEMAS[version]:
            damaged(path, "other tables than a catalog has")
        if there.st_size < _LARGE_BYTES:
            _check(path, connection)
            return _read(connection, version, known)
        with ThreadPoolExecutor(1) as checking:  # SQLite needs no lock of Python's for it: another core may do it
            checked = checking.submit(_check_apart, path, uri)
            found = _read(connection, version, known)
            checked.result()
        return found


def check_under_wal(folder: Folder, path: Path, meta: tables.Meta) -> None:
    """Check that a file that a -wal is about to change is the one that the -wal belongs to: nothing else says so.

    Nobody may have it open.

    Raises:
        Damage: it is another catalog's.
    """
    if folder.look(sqlite.files_of(path)[1].name) is None:
        return
    with contextlib.closing(_connect_to_read(f"{path.as_uri()}?immutable=1")) as connection:
        try:
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            found = tables.read_meta(connection, version)
        except (sqlite3.Error, Damage):  # a copying that was not finished: the -wal has what is missing
            return
    if found.id != meta.id:
        raise Damage(f"that of another registrar or system ({found.registrar or found.id}), with this one's -wal")


def _read(connection: sqlite3.Connection, version: int, known: Known) -> tuple[tables.Meta, Content]:
    meta = tables.read_meta(connection, version)
    content = known(meta)
    return meta, tables.read_all(connection) if content is None else content


def _connect_to_read(uri: str) -> sqlite3.Connection:
    return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)


def _check_apart(path: Path, uri: str) -> None:
    with contextlib.closing(_connect_to_read(uri)) as connection:
        _check(path, connection)


def _check(path: Path, connection: sqlite3.Connection) -> None:
    problems = connection.execute("PRAGMA quick_check(1)").fetchall()
    if problems != [("ok",)]:
        damaged(path, f"one that SQLite finds damaged: {problems[0][0]}")


def _check_header(path: Path, header: bytes) -> None:
    if len(header) < _HEADER_BYTES or not header.startswith(_MAGIC):
        damaged(path, "a file that is not one of SQLite's" if header else "an empty file")
    application_id = int.from_bytes(header[68:72], "big")
    if application_id != sqlite.APPLICATION_ID or header[18:20] != _WAL_MODE:
        damaged(path, "an SQLite file of something else")
    _check_version(path, int.from_bytes(header[60:64], "big"))


def _check_version(path: Path, version: int) -> None:
    if version > tables.SCHEMA_VERSION:
        raise CatalogVersion(
            f"{path}: expected a catalog of version {tables.SCHEMA_VERSION} or older, got version {version}; it is left"
            " as it is. Use the newer rr_actors that wrote it, or move it away to start with an empty catalog",
            path=str(path),
            expected=tables.SCHEMA_VERSION,
            got=version,
        )
    if version < 1:
        damaged(path, f"one of schema version {version}")
