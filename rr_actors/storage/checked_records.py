"""Files of checked records: a record that is read was written whole, and behind the one that is read before it.

A record begins with its length, and with that length joined to the checksum of the record before it, by which its
checksum is begun. So a wrong length differs from a record that was never finished, and nothing can be left out. The
first one goes on from the checksum of the file's header.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import struct
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import NamedTuple, NoReturn

from rr_actors.base.errors import CatalogDamaged, CatalogError
from rr_actors.base.folder import NotAFile, NotOurs
from rr_actors.base.scarcity import wanted_by

_RECORD = struct.Struct("<III")  # length of what follows, that with the checksum before, checksum


class Place(NamedTuple):
    """Where a file ends, or a record in it: the byte after it, its checksum."""

    at: int
    checksum: int


def record(body: bytes, before: int) -> tuple[bytes, int]:
    """Return a record as it is written, and its checksum. `before`: that of the one before it."""
    length = len(body)
    first = before ^ length
    checksum = zlib.crc32(body, first)
    return _RECORD.pack(length, first, checksum) + body, checksum


def records(data: bytes, begin: Place) -> Iterator[tuple[bytes, Place]]:
    """Yield the whole records behind `begin`, and where each ends, up to the first that is not as it was written."""
    at, checksum = begin
    while at + _RECORD.size <= len(data):
        length, first, expected = _RECORD.unpack_from(data, at)
        start = at + _RECORD.size
        body = data[start : start + length]
        if not length or first != checksum ^ length or len(body) < length or zlib.crc32(body, first) != expected:
            return
        at, checksum = start + length, expected
        yield body, Place(at, checksum)


def is_torn(data: bytes, end: Place) -> bool:
    """Whether what is behind the last good record can be the beginning of one that was never finished."""
    left = len(data) - end.at
    if left < _RECORD.size:
        return True
    length, first, _ = _RECORD.unpack_from(data, end.at)
    return length > 0 and first == end.checksum ^ length and left < _RECORD.size + length


def write_whole(fd: int, data: bytes, begin: int) -> int:
    """Write all of it at the end of a file, which is at `begin`, or nothing; return where the file ends then.

    What a failed attempt leaves is cut off, or else written over or ignored.

    Raises:
        OSError: it could not be written.
    """
    end = begin + len(data)
    try:
        at = begin + os.pwrite(fd, data, begin)
        while at < end:  # the disk was full there
            at += os.pwrite(fd, data[at - end :], at)
    except BaseException:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, begin)
        raise
    return end


# Damage: what is stored is not what was written; and the errors that users get of it.

_NOT_ITS_FAULT = {  # errors that say nothing about the file's contents
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOMEM,
}


_DESCRIPTORS = 8
"""More than SQLite has open at a time for one catalog."""
_ROOM_BYTES = 65_536
"""More than SQLite makes a file longer by."""


class Damage(Exception):
    """Something read is not what a catalog has there. The text goes on from "expected a catalog, got"."""


def damaged(path: Path, got: str, cause: Exception | None = None) -> NoReturn:
    """Raise CatalogDamaged for a catalog that is `got` instead."""
    raise CatalogDamaged(
        f"{path}: expected a catalog, got {got}; it is left as it is. Put a good copy in its place, move it away to"
        ' start with an empty catalog, or set on_damage = "aside" to have that done',
        path=str(path),
    ) from cause


def _want_of_sqlite(error: sqlite3.Error, path: Path) -> BaseException | None:
    """Return what says that SQLite had too little of something. It does not say so of all: then look."""
    code = getattr(error, "sqlite_errorcode", 0)
    match sqlite3.SQLITE_NOMEM if code == sqlite3.SQLITE_IOERR_NOMEM else code & 0xFF:
        case sqlite3.SQLITE_NOMEM:
            return MemoryError()
        case sqlite3.SQLITE_FULL:
            return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        case sqlite3.SQLITE_CANTOPEN:
            with contextlib.ExitStack() as opened:  # what it had opened itself is closed by now
                try:
                    for _ in range(_DESCRIPTORS):
                        opened.callback(os.close, os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
                except OSError as now:
                    return now if wanted_by(now) else None
        case sqlite3.SQLITE_IOERR:  # also where it could not make a file longer
            with contextlib.suppress(OSError):
                disk = os.statvfs(path.parent)
                if disk.f_bavail * disk.f_frsize < _ROOM_BYTES:
                    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        case _:
            pass
    return None


@contextlib.contextmanager
def errors_named(path: Path) -> Generator[None]:
    """Make of what goes wrong with a catalog an error that names it: CatalogDamaged, or CatalogError."""
    try:
        yield
    except (Damage, UnicodeDecodeError) as error:
        damaged(path, str(error), error)
    except NotAFile as error:
        damaged(path, f"{Path(error.filename).name}, which is no file but {error.got}", error)
    except NotOurs as error:
        raise CatalogError(
            f"{error.filename}: {error.strerror}; make it yours if you trust what is in it, or choose another location",
            path=str(error.filename),
        ) from error
    except sqlite3.Error as error:
        if (want := _want_of_sqlite(error, path)) is not None:
            want.__cause__ = error
            text = f"{path}: {error}; the catalog is left as it is. {wanted_by(want)}"
            raise CatalogError(text, path=str(path)) from want
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _NOT_ITS_FAULT:
            raise CatalogError(
                f"{path}: expected to read and write the catalog, got: {error}. It is left as it is."
                " See that its file may be written and that the disk has room, and try again",
                path=str(path),
            ) from error
        damaged(path, f"one that SQLite cannot read: {error}", error)
    except OSError as error:
        if wanted := wanted_by(error):
            raise CatalogError(
                f"{path}: the catalog cannot be opened; it is left as it is. {wanted}", path=str(path)
            ) from error
        raise CatalogError(
            f"{path}: expected a directory and files that this process may read and write, got: {error.strerror}"
            f" ({error.filename})",
            path=str(path),
        ) from error
