"""Watched: whether anybody wants to hear what happens in the system. One byte that all its processes share.

Most systems run unwatched, and telling the system's own process of every load costs as much as a tenth of the load: so
nothing is told then. What changes here is seen everywhere at once, and asked for without a system call.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from pathlib import Path

from rr_actors.errors import ConfigError
from rr_actors.folder import Folder

_NAME = "watched"


class Watched:
    """The byte of one running system, false at first.

    Args:
        run_dir: the system's StateDir.run_dir.

    Raises:
        ConfigError: it cannot be made there.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._file: os.stat_result
        self._shared = self._open()

    def _open(self) -> mmap.mmap:
        try:
            with Folder.at(self._run_dir) as run:
                fd = run.open(_NAME, os.O_RDWR | os.O_CREAT)
            try:
                os.ftruncate(fd, 1)
                self._file = os.fstat(fd)
                return mmap.mmap(fd, 1)
            finally:
                os.close(fd)
        except OSError as error:
            path = self._run_dir / _NAME
            text = f"cannot use {path}: {error.strerror or error}: remove it, or choose another state_dir"
            raise ConfigError(text, file=str(path), key="state_dir") from error

    def restore(self) -> None:
        """Make the file again, or use the one that another process has made, if it was removed.

        Raises:
            ConfigError: it cannot be made.
        """
        with contextlib.suppress(OSError):  # it is not there
            if os.path.samestat(os.lstat(self._run_dir / _NAME), self._file):
                return
        watched = bool(self)
        self._shared = self._open()
        if watched:
            self.set(watched)

    def __bool__(self) -> bool:
        return self._shared[0] != 0

    def set(self, watched: bool) -> None:
        """Say so, to all processes of the system."""
        self._shared[0] = watched
