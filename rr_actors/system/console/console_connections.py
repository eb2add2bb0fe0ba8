"""Connections to the console of one system: one for each call in flight, opened as needed and kept for later calls."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from rr_actors.system.console.console_client import ConsoleClient, NotRunning
from rr_actors.system.console.console_messages import Request, Welcome

_A = TypeVar("_A")
_IDLE = 8  # connections that are kept for the next call

_here: weakref.WeakSet[Connections] = weakref.WeakSet()


class Connections:
    """Connections to one console. From any thread.

    Args:
        find: returns the directory of the console's socket; called for each new connection.
        timeout_s: seconds that an answer may take, unless a call says otherwise.
    """

    def __init__(self, find: Callable[[], Path], timeout_s: float) -> None:
        self._find = find
        self._timeout_s = timeout_s
        self._closed = ""
        self._lock = threading.Lock()
        self._idle: list[ConsoleClient] = []
        self._all: weakref.WeakSet[ConsoleClient] = weakref.WeakSet()
        _here.add(self)

    def open(self) -> ConsoleClient:
        """Return a new connection. The caller closes it; close() does, too.

        Raises:
            NotRunning: no system runs, or these connections are closed.
            Unavailable: the system is another user's, or speaks another version.
        """
        if not self._closed:
            client = ConsoleClient(self._find(), timeout_s=self._timeout_s)
            with self._lock:
                if not self._closed:
                    self._all.add(client)
                    return client
            client.close()
        raise NotRunning(self._closed)

    @contextmanager
    def lent(self) -> Generator[ConsoleClient]:
        """Lend a connection that no other call uses within the `with` block.

        Raises:
            NotRunning, Unavailable: as open().
        """
        client = self._kept() or self.open()
        try:
            yield client
        except NotRunning:
            self._forget_idle()
            raise
        finally:
            self._give_back(client)

    def ask(self, request: Request, expected: type[_A], timeout_s: float | None = None) -> _A:
        """Send a request and return its answer.

        Raises:
            RrError: the system refused the request, or could not carry it out.
            NotRunning: the system has ended, or these connections are closed.
            Unavailable: no answer came in time; the system may carry out the request all the same.
        """
        with self.lent() as client:
            return client.ask(request, expected, timeout_s)

    def welcome(self) -> Welcome:
        """Return the console's answer to Hello, which names the system.

        Raises:
            NotRunning, Unavailable: as open().
        """
        with self.lent() as client:
            return client.welcome

    def close(self, why: str) -> None:
        """Close all connections. Calls in flight and later ones raise NotRunning. A second close does nothing."""
        with self._lock:
            self._closed = self._closed or why
            clients, self._idle = list(self._all), []
        for client in clients:
            client.close()

    def leave_to_parent(self) -> None:
        """Close the copies in a forked child, so that the parent's connections end with the parent."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        self._closed = "this process was forked from the client's: call rr.connect() here"
        self._idle = []
        for client in list(self._all):
            client.drop()

    def _kept(self) -> ConsoleClient | None:
        with self._lock:
            return self._idle.pop() if self._idle else None

    def _give_back(self, client: ConsoleClient) -> None:
        with self._lock:
            kept = not client.is_broken and not self._closed and len(self._idle) < _IDLE
            if kept:
                self._idle.append(client)
        if not kept:
            client.drop()

    def _forget_idle(self) -> None:
        """Close the idle connections: their system has ended."""
        with self._lock:
            idle, self._idle = self._idle, []
        for client in idle:
            client.close()


def _forked() -> None:
    for connections in list(_here):
        connections.leave_to_parent()


os.register_at_fork(after_in_child=_forked)
