"""A link that its own thread writes and reads: one message there, one back, with no loop on this side.

For the caller of a blocking load it saves two hand-overs between threads. The other end is an ordinary link.
"""

from __future__ import annotations

import select
import socket
import time
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.errors import Unavailable
from rr_actors.transport import Hello, Welcome
from rr_actors.transports.frames import FRAME_LIMIT_BYTES, FrameReader, encode, frame
from rr_actors.transports.handshake import DiallerHandshake
from rr_actors.transports.sockets import SocketDir

_CHUNK_BYTES = 65536


class BlockingLink:
    """One connection, used by one thread at a time.

    Args:
        socket_dir, key: as for UnixTransport.
        address: of the transport to connect to.
        decoder: of the messages that come back.
        timeout_s: how long the handshake may take.

    Raises:
        RrError: what the other side refused with. Unavailable: nobody is there.
    """

    def __init__(
        self,
        socket_dir: Path,
        key: bytes,
        address: str,
        hello: Hello,
        decoder: msgspec.msgpack.Decoder[Any],
        *,
        frame_limit_bytes: int = FRAME_LIMIT_BYTES,
        timeout_s: float = 5.0,
    ) -> None:
        self.welcome: Welcome
        self._limit = frame_limit_bytes
        self._reader: FrameReader[Any] = FrameReader(decoder, frame_limit_bytes)
        self._poll = select.poll()
        directory = SocketDir(socket_dir)
        try:
            self._socket = directory.connect(address)
        except (OSError, ValueError) as error:
            raise Unavailable(f"{hello.to}: nobody listens at {address}: {error}") from error
        finally:
            directory.close()
        try:
            self._socket.setblocking(True)
            self._poll.register(self._socket, select.POLLIN)
            self._shake_hands(DiallerHandshake(key, hello), timeout_s)
        except OSError as error:
            self.close()
            raise Unavailable(f"{hello.to}: the handshake failed: {error}") from error
        except BaseException:
            self.close()
            raise

    def _shake_hands(self, handshake: DiallerHandshake, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while not handshake.done:
            data = self._receive(max(0.001, deadline - time.monotonic()))
            answer = handshake.receive(data)
            if answer:
                self._socket.sendall(answer)
        if handshake.refusal is not None:
            raise handshake.refusal
        assert handshake.welcome is not None
        self.welcome = handshake.welcome

    def send(self, message: Any) -> None:
        """Write a message.

        Raises:
            OSError: the connection is lost. NotSerializable: too long for a frame.
        """
        self._socket.sendall(frame(encode(message, self._limit)))

    def receive(self, timeout_s: float | None) -> Any:
        """Return the next message.

        Raises:
            TimeoutError: none within `timeout_s` seconds. OSError: the connection is lost.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        left_s = timeout_s
        while True:
            messages = self._reader.feed(self._receive(left_s))
            if messages:
                return messages[0]
            if self._reader.error is not None or self._reader.ended:
                raise ConnectionResetError(f"the link has ended: {self._reader.error or 'closed'}")
            if deadline is not None:
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise TimeoutError

    def _receive(self, timeout_s: float | None) -> bytes:
        # not recv() alone: it is woken, too, when the other side has read what was sent, which costs both a wake-up
        if not self._poll.poll(None if timeout_s is None else timeout_s * 1e3):
            raise TimeoutError
        data = self._socket.recv(_CHUNK_BYTES)
        if not data:
            raise ConnectionResetError("closed by the other side")
        return data

    def close(self) -> None:
        """Let it go."""
        self._socket.close()
