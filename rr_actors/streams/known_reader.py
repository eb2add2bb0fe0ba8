"""KnownReader: what a publisher sends to one reader, and when, and how long what the reader has is in use."""

from __future__ import annotations

import errno
import select
from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol

import msgspec

from rr_actors.base import pickling
from rr_actors.streams.stream import Keep, ReaderRow, Stream
from rr_actors.streams.stream_sockets import (
    AWAY,
    IN_BAND_BYTES,
    LOOK,
    MOST_DEPTH,
    NOTHING_NEWER,
    WISH,
    Packet,
    hello_of,
)
from rr_actors.wire.segments import Parcel, can_open

_ASKED_BYTES = 4096  # a reader sends less at once


class Connected(Protocol):
    """The publisher's end of a reader's connection. It does not block."""

    def recv(self, size: int, /) -> bytes: ...

    def send(self, packet: bytes, /) -> int: ...

    def has_unread(self) -> bool: ...

    def end(self) -> None: ...

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class PollSet(Protocol):
    """Tells the publisher's thread of what happens to sockets."""

    def register(self, connected: Connected, events: int, /) -> None: ...

    def modify(self, connected: Connected, events: int, /) -> None: ...


class Shared(Protocol):
    """Lets others have a value that is in shared memory."""

    def may_share(self, holder: object, most_bytes: int) -> bool: ...

    def share(self, parcel: Parcel, holder: object, most_bytes: int) -> Parcel | None: ...

    def discard(self, parcel: Parcel) -> None: ...

    def take_back(self, holder: object) -> None: ...


class PublishedFrame(NamedTuple):
    """What is published. `body`: the value for all readers that can open segments; b"": there is no memory for it."""

    number: int
    published_at: float
    value: bytes | pickling.Large
    body: bytes | Parcel
    most_bytes: int  # that a reader may keep
    why: str = ""  # there is no memory


Readiness = Literal["ready", "behind", "keeps"]
"""Whether a reader of all frames can be given one: it has too much to read ("behind"), or keeps too much ("keeps")."""


class KnownReader:
    """A reader, as its publisher knows it. One thread at a time calls its methods, except row().

    Args:
        pid: its process.
        rebound: hears of the registrar whose reader goes on with this stream, and of the stream before.
        greeting: what it is sent when it has come.

    Attributes:
        wanted: how many frames it can take.
        left: it reads no more, but may still have values.
        stuck: it did not read in time, and has said nothing since.
        keeps_since: when it was first found to keep too much; None: it has said something since, or got a frame.
    """

    def __init__(
        self,
        connected: Connected,
        pid: int,
        parcels: Shared,
        ready: PollSet,
        rebound: Callable[[str, Stream], None],
        greeting: Packet | None = None,
    ) -> None:
        self._rebound = rebound
        self._greeting = greeting
        self.keep: Keep | None = None  # until its hello has arrived
        self.wanted = 0
        self.left = self.stuck = False
        self.keeps_since: float | None = None
        self._is_away = False  # it will look what there is
        self._depth = 1
        self._registrar = ""
        self._offered = self._sent = 0  # frames
        self._socket = connected
        self._pid = pid
        self._shares = can_open(pid)
        self._parcels = parcels
        self._last = 0
        self._waiting: Packet | None = None  # the newest frame, for when it wants one
        self._noted = ""
        self._ready = ready
        self._hears = True
        ready.register(connected, select.EPOLLIN | select.EPOLLRDHUP)

    def hear(self, hears: bool) -> None:
        """Have the publisher's thread told what it sends, or only that it ends."""
        if hears != self._hears and not self.left:
            self._hears = hears
            self._ready.modify(self._socket, select.EPOLLRDHUP | (select.EPOLLIN if hears else 0))

    def receive(self) -> None:
        """Read what it has sent, and send the frame that waits for it."""
        self._read()
        self._send()
        self.hear(self.keep != "latest" or self._waiting is not None or self._is_away)  # "all": it may send many bytes

    def _read(self) -> None:
        try:
            while not self.left:
                raw = self._socket.recv(_ASKED_BYTES)
                if not raw:
                    self.leave()
                elif self.keep is None:
                    self._meet(raw)
                else:
                    self._ask(raw)
        except BlockingIOError:
            return
        except (OSError, msgspec.MsgspecError):
            self.leave()

    def _meet(self, raw: bytes) -> None:
        hello = hello_of(raw)
        if hello.keep == "all":
            self._depth = self.wanted = max(1, min(hello.depth, MOST_DEPTH))
        self._registrar = hello.registrar
        self.keep = hello.keep
        if hello.before is not None:
            self._rebound(hello.registrar, hello.before)
        if self._greeting is not None:
            self._socket.send(msgspec.msgpack.encode(self._greeting))

    def _ask(self, raw: bytes) -> None:
        self.stuck, self.keeps_since = False, None
        self._is_away = self._is_away or AWAY in raw
        looks = LOOK in raw
        self.wanted = min(self._depth, self.wanted + raw.count(WISH) + looks)
        if looks:
            self._is_away = False
            if self._waiting is None:
                self.wanted = 0
                self._socket.send(msgspec.msgpack.encode(Packet(0, 0.0, b"", NOTHING_NEWER)))

    def give(self, frame: PublishedFrame) -> bool:
        """Give it a frame in place of one that it has not wanted yet; return whether it gets it."""
        self._read()
        self._offered += 1
        if self.left or frame.number < self._last:  # of another thread, which was later
            self._send()  # it may want the one that waits, as has just been read
            return False
        body = self._body_of(frame)
        if isinstance(body, str):
            self._send()
            self._note(body)
            return False
        self._drop()
        self._last, self._waiting = frame.number, Packet(frame.number, frame.published_at, body)
        if not self._send() or self._is_away:
            self.hear(True)
        return not self.left

    def _body_of(self, frame: PublishedFrame) -> bytes | Parcel | str:
        """Return what its packet carries; or why it cannot have this frame."""
        if self._shares or isinstance(frame.value, bytes):
            if isinstance(frame.body, bytes):
                return frame.body or frame.why
            try:
                shared = self._parcels.share(frame.body, self, frame.most_bytes)
            except OSError:
                return "the stream is closed"
            return shared or f"it keeps frames of more than {frame.most_bytes} bytes, its part of segments_limit_bytes"
        whole = frame.value.whole()
        if len(whole) <= IN_BAND_BYTES:
            return whole
        return f"its process cannot open the shared memory, and a frame of {len(whole)} bytes is too long for a socket"

    def readiness(self, frame: PublishedFrame) -> Readiness:
        """Return whether the frame would be sent at once; if not, the publisher's thread hears when it would."""
        if not self.wanted:
            self.receive()
        if not self.wanted or self._waiting is not None:
            return "behind"
        if self._shares and isinstance(frame.body, Parcel) and not self._parcels.may_share(self, frame.most_bytes):
            return "behind" if self._socket.has_unread() else "keeps"
        return "ready"

    def has_unread(self) -> bool:
        """Return whether it has still to read a frame, whose memory may be free then."""
        return not self.left and self._socket.has_unread()

    def _send(self) -> bool:
        """Return whether the frame that waits is sent."""
        if self._waiting is None or not self.wanted:
            return False
        try:
            self._socket.send(msgspec.msgpack.encode(self._waiting))
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno != errno.EMSGSIZE:  # it may have ended
                self.give_up()
                return False
            self._drop()
            self._note(f"frames are too long for a socket here: {error}")
            return False
        self._waiting = None
        self._noted = ""
        self.wanted -= 1
        self._sent += 1
        return True

    def _note(self, why: str) -> None:
        """Tell it why it misses frames, once until it gets one."""
        if why and why != self._noted:
            self._noted = why
            try:
                self._socket.send(msgspec.msgpack.encode(Packet(0, 0.0, b"", why)))
            except BlockingIOError:
                pass
            except OSError:
                self.give_up()

    def miss(self) -> None:
        """Count a frame for which it was too far behind."""
        self._offered += 1

    def row(self) -> ReaderRow:
        """Return what is seen of it from outside. From any thread, without a lock: it may be one frame late."""
        missed = self._offered - self._sent - (self._waiting is not None)
        return ReaderRow(self._registrar, self._pid, self.keep or "latest", max(0, missed))

    def _drop(self) -> None:
        if self._waiting is not None and isinstance(self._waiting.body, Parcel):
            self._parcels.discard(self._waiting.body)
        self._waiting = None

    def leave(self) -> None:
        """Note that it reads no more. What it has stays in use until its end."""
        if not self.left:
            self.left = True
            self._drop()
            self._ready.modify(self._socket, 0)  # its end is heard all the same

    def give_up(self) -> None:
        """Send no more, and have it connect again."""
        self.leave()
        self._socket.end()

    def close(self) -> None:
        """Free all that it has: it has ended."""
        self.leave()
        self._socket.close()
        self._parcels.take_back(self)

    def close_in_child(self) -> None:
        """Close its connection in a child of fork."""
        self._socket.close()
