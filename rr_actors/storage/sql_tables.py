"""Rows as SQL, made from their fields: the tables, the statements that change them, and the reading of rows.

Each kind of row has a table, and the catalog's meta row has one. Each field has a column, and `crc` is a checksum that
says whether a row is damaged.

A journal's records have the same rows. They are checked for what SQLite can take before they are written.
"""

from __future__ import annotations

import functools
import sqlite3
import types
import typing
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Any, TypeVar

import msgspec

from rr_actors.registrar.model.rows import TABLE_OF, TABLES, Change, Content, Drop, Int64, Put, Row, Table
from rr_actors.storage.damage import Damage


class Meta(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The meta row: a catalog's only row about itself.

    `id`: the catalog's id, which its journal has, too. `epoch`: how often it has been opened. `folded`: the last
    segment of its journal that is in its tables; without a journal, the number of the last commit. `registrar`: the
    name of its registrar; "" if that is unknown.
    """

    id: str
    epoch: int
    folded: int
    registrar: str = ""


class Net(msgspec.Struct, frozen=True):
    """The net result of many changes: only the last change of each id counts."""

    puts: dict[Table, dict[str, Row]]
    drops: dict[Table, dict[str, None]]
    count: int  # of the changes


T = TypeVar("T")

Statements = Iterable[tuple[str, Sequence[Any]]]  # SQL, each with its parameters
_Stored = Row | Meta
_STORED: dict[str, type[_Stored]] = {**TABLES, "meta": Meta}
_encode = msgspec.msgpack.Encoder().encode
_values_of = msgspec.structs.astuple
_CHUNK = 1000  # rows read at a time: with all at once the garbage collector takes as long as SQLite


SCHEMA_VERSION = 6
OLDEST_VERSION = 3
"""A catalog of this version, or of a later one up to SCHEMA_VERSION, is read, and migrated when it is opened."""

_SINCE = {
    "callback_runs": 4,
    "peers.released": 4,
    **dict.fromkeys(("queries.priority", "queries.own", "held.priority", "held.own"), 5),
    **dict.fromkeys(("revocations", "notices.reason", "notices.grace_ms"), 6),
}
"""The version that has brought a table, or a column, if a catalog of OLDEST_VERSION has none of that name.

Such columns are the last ones of their table, and their fields have defaults.
"""


def _create(table: str, row: type[_Stored], version: int = SCHEMA_VERSION) -> str:
    fields = [it for it in msgspec.structs.fields(row) if _SINCE.get(f"{table}.{it.name}", OLDEST_VERSION) <= version]
    described = [f"{field.name} {_column_type(field.type)}" for field in fields]
    described[0] += " PRIMARY KEY"
    return f"CREATE TABLE {table} ({', '.join(described)}, crc INTEGER NOT NULL) WITHOUT ROWID"


def _column_type(type_: Any) -> str:
    if typing.get_origin(type_) is types.UnionType:
        return "BLOB"  # bytes | None, the only union in a row
    if type_ == Int64 or issubclass(type_, int):
        return "INTEGER NOT NULL"
    return "BLOB NOT NULL" if issubclass(type_, bytes) else "TEXT NOT NULL"


def _put(table: str, row: type[_Stored], count: int = 1) -> str:
    """Return a statement that updates rows in place: INSERT OR REPLACE removes and inserts them, a third slower."""
    names = [*row.__struct_fields__, "crc"]
    marks = ", ".join([f"({', '.join('?' * len(names))})"] * count)
    changes = ", ".join(f"{name} = excluded.{name}" for name in names[1:])
    return f"INSERT INTO {table} VALUES {marks} ON CONFLICT (id) DO UPDATE SET {changes}"


def _drop(table: str, count: int = 1) -> str:
    return f"DELETE FROM {table} WHERE id IN ({', '.join('?' * count)})"


SCHEMA = {table: _create(table, row) for table, row in _STORED.items()}
PUT_META = _put("meta", Meta)
_AT_ONCE = (32, 8, 1)  # rows a statement: each statement releases Python's lock, and may wait long to get it again
_PUT = {(table, count): _put(table, row, count) for table, row in TABLES.items() for count in _AT_ONCE}
_DROP = {(table, count): _drop(table, count) for table in TABLES for count in _AT_ONCE}


def columns_of(row: Row | Meta) -> tuple[Any, ...]:
    """Return the values of the columns for this row. SQLite stores string enums as strings."""
    return (*_values_of(row), zlib.crc32(_encode(row)))


def net_of(changes: Sequence[Change]) -> Net:
    """Return the net result of the changes in their order."""
    puts: dict[Table, dict[str, Row]] = {}
    drops: dict[Table, dict[str, None]] = {}
    for change in changes:
        if type(change) is Put:
            row = change.row
            table = TABLE_OF[type(row)]
            puts.setdefault(table, {})[row.id] = row
            drops.get(table, {}).pop(row.id, None)
        elif type(change) is Drop:
            drops.setdefault(change.table, {})[change.id] = None
            puts.get(change.table, {}).pop(change.id, None)
    return Net(puts, drops, len(changes))


def statements(net: Net) -> Iterator[tuple[str, Sequence[Any]]]:
    """Yield the statements for many changes, each with its parameters.

    Rows do not refer to one another in SQL. So a statement takes many of them, in the order of their table, which is
    two to four times as fast as any other.
    """
    for table, rows in net.puts.items():
        for some in _in_parts([rows[id] for id in sorted(rows)]):
            yield _PUT[table, len(some)], [column for row in some for column in columns_of(row)]
    for table, ids in net.drops.items():
        for some in _in_parts(sorted(ids)):
            yield _DROP[table, len(some)], some


def _in_parts(items: list[T]) -> Iterator[list[T]]:
    at = 0
    for count in _AT_ONCE:
        while len(items) - at >= count:
            yield items[at : at + count]
            at += count


def schema_of(version: int) -> dict[str, str]:
    """Return the statements that make the tables of a catalog of this version, by their names."""
    there = {table: row for table, row in _STORED.items() if _SINCE.get(table, OLDEST_VERSION) <= version}
    return {table: _create(table, row, version) for table, row in there.items()}


def migration_from(version: int, content: Content) -> Iterator[tuple[str, Sequence[Any]]]:
    """Yield the statements that make a catalog of this version and content one of SCHEMA_VERSION; none if it is one.

    A table with other columns is made anew: the checksum of a row depends on how many it has.
    """
    if version == SCHEMA_VERSION:
        return
    before = schema_of(version)
    for table, rows in content.items():
        if before.get(table) != SCHEMA[table]:
            if table in before:
                yield f"DROP TABLE {table}", ()
            yield SCHEMA[table], ()
            yield from statements(Net({table: rows}, {}, len(rows)))
    yield f"PRAGMA user_version = {SCHEMA_VERSION}", ()


def version_of(connection: sqlite3.Connection) -> int:
    """Return the version of a catalog's tables."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def read_all(connection: sqlite3.Connection) -> Content:
    """Return every row of a catalog; raise Damage for a row that differs from the one that was written."""
    content: Content = {table: {} for table in TABLES}
    there = schema_of(version_of(connection))
    for table, type_ in TABLES.items():
        if table not in there:
            continue
        rows = content[table]
        cursor = connection.execute(f"SELECT * FROM {table}")
        while stored := cursor.fetchmany(_CHUNK):
            rows |= {row.id: row for row in _rows_of(table, stored, type_)}
    return content


def read_meta(connection: sqlite3.Connection) -> Meta:
    """Return the catalog's meta row; raise Damage if it is missing, or differs from the one that was written."""
    rows: list[Meta] = _rows_of("meta", connection.execute("SELECT * FROM meta").fetchall(), Meta)
    if len(rows) != 1:
        raise Damage(f"{len(rows)} rows in its table meta instead of one")
    return rows[0]


def _rows_of(table: str, stored: list[tuple[Any, ...]], type_: type[_Stored]) -> list[Any]:
    checksums = [values[-1] for values in stored]
    encode: Callable[[Any], bytes] = _encode
    if stored and (count := len(stored[0]) - 1) < len(type_.__struct_fields__):  # of an earlier version
        stored = [values[:-1] for values in stored]
        encode = lambda row: _encode(_values_of(row)[:count])  # noqa: E731
    try:
        rows: list[Any] = msgspec.convert(stored, list[type_], strict=False)  # ignores the crc
    except msgspec.ValidationError as error:
        raise Damage(f"a bad row in its table {table}: {error}") from error
    if list(map(zlib.crc32, map(encode, rows))) != checksums:
        pairs = zip(rows, checksums, strict=True)
        bad = next(row.id for row, checksum in pairs if zlib.crc32(encode(row)) != checksum)
        raise Damage(f"a row in its table {table} that fails its checksum (id {bad!r})")
    return rows


# -- rows in the records of a journal ----------------------------------------------------------------------------------

_ARRAY = 0x90  # msgpack's first byte of an array of up to fifteen items: a row
_LARGEST = 2**63 - 1

_encode = msgspec.msgpack.Encoder().encode


def check_lengths(changes: Sequence[Change], longest: int) -> None:
    """Raise an OverflowError if a row has more bytes than `longest`."""
    for change in changes:
        if isinstance(change, Put) and (size := len(_encode(change.row))) > longest:
            raise OverflowError(f"{change.row.id}: expected a row of up to {longest} bytes, got {size}")


def check_numbers(changes: Iterable[Change]) -> None:
    """Check the numbers of rows if their bytes may have a too large one. Many rows' bytes do, so this must be quick."""
    for change in changes:
        if type(change) is Put:
            largest = max(_numbers(type(change.row))(change.row))
            if largest > _LARGEST:
                raise OverflowError(f"{change.row.id}: expected a number up to {_LARGEST}, got {largest}")


@functools.cache
def _numbers(type_: type[Row]) -> Callable[[Row], tuple[int, ...]]:
    names = [field.name for field in msgspec.structs.fields(type_) if field.type == Int64]
    return attrgetter(*names, *names) if names else lambda _: (0,)  # twice: for one name it would return no tuple


def decoded(body: bytes) -> list[Change]:
    """Return the changes in the body of a record; raise Damage if it is not a catalog's."""
    try:
        return [_change(table, raw) for table, raw in _decoder(list[tuple[Table, msgspec.Raw]])(body)]
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Damage(f"a bad record in its journal: {error}") from error


def _change(table: Table, raw: msgspec.Raw) -> Change:
    if bytes(raw)[0] & 0xF0 == _ARRAY:
        return Put(_decoder(TABLES[table])(raw))
    return Drop(table, _decoder(str)(raw))


@functools.cache
def _decoder(type_: Any) -> Callable[[Any], Any]:
    """Return a decoder, made at the first reading: few openings find a journal."""
    return msgspec.msgpack.Decoder(type_).decode
