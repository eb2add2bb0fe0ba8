"""Catalogs: a good one with wrong bytes, wrong values and wrong tables in it, closed or with its -wal."""

from __future__ import annotations

import contextlib
import itertools
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path

from fuzz.target import Feed, Target
from rr_actors.base.errors import CatalogDamaged, CatalogVersion
from rr_actors.registrar.model.rows import (
    Held,
    Hold,
    Notice,
    Peer,
    Phase,
    Put,
    Resource,
    Row,
    ServedQuery,
    State,
    rows_of,
)
from rr_actors.storage.opening import open_store, read_rows

_Files = dict[str, bytes]
_NAME = "catalog.sqlite3"
_WAL = f"{_NAME}-wal"
_PAGE = 4096
_COLUMNS = {
    "resources": ("id", "server", "request", "phase", "state", "crc"),
    "queries": ("id", "resource_id", "origin", "seq", "crc"),
    "held": ("id", "response", "hold", "crc"),
    "notices": ("id", "state", "released", "response", "crc"),
    "peers": ("id", "crc"),
    "meta": ("id", "epoch", "crc"),
}
_STATEMENTS = (
    "CREATE TABLE more (id)", "CREATE INDEX more ON peers (crc)", "CREATE VIEW more AS SELECT * FROM peers",
    "CREATE TRIGGER more AFTER INSERT ON meta BEGIN SELECT 1; END", "DROP TABLE peers", "ANALYZE", "VACUUM",
    "PRAGMA user_version = 0", "PRAGMA user_version = -1", "PRAGMA user_version = 1", "PRAGMA user_version = 4",
    "PRAGMA application_id = 1",
    "PRAGMA journal_mode = DELETE", "PRAGMA journal_mode = DELETE; PRAGMA page_size = 512; VACUUM",
    "ALTER TABLE peers ADD COLUMN more", "ALTER TABLE peers RENAME TO more", "DELETE FROM meta", "REINDEX",
    "INSERT INTO meta VALUES ('x', 1, 1, '', 1)", "UPDATE meta SET id = 'x'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = NULL WHERE name = 'peers'",
    "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET rootpage = 2",
    "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = x'ff' WHERE name = 'peers'",
)  # fmt: skip


def _rows() -> list[Row]:
    rows: list[Row] = [Peer("maker")]
    for n in range(12):
        rows.append(Resource(f"r{n:02}", "thing", b"q" * n, b"a", Phase.LOADED, State.OK, "", 1))
        rows.append(ServedQuery(f"q{n:02}", f"r{n:02}", "app", "", 1, n))
        rows.append(Held(f"h{n:02}", "maker", "thing", b"q" * n, b"a", f"r{n:02}", "", 1, n, Hold.HELD, State.OK))
        rows.append(Notice(f"n{n:02}", "q00", "app", "r00", "e", State.UPDATE, "x" * 100 * n, "r00", False, b"a"))
    return rows


def _files(directory: Path) -> _Files:
    return {file.name: file.read_bytes() for file in directory.glob(f"{_NAME}*") if not file.name.endswith("-shm")}


# -- damage --------------------------------------------------------------------------------------------------------


class _Taken:
    """The input, taken byte by byte; zeros after its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def ended(self) -> bool:
        return self._at >= len(self._data)

    def number(self, size: int, limit: int) -> int:
        return int.from_bytes(self.bytes(size), "big") % limit if limit else 0

    def bytes(self, size: int) -> bytes:
        found = self._data[self._at : self._at + size]
        self._at += size
        return found.ljust(size, b"\0")


def _bytes_changed(files: _Files, name: str, taken: _Taken, within: int | None = None) -> None:
    content = files[name]
    at = taken.number(3 if within is None else 1, min(len(content), within or len(content)))
    new = taken.bytes(1 + taken.number(1, 8))
    files[name] = content[:at] + new[: len(content) - at] + content[at + len(new) :]


def _cut(files: _Files, name: str, taken: _Taken) -> None:
    files[name] = files[name][: taken.number(3, len(files[name]) + 1)]


def _page_emptied(files: _Files, name: str, taken: _Taken) -> None:
    at = _PAGE * taken.number(1, max(1, len(files[name]) // _PAGE))
    files[name] = files[name][:at] + bytes(min(_PAGE, len(files[name]) - at)) + files[name][at + _PAGE :]


def _value_changed(files: _Files, name: str, taken: _Taken) -> None:
    table, columns = list(_COLUMNS.items())[taken.number(1, len(_COLUMNS))]
    column = columns[taken.number(1, len(columns))]
    row = taken.number(1, 12)
    values = ("'1'", "1.0", "9223372036854775807", "-1", "1e999", "''", "x'ff'", "NULL", "CAST(x'ff00' AS TEXT)",
              "zeroblob(100000)", "'ok'", "'loaded'", f"x'{taken.bytes(3).hex()}'", f"CAST({column} AS BLOB)",
              f"CAST({column} AS TEXT)")  # fmt: skip
    value = values[taken.number(1, len(values))]
    key = columns[0]
    where = f"{key} = (SELECT {key} FROM {table} LIMIT 1 OFFSET {row})"
    _execute(files, f"UPDATE {table} SET {column} = {value} WHERE {where}")


def _tables_changed(files: _Files, name: str, taken: _Taken) -> None:
    _execute(files, _STATEMENTS[taken.number(1, len(_STATEMENTS))])


def _execute(files: _Files, sql: str) -> None:
    """As a tool would; what SQLite refuses is left out."""
    with tempfile.TemporaryDirectory(prefix="rr-") as place:
        for name, content in files.items():
            Path(place, name).write_bytes(content)
        file = Path(place, _NAME)
        refused = contextlib.suppress(sqlite3.Error, UnicodeDecodeError)  # the latter: an error's text quotes the file
        with refused, contextlib.closing(sqlite3.connect(file)) as connection:
            connection.executescript(f"PRAGMA synchronous = OFF; {sql};")
        files |= {name: content for name, content in _files(Path(place)).items() if name in files}
        if not Path(place, _WAL).exists():
            files.pop(_WAL, None)


_DAMAGES: list[Callable[[_Files, str, _Taken], None]] = [
    _bytes_changed,
    lambda files, name, taken: _bytes_changed(files, name, taken, within=112),
    _cut,
    _page_emptied,
    _value_changed,
    _tables_changed,
]


def _damage(good: _Files, taken: _Taken) -> _Files:
    files = dict(good)
    while not taken.ended:
        damage = _DAMAGES[taken.number(1, len(_DAMAGES))]
        name = _WAL if taken.number(1, 2) and _WAL in files else _NAME
        damage(files, name, taken)
    return files


# -- the target ----------------------------------------------------------------------------------------------------


def _prepare(directory: Path) -> Feed:
    """Byte 0: closed, or as SIGKILL leaves it, with a -wal; the rest: what is done to it."""
    place = directory / "registrar"
    path = place / _NAME
    store = open_store(path)
    store.commit([Put(row) for row in _rows()])
    store.close()
    closed = _files(place)
    store = open_store(path)
    store.commit([Put(Peer("another"))])
    killed, saved = _files(place), set(_rows())
    store.close()

    def feed(data: bytes) -> None:
        taken = _Taken(data)
        open_ = bool(taken.number(1, 2))
        files = _damage(killed if open_ else closed, taken)
        expected = [saved, saved | {Peer("another")}] if open_ else [saved]
        for file in place.iterdir():
            file.unlink()
        for name, content in files.items():
            (place / name).write_bytes(content)
        _check(path, files, expected)

    return feed


def _check(path: Path, files: _Files, expected: list[set[Row]]) -> None:
    """Read it, then open it: what it held, or a named error that leaves it as it is."""
    readable = True
    try:
        assert set(read_rows(path)) in expected
    except (CatalogDamaged, CatalogVersion) as error:
        readable = False
        assert str(path) in str(error)
    assert _files(path.parent).items() >= files.items()
    try:
        store = open_store(path)
    except (CatalogDamaged, CatalogVersion) as error:
        assert not readable
        assert str(path) in str(error)
        assert _files(path.parent).items() >= files.items()
        return
    try:
        assert readable
        assert set(rows_of(store.load())) in expected
        store.commit([Put(Peer("more"))])
    finally:
        store.close()


def _seeds() -> list[bytes]:
    damages = range(len(_DAMAGES))
    some = [bytes([state, damage, 0, *range(5)]) for state, damage in itertools.product((0, 1), damages)]
    tables = [bytes([0, 5, 0, statement]) for statement in range(len(_STATEMENTS))]
    values = [bytes([0, 4, 0, table, column, 1, 0, 0, 0, 13]) for table in range(5) for column in range(6)]
    return [b"\0", b"\1", *some, *tables, *values]


CATALOG = Target("catalogs, with wrong bytes, values and tables", _prepare, _seeds, longest=48)
