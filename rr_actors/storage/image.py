"""Image: the rows of a large catalog once more, as its SQLite file has them, but read in a fraction of the time.

Whatever is folded into the tables is put at the image's end before, with a mark that says of which folding it is. At
opening, the image is what it says it is if it has the mark of the last folding that SQLite knows of. If it has not, or
is not whole, the tables are read, and another image is made in time: nothing depends on it. So its errors go to
the log alone.

What is out of date stays in it until it is larger than the tables; it is written anew then.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import struct
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import chain, repeat
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec

from rr_actors.base.errors import CatalogError
from rr_actors.base.folder import Folder
from rr_actors.registrar.model.rows import TABLES, Content, Table, content_of
from rr_actors.storage import checked_records, sql_tables
from rr_actors.storage.checked_records import Damage, Place

LARGE_BYTES = 4 * 2**20
"""Of a catalog's tables, from which it has an image."""

_MAGIC = b"RRACI\0\0\2"
_HEADER = struct.Struct("<8s16sII")  # magic, id, schema, checksum of all that
_SCHEMA = zlib.crc32(repr(sql_tables.SCHEMA).encode())
_ROWS = 1000  # in a block, at most
_BLOCK_BYTES = 2**20  # of requests, responses and the like, at most, but for one row that has more
_AT_ONCE_BYTES = 2**20  # to be written
_SPARE_BYTES = 2**20  # that an image may be larger than the tables
_GROWN = 1.5  # times what it was when it was written anew, at least, before that is done again,
_SHRUNK = 2  # or the tables have so many times less than then
_SMALL = 4  # so many times less than LARGE_BYTES, and it is removed

# What may come of a file, of what is in it, and of making something of that.
_ITS_ERRORS = (
    OSError,
    Damage,
    CatalogError,
    msgspec.MsgspecError,
    ValueError,
    OverflowError,
    RecursionError,
    MemoryError,
)

_log = logging.getLogger(__name__)


class Source(Protocol):
    """What it is an image of: the tables, after a folding."""

    @property
    def meta(self) -> sql_tables.Meta:
        """What the catalog says of itself."""
        ...

    def rows(self) -> Iterator[tuple[Table, list[Any]]]:
        """Yield all rows, some of one table at a time.

        Raises:
            CatalogError: they cannot be read.
        """
        ...

    def used_bytes(self) -> int:
        """Return how much of the file has rows in it, about.

        Raises:
            CatalogError: it cannot be read.
        """
        ...


class _Block(msgspec.Struct, array_like=True, tag=0):
    table: Table
    rows: msgspec.Raw


class _Gone(msgspec.Struct, array_like=True, tag=1):
    table: Table
    ids: list[str]


class Mark(msgspec.Struct, array_like=True, tag=2, frozen=True):
    """What is before it is what the tables are after this folding: in which opening of the catalog, which segment."""

    opening: str
    folded: int


_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(_Block | _Gone | Mark).decode


class Image:
    """A catalog's image, whether there is one or not. Usable from any thread, one at a time.

    It takes no file descriptor but while it reads or writes.
    """

    def __init__(self, folder: Folder, catalog: Path) -> None:
        self._folder = folder
        self._catalog = catalog
        self._name = path_of(catalog).name
        self._new = f"{self._name}.new"
        self._end: Place | None = None  # None: there is none that can be gone on with
        self._made_bytes = 0  # when it was written anew, if that is known
        self._made_of_bytes = 0  # what the tables had then
        self._given_up = False

    def rows(self, meta: sql_tables.Meta) -> Content | None:
        """Return the rows that the tables have, or None. From then on it can be gone on with, if there are any."""
        self._end = None
        mark = Mark(meta.opening, meta.folded)
        found = content_of(())
        try:
            for part, end in self._parts(_header(meta.id)):
                match part:
                    case _Block(table, packed):
                        found[table].update(zip(*rows_of_block(packed, TABLES[table]), strict=True))
                    case _Gone(table, ids):
                        for id in ids:
                            found[table].pop(id, None)
                    case _:
                        if part == mark:
                            self._end = end
                            return found
        except FileNotFoundError:
            return None
        except _ITS_ERRORS as error:
            _log.warning("%s: its image: %s; its tables are read instead, which takes longer", self._catalog, error)
            return None
        _log.info("%s: its image is of another state than its tables, which are read instead", self._catalog)
        return None

    def begin(self, net: sql_tables.Net, mark: Mark) -> None:
        """Go on with it in another opening of the catalog, which begins with this folding; else let there be none."""
        if self._end is None:
            self.remove()
        else:
            self._folder.discard(self._new)
            self.add(net, mark)

    def add(self, net: sql_tables.Net, mark: Mark) -> None:
        """Put what is about to be folded at its end, if there is one."""
        if self._end is None:
            return
        with self._giving_up_if_it_fails():
            fd = self._folder.open(self._name, os.O_WRONLY)
            try:
                os.ftruncate(fd, self._end.at)  # behind it is what was never folded
                self._end = _write(fd, chain(_changed(net), [_encode(mark)]), self._end)
            finally:
                os.close(fd)

    def keep(self, source: Source) -> None:
        """Make it, if the catalog is large and it has none; write it anew if much in it is out of date.

        It is removed if the catalog is not large any more.
        """
        if self._given_up:
            return
        with self._giving_up_if_it_fails():
            used = source.used_bytes()
            if self._end is None:
                if used >= LARGE_BYTES:
                    self._make(source, used)
            elif used < LARGE_BYTES // _SMALL:
                self.remove()
            elif self._end.at > used + _SPARE_BYTES and (
                self._end.at > _GROWN * self._made_bytes or used < self._made_of_bytes // _SHRUNK
            ):
                self._make(source, used)

    def remove(self) -> None:
        """Let there be none. One that cannot be removed has no mark of any later state."""
        self._end = None
        for name in (self._name, self._new):
            self._folder.discard(name)

    def _make(self, source: Source, used: int) -> None:
        meta = source.meta
        header = _header(meta.id)
        self._folder.discard(self._new)
        fd = self._folder.open(self._new, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        try:
            checked_records.write_whole(fd, header, 0)
            end = _write(fd, _blocks(source.rows()), _begin(header))
            end = _write(fd, [_encode(Mark(meta.opening, meta.folded))], end)
        finally:
            os.close(fd)
        self._folder.rename(self._new, self._name)
        self._end = end
        self._made_bytes, self._made_of_bytes = end.at, used

    def _parts(self, header: bytes) -> Iterator[tuple[_Block | _Gone | Mark, Place]]:
        data = self._folder.read(self._name)
        if not data.startswith(header):
            raise Damage("another catalog's, or another version's")
        for body, end in checked_records.records(data, _begin(header)):
            yield _decode(body), end

    @contextlib.contextmanager
    def _giving_up_if_it_fails(self) -> Generator[None]:
        try:
            yield
        except _ITS_ERRORS as error:
            self._given_up = True
            self.remove()
            _log.warning(
                "%s: its image: %s; it has none until it is opened again, which takes longer then", self._catalog, error
            )


def path_of(catalog: Path) -> Path:
    """Return where a catalog's image is, if it has one."""
    return catalog.with_name(f"{catalog.stem}.image")


def _header(id_: str) -> bytes:
    header = _HEADER.pack(_MAGIC, id_.encode(), _SCHEMA, 0)
    return header[:-4] + zlib.crc32(header[:-4]).to_bytes(4, "little")


def _begin(header: bytes) -> Place:
    return Place(len(header), int.from_bytes(header[-4:], "little"))


def _changed(net: sql_tables.Net) -> Iterator[bytes]:
    yield from _blocks((table, list(rows.values())) for table, rows in net.puts.items())
    for table, ids in net.drops.items():
        if ids:
            yield _encode(_Gone(table, list(ids)))


def _blocks(some: Iterable[tuple[Table, list[Any]]]) -> Iterator[bytes]:
    for table, rows in some:
        for part in _cut(table, rows):
            yield _encode(_Block(table, msgspec.Raw(packed(part))))


def _cut(table: Table, rows: list[Any]) -> Iterator[list[Any]]:
    """The rows, not too many at a time, and not too much: they are encoded in memory."""
    begin = size = 0
    for at, more in enumerate(_sizes(table, rows)):
        size += more
        if at > begin and (at - begin >= _ROWS or size > _BLOCK_BYTES):
            yield rows[begin:at]
            begin, size = at, more
    if rows:
        yield rows[begin:]


def _sizes(table: Table, rows: list[Any]) -> Iterable[int]:
    """How long a row's bytes are; texts are short."""
    names = [field.name for field in msgspec.structs.fields(TABLES[table]) if field.type in (bytes, bytes | None)]
    if not names:
        return repeat(0, len(rows))
    columns = (map(attrgetter(name), rows) for name in names)
    return (sum([len(value) for value in values if value]) for values in zip(*columns, strict=True))


def _write(fd: int, bodies: Iterable[bytes], end: Place) -> Place:
    at, checksum = end
    waiting: list[bytes] = []
    size = 0
    for body in bodies:
        record, checksum = checked_records.record(body, checksum)
        waiting.append(record)
        size += len(record)
        if size > _AT_ONCE_BYTES:
            at = checked_records.write_whole(fd, b"".join(waiting), at)
            waiting, size = [], 0
    return Place(checked_records.write_whole(fd, b"".join(waiting), at), checksum)


# Blocks: some rows of one table by their columns, to be written and read many at once.
#
# A column in which all is the same has one item, one that is as the ids has none: there is less to write, to read
# and to
# keep then, as what was one object is one again.

_FEW = 4  # times that a text is in a column, at least, on average, to be looked for

R = TypeVar("R", bound=msgspec.Struct)

_values_of = msgspec.structs.astuple


def packed(rows: Sequence[msgspec.Struct]) -> bytes:
    """Return rows of one type, of which there are some, as MessagePack."""
    ids, *columns = zip(*map(_values_of, rows), strict=True)
    return _encode([ids, *(_shortened(column, ids) for column in columns)])


def rows_of_block(data: bytes | msgspec.Raw, type_: type[R]) -> tuple[list[str], list[R]]:
    """Return the ids, and the rows.

    Raises:
        msgspec.MsgspecError, ValueError: they are not rows of this type.
    """
    types, decode = _reading(type_)
    ids, *columns = decode(data)
    if not ids:
        raise ValueError("expected rows, got none")
    return ids, list(map(type_, ids, *(map(_at_length, columns, types, repeat(ids)))))


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
