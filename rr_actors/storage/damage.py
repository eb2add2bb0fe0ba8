"""Damage: the stored bytes of a catalog are not those that were written; and the errors of its files for users."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from collections.abc import Generator
from pathlib import Path
from typing import NoReturn

from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogLocked
from rr_actors.base.folder import NotAFile, NotOurs
from rr_actors.base.scarcity import wanted_by

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
