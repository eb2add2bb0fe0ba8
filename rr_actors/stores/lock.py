"""CatalogLock: one process at a time has a catalog open. The kernel releases it when that process dies."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import NoReturn

from rr_actors.errors import CatalogLocked


class CatalogLock:
    """An exclusive lock on a catalog, held from when this is made until `release`; the holder's pid is in its file.

    `flock` and not `lockf`: that one is lost as soon as anything in the process reads the lock's file.

    Raises:
        CatalogLocked: it is held already. `.path`, `.pid`
    """

    def __init__(self, catalog: Path) -> None:
        self._path = catalog.with_suffix(".lock")
        while True:
            self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            if not self._lock():
                holder = os.pread(self._fd, 20, 0)
                os.close(self._fd)
                _refuse(catalog, int(holder) if holder.isdigit() else None)
            if self._is_there():
                break
            os.close(self._fd)  # its last holder erased the catalog, and this file with it
        _locks.add(self)
        self._write(str(os.getpid()))

    def release(self, *, remove: bool = False) -> None:
        """Let others have it; with `remove`, remove its file.

        Raises:
            OSError: it is released, and its file is still there.
        """
        _locks.discard(self)
        try:
            if remove:
                self._path.unlink(missing_ok=True)
            self._write("")
        finally:
            os.close(self._fd)

    def forget(self) -> None:
        """In a forked child: the lock is the parent's alone, and must not outlive it here."""
        os.close(self._fd)

    def _lock(self) -> bool:
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def _is_there(self) -> bool:
        try:
            return os.path.samestat(self._path.stat(), os.fstat(self._fd))
        except FileNotFoundError:
            return False

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError):  # a full disk: the pid is for people, the lock does without
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, text.encode(), 0)


_locks: set[CatalogLock] = set()


def _forget_locks() -> None:
    while _locks:
        _locks.pop().forget()


os.register_at_fork(after_in_child=_forget_locks)


def _refuse(path: Path, pid: int | None) -> NoReturn:
    holder = "another process" if pid is None else "this process" if pid == os.getpid() else f"process {pid}"
    raise CatalogLocked(
        f"{path}: expected a catalog that nobody has open, got one that {holder} holds; close it there first, or"
        " choose another name or location",
        path=str(path),
        pid=pid,
    )
