"""KeptRecord: what a manager knows beside its catalog, in a file of JSON that is written anew at each change."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from rr_actors.base.folder import Folder, make_directories
from rr_actors.base.reporting.log import Log

logger = Log("rr_actors.managers")

R = TypeVar("R", bound=msgspec.Struct)


class KeptRecord(Generic[R]):
    """A struct that survives its manager. A fault of the disk costs the memory of it, and never a decision.

    Attributes:
        now: the struct. After a change, call save().
    """

    def __init__(self, path: Path, kind: type[R]) -> None:
        """Read the file. If there is none, begin with what `kind()` makes; if it is damaged, log that, too."""
        self._path = path
        self._saving = threading.Lock()
        self._is_behind = False
        self.now: R = kind()
        try:
            with Folder.at(path.parent) as folder:
                self.now = msgspec.json.decode(folder.read(path.name), type=kind)
        except FileNotFoundError:
            pass
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            logger.warning("%s cannot be read, and is started anew: %s", path, error)

    def save(self) -> bool:
        """Write the struct as it is now, whole or not at all. Return whether it is on disk.

        If the disk refuses it, log that once. The next save() writes all of it again. From any thread.
        """
        with self._saving:
            try:
                make_directories(self._path.parent)
                with Folder.at(self._path.parent) as folder:
                    folder.write(self._path.name, msgspec.json.format(msgspec.json.encode(self.now)))
            except OSError as error:
                if not self._is_behind:
                    logger.warning("%s cannot be written, and a restart would not know of it: %s", self._path, error)
                self._is_behind = True
                return False
            if self._is_behind:
                logger.info("%s is on disk again", self._path)
            self._is_behind = False
            return True

    def catch_up(self) -> bool:
        """Write the struct if the disk has refused the last save(). Return whether it is on disk as it is now.

        What somebody has set is not made again by the next event: have the planning loop call this until it is True.
        """
        return not self._is_behind or self.save()
