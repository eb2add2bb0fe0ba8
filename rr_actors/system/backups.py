"""Backups: the catalogs of all registrars of a system at one moment, in a directory; and how they come back.

A backup has catalogs/<registrar>/ with a closed catalog each and the files beside it, state/ with what the state
directory has besides, manifest.json, and SHA256SUMS, which the command sha256sum can check.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import socket
import threading
import time
from collections.abc import Container, Generator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base import __version__
from rr_actors.base.config import CATALOG_FILE, RegistrarConfig, SystemConfig
from rr_actors.base.errors import (
    CatalogDamaged,
    CatalogError,
    CatalogLocked,
    CatalogVersion,
    ConfigError,
    RegistrarDown,
    RrError,
    Unavailable,
    counted,
    shown,
)
from rr_actors.base.folder import Folder, make_directories
from rr_actors.registrar.engine.cut import GO, HELD, HOLD, HOLD_S, CatalogCopy, OpenFiles, is_beside, take_part
from rr_actors.registrar.engine.node import Node
from rr_actors.storage.opening import catalog_id, copy_catalog, is_there
from rr_actors.storage.sql_tables import SCHEMA_VERSION
from rr_actors.storage.witness import Witness
from rr_actors.system.registrar_lookup import catalogs_on_disk
from rr_actors.wire.name_service import Presence, absolute_path, open_state_dir
from rr_actors.wire.unix_sockets import SocketDir, new_name

_FORMAT = 1
_MANIFEST, _SUMS = "manifest.json", "SHA256SUMS"
_CATALOGS, _STATE, _OUTSIDE = "catalogs", "state", ".outside"
_WITNESSES, _EPOCHS = ".catalogs", ".epochs"
_AGAIN_S = 0.2  # from an attempt that failed to the next
_LOOK_S = 0.05

WRITING_S = 600.0
"""How long the writing of a backup may take, for those that wait for the answer of another process."""


class Backup(msgspec.Struct, frozen=True):
    """What a backup is, and its manifest.

    Attributes:
        system: the system's name.
        version: the version of rr_actors that wrote it; `schema`: the version of its catalogs; `format`: its own.
        at: when it was taken, in seconds since the epoch.
        held_s: the longest time for which a load, an unload or a status had to wait for it.
        registrars: the registrars whose catalogs it has, each with the location that the catalog was configured with,
            and its number of rows by table.
        files: the size of each file, by its path.
    """

    system: str
    version: str
    format: int
    schema: int
    at: float
    held_s: float
    registrars: dict[str, CatalogCopy]
    files: dict[str, int]

    def told(self, where: str) -> str:
        """Return what is there, in words for people."""
        count = len(self.registrars)
        rows = sum(sum(copy.rows.values()) for copy in self.registrars.values())
        catalogs = f"{counted(count, 'catalog')} with {counted(rows, 'row')} ({counted(self.size, 'byte')})"
        held = f"; all held still for {self.held_s * 1000:.1f} ms" if self.held_s else ""
        return f"{where} has {catalogs} as they were at one moment{held}"

    def facts(self, where: str) -> dict[str, Any]:
        """Return the same for programs."""
        return {"directory": where, "held_s": self.held_s, "catalogs": len(self.registrars), "bytes": self.size}

    @property
    def size(self) -> int:
        """The bytes of all files."""
        return sum(self.files.values())


# -- taking one --------------------------------------------------------------------------------------------------------


def back_up(node: Node, directory: Path, timeout_s: float) -> Backup:
    """Back up the running system of this process. Blocks.

    Raises:
        ConfigError: the directory is not empty, or cannot be made.
        RegistrarDown, Unavailable: a registrar did not hold still within `timeout_s` seconds; the error names it.
        CatalogError: a catalog cannot be read, or its copy cannot be written.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            with _new_directory(directory) as place:
                return _back_up_once(node, place, deadline)
        except (Unavailable, CatalogLocked) as error:  # a process has ended, or started, meanwhile
            if time.monotonic() + _AGAIN_S > deadline:
                raise type(error)(f"{directory}: no backup was made: {error}", **error.details) from error
            time.sleep(_AGAIN_S)


def _back_up_once(node: Node, place: Path, deadline: float) -> Backup:
    state = Path(node.info.state_dir)
    (place / _CATALOGS).mkdir(0o700)
    barrier = Barrier(node, place / _CATALOGS, deadline)
    closed = _ClosedCatalogs(node.config, state, place / _CATALOGS)
    closed.copy(but=barrier.open_ones())
    with contextlib.ExitStack() as opened:
        opened.callback(barrier.close)
        barrier.hold()
        open_ones = barrier.open_ones()
        closed.copy(but=open_ones)  # only those that have changed since
        others = _OtherFiles(state)
        opened.callback(others.close)
        held_s = barrier.go()
        others.copy(place / _STATE)
        copies = barrier.copies()
    there = {copy.registrar for copy in copies}
    for name in open_ones - there:
        here = node.registrars.get(name)
        config = node.config.registrar(name) if here is None else here.config
        if config.durability != "none":
            raise RegistrarDown(f"registrar {name!r} has ended meanwhile", registrar=name, status="")
    return _complete(place, node.info.name, [*copies, *closed.copies()], held_s)


def back_up_files(state_dir: Path, directory: Path) -> Backup:
    """Back up the state directory of a system that does not run. Blocks.

    Raises:
        CatalogLocked: the system runs.
        ConfigError: there is no such state directory; or as back_up().
        CatalogError: as back_up().
    """
    state = absolute_path(state_dir)
    if not state.is_dir():
        raise _wrong(state, "the state directory of a system", "nothing of that name")
    with contextlib.closing(open_state_dir(state)), _new_directory(directory) as place:
        placed = {name: RegistrarConfig(name, location=_location(state, name)) for name in _recorded(state)}
        closed = _ClosedCatalogs(SystemConfig(registrars=placed), state, place / _CATALOGS)
        closed.copy()
        with contextlib.closing(_OtherFiles(state)) as others:
            others.copy(place / _STATE)
        return _complete(place, state.name, closed.copies(), 0.0)


def _recorded(state: Path) -> list[str]:
    with contextlib.suppress(FileNotFoundError):
        return [name for name in sorted(os.listdir(state / _WITNESSES)) if not name.startswith(".")]
    return []


def _location(state: Path, name: str) -> str | None:
    """Return where a registrar's catalog is, if that is outside of the state directory, which may have been moved."""
    known = Witness(state, name).known()
    if known is None or catalog_id(state / name / CATALOG_FILE) == known.id:
        return None
    return str(Path(known.path).parent)


class _ClosedCatalogs:
    """Copies the catalogs that nobody has open, with the files beside them."""

    def __init__(self, config: SystemConfig, state: Path, place: Path) -> None:
        self._config = config
        self._state = state
        self._place = place
        self._known: dict[str, tuple[object, CatalogCopy | None]] = {}

    def copy(self, but: Container[str] = ()) -> None:
        """Copy those that have changed since the last call; drop the copies of those that are gone or open.

        Args:
            but: the registrars that have their catalogs open.
        """
        found = catalogs_on_disk(self._config, self._state)
        now = {name: (path, _looks_of(path)) for name, path in found.items() if name not in but}
        for name, (looks, _) in list(self._known.items()):
            if name not in now or now[name][1] != looks:
                _remove(self._place / name)
                del self._known[name]
        for name in now.keys() - self._known.keys():
            path, looks = now[name]
            to, copy = self._place / name, None
            content = copy_catalog(path, Witness(self._state, name), to / CATALOG_FILE)
            if any(content.values()):
                copy = CatalogCopy.of(name, self._config.registrar(name).location, content)
                with contextlib.closing(OpenFiles(path.parent, is_beside)) as beside:
                    beside.copy(to)
            self._known[name] = looks, copy

    def copies(self) -> list[CatalogCopy]:
        """Return the copies. A catalog without rows has none."""
        return [copy for _, copy in self._known.values() if copy is not None]


def _looks_of(catalog: Path) -> object:
    """Return what differs when one of the catalog's files has changed."""
    looks: list[tuple[str, int, int, int]] = []
    with contextlib.suppress(FileNotFoundError), os.scandir(catalog.parent) as entries:
        for entry in entries:
            if not entry.name.endswith("-shm"):  # a reader may touch it
                found = entry.stat(follow_symlinks=False)
                looks.append((entry.name, found.st_ino, found.st_size, found.st_mtime_ns))
    return sorted(looks)


class _OtherFiles:
    """What the state directory has besides catalogs, as it is now: the directories whose names begin with a dot.

    Of the records of catalogs, which name their places, only the epochs that are spent are copied.
    """

    def __init__(self, state: Path) -> None:
        self._opened: dict[Path, OpenFiles] = {}
        for top in sorted(state.glob(".*")):
            for folder, _, _ in os.walk(top):
                wanted = _EPOCHS.__eq__ if top.name == _WITNESSES else is_beside
                self._opened[Path(folder).relative_to(state)] = OpenFiles(Path(folder), wanted)

    def copy(self, place: Path) -> None:
        """Write the files below a directory."""
        for folder, files in self._opened.items():
            files.copy(place / folder)

    def close(self) -> None:
        """Close the files."""
        for files in self._opened.values():
            files.close()


class Barrier:
    """Has all processes with registrars hold still, and then write their catalogs below `place`. Once.

    Raises:
        RegistrarDown: a registrar is being started or respawned.
    """

    def __init__(self, node: Node, place: Path, deadline: float) -> None:
        self._node = node
        self._place = place
        self._deadline = deadline
        self._up = self._processes()
        self._lines: dict[str, socket.socket] = {}
        self._replies: dict[str, Reply[list[CatalogCopy]]] = {}
        self._began = 0.0

    def _processes(self) -> dict[str, str]:
        """Return a registrar of each process that has some, by the process's address."""
        found: dict[str, str] = {}
        for name, status in self._node.statuses().items():
            entry = self._node.find(name)
            if status is Presence.STARTING or entry is None:
                raise RegistrarDown(f"registrar {name!r} is being started", registrar=name, status="starting")
            if status is Presence.UP:
                found.setdefault(entry.address, name)
        return found

    def open_ones(self) -> set[str]:
        """Return the names of the registrars that are up."""
        return {name for name, status in self._node.statuses().items() if status is Presence.UP}

    def hold(self) -> None:
        """Return when all hold still.

        Raises:
            RegistrarDown: one does not; the error names it.
        """
        name = new_name()
        with contextlib.closing(SocketDir(self._node.info.run_dir)) as sockets, sockets.bind(name) as listener:
            try:
                listener.listen(len(self._up) + 1)
                listener.settimeout(_LOOK_S)
                self._replies = {registrar: self._ask(registrar, name) for registrar in self._up.values()}
                while len(self._lines) < len(self._up):
                    self._accept(listener)
            finally:
                sockets.unlink(name)
        self._began = time.monotonic()
        for line in self._lines.values():
            with contextlib.suppress(OSError):  # it is gone, as is said below
                line.sendall(HOLD)
        held: set[str] = set()
        for registrar, line in self._lines.items():
            line.settimeout(max(0.001, self._began + HOLD_S - time.monotonic()))
            with contextlib.suppress(OSError):
                if line.recv(1) == HELD:
                    held.add(registrar)
        self._check(held, f"has not held still within {HOLD_S:g} s")

    def _ask(self, registrar: str, name: str) -> Reply[list[CatalogCopy]]:
        if registrar not in self._node.registrars:
            return self._node.handle(registrar).call("_take_part", (registrar, name, str(self._place)), {})
        reply: Reply[list[CatalogCopy]] = Reply()

        def take_part_here() -> None:
            try:
                reply.set(take_part(self._node, registrar, name, self._place))
            except Exception as error:
                fail(reply, error)

        threading.Thread(target=take_part_here, name="rr-backup", daemon=True).start()
        return reply

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(TimeoutError):
            line, _ = listener.accept()
            line.settimeout(_LOOK_S)
            with line.makefile() as said:
                registrar = said.readline().rstrip()
            self._lines[registrar] = line
        for reply in self._replies.values():
            if reply.done():
                reply.get()  # raises why it takes no part
        if time.monotonic() > self._deadline:
            self._check(self._lines, "has not answered in time")

    def _check(self, heard: Container[str], what: str) -> None:
        for name in self._up.values():
            if name not in heard:
                raise RegistrarDown(f"registrar {name!r}: its process {what}", registrar=name, status="")

    def go(self) -> float:
        """Have all go on; return for how many seconds the first of them has held still.

        Raises:
            Unavailable: registrars were started, or have ended, since this barrier was made.
        """
        if self._processes() != self._up:
            raise Unavailable("a registrar was started, or has ended, meanwhile")
        for line in self._lines.values():
            with contextlib.suppress(OSError):  # its reply says that it is gone
                line.sendall(GO)
        return time.monotonic() - self._began

    def copies(self) -> list[CatalogCopy]:
        """Wait for all copies.

        Raises:
            RegistrarDown: a process has ended, or has not written its copies; the error names a registrar of it.
        """
        copies: list[CatalogCopy] = []
        for registrar, reply in self._replies.items():
            try:
                copies += reply.result(timeout=WRITING_S)
            except TimeoutError as error:
                text = f"registrar {registrar!r}: its process has not written its copies within {WRITING_S:g} s"
                raise RegistrarDown(text, registrar=registrar, status="") from error
        return copies

    def close(self) -> None:
        """Have those go on that still hold still; wait a moment for those that still write, as it will be removed."""
        for line in self._lines.values():
            line.close()
        deadline = time.monotonic() + HOLD_S
        for reply in self._replies.values():
            with contextlib.suppress(RrError, TimeoutError):
                reply.result(timeout=max(0.0, deadline - time.monotonic()))


# -- the directory -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _new_directory(directory: Path) -> Generator[Path]:
    """Make a private directory that gets this name at the end of the block, complete; or nothing of it, at an error.

    Raises:
        ConfigError: there is a directory with something in it, or a file; or the directory cannot be made.
    """
    directory = Path(os.path.realpath(os.path.expanduser(directory)))
    _check_empty(directory)
    new = directory.with_name(f".{directory.name}.new-{os.urandom(4).hex()}")
    try:
        make_directories(new, synced=True)
        yield new
        os.rename(new, directory)
        with Folder.at(directory.parent, to_read=True) as folder:
            os.fsync(folder.fd)
    except OSError as error:
        text = f"{directory}: cannot be made: {error.strerror} ({error.filename})"
        raise ConfigError(text, file=str(directory)) from error
    finally:
        _remove(new)


def _remove(place: Path) -> None:
    """Remove a directory of this module's making, if it is there."""
    for folder, _, files in os.walk(place, topdown=False):
        with contextlib.suppress(OSError):
            for name in files:
                os.unlink(os.path.join(folder, name))
            os.rmdir(folder)


def _check_empty(directory: Path) -> None:
    try:
        names = os.listdir(directory)
    except FileNotFoundError:
        return
    except OSError as error:
        raise _wrong(directory, "a directory", error.strerror or str(error)) from error
    if names:
        there = ", ".join(sorted(names)[:3])
        raise _wrong(directory, "a new or an empty directory", f"one that has {there}; choose another one")


def _wrong(path: Path, expected: str, got: str) -> ConfigError:
    return ConfigError(f"{path}: expected {expected}, got {got}", file=str(path), expected=expected, got=got)


def _complete(place: Path, system: str, copies: list[CatalogCopy], held_s: float) -> Backup:
    """Write manifest and checksums, and have all directories on the disk."""
    files = sorted(path for path in place.rglob("*") if path.is_file())
    if odd := next((path for path in files if not str(path.relative_to(place)).isprintable()), None):
        raise CatalogError(f"{shown(odd.name)}: a file of such a name cannot be backed up; rename it", path=str(odd))
    backup = Backup(
        system,
        __version__,
        _FORMAT,
        SCHEMA_VERSION,
        time.time(),
        held_s,
        {copy.registrar: copy for copy in sorted(copies, key=lambda copy: copy.registrar)},
        {str(path.relative_to(place)): path.stat().st_size for path in files},
    )
    with Folder.at(place) as folder:
        folder.write(_MANIFEST, msgspec.json.format(msgspec.json.encode(backup)), synced=True)
        sums = [sum_line(path, str(path.relative_to(place))) for path in (place / _MANIFEST, *files)]
        folder.write(_SUMS, "".join(sums).encode(), synced=True)
    _sync_below(place)
    return backup


def _sync_below(place: Path) -> None:
    for path in (place, *(path for path in place.rglob("*") if path.is_dir())):
        with Folder.at(path) as folder:
            os.fsync(folder.fd)


def sum_line(path: Path, name: str) -> str:
    """Return a line of SHA256SUMS."""
    with path.open("rb") as file:
        return f"{hashlib.file_digest(file, 'sha256').hexdigest()}  {name}\n"


# -- restoring ---------------------------------------------------------------------------------------------------------


def restore(directory: Path, state_dir: Path, locations: Mapping[str, str | os.PathLike[str]]) -> Backup:
    """Make the state directory of a backup. Blocks.

    Args:
        locations: where to put catalogs, by the names of their registrars; the others go to the locations that they
            were configured with.

    Raises:
        ConfigError: the directory is no backup, the state directory is not empty, a location has a catalog, or a
            directory cannot be made.
        CatalogDamaged: a file of the backup is missing or damaged; nothing is made. `.path`
        CatalogVersion: a newer version of rr_actors has written the backup.
    """
    directory = Path(os.path.realpath(directory))
    backup = read_backup(directory)
    state = absolute_path(state_dir)
    for name in locations:
        if name not in backup.registrars:
            expected = f"registrars of the backup ({', '.join(backup.registrars)})"
            raise ConfigError(f"locations: expected {expected}, got {shown(name)}", key="locations", file=None)
    chosen = {name: locations.get(name, copy.location) for name, copy in backup.registrars.items()}
    places = {
        name: Path(os.path.normpath(RegistrarConfig(name, location=place).catalog_path(state))).parent
        for name, place in chosen.items()
    }
    outside = {name: place for name, place in places.items() if not place.is_relative_to(state)}
    for name, place in outside.items():
        if is_there(place / CATALOG_FILE):
            expected = f"a location of {name} without a catalog"
            raise _wrong(place, expected, "one with a catalog: move that away, or give another location")
    sums = dict(zip(backup.files, _lines_of_sums(directory, backup), strict=True))
    for file, said in sums.items():
        _read_checked(directory, file, said)
    with contextlib.ExitStack() as undo:
        with _new_directory(state) as new:
            inside = {name: new / place.relative_to(state) for name, place in places.items() if name not in outside}
            for file, said in sums.items():
                kind, name, *_ = parts = Path(file).parts
                if kind == _STATE:
                    to = new.joinpath(*parts[1:])
                else:
                    to = inside.get(name, new / _OUTSIDE / name).joinpath(*parts[2:])
                make_directories(to.parent)
                _write(to, _read_checked(directory, file, said))
            for name, place in outside.items():
                _put(new / _OUTSIDE / name, place, undo)
            _remove(new / _OUTSIDE)
            _sync_below(new)
        undo.pop_all()
    return backup


def read_backup(directory: Path) -> Backup:
    """Return the manifest of a backup, after its checks; raise what restore() raises for a wrong one."""
    try:
        with Folder.at(directory) as folder:
            manifest = folder.read(_MANIFEST)
            sums = folder.read(_SUMS)
    except FileNotFoundError as error:
        raise _wrong(directory, f"a backup, with {_MANIFEST} and {_SUMS}", "a directory without") from error
    except OSError as error:
        raise _wrong(directory, f"a backup, with {_MANIFEST} and {_SUMS}", str(error)) from error
    if sums.split(b"\n")[0] != f"{hashlib.sha256(manifest).hexdigest()}  {_MANIFEST}".encode():
        raise _damaged(directory / _MANIFEST, f"the one that {_SUMS} has the checksum of")
    try:
        found = msgspec.json.decode(manifest, type=_Versions)
        if found.format > _FORMAT or found.schema > SCHEMA_VERSION:
            text = f"{directory}: expected a backup of rr_actors {__version__} or before, got one of {found.version}"
            text = f"{text}: restore it with that version"
            raise CatalogVersion(text, path=str(directory), expected=__version__, got=found.version)
        backup = msgspec.json.decode(manifest, type=Backup)
    except msgspec.DecodeError as error:
        raise _damaged(directory / _MANIFEST, f"a manifest ({error})") from error
    for file in backup.files:
        kind, *others = Path(file).parts
        if kind not in (_CATALOGS, _STATE) or len(others) < 2 or ".." in others:
            raise _damaged(directory / _MANIFEST, f"files of a backup alone, not {shown(file)}")
    return backup


class _Versions(msgspec.Struct, frozen=True):
    """What the manifests of all versions have."""

    format: int
    version: str
    schema: int


def _lines_of_sums(directory: Path, backup: Backup) -> list[bytes]:
    """Return the lines of SHA256SUMS, one for each file of the manifest."""
    with Folder.at(directory) as folder:
        lines = folder.read(_SUMS).splitlines(keepends=True)[1:]
    if len(lines) != len(backup.files):
        raise _damaged(directory / _SUMS, f"the checksums of {counted(len(backup.files), 'file')}, not of {len(lines)}")
    return lines


def _read_checked(directory: Path, file: str, said: bytes) -> bytes:
    path = directory / file
    try:
        with Folder.below(directory, path.parent) as folder:
            data = folder.read(path.name)
    except OSError as error:
        raise _damaged(path, f"a file of the backup, got: {error.strerror or error}") from error
    if said != f"{hashlib.sha256(data).hexdigest()}  {file}\n".encode():
        raise _damaged(path, f"the file that {_SUMS} has the checksum of")
    return data


def _write(path: Path, data: bytes) -> None:
    flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY
    with Folder.at(path.parent) as folder, io.BufferedWriter(folder.open(path.name, flags)) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _put(staged: Path, place: Path, undo: contextlib.ExitStack) -> None:
    """Put a catalog, with the files beside it, where it belongs outside of the state directory."""
    make_directories(place, synced=True)
    for path in sorted(staged.iterdir()):
        to = place / path.name
        _write(to, path.read_bytes())
        undo.callback(to.unlink, missing_ok=True)
    _sync_below(place)


def _damaged(path: Path, expected: str) -> CatalogDamaged:
    text = f"{path}: expected {expected}; nothing is restored. Take another backup, or another copy of this one"
    return CatalogDamaged(text, path=str(path))
