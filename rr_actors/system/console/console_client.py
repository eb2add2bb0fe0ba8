"""The console's client: plain and synchronous, for any program of the same user. No part of a system runs in it."""

from __future__ import annotations

import contextlib
import os
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

from rr_actors.base.errors import ConfigError, Unavailable, UsageError
from rr_actors.registrar.model.messages import error_of
from rr_actors.system.console.console_messages import (
    ANSWER_LIMIT_BYTES,
    PAGE_LIMIT,
    REQUEST_LIMIT_BYTES,
    SOCKET,
    VERSION,
    Answer,
    BeginRecording,
    Children,
    Entries,
    Events,
    Follow,
    Following,
    Hello,
    Holding,
    Keep,
    ListChildren,
    ListQueries,
    ListRegistrars,
    ListResources,
    Missed,
    PageRequest,
    Queries,
    Refused,
    Registrars,
    Request,
    Resources,
    Welcome,
)
from rr_actors.system.console.running_systems import consoles_in, running_systems
from rr_actors.wire.frames import FrameReader, framed
from rr_actors.wire.unix_sockets import SocketDir, peer_at

_A = TypeVar("_A")
_Page = TypeVar("_Page", Children, Registrars, Resources, Queries)
_GREETING_S = 5.0
_RETRY_S = 0.01
_IDLE = 8  # connections that are kept for the next call

_here: weakref.WeakSet[Connections] = weakref.WeakSet()


class ConsoleClient:
    """A connection to the console of a running system. For one thread; as a context manager it is closed at the end.

    Args:
        run_dir: the directory of the console's socket, as find_console() returns it.
        timeout_s: seconds that an answer may take.

    Attributes:
        welcome: the console's answer to Hello, which names the system.
        is_broken: whether the connection must not be kept for another call: the last answer did not come, or is a
            Holding without its keep() yet, or a Refused, after which the console may close the connection.

    Raises:
        NotRunning: no console answers in run_dir.
        Unavailable: the console is another user's, or speaks another version.
    """

    def __init__(self, run_dir: Path, *, timeout_s: float = 60.0) -> None:
        self.run_dir = run_dir
        self.timeout_s = timeout_s
        self._socket = _connected(run_dir)
        self._frames = FrameReader(msgspec.msgpack.Decoder(Answer), ANSWER_LIMIT_BYTES)
        self._answers: deque[Answer] = deque()
        self.is_broken = False
        try:
            self.welcome = self.ask(Hello(VERSION), Welcome, _GREETING_S)
        except BaseException:
            self.close()
            raise

    def ask(self, request: Request, expected: type[_A], timeout_s: float | None = None) -> _A:
        """Send a request and return its answer, which is of the type `expected`.

        Args:
            timeout_s: seconds that the answer may take; None: the client's own limit.

        Raises:
            RrError: the system refused the request, or could not carry it out.
            NotRunning: the system has ended.
            Unavailable: no answer came in time; the system may carry out the request all the same.
        """
        self.is_broken = True
        self._send(request)
        answer = self._receive(self.timeout_s if timeout_s is None else timeout_s)
        self.is_broken = isinstance(answer, Holding | Refused)
        return _checked(answer, expected)

    def keep(self) -> None:
        """Say that the query of the last Holding has arrived; otherwise the end of the connection releases it."""
        self._send(Keep())
        self.is_broken = False

    def children(self) -> Children:
        """Return all children of the tree, read page by page."""
        return self._all(ListChildren(), Children)

    def registrars(self) -> Registrars:
        """Return all registrars, read page by page."""
        return self._all(ListRegistrars(), Registrars)

    def resources(self, registrar: str = "", match: str = "", limit: int = sys.maxsize) -> Resources:
        """Return the resources of a registrar, or of all, that ListResources(match) finds; at most `limit`."""
        return self._all(ListResources(match, registrar=registrar), Resources, limit)

    def queries(self, registrar: str = "", match: str = "", limit: int = sys.maxsize) -> Queries:
        """Return the queries that a registrar holds, or all, that ListQueries(match) finds; at most `limit`."""
        return self._all(ListQueries(match, registrar=registrar), Queries, limit)

    def _all(self, request: PageRequest, expected: type[_Page], limit: int = sys.maxsize) -> _Page:
        """Return the rows of all pages, at most `limit`, with the notes of all pages."""
        rows: list[Any] = []
        notes: dict[str, None] = {}
        while True:
            left = max(1, min(limit - len(rows), PAGE_LIMIT))
            page = self.ask(msgspec.structs.replace(request, offset=len(rows), limit=left), expected)
            rows += page.rows
            if isinstance(page, Resources | Queries):
                notes.update(dict.fromkeys(page.notes))
            if not page.rows or len(rows) >= min(page.total, limit):
                more = {"notes": list(notes)} if notes else {}
                return msgspec.structs.replace(page, rows=rows[:limit], **more)

    def follow(self, follow: Follow) -> Iterator[Events | Missed]:
        """Yield the events from now on, until the system ends. The connection has no other use after that.

        A Missed has the number of events that this reader was too slow for, and the first page of the tree now.

        Raises:
            RrError: the system refused the request.
        """
        return self._parts(follow)

    def record(self) -> Iterator[Entries]:
        """Yield the recorded entries from now on, as follow() does. `dropped` has those that this reader missed, too.

        Raises:
            RrError: the system refused the request.
        """
        parts = self._parts(BeginRecording())
        return (Entries([], part.count) if isinstance(part, Missed) else part for part in parts)

    def _parts(self, request: Follow | BeginRecording) -> Iterator[Any]:
        self._send(request)
        _checked(self._receive(self.timeout_s), Following)
        return self._fed()

    def _fed(self) -> Iterator[Any]:
        while True:
            try:
                answer = self._receive(None)
            except NotRunning:
                return
            if isinstance(answer, Refused):
                raise error_of(answer.failure)
            yield answer

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

    def _send(self, request: Request) -> None:
        frame = framed(request, REQUEST_LIMIT_BYTES, "the longest request of a console")
        try:
            self._socket.settimeout(self.timeout_s)
            self._socket.sendall(frame)
        except TimeoutError as error:
            raise Unavailable(f"{self._who()} does not read what it is sent") from error
        except OSError:
            return  # the console has refused the connection: its answer is read next

    def _receive(self, timeout_s: float | None) -> Answer:
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._answers:
            try:
                self._socket.settimeout(None if deadline is None else max(0.001, deadline - time.monotonic()))
                data = self._socket.recv(2**18)
            except TimeoutError as error:
                raise Unavailable(f"{self._who()} has not answered within {timeout_s:g} s") from error
            except OSError as error:
                raise NotRunning(f"{self._who()} has ended: {error.strerror}") from error
            if not data:
                raise NotRunning(f"{self._who()} has ended, or closed the connection")
            self._answers += self._frames.feed(data)
            if self._frames.error is not None and not self._answers:
                raise Unavailable(f"{self._who()} said something else than answers: {self._frames.error}")
        return self._answers.popleft()

    def _who(self) -> str:
        return f"the system in {self.run_dir.parent.parent}"


class NotRunning(Unavailable):
    """No running system was reached, or the system has ended."""


def _checked(answer: Answer, expected: type[_A]) -> _A:
    if isinstance(answer, Refused):
        raise error_of(answer.failure)
    if not isinstance(answer, expected):
        raise Unavailable(f"console: expected {expected.__name__}, got {type(answer).__name__}")
    return answer


def _connected(run_dir: Path) -> socket.socket:
    sockets = SocketDir(run_dir)
    deadline = time.monotonic() + _GREETING_S
    try:
        while True:
            try:
                connected = sockets.connect(SOCKET)
                break
            except BlockingIOError as error:  # too many connections wait to be accepted
                if time.monotonic() > deadline:
                    raise Unavailable(f"{run_dir}: the system's console accepts no connections") from error
                time.sleep(_RETRY_S)
            except (OSError, ConfigError) as error:
                why = getattr(error, "strerror", None) or error
                raise NotRunning(f"{run_dir / SOCKET}: no system listens there ({why})") from error
    finally:
        sockets.close()
    if not (peer := peer_at(connected)).trusted:
        connected.close()
        raise Unavailable(f"{run_dir / SOCKET}: expected a system of user {os.geteuid()}, got one of user {peer.uid}")
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
        with self._lock:
            kept = self._idle.pop() if self._idle else None
        client = kept or self.open()
        try:
            yield client
        except NotRunning:  # the system has ended, and the idle connections with it
            with self._lock:
                idle, self._idle = self._idle, []
            for other in idle:
                other.close()
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

    def _give_back(self, client: ConsoleClient) -> None:
        with self._lock:
            kept = not client.is_broken and not self._closed and len(self._idle) < _IDLE
            if kept:
                self._idle.append(client)
        if not kept:
            client.close()


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
            "no running system of this user is listed: start one (rr-actors run TREE.toml), or name its state "
            "directory with --state DIR or RR_STATE"
        )
    if len(running) > 1:
        names = ", ".join(sorted(str(run_dir.parent.parent) for run_dir in running))
        raise UsageError(f"several systems run: {names}; choose one with --state DIR or RR_STATE")
    return running[0]
