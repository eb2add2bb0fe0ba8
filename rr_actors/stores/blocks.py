"""Blocks: some rows of one table by their columns, to be written and read many at once.

A column in which all is the same has one item, one that is as the ids has none: there is less to write, to read and to
keep then, as what was one object is one again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from itertools import repeat
from typing import Any, TypeVar

import msgspec

_FEW = 4  # times that a text is in a column, at least, on average, to be looked for

R = TypeVar("R", bound=msgspec.Struct)

_encode = msgspec.msgpack.Encoder().encode
_decode_columns = msgspec.msgpack.Decoder(list[msgspec.Raw]).decode
_decode_texts = msgspec.msgpack.Decoder(list[str]).decode
_values_of = msgspec.structs.astuple


def packed(rows: Sequence[msgspec.Struct]) -> bytes:
    """Return rows of one type, of which there are some, as MessagePack."""
    ids, *columns = zip(*map(_values_of, rows), strict=True)
    return _encode([ids, *(_shortened(column, ids) for column in columns)])


def unpacked(data: bytes | msgspec.Raw, type_: type[R]) -> tuple[list[str], list[R]]:
    """Return the ids, and the rows.

    Raises:
        msgspec.MsgspecError, ValueError: they are not rows of this type.
    """
    types, decode = _reading(type_)
    ids, *columns = decode(data)
    if not ids:
        raise ValueError("expected rows, got none")
    return ids, list(map(type_, ids, *(map(_at_length, columns, types, repeat(ids)))))


def ids_of(data: bytes | msgspec.Raw) -> list[str]:
    """Return the ids alone.

    Raises:
        msgspec.MsgspecError: they are not rows.
    """
    return _decode_texts(_decode_columns(data)[0])


def _shortened(column: tuple[Any, ...], ids: tuple[str, ...]) -> tuple[Any, ...]:
    if column.count(column[0]) == len(column):
        return column[:1]
    return () if type(column[0]) is str and column == ids else column


def _at_length(column: list[Any], type_: Any, ids: list[str]) -> Any:
    if len(column) == len(ids):
        return _each_once(column) if type_ is str else column
    if len(column) == 1:
        return repeat(column[0])
    if column or type_ is not str:
        raise ValueError(f"expected {len(ids)} items in a column, got {len(column)}")
    return ids


def _each_once(column: list[str]) -> list[str]:
    """The same texts, but those that are equal are mostly one object: fewer to keep, to hash and to compare."""
    different = set(column)
    if len(different) * _FEW > len(column):
        return column
    return list(map(dict(zip(different, different, strict=True)).__getitem__, column))


@functools.cache
def _reading(type_: type[msgspec.Struct]) -> tuple[list[Any], Callable[[Any], Any]]:
    """The types of the columns but the first, and what decodes all. Made when something is read: few openings do."""
    types = [field.type for field in msgspec.structs.fields(type_)]
    columns = tuple(list[item] for item in types)
    return types[1:], msgspec.msgpack.Decoder(tuple[columns]).decode
