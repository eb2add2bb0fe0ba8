"""JournaledStore: commits go to a journal. Another thread folds many of them at a time into the SQLite file.

SQLite's own commit takes six locks and two or three writes; a commit to the journal is one write, and as safe from
SIGKILL. With durability "power" one fdatasync follows, and one fsync of the directory for each new segment. A row that
is put and dropped again before the folding never gets into a table.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
import threading
import time
import zlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from rr_actors.base.errors import CatalogDamaged, CatalogError
from rr_actors.base.folder import Folder
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.registrar.model.rows import TABLE_OF, Change, Content, Put, apply
from rr_actors.storage.damage import Damage
from rr_actors.storage.sql_tables import Meta, check_lengths, check_numbers, decoded, net_of
from rr_actors.storage.sqlite_store import SqliteTables, segments_among
from rr_actors.storage.witness import segment_prefix

_AT_MOST = 1_000_000  # changes in the journal: those of many seconds. The folding has failed all the time, or hangs

LOOK_S = 0.1
"""The longest time for which commits are acknowledged after the directory of a catalog has gone away."""

_log = Log(__name__)


class JournaledStore:
    """A Store (store.py) that survives SIGKILL, and a power cut if its tables do; made by `open_store` (opening.py).

    Any thread may commit.

    `upkeep` brings the SQLite file, with its -wal, up to date with the commits before it. A segment stays until the
    file has its changes without the -wal: so no single damaged file loses what was folded.

    Args:
        tables: the catalog's SQLite file.
        kept: the names of segments that are folded, but that the file may not have without its -wal.
        end: the end of the last one.

    Attributes:
        path: the catalog's SQLite file.
    """

    def __init__(self, tables: SqliteTables, kept: Iterable[str] = (), end: End | None = None) -> None:
        self.path = tables.path
        self.epoch = tables.epoch
        self._tables = tables
        self._look_at = 0.0  # when a commit looks next whether the directory is in its place
        self._lock = threading.Lock()  # protects the next five
        self._segment: Segment | None = None  # takes commits; made by the first commit
        self._last = tables.meta.folded  # the number of the segment before
        self._end = end or End()  # and its end
        self._pending: list[Change] = []  # changes that are not in the tables
        self._closed = False
        self._tidying = threading.Lock()  # protects the tables, and:
        self._full: list[Segment] = []  # ended segments with pending changes
        self._kept = list(kept)

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
            CatalogError: the changes could not be written (disk full, I/O error, the directory has gone away), or the
                journal is full because the SQLite file takes nothing; nothing was written.
            OverflowError: a number or a row is too large for SQLite; nothing was written.
            UnicodeEncodeError: a text has no UTF-8; nothing was written.
        """
        if not changes:
            return
        if len(self._pending) >= _AT_MOST:
            raise CatalogError(
                f"{self.path}: expected fewer than {_AT_MOST} changes in its journal, got {len(self._pending)}, which"
                " the SQLite file has not taken; no more are written until it takes them. The log has the reason; a"
                " tool that keeps the file locked is one",
                path=str(self.path),
            )
        if (now := time.monotonic()) >= self._look_at:
            self._tables.place.check()
            self._look_at = now + LOOK_S
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
        """Return whether a change is in the journal alone."""
        return bool(self._pending)

    def upkeep(self) -> None:
        """Fold the journal's changes into the SQLite file. Do nothing once this is closed, or while the directory has
        gone away.

        If the folding fails, the changes stay in the journal.
        """
        with self._tidying:
            if self._is_usable():
                self._fold()
                if self._tables.wants_tidying() or self._tables.is_too_large():
                    self._settle()

    def tidy(self) -> None:
        """Fold, and have the file itself take what its -wal has; then the journal keeps nothing."""
        with self._tidying:
            if self._is_usable():
                self._fold()
                self._settle()

    def _is_usable(self) -> bool:
        if self._closed or not self._tables.place.is_there():
            return False
        self._tables.keep_lock()
        return True

    def copy(self, content: Content, path: Path) -> None:
        self._tables.copy(content, path)

    def close(self, *, erase: bool = False) -> None:
        """Close the store as the contract says. The next opening folds the changes that cannot be folded now."""
        with self._tidying:
            try:
                if not erase:
                    self._fold()
                    self._settle()
                elif self._tables.is_made:
                    self._fold()
            except CatalogError as error:
                if not erase:
                    _log.warning("%s", error)
            finally:
                with self._lock:
                    segment, self._segment = self._segment, None
                    self._closed = True
                if segment is not None and segment.end.records:  # _fold() was interrupted, or a commit came behind it
                    segment.close()
                elif segment is not None:
                    segment.remove()
                self._tables.close(erase=erase, settled=not self._pending)

    def _new_segment(self) -> Segment:
        if self._closed:
            raise CatalogError(f"{self.path}: expected an open catalog, got one that is closed", path=str(self.path))
        tables, number = self._tables, self._last + 1
        begins = number == 1 and not tables.is_made
        segment = Segment(
            tables.folder, self.path, tables.meta, number, self._end, begins=begins, synced=tables.is_synced
        )
        tables.note(number)
        if begins:
            tables.note_outside()
        return segment

    def _fold(self) -> None:
        self._fold_again()
        was_made = self._tables.is_made
        changes: list[Change] = []
        try:
            with self._lock:
                if not was_made and not self._full and not any(net_of(self._pending).puts.values()):
                    self._begin_again()
                segment = self._segment
                if segment is not None and segment.end.records:
                    self._settle_end(segment)
                    self._last, self._end = segment.number, segment.end
                    self._full.append(segment)
                    self._segment = None
                    segment.close()
                changes, self._pending = self._pending, []
            if changes:
                self._tables.fold(net_of(changes), self._full[-1].number)
        except BaseException:  # KeyboardInterrupt, too: save_catalog() may fold in the main thread
            with self._lock:
                self._pending = changes + self._pending
            raise
        full, self._full = self._full, []
        self._kept += [segment.name for segment in full]
        if full:
            self._note()  # also that the file is made: from now on a catalog without its file is a damaged one

    def _note(self) -> None:
        with self._lock:
            self._tables.note(self._last if self._segment is None else self._segment.number)

    def _settle_end(self, segment: Segment) -> None:
        try:
            segment.settle()
        except OSError as error:
            raise CatalogError(
                f"{self.path}: expected to cut a record that was refused off {segment.name}, got: {error.strerror};"
                " what was written before is safe there. Repair the disk, or move the catalog to another",
                path=str(self.path),
            ) from error

    def _settle(self) -> None:
        """Have the SQLite file take its -wal, and remove the segments that it has then."""
        tables = self._tables
        if not tables.is_made or (not self._kept and not tables.wants_tidying() and not tables.is_too_large()):
            return
        try:
            tables.tidy()
        except CatalogDamaged as error:
            _log.warning("%s. It is made again from the journal", error)
            tables.reopen()
            self._fold_again()
            tables.tidy()
        if tables.settled == tables.meta.folded:
            self._note()  # first: a segment that is missing then is not missed
            kept, self._kept = self._kept, []
            for name in kept:
                tables.folder.discard(name)

    def _fold_again(self) -> None:
        """Fold the kept segments that the tables have no more, since reopen(); nearly always there are none."""
        tables, last = self._tables, self._full[0].number - 1 if self._full else self._last
        if tables.meta.folded < last:
            before = msgspec.structs.replace(tables.meta, epoch=0)  # segments of earlier openings are kept, too
            found = read(tables.folder, self.path).since(before, until=last)
            tables.fold(net_of(found.changes), last)

    def _begin_again(self) -> None:
        """Forget all commits of a catalog without a file, which have come to nothing. With the lock."""
        segment, self._segment, self._pending = self._segment, None, []
        if segment is not None:
            self._tables.forget_outside()  # first: a crash leaves no record of what is not there
            self._tables.note(0)
            segment.remove()


# -- the journal -------------------------------------------------------------------------------------------------------
#
# The latest changes of a catalog, which are not in its SQLite file yet; in segments, catalog.journal.<n>. A commit is
# one write at the end of the newest segment: bytes that the kernel has are not lost with the process. Full segments are
# folded into the SQLite file, which has the number of the last one, and removed.
#
# A record begins with its length, and with its length XOR the checksum of the record before it. That value also starts
# the record's own checksum. So a wrong length differs from an unfinished record, and no record can be left out. The
# first record continues from the checksum of the segment's header, which names the catalog, its opening, and the end of
# the segment before it. The catalog's lock has the number of the last segment that was begun (catalog_lock.py). So a
# reader always gets the changes up to some commit. A record that is missing, damaged or another catalog's differs from
# an unfinished one, which belongs to a commit that was never acknowledged.

_MAGIC = b"RRACJ\0\0\2"
_FIRST = b"RRACF\0\0\2"  # of segment 1 of a catalog whose SQLite file is made later: with it all is in the journal
_HEADER = struct.Struct("<8s16sQQQII")  # magic, id, epoch, number, records and checksum before, checksum of all that
_CHECKSUM = struct.Struct("<I")
_RECORD = struct.Struct("<III")  # the body's length, that XOR the checksum before, the checksum
_UINT64 = b"\xcf"  # msgpack's first byte of an integer of eight bytes; a search for it alone is quicker
_TOO_LARGE = re.compile(rb"\xcf[\x80-\xff]")  # an integer too large for SQLite, or other bytes by chance
_LONGEST = 10**9 - 1000  # bytes: about the longest row that SQLite takes

_encode = msgspec.msgpack.Encoder().encode


class RecordEnd(NamedTuple):
    """The end of a file or of a record in it: the byte after it, and its checksum."""

    at: int
    checksum: int


def record(body: bytes, before: int) -> tuple[bytes, int]:
    """Return a record's bytes and its checksum. `before` is the checksum of the record before it."""
    length = len(body)
    first = before ^ length
    checksum = zlib.crc32(body, first)
    return _RECORD.pack(length, first, checksum) + body, checksum


def records(data: bytes, begin: RecordEnd) -> Iterator[tuple[bytes, RecordEnd]]:
    """Yield the records after `begin`, each with its end, up to the first damaged or unfinished one."""
    at, checksum = begin
    while at + _RECORD.size <= len(data):
        length, first, expected = _RECORD.unpack_from(data, at)
        start = at + _RECORD.size
        body = data[start : start + length]
        if not length or first != checksum ^ length or len(body) < length or zlib.crc32(body, first) != expected:
            return
        at, checksum = start + length, expected
        yield body, RecordEnd(at, checksum)


def is_torn(data: bytes, end: RecordEnd) -> bool:
    """Return whether the bytes after the last good record can be the beginning of an unfinished record."""
    left = len(data) - end.at
    if left < _RECORD.size:
        return True
    length, first, _ = _RECORD.unpack_from(data, end.at)
    return length > 0 and first == end.checksum ^ length and left < _RECORD.size + length


def write_whole(fd: int, data: bytes, begin: int) -> int:
    """Write all of `data` at the file's end, which is at `begin`, or nothing and raise an OSError; return the new end.

    The rest of a failed attempt is cut off. If that fails, the next record overwrites it, and readers ignore it.
    """
    end = begin + len(data)
    try:
        at = begin + os.pwrite(fd, data, begin)
        while at < end:  # the disk became full at `at`
            at += os.pwrite(fd, data[at - end :], at)
    except BaseException:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, begin)
        raise
    return end


class End(msgspec.Struct, frozen=True, gc=False):
    """The end of a segment: the number of its records, and the checksum of the last."""

    records: int = 0
    checksum: int = 0


class Segment:
    """The segment that takes commits, as a new file.

    Args:
        folder, catalog: the catalog's directory, and its SQLite file there.
        meta: the catalog's meta row.
        number: the segment's number. A file of that name is from a failed attempt, and is written over.
        before: the end of the segment before; any value if that is folded.
        begins: whether the catalog has no SQLite file before this segment is folded.
        synced: whether a power cut loses neither the segment nor a record that append() has written.

    Raises:
        OSError: the segment cannot be made; at most an empty file is left.
    """

    def __init__(
        self,
        folder: Folder,
        catalog: Path,
        meta: Meta,
        number: int,
        before: End,
        *,
        begins: bool = False,
        synced: bool = False,
    ) -> None:
        self.number = number
        self.name = f"{segment_prefix(catalog)}{number}"
        self._folder = folder
        place = (meta.id.encode(), meta.epoch, number)
        if begins:
            before = End(0, _checksum_of(meta.registrar))
        magic = _FIRST if begins else _MAGIC
        header = _HEADER.pack(magic, *place, before.records, before.checksum, 0)[: -_CHECKSUM.size]
        self._checksum = zlib.crc32(header)
        self._header = header + _CHECKSUM.pack(self._checksum)
        self._records = 0
        self._synced = synced
        self._is_in_doubt = False  # whether the disk may have a record that was refused
        self._file = folder.open(self.name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        self._fd = self._file.fileno()
        try:
            self._size = write_whole(self._fd, self._header, 0)
            if synced:  # the first record's fdatasync is that of the header, too
                os.fsync(folder.fd)
        except BaseException:
            self.remove()
            raise

    @property
    def end(self) -> End:
        """The segment's present end."""
        return End(self._records, self._checksum)

    def append(self, changes: Sequence[Change]) -> None:
        """Write changes as one record, or write nothing and raise an OSError or an error of JournaledStore.commit()."""
        body = _encode([(TABLE_OF[type(c.row)], c.row) if type(c) is Put else (c.table, c.id) for c in changes])
        if len(body) > _LONGEST:
            check_lengths(changes, _LONGEST)
        if _UINT64 in body and _TOO_LARGE.search(body):
            check_numbers(changes)
        data, checksum = record(body, self._checksum)
        self._size = self._write_synced(data) if self._synced else write_whole(self._fd, data, self._size)
        self._checksum = checksum
        self._records += 1

    def _write_synced(self, data: bytes) -> int:
        self.settle()
        self._is_in_doubt = True
        try:
            end = write_whole(self._fd, data, self._size)
            os.fdatasync(self._fd)
        except BaseException:
            with contextlib.suppress(OSError):
                self.settle()
            raise
        self._is_in_doubt = False
        return end

    def settle(self) -> None:
        """Cut off what a failed append() may have left on the disk; raise an OSError if the disk does not do it.

        After a failed fdatasync the kernel may take the pages for written. So the header, which no earlier fdatasync
        covered if there are no records, is written again.
        """
        if self._is_in_doubt:
            os.ftruncate(self._fd, self._size)
            if not self._records:
                write_whole(self._fd, self._header, 0)
            os.fdatasync(self._fd)
            self._is_in_doubt = False

    def remove(self) -> None:
        """Close the segment and remove its file. If that fails, the next opening ignores its changes and removes it."""
        self.close()
        self._folder.discard(self.name)

    def close(self) -> None:
        """Close the segment's descriptor. A second call does nothing."""
        self._fd = -1
        with contextlib.suppress(OSError):  # it is closed even so
            self._file.close()


class JournalFiles(msgspec.Struct, frozen=True):
    """The files of a catalog's journal.

    `contents`: each segment's bytes by its number, None if it is only begun. `bad`: what is wrong with a file that has
    a segment's name, but not a segment's beginning.
    """

    catalog: Path
    segments: dict[int, str]
    contents: dict[int, bytes | None]
    bad: dict[int, str]

    @property
    def last(self) -> int:
        """The highest number of a segment; 0 without segments."""
        return max((*self.contents, *self.bad), default=0)

    def first(self, registrars: Collection[str]) -> Meta | None:
        """Return the meta row of a catalog without an SQLite file, all of which is in its journal; None for another.

        Args:
            registrars: the names that its registrar can have; none: any.

        Raises:
            Damage: it is that of another registrar.
        """
        data = self.contents.get(1)
        if data is None or not data.startswith(_FIRST):
            return None
        _, id, epoch, _, _, checksum, _ = _HEADER.unpack_from(data)
        if registrars and checksum not in map(_checksum_of, ("", *registrars)):
            raise Damage("a journal that another registrar has begun")
        return Meta(id.rstrip(b"\0").decode(), epoch, 0)

    def epoch_after(self, folded: int) -> int:
        """Return the last opening that wrote a segment after segment `folded`; 0 if there is none."""
        later = (data for number, data in self.contents.items() if number > folded and data is not None)
        return max((_HEADER.unpack_from(data)[2] for data in later), default=0)

    def since(self, meta: Meta, begun: int = 0, *, settled: int = 0, until: int | None = None) -> Replay:
        """Return the changes after those in the tables, up to the first that is missing; log a warning about the rest.

        Args:
            meta: the meta row in the tables.
            begun: the last segment that is known to have been begun, even if its file is missing.
            settled: the last segment that is known to be in the SQLite file; that is gone if it is missing there.
            until: the last segment to read; None: all.

        Raises:
            Damage: a segment belongs to another catalog, or a record is not a catalog's.
        """
        found = Replay()
        before = meta.folded
        for number in sorted(self.bad):
            if number > meta.folded:
                raise Damage(self.bad[number])
            _log.warning("%s: %s; the SQLite file has all of it: nothing is lost", self.catalog, self.bad[number])
        for number in sorted(self.contents):
            data = self.contents[number]
            if number <= meta.folded or data is None or (until is not None and number > until):
                continue
            name = f"{segment_prefix(self.catalog)}{number}"
            # A segment of an earlier epoch would be folded. A later epoch is right if a power cut took the -wal.
            id_, epoch, _, *place = _HEADER.unpack_from(data)[1:6]
            if id_ != meta.id.encode().ljust(16, b"\0") or epoch < meta.epoch:
                raise Damage(f"{name}, which belongs to another catalog, or to an earlier state of this one")
            follows = End(*place) in ((End(),) if found.end is None else (found.end,))
            if not found.has_gap and not follows and (found.end is not None or number != meta.folded + 1):
                found.has_gap = True
                if before >= settled:
                    _tell_of_gap(self.catalog, before + 1)
            changes: list[Change] = []
            end, rest = _read_records(data, changes)
            if found.has_gap:
                found.ignored += changes
                continue
            found.changes += changes
            found.end, before = end, number
            if rest.at < len(data) and _tell_of_rest(self.catalog, name, data, rest):
                found.is_whole = False
                found.ignored += _behind(data, rest)
        if until is None and not found.has_gap and begun > before:
            found.has_gap = True
            if before >= settled:
                _tell_of_gap(self.catalog, before + 1)
        found.is_whole = found.is_whole and not found.has_gap
        if found.end is None and (data := self.contents.get(self.last)) is not None:
            found.end = _read_records(data, [])[0]
        return found


class Replay(msgspec.Struct):
    """What a journal has beside the tables.

    `changes`: to be applied. `ignored`: those that were found behind a gap or behind damage. `end`: of the last
    segment. `has_gap`: a segment is missing. `is_whole`: nothing is missing or damaged.
    """

    changes: list[Change] = []
    ignored: list[Change] = []
    end: End | None = None
    has_gap: bool = False
    is_whole: bool = True


def _tell_of_gap(catalog: Path, number: int) -> None:
    _log.warning(
        "%s: %s%s: missing, or not what was written next; it and what came later is ignored: what was committed since"
        " then is lost. A power cut may do that (with durability 'power' it does not), and so does a file that is"
        " removed, or put in another's place",
        catalog,
        segment_prefix(catalog),
        number,
    )


def _tell_of_rest(catalog: Path, name: str, data: bytes, end: RecordEnd) -> bool:
    """Log a warning about the bytes after the last good record; return whether commits are lost."""
    left, torn = len(data) - end.at, is_torn(data, end)
    if torn:
        text = (
            f"its last record is not whole ({left} bytes from byte {end.at} on), and ignored: its process died while it"
            " wrote it, and nobody heard that it was written; or the file was cut off there later"
        )
    else:
        text = (
            f"wrong from byte {end.at} on, and ignored from there: what was committed in these {left} bytes, and later,"
            " is lost. Compare it with a copy, and see whether the disk is good"
        )
    _log.warning("%s: %s: %s", catalog, name, text)
    return not torn


def _behind(data: bytes, end: RecordEnd) -> list[Change]:
    """Return what can still be read of a damaged record and of those after it, to say what is lost."""
    found: list[Change] = []
    length, first, _ = _RECORD.unpack_from(data, end.at)
    for size in {length, first ^ end.checksum}:  # one of the two is right
        start = end.at + _RECORD.size
        after = start + size
        if after + _RECORD.size > len(data) and after != len(data):
            continue
        with contextlib.suppress(Damage):
            found += decoded(data[start:after])
        if after < len(data):
            length, first, _ = _RECORD.unpack_from(data, after)
            for body, _ in records(data, RecordEnd(after, first ^ length)):
                found += decoded(body)
    return found


def read(folder: Folder, catalog: Path) -> JournalFiles:
    """Read the files of this catalog's journal; a segment that is removed during this is folded, and left out."""
    found = JournalFiles(catalog, {}, {}, {})
    for name in segments_among(folder.names(), catalog):
        try:
            data = folder.read(name)
        except FileNotFoundError:
            continue
        number = int(name.removeprefix(segment_prefix(catalog)))
        found.segments[number] = name
        try:
            found.contents[number] = _checked(name, number, data)
        except Damage as error:
            found.bad[number] = str(error)
    return found


def _checksum_of(registrar: str) -> int:
    return zlib.crc32(registrar.encode())


def _checked(name: str, number: int, data: bytes) -> bytes | None:
    """Check the header of a segment, and return the segment's bytes; None if the header was not written whole."""
    header = data[: _HEADER.size]
    magic = header[: len(_MAGIC)]
    if not any(header) or (len(header) < _HEADER.size and (_MAGIC.startswith(magic) or _FIRST.startswith(magic))):
        return None
    if len(header) < _HEADER.size or magic not in (_MAGIC, _FIRST):
        raise Damage(f"{name}, which is something else than a part of a catalog's journal")
    if _HEADER.unpack(header)[3] != number or zlib.crc32(header[: -_CHECKSUM.size]) != _HEADER.unpack(header)[-1]:
        raise Damage(f"{name}, whose beginning is damaged, or another file's")
    return data


def _read_records(data: bytes, changes: list[Change]) -> tuple[End, RecordEnd]:
    """Add the changes of a segment's whole records to `changes`; return the end and the place of the last."""
    checksum: int = _CHECKSUM.unpack_from(data, _HEADER.size - _CHECKSUM.size)[0]
    end = RecordEnd(_HEADER.size, checksum)
    count = 0
    for body, after in records(data, end):
        changes += decoded(body)
        count += 1
        end = after
    return End(count, end.checksum), end
