"""The link to a running system, which may end and start again meanwhile."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

from rr_actors.base.errors import RrError
from rr_actors.system.console.console_connection import Connections, NotRunning, find_console
from rr_actors.system.console.console_messages import Events, Follow, Missed, Welcome
from rr_actors.system.console.console_view import Verb

_A = TypeVar("_A")
_CLOSED = "the connection to the system is closed"
_LONGEST_S = 100.0  # for a command: longer than any of them may take


class ConsoleLink:
    """Connections to the console of the system that runs in one state directory. Any thread may use them.

    Args:
        state_dir: the system's directory; None for the one system that runs. Later calls keep that directory.

    Raises:
        NotRunning: no system runs in the directory, or none at all.
        UsageError: several systems run, and no state directory was given.
        Unavailable: the system belongs to another user, or speaks another version.
    """

    def __init__(self, state_dir: str | os.PathLike[str] | None = None) -> None:
        self.state_dir = state_dir
        self._connections = Connections(lambda: find_console(self.state_dir), _LONGEST_S)
        with self._connections.lent() as connection:
            self.state_dir = connection.welcome.state_dir

    def ask(self, request: Verb[_A], timeout_s: float | None = None) -> _A:
        """Send a question or a command, and return its answer.

        Raises:
            RrError: the system refused the request, or could not carry it out.
            NotRunning: the system has ended, or the link is closed.
            Unavailable: the system has not answered in time; it may still carry the request out.
        """
        return self._connections.ask(request, timeout_s)

    def follow(self, found: Callable[[Welcome], None], hear: Callable[[Events | Missed], None]) -> str:
        """Call `found` when the system is reached, then `hear` with its events; return why that has ended.

        It ends when the system does, or when the link is closed; at once if no system runs, or if it refuses.
        """
        ended = f"the system in {self.state_dir} has stopped"
        try:
            with self._connections.open() as connection:
                found(connection.welcome)
                for part in connection.follow(Follow()):
                    hear(part)
        except NotRunning:
            ended = f"no system runs in {self.state_dir}"
        except RrError as error:
            ended = str(error)
        return _CLOSED if self._connections.is_closed else ended

    def close(self) -> None:
        """Close all connections. Calls that wait in other threads raise NotRunning. A second call does nothing."""
        self._connections.close(_CLOSED)
