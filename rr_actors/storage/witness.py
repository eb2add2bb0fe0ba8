"""Witness: a state directory's record of a catalog, outside of the catalog's own directory.

Each registrar has a file, <state_dir>/.catalogs/<registrar>: the catalog's id, how often it was opened, and its path.
It tells a new catalog from one whose directory was removed, swapped or put back from an older copy.

A catalog that is erased on purpose leaves no file. One number for all of them, <state_dir>/.catalogs/.epochs, says
which epochs are spent: links of an earlier incarnation must not be taken for those of a later one.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import zlib
from collections.abc import Generator
from pathlib import Path

import msgspec

from rr_actors.base.folder import Folder
from rr_actors.base.reporting.log import Log

_PLACE = ".catalogs"  # no registrar is called that
_EPOCHS = ".epochs"  # nor that

_log = Log(__name__)


class LastOpening(msgspec.Struct, frozen=True):
    """A catalog at its last opening."""

    id: str
    epoch: int
    path: str


class Witness:
    """The record of one registrar's catalog. Its errors are logged: the catalog works without it.

    Args:
        state_dir: the system's state directory.
        registrar: the registrar's name.
        formerly: its name in earlier runs, which its catalog may have.
    """

    def __init__(self, state_dir: str | os.PathLike[str], registrar: str, formerly: str = "") -> None:
        self.registrar = registrar
        self.formerly = formerly
        self.state_dir = Path(state_dir)
        self._place = self.state_dir / _PLACE

    def known(self) -> LastOpening | None:
        """Return the catalog at its last opening; None if there was none, or the record cannot be read."""
        with self._errors_logged(), _opened(self._place) as place:
            return _read(place, self.registrar)
        return None

    def note(self, known: LastOpening, *, synced: bool = False) -> None:
        """Record that the catalog was opened. `synced`: a power cut neither loses the record nor damages it."""
        body = msgspec.json.encode(known)
        with self._errors_logged(), _opened(self._place) as place:
            place.write(self.registrar, b"%08x %b\n" % (zlib.crc32(body), body), synced=synced)
            if synced:
                with Folder.at(self.state_dir) as state:
                    os.fsync(state.fd)

    def known_or_spent(self) -> tuple[LastOpening | None, int]:
        """Return what known() does; and if it has no epoch, the highest of all catalogs here that were erased."""
        with self._errors_logged(), _opened(self._place) as place:
            known = _read(place, self.registrar)
            return known, 0 if known is not None and known.epoch else _spent(place)
        return None, 0

    def forget(self, epoch: int) -> bool:
        """Remove the record, because the catalog is about to be erased; return whether its epoch is noted as spent."""
        with self._errors_logged(), _opened(self._place) as place:
            _spend(place, epoch)
            place.discard(self.registrar)
            return True
        return False

    def spend(self, epoch: int) -> bool:
        """Note an epoch as spent, if the catalog has no record; return whether that is done."""
        with self._errors_logged(), _opened(self._place) as place:
            if not place.has(self.registrar):
                _spend(place, epoch)
                return True
        return False

    @contextlib.contextmanager
    def _errors_logged(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            _log.warning(
                "%s: what is known of the catalog of %s cannot be read or written: %s; if that catalog is removed or"
                " replaced, nobody will notice",
                self._place,
                self.registrar,
                error,
            )


def tell_of_missing(state_dir: str | os.PathLike[str]) -> list[str]:
    """Log each recorded catalog that is missing; return the names of their registrars."""
    missing: list[str] = []
    try:
        with _opened(Path(state_dir, _PLACE)) as place:
            for name in sorted(place.names()):
                known = None if name.startswith(".") else _read(place, name)
                if known is not None and is_missing(Path(known.path)):
                    missing.append(name)
                    _log.warning("%s", missing_text(name, known))
    except OSError as error:
        _log.warning("%s: which catalogs there were cannot be read: %s", state_dir, error)
    return missing


def segment_prefix(path: Path) -> str:
    """Return the prefix of the names of the segments of a catalog's journal; a number follows it."""
    return f"{path.stem}.journal."


def is_missing(path: Path) -> bool:
    """Return whether a catalog has neither its SQLite file nor the first segment of its journal."""
    return not (os.path.exists(path) or os.path.exists(path.with_name(f"{segment_prefix(path)}1")))


def missing_text(registrar: str, known: LastOpening) -> str:
    """Return the warning about a catalog that is missing."""
    return (
        f"{registrar}: expected its catalog {known.path} (opened {known.epoch} times), got none: it was removed. What"
        " the registrar held and served is lost, and it starts empty; put a copy in its place before it is opened, if"
        " there is one"
    )


def _opened(path: Path) -> Folder:
    """Open or make the directory of the records."""
    try:
        place = Folder.unlinked(path)
    except FileNotFoundError:
        with Folder.at(path.parent) as state:
            return state.inner(path.name)
    try:
        place.tighten(0o077)
    except BaseException:
        place.close()
        raise
    return place


def _spent(place: Folder) -> int:
    if not place.has(_EPOCHS):
        return 0
    with place.open(_EPOCHS) as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        return _number_in(file)


def _spend(place: Folder, epoch: int) -> None:
    with place.open(_EPOCHS, os.O_RDWR | os.O_CREAT) as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # another process may be erasing a catalog, too
        if epoch > _number_in(file):
            os.pwrite(file.fileno(), b"%020d" % epoch, 0)


def _number_in(file: io.FileIO) -> int:
    text = os.pread(file.fileno(), 20, 0)
    return int(text) if text.isdigit() else 0


def _read(place: Folder, name: str) -> LastOpening | None:
    if not place.has(name):  # nearly always, and an error costs more
        return None
    try:
        checksum, _, body = place.read(name).partition(b" ")
    except FileNotFoundError:
        return None
    body = body.removesuffix(b"\n")
    if checksum != b"%08x" % zlib.crc32(body):
        _log.warning("%s: damaged, and not used; it is written anew when the catalog is opened", place.path / name)
        return None
    return msgspec.json.decode(body, type=LastOpening)
