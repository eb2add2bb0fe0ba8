"""Reading the SQLite file of a catalog, all of it, through a read-only connection: not a byte of it changes."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rr_actors.errors import CatalogVersion
from rr_actors.records import Content, content_of
from rr_actors.stores import sqlite, tables
from rr_actors.stores.damage import check_can_be_read, damaged

NONE = tables.Meta("", epoch=0, folded=0)
"""What a catalog says of itself that is not there."""

Known = Callable[[tables.Meta], Content | None]
"""Of what a catalog says of itself, the rows, if they are known from elsewhere; else they are read."""

_MAGIC = b"SQLite format 3\0"
_WAL_MODE = b"\2\2"  # file format versions for writing and reading: a catalog is always in WAL mode
_HEADER_BYTES = 100
_LARGE_BYTES = 4 * 2**20  # of a catalog that is checked and read at the same time


def read_catalog(path: Path, known: Known = lambda _: None) -> tuple[tables.Meta, Content]:
    """Return what the catalog says of itself, and its rows; epoch 0 and none if there is no file.

    Args:
        known: the rows, if they are known from elsewhere; else they are read.

    Raises:
        CatalogDamaged, CatalogVersion: see open_store; nothing is changed.
        Damage, sqlite3.Error, OSError: errors_named() makes a CatalogDamaged or a CatalogError of it.
    """
    wal = sqlite.files_of(path)[1]
    if not path.exists():
        if wal.exists() and wal.stat().st_size > 0:
            damaged(path, f"no such file, but {wal.name}, which belongs to it")
        return NONE, content_of(())
    check_can_be_read(path)
    with path.open("rb") as file:
        _check_header(path, file.read(_HEADER_BYTES))
    # Without a -wal nobody has it open; SQLite then leaves none behind if it is told that the file does not change.
    uri = f"{path.as_uri()}?{'mode=ro' if wal.exists() else 'immutable=1'}"
    with contextlib.closing(_connect_to_read(uri)) as connection:
        connection.execute("BEGIN")  # one state of it, if another process has it open
        schema = connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL").fetchall()
        if dict(schema) != tables.SCHEMA:
            damaged(path, "other tables than a catalog has")
        if path.stat().st_size < _LARGE_BYTES:
            _check(path, connection)
            return _read(connection, known)
        with ThreadPoolExecutor(1) as checking:  # SQLite needs no lock of Python's for it: another core may do it
            checked = checking.submit(_check_apart, path, uri)
            found = _read(connection, known)
            checked.result()
        return found


def _read(connection: sqlite3.Connection, known: Known) -> tuple[tables.Meta, Content]:
    meta = tables.read_meta(connection)
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
    version = int.from_bytes(header[60:64], "big")
    if version > sqlite.SCHEMA_VERSION:
        raise CatalogVersion(
            f"{path}: expected a catalog of version {sqlite.SCHEMA_VERSION} or older, got version {version}; it is left"
            " as it is. Use the newer rr_actors that wrote it, or move it away to start with an empty catalog",
            path=str(path),
            expected=sqlite.SCHEMA_VERSION,
            got=version,
        )
    if version < 1:
        damaged(path, f"one of schema version {version}")
