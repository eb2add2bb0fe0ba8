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
