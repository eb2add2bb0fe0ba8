"""The cut of a backup: what all registrars of a system have at one moment, for which their processes hold still.

Each process takes the turns of its registrars, so nothing is decided or committed in it, and says so to the one that
asks. When all have said so, that is the moment: a SIGKILL of all processes would leave the same. Each notes its rows,
which takes a moment, and gives the turns back. Then it writes them to the disk.

A turn is given back when the asking process says so, when it closes the connection or dies, and after HOLD_S.
"""

from __future__ import annotations

import contextlib
import io
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from rr_actors.base.config import CATALOG_FILE
from rr_actors.base.errors import CatalogError, Unavailable
from rr_actors.base.folder import Folder, NotAFile, NotOurs, make_directories
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.rows import PENDING, Content
from rr_actors.wire.unix_sockets import SocketDir

HOLD_S = 2.0
"""The longest time for which a process holds the turns of its registrars."""
WAIT_S = 30.0
"""How long a process waits to be told to hold them, while the others get ready."""
_SMALL_BYTES = 2**16
HOLD, HELD, GO = b"h", b"H", b"g"
"""What the asking process says, what is answered, and what it says at the end. First each process says a name."""


class CatalogCopy(msgspec.Struct, frozen=True):
    """A catalog that was copied: its registrar, the location that this was configured with, its rows by table."""

    registrar: str
    location: str | None
    rows: dict[str, int]

    @classmethod
    def of(cls, registrar: str, location: str | os.PathLike[str] | None, content: Content) -> CatalogCopy:
        """Return the copy of a catalog with these rows."""
        rows: dict[str, int] = {table: len(rows) for table, rows in content.items()}
        return cls(registrar, None if location is None else os.fspath(location), rows)


class OpenFiles:
    """Files of a directory as they are now, to be copied later. Small ones are in memory; large ones are open.

    A large file that is written anew by a rename, or made longer, is copied as it was. What is no file of this user's
    own is left out, and so are directories.
    """

    def __init__(self, directory: Path, wanted: Callable[[str], bool]) -> None:
        """Read or open the files with wanted names."""
        self._small: dict[str, bytes] = {}
        self._large: dict[str, tuple[io.FileIO, int]] = {}
        with contextlib.suppress(FileNotFoundError), Folder.at(directory) as folder:
            for name in filter(wanted, folder.names()):
                with contextlib.suppress(NotAFile, NotOurs, FileNotFoundError):
                    file = folder.open(name)
                    if (length := os.fstat(file.fileno()).st_size) > _SMALL_BYTES:
                        self._large[name] = file, length
                    else:
                        with file:
                            self._small[name] = file.read(length)

    def copy(self, to: Path) -> None:
        """Write the files to a directory.

        Raises:
            CatalogError: they cannot be read or written.
        """
        if not (self._small or self._large):
            return
        try:
            make_directories(to)
            with Folder.at(to) as folder:
                for name, data in self._small.items():
                    folder.write(name, data, synced=True)
                for name, (file, length) in self._large.items():
                    with folder.open(name, os.O_CREAT | os.O_EXCL | os.O_WRONLY) as target:
                        while data := file.read(_SMALL_BYTES):
                            target.write(data)
                        os.ftruncate(target.fileno(), length)
                        os.fsync(target.fileno())
        except OSError as error:
            text = f"{to}: the files beside a catalog cannot be copied here: {error.strerror}"
            raise CatalogError(text, path=str(to)) from error

    def close(self) -> None:
        """Close the files."""
        for file, _ in self._large.values():
            file.close()


def is_beside(name: str) -> bool:
    """Return whether a file of this name, in the directory of a catalog, is not the catalog's, nor half written."""
    return not name.startswith((f"{Path(CATALOG_FILE).stem}.", "."))


class _Cut:
    """What a registrar has at the moment. With the lock."""

    def __init__(self, node: Node, registrar: RegistrarActor) -> None:
        self._registrar = registrar
        catalog = registrar.whole()
        self._content: Content = {table: dict(rows) for table, rows in catalog.tables.items()}
        for id in catalog.unsettled:
            if catalog.held[id].hold is PENDING:  # never on disk: its provider says whether it was loaded
                del self._content["held"][id]
        directory = registrar.config.catalog_path(node.info.state_dir).parent
        self.beside = OpenFiles(directory, is_beside)

    def copy(self, place: Path) -> CatalogCopy:
        """Write the catalog below `place`, which is there unless the backup was given up, and the files beside it."""
        registrar = self._registrar
        try:
            (place / registrar.name).mkdir(0o700)
        except OSError as error:
            text = f"{place}: the catalog of {registrar.name} cannot be copied here: {error.strerror}"
            raise CatalogError(text, path=str(place)) from error
        registrar.commits.store.copy(self._content, place / registrar.name / CATALOG_FILE)
        self.beside.copy(place / registrar.name)
        return CatalogCopy.of(registrar.name, registrar.config.location, self._content)


def take_part(node: Node, registrar: str, name: str, place: Path) -> list[CatalogCopy]:
    """Copy the catalogs of this process to `place`, at the moment that the process says which asks by this socket.

    Args:
        registrar: the registrar of this process that was asked.
        name: the socket's name.

    Raises:
        Unavailable: that process has given up, or a thread has kept a turn for too long.
        CatalogError: a copy cannot be written.
    """
    with contextlib.closing(SocketDir(node.info.run_dir)) as sockets, sockets.connect(name) as line:
        line.settimeout(WAIT_S)
        line.sendall(f"{registrar}\n".encode())
        hear(line, HOLD)
        with contextlib.ExitStack() as files:
            with contextlib.ExitStack() as held:
                deadline = time.monotonic() + HOLD_S
                cuts = [_Cut(node, registrar) for registrar in _take_turns(node, held, deadline)]
                for cut in cuts:
                    files.callback(cut.beside.close)
                line.settimeout(max(0.001, deadline - time.monotonic()))
                line.sendall(HELD)
                hear(line, GO)
            return [cut.copy(place) for cut in cuts]


def _take_turns(node: Node, held: contextlib.ExitStack, deadline: float) -> list[RegistrarActor]:
    """Take the turns of all registrars here that have catalogs on disk, and return these."""
    taken: set[int] = set()
    while True:
        here = [one for one in list(node.registrars.values()) if one.config.durability != "none"]
        locks = {id(one.lock): one.lock for one in here if id(one.lock) not in taken}
        if not locks:
            return [one for one in here if not one.closed]
        for key, lock in sorted(locks.items()):
            if not lock.acquire(timeout=max(0.0, deadline - time.monotonic())):
                raise Unavailable(f"{node.path}: a registrar has not been still within {HOLD_S:g} s")
            held.callback(lock.release)
            taken.add(key)


def hear(line: socket.socket, expected: bytes) -> None:
    """Wait for what the asking process says.

    Raises:
        Unavailable: it says nothing, or is gone.
    """
    try:
        heard = line.recv(1)
    except OSError:  # it took too long, or the other end is gone
        heard = b""
    if heard != expected:
        raise Unavailable("the backup was given up")
