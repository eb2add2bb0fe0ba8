"""The way to a running system that may end and start again meanwhile: connections to its console, opened as needed."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import TypeVar

from rr_actors.base.errors import RrError, Unavailable
from rr_actors.system.console.console_client import ConsoleClient, NotRunning, find_console
from rr_actors.system.console.console_messages import Events, Follow, Missed, Request, Welcome

_A = TypeVar("_A")
_LONGEST_S = 100.0  # for a command: longer than any of them may take


class ConsoleLink:
    """Connections to the console of the system in one state directory. From any thread; each call has a connection.

    Args:
        state_dir: where the system is; None for the one that runs. A later call stays with that directory.

    Raises:
        NotRunning: no system runs, there or at all.
        UsageError: several systems run, and no state directory was given.
        Unavailable: it belongs to another user, or speaks another version.
    """

    def __init__(self, state_dir: str | os.PathLike[str] | None = None) -> None:
        self._lock = threading.Lock()
        self._idle: list[ConsoleClient] = []
        self._open: set[ConsoleClient] = set()
        self._is_closed = False
        client = ConsoleClient(find_console(state_dir), timeout_s=_LONGEST_S)
        self.state_dir = client.welcome.state_dir
        self._open.add(client)
        self._give_back(client)

    def ask(self, request: Request, expected: type[_A], timeout_s: float | None = None) -> _A:
        """Send a request and return its answer. A connection that failed is closed; the next call opens another.

        Raises:
            RrError: the system refused it, or could not do it.
            NotRunning: the system has ended, or the link is closed.
            Unavailable: it has not answered in time; what was asked for may be done all the same.
        """
        client = self._taken() or self._opened()
        try:
            answer = client.ask(request, expected, timeout_s)
        except RrError as error:
            if isinstance(error, NotRunning):
                self._forget_idle()
            if isinstance(error, Unavailable):  # an answer that is late must not be taken for the next one
                self._drop(client)
            else:
                self._give_back(client)
            raise
        except BaseException:
            self._drop(client)
            raise
        self._give_back(client)
        return answer

    def follow(self, found: Callable[[Welcome], None], hear: Callable[[Events | Missed], None]) -> None:
        """Call `found` when the system is reached, then `hear` with what happens in it. Return when it ends.

        Raises:
            NotRunning: no system runs in the state directory, or the link is closed.
            RrError: the system refused the connection.
        """
        client = self._opened()
        try:
            found(client.welcome)
            for part in client.follow(Follow()):
                hear(part)
        finally:
            self._drop(client)

    def close(self) -> None:
        """Close all connections: calls that wait in other threads end with NotRunning. Again is nothing."""
        with self._lock:
            self._is_closed = True
            clients, self._open = self._open, set()
            self._idle.clear()
        for client in clients:
            client.close()

    def _taken(self) -> ConsoleClient | None:
        with self._lock:
            return self._idle.pop() if self._idle else None

    def _opened(self) -> ConsoleClient:
        with self._lock:
            if self._is_closed:
                raise NotRunning("the connection to the system is closed")
        client = ConsoleClient(find_console(self.state_dir), timeout_s=_LONGEST_S)
        with self._lock:
            if not self._is_closed:
                self._open.add(client)
                return client
        client.close()
        raise NotRunning("the connection to the system is closed")

    def _give_back(self, client: ConsoleClient) -> None:
        with self._lock:
            if client in self._open:
                self._idle.append(client)

    def _drop(self, client: ConsoleClient) -> None:
        with self._lock:
            self._open.discard(client)
        client.close()

    def _forget_idle(self) -> None:
        """Close the connections to a system that has ended."""
        with self._lock:
            idle, self._idle = self._idle, []
            self._open.difference_update(idle)
        for client in idle:
            client.close()
