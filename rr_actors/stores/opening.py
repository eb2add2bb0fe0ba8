"""Opening a catalog: its lock, its files checked and read, what a crash left of its journal folded in.

Until it is known to be good not a byte of it changes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec

from rr_actors.errors import CatalogDamaged, CatalogError, shortened
from rr_actors.records import Change, Content, Row, apply, content_of, rows_of
from rr_actors.store import Store
from rr_actors.stores import image, journal, reading, sqlite, tables
from rr_actors.stores.damage import Damage, damaged, errors_named
from rr_actors.stores.image import Image, Mark
from rr_actors.stores.journal import Owner
from rr_actors.stores.journaled import JournaledStore
from rr_actors.stores.lock import CatalogLock
from rr_actors.stores.privacy import make_private

Durability = Literal["process", "power"]

_PATH_BYTES = 500
"""SQLite's limit is 512 bytes (MAX_PATHNAME in its os_unix.c), the endings ".new", of a catalog that is being made, and
"-journal" included."""

_READINGS = 20  # of a catalog that is opened or closed each time while it is read

_log = logging.getLogger(__name__)


def open_store(
    path: str | os.PathLike[str],
    *,
    durability: Durability = "process",
    on_damage: Literal["refuse", "aside"] = "refuse",
) -> Store:
    """Open the catalog in the file `path`, lock it, read it, and count its epoch up; a new one if there is none.

    `durability` says what a commit survives: "process", SIGKILL; "power", a power cut too. With on_damage="aside" a
    damaged or foreign file is renamed to <name>.damaged-<n>, and an empty catalog takes its place.

    Raises:
        CatalogLocked: it is open already. `.path`, `.pid`
        CatalogDamaged: it is damaged, or not a catalog at all; it is left as it is. `.path`
        CatalogVersion: a newer rr_actors wrote it; it is left as it is. `.path`, `.expected`, `.got`
        CatalogError: it cannot be read or written, or is not this user's alone and cannot be made so. `.path`
    """
    path = Path(path).absolute()
    if (length := len(os.fsencode(path))) > _PATH_BYTES:
        text = f"{shortened(str(path))}: its path has {length} bytes, expected at most {_PATH_BYTES}, as SQLite opens"
        raise CatalogError(f"{text} no longer one; choose a shorter state_dir, or another location", path=str(path))
    with errors_named(path):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        others = (image.path_of(path), path.with_suffix(".lock"))
        make_private(path.parent, [*sqlite.files_of(path), *journal.segments_of(path), *others])
        lock = CatalogLock(path)
        try:
            return _open_locked(path, lock, durability, on_damage)
        except BaseException:
            lock.release()
            raise


def read_rows(path: str | os.PathLike[str]) -> list[Row]:
    """Return the rows of the catalog in the file `path` as they are after some commit, and change nothing.

    It is not locked: another process may have it open.

    Raises:
        CatalogDamaged: it is damaged, or not a catalog at all. `.path`
        CatalogVersion: a newer rr_actors wrote it. `.path`, `.expected`, `.got`
        CatalogError: it cannot be read. `.path`
    """
    path = Path(path).absolute()
    with errors_named(path):
        for _ in range(_READINGS - 1):
            before = _look(path)
            try:
                content = _read(path)[1]
            except (CatalogDamaged, Damage, sqlite3.Error, FileNotFoundError):
                if _look(path) == before:
                    raise
            else:
                after = _look(path)
                if before == after or (before.is_open and after.is_open):
                    return rows_of(content)
        return rows_of(_read(path)[1])


class _Look(msgspec.Struct, frozen=True):
    """A catalog's file from outside. While it is open SQLite shows one state of it; else it must not change."""

    is_open: bool
    file: tuple[int, int, int] | None


def _look(path: Path) -> _Look:
    is_open = sqlite.files_of(path)[1].exists()
    try:
        found = path.stat()
    except FileNotFoundError:
        return _Look(is_open, None)
    return _Look(is_open, (found.st_ino, found.st_size, found.st_mtime_ns))


def _open_locked(path: Path, lock: CatalogLock, durability: Durability, on_damage: str) -> Store:
    of_tables = Image(path)
    try:
        with errors_named(path):
            meta, content, left = _read(path, of_tables.rows)
    except CatalogDamaged as error:
        if on_damage != "aside":
            raise
        of_tables = Image(path)
        meta, content, left = reading.NONE, content_of(()), _Left()
        _log.warning("%s: renamed to %s, and the catalog starts empty", error, _set_aside(path).name)
    if not path.exists():
        meta = sqlite.create(path, durability)
    changes = tables.net_of(left.changes)
    meta = tables.Meta(meta.id, meta.epoch + 1, max(meta.folded, left.last), opening=os.urandom(8).hex())
    if durability == "power":
        of_tables.remove()
    else:
        of_tables.begin(changes, Mark(meta.opening, meta.folded))
    store = sqlite.SqliteStore(path, lock, durability, meta, changes, content)
    for segment in left.segments:
        with contextlib.suppress(OSError):  # it is folded: it is not read again, and removed next time
            segment.unlink()
    return store if durability == "power" else JournaledStore(store, of_tables)


class _Left(msgspec.Struct, frozen=True):
    """What a crash has left of a journal, or another process is just writing."""

    segments: Sequence[Path] = ()
    last: int = 0
    changes: Sequence[Change] = ()


def _read(path: Path, known: reading.Known = lambda _: None) -> tuple[tables.Meta, Content, _Left]:
    """Return what a catalog says of itself, its rows, and what of them is in its journal."""
    found = journal.read(path)  # first: what is folded while this reads, the file has by then
    if found.contents and not path.exists() and journal.segments_of(path):  # else it was erased meanwhile
        damaged(path, f"no such file, but {found.segments[0].name}, which belongs to it")
    meta, content = reading.read_catalog(path, known)
    changes = found.since(meta.folded, Owner(meta.id, meta.epoch))
    apply(content, changes)
    return meta, content, _Left(found.segments, found.last, changes)


def _set_aside(path: Path) -> Path:
    n = 1
    while any(name.startswith(_aside(path, n).name) for name in os.listdir(path.parent)):
        n += 1
    aside = _aside(path, n)
    for old, new in zip(sqlite.files_of(path), sqlite.files_of(aside), strict=True):
        if old.exists():
            old.rename(new)
    for old in (*journal.segments_of(path), image.path_of(path)):
        if old.exists():
            old.rename(aside.with_name(f"{aside.name}-{old.name}"))
    return aside


def _aside(path: Path, n: int) -> Path:
    return path.with_name(f"{path.name}.damaged-{n}")
