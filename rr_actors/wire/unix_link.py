"""A link of the Unix transport: one connection whose handshake is done."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import socket
import threading
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors.base.errors import MailboxFull, NotSerializable, Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.wire.frames import GOODBYE, FrameReader, framed
from rr_actors.wire.transport import Attach, Hello, Receiver, Welcome
from rr_actors.wire.unix_sockets import SocketPeer

_log = Log(__name__)

BUFFER_LIMIT_BYTES = 64 * 1024 * 1024
"""How much may wait on one link for a peer that does not read."""
CLOSE_LIMIT_S = 1.0
"""How long a closing link waits until its peer has read the last messages."""


class Wire(msgspec.Struct, frozen=True):
    """The settings that all links of one kind share."""

    decoder: msgspec.msgpack.Decoder[Any]
    frame_limit_bytes: int


class UnixLink(asyncio.Protocol):
    """A Link, and the protocol of its connection. `closed` is set when `lost` is called."""

    more = False
    _received: Callable[[Any, Any], None]  # set by attach(), before the transport reads

    def __init__(
        self,
        links: set[UnixLink],
        transport: asyncio.Transport,
        wire: Wire,
        hello: Hello,
        welcome: Welcome,
        peer: SocketPeer,
        name: str,
        start: bytes = b"",
    ) -> None:
        """Make the link with the `peer` of this name. It is in `links` while it is open; `start` is sent first."""
        self.hello = hello
        self.welcome = welcome
        self.peer = peer.named(name)
        self.pid = peer.pid
        self.closed = asyncio.Event()
        self._links = links
        self._transport = transport
        self._reader: FrameReader[Any] = FrameReader(wire.decoder, wire.frame_limit_bytes)
        self._frame_limit = wire.frame_limit_bytes
        self._buffer = bytearray(start)  # the frames of the next flush
        self._unsent = 0  # bytes that the transport still buffered at the last look
        self._open = True
        self._reason: Exception | None = None
        self._receiver: Receiver | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._outlet: Outlet | None = None

    def attach(self, attach: Attach) -> None:
        """Set the receiver of the link; from now on the link calls its `lost` at the end."""
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
        if len(self._buffer) + self._unsent > BUFFER_LIMIT_BYTES:
            self._check_room()
        self._buffer += framed(message, self._frame_limit)

    def _check_room(self) -> None:
        self._unsent = self._transport.get_write_buffer_size()
        waiting = len(self._buffer) + self._unsent
        if waiting > BUFFER_LIMIT_BYTES:
            raise MailboxFull(
                f"{waiting} bytes wait for {self.peer}, over the limit of {BUFFER_LIMIT_BYTES}: "
                "it does not read; try again when it does",
                name=self.peer,
                limit=BUFFER_LIMIT_BYTES,
            )

    def flush(self) -> None:
        if self._open and self._buffer:
            frames, self._buffer = self._buffer, bytearray()  # the transport may keep the buffer
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
        """Let other threads, too, write answers to this link from now on."""
        if self._outlet is None and self._open:
            with contextlib.suppress(OSError):  # then the event loop sends all answers
                self._outlet = Outlet(self._transport.get_extra_info("socket").fileno())

    def answering(self, message: Any) -> Callable[[], None] | None:
        """Return a function with which any thread sends the answer to the only open question; None: the loop must."""
        outlet = self._outlet
        if outlet is None or not self._open:
            return None
        try:
            return functools.partial(self._answer, outlet, framed(message, self._frame_limit))
        except NotSerializable:  # the loop will find this, too, and report it
            return None

    def _answer(self, outlet: Outlet, frame: bytes) -> None:
        if not outlet.write(frame):
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._write_rest, outlet)

    def _write_rest(self, outlet: Outlet) -> None:
        if self._open:
            self._transport.write(outlet.take_rest())

    def close(self) -> None:
        """Send the queued messages and close; cut off a peer that does not read them within a second."""
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
        """Close at once, and drop the queued messages."""
        self._open = False
        self._reason = self._reason or reason
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        """Hand each complete message to the receiver (asyncio calls this)."""
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
        """Abort the link: the peer writes and reads no more (asyncio calls this)."""
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
# Beside the event loop's transport, a thread may write only an answer with no other message before or behind it. The
# peer has read all earlier messages, or it would not have asked again.


class Outlet:
    """A second descriptor for a connection, which stays valid whatever the transport does.

    Args:
        fd: the transport's descriptor of the connection.

    Raises:
        OSError: the process has no file descriptors left.
    """

    __slots__ = ("_lock", "_rest", "_socket")

    def __init__(self, fd: int) -> None:
        self._lock = threading.Lock()  # between a thread that writes and the loop that closes
        self._rest = b""
        self._socket: socket.socket | None = socket.socket(fileno=os.dup(fd))

    def write(self, data: bytes) -> bool:
        """Write without waiting; return False if the connection does not take all data: the loop must write the rest.

        The data is dropped if the connection is lost or this outlet is closed.
        """
        with self._lock:
            if self._socket is None:
                return True
            try:
                sent = self._socket.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                sent = 0
            except OSError:  # the connection is lost; its transport will find that, too
                return True
            self._rest = data[sent:]
            return not self._rest

    def take_rest(self) -> bytes:
        """Return the data that a thread could not write, for the loop to write first; then forget it."""
        with self._lock:
            rest, self._rest = self._rest, b""
            return rest

    def close(self) -> bytes:
        """Close the descriptor, and return the data that is still to be written. A second call does nothing."""
        with self._lock:
            if self._socket is not None:
                self._socket.close()
                self._socket = None
        return self.take_rest()
