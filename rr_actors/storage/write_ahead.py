"""The -wal of a catalog: a second copy of it while SQLite copies it into the catalog's file, and what a crash left.

While SQLite copies pages into the file, the file has new pages and old ones, and only the -wal completes it. One
damaged byte of the -wal would then lose rows that are in no other file. The spare, catalog.sqlite3.spare-wal, is a
second -wal for that time.
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

from rr_actors.base.errors import CatalogDamaged
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

    Args:
        folder, path: the catalog's directory, and its file there.
        synced: whether a power cut, too, leaves a whole spare while SQLite copies the -wal, and no spare after that: an
            earlier one would put old pages into the file.

    Attributes:
        is_made: whether there is one.
    """

    def __init__(self, folder: Folder, path: Path, *, synced: bool = False) -> None:
        self.is_made = False
        self._synced = synced
        self._folder = folder
        self._wal, self._shm = f"{path.name}-wal", f"{path.name}-shm"
        self._path = path
        self._name = f"{path.name}.spare-wal"
        self._copy = f"{path.name}.copy"  # as the -wal of this file SQLite reads a spare that is being made
        self._index: io.FileIO | None = None

    def close(self) -> None:
        """Close the -shm, after SQLite has: a process that closes it loses the locks that SQLite has on it."""
        index, self._index = self._index, None
        if index is not None:
            index.close()

    def frames(self) -> int:
        """Return how many frames SQLite has written to the -wal and not yet copied for good."""
        if self._index is None:
            self._index = self._folder.open(self._shm)
        return _committed(os.pread(self._index.fileno(), _INDEX_BYTES, 0))

    def make(self, number: int, frames: int) -> None:
        """Copy the -wal, which has so many frames and all up to commit `number`, and have SQLite check the copy.

        An earlier spare is replaced by a rename.

        Raises:
            CatalogDamaged: the -wal is not what SQLite has written to it; an earlier spare stays.
            OSError, sqlite3.Error: there is no room for a copy, say.
        """
        try:
            data = self._read(self._wal)
            data = data[: _WAL_HEADER + frames * (_FRAME_HEADER + int.from_bytes(data[_PAGE_AT : _PAGE_AT + 4], "big"))]
            data += _TRAILER.pack(number, zlib.crc32(data + number.to_bytes(8, "little")))
            self._write(f"{self._copy}-wal", data)
            if (sound := self._sound_frames()) < frames:
                raise CatalogDamaged(
                    f"{self._path}: expected {self._wal} as it was written, got {sound} sound pages of {frames}; it is"
                    " not copied into the catalog's file. See whether the disk is good",
                    path=str(self._path),
                )
            if self._synced:
                with self._folder.open(f"{self._copy}-wal") as file:
                    os.fsync(file.fileno())
            self._folder.rename(f"{self._copy}-wal", self._name)
            if self._synced:
                os.fsync(self._folder.fd)
            self.is_made = True
        finally:
            self._tidy_up()

    def _sound_frames(self) -> int:
        """Return how many frames of the new copy SQLite takes when it reads all of it."""
        self._write(self._copy, _empty())
        try:
            with _reading(self._path.with_name(self._copy), "mode=ro") as connection:
                connection.execute("PRAGMA schema_version").fetchall()
                return _committed(self._folder.read(f"{self._copy}-shm"))
        except sqlite3.DatabaseError as error:  # without its -wal, one page is no database
            if error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
                return 0
            raise

    def remove(self) -> bool:
        """Remove the spare if there is one; return whether there is none then."""
        was_there = not self.is_gone()
        self._folder.discard(self._name)
        self.is_made = False
        if self._synced and was_there:
            os.fsync(self._folder.fd)
        return self.is_gone()

    def is_gone(self) -> bool:
        """Return whether there is no file of a spare, not even a useless one."""
        return not self._folder.has(self._name)

    def _tidy_up(self) -> None:
        """Remove what the check of a copy leaves."""
        for name in leftovers(self._path):
            self._folder.discard(name)

    def _read(self, name: str) -> bytes:
        try:
            return self._folder.read(name)
        except FileNotFoundError:
            return b""

    def _write(self, name: str, data: bytes) -> None:
        with io.BufferedWriter(self._folder.open(name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)) as file:
            file.write(data)

    def recover(self, settled: int) -> None:
        """Mend the -wal with a spare that was made of it, and keep the spare; remove one that is of no use.

        No process may have the catalog's file open.

        Args:
            settled: the number of the last commit that the catalog's file is known to have without its -wal.
        """
        self._tidy_up()
        if not self._folder.has(self._name):
            return
        spare, number = _checked(self._folder.read(self._name))
        wal = self._read(self._wal)
        if number is None or number <= settled or self._is_outdated(spare, number, wal):
            self.remove()
            return
        self.is_made = True
        if wal[: len(spare)] == spare:
            return
        self._folder.write(self._wal, spare + wal[len(spare) :], synced=self._synced)
        self._folder.discard(self._shm)
        if wal:  # a crash may come between the end of the copying, when the -wal is emptied, and the spare's removal
            _log.warning(
                "%s: %s: not as it was written, and mended from a copy: nothing is lost. See whether the disk is good",
                self._path,
                self._wal,
            )

    def _is_outdated(self, spare: bytes, number: int, wal: bytes) -> bool:
        """Return whether SQLite has begun the -wal anew since then: it does so once the file has all of the spare."""
        if _generation(wal) in (None, spare[_SALTS]):
            return False
        found = _meta(self._path, "mode=ro")  # an earlier -wal, put back, has an earlier number
        return found is not None and found.folded >= number

    def check(self) -> None:
        """Raise Damage if the -wal is not that of the spare: only recover() gets the right rows."""
        spare, number = _checked(self._read(self._name))  # nearly always nothing
        wal = self._read(self._wal)
        if number is None:
            return
        is_mixed = not wal and not _has_all(self._read(self._path.name), spare)
        if is_mixed or (_generation(wal) == spare[_SALTS] and wal[: len(spare)] != spare):
            raise Damage(f"{self._wal}, which is damaged or missing; opening the catalog mends it")


def leftovers(path: Path) -> list[str]:
    """Return the names of files that a crash leaves of the making, or the use, of a spare."""
    copy = f"{path.name}.copy"
    return [copy, f"{copy}-wal", f"{copy}-shm", f".{path.name}-wal.new"]


def settled_before(folder: Folder, path: Path, spare: Spare, settled: int) -> int:
    """Look at a catalog's file without its -wal, and return the number of the last commit that it has for certain.

    A -wal that is older than the file is renamed to <name>-wal.old: SQLite would write it over the newer pages. No
    process may have the file open.

    Args:
        spare: what a crash has left of it, after recover().
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
    if spare.is_made or alone is None:  # copied in part: the -wal has the missing pages
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
        with _reading(path, how) as connection:
            return sql_tables.read_meta(connection)
    except (sqlite3.Error, Damage):  # the reading of the whole catalog says what is wrong
        return None


def _reading(path: Path, how: str) -> contextlib.closing[sqlite3.Connection]:
    return contextlib.closing(sqlite3.connect(f"{path.as_uri()}?{how}", uri=True, isolation_level=None))


def _committed(shm: bytes) -> int:
    return struct.unpack_from("=I", shm, _COMMITTED_AT)[0]


def _checked(data: bytes) -> tuple[bytes, int | None]:
    """Return the -wal in a spare, and the number of its last commit; None if the spare was not written whole."""
    if len(data) < _TRAILER.size + _WAL_HEADER:
        return b"", None
    wal = data[: -_TRAILER.size]
    number, checksum = _TRAILER.unpack(data[-_TRAILER.size :])
    return wal, number if zlib.crc32(wal + number.to_bytes(8, "little")) == checksum else None


def _has_all(file: bytes, wal: bytes) -> bool:
    """Return whether a catalog's file has the last version of each page in a sound -wal."""
    size = int.from_bytes(wal[_PAGE_AT : _PAGE_AT + 4], "big")
    last: dict[int, int] = {}  # the place of each page's last frame
    pages = 0
    for at in range(_WAL_HEADER, len(wal), _FRAME_HEADER + size):
        number, pages = struct.unpack_from(">2I", wal, at)
        last[number - 1] = at + _FRAME_HEADER
    return all(
        file[page * size : (page + 1) * size] == wal[at : at + size] for page, at in last.items() if page < pages
    )


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
