"""A connection to the console: plain and synchronous, for any program of the user. No part of a system runs in it."""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

import msgspec

from rr_actors.base.errors import ConfigError, NotRunning, Unavailable, UsageError
from rr_actors.base.values.failure import error_of
from rr_actors.runtime.time_limits import deadline_of, left_until
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_commands import AwaitStatuses
from rr_actors.system.console.console_protocol import ANSWERS, answer_of, decoder_of
from rr_actors.system.console.console_questions import (
    ListChildren,
    Listing,
    ListLoads,
    ListQueries,
    ListRegistrars,
    ListResources,
    ListStreams,
    ListUsages,
)
from rr_actors.system.console.console_view import Verb
from rr_actors.system.console.running_systems import consoles_in, running_systems
from rr_actors.wire.frames import FrameReader, framed
from rr_actors.wire.unix_sockets import SocketDir, peer_at

_A = TypeVar("_A")
_Page = TypeVar("_Page", c.Children, c.Registrars, c.Resources, c.QueryPage, c.Loads, c.Usages, c.Streams)
GREETING_S = 5.0
"""Seconds within which a console answers a new connection."""
_RETRY_S = 0.01
_IDLE = 8  # connections that are kept for the next call

_here: weakref.WeakSet[Connections] = weakref.WeakSet()


class ConsoleConnection:
    """A connection to the console of a running system. For one thread; as a context manager it is closed at the end.

    Args:
        run_dir: the directory of the console's socket, as find_console() returns it.
        timeout_s: seconds that an answer may take, and that a request may take to be sent.
        greeting_s: seconds within which the console has to answer at first.
        program: the same for all sockets of one rr.Connection; "": this is its only one.

    Attributes:
        welcome: the console's answer to Hello, which names the system.
        has_ended: whether the system has closed the connection, or this side has.
        is_broken: whether the connection must not be kept for another call: the last answer did not come, or is a
            Holding without its keep() yet, or a Refused, after which the console may close the connection.

    Raises:
        NotRunning: no console answers in run_dir.
        Unavailable: the console is another user's, or speaks another version.
    """

    def __init__(
        self, run_dir: Path, *, timeout_s: float = 60.0, greeting_s: float = GREETING_S, program: str = ""
    ) -> None:
        deadline = deadline_of(greeting_s)
        self.run_dir = run_dir
        self.timeout_s = timeout_s
        self._socket = _connected(run_dir, deadline)
        self._frames = FrameReader(decoder_of(ANSWERS), c.ANSWER_LIMIT_BYTES)
        self._answers: deque[c.Message] = deque()
        self.has_ended = self.is_broken = False
        try:
            self.welcome = self._asked(c.Hello(c.VERSION, program), c.Welcome, deadline)
        except BaseException:
            self.close()
            raise

    def ask(self, request: Verb[_A], timeout_s: float | None = None) -> _A:
        """Send a question or a command, and return its answer.

        Args:
            timeout_s: seconds until the answer has to be here; None: the connection's own limit.

        Raises:
            RrError: the system refused the request, or could not carry it out.
            NotRunning: the system has ended.
            Unavailable: no answer came in time; the system may carry out the request all the same.
        """
        deadline = deadline_of(self.timeout_s if timeout_s is None else timeout_s)
        return self._asked(request, answer_of(type(request)), deadline)

    def _asked(self, request: c.Message, expected: type[_A], deadline: float) -> _A:
        self.is_broken = True
        self._send(request, deadline)
        answer = self._receive(deadline)
        self.is_broken = isinstance(answer, c.Holding | c.Refused)
        return _checked(answer, expected)

    def wait_statuses(self, registrar: str) -> list[c.Heard | c.Dropped]:
        """Wait without limit for statuses of the queries of the registrar that this connection has opened."""
        self._send(AwaitStatuses(registrar))
        return _checked(self._receive(math.inf), c.Statuses).statuses

    def keep(self) -> None:
        """Say that the query of the last Holding has arrived; otherwise the end of the connection releases it."""
        self._send(c.Keep())
        self.is_broken = False

    def children(self) -> c.Children:
        """Return all children of the tree, read page by page."""
        return self._all(ListChildren())

    def registrars(self) -> c.Registrars:
        """Return all registrars, read page by page."""
        return self._all(ListRegistrars())

    def resources(self, registrar: str = "", match: str = "", limit: int = sys.maxsize) -> c.Resources:
        """Return the resources of a registrar, or of all, that ListResources(match) finds; at most `limit`."""
        return self._all(ListResources(match, registrar=registrar), limit)

    def usages(self, registrar: str = "", match: str = "") -> c.Usages:
        """Return what the resources use that ListUsages(match) finds, of a registrar, or of all."""
        return self._all(ListUsages(match, registrar=registrar))

    def streams(self, registrar: str = "", match: str = "") -> c.Streams:
        """Return the open streams that ListStreams(match) finds, of a registrar's resources, or of all."""
        return self._all(ListStreams(match, registrar=registrar))

    def loads(self, registrar: str = "", match: str = "") -> c.Loads:
        """Return the loads that wait, of one registrar or of all, and how often those of each server did."""
        return self._all(ListLoads(match, registrar=registrar))

    def queries(self, registrar: str = "", match: str = "", limit: int = sys.maxsize) -> c.QueryPage:
        """Return the queries that a registrar holds, or all, that ListQueries(match) finds; at most `limit`."""
        return self._all(ListQueries(match, registrar=registrar), limit)

    def _all(self, request: Listing[_Page], limit: int = sys.maxsize) -> _Page:
        """Return the rows of all pages, at most `limit`, with the notes of all pages."""
        pages = list(read_pages(self.ask, request, limit))
        rows: list[Any] = [row for page in pages for row in page.rows]
        notes = dict.fromkeys(note for page in pages for note in getattr(page, "notes", ()))
        more = {"notes": list(notes)} if notes else {}
        return msgspec.structs.replace(pages[-1], rows=rows[:limit], **more)

    def follow(self, follow: c.Follow, tick_s: float | None = None) -> Iterator[c.Events | c.Missed]:
        """Yield the events from now on, until the system ends. The connection has no other use after that.

        After `tick_s` without events it yields an Events without any. A Missed has the number of events that this
        reader was too slow for, and the first page of the tree now.

        Raises:
            RrError: the system refused the request.
        """
        return self._parts(follow, tick_s)

    def record(self, *, decisions: bool = False) -> Iterator[c.Entries]:
        """Yield the recorded entries from now on, as follow() does. `dropped` has those that this reader missed, too.

        Args:
            decisions: also those of what the registrars decide.

        Raises:
            RrError: the system refused the request.
        """
        parts = self._parts(c.BeginRecording(decisions))
        return (c.Entries([], part.count) if isinstance(part, c.Missed) else part for part in parts)

    def _parts(self, request: c.Follow | c.BeginRecording, tick_s: float | None = None) -> Iterator[Any]:
        self._send(request)
        _checked(self._receive(deadline_of(self.timeout_s)), c.Following)
        return self._fed(tick_s)

    def _fed(self, tick_s: float | None) -> Iterator[Any]:
        while True:
            try:
                answer = self._next(deadline_of(tick_s))
            except NotRunning:
                return
            if isinstance(answer, c.Refused):
                raise error_of(answer.failure)
            yield c.Events([]) if answer is None else answer

    def is_open(self) -> bool:
        """Return whether neither side has closed the connection; the thread that waits for answers asks between two."""
        look = select.poll()
        try:
            look.register(self._socket, select.POLLIN)
            return not look.poll(0) or bool(self._socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
        except BlockingIOError:
            return True
        except (OSError, ValueError):  # closed here
            return False

    def fileno(self) -> int:
        """Return the descriptor of the connection, which is readable when an answer is there."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the connection; a call that waits in another thread raises NotRunning. A second close does nothing."""
        with contextlib.suppress(OSError):  # the connection is closed already, or the other side has gone
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def drop(self) -> None:
        """Close this process's copy of the connection, on which no thread waits: a forked child's parent keeps its."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _send(self, request: c.Message, deadline: float | None = None) -> None:
        """Send a request until a deadline; None: within the time of an answer."""
        frame = framed(request, c.REQUEST_LIMIT_BYTES, "the longest request of a console")
        try:
            self._socket.settimeout(_left_s(deadline_of(self.timeout_s) if deadline is None else deadline))
            self._socket.sendall(frame)
        except TimeoutError as error:
            raise Unavailable(f"{self._who()} does not read what it is sent") from error
        except OSError:
            return  # the console has refused the connection: its answer is read next

    def _receive(self, deadline: float) -> c.Message:
        began = time.monotonic()
        answer = self._next(deadline)
        if answer is None:
            raise Unavailable(f"{self._who()} has not answered for {time.monotonic() - began:.1f} s")
        return answer

    def _next(self, deadline: float) -> c.Message | None:
        """Return the next answer, or None if none has come by the deadline. Another thread may close the socket."""
        while not self._answers:
            try:
                self._socket.settimeout(_left_s(deadline))
                data = self._socket.recv(2**18)
            except TimeoutError:
                return None
            except OSError as error:
                self.has_ended = True
                raise NotRunning(f"{self._who()} has ended: {error.strerror}") from error
            if not data:
                self.has_ended = True
                raise NotRunning(f"{self._who()} has ended, or closed the connection")
            self._answers += self._frames.feed(data)
            if self._frames.error is not None and not self._answers:
                raise Unavailable(f"{self._who()} sent something other than answers: {self._frames.error}")
        return self._answers.popleft()

    def _who(self) -> str:
        return f"the system in {self.run_dir.parent.parent}"


def read_pages(
    ask: Callable[[Listing[_Page]], _Page], request: Listing[_Page], limit: int = sys.maxsize
) -> Iterator[_Page]:
    """Ask for one page after another, and yield them, until there are `limit` rows or no more."""
    count = 0
    while True:
        left = max(1, min(limit - count, c.PAGE_LIMIT))
        page = ask(msgspec.structs.replace(request, offset=count, limit=left))
        yield page
        count += len(page.rows)
        if not page.rows or count >= min(page.total, limit):
            return


def _checked(answer: c.Message, expected: type[_A]) -> _A:
    if isinstance(answer, c.Refused):
        raise error_of(answer.failure)
    if not isinstance(answer, expected):
        raise Unavailable(f"console: expected {expected.__name__}, got {type(answer).__name__}")
    return answer


def _left_s(deadline: float) -> float | None:
    """Return the time limit of a socket, which must be over 0: it would not wait for what is there already."""
    left_s = left_until(deadline)
    return None if left_s is None else max(0.001, left_s)


def _connected(run_dir: Path, deadline: float) -> socket.socket:
    sockets = SocketDir(run_dir)
    try:
        while True:
            try:
                connected = sockets.connect(c.SOCKET)
                break
            except BlockingIOError as error:  # too many connections wait to be accepted
                if time.monotonic() > deadline:
                    raise Unavailable(f"{run_dir}: the system's console accepts no connections") from error
                time.sleep(_RETRY_S)
            except (OSError, ConfigError) as error:
                why = getattr(error, "strerror", None) or error
                raise NotRunning(f"{run_dir / c.SOCKET}: no system listens there ({why})") from error
    finally:
        sockets.close()
    if not (peer := peer_at(connected)).trusted:
        connected.close()
        raise Unavailable(f"{run_dir / c.SOCKET}: expected a system of user {os.geteuid()}, got one of user {peer.uid}")
    return connected


class Connections:
    """Connections to one console: one for each call in flight, kept for later calls. From any thread.

    Args:
        find: returns the directory of the console's socket; called for each new connection.
        timeout_s: seconds that an answer may take, unless a call says otherwise.
    """

    def __init__(self, find: Callable[[], Path], timeout_s: float) -> None:
        self._find = find
        self._timeout_s = timeout_s
        self._name = os.urandom(8).hex()
        self._closed = ""
        self._lock = threading.Lock()
        self._idle: list[ConsoleConnection] = []
        self._all: weakref.WeakSet[ConsoleConnection] = weakref.WeakSet()
        _here.add(self)

    @property
    def is_closed(self) -> bool:
        """Whether this side has closed the connections."""
        return bool(self._closed)

    def check_open(self) -> None:
        """Raise NotRunning if this side has closed the connections."""
        if self._closed:
            raise NotRunning(self._closed)

    def open(self, greeting_s: float = GREETING_S) -> ConsoleConnection:
        """Return a new connection. The caller closes it; close() does, too.

        Args:
            greeting_s: seconds within which the console has to answer.

        Raises:
            NotRunning: no system runs, or these connections are closed.
            Unavailable: the system is another user's, or speaks another version.
        """
        self.check_open()
        connection = ConsoleConnection(
            self._find(), timeout_s=self._timeout_s, greeting_s=greeting_s, program=self._name
        )
        with self._lock:
            if not self._closed:
                self._all.add(connection)
                return connection
        connection.close()
        raise NotRunning(self._closed)

    @contextmanager
    def lent(self, greeting_s: float = GREETING_S) -> Generator[ConsoleConnection]:
        """Lend a connection that no other call uses within the `with` block.

        Args:
            greeting_s: as for open().

        Raises:
            NotRunning, Unavailable: as open().
        """
        with self._lock:
            kept = self._idle.pop() if self._idle else None
        connection = kept or self.open(greeting_s)
        try:
            yield connection
        except NotRunning:  # the system has ended, and the idle connections with it
            with self._lock:
                idle, self._idle = self._idle, []
            for other in idle:
                other.close()
            raise
        finally:
            self._give_back(connection)

    def ask(self, request: Verb[_A], timeout_s: float | None = None) -> _A:
        """Send a question or a command, and return its answer.

        Args:
            timeout_s: seconds until the answer has to be here, also if a connection has to be opened before; None:
                the limit of these connections.

        Raises:
            RrError: the system refused the request, or could not carry it out.
            NotRunning: the system has ended, or these connections are closed.
            Unavailable: no answer came in time; the system may carry out the request all the same.
        """
        deadline = deadline_of(self._timeout_s if timeout_s is None else timeout_s)
        with self.lent(GREETING_S if timeout_s is None else min(GREETING_S, timeout_s)) as connection:
            return connection.ask(request, left_until(deadline))

    def drop_ended(self) -> None:
        """Close the idle connections that the system has closed."""
        with self._lock:
            ended = [connection for connection in self._idle if not connection.is_open()]
            self._idle = [connection for connection in self._idle if connection not in ended]
        for connection in ended:
            connection.close()

    def close(self, why: str) -> None:
        """Close all connections. Calls in flight and later ones raise NotRunning. A second close does nothing."""
        with self._lock:
            self._closed = self._closed or why
            connections, self._idle = list(self._all), []
        for connection in connections:
            connection.close()

    def leave_to_parent(self) -> None:
        """Close the copies in a forked child, so that the parent's connections end with the parent."""
        self._lock = threading.Lock()  # another thread may have held it at the fork
        self._closed = "this process was forked from the one that connected: call rr.connect() here"
        self._idle = []
        for connection in list(self._all):
            connection.drop()

    def _give_back(self, connection: ConsoleConnection) -> None:
        with self._lock:
            kept = not connection.is_broken and not self._closed and len(self._idle) < _IDLE
            if kept:
                self._idle.append(connection)
        if not kept:
            connection.close()


def _forked() -> None:
    for connections in list(_here):
        connections.leave_to_parent()


os.register_at_fork(after_in_child=_forked)


def find_console(state_dir: str | os.PathLike[str] | None = None) -> Path:
    """Return the directory of a console's socket: of the system in `state_dir`, or of the only running system.

    Raises:
        NotRunning: no system runs (in `state_dir`), or it has no console.
        UsageError: several systems of this user run; the error names them.
    """
    if state_dir is not None:
        found = consoles_in(Path(os.path.realpath(os.path.expanduser(state_dir))))
        if not found:
            raise NotRunning(
                f"{os.fspath(state_dir)}: no system with a console runs in this state directory; start it, or see "
                "`rr-actors inspect` for what its catalogs hold"
            )
        return found[0]
    running = running_systems()
    if not running:
        raise NotRunning(
            "no running system found for this user: start one (rr-actors run TREE.toml), or name its state "
            "directory with --state DIR or RR_STATE"
        )
    if len(running) > 1:
        names = ", ".join(sorted(str(run_dir.parent.parent) for run_dir in running))
        raise UsageError(f"several systems run: {names}; choose one with --state DIR or RR_STATE")
    return running[0]
