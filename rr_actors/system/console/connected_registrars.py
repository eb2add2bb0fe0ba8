"""Registrars of connected programs: opened in the application's process, as long as the program is connected.

Each belongs to one socket. The kernel closes the socket when the program ends, however it ends. Then the
registrar is closed, and its queries are released. In the system it is called "connection.NAME". The system's next start
gives up those that a killed application left.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol

from rr_actors.base.errors import NameTaken, RrError, UnknownQuery, UnknownRegistrar, shown
from rr_actors.base.names import CONNECTED
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status, when_over
from rr_actors.registrar.registrar import Registrar, news
from rr_actors.system.console.console_messages import RESPONSE_LIMIT_BYTES, Dropped, Heard

logger = Log("rr_actors")


_BATCH_BYTES = 2**20  # of the messages and responses in one answer, which is complete with the one that reaches them
_SHORT = 10_000  # characters of a message
_CLOSED_S = 10.0  # so long a name may wait for the end of the registrar before


class Caller(Protocol):
    """The socket by which a request came. What a connected program opens lives as long.

    Attributes:
        program: what all sockets of one connection (rr.connect()) have in common.
        pid: the id of the program's process.
    """

    program: object
    pid: int

    @property
    def is_gone(self) -> bool:
        """Whether the program has left. From any thread."""
        ...


class OpenedRegistrar:
    """A registrar of one connected program, and the statuses that the program has not heard yet. From any thread."""

    def __init__(self, owner: Caller, registrar: Registrar) -> None:
        self.owner = owner
        self.registrar = registrar
        self._lock = threading.Lock()
        self._unheard: deque[tuple[Heard | Dropped, Callable[[], object]]] = deque()  # one status of each query
        self._ended = False
        self._arrived: Callable[[], None] | None = None

    async def hear(self, status: Status) -> None:
        """Keep a status until the program has it, as the callback of each of its loads: the next of the query waits."""
        response, released = news(self.registrar, status.query_id)
        if status.state is not State.UPDATE or (response is not None and len(response) > RESPONSE_LIMIT_BYTES):
            response = None
        about = status.query_id, status.resource_id, str(status.state), status.message[:_SHORT], status.source
        why = status.repeated, status.reason, status.deadline_s
        taken = asyncio.Event()
        take = functools.partial(asyncio.get_running_loop().call_soon_threadsafe, taken.set)
        if self._add(Heard(*about, *why, response, released), take):
            await taken.wait()

    def watch(self, query: Query, node: Node) -> None:
        """Have the program hear when its query is released, also if it is not the program that releases it.

        If its provider takes the query away, its last status says so. If the system stops, the end of the connection
        does.
        """

        def over() -> None:
            if not (query.released or node.stopping):
                self._add(Dropped(query.id), lambda: None)

        when_over(query, over)

    def _add(self, news: Heard | Dropped, take: Callable[[], object]) -> bool:
        with self._lock:
            if self._ended:
                return False
            self._unheard.append((news, take))
            arrived, self._arrived = self._arrived, None
        if arrived is not None:
            arrived()
        return True

    def has_unheard(self, arrived: Callable[[], None]) -> bool:
        """Return whether statuses wait for the program; if none does, have `arrived` called once when one arrives."""
        with self._lock:
            self._arrived = None if self._unheard else arrived
            return bool(self._unheard)

    def take(self) -> list[Heard | Dropped]:
        """Return statuses that wait, as many as one answer has room for."""
        taken: list[Heard | Dropped] = []
        left = _BATCH_BYTES
        with self._lock:
            while self._unheard and left > 0:
                heard, take = self._unheard.popleft()
                taken.append(heard)
                left -= len(heard.message) + len(heard.response or b"") if isinstance(heard, Heard) else 0
                with contextlib.suppress(RuntimeError):  # the user loop has ended: the process is stopping
                    take()
        return taken

    def end(self) -> None:
        """Drop the statuses that wait, and all later ones, as the program has gone."""
        with self._lock:
            self._ended = True
        while self.take():
            pass


class ConnectedRegistrars:
    """The registrars of the connected programs of one system. In workers, except has_statuses()."""

    def __init__(self) -> None:
        self._lock = threading.Condition()
        self._open: dict[str, OpenedRegistrar] = {}
        self._closing: set[str] = set()

    def open(self, owner: Caller, name: str, open: Callable[[str], Registrar]) -> None:
        """Open a registrar for a program, until that ends. One whose program has left is waited for.

        Raises:
            NameTaken: another connection has this name.
        """
        try:
            registrar = open(name)
        except NameTaken:
            if not self._have_left(name):
                raise
            registrar = open(name)
        with self._lock:
            self._open[name] = OpenedRegistrar(owner, registrar)

    def _have_left(self, name: str) -> bool:
        """Wait until the registrar of a program that has left is closed. Return False if its program is here."""
        with self._lock:
            opened = self._open.get(name)
            if opened is not None and not opened.owner.is_gone:
                return False
            return self._lock.wait_for(lambda: not (name in self._open or name in self._closing), _CLOSED_S)

    def close(self, owner: object) -> None:
        """Close the registrars of a program that has left, and release what they hold."""
        with self._lock:
            mine = [name for name, opened in self._open.items() if opened.owner is owner]
            closing = [self._open.pop(name) for name in mine]
            self._closing.update(mine)
        for opened in closing:
            opened.end()
            registrar = opened.registrar
            try:
                registrar.close()
                logger.info("registrar %s: closed, as its program has gone", registrar.name)
            except Exception:  # a provider's error, or a defect: go on with the others
                logger.exception(
                    "registrar %s: its program has gone, and not all that it held is released", registrar.name
                )
            finally:
                with self._lock:
                    self._closing.discard(registrar.name)
                    self._lock.notify_all()

    def has_statuses(self, registrar: str, owner: object, arrived: Callable[[], None]) -> bool:
        """Return whether AwaitStatuses has an answer; if not, have `arrived` called, from any thread, once it has."""
        with self._lock:
            opened = self._open.get(registrar)
        return opened is None or opened.owner is not owner or opened.has_unheard(arrived)

    def release_unheard(self, registrar: str, query_id: str) -> None:
        """Release a query of a program that left before it kept the query."""
        try:
            self.named(registrar).registrar.unload(query_id)
        except (UnknownQuery, UnknownRegistrar):
            logger.debug("query %s: released by its program or with its registrar", query_id)
        except RrError:
            logger.exception("query %s: its program has gone, and it is not released", query_id)

    def asking(self, caller: Caller, name: str) -> str:
        """Return the name by which a program asks: of a registrar that it has opened, or with "" that of its process.

        Raises:
            UnknownRegistrar: it has not opened the registrar.
        """
        if not name:
            return f"{CONNECTED}pid-{caller.pid}"
        if self.named(name).owner.program != caller.program:
            raise UnknownRegistrar(f"registrar {shown(name)}: another connection has opened it", registrar=name)
        return name

    def named(self, name: str, owner: object = None) -> OpenedRegistrar:
        """Return a program's registrar; with `owner`, only if this socket has opened it.

        Raises:
            UnknownRegistrar: no connection has opened it, or it has ended.
        """
        with self._lock:
            opened = self._open.get(name)
        if opened is None or owner not in (None, opened.owner):
            text = f"registrar {shown(name)}: no connection has opened it, or it has ended"
            raise UnknownRegistrar(text, registrar=name)
        return opened
