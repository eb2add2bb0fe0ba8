"""Journals: good segments with wrong bytes, cut, emptied, missing, swapped, or forged with good checksums."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from fuzz.target import Feed, Target
from rr_actors.base.errors import CatalogDamaged
from rr_actors.base.folder import Folder
from rr_actors.registrar.model.rows import (
    TABLE_OF,
    Change,
    Drop,
    Peer,
    Phase,
    Put,
    Resource,
    Row,
    ServedQuery,
    State,
    apply,
    content_of,
    rows_of,
)
from rr_actors.storage import journaled_store
from rr_actors.storage.damage import Damage
from rr_actors.storage.journaled_store import End, Segment
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.storage.sql_tables import Meta
from rr_actors.storage.sqlite_store import read_catalog

_Segments = list[bytes | None]
_HEADER = 56
_RECORD = struct.Struct("<III")
_PARTS: list[list[list[Change]]] = [
    [[Put(ServedQuery("a", "r", "app", "", 1, 1)), Put(Peer("maker"))], [Put(ServedQuery("a", "r", "app", "", 1, 2))]],
    [[Put(Resource("r", "thing", b"q" * 40, None, Phase.LOADED, State.OK, "", 1)), Drop("queries", "a")]],
    [
        [Put(ServedQuery("b", "r", "app", "", 1, 2**62))],
        [Drop("peers", "maker")],
        [Put(ServedQuery("c", "", "", "", 1, -1))],
    ],
    [[Drop("resources", "r"), Put(ServedQuery("b", "r", "app", "", 2, 7))]],
]
"""Commits, by segment."""


def _states() -> list[set[Row]]:
    """What there is after each commit."""
    rows: dict[tuple[str, str], Row] = {}
    found: list[set[Row]] = [set()]
    for change in (changes for part in _PARTS for changes in part):
        for one in change:
            if isinstance(one, Put):
                rows[TABLE_OF[type(one.row)], one.row.id] = one.row
            else:
                rows.pop((one.table, one.id), None)
        found.append(set(rows.values()))
    return found


def _written(folder: Folder, catalog: Path, meta: Meta) -> list[bytes]:
    found: list[bytes] = []
    end = End()
    for number, part in enumerate(_PARTS, 1):
        segment = Segment(folder, catalog, meta, number, end)
        for changes in part:
            segment.append(changes)
        end = segment.end
        segment.close()
        found.append(folder.read(segment.name))
        segment.remove()
    return found


# -- damage --------------------------------------------------------------------------------------------------------


class _Taken:
    """The input, taken byte by byte; zeros after its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    @property
    def ended(self) -> bool:
        return not self._data

    def number(self, limit: int) -> int:
        return int.from_bytes(self.bytes(2), "big") % limit if limit else 0

    def bytes(self, size: int) -> bytes:
        found, self._data = self._data[:size], self._data[size:]
        return found.ljust(size, b"\0")


def _changed(segments: _Segments, n: int, taken: _Taken) -> None:
    old = segments[n] or b""
    at = taken.number(len(old) + 1)
    new = taken.bytes(1 + taken.number(12))
    segments[n] = old[:at] + new + old[at + len(new) * (taken.number(4) > 0) :]  # or put in between


def _cut(segments: _Segments, n: int, taken: _Taken) -> None:
    old = segments[n] or b""
    segments[n] = old[: taken.number(len(old) + 1)]


def _zeros(segments: _Segments, n: int, taken: _Taken) -> None:
    old = segments[n] or b""
    kept = taken.number(len(old) + 1)
    segments[n] = old[:kept] + bytes(len(old) - kept + taken.number(100))


def _missing(segments: _Segments, n: int, _taken: _Taken) -> None:
    segments[n] = None


def _swapped(segments: _Segments, n: int, taken: _Taken) -> None:
    other = taken.number(len(segments))
    segments[n], segments[other] = segments[other], segments[n]


def _forged(segments: _Segments, n: int, taken: _Taken) -> None:
    """A record of any bytes at the end, whose checksum is right."""
    old = segments[n] or b""
    if len(old) < _HEADER:
        return
    checksum: int = struct.unpack_from("<I", old, _HEADER - 4)[0]
    at = _HEADER
    while at + _RECORD.size <= len(old):
        length, first, expected = _RECORD.unpack_from(old, at)
        body = old[at + _RECORD.size : at + _RECORD.size + length]
        if not length or first != checksum ^ length or zlib.crc32(body, first) != expected:
            break
        at, checksum = at + _RECORD.size + length, expected
    body = taken.bytes(1 + taken.number(80))
    segments[n] = old[:at] + journaled_store.record(body, checksum)[0]


_DAMAGES: list[Callable[[_Segments, int, _Taken], None]] = [_changed, _cut, _zeros, _missing, _swapped, _forged]


# -- the target ----------------------------------------------------------------------------------------------------


def _prepare(directory: Path) -> Feed:
    """Byte 0: how many segments are folded, and whether the catalog is opened, too; the rest: what is done to them."""
    place = directory / "registrar"
    path = place / "catalog.sqlite3"
    open_store(path, durability="power").close()  # has its file from the first opening on
    empty = path.read_bytes()
    folder = Folder.at(place)
    meta, _ = read_catalog(folder, path)
    good = _written(folder, path, meta)
    states = _states()
    folded_at = [sum(map(len, _PARTS[:n])) for n in range(len(_PARTS) + 1)]

    def feed(data: bytes) -> None:
        taken = _Taken(data)
        first = taken.bytes(1)[0]
        folded = first % len(folded_at)
        segments: _Segments = list(good)
        forged = False
        while not taken.ended:
            kind = _DAMAGES[taken.number(len(_DAMAGES))]
            kind(segments, taken.number(len(segments)), taken)
            forged = forged or kind is _forged
        for file in place.iterdir():
            file.unlink()
        for number, content in enumerate(segments, 1):
            if content is not None:
                (place / f"catalog.journal.{number}").write_bytes(content)
        expected = None if forged else states[folded_at[folded] :]
        _read(folder, path, msgspec.structs.replace(meta, folded=folded), states[folded_at[folded]], expected)
        if first == 255:  # a hundred times as slow
            path.write_bytes(empty)
            _open(path, segments, None if forged else states)

    return feed


def _read(folder: Folder, path: Path, meta: Meta, base: set[Row], expected: list[set[Row]] | None) -> None:
    content = content_of(base)
    try:
        apply(content, journaled_store.read(folder, path).since(meta).changes)
    except Damage:
        return
    rows = set(rows_of(content))
    if expected is not None:
        assert rows in expected
    assert rows == set(map(_decoded_again, rows)), "what was read could not be written"


def _decoded_again(row: Row) -> Row:
    return msgspec.msgpack.decode(msgspec.msgpack.encode(row), type=type(row))


def _open(path: Path, segments: _Segments, expected: list[set[Row]] | None) -> None:
    """Read it, then open it: what it held, or a named error that leaves it as it is."""
    try:
        rows = set(read_rows(path))
    except CatalogDamaged as error:
        assert str(path) in str(error)
        try:
            open_store(path)
        except CatalogDamaged:
            left = [path.with_name(f"catalog.journal.{n}") for n in range(1, len(segments) + 1)]
            assert [file.read_bytes() if file.exists() else None for file in left] == segments
            return
        raise AssertionError("it opened") from None
    assert expected is None or rows in expected
    store = open_store(path)
    try:
        assert set(rows_of(store.load())) == rows
        store.commit([Put(Peer("more"))])
    finally:
        store.close()
    assert set(read_rows(path)) == rows | {Peer("more")}
    assert list(path.parent.glob("*.journal.*")) == []


def _seeds() -> list[bytes]:
    kinds = range(len(_DAMAGES))
    some = [bytes([first, 0, kind, 0, n, 0, 3, 0, 9]) for first in (0, 2, 255) for kind in kinds for n in range(4)]
    body = msgspec.msgpack.encode([("queries", ServedQuery("x", "r", "app", "", 1, 1)), ("peers", "maker")])
    forged = [bytes([255, 0, 5, 0, n, 0, len(body) - 1]) + body for n in range(4)]
    return [b"\0", b"\4", b"\xff", *some, *forged]


JOURNAL = Target(
    "journals, with segments that are wrong, cut, missing, swapped or forged",
    _prepare,
    _seeds,
    words=tuple(bytes([0xA0 + len(word)]) + word for word in (b"queries", b"peers", b"resources", b"held", b"notices")),
    longest=160,
)
