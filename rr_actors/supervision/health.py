"""Health: checks that a child's process has what it needs to work: descriptors, rights, and its root."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable
from pathlib import Path

_OF_ALL = (errno.ENFILE, errno.ENOMEM, errno.EINTR, errno.EIO, errno.ENOENT, errno.ENOTDIR)
"""Errors that a new process in its place would have as well."""


_SPARE = 8
"""How many descriptors must be free: a connection or a segment of a journal takes some for a while."""


class Health:
    """The health of this process.

    Args:
        directories: returns the directories in which the process works now.
    """

    def __init__(self, directories: Callable[[], Iterable[Path]]) -> None:
        self._directories = directories
        self._root = os.stat("/")

    def trouble(self) -> str:
        """Return why this process cannot go on, in words; "" if it can.

        It opens each directory, which takes free descriptors and the rights to it. An error that a new process would
        have as well is no trouble. Blocks for some 10 µs for each directory.
        """
        if not os.path.samestat(self._root, os.stat("/")):
            return "has another root directory than it was started in (chroot)"
        for directory in self._directories():
            try:
                _open(directory)
            except OSError as error:
                if error.errno not in _OF_ALL:
                    name = errno.errorcode.get(error.errno or 0, "OSError")
                    return f"cannot open {directory}: {name} ({error.strerror})"
        return ""


def _open(directory: Path) -> None:
    opened = [os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)]
    try:
        opened.extend(os.dup(opened[0]) for _ in range(_SPARE - 1))
    finally:
        for descriptor in opened:
            os.close(descriptor)
