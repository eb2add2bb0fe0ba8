"""Watched: whether anybody wants to hear what happens in the system. One byte that all its processes share.

Most systems run unwatched, and telling the system's own process of every load costs as much as a tenth of the load: so
nothing is told then. What changes here is seen everywhere at once, and asked for without a system call.
"""

from __future__ import annotations

import mmap
import os
from pathlib import Path


class Watched:
    """The byte of one running system, false at first.

    Args:
        run_dir: the system's StateDir.run_dir.
    """

    def __init__(self, run_dir: Path) -> None:
        fd = os.open(run_dir / "watched", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.ftruncate(fd, 1)
            self._shared = mmap.mmap(fd, 1)
        finally:
            os.close(fd)

    def __bool__(self) -> bool:
        return self._shared[0] != 0

    def set(self, watched: bool) -> None:
        """Say so, to all processes of the system."""
        self._shared[0] = watched
