"""Damage: what is stored is not what was written; and the errors that users get of it."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Generator
from pathlib import Path
from typing import NoReturn

from rr_actors.errors import CatalogDamaged, CatalogError
from rr_actors.folder import NotAFile, NotOurs

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


class Damage(Exception):
    """Something read is not what a catalog has there. The text goes on from "expected a catalog, got"."""


def damaged(path: Path, got: str, cause: Exception | None = None) -> NoReturn:
    """Raise CatalogDamaged for a catalog that is `got` instead."""
    raise CatalogDamaged(
        f"{path}: expected a catalog, got {got}; it is left as it is. Put a good copy in its place, move it away to"
        ' start with an empty catalog, or set on_damage = "aside" to have that done',
        path=str(path),
    ) from cause


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
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _NOT_ITS_FAULT:
            raise CatalogError(
                f"{path}: expected to read and write the catalog, got: {error}. It is left as it is."
                " See that its file may be written and that the disk has room, and try again",
                path=str(path),
            ) from error
        damaged(path, f"one that SQLite cannot read: {error}", error)
    except OSError as error:
        raise CatalogError(
            f"{path}: expected a directory and files that this process may read and write, got: {error.strerror}"
            f" ({error.filename})",
            path=str(path),
        ) from error
