"""A link of the Unix transport: one connection whose handshake is done."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import os
import socket
import threading
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors.base.errors import MailboxFull, NotSerializable, Unavailable
from rr_actors.wire.frames import GOODBYE, FrameReader, framed
from rr_actors.wire.transport import Attach, Hello, Receiver, Welcome

_log = logging.getLogger(__name__)

CLOSE_LIMIT_S = 1.0
"""How long a closing link waits for its peer to read what was sent last."""


class Wire(msgspec.Struct, frozen=True):
    """What links of one kind share."""

    decoder: msgspec.msgpack.Decoder[Any]
    frame_limit_bytes: int
    buffer_limit_bytes: int


def _nobody(_link: Any, message: Any) -> None:
    raise AssertionError(f"{type(message).__name__} came before there was anybody to receive it")


class UnixLink(asyncio.Protocol):
    """A Link, and the protocol of its connection. `closed` is set when `lost` is called."""

    more = False

    def __init__(
        self,
        links: set[UnixLink],
        transport: asyncio.Transport,
        wire: Wire,
        hello: Hello,
        welcome: Welcome,
        peer: str,
        start: bytes = b"",
    ) -> None:
        """Make the link; it is in `links` while it is open, and writes `start` before any message."""
        self.hello = hello
        self.welcome = welcome
        self.peer = peer
        self.closed = asyncio.Event()
        self._links = links
        self._transport = transport
        self._reader: FrameReader[Any] = FrameReader(wire.decoder, wire.frame_limit_bytes)
        self._frame_limit = wire.frame_limit_bytes
        self._buffer = bytearray(start)  # the frames of the next flush
        self._buffer_limit = wire.buffer_limit_bytes
        self._unsent = 0  # what the connection had not taken at the last look
        self._open = True
        self._reason: Exception | None = None
        self._receiver: Receiver | None = None
        self._received: Callable[[Any, Any], None] = _nobody
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._outlet: Outlet | None = None

    def attach(self, attach: Attach) -> None:
        """Give it its receiver; from then on it will hear `lost`."""
        self._receiver = attach(self)
        self._received = self._receiver.received
        self._links.add(self)

    @property
    def behind(self) -> bool:
        self._unsent = self._transport.get_write_buffer_size()
        return self._unsent > 0

    def send(self, message: Any) -> None:
        if not self._open:
            return
        if len(self._buffer) + self._unsent > self._buffer_limit:
            self._check_room()
        self._buffer += framed(message, self._frame_limit)

    def _check_room(self) -> None:
        self._unsent = self._transport.get_write_buffer_size()
        waiting = len(self._buffer) + self._unsent
        if waiting > self._buffer_limit:
            raise MailboxFull(
                f"{waiting} bytes wait for {self.peer}, over the limit of {self._buffer_limit} (buffer_limit_bytes): "
                "it does not read; try again when it does",
                name=self.peer,
                limit=self._buffer_limit,
            )

    def flush(self) -> None:
        if self._open and self._buffer:
            frames, self._buffer = self._buffer, bytearray()  # the transport may keep what it is given
            self._transport.write(frames)
            self._unsent = self._transport.get_write_buffer_size()

    def send_now(self, message: Any) -> None:
        if self._buffer or self._unsent or not self._open:
            self.send(message)
            self.flush()
        else:
            self._transport.write(framed(message, self._frame_limit))
            self._unsent = self._transport.get_write_buffer_size()

    def open_outlet(self) -> None:
        """Let threads answer on it, too, what is asked from now on."""
        if self._outlet is None and self._open:
            with contextlib.suppress(OSError):  # then it is the loop that answers
                self._outlet = Outlet(self._transport.get_extra_info("socket").fileno())

    def answering(self, message: Any) -> Callable[[], None] | None:
        """What sends the answer to the only open question, by any thread; None: it is the loop's to send."""
        outlet = self._outlet
        if outlet is None or not self._open:
            return None
        try:
            return functools.partial(self._answer, outlet, framed(message, self._frame_limit))
        except NotSerializable:  # as the loop will find, and say
            return None

    def _answer(self, outlet: Outlet, frame: bytes) -> None:
        if not outlet.write(frame):
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._write_rest, outlet)

    def _write_rest(self, outlet: Outlet) -> None:
        if self._open:
            self._transport.write(outlet.take_rest())

    def close(self) -> None:
        """Send what is queued and close; a peer that does not read it within a second is cut off."""
        if not self._open:
            return
        if self._outlet is not None:
            self._transport.write(self._outlet.close())
        self._buffer += GOODBYE
        self.flush()
        self._open = False
        self._transport.close()
        self._timer = asyncio.get_running_loop().call_later(CLOSE_LIMIT_S, self._transport.abort)

    def abort(self, reason: Exception | None) -> None:
        """Close at once, whatever is queued."""
        self._open = False
        self._reason = self._reason or reason
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        """Hand over each message that is complete (asyncio calls this)."""
        reader = self._reader
        received = self._received
        messages = reader.feed(data)
        left = len(messages)
        for message in messages:
            if not self._open:
                return
            left -= 1
            self.more = left > 0
            try:
                received(self, message)
            except Exception as error:
                _log.exception("closing the link with %s: its receiver failed on %s", self.peer, type(message).__name__)
                self.abort(error)
        if reader.error is not None and self._open:
            _log.error("closing the link with %s: it sent %s", self.peer, reader.error)
            self.abort(Unavailable(f"{self.peer} sent {reader.error}"))

    def eof_received(self) -> None:
        """Nothing more will come (asyncio calls this). What is not sent yet cannot arrive any more."""
        self.abort(
            None if self._reader.ended else Unavailable(f"the connection with {self.peer} ended: its process died")
        )

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell the receiver, once (asyncio calls this)."""
        if self.closed.is_set():
            return
        closing = not self._open and self._reason is None
        self._open = False
        self.closed.set()
        self._links.discard(self)
        if self._outlet is not None:
            self._outlet.close()
        if self._timer is not None:
            self._timer.cancel()
        reason = self._reason
        if exc is not None and not closing and not self._reader.ended:
            reason = Unavailable(f"the connection with {self.peer} broke: {exc}")
            reason.__cause__ = exc
        if self._receiver is not None:
            try:
                self._receiver.lost(self, reason)
            except Exception:
                _log.exception("the receiver of the link with %s failed when it was lost", self.peer)


# -- writing from any thread -------------------------------------------------------------------------------------------
#
# Beside the loop's transport that has the connection. For an answer that has nothing before it and nothing behind: the
# peer has read what was sent before, or it would not have asked again.


class Outlet:
    """A descriptor of its own for a connection, which stays this connection's whatever the transport does.

    Args:
        fd: the transport's.

    Raises:
        OSError: the process has no file descriptors left.
    """

    __slots__ = ("_lock", "_rest", "_socket")

    def __init__(self, fd: int) -> None:
        self._lock = threading.Lock()  # between a thread that writes and the loop that closes
        self._rest = b""
        self._socket: socket.socket | None = socket.socket(fileno=os.dup(fd))

    def write(self, data: bytes) -> bool:
        """Write without waiting; False: a rest, which the connection does not take now, is the loop's to write.

        Dropped if the connection is lost, or this is closed.
        """
        with self._lock:
            if self._socket is None:
                return True
            try:
                sent = self._socket.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                sent = 0
            except OSError:  # as its transport will find
                return True
            self._rest = data[sent:]
            return not self._rest

    def take_rest(self) -> bytes:
        """What a thread has left to be written, before anything else."""
        with self._lock:
            rest, self._rest = self._rest, b""
            return rest

    def close(self) -> bytes:
        """Give the descriptor back, and what is left to be written; again is nothing."""
        with self._lock:
            if self._socket is not None:
                self._socket.close()
                self._socket = None
        return self.take_rest()
