"""Outlets: writing to a connection from any thread, beside the loop's transport that has it.

For an answer that has nothing before it and nothing behind: the peer has read what was sent before, or it would not
have asked again.
"""

from __future__ import annotations

import os
import socket
import threading


class Outlet:
    """A descriptor of its own for a connection, which stays this connection's whatever the transport does.

    Args:
        fd: the transport's.

    Raises:
        OSError: the process has no file descriptors left.
    """

    __slots__ = ("_lock", "_socket")

    def __init__(self, fd: int) -> None:
        self._lock = threading.Lock()  # between a thread that writes and the loop that closes
        self._socket: socket.socket | None = socket.socket(fileno=os.dup(fd))

    def write(self, data: bytes) -> bytes:
        """Write without waiting; what the connection does not take now is returned. Dropped if it is lost."""
        with self._lock:
            if self._socket is None:
                return b""
            try:
                sent = self._socket.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return data
            except OSError:  # as its transport will find
                return b""
        return data[sent:]

    def close(self) -> None:
        """Give the descriptor back; again is nothing."""
        with self._lock:
            if self._socket is not None:
                self._socket.close()
                self._socket = None
