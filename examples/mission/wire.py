"""How the robot's programs talk: JSON lines over local sockets, nothing ever waits for anybody.

A Publisher gives every message to all who are connected; one who reads too slowly misses some. A Subscriber connects,
and connects again whenever the other side was gone.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from typing import Any

Message = dict[str, Any]


class Publisher:
    """Listens at a path. `clients` are connected at the moment."""

    def __init__(self, path: str) -> None:
        self._path = path
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)  # of a predecessor that was killed
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.setblocking(False)
        self._listener.bind(path)
        self._listener.listen()
        self.clients: list[_Line] = []

    def poll(self) -> list[Message]:
        """What the clients have said since the last time."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self.clients.append(_Line(self._listener.accept()[0]))
        messages = [message for client in self.clients for message in client.receive()]
        self.clients = [client for client in self.clients if client.is_open]
        return messages

    def publish(self, message: Message) -> None:
        for client in self.clients:
            client.send(message)

    def close(self) -> None:
        os.unlink(self._path)
        self._listener.close()
        for client in self.clients:
            client.close()


class Subscriber:
    """Connects to a Publisher's path."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.latest: Message | None = None
        self.latest_at = float("-inf")
        self._line: _Line | None = None

    def poll(self) -> list[Message]:
        """What was published since the last time; the last of it stays in `latest`, its arrival in `latest_at`."""
        messages = self._line.receive() if self._connected() and self._line else []
        if messages:
            self.latest, self.latest_at = messages[-1], time.monotonic()
        return messages

    def age_s(self) -> float:
        """Seconds since the last message."""
        return time.monotonic() - self.latest_at

    def send(self, message: Message) -> None:
        """Say something to the publisher; lost if it is not there."""
        if self._connected() and self._line:
            self._line.send(message)

    def close(self) -> None:
        if self._line:
            self._line.close()

    @property
    def is_connected(self) -> bool:
        return self._line is not None and self._line.is_open

    def _connected(self) -> bool:
        if self.is_connected:
            return True
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(self.path)
        except OSError:
            connection.close()
            return False
        connection.setblocking(False)
        self._line = _Line(connection)
        return True


class _Line:
    """One connection: whole messages in, whole messages out."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._connection = connection
        self._received = b""
        self._unsent = b""
        self.is_open = True

    def receive(self) -> list[Message]:
        try:
            while data := self._connection.recv(65536):
                self._received += data
            self.close()
        except BlockingIOError:
            pass
        except OSError:
            self.close()
        *lines, self._received = self._received.split(b"\n")
        return [json.loads(line) for line in lines]

    def send(self, message: Message) -> None:
        if not self.is_open:
            return
        if not self._unsent:  # else it reads too slowly, and misses this one
            self._unsent = json.dumps(message).encode() + b"\n"
        try:
            self._unsent = self._unsent[self._connection.send(self._unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def close(self) -> None:
        self.is_open = False
        self._connection.close()


def every(period_s: float) -> Iterator[float]:
    """Yield once a period, with the seconds since the last time, until SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    last = due = time.monotonic()
    while True:
        due = max(due + period_s, time.monotonic())  # what was missed is not made up for
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.monotonic()
        yield now - last
        last = now
