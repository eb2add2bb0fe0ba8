"""Privacy: a catalog belongs to one user. What others could write is tightened or refused before it is opened.

A catalog may hold pickles (stored servers, types): who can write it, or put a -wal beside it, can run code as whoever
opens it. Inside a system's state directory nobody can; a `location` elsewhere is checked here.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from rr_actors.errors import CatalogError

_log = logging.getLogger(__name__)


def make_private(directory: Path, files: Iterable[Path]) -> None:
    """Take the right to write from others for the directory of a catalog, and every right to its files.

    Raises:
        CatalogError: the directory, or one of the files, is another user's, or the directory is one that all share.
            `.path`
        OSError: it cannot be looked at, or tightened.
    """
    found = directory.stat()
    mode = stat.S_IMODE(found.st_mode)
    _check_owner(directory, found)
    if mode & 0o022:
        if mode & stat.S_ISVTX:
            raise CatalogError(
                f"{directory}: expected a directory for catalogs that one user writes, got one that all share"
                f" (mode {mode:o}); choose a directory in it as location",
                path=str(directory),
            )
        _log.info("%s: mode %o tightened to %o", directory, mode, mode & ~0o022)
        directory.chmod(mode & ~0o022)
    for file in files:
        try:
            found = file.stat()
        except FileNotFoundError:
            continue
        _check_owner(file, found)
        if (mode := stat.S_IMODE(found.st_mode)) & 0o077:
            _log.info("%s: mode %o tightened to 600", file, mode)
            file.chmod(0o600)


def _check_owner(path: Path, found: os.stat_result) -> None:
    if found.st_uid != os.geteuid():
        raise CatalogError(
            f"{path}: expected to belong to user {os.geteuid()}, who runs this, got user {found.st_uid}; make it"
            " yours if you trust what is in it, or choose another location",
            path=str(path),
        )
