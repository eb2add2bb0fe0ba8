"""KeptRecord: what a manager knows beside its catalog, in a file of JSON that is written anew at each change."""

from __future__ import annotations

from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from rr_actors.base.folder import Folder, make_directories

R = TypeVar("R", bound=msgspec.Struct)


class KeptRecord(Generic[R]):
    """A struct that survives its manager.

    Attributes:
        now: the struct. After a change, call save().
    """

    def __init__(self, path: Path, kind: type[R]) -> None:
        """Read the file; if there is none yet, or it is damaged, begin with what `kind()` makes."""
        self._path = path
        try:
            with Folder.at(path.parent) as folder:
                self.now = msgspec.json.decode(folder.read(path.name), type=kind)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            self.now = kind()

    def save(self) -> None:
        """Write the struct as it is now, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        make_directories(self._path.parent)
        with Folder.at(self._path.parent) as folder:
            folder.write(self._path.name, msgspec.json.format(msgspec.json.encode(self.now)))
