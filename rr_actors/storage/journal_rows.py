"""Rows in the records of a journal: checked before they are written, and decoded when they are read."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

import msgspec

from rr_actors.registrar.model.rows import TABLES, Change, Drop, Int64, Put, Row, Table
from rr_actors.storage.damage import Damage

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
