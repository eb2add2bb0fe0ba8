"""The -wal of a catalog: a second copy of it while SQLite copies it into the catalog's file, and what a crash left.

While its pages are copied into the file, the -wal alone makes sense of both. So one damaged byte of it would lose
rows that are in no other file. The spare is a second -wal for that time: catalog.sqlite3.spare-wal.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import sqlite3
import struct
import zlib
from pathlib import Path

from rr_actors.base.folder import Folder
from rr_actors.base.reporting.log import Log
from rr_actors.storage import sql_tables
from rr_actors.storage.damage import Damage

# https://sqlite.org/walformat.html. A -wal: a header of 32 bytes, with the page's size at 8, two salts at 16 and a
# checksum at 24; then frames, each with a header of 24 bytes, which has the salts at 8, and a page.
_WAL_HEADER = 32
_FRAME_HEADER = 24
_SALTS = slice(16, 24)
_FRAMES_SALTS = slice(_WAL_HEADER + 8, _WAL_HEADER + 16)
_PAGE_AT = 8
_COMMITTED_AT = 16  # in a -shm: the number of the -wal's frames that are whole and committed, in the machine's order
_INDEX_BYTES = 48
_LITTLE = b"\x37\x7f\x06\x82"  # the beginning of a -wal whose checksums are those of a little-endian machine
_TRAILER = struct.Struct("<QI")  # the number of the last commit in a spare; the checksum of all that is before

_log = Log(__name__)


class Spare:
    """The second copy of a catalog's -wal. One thread at a time uses it.

    Attributes:
        number: the number of the last commit in it; None while there is none.
    """

    def __init__(self, folder: Folder, path: Path) -> None:
        self.number: int | None = None
        self._folder = folder
        self._wal, self._shm = f"{path.name}-wal", f"{path.name}-shm"
        self._path = path
        self._base = f"{path.name}.spare"  # with this name SQLite itself can read the spare
        self._name = f"{self._base}-wal"
        self._salts = b""
        self._index: io.FileIO | None = None

    def close(self) -> None:
        """Close the -shm, after SQLite has: a process that closes it loses the locks that SQLite has on it."""
        index, self._index = self._index, None
        if index is not None:
            index.close()

    def make(self, number: int) -> None:
        """Copy the -wal, which has all up to commit `number`, and have SQLite check the copy.

        Raises:
            Damage: the -wal is not what SQLite has written to it.
            OSError, sqlite3.Error: there is no room for a copy, say.
        """
        if self._index is None:
            self._index = self._folder.open(self._shm)
        frames = _committed(os.pread(self._index.fileno(), _INDEX_BYTES, 0))
        data = self._folder.read(self._wal)
        data = data[: _WAL_HEADER + frames * (_FRAME_HEADER + int.from_bytes(data[_PAGE_AT : _PAGE_AT + 4], "big"))]
        data += _TRAILER.pack(number, zlib.crc32(data + number.to_bytes(8, "little")))
        self._write(self._name, data)
        self._salts, self.number = data[_SALTS], number
        if self._checked_frames() < frames:
            self.remove()
            raise Damage(f"{self._wal}, which is damaged: fewer than {frames} of its pages pass their checksums")

    def _checked_frames(self) -> int:
        """Return how many frames of the spare SQLite takes when it reads all of it."""
        self._write(self._base, _empty())
        try:
            with _reading(self._path.with_name(self._base)) as connection:
                connection.execute("PRAGMA schema_version").fetchall()
                return _committed(self._folder.read(f"{self._base}-shm"))
        except sqlite3.DatabaseError:  # without its -wal, one page is no database
            return 0
        finally:
            self.tidy_up()

    def is_outdated(self) -> bool:
        """Return whether SQLite has begun the -wal anew: it has copied all of the one that the spare is of."""
        with self._folder.open(self._wal) as file:
            return file.read(_WAL_HEADER)[_SALTS] != self._salts

    def remove(self) -> None:
        """Remove the spare if there is one. One that stays is known by its number, or by its salts."""
        self._folder.discard(self._name)
        self.number = None

    def tidy_up(self) -> None:
        """Remove what the check of a spare leaves."""
        for name in (self._base, f"{self._base}-shm", f".{self._wal}.new"):
            self._folder.discard(name)

    def _write(self, name: str, data: bytes) -> None:
        with io.BufferedWriter(self._folder.open(name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)) as file:
            file.write(data)

    def take_up(self, settled: int) -> None:
        """Read the spare that a crash left, mend the -wal with it, and keep it; remove it if it is of no use.

        Args:
            settled: the number of the last commit that the catalog's file is known to have.
        """
        self.tidy_up()
        if not self._folder.has(self._name):
            return
        spare, number = _checked(self._folder.read(self._name))
        wal = self._folder.read(self._wal) if self._folder.has(self._wal) else b""
        if number is None or number <= settled or _generation(wal) not in (None, spare[_SALTS]):
            self.remove()
            return
        self._salts, self.number = spare[_SALTS], number
        if wal[: len(spare)] == spare:
            return
        self._folder.write(self._wal, spare + wal[len(spare) :])
        self._folder.discard(self._shm)
        if wal:  # a crash may come between the end of the copying, when the -wal is emptied, and the spare's removal
            _log.warning(
                "%s: %s: damaged, and mended from a copy: nothing is lost. See whether the disk is good",
                self._path,
                self._wal,
            )

    def check(self) -> None:
        """Raise Damage if the -wal is not that of the spare: only take_up() gets the right rows."""
        try:
            spare, number = _checked(self._folder.read(self._name))
            wal = self._folder.read(self._wal)
        except FileNotFoundError:  # nearly always
            return
        is_of_it = number is not None and _generation(wal) == spare[_SALTS]
        if is_of_it and wal[: len(spare)] != spare:
            raise Damage(f"{self._wal}, which is damaged; opening the catalog mends it")


def settled_before(folder: Folder, path: Path, spare: Spare, settled: int) -> int:
    """Look at a catalog's file without its -wal, and return the number of the last commit that it has for certain.

    A -wal that is older than the file is renamed to <name>-wal.old: SQLite would write it over the newer pages. No
    process may have the file open.

    Args:
        spare: what a crash has left of it, used again.
        settled: the last commit that the lock says the file has.

    Raises:
        Damage: the file is another catalog's than its -wal, or an older state of the same.
    """
    wal = folder.look(f"{path.name}-wal")
    if not folder.has(path.name):
        return 0
    alone = _meta(path, "immutable=1")
    if wal is None or not wal.st_size:
        return settled if alone is None else alone.folded
    if spare.number is not None or alone is None:  # copied in part: the -wal has the missing pages
        return settled
    if (through := _meta(path, "mode=ro")) is None:
        return settled
    if alone.id != through.id:
        raise Damage(f"that of another registrar or system ({alone.registrar or alone.id}), with this one's -wal")
    if alone.folded < settled:
        raise Damage(
            f"an earlier state of it ({alone.folded} commits or segments instead of {settled}), with a later -wal"
        )
    if (through.epoch, through.folded) < (alone.epoch, alone.folded):
        folder.rename(f"{path.name}-wal", f"{path.name}-wal.old")
        folder.discard(f"{path.name}-shm")
        _log.warning(
            "%s: %s-wal: one of an earlier state of the catalog, renamed to %s-wal.old and not read",
            path,
            path.name,
            path.name,
        )
    return alone.folded


@functools.cache
def _empty() -> bytes:
    """Return the bytes of an SQLite file without tables, in WAL mode."""
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute("PRAGMA user_version = 1")
        image = connection.serialize()
    return image[:18] + b"\2\2" + image[20:]


def _meta(path: Path, how: str) -> sql_tables.Meta | None:
    try:
        with contextlib.closing(
            sqlite3.connect(f"{path.as_uri()}?{how}", uri=True, isolation_level=None)
        ) as connection:
            return sql_tables.read_meta(connection)
    except (sqlite3.Error, Damage):  # the reading of the whole catalog says what is wrong
        return None


def _reading(path: Path) -> contextlib.closing[sqlite3.Connection]:
    return contextlib.closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, isolation_level=None))


def _committed(shm: bytes) -> int:
    return struct.unpack_from("=I", shm, _COMMITTED_AT)[0]


def _checked(data: bytes) -> tuple[bytes, int | None]:
    """Return the -wal in a spare, and the number of its last commit; None if the spare was not written whole."""
    if len(data) < _TRAILER.size + _WAL_HEADER:
        return b"", None
    wal = data[: -_TRAILER.size]
    number, checksum = _TRAILER.unpack(data[-_TRAILER.size :])
    return wal, number if zlib.crc32(wal + number.to_bytes(8, "little")) == checksum else None


def _generation(wal: bytes) -> bytes | None:
    """Return the salts of a -wal; those of its first frame if its header is damaged; None if both are lost."""
    if len(wal) < _FRAMES_SALTS.stop:
        return None
    words = struct.unpack("<6I" if wal.startswith(_LITTLE) else ">6I", wal[:24])
    one = two = 0
    for first, second in zip(words[::2], words[1::2], strict=True):
        one = (one + first + two) & 0xFFFFFFFF
        two = (two + second + one) & 0xFFFFFFFF
    is_sound = any(wal[:24]) and struct.unpack(">2I", wal[24:_WAL_HEADER]) == (one, two)
    salts = wal[_SALTS if is_sound else _FRAMES_SALTS]
    return salts if any(salts) else None
