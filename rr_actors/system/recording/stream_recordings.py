"""Recordings of streams: a thread reads a stream as one reader more, and writes its frames into a file."""

from __future__ import annotations

import os
import threading
import time
from typing import Any, Self

from rr_actors.base.errors import RrError, UsageError, is_a, shown, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.queries import Query, response_bytes
from rr_actors.streams.stream import Keep, Stream
from rr_actors.streams.stream_file import RecordedStream, StreamHeader, StreamWriter
from rr_actors.streams.stream_reader import stream_of

logger = Log("rr_actors")

LIMIT_BYTES = 2**30
"""The default limit of a file."""


class StreamRecording:
    """A stream that is being recorded. Use it as a context manager, or call stop(). Any thread may.

    It ends by itself when the query is released or the resource is lost, and when the file or the disk is full.

    Attributes:
        frames: how many are in the file.
        missed: how many are not, as far as the reader knows.
        size_bytes: of the file.
        why: why it has ended by itself: "the query is released", "the file has reached its limit of ...", or an error;
            "": it goes on, or stop() has ended it.
    """

    frames: int
    missed: int
    why: str

    def __init__(
        self, query: Query[Any], file: str | os.PathLike[str], name: str | Stream | None, keep: Keep, limit_bytes: int
    ) -> None:
        if not is_a(query, Query):
            raise UsageError(f"record_stream: query: expected a Query, got {shown(query)}")
        self.frames = self.missed = 0
        self.why = ""
        self._is_stopped = False
        self._reader = query.stream(name, keep=keep)
        try:
            stream = stream_of(self._reader) or Stream(query.resource_id, name if isinstance(name, str) else "stream")
            self._what = f"the recording of stream {stream.name!r}"
            header = StreamHeader(
                stream.name,
                stream.resource_id,
                query.server_id,
                encode(query.request),
                response_bytes(query),
                time.time(),
            )
            self._file = StreamWriter(file, header, limit_bytes)
        except BaseException:
            self._reader.close()
            raise
        self._limit_bytes = limit_bytes
        self._thread = threading.Thread(target=self._run, name="rr-stream-recording", daemon=True)
        self._thread.start()

    @property
    def size_bytes(self) -> int:
        """The size of the file."""
        return self._file.size_bytes

    def stop(self) -> None:
        """End the recording; return when the file is closed. A second call does nothing."""
        self._is_stopped = True
        self._reader.close()
        self._thread.join()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Return when the recording has ended by itself, or False after `timeout_s` seconds."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        try:
            why = self._write_all()
        except (RrError, OSError) as error:
            why = text_of(error)
            if not self._is_stopped:
                logger.warning("%s ends: %s", self._what, why)
        finally:
            self._file.close()
            self._reader.close()
        self.why = "" if self._is_stopped else why

    def _write_all(self) -> str:
        """Write frame after frame, and return why there are no more."""
        unread = 0  # frames whose values cannot be read here
        while True:
            try:
                frame = next(self._reader, None)
                if frame is None:
                    return "the query is released"
            except RrError:
                raise
            except Exception as error:  # of the value's own code; the next frame may be well
                unread += 1
                self.missed += 1
                if unread == 1:
                    logger.warning("%s misses frames: %s", self._what, text_of(error))
                continue
            if not self._file.write(frame, unread):
                return f"the file has reached its limit of {self._limit_bytes} bytes"
            self.frames += 1
            self.missed += frame.missed
            unread = 0


def record_stream(
    query: Query[Any],
    file: str | os.PathLike[str],
    name: str | Stream | None = None,
    *,
    keep: Keep = "latest",
    limit_bytes: int = LIMIT_BYTES,
) -> StreamRecording:
    """Begin to record a stream of a resource that is held, into a new file.

    The file has the frames with their times, and the resource's request and response. A recorder that is killed leaves
    a file that can be read to the last whole frame.

    Args:
        query: holds the resource. The recording ends when it is released.
        file: a new file. What it contains are pickles: only open files of people whom you trust.
        name: of the stream, as for Query.stream().
        keep: "latest": the publisher never waits, and frames that the disk is too slow for are missed and counted.
            "all": the publisher waits for the disk.
        limit_bytes: the most that the file may have. Then the recording ends.

    Raises:
        ConfigError: the file exists already, or cannot be created.
        NotFound, UnknownQuery, UsageError: as for Query.stream(); or `limit_bytes` is no whole number above 0.
    """
    return StreamRecording(query, file, name, keep, limit_bytes)


def read_stream(file: str | os.PathLike[str]) -> RecordedStream:
    """Read a file that record_stream() has written, also while it is being written, or if its writer was killed.

    The values of its frames are read when you iterate. Their pickles may run code: only open files of people whom you
    trust.

    Raises:
        ConfigError: the file cannot be read, or is no recorded stream.
    """
    return RecordedStream(file)
