"""Opening a catalog: take its lock, check and read its files, and fold in the journal that a crash left.

The files do not change before all of them are known to be good.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sqlite3
import stat
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from rr_actors.base.config import CATALOG_FILE, RegistrarConfig
from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogLocked, shortened
from rr_actors.base.folder import Folder, NotAFile, make_directories
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.model.rows import Change, Content, Held, Resource, Row, apply, content_of, rows_of
from rr_actors.registrar.model.store import MemoryStore, Store, is_needed
from rr_actors.storage import journaled_store, sql_tables, sqlite_store, write_ahead
from rr_actors.storage.catalog_lock import CatalogLock, Reached
from rr_actors.storage.damage import Damage, damaged, errors_named
from rr_actors.storage.journaled_store import JournaledStore
from rr_actors.storage.witness import LastOpening, Witness, is_missing, missing_text
from rr_actors.storage.write_ahead import Spare

Durability = Literal["process", "power"]

_PATH_BYTES = 500
"""SQLite's limit is 512 bytes (MAX_PATHNAME in its os_unix.c), the endings ".new", of a catalog that is being made, and
"-journal" included."""

_LOCKED_S = 1.0
"""How long an opening waits for the lock: a thread may be looking whether the catalog is still needed."""
_LOOK_AGAIN_S = 0.05

_READINGS = 20  # attempts to read a catalog that is opened or closed during each reading

_LISTED = 20  # of what is lost
_log = Log(__name__)


def open_catalog(config: RegistrarConfig, state_dir: str) -> Store:
    """Open the store of a registrar as its configuration says; raise as open_store() does."""
    if config.durability == "none":
        return MemoryStore()
    path, witness = config.catalog_path(state_dir), Witness(state_dir, config.name)
    deadline = time.monotonic() + _LOCKED_S
    while True:
        try:
            return open_store(path, durability=config.durability, on_damage=config.on_damage, witness=witness)
        except CatalogLocked:
            if time.monotonic() > deadline:
                raise
            time.sleep(_LOOK_AGAIN_S)


def remove_catalogs(registrars: Sequence[str], state_dir: str) -> None:
    """Remove those of the registrars' catalogs in the state directory that have nothing that would be missed."""
    for name in registrars:
        try:
            remove_unneeded(Path(state_dir, name, CATALOG_FILE), Witness(state_dir, name))
        except CatalogError as error:  # it is open again already, say
            _log.info("%s: its catalog stays: %s", name, error)


def open_store(
    path: str | os.PathLike[str],
    *,
    durability: Durability = "process",
    on_damage: Literal["refuse", "aside"] = "refuse",
    witness: Witness | None = None,
) -> Store:
    """Open the catalog in the file `path`, or make it: lock it, read it, and count its epoch up.

    `durability` says what a commit survives: "process", SIGKILL; "power", a power cut too. With on_damage="aside" a
    damaged or foreign file is renamed to <name>.damaged-<n>, and an empty catalog takes its place. The `witness` has
    the registrar's name and its last known catalog. A warning reports commits that are missing.

    Raises:
        CatalogLocked: the catalog is open already. `.path`, `.pid`
        CatalogDamaged: the file is damaged, another registrar's, or no catalog; it is not changed. `.path`
        CatalogVersion: another version of rr_actors wrote the catalog; it is not changed. `.path`, `.expected`, `.got`
        CatalogError: the catalog cannot be read or written, or other users could write it. `.path`
    """
    path = Path(path).absolute()
    if (length := len(os.fsencode(path))) > _PATH_BYTES:
        text = f"{shortened(str(path))}: its path has {length} bytes, expected at most {_PATH_BYTES}, as SQLite opens"
        raise CatalogError(f"{text} no longer one; choose a shorter state_dir, or another location", path=str(path))
    with errors_named(path):
        while True:
            try:
                folder = _folder_of(path, witness, synced=durability == "power")
                return _open_in_directory(folder, path, durability, on_damage, witness)
            except FileNotFoundError:  # who closed the catalog for good has removed the directory just now
                if os.path.lexists(path.parent):
                    raise


def _open_in_directory(
    folder: Folder, path: Path, durability: Durability, on_damage: str, witness: Witness | None
) -> Store:
    with contextlib.ExitStack() as if_not:
        if_not.enter_context(folder)
        _make_private(folder)
        _make_files_private(folder, [path.with_suffix(".lock").name])
        lock = CatalogLock(folder, path)
        if_not.callback(lock.release)
        store = _open_locked(folder, path, lock, durability, on_damage, witness)
        if_not.pop_all()
        return store


def is_there(path: str | os.PathLike[str]) -> bool:
    """Return whether there is a catalog, also one that has only its lock, or all in its journal; False if unknown."""
    path = Path(path)
    return os.path.lexists(path) or os.path.lexists(path.with_suffix(".lock")) or not is_missing(path)


def remove_unneeded(path: Path, witness: Witness) -> None:
    """Remove a catalog that nobody has open, with its directory, if it has nothing that would be missed.

    Raises:
        CatalogError: as open_store() describes; or the catalog cannot be removed.
    """
    if not os.path.lexists(path.parent) or _remove_its_lock(path, witness) or not is_there(path):
        return
    if is_missing(path):
        if witness.known() is not None:  # it was removed: the next opening says so
            return
    elif is_needed(content_of(read_rows(path))):
        return
    store = open_store(path, witness=witness)
    needed = True
    try:
        needed = is_needed(store.load())
    finally:
        store.close(erase=not needed)


def _remove_its_lock(path: Path, witness: Witness) -> bool:
    """Remove a catalog that has committed nothing, so that its lock alone is there; return whether it is one."""
    name = path.with_suffix(".lock").name
    with errors_named(path), Folder.unlinked(path.parent) as folder:
        names = folder.names()
        if name not in names or sqlite_store.files_among(names, path):
            return False
        lock = CatalogLock(folder, path)
        reached, spent = lock.reached, False
        try:
            is_new = reached is None or not (reached.is_made or reached.number)
            if is_new and not sqlite_store.files_among(folder.names(), path):
                spent = witness.spend(0 if reached is None else reached.epoch)
        finally:
            lock.release(remove=spent)
    if spent:
        with contextlib.suppress(OSError):  # something else is in the directory, or it is being opened again
            os.rmdir(path.parent)
    return spent


def _folder_of(path: Path, witness: Witness | None, *, synced: bool) -> Folder:
    """Open or make the directory of a catalog. Below the state directory, no link is followed."""
    parent = path.parent
    top = parent if witness is None else witness.state_dir
    if parent.parent == top:  # nearly always: then its last name alone could be a link
        with contextlib.suppress(OSError):  # the rest finds out what is wrong
            make_directories(parent, synced=synced)
            return Folder.unlinked(parent)
    is_below = parent.is_relative_to(top) and ".." not in parent.relative_to(top).parts
    if not is_below:  # a location that was chosen
        top = parent
    try:
        for at in (parent, *parent.parents):
            if at == top:
                break
            if at.is_symlink():
                raise NotAFile(at, "a symbolic link")
        make_directories(parent, synced=synced)
        return Folder.below(top, parent)
    except NotAFile as error:
        raise CatalogError(
            f"{error.filename}: expected a directory of the catalog's own, got {error.got}; it is left as it is, and so"
            " is what it leads to. Remove it, or choose the directory that it leads to as the registrar's location",
            path=str(error.filename),
        ) from error


def move_catalog(old: Path, new: Path) -> None:
    """Move a catalog that nobody has open, with its directory. A crash leaves it at one of the two places.

    Raises:
        CatalogLocked: the catalog is open. `.path`, `.pid`
        CatalogError: it cannot be moved: there is a directory with something in it, say.
    """
    with errors_named(new):
        make_directories(new.parent.parent)
        with Folder.at(old.parent) as folder:
            lock = CatalogLock(folder, old)
            try:
                os.rename(old.parent, new.parent)
            finally:
                lock.release()


def read_rows(path: str | os.PathLike[str]) -> list[Row]:
    """Return the rows of the catalog in the file `path` as they are after some commit, and change nothing.

    The catalog is not locked: another process may have it open. It may be another user's.

    Raises:
        CatalogDamaged: the file is damaged, or no catalog. `.path`
        CatalogVersion: another version of rr_actors wrote the catalog. `.path`, `.expected`, `.got`
        CatalogError: the catalog cannot be read. `.path`
    """
    return rows_of(_read_unlocked(Path(path).absolute())[1])


def copy_catalog(path: Path, witness: Witness, to: Path) -> Content:
    """Copy a catalog that nobody has open to a new path, as Store.copy() does, and return its rows.

    It is read as by read_rows(). One without rows, or without files, is not copied.

    Raises:
        CatalogError: as read_rows() describes; or the copy cannot be written. `.path`
    """
    meta, content, left = _read_unlocked(path)
    known = witness.known()
    if any(content.values()):
        epoch = max(meta.epoch, left.epoch, 0 if known is None else known.epoch)
        sqlite_store.write_copy(to, msgspec.structs.replace(meta, epoch=epoch, registrar=witness.registrar), content)
    return content


def catalog_id(path: Path) -> str:
    """Return a catalog's id, read as by read_rows(), with its errors; "" without a catalog."""
    return _read_unlocked(path)[0].id


def _read_unlocked(path: Path) -> tuple[sql_tables.Meta, Content, _Left]:
    """Return what _read() does, of a catalog whose lock another process may have, as it is after some commit."""
    with errors_named(path):
        try:
            folder = Folder.at(path.parent, to_read=True)
        except FileNotFoundError:
            return sqlite_store.NONE, content_of(()), _Left()
        with folder:
            for _ in range(_READINGS - 1):
                before = _look(folder, path)
                try:
                    found = _read(folder, path)
                except (CatalogDamaged, Damage, NotAFile, sqlite3.Error, FileNotFoundError):
                    if _look(folder, path) == before:
                        raise
                else:
                    after = _look(folder, path)
                    if before == after or (before.is_open and after.is_open):
                        return found
            return _read(folder, path)


class _Look(msgspec.Struct, frozen=True):
    """A catalog's file from outside. SQLite shows one state of an open file; a closed file must not change."""

    is_open: bool
    file: tuple[int, int, int] | None


def _look(folder: Folder, path: Path) -> _Look:
    is_open = folder.has(sqlite_store.files_of(path)[1].name)
    try:
        found = os.stat(path.name, dir_fd=folder.fd, follow_symlinks=False)
    except FileNotFoundError:
        return _Look(is_open, None)
    return _Look(is_open, (found.st_ino, found.st_size, found.st_mtime_ns))


def _open_locked(
    folder: Folder, path: Path, lock: CatalogLock, durability: Durability, on_damage: str, witness: Witness | None
) -> Store:
    registrar = "" if witness is None else witness.registrar
    known, spent = (None, 0) if witness is None else witness.known_or_spent()
    is_synced = durability == "power"
    spare, settled = Spare(folder, path, synced=is_synced), 0
    try:
        settled = _mend(folder, path, lock.reached, spare)
        meta, content, left = _read_locked(folder, path, lock.reached, witness)
    except CatalogDamaged as error:
        if on_damage != "aside":
            raise
        meta, content = sqlite_store.NONE, content_of(())
        left = _Left(epoch=0 if lock.reached is None else lock.reached.epoch)
        spare, settled = Spare(folder, path, synced=is_synced), 0
        _log.warning("%s: renamed to %s, and the catalog starts empty", error, _set_aside(folder, path).name)
    else:
        if known is not None:
            _compare(path, meta, known, registrar)
    spent = max(meta.epoch, left.epoch, 0 if known is None else known.epoch) or spent
    changes: sql_tables.Net | None = sql_tables.net_of(left.changes)
    place = (spent + 1, max(meta.folded, left.last), registrar or meta.registrar)
    if meta.id:
        if not sqlite_store.has_file(folder, path):  # all is in the journal; from here on as after any crash
            sqlite_store.create(folder, path, sql_tables.Meta(meta.id, meta.epoch, 0, registrar))
        meta = sql_tables.Meta(meta.id, *place)
    else:
        meta = sql_tables.Meta(os.urandom(8).hex(), *place)
        if is_synced or known is not None or left.segments or meta.folded:
            sqlite_store.create(folder, path, meta)
        changes = None  # SQLite opens the file at the first folding
    if is_synced:  # also where an opening that failed, or one without "power", has made the file
        os.fsync(folder.fd)
    tables = sqlite_store.SqliteTables(
        folder, path, lock, durability, meta, changes, content, witness, settled=settled, spare=spare
    )
    if left.segments and (is_synced or not left.is_whole):
        tables.tidy()
    kept: list[str] = []
    for number, segment in left.segments.items():
        if number > tables.settled:
            kept.append(segment)
        else:
            folder.discard(segment)  # if that fails: it is folded, so it is ignored, and the next opening removes it
    return JournaledStore(tables, kept, left.end)


class _Left(msgspec.Struct, frozen=True):
    """The journal that a crash left, or that another process is writing.

    `last`: the last segment that was begun. `epoch`: the last opening that the journal or the lock knows.
    """

    segments: Mapping[int, str] = {}
    last: int = 0
    epoch: int = 0
    changes: Sequence[Change] = ()
    end: journaled_store.End | None = None
    is_whole: bool = True


def _mend(folder: Folder, path: Path, reached: Reached | None, spare: Spare) -> int:
    """Mend the -wal of a catalog whose lock the caller has, and return the last commit that its file has without it."""
    settled = 0 if reached is None else reached.settled
    with errors_named(path):
        _make_files_private(folder, sqlite_store.files_among(folder.names(), path))
        spare.recover(settled)
        return write_ahead.settled_before(folder, path, spare, settled)


def _read_locked(
    folder: Folder, path: Path, reached: Reached | None, witness: Witness | None
) -> tuple[sql_tables.Meta, Content, _Left]:
    """Return what _read() does, of a catalog whose lock the caller has, and which is mended."""
    with errors_named(path):
        if reached is None and not sqlite_store.files_among(folder.names(), path):
            return sqlite_store.NONE, content_of(()), _Left()
        return _read(folder, path, reached, witness)


def _read(
    folder: Folder, path: Path, reached: Reached | None = None, witness: Witness | None = None
) -> tuple[sql_tables.Meta, Content, _Left]:
    """Return a catalog's meta row, its rows with the journal's changes, and its journal.

    Args:
        reached: the catalog's progress, if it was not closed.
        witness: has the name of the catalog's registrar, if that is known.
    """
    if reached is None and witness is None:
        Spare(folder, path).check()
    found = journaled_store.read(folder, path)  # first: the file then has the segments that are folded meanwhile
    first, is_new = None, reached is not None and not reached.is_made
    if not sqlite_store.has_file(folder, path):
        first = found.first(() if witness is None else (witness.registrar, witness.formerly))
        is_new = is_new or first is not None
    if not folder.has(path.name):
        left = not is_new and any(found.contents.values())
        if left and sqlite_store.segments_among(folder.names(), path):  # otherwise it was erased meanwhile
            damaged(path, f"no such file, but {min(found.segments.items())[1]}, which belongs to it")
        if reached is not None and reached.is_made:
            damaged(path, f"no such file, though it was opened {reached.epoch} times and is not closed")
    if is_new and folder.has(path.name) and not sqlite_store.has_file(folder, path):
        meta, content = sqlite_store.NONE, content_of(())  # a tool has left an empty file in its place
    else:
        meta, content = sqlite_store.read_catalog(folder, path)
    if not meta.id and first is not None:
        meta = first
    if witness is not None and meta.registrar not in ("", witness.registrar, witness.formerly):
        damaged(path, f"that of the registrar {meta.registrar!r} in the place of that of {witness.registrar!r}")
    if reached is not None and reached.id != meta.id and (meta.id or reached.is_made):
        if reached.is_made or reached.number:  # otherwise that one had nothing
            _log.warning(
                "%s: another catalog than the one that was open here, and was not closed; that one is lost", path
            )
        reached = None
    begun = 0 if reached is None else reached.number
    settled = 0 if reached is None else reached.settled
    replay = found.since(meta, begun, settled=settled)
    apply(content, replay.changes)
    if reached is not None and reached.folded > meta.folded:
        _tell_of_older(path, meta, reached, is_whole=replay.is_whole)
    if lost := _lost(replay.ignored, content):
        more = f" and {len(lost) - _LISTED} more" if len(lost) > _LISTED else ""
        _log.warning("%s: lost with that: %s%s", path, ", ".join(lost[:_LISTED]), more)
    last = max(found.last, begun)
    epoch = max(found.epoch_after(meta.folded), 0 if reached is None else reached.epoch)
    return meta, content, _Left(found.segments, last, epoch, replay.changes, replay.end, replay.is_whole)


def _tell_of_older(path: Path, meta: sql_tables.Meta, reached: Reached, *, is_whole: bool) -> None:
    """Warn that the SQLite file, or its -wal, has less than was written to it."""
    name = path.name if meta.folded < reached.settled else f"{path.name}-wal"
    if not reached.number:  # an earlier version's, without a journal
        text = f"its last {reached.folded - meta.folded} commit(s) are missing, and what they changed is lost"
    elif meta.folded < reached.settled:
        text = "what was committed since then is lost"
    else:
        text = f"what it had is taken from the journal{': nothing is lost' if is_whole else ', as far as it goes'}"
    _log.warning("%s: %s was removed, cut off, damaged, or put back from an older copy: %s", path, name, text)


def _lost(ignored: Sequence[Change], content: Content) -> list[str]:
    """Return what was served and held by changes that could not be applied, for people."""
    net = sql_tables.net_of(ignored)
    served = [row for row in net.puts.get("resources", {}).values() if row.id not in content["resources"]]
    held = [row for row in net.puts.get("held", {}).values() if row.id not in content["held"]]
    texts = [f"{row.server} {row.id} (served)" for row in served if isinstance(row, Resource)]
    return texts + [f"{row.registrar}/{row.server} {row.id} (held)" for row in held if isinstance(row, Held)]


def _compare(path: Path, meta: sql_tables.Meta, known: LastOpening, registrar: str) -> None:
    """Compare the catalog with its last known opening, and warn of differences."""
    if known.id != meta.id and known.path != str(path) and not is_missing(Path(known.path)):
        _log.warning(
            "%s: expected its catalog %s, which is there, got %s in another location: the configuration was changed."
            " What %s held and served in the first stays there, and is not read. To have it read, set its location to"
            " that directory again, or move the directory to the new place while no system runs",
            registrar,
            known.path,
            path,
            registrar,
        )
    elif not meta.id:
        _log.warning("%s", missing_text(registrar, known))
    elif known.id != meta.id:
        _log.warning(
            "%s: another catalog than the one that %s had last (%s); what that one held and served is not in it",
            path,
            registrar,
            known.path,
        )
    elif known.epoch > meta.epoch:
        _log.warning(
            "%s: expected its state of opening %d or later, got that of opening %d: it was put back from an older copy,"
            " or its -wal is missing or damaged; what was committed since then is lost, unless its journal has it",
            path,
            known.epoch,
            meta.epoch,
        )


def _set_aside(folder: Folder, path: Path) -> Path:
    names = folder.names()
    places = (path.with_name(f"{path.name}.damaged-{n}") for n in itertools.count(1))
    aside = next(place for place in places if not any(name.startswith(place.name) for name in names))
    for old, new in zip(sqlite_store.files_of(path), sqlite_store.files_of(aside), strict=True):
        if old.name in names:
            folder.rename(old.name, new.name)
    for name in sqlite_store.segments_among(names, path):
        folder.rename(name, f"{aside.name}-{name}")
    return aside


# -- the rights of other users are removed, or the catalog is refused ------------------------------------------------
#
# A catalog may hold pickles (stored servers, types). A user that can write it, or put a -wal beside it, can run code as
# the user that opens it. No other user can do that inside a system's state directory; a `location` elsewhere is checked
# here. The directory comes first: from then on no other user can add a file. The older files are checked one by one.


def _make_private(folder: Folder) -> None:
    """Remove the right of other users to write the directory; refuse one that all users share (sticky bit)."""
    mode = stat.S_IMODE(folder.check_owner().st_mode)
    if not mode & 0o022:
        return
    if mode & stat.S_ISVTX:
        raise CatalogError(
            f"{folder.path}: expected a directory for catalogs that one user writes, got one that all share"
            f" (mode {mode:o}); choose a directory in it as location",
            path=str(folder.path),
        )
    before, after = folder.tighten(0o022)
    _log.info("%s: mode %o tightened to %o", folder.path, before, after)


def _make_files_private(folder: Folder, names: Iterable[str]) -> None:
    """Remove all rights of other users to these files. Skip an entry that is no file: the reader refuses it."""
    for name in names:
        try:
            found = folder.look(name)
        except NotAFile:
            continue
        if found is None or not stat.S_IMODE(found.st_mode) & 0o077:
            continue
        with folder.open(name) as file:
            os.fchmod(file.fileno(), 0o600)
        _log.info("%s: mode %o tightened to 600", folder.path / name, stat.S_IMODE(found.st_mode))
