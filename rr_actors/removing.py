"""Removing: a directory goes with all that is in it.

Not by shutil, which brings bz2 and lzma to every process, nor with its errors: what is left is removed by the next who
comes by.
"""

from __future__ import annotations

import contextlib
import os


def remove_tree(directory: str | os.PathLike[str], *, dir_fd: int | None = None) -> None:
    """Remove the directory and what is in it, as far as that can be; a link in it goes, not what it leads to.

    Nothing of it is reached by a path that somebody could put a link into meanwhile. With `dir_fd`, it is a name in the
    directory that this descriptor is of. Blocks.
    """
    with contextlib.suppress(OSError):
        for _, inner, others, descriptor in os.fwalk(directory, topdown=False, dir_fd=dir_fd):
            for name in (*inner, *others):
                _remove(name, descriptor)
        os.rmdir(directory, dir_fd=dir_fd)


def _remove(name: str, place: int) -> None:
    """A file, a link, or a directory that is empty by now; what it is, is not asked for beforehand."""
    with contextlib.suppress(OSError):
        try:
            os.unlink(name, dir_fd=place)
        except (IsADirectoryError, PermissionError):  # which of them, depends on the platform
            os.rmdir(name, dir_fd=place)
