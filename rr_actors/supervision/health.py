"""Health: whether a child's process has what it needs to work: descriptors, rights, and its root."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable
from pathlib import Path

_OF_ALL = (errno.ENFILE, errno.ENOMEM, errno.EINTR, errno.EIO, errno.ENOENT, errno.ENOTDIR)
"""What a process in its place would suffer from as well."""


_SPARE = 8
"""Descriptors that must be free: a connection and a segment of a journal take some, and give them back."""


class Health:
    """Looks after this process, from now on.

    Args:
        directories: those it works in, now.
    """

    def __init__(self, directories: Callable[[], Iterable[Path]]) -> None:
        self._directories = directories
        self._root = os.stat("/")

    def trouble(self) -> str:
        """Return why this process cannot go on, in words; "" if it can.

        To open a directory takes free descriptors and the rights to it. Only what another process in its place would
        not suffer from is trouble. Blocks for some 10 µs for each directory.
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
