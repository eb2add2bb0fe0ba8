"""PublisherLink: a reader's connection to a publisher, and the frames that arrive on it.

A signal handler may raise between any two steps of the main thread. So a packet stays in the inbox until the reader has
set `is_taken`, just before it returns the frame. What follows from that is done by the next call.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections import deque
from typing import cast

import msgspec

from rr_actors.base import pickling
from rr_actors.base.errors import Unavailable, text_of
from rr_actors.base.scarcity import wanted_by
from rr_actors.streams.stream import Stream, StreamFrame
from rr_actors.streams.stream_sockets import (
    AWAY,
    LOOK,
    NOTHING_NEWER,
    OPENED,
    OPENED_ONCE,
    PACKET_BYTES,
    WISH,
    Hello,
    Packet,
    address_of,
    close_in_children,
    packet_of,
    pid_of,
)
from rr_actors.wire.segments import Lie, Parcel, Segments
from rr_actors.wire.shared_values import Claim

_ENDS_S = 0.5  # the longest time from when a process ends to the end of its connections
_NEWER_S = 0.1  # the longest wait for the publisher's answer whether there is a newer frame


class Line:
    """A socket that stays open as long as somebody has this object: the reader, or a value of its."""

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        close_in_children(self)

    def __del__(self) -> None:
        self.socket.close()

    def close_in_child(self) -> None:
        """Close it in a child of fork."""
        self.socket.close()


class PublisherLink:
    """A reader's connection to a publisher. One thread at a time calls its methods.

    Args:
        last, opened_at: those of the connection before.

    Attributes:
        pid: the publisher's process.
        is_taken: whether the frame that take() has returned is the caller's, and not to be returned again.
        claim: on the value of the first packet in the inbox. The value has it, too.
        last: the number of the last frame that was taken; None: there was none of this stream.
        opened_at: when the last publisher that was heard opened the stream, which tells two apart; 0: there was none.
        is_open: whether the publisher is there.
        opened_once: nobody opens the stream again if the publisher ends.
        note: why frames are missed, as the publisher says; "": they are not.

    Raises:
        OSError: there is no publisher, or it runs as another user, or has no room now.
    """

    def __init__(self, stream: Stream, hello: Hello, last: int | None, opened_at: float) -> None:
        self._stream = stream
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._line = Line(connected)
        connected.connect(address_of(stream))
        self.pid = pid_of(connected)
        connected.send(msgspec.msgpack.encode(hello))
        self._latest = hello.keep == "latest"
        self._parcels = Segments(0).parcels(self.pid)
        self._inbox: deque[bytes] = deque()
        self.claim: Claim | None = None
        self._offered_to = 0  # the thread that take() has given the first frame to
        self._number = 0  # of that frame
        self.is_taken = False
        self.last = last
        self.opened_at = opened_at
        self._owed = 1 if self._latest else 0  # frames that it has not said that it can take
        self._is_asked = False  # it has said so, and has got none since
        self._is_away = False  # the publisher knows that nobody waits
        self._may_be_old = False  # what is there: it has arrived before this call began
        self._looks_until: float | None = None
        self.is_open = True
        self.opened_once = False
        self.note = ""

    def fileno(self) -> int:
        """Return the descriptor that can be read when something has arrived."""
        return self._line.socket.fileno()

    def ask(self) -> None:
        """Say that it can take as many frames more as it has taken."""
        if self._owed and self._send(WISH * self._owed):
            self._owed, self._is_asked = 0, True

    def begin(self) -> None:
        """Note that a call begins. With "latest", what is there already may be old."""
        self.settle()
        self.leave()
        self._may_be_old, self._looks_until = self._is_away, None

    def leave(self) -> None:
        """Note that nobody waits any more."""
        if self._latest and self._is_asked and not self._is_away and self._send(AWAY):
            self._is_away = True

    def looks_until(self, now: float) -> float | None:
        """Return how long it waits for a newer frame than the one that is there; None: it need not."""
        if not self._may_be_old:
            return None
        newer = self._skip_to_newest()
        if self._looks_until is None:
            if self._has_frame():
                self._looks_until = now + _NEWER_S
                self._send(LOOK)
            else:  # what comes now is new
                self._may_be_old = False
        elif newer or now >= self._looks_until:
            self._may_be_old, self._looks_until = False, None
        return self._looks_until

    def _send(self, what: bytes) -> bool:
        with contextlib.suppress(OSError):  # to read says that the publisher is gone; if it has no room, later
            self._line.socket.send(what)
            return True
        return False

    def _has_packet(self) -> bool:
        """Have the next packet in the inbox; return whether there is one."""
        self.settle()
        return bool(self._inbox) or self._receive()

    def settle(self) -> None:
        """Do what follows from it that a frame was taken, or that another thread has it."""
        if not self.is_taken and self._offered_to in (0, threading.get_ident()):
            return
        self.is_taken = True
        self._inbox.clear()
        # No call stands between these lines: a signal handler that raises has all of them done, or none.
        self._owed += 1
        self.last = self._number
        self._is_asked = self._is_away = self.is_taken = False
        self._offered_to = 0
        self.note = ""
        self.claim = None

    def _receive(self) -> bool:
        try:  # one call in C: a signal handler that raises cannot lose what was received
            self._inbox.extend(map(self._line.socket.recv, (PACKET_BYTES,)))
        except BlockingIOError:
            return False
        except OSError:
            self._inbox.append(b"")
        return True

    def _has_frame(self) -> bool:
        """Return whether a frame is first in the inbox, after the notes before it have been read."""
        while self.is_open and self._has_packet():
            packet = self._packet(self._inbox[0])
            if packet is None:
                self.close()
            elif not packet.note:
                return True
            else:
                self._hear(packet)
                self._inbox.clear()
        return False

    def _skip_to_newest(self) -> bool:
        """Leave out all but the newest of the frames that are there; return whether it is the newest that there is."""
        newer = False
        while self._has_frame() and self._receive():
            packet = self._packet(self._inbox[-1])
            if packet is None:  # its end, which is read again
                self._inbox.pop()
                return True
            if packet.note:
                newer = newer or packet.note == NOTHING_NEWER
                self._hear(packet)
                self._inbox.pop()
                continue
            newer = True
            first = self._packet(self._inbox[0])
            with contextlib.suppress(OSError, MemoryError, Lie):
                self._hold(first)
            self.claim = None  # which frees the slot
            self._inbox.popleft()
        return newer

    def take(self) -> StreamFrame | None:
        """Return the next frame that has arrived; None if there is none, or the publisher is gone.

        Raises:
            Unavailable: this process has no memory or no descriptor for it.
            Exception: of the value's own code.
        """
        if not self._has_frame() or (packet := self._packet(self._inbox[0])) is None:
            return None
        try:
            self._hold(packet)
        except (FileNotFoundError, ProcessLookupError, Lie):  # the frame was lost with its publisher
            self.close()
            return None
        except (OSError, MemoryError) as error:
            ended = isinstance(error, PermissionError) and self._has_ended()
            self.close()
            if ended:
                return None
            raise Unavailable(f"a frame cannot be read: {wanted_by(error) or text_of(error)}") from error
        self._number = packet.number
        try:
            value = self.claim.open() if self.claim is not None else pickling.loads(cast(bytes, packet.body))
        except Exception:
            self.is_taken = True  # no other call could make it
            raise
        missed = 0 if self.last is None else packet.number - self.last - 1
        frame = StreamFrame(value, packet.number, packet.published_at, missed, self._stream)
        self._offered_to = threading.get_ident()
        return frame

    def _has_ended(self) -> bool:
        """Return whether the publisher ends now: the descriptors of a process that ends cannot be opened any more."""
        poll = select.poll()
        poll.register(self._line.socket, 0)
        return bool(poll.poll(_ENDS_S * 1000))

    @staticmethod
    def _packet(raw: bytes) -> Packet | None:
        """Return what a packet says; None: the publisher has ended, or says nonsense."""
        with contextlib.suppress(msgspec.MsgspecError):
            return packet_of(raw) if raw else None
        return None

    def _hear(self, packet: Packet) -> None:
        if packet.note in (OPENED, OPENED_ONCE):
            self.opened_once = packet.note == OPENED_ONCE
            if self.opened_at not in (0.0, packet.published_at):
                self.last = 0  # another publisher counts from 1
            self.opened_at = packet.published_at
        elif packet.note != NOTHING_NEWER:
            self.note = packet.note

    def _hold(self, packet: Packet | None) -> None:
        if self.claim is None and packet is not None and isinstance(packet.body, Parcel):
            self.claim = self._parcels.hold(packet.body, self._line)
        if self.claim is not None:
            self.claim.arm()

    def close(self) -> None:
        """Read no more. The connection ends with the last value that is in use."""
        self.is_open = False
        with contextlib.suppress(OSError):
            self._line.socket.shutdown(socket.SHUT_WR)
        self._inbox.clear()
        self.claim = None
        self._parcels.close()
