"""Publishers: the open streams of one registrar's resources."""

from __future__ import annotations

import asyncio
import threading

from rr_actors.base.errors import NameTaken
from rr_actors.base.names import check_name
from rr_actors.base.reporting.log import Log
from rr_actors.streams.publisher import Publisher
from rr_actors.streams.stream import Stream, Tell
from rr_actors.streams.stream_sockets import IN_BAND_BYTES, OPENED, OPENED_ONCE
from rr_actors.wire.segments import Segments

logger = Log("rr_actors")

ADVICE = "recovery='keep' and no recover callback; give it one, or recovery='reload'"


class Publishers:
    """The open streams of one registrar's resources. From any thread.

    Attributes:
        streams: the streams, by the ids of their resources and their names.

    Args:
        loop: gives the memory of frames that nobody has any more back to the machine.
    """

    def __init__(self, segments_limit_bytes: int | None, loop: asyncio.AbstractEventLoop) -> None:
        self._segments = Segments(segments_limit_bytes, IN_BAND_BYTES)
        self._segments.loop = loop
        self._lock = threading.Lock()
        self._warned: set[str] = set()
        self.streams: dict[str, dict[str, Publisher]] = {}

    def open(self, resource_id: str, name: object, once: str = "") -> Publisher:
        """Open a stream of a resource.

        Args:
            once: the server, if none of its callbacks opens the stream again after a crash.

        Raises:
            InvalidName: `name` is none.
            NameTaken: the resource has such a stream.
        """
        stream = Stream(resource_id, check_name(name, "stream"))
        with self._lock:
            streams = self.streams.setdefault(resource_id, {})
            if stream.name in streams:
                raise NameTaken(f"resource {resource_id} has a stream {stream.name!r} already", name=stream.name)
            publisher = streams[stream.name] = Publisher(stream, self._segments, OPENED_ONCE if once else OPENED)
        if once and once not in self._warned:
            self._warned.add(once)
            logger.warning(
                "stream %r: after a crash of its manager nobody opens it again: %s has %s", name, once, ADVICE
            )
        return publisher

    def let_in(self, resource_id: str, tell: Tell) -> None:
        """Let readers in to the streams of a resource: the callback that opens them has returned."""
        with self._lock:
            publishers = list(self.streams.get(resource_id, {}).values())
        for publisher in publishers:
            publisher.let_in(tell)

    def all(self) -> list[Publisher]:
        """Return the open streams."""
        with self._lock:
            return [publisher for streams in self.streams.values() for publisher in streams.values()]

    def close(self, resource_id: str) -> None:
        """Close the streams of a resource that is gone."""
        if self.streams:
            with self._lock:
                streams = self.streams.pop(resource_id, {})
            for publisher in streams.values():
                publisher.close()

    def close_all(self) -> None:
        """Close all streams: the registrar is closed."""
        for resource_id in list(self.streams):
            self.close(resource_id)
