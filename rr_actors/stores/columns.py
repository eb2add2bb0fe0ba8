"""A large table read by its columns, a thousand rows at a time.

Read row by row, SQLite lets go of Python's lock and takes it again for each row, and is waited for. Here it gathers a
column of a thousand rows into one JSON array, without that lock, while another thread makes rows of the thousand
before. And what repeats in a column becomes one object.

Only a table in which every row fits its checksum is taken. Of any other this says no more than that it is Unclear: it
is to be read row by row then, which tells what is wrong with it, if anything is.
"""

from __future__ import annotations

import functools
import sqlite3
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate, pairwise
from operator import attrgetter, lt
from typing import Any

import msgspec

_ROWS = 1000  # at a time: with more, what SQLite gathers takes longer to grow than it saves
_LONGEST = 2**26  # bytes of a column that SQLite may gather; rows so long are read one by one
_FEW = 4  # times that a text is in a column, at least, on average, to be looked for
_BLOBS = (bytes, bytes | None)
_AFTER_ALL = b""  # bytes come after every text

_encode = msgspec.msgpack.Encoder().encode
_id = attrgetter("id")


class Unclear(Exception):
    """The table has something that is not read in this way."""


def read_table(connection: sqlite3.Connection, table: str, type_: type[msgspec.Struct]) -> list[Any]:
    """Return the table's rows, in the order of their ids.

    Args:
        connection: not bound to this thread.
        type_: of the rows: a field for each column, `id` the first, `crc` besides.

    Raises:
        Unclear: read it row by row.
    """
    texts, longest = connection.text_factory, connection.getlimit(sqlite3.SQLITE_LIMIT_LENGTH)
    connection.text_factory = bytes
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(_LONGEST, longest))
    try:
        return _read(connection, table, type_)
    except (msgspec.MsgspecError, sqlite3.Error, ValueError) as error:
        raise Unclear(f"{table}: {error}") from error
    finally:
        connection.text_factory = texts
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)


def _read(connection: sqlite3.Connection, table: str, type_: type[msgspec.Struct]) -> list[Any]:
    rows: list[Any] = []
    parts = _parts(connection, table, type_)
    with ThreadPoolExecutor(1) as gathering:
        ahead = gathering.submit(next, parts, None)
        while (part := ahead.result()) is not None:
            ahead = gathering.submit(next, parts, None)
            rows += _rows_of(part, type_)
        ((count,),) = gathering.submit(_fetch, connection, f"SELECT count(*) FROM {table}").result()
    ids = list(map(_id, rows))
    if len(rows) != count or not all(map(lt, ids, ids[1:])):
        raise Unclear(f"{table}: {len(rows)} rows in the order of their ids, of {count}")
    return rows


def _parts(connection: sqlite3.Connection, table: str, type_: type[msgspec.Struct]) -> Iterator[tuple[Any, ...]]:
    columns = ", ".join(_gathered(field.name, field.type) for field in msgspec.structs.fields(type_))
    gather = f"SELECT {columns}, json_group_array(crc) FROM {table} WHERE id >= ? AND id < ?"
    look_ahead = f"SELECT id FROM {table} WHERE id >= ? ORDER BY id LIMIT 1 OFFSET {_ROWS}"
    first = ""
    while found := _fetch(connection, look_ahead, first):
        after: str = found[0][0].decode()
        if after <= first:
            raise Unclear(f"{table}: ids in another order than theirs")
        yield from _fetch(connection, gather, first, after)
        first = after
    yield from _fetch(connection, gather, first, _AFTER_ALL)


def _gathered(column: str, type_: Any) -> str:
    """Of what is in the column, JSON; of bytes the lengths, and then all of them."""
    if type_ not in _BLOBS:
        return f"json_group_array({column})"
    lengths = f"json_group_array(CASE typeof({column}) WHEN 'blob' THEN length({column}) END)"
    return f"{lengths}, CAST(group_concat({column}, '') AS BLOB)"


def _fetch(connection: sqlite3.Connection, sql: str, *parameters: Any) -> list[Any]:
    return connection.execute(sql, parameters).fetchall()


def _rows_of(part: tuple[Any, ...], type_: type[msgspec.Struct]) -> list[Any]:
    gathered = iter(part)
    columns: list[list[Any]] = []
    for field in msgspec.structs.fields(type_):
        if field.type in _BLOBS:
            lengths = _decoder(int if field.type is bytes else int | None)(next(gathered))
            columns.append(_cut(next(gathered) or b"", lengths))
        else:
            columns.append(_decoder(field.type)(next(gathered)))
            if field.type is str and columns[0]:
                columns[-1] = _each_once(columns[-1], columns[0])
    rows = list(map(type_, *columns))
    if list(map(zlib.crc32, map(_encode, rows))) != _decoder(int)(next(gathered)):
        raise Unclear("a row that fails its checksum")
    return rows


@functools.cache
def _decoder(type_: Any) -> Callable[[bytes], list[Any]]:
    return msgspec.json.Decoder(list[type_], strict=False).decode


def _cut(data: bytes, lengths: list[int | None]) -> list[bytes | None]:
    ends = list(accumulate([length or 0 for length in lengths], initial=0))
    if ends[-1] != len(data):
        raise Unclear(f"{len(data)} bytes instead of {ends[-1]}")
    pieces: list[bytes | None] = [data[begin:end] for begin, end in pairwise(ends)]
    if None in lengths:
        return [None if length is None else piece for length, piece in zip(lengths, pieces, strict=True)]
    return pieces


def _each_once(column: list[str], ids: list[str]) -> list[str]:
    """The same texts, but those that are equal are mostly one object: fewer to keep, to hash and to compare."""
    if column == ids:
        return ids
    if column.count(column[0]) == len(column):
        return [column[0]] * len(column)
    different = set(column)
    if len(different) * _FEW > len(column):
        return column
    return list(map(dict(zip(different, different, strict=True)).__getitem__, column))
