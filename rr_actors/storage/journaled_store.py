"""JournaledStore: commits go to a journal, and from there, many together and in another thread, to the SQLite file.

A commit of SQLite's own is six locks and two or three writes; in a journal it is one write, as safe from SIGKILL. What
is put and dropped again meanwhile never gets into a table.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import re
import struct
import threading
import zlib
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.base.errors import CatalogError
from rr_actors.base.folder import Folder
from rr_actors.base.scarcity import wanted_by
from rr_actors.registrar.model.rows import TABLE_OF, TABLES, Change, Content, Drop, Int64, Put, Row, Table, apply
from rr_actors.storage import checked_records
from rr_actors.storage.checked_records import Damage
from rr_actors.storage.sql_tables import net_of
from rr_actors.storage.sqlite_store import SqliteStore, segment_prefix, segments_among

_AT_MOST = 100_000  # changes in the journal: another thread is too slow in folding them

_log = logging.getLogger(__name__)


class JournaledStore:
    """A Store (store.py) that survives SIGKILL; made by `open_store` (opening.py). Commits from any thread.

    `tidy` brings the SQLite file up to date with the commits before it.

    Attributes:
        path: the catalog's SQLite file.
    """

    def __init__(self, tables: SqliteStore) -> None:
        self.path = tables.path
        self.epoch = tables.epoch
        self._tables = tables
        self._lock = threading.Lock()  # of what follows
        self._segment: Segment | None = None  # the one that is written, once there is something to write
        self._end = End()  # of the segment before
        self._pending: list[Change] = []  # which are not in the tables
        self._closed = False
        self._tidying = threading.Lock()  # of the tables, and:
        self._full: list[Segment] = []  # in which some of what is pending is

    def load(self) -> Content:
        with self._tidying:
            content = self._tables.load()
            with self._lock:
                changes = list(self._pending)
            apply(content, changes)
            return content

    def commit(self, changes: Sequence[Change]) -> None:
        """Write all changes in their order, atomically.

        Raises:
            CatalogError: it could not be written (disk full, I/O error), or too much waits in the journal that cannot
                be written to the SQLite file; nothing was.
            OverflowError: a number in it, or a row, is too large for SQLite; nothing was written.
            UnicodeEncodeError: a text in it has no UTF-8; nothing was written.
        """
        if not changes:
            return
        if len(self._pending) > _AT_MOST:
            self.tidy()
        with self._lock:
            try:
                if self._segment is None:
                    self._segment = self._new_segment()
                self._segment.append(changes)
            except OSError as error:
                advice = wanted_by(error) or "Make room on the disk, or repair it"
                raise CatalogError(
                    f"{self.path}: expected to write {len(changes)} change(s) to its journal, got: {error.strerror};"
                    f" none of them is written. {advice}; then try again",
                    path=str(self.path),
                ) from error
            self._pending += changes

    def wants_tidying(self) -> bool:
        """Whether anything is in the journal alone."""
        return bool(self._pending)

    def tidy(self) -> None:
        """Fold what is in the journal into the SQLite file, and keep that one's -wal small. Nothing, once it is closed.

        If that fails it stays in the journal.
        """
        with self._tidying:
            if self._closed:
                return
            self._tables.keep_lock()
            self._fold()
            if self._tables.wants_tidying() or self._tables.is_too_large():
                self._tables.tidy()

    def close(self, *, erase: bool = False) -> None:
        """Close it as the contract says. What cannot be folded in now is folded in at the next opening."""
        with self._tidying:
            try:
                self._fold()
            except CatalogError as error:
                if not erase:
                    _log.warning("%s", error)
            finally:
                with self._lock:
                    segment, self._segment = self._segment, None
                    self._closed = True
                if segment is not None:  # nothing is in it, or it would be full
                    segment.remove()
                self._tables.close(erase=erase, settled=not self._pending)

    def _new_segment(self) -> Segment:
        if self._closed:
            raise CatalogError(f"{self.path}: expected an open catalog, got one that is closed", path=str(self.path))
        owner = Owner(self._tables.meta.id, self.epoch)
        full = self._full  # a folding that ends meanwhile empties it; the tables have its number by then
        number = (full[-1].number if full else self._tables.meta.folded) + 1
        segment = Segment(self._tables.folder, self.path, owner, number, self._end)
        self._tables.note(number)
        return segment

    def _fold(self) -> None:
        changes: list[Change] = []
        try:
            with self._lock:
                self._end_segment()
                changes, self._pending = self._pending, []
            if changes:
                self._tables.fold(net_of(changes), self._full[-1].number)
        except BaseException:  # KeyboardInterrupt, too: a thread that commits too much folds for itself
            with self._lock:
                self._pending = changes + self._pending
            raise
        full, self._full = self._full, []
        for segment in full:
            segment.remove()

    def _end_segment(self) -> None:
        segment = self._segment
        if segment is not None and segment.end.records:
            self._end = segment.end
            self._full.append(segment)
            self._segment = None
            segment.close()


# -- the journal -------------------------------------------------------------------------------------------------------
#
# The latest changes of a catalog, which are not in its SQLite file yet; in segments, catalog.journal.<n>. A commit is
# one write at the end of the newest segment: what the kernel has is not lost with the process. Full segments are folded
# into the SQLite file, which counts how far that has come, and removed.
#
# A record's checksum goes on from that of the record before it, and a segment's header names the catalog, its opening,
# and how the segment before it ended. The catalog's lock says which segments have been begun (catalog_lock.py). So what
# is read is always the changes up to some commit. A record that is missing, of another catalog, or wrong differs from
# one that was never finished: a commit that nobody heard of.

_MAGIC = b"RRACJ\0\0\2"
_HEADER = struct.Struct("<8s16sQQQII")  # magic, id, epoch, number, records and checksum before, checksum of all that
_CHECKSUM = struct.Struct("<I")
_UINT64 = b"\xcf"  # how msgpack begins an integer of eight bytes; quicker to look for than what follows it
_TOO_LARGE = re.compile(rb"\xcf[\x80-\xff]")  # such as SQLite does not have, or by chance
_ARRAY = 0x90  # how it begins one of up to fifteen items: a row
_LARGEST = 2**63 - 1
_LONGEST = 10**9 - 1000  # bytes of a row, about, that SQLite takes

_encode = msgspec.msgpack.Encoder().encode


class Owner(msgspec.Struct, frozen=True, gc=False):
    """Whose journal it is: the catalog's id, and how often that had been opened."""

    id: str
    epoch: int


class End(msgspec.Struct, frozen=True, gc=False):
    """How a segment ends: after how many records, with what checksum."""

    records: int = 0
    checksum: int = 0


class Segment:
    """The segment that is written, as a new file.

    Args:
        folder, catalog: the catalog's directory, and its SQLite file there.
        number: its own. A file of that name is one whose making failed, and is written over.
        before: how the one before it ended; anything if that is folded.

    Raises:
        OSError: it cannot be made; at most an empty file is left.
    """

    def __init__(self, folder: Folder, catalog: Path, owner: Owner, number: int, before: End) -> None:
        self.number = number
        self.name = f"{segment_prefix(catalog)}{number}"
        self._folder = folder
        place = (owner.id.encode(), owner.epoch, number)
        header = _HEADER.pack(_MAGIC, *place, before.records, before.checksum, 0)[: -_CHECKSUM.size]
        self._checksum = zlib.crc32(header)
        self._records = 0
        self._fd = folder.open(self.name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        try:
            self._size = checked_records.write_whole(self._fd, header + _CHECKSUM.pack(self._checksum), 0)
        except BaseException:
            self.remove()
            raise

    @property
    def end(self) -> End:
        """How it ends."""
        return End(self._records, self._checksum)

    def append(self, changes: Sequence[Change]) -> None:
        """Write changes as one record.

        Raises:
            OSError: it could not be written; the segment is as it was.
            OverflowError, UnicodeEncodeError: as JournaledStore.commit(), which hands them on.
        """
        body = _encode([(TABLE_OF[type(c.row)], c.row) if type(c) is Put else (c.table, c.id) for c in changes])
        if len(body) > _LONGEST:
            _check_lengths(changes)
        if _UINT64 in body and _TOO_LARGE.search(body):
            _check_numbers(changes)
        record, checksum = checked_records.record(body, self._checksum)
        self._size = checked_records.write_whole(self._fd, record, self._size)
        self._checksum = checksum
        self._records += 1

    def remove(self) -> None:
        """Close it, and remove its file; if that cannot be, it is not read again, and goes at the next opening."""
        self.close()
        self._folder.discard(self.name)

    def close(self) -> None:
        """Write no more to it; again is nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with contextlib.suppress(OSError):  # it is closed all the same
                os.close(fd)


class Found(msgspec.Struct, frozen=True):
    """What there is of a catalog's journal. `contents`: of each segment by its number, None if it is only begun."""

    catalog: Path
    segments: list[str]
    contents: dict[int, bytes | None]

    @property
    def last(self) -> int:
        """The highest number; 0 if there is none."""
        return max(self.contents, default=0)

    def epoch_after(self, folded: int) -> int:
        """Return the last opening in which any of it after segment `folded` was written; 0 if there is none."""
        later = (data for number, data in self.contents.items() if number > folded and data is not None)
        return max((_HEADER.unpack_from(data)[2] for data in later), default=0)

    def since(self, folded: int, owner: Owner, begun: int = 0) -> list[Change]:
        """Return the changes after segment `folded`, as far as nothing is missing; of the rest, a warning tells.

        Args:
            begun: the last segment that is known to have been begun, whether it is there or not.

        Raises:
            Damage: a segment is another catalog's, or a record is not one of a catalog's.
        """
        changes: list[Change] = []
        end: End | None = None
        for number in range(folded + 1, max(self.last, begun) + 1):
            data = self.contents.get(number)
            if data is None and number == self.last > begun:
                break  # begun, and nothing written to it
            name = f"{segment_prefix(self.catalog)}{number}"
            if data is not None:
                _check_owner(name, data, owner)
            if data is None or (end is not None and _before(data) != end):
                _log.warning(
                    "%s: %s: missing, or not what was written next; it and what came later is ignored: what was"
                    " committed since then is lost. A power cut may do that (with durability 'power' it does not), and"
                    " so does a file that is removed, or put in another's place",
                    self.catalog,
                    name,
                )
                break
            end, place = _read_records(data, changes)
            if place.at < len(data):
                _tell_of_rest(self.catalog, name, data, place)
        return changes


def _tell_of_rest(catalog: Path, name: str, data: bytes, end: checked_records.Place) -> None:
    left = len(data) - end.at
    if checked_records.is_torn(data, end):
        _log.warning(
            "%s: %s: its last record is not whole (%d bytes from byte %d on), and ignored: its process died while it"
            " wrote it, and nobody heard that it was written; or the file was cut off there later",
            catalog,
            name,
            left,
            end.at,
        )
    else:
        _log.warning(
            "%s: %s: wrong from byte %d on, and ignored from there: what was committed in these %d bytes, and later,"
            " is lost. Compare it with a copy, and see whether the disk is good",
            catalog,
            name,
            end.at,
            left,
        )


def read(folder: Folder, catalog: Path) -> Found:
    """Return what there is of this catalog's journal; a segment that is removed meanwhile is folded.

    Raises:
        Damage: a file of that name is not a segment.
    """
    found = Found(catalog, [], {})
    for name in segments_among(folder.names(), catalog):
        try:
            data = folder.read(name)
        except FileNotFoundError:
            continue
        number = int(name.removeprefix(segment_prefix(catalog)))
        found.segments.append(name)
        found.contents[number] = _checked(name, number, data)
    return found


def _check_lengths(changes: Sequence[Change]) -> None:
    for change in changes:
        if isinstance(change, Put) and (size := len(_encode(change.row))) > _LONGEST:
            raise OverflowError(f"{change.row.id}: expected a row of up to {_LONGEST} bytes, got {size}")


def _check_numbers(changes: Iterable[Change]) -> None:
    """Of rows whose bytes look as if one was too large. Bytes of some lengths always do, so this has to be quick."""
    for change in changes:
        if type(change) is Put:
            largest = max(_numbers(type(change.row))(change.row))
            if largest > _LARGEST:
                raise OverflowError(f"{change.row.id}: expected a number up to {_LARGEST}, got {largest}")


@functools.cache
def _numbers(type_: type[Row]) -> Callable[[Row], tuple[int, ...]]:
    names = [field.name for field in msgspec.structs.fields(type_) if field.type == Int64]
    return attrgetter(*names, *names) if names else lambda _: (0,)  # of one name alone it would return no tuple


def _checked(name: str, number: int, data: bytes) -> bytes | None:
    """Return the segment's bytes; None if not even its header was written."""
    header = data[: _HEADER.size]
    if not any(header) or (len(header) < _HEADER.size and _MAGIC.startswith(header[: len(_MAGIC)])):
        return None
    if len(header) < _HEADER.size or not header.startswith(_MAGIC):
        raise Damage(f"{name}, which is something else than a part of a catalog's journal")
    if _HEADER.unpack(header)[3] != number or zlib.crc32(header[: -_CHECKSUM.size]) != _HEADER.unpack(header)[-1]:
        raise Damage(f"{name}, whose beginning is damaged, or another file's")
    return data


def _check_owner(name: str, data: bytes, owner: Owner) -> None:
    """An earlier epoch has nothing that is not folded; a later one is this catalog's, if a power cut took its -wal."""
    id_, epoch = _HEADER.unpack_from(data)[1:3]
    if id_ != owner.id.encode().ljust(16, b"\0") or epoch < owner.epoch:
        raise Damage(f"{name}, which belongs to another catalog, or to an earlier state of this one")


def _before(data: bytes) -> End:
    return End(*_HEADER.unpack_from(data)[4:6])


def _read_records(data: bytes, changes: list[Change]) -> tuple[End, checked_records.Place]:
    """Add the changes of a segment's whole records; return how and where they end."""
    checksum: int = _CHECKSUM.unpack_from(data, _HEADER.size - _CHECKSUM.size)[0]
    end = checked_records.Place(_HEADER.size, checksum)
    records = 0
    for body, after in checked_records.records(data, end):
        changes += _decoded(body)
        records += 1
        end = after
    return End(records, end.checksum), end


def _decoded(body: bytes) -> list[Change]:
    try:
        return [_change(table, raw) for table, raw in _decoder(list[tuple[Table, msgspec.Raw]])(body)]
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Damage(f"a bad record in its journal: {error}") from error


def _change(table: Table, raw: msgspec.Raw) -> Change:
    if bytes(raw)[0] & 0xF0 == _ARRAY:
        return Put(_decoder(TABLES[table])(raw))
    return Drop(table, _decoder(str)(raw))


@functools.cache
def _decoder(type_: Any) -> Callable[[Any], Any]:
    """Made only when something is read: few openings find a journal."""
    return msgspec.msgpack.Decoder(type_).decode
