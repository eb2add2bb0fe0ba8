"""Privacy: a catalog belongs to one user. Rights of other users are removed before it is opened, or it is refused.

A catalog may hold pickles (stored servers, types). A user that can write it, or put a -wal beside it, can run code as
the user that opens it. No other user can do that inside a system's state directory; a `location` elsewhere is checked
here. The directory comes first: from then on no other user can add a file. The older files are checked one by one.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterable

from rr_actors.base.errors import CatalogError
from rr_actors.base.folder import Folder, NotAFile

_log = logging.getLogger(__name__)


def make_private(folder: Folder) -> None:
    """Remove the right of other users to write the directory of a catalog.

    Raises:
        CatalogError: all users share the directory (sticky bit). `.path`
    """
    mode = stat.S_IMODE(folder.check_owner().st_mode)
    if mode & 0o022 and mode & stat.S_ISVTX:
        raise CatalogError(
            f"{folder.path}: expected a directory for catalogs that one user writes, got one that all share"
            f" (mode {mode:o}); choose a directory in it as location",
            path=str(folder.path),
        )
    before, after = folder.tighten(0o022)
    if before != after:
        _log.info("%s: mode %o tightened to %o", folder.path, before, after)


def make_files_private(folder: Folder, names: Iterable[str]) -> None:
    """Remove all rights of other users to these files. Skip an entry that is no file: the reader refuses it."""
    for name in names:
        try:
            found = folder.look(name)
        except NotAFile:
            continue
        if found is None or not stat.S_IMODE(found.st_mode) & 0o077:
            continue
        with folder.open(name) as file:
            os.fchmod(file.fileno(), 0o600)
        _log.info("%s: mode %o tightened to 600", folder.path / name, stat.S_IMODE(found.st_mode))
