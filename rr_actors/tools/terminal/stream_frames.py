"""The frames of a stream for those who look from outside: read beside its consumers, and drawn as pictures."""

from __future__ import annotations

import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rr_actors.base.errors import RrError, Unavailable, text_of
from rr_actors.streams.stream import Stream, StreamFrame
from rr_actors.streams.stream_reader import Source, StreamReader
from rr_actors.streams.wake import Wake

_READER = "rr-actors"
_COLOURS = {1: 0, 3: 2, 4: 6}
"""The PNG colour types: grey, red-green-blue, and these with a transparency, by the bytes of a pixel."""
_SIDE = 240  # of a small picture, in pixels
_WAIT_S = 1.0  # for a frame of which a small picture is drawn
_FRESH_S = 0.4
_KEPT = 50  # small pictures


def frames_of(stream: Stream, is_over: Callable[[], bool], timeout_s: float) -> Iterator[StreamFrame]:
    """Yield the newest frames, until it is over.

    Raises:
        Unavailable: no frame came in time.
        RrError: a frame cannot be read here.
    """
    source = Source(stream.resource_id, _READER, is_over, list, _unwatched, _unwatched, lambda: False)
    with StreamReader(source, stream.name, "latest", 1, timeout_s) as reader:
        while True:
            try:
                frame = next(reader, None)
            except TimeoutError as error:
                raise Unavailable(str(error)) from error
            except RrError:
                raise
            except Exception as error:  # of the value's own code
                what = f"stream {stream.name!r}: a frame cannot be read here: {text_of(error)}"
                raise Unavailable(f"{what}; its classes must be importable: set PYTHONPATH, say") from error
            if frame is None:
                return
            yield frame


def _unwatched(wake: Wake) -> None:
    """Do nothing: no status comes here."""


def png(value: Any, side: int = 0) -> bytes:
    """Return the PNG of a picture: height by width bytes of grey, or height by width by 3 or 4 of colour.

    Args:
        side: the most pixels of a side; of more, each second is left out, or two of three, and so on. 0: no limit.

    Raises:
        TypeError, ValueError: the value is no picture.
    """
    view = memoryview(value)
    shape = (*(view.shape or ()), 1) if view.ndim == 2 else view.shape or ()
    if view.format not in ("B", "<B") or len(shape) != 3 or shape[2] not in _COLOURS or not all(shape):
        raise ValueError("a picture is an array of unsigned bytes, height by width, or height by width by 3 or 4")
    height, width, depth = shape
    data = view.cast("B") if view.c_contiguous and view.format == "B" else memoryview(view.tobytes())
    row, step = width * depth, -(-max(height, width) // side) if side else 1
    lines = [_thinned(data[at : at + row], depth, step) for at in range(0, height * row, row * step)]
    head = struct.pack(">IIBBBBB", len(lines[0]) // depth, len(lines), 8, _COLOURS[depth], 0, 0, 0)
    packed = zlib.compress(b"".join(b"\0" + line for line in lines), 6)
    chunks = ((b"IHDR", head), (b"IDAT", packed), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def _thinned(line: memoryview, depth: int, step: int) -> bytes:
    """Return each `step`-th pixel of a line."""
    if step == 1:
        return line.tobytes()
    thin = bytearray(-(-len(line) // (depth * step)) * depth)
    for channel in range(depth):
        thin[channel::depth] = line[channel :: depth * step]
    return bytes(thin)


class _Picture(NamedTuple):
    png: bytes
    due: float  # when the next is read


class Thumbnails:
    """Small pictures of the newest frames of streams. Any thread may ask; a stream is read while somebody does."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pictures: dict[Stream, _Picture] = {}  # oldest first

    def newest(self, stream: Stream) -> bytes:
        """Return a PNG of at most 240 by 240 pixels; b"" if there is no frame, or the frames are no pictures.

        It is read at most every 0.4 seconds, by one thread at a time: others get the one before.
        """
        with self._lock:
            known, now = self._pictures.pop(stream, _Picture(b"", 0.0)), time.monotonic()
            is_due = now >= known.due
            self._pictures[stream] = known._replace(due=now + _WAIT_S + _FRESH_S) if is_due else known
            if len(self._pictures) > _KEPT:
                del self._pictures[next(iter(self._pictures))]
        if not is_due:
            return known.png
        found = self._read(stream, known.png)
        with self._lock:
            self._pictures[stream] = _Picture(found, time.monotonic() + _FRESH_S)
        return found

    def _read(self, stream: Stream, before: bytes) -> bytes:
        try:
            frame = next(frames_of(stream, lambda: False, _WAIT_S))
        except RrError:  # there is none now, or it cannot be read here
            return before
        try:
            return png(frame.value, _SIDE)
        except (TypeError, ValueError):
            return b""
