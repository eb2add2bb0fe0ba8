"""A recorded stream: one file with the frames of a stream and their times.

The file begins with a line that names the format, and a header that says what was recorded. Each frame has a head of
fixed length, a pickle, and the buffers that the pickle leaves out, such as the memory of numpy's arrays. A buffer
begins at a multiple of 64 bytes, so that an array that is read lies in the file's own pages and is not copied.

A frame is written by one call. If the writer is killed, or its disk is full, the frames before are whole, and a reader
ends with the last of them.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.base import pickling
from rr_actors.base.checks import path_text
from rr_actors.base.errors import ConfigError, UsageError, shown, text_of
from rr_actors.base.folder import open_plain
from rr_actors.base.values.canonical import shown_plain
from rr_actors.streams.stream import Stream, StreamFrame

_FORMAT = b"rr_actors stream 1\n"
_SIZE = struct.Struct("<II")  # of the header: its length and checksum
_HEAD = struct.Struct("<4sIQdIIQ")  # mark, checksum, number, published at, missed, count of buffers, length of pickle
_MARK = b"RRfr"
_LENGTH = struct.Struct("<Q")
_ALIGNED = 64
_LARGE_BYTES = 4096  # a shorter buffer is copied sooner than it is aligned
_MOST_AT_ONCE = 512  # parts of one call of writev, which takes 1,024
_MOST_HEADER = 2**24
_WANTED = "the file of a recorded stream"


class StreamHeader(msgspec.Struct, frozen=True):
    """What a file says of its stream.

    Attributes:
        name: the stream's.
        resource_id: the resource that the stream belonged to.
        server: the server that its holder had loaded, "registrar/server".
        request, response: of that resource, as canonical bytes; None: not known.
        began_at: when the recording began, as time.time() says it.
    """

    name: str
    resource_id: str
    server: str
    request: bytes | None
    response: bytes | None
    began_at: float


class StreamWriter:
    """Writes the file. One thread at a time.

    Attributes:
        size_bytes: of the file.
    """

    def __init__(self, file: str | os.PathLike[str], header: StreamHeader, limit_bytes: int) -> None:
        """Make the file, readable for its user alone.

        Raises:
            ConfigError: it exists already, or cannot be created. `.file`
            UsageError: `limit_bytes` is no whole number above 0.
        """
        if type(limit_bytes) is not int or limit_bytes <= 0:
            raise UsageError(f"limit_bytes: expected a whole number of bytes above 0, got {shown(limit_bytes)}")
        self._limit_bytes = limit_bytes
        self._what = f"a frame of stream {header.name!r}"
        path = _path(file)
        try:
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise _wrong(path, "a new file", text_of(error)) from error
        self.size_bytes = 0
        body = msgspec.msgpack.encode(header)
        try:
            self._write([_FORMAT, _SIZE.pack(len(body), zlib.crc32(body)), body])
        except OSError as error:
            self.close()
            raise _wrong(path, "a file that can be written", text_of(error)) from error

    def write(self, frame: StreamFrame, missed: int = 0) -> bool:
        """Write a frame. Return whether there was room for it within the limit.

        Args:
            missed: how many frames are missing before it, besides those that the frame itself says.

        Raises:
            OSError: the disk has no room, or fails. The file ends with the frame before.
            NotSerializable: a part of the value cannot be pickled.
        """
        packed = pickling.dumps_large(frame.value, self._what, _LARGE_BYTES)
        parts, buffers = ([packed], ()) if isinstance(packed, bytes) else (packed.parts, packed.buffers)
        lengths = b"".join(_LENGTH.pack(len(buffer)) for buffer in buffers)
        size = sum(map(len, parts))
        facts = (frame.number, frame.published_at, min(frame.missed + missed, 2**32 - 1), len(buffers), size)
        check = zlib.crc32(_HEAD.pack(b"", 0, *facts) + lengths)
        for part in parts:
            check = zlib.crc32(part, check)
        views: list[bytes | memoryview] = [_HEAD.pack(_MARK, check, *facts), lengths, *map(memoryview, parts)]
        at = self.size_bytes + _HEAD.size + len(lengths) + size
        for buffer in buffers:
            views += [bytes(-at % _ALIGNED), buffer]
            at += -at % _ALIGNED + len(buffer)
        if at > self._limit_bytes:
            return False
        self._write(views)
        return True

    def _write(self, views: Sequence[bytes | memoryview]) -> None:
        """Write all of it, or nothing."""
        left = [memoryview(view).cast("B") for view in views if len(view)]
        size = sum(map(len, left))
        try:
            while left:
                written = os.writev(self._fd, left[:_MOST_AT_ONCE])
                while left and written >= len(left[0]):
                    written -= len(left.pop(0))
                if written:
                    left[0] = left[0][written:]
        except OSError:
            os.ftruncate(self._fd, self.size_bytes)
            os.lseek(self._fd, self.size_bytes, os.SEEK_SET)
            raise
        self.size_bytes += size

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


class RecordedStream:
    """A recorded stream, which is read from its file. Iterate over it for its frames, as often as you like.

    To read a frame is to open a pickle, which may run code of the file's writer. Numpy's arrays lie in the file's
    pages, so they are read-only. Do not shorten the file while it is read.

    Attributes:
        file: its path.
        name: the stream's.
        server: the server that had been loaded, "registrar/server".
        request, response: of that, as plain data; None: not known.
        resource_id: the resource that the stream belonged to.
        began_at: when the recording began, as time.time() says it.
        frames: how many whole frames the file has.
        missed: how many frames are missing before them, and between them.
        duration_s: from the first frame to the last.
        is_cut: whether something follows that is no whole frame: the writer was killed, or writes it now.
    """

    file: Path
    name: str
    server: str
    request: Any
    response: Any
    resource_id: str
    began_at: float
    frames: int
    missed: int
    is_cut: bool

    def __init__(self, file: str | os.PathLike[str]) -> None:
        """Read what the file has, without the values.

        Raises:
            ConfigError: it cannot be read, or is no recorded stream. `.file`
        """
        self.file = path = _path(file)
        try:
            with open_plain(path) as opened:
                self._data: Any = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:  # an empty file has no pages
            raise _wrong(path, _WANTED, text_of(error)) from error
        self._view = memoryview(self._data)
        header, at = self._read_header(path)
        self._header = header
        self.name, self.server, self.resource_id = header.name, header.server, header.resource_id
        self.began_at = header.began_at
        self.request = None if header.request is None else shown_plain(header.request)
        self.response = None if header.response is None else shown_plain(header.response)
        self._places: list[_Place] = []
        while (place := self._place_at(at)) is not None:
            self._places.append(place)
            at = place.end
        self.is_cut = at < len(self._view)
        self.frames, self.missed = len(self._places), sum(place.missed for place in self._places)

    @property
    def times(self) -> list[float]:
        """When each frame was published, as time.time() says it."""
        return [place.published_at for place in self._places]

    @property
    def duration_s(self) -> float:
        """From the first frame to the last, in seconds."""
        return max(0.0, self.times[-1] - self.times[0]) if self._places else 0.0

    def __len__(self) -> int:
        return self.frames

    def __iter__(self) -> Iterator[StreamFrame]:
        """Yield the frames.

        Raises:
            Exception: a value's own code has raised it, or its class cannot be imported here.
        """
        return (self.frame(i) for i in range(self.frames))

    def frame(self, index: int) -> StreamFrame:
        """Return one frame; 0 is the first. Raises the errors of a loop, and IndexError."""
        place = self._places[index]
        pickle = self._view[place.pickle : place.pickle + place.size]
        buffers = [self._view[at : at + length] for at, length in place.buffers]
        value = pickling.loads_large(pickle, buffers) if buffers else pickling.loads(bytes(pickle))
        return StreamFrame(value, place.number, place.published_at, place.missed, Stream(self.resource_id, self.name))

    def _read_header(self, path: Path) -> tuple[StreamHeader, int]:
        at = len(_FORMAT) + _SIZE.size
        if bytes(self._view[: len(_FORMAT)]) != _FORMAT or len(self._view) < at:
            raise _wrong(path, _WANTED, f"what begins with {shown(bytes(self._view[:20]))}")
        length, check = _SIZE.unpack_from(self._view, len(_FORMAT))
        body = bytes(self._view[at : at + min(length, _MOST_HEADER)])
        if len(body) != length or zlib.crc32(body) != check:
            raise _wrong(path, _WANTED, "one whose header is damaged")
        try:
            return msgspec.msgpack.decode(body, type=StreamHeader), at + length
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise _wrong(path, _WANTED, f"one with another header: {error}") from error

    def _place_at(self, at: int) -> _Place | None:
        """Return where the parts of the frame are that begins here; None: there is no whole one."""
        end = len(self._view)
        if at + _HEAD.size > end:
            return None
        mark, check, *facts = _HEAD.unpack_from(self._view, at)
        number, published_at, missed, count, size = facts
        pickle = at + _HEAD.size + count * _LENGTH.size
        if mark != _MARK or pickle + size > end:
            return None
        lengths = self._view[at + _HEAD.size : pickle]
        found = zlib.crc32(self._view[pickle : pickle + size], zlib.crc32(_HEAD.pack(b"", 0, *facts) + lengths))
        if found != check:
            return None
        buffers: list[tuple[int, int]] = []
        at = pickle + size
        for (length,) in _LENGTH.iter_unpack(lengths):
            at += -at % _ALIGNED
            buffers.append((at, length))
            at += length
        return _Place(number, published_at, missed, pickle, size, tuple(buffers), at) if at <= end else None


def header_of(recorded: RecordedStream) -> StreamHeader:
    """Return what a file says of its stream, as it is there."""
    return recorded._header  # pyright: ignore[reportPrivateUsage]  # same file


class _Place(msgspec.Struct, frozen=True):
    """Where the parts of a frame are in its file."""

    number: int
    published_at: float
    missed: int
    pickle: int
    size: int
    buffers: tuple[tuple[int, int], ...]
    end: int


def _path(given: object) -> Path:
    if not (text := path_text(given)):
        raise _wrong(None, _WANTED, shown(given))
    return Path(text).absolute()


def _wrong(file: Path | None, expected: str, got: str) -> ConfigError:
    said = f"expected {expected}, got {got}"
    where = str(file) if file is not None else "file"
    return ConfigError(f"{where}: {said}", file=str(file) if file else None, key="", expected=expected, got=got)
