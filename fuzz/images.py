"""Images: any record among good ones, with a checksum that is right, and any bytes in the place of some."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from fuzz.packed import after
from fuzz.target import Feed, Target
from rr_actors.folder import Folder
from rr_actors.records import TABLE_OF, Phase, Put, Query, Resource, Row, State, Table, rows_of
from rr_actors.stores import framing, image, tables
from rr_actors.stores.framing import Place
from rr_actors.stores.image import Image, Mark

_META = tables.Meta("0123456789abcdef", epoch=1, folded=1, opening="first")
_ROWS: list[Row] = [Resource("r", "s", b"q", None, Phase.LOADED, State.OK, "", 1), Query("a", "r", "app", "", 1, 1)]
_HEADER = 32
_encode = msgspec.msgpack.encode


class _Tables:
    """What there is an image of: nothing yet."""

    meta = tables.Meta(_META.id, epoch=1, folded=0, opening="first")

    def rows(self) -> Iterator[tuple[Table, list[Any]]]:
        return iter(())

    def used_bytes(self) -> int:
        return image.LARGE_BYTES


def _prepare(directory: Path) -> Feed:
    """Byte 0: 0, the rest is a record's content; else, it replaces what is at that place, counted in eights."""
    catalog = directory / "catalog.sqlite3"
    folder = Folder.at(directory)
    of_tables = Image(folder, catalog)
    of_tables.keep(_Tables())
    of_tables.add(tables.net_of([Put(row) for row in _ROWS]), Mark("first", 1))
    path = image.path_of(catalog)
    good = path.read_bytes()
    checksum = int.from_bytes(good[_HEADER - 4 : _HEADER], "little")
    *_, (_, end), (mark, _) = framing.records(good, Place(_HEADER, checksum))

    def feed(data: bytes) -> None:
        content = data[1:]
        if data[:1] == b"\0" and content:
            record, checksum = framing.record(content, end.checksum)
            path.write_bytes(good[: end.at] + record + framing.record(mark, checksum)[0])
        else:
            at = 8 * sum(data[:1])
            path.write_bytes(good[:at] + content + good[at + len(content) :])
        found = Image(folder, catalog).rows(_META)
        rows = None if found is None else rows_of(found)
        if data[:1] != b"\0":
            assert rows is None or rows == _ROWS
        for row in rows or ():
            assert type(row) in TABLE_OF

    return feed


def _seeds() -> list[bytes]:
    of_tables = [
        [0, "queries", [["b", "c"], [], ["app"], [""], [1], [1, 2]]],
        [0, "peers", [["b"]]],
        [1, "queries", ["a", "b"]],
        [2, "first", 0],
    ]
    return [*(b"\0" + _encode(part) for part in of_tables), *(bytes([at]) + b"\x91" for at in range(1, 12))]


IMAGE = Target("images, with a record that is forged, or wrong bytes", _prepare, _seeds, after(1), longest=200)
