"""CatalogLock: one process at a time has a catalog open. The kernel releases the lock when that process dies.

The lock's file has the holder's pid and the catalog's progress: the number of the opening, and the last segment of the
journal that is begun. By this the next opening tells a file that is missing, older or cut off from
one that was never written. A clean end removes the progress, because the SQLite file has everything then.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import weakref
import zlib
from pathlib import Path

import msgspec

from rr_actors.base.errors import CatalogError, CatalogLocked
from rr_actors.base.folder import Folder, NotAFile
from rr_actors.base.reporting.log import Log

_LONGEST = 200  # bytes: more than a lock's file has

_log = Log(__name__)


class Reached(msgspec.Struct, frozen=True, gc=False):
    """A catalog's progress: its id, how often it was opened, and the last segment of its journal that is begun.

    `is_made`: whether it has its SQLite file; one that has committed nothing has none, nor one whose commits are all in
    its journal. `folded`: the last segment in the tables; in a note of an earlier version's catalog without a journal,
    the last commit, and the number is 0. `settled`: the last one in the SQLite file without its -wal.
    """

    id: str
    epoch: int
    number: int
    is_made: bool = True
    folded: int = 0
    settled: int = 0


class CatalogLock:
    """An exclusive lock on a catalog, from the making of this object until `release`. Its file has the holder's pid.

    The lock uses `flock`, because a `lockf` lock is lost as soon as anything in the process closes the lock's file.

    Attributes:
        reached: the progress that a killed process or this process noted last.

    Raises:
        CatalogLocked: the lock is held already. `.path`, `.pid`
        CatalogError: the file is a link, a pipe or a directory, which is not changed.
    """

    def __init__(self, folder: Folder, catalog: Path) -> None:
        self._folder = folder
        self._catalog = catalog
        self._name = catalog.with_suffix(".lock").name
        self._take()
        while not self.is_there():  # its last holder erased the catalog, and this file with it
            self._file.close()
            self._take()
        _locks.add(self)
        self.reached = _read(self._noted)[1]
        self._write(os.getpid())

    def note(self, reached: Reached | None, *, needed: bool = False) -> None:
        """Note the catalog's progress in the lock's file; None removes the note.

        Raises:
            OSError: the note is needed, as nothing else has it, and cannot be written.
        """
        self.reached = reached
        self._write(os.getpid(), needed=needed)

    def release(self, *, remove: bool = False) -> None:
        """Release the lock, and with `remove` remove its file; the lock is released even if that raises an OSError."""
        _locks.discard(self)
        try:
            if remove:
                self.reached = None
                with contextlib.suppress(FileNotFoundError):
                    self._folder.unlink(self._name)
            self._write(None)
        finally:
            self._file.close()

    def forget(self) -> None:
        """Close the descriptors in a forked child, which would otherwise hold the lock after its parent's end."""
        self._file.close()
        self._folder.close()

    def is_there(self) -> bool:
        """Return whether the locked file still has its name: otherwise another process can lock a new file."""
        try:
            return os.path.samestat(
                os.stat(self._name, dir_fd=self._folder.fd, follow_symlinks=False), os.fstat(self._file.fileno())
            )
        except FileNotFoundError:
            return False

    def keep(self) -> None:
        """Take the lock again if its file was removed, and log that: another process could have opened the catalog.

        Raises:
            CatalogLocked: another process has the lock: two write the same files, and one must be closed. `.path`,
                `.pid`
            CatalogError: the file is something else.
            OSError: the file cannot be made again.
        """
        if self.is_there():
            return
        _log.error(
            "%s: it was removed while the catalog is open, and is taken again; keep the directory from cleaners of"
            " temporary files",
            self._folder.path / self._name,
        )
        lost = self._file
        self._take()
        lost.close()
        self._write(os.getpid())

    def _take(self) -> None:
        """Open and lock the lock's file."""
        try:
            file = self._folder.open(self._name, os.O_RDWR | os.O_CREAT)
        except NotAFile as error:
            raise CatalogError(
                f"{error.filename}: expected the catalog's lock, a file of its own, got {error.got}; it is left as it"
                " is. See who has put it there, and remove it",
                path=str(self._catalog),
            ) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            pid = _read(os.pread(file.fileno(), _LONGEST, 0))[0]
            file.close()
            holder = "another process" if pid is None else "this process" if pid == os.getpid() else f"process {pid}"
            raise CatalogLocked(
                f"{self._catalog}: expected a catalog that nobody has open, got one that {holder} holds; close it there"
                " first, or choose another name or location",
                path=str(self._catalog),
                pid=pid,
            ) from error
        self._file, self._size = file, os.fstat(file.fileno()).st_size
        self._noted = os.pread(file.fileno(), _LONGEST, 0)

    def _write(self, pid: int | None, *, needed: bool = False) -> None:
        """Write pid and progress in one call, with a fixed length: a killed process leaves the old text or the new."""
        reached = self.reached
        if reached is None:
            text = "" if pid is None else str(pid)
        else:
            kind = "journal" if reached.is_made else "new"
            numbers = f"{reached.number:020} {reached.folded:020} {reached.settled:020}"
            noted = f"{reached.id} {reached.epoch} {kind} {numbers}"
            text = f"{'' if pid is None else pid}\n{noted} {zlib.crc32(noted.encode()):08x}\n"
        with contextlib.nullcontext() if needed else contextlib.suppress(OSError):  # commits are elsewhere, and safe
            fd, data = self._file.fileno(), text.encode()
            written = os.pwrite(fd, data, 0)
            if written < len(data):  # a full disk: what was noted before is good
                os.pwrite(fd, self._noted[:written], 0)
                os.ftruncate(fd, self._size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if len(data) < self._size:
                os.ftruncate(fd, len(data))
            self._noted, self._size = data, len(data)


def _read(text: bytes) -> tuple[int | None, Reached | None]:
    """Return the holder's pid and the noted progress; None for one that is missing or damaged."""
    first, _, second = text.decode(errors="replace").partition("\n")
    pid = int(first) if first.isascii() and first.isdigit() else None
    noted, _, checksum = second.rstrip("\n").rpartition(" ")
    if f"{zlib.crc32(noted.encode()):08x}" != checksum or not noted:
        return pid, None
    id_, epoch, kind, number, *others = noted.split(" ")
    folded, settled = map(int, others or (0, 0))  # an earlier version noted neither
    if kind == "tables":  # of an earlier version, which had no journal for durability "power"
        return pid, Reached(id_, int(epoch), 0, True, int(number), settled)
    return pid, Reached(id_, int(epoch), int(number), kind != "new", folded, settled)


_locks: weakref.WeakSet[CatalogLock] = weakref.WeakSet()  # weak: an interrupted caller may never get its lock


def held() -> list[CatalogLock]:
    """Return the locks that this process holds."""
    return list(_locks)


def _forget_locks() -> None:
    for lock in held():
        lock.forget()


os.register_at_fork(after_in_child=_forget_locks)
