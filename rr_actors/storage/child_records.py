"""ChildRecords: the children that dynamic supervisors were given an id for, on disk, beside the catalogs.

The file <state_dir>/.children/:SUPERVISOR/ID has one child and its arguments. A record is committed before its child
starts for the first time, and removed when the child has ended for good. Each child has a file of its own, so damage to
one leaves the others. A record is written whole, by a rename, and its checksum covers all of it.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Generator, Iterable
from pathlib import Path

import msgspec

from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogVersion
from rr_actors.base.folder import Folder, NotAFile, make_directories
from rr_actors.base.scarcity import wanted_by

_PLACE = ".children"  # no registrar is called that
_MAGIC = b"rr-child"
_VERSION = 1


class ChildRecord(msgspec.Struct, frozen=True):
    """One child: the path of its supervisor from the root on, its id, when it was recorded, its pickled arguments."""

    supervisor: str
    id: str
    at_ns: int
    args: bytes


def encode(record: ChildRecord) -> bytes:
    """Return a record as the bytes of its file: a line with the version and a checksum, then the record."""
    body = b"%d %b" % (_VERSION, msgspec.msgpack.encode(record))
    return b"%b %08x %b" % (_MAGIC, zlib.crc32(body), body)


def decode(data: bytes, path: str, supervisor: str, id: str) -> ChildRecord:
    """Return the record of that child in the bytes of its file.

    Raises:
        CatalogDamaged: it is not what encode() returned for this child.
        CatalogVersion: another version of rr_actors wrote it.
    """
    magic, _, rest = data.partition(b" ")
    checksum, _, body = rest.partition(b" ")
    if magic != _MAGIC or checksum != b"%08x" % zlib.crc32(body):
        raise _damaged(path, "other bytes than were written")
    version, _, packed = body.partition(b" ")
    if version != b"%d" % _VERSION and version.isdigit() and len(version) < 10:
        text = f"{path}: expected the record of a child in version {_VERSION}, got version {int(version)}; it is left"
        raise CatalogVersion(f"{text} as it is", path=path, expected=_VERSION, got=int(version))
    if version != b"%d" % _VERSION:
        raise _damaged(path, "one of no version")
    try:
        record = msgspec.msgpack.decode(packed, type=ChildRecord)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise _damaged(path, f"one that rr_actors does not write: {error}") from error
    if (record.supervisor, record.id) != (supervisor, id):
        raise _damaged(path, f"that of {record.id!r} of the supervisor {record.supervisor!r}")
    return record


def _damaged(path: str, got: str) -> CatalogDamaged:
    text = f"{path}: expected the record of a child, got {got}; it is left as it is. start_child() with this id and"
    return CatalogDamaged(f"{text} arguments replaces it, terminate_child() removes it", path=path)


class ChildRecords:
    """The records of one state directory. A supervisor is named by its path in the tree. All methods block.

    One caller at a time may use those of one supervisor.
    """

    def __init__(self, state_dir: str | os.PathLike[str]) -> None:
        self.state_dir = Path(state_dir)

    def ids(self, supervisor: str) -> list[str]:
        """Return the ids of the children of a supervisor that have a record, readable or not, sorted.

        Raises:
            CatalogError: the directory cannot be read.
        """
        place = self.place(supervisor)
        with _errors_named(place):
            try:
                with Folder.below(self.state_dir, place) as folder:
                    return sorted(name for name in folder.names() if not name.startswith("."))
            except FileNotFoundError:
                return []

    def read(self, supervisor: str, id: str) -> ChildRecord:
        """Return the record of a child.

        Raises:
            CatalogDamaged, CatalogVersion: as decode() says.
            CatalogError: it cannot be read.
        """
        place = self.place(supervisor)
        with _errors_named(place / id), Folder.below(self.state_dir, place) as folder:
            return decode(folder.read(id), str(place / id), _below_root(supervisor), id)

    def write(self, supervisor: str, id: str, args: bytes, at_ns: int, *, synced: bool) -> None:
        """Commit the record of a child, in the place of an older one. `synced`: a power cut does not lose it.

        Raises:
            CatalogError: it cannot be written.
        """
        place = self.place(supervisor)
        with _errors_named(place / id):
            make_directories(place, synced=synced)
            with Folder.below(self.state_dir, place) as folder:
                folder.tighten(0o077)
                folder.write(id, encode(ChildRecord(_below_root(supervisor), id, at_ns, args)), synced=synced)

    def remove(self, supervisor: str, ids: Iterable[str], *, synced: bool) -> None:
        """Remove the records of these children, if there are any.

        Raises:
            CatalogError: one cannot be removed.
        """
        place = self.place(supervisor)
        with _errors_named(place):
            try:
                folder = Folder.below(self.state_dir, place)
            except FileNotFoundError:
                return
            with folder:
                for id in ids:
                    with contextlib.suppress(FileNotFoundError):
                        folder.unlink(id)
                for left in [name for name in folder.names() if name.startswith(".")]:  # by a crash in a write
                    folder.discard(left)
                if synced:
                    os.fsync(folder.fd)
        with contextlib.suppress(OSError):  # it has others
            os.rmdir(place)

    def supervisors(self) -> list[str]:
        """Return the supervisors that have records, each by its ids below the root.

        Raises:
            CatalogError: the directory cannot be read.
        """
        with _errors_named(self.state_dir / _PLACE):
            try:
                with Folder.unlinked(self.state_dir / _PLACE) as top:
                    return sorted(name[1:].replace(":", "/") for name in top.names() if name.startswith(":"))
            except FileNotFoundError:
                return []

    def remove_below(self, supervisor: str) -> None:
        """Remove the records of a supervisor that is gone for good, and of all supervisors below it.

        Raises:
            CatalogError: one cannot be removed.
        """
        top = supervisor.partition("/")[0]
        gone = _below_root(supervisor)
        for other in self.supervisors():
            if not gone or f"{other}/".startswith(f"{gone}/"):
                path = f"{top}/{other}" if other else top
                self.remove(path, self.ids(path), synced=False)

    def place(self, supervisor: str) -> Path:
        """Return the directory that has the records of a supervisor's children."""
        return self.state_dir / _PLACE / f":{_below_root(supervisor).replace('/', ':')}"


def _below_root(path: str) -> str:
    """Return the ids below the root: the root of a second system in one process has another id."""
    return path.partition("/")[2]


@contextlib.contextmanager
def _errors_named(path: Path) -> Generator[None]:
    try:
        yield
    except NotAFile as error:
        raise _damaged(str(error.filename), error.got) from error
    except OSError as error:
        got = wanted_by(error) or error.strerror or error
        text = f"{path}: expected the record of a child that this process may read and write, got: {got}"
        raise CatalogError(text, path=str(path)) from error
