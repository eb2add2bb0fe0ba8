"""What is known of a stream: its name, its frames, and its readers as the console shows them."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, cast

import msgspec

from rr_actors.base.errors import InvalidName
from rr_actors.base.names import check_name
from rr_actors.base.values.codecs import NAMED, split_name
from rr_actors.base.values.fitting import Mark, read_tree

Keep = Literal["latest", "all"]

StreamHappening = Literal["stream_opened", "stream_rebound", "stream_closed"]
"""What may happen to a stream. "stream_rebound": a reader of another stream goes on with this one."""

Place = tuple[object, ...]
"""Where in a response something is: the names and numbers that lead to it."""

_ID = re.compile(r"[0-9a-f]{32}(\.\d+)?(\+\d+)?").fullmatch  # with the epoch of a provider that was respawned


class Stream(msgspec.Struct, frozen=True):
    """Names a stream: plain data that a response may contain.

    Attributes:
        resource_id: the resource that the stream belongs to.
        name: its name among the streams of the resource.
    """

    resource_id: str
    name: str


class StreamFrame(msgspec.Struct, frozen=True, eq=False):
    """One value of a stream, as a reader has got it.

    Attributes:
        value: what was published.
        number: from 1, without gaps at the publisher; from 1 again after a crash of the manager.
        published_at: when it was published, as time.time() says it.
        missed: how many frames the reader did not get since the one before.
        stream: the stream.
    """

    value: Any
    number: int
    published_at: float
    missed: int
    stream: Stream

    @property
    def age_s(self) -> float:
        """How long ago the frame was published."""
        return time.time() - self.published_at


class ReaderRow(msgspec.Struct, frozen=True):
    """A reader of a stream, as the publisher knows it.

    Attributes:
        registrar: the registrar that holds its query.
        pid: its process.
        keep: "latest" or "all".
        missed: how many frames it did not get since it came.
    """

    registrar: str
    pid: int
    keep: Keep
    missed: int


class StreamInfo(msgspec.Struct, frozen=True):
    """An open stream at one moment.

    Attributes:
        id: the resource's id, a slash, and the name.
        name: its name among the streams of the resource.
        server: the server of its resource, as "registrar/server".
        resource_id: its resource.
        rate_hz: how many frames were published a second, in the last ten seconds.
        bytes_per_s: how many bytes these had; those that nobody reads are not pickled, and have none.
        consumers: how many readers it has.
        missed: how many frames its readers missed, all together.
        age_s: how many seconds ago the last frame was published; None: there was none.
        best_hz: the highest rate of any ten seconds since it was opened; 0 before there were ten.
    """

    id: str
    name: str
    server: str
    resource_id: str
    rate_hz: float
    bytes_per_s: float
    consumers: int
    missed: int
    age_s: float | None
    best_hz: float = 0.0


class StreamRow(msgspec.Struct, frozen=True):
    """A stream, as the console shows it.

    Attributes:
        info: what programs see of it.
        request: that of its resource as JSON, cut if it is long.
        frames: how many were published since it was opened.
        readers: those who read it now.
        title: of the request; "" if it has none.
    """

    info: StreamInfo
    request: str
    frames: int
    readers: list[ReaderRow]
    title: str = ""


Tell = Callable[[StreamHappening, Stream, str, Stream | None], None]
"""A function that hears what has happened to a stream. If it was rebound: which registrar read which stream before."""


def streams_in(response: bytes) -> list[tuple[Place, Stream]]:
    """Return the streams that the canonical bytes of a response name, each with its place there."""
    try:
        return list(_streams_below(read_tree(response), ()))
    except Exception:  # the bytes may come from anywhere, and nothing more than names is wanted
        return []


def _streams_below(part: object, place: Place) -> Iterator[tuple[Place, Stream]]:
    name = ""
    if isinstance(part, Mark):
        name, body = split_name(part.data) if part.code == NAMED else ("", b"")
        part = read_tree(body) if body else None
    parts: dict[Any, object] = {}
    if isinstance(part, dict):
        parts = cast("dict[Any, object]", part)
        if name in ("", Stream.__name__) and (found := _stream_of(parts)) is not None:  # plain data has no class
            yield place, found
            return
    elif isinstance(part, list | tuple):
        parts = dict(enumerate(cast("list[object]", part)))
    for key, below in parts.items():
        yield from _streams_below(below, (*place, key))


def _stream_of(plain: dict[Any, object]) -> Stream | None:
    resource_id, name = plain.get("resource_id"), plain.get("name")
    if len(plain) != 2 or not isinstance(resource_id, str) or not _ID(resource_id):
        return None
    try:
        return Stream(resource_id, check_name(name, "stream"))
    except InvalidName:
        return None
