"""Files of checked records: each record that is read was written whole, directly after the record before it.

A record begins with its length, and with its length XOR the checksum of the record before it. That value also starts
the record's own checksum. So a wrong length differs from an unfinished record, and no record can be left out. The first
record continues from the checksum of the file's header.
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

from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogLocked
from rr_actors.base.folder import NotAFile, NotOurs
from rr_actors.base.scarcity import wanted_by

_RECORD = struct.Struct("<III")  # the body's length, that XOR the checksum before, the checksum


class Place(NamedTuple):
    """The end of a file or of a record in it: the byte after it, and its checksum."""

    at: int
    checksum: int


def record(body: bytes, before: int) -> tuple[bytes, int]:
    """Return a record's bytes and its checksum. `before` is the checksum of the record before it."""
    length = len(body)
    first = before ^ length
    checksum = zlib.crc32(body, first)
    return _RECORD.pack(length, first, checksum) + body, checksum


def records(data: bytes, begin: Place) -> Iterator[tuple[bytes, Place]]:
    """Yield the records after `begin`, each with its end, up to the first damaged or unfinished one."""
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
    """Return whether the bytes after the last good record can be the beginning of an unfinished record."""
    left = len(data) - end.at
    if left < _RECORD.size:
        return True
    length, first, _ = _RECORD.unpack_from(data, end.at)
    return length > 0 and first == end.checksum ^ length and left < _RECORD.size + length


def write_whole(fd: int, data: bytes, begin: int) -> int:
    """Write all of `data` at the file's end, which is at `begin`, or nothing and raise an OSError; return the new end.

    The rest of a failed attempt is cut off. If that fails, the next record overwrites it, and readers ignore it.
    """
    end = begin + len(data)
    try:
        at = begin + os.pwrite(fd, data, begin)
        while at < end:  # the disk became full at `at`
            at += os.pwrite(fd, data[at - end :], at)
    except BaseException:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, begin)
        raise
    return end


# Damage: the stored bytes are not those that were written; and the errors for users.

_NOT_ITS_FAULT = {  # errors that do not come from the file's content
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_NOMEM,
}


_DESCRIPTORS = 8
"""More descriptors than SQLite has open at a time for one catalog."""
_ROOM_BYTES = 65_536
"""More bytes than SQLite adds to a file at a time."""


class Damage(Exception):
    """A catalog's file has wrong content. The text continues "expected a catalog, got"."""


def damaged(path: Path, got: str, cause: Exception | None = None) -> NoReturn:
    """Raise CatalogDamaged; `got` describes what is in the catalog's place."""
    raise CatalogDamaged(
        f"{path}: expected a catalog, got {got}; it is left as it is. Put a good copy in its place, move it away to"
        ' start with an empty catalog, or set on_damage = "aside" to have that done',
        path=str(path),
    ) from cause


def _want_of_sqlite(error: sqlite3.Error, path: Path) -> BaseException | None:
    """Return an error that names the resource SQLite lacked, or None. Some of its codes leave that open: test then."""
    code = getattr(error, "sqlite_errorcode", 0)
    match sqlite3.SQLITE_NOMEM if code == sqlite3.SQLITE_IOERR_NOMEM else code & 0xFF:
        case sqlite3.SQLITE_NOMEM:
            return MemoryError()
        case sqlite3.SQLITE_FULL:
            return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        case sqlite3.SQLITE_CANTOPEN:
            with contextlib.ExitStack() as opened:  # SQLite has closed its own files by now
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
    """Turn an error of the block into a CatalogDamaged or a CatalogError, which names the catalog."""
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
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise CatalogLocked(
                f"{path}: expected a catalog that nobody has open, got one that another process has locked ({error});"
                " close it there",
                path=str(path),
                pid=None,
            ) from error
        if code in _NOT_ITS_FAULT:
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
