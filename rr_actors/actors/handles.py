"""Handles: calling the methods of a registrar in another process.

A link of kind "handle" carries calls by number; arguments and results travel by cloudpickle, between processes of one
system only, and are opened in workers, never on the loop. Calls run side by side.
"""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors import pickling
from rr_actors.actors.replies import Reply, fail
from rr_actors.directory import Status, registrar_key
from rr_actors.errors import RegistrarDown, RrError, Unavailable, UnknownRegistrar
from rr_actors.messages import Failure, error_of, failure_of
from rr_actors.transport import Attach, Hello, Link, Welcome

logger = logging.getLogger("rr_actors")

KIND = "handle"


class Call(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """Call a method; `body` has its arguments."""

    number: int
    method: str
    body: bytes


class Returned(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """What a call returned."""

    number: int
    body: bytes


class Raised(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """What a call raised."""

    number: int
    failure: Failure


HandleMessage = Call | Returned | Raised

METHODS = frozenset(
    {
        "children",
        "clients",
        "fetch_queries",
        "load",
        "load_catalog",
        "on_status",
        "owed",
        "queries",
        "register_stored",
        "resources",
        "save_catalog",
        "send_status",
        "servers",
        "stats",
        "unload",
        "unload_all",
        "unload_client",
        "unregister_server",
        "update_response",
    }
)


class Door:
    """The end of a handle's link where the registrar lives."""

    def __init__(self, node: Any, registrar: Any, _link: Link) -> None:
        self._node = node
        self._registrar = registrar

    def received(self, link: Link, message: Any) -> None:
        """Run the call in a worker and answer."""
        workers = self._node.dispatcher.workers

        def done(body: bytes, error: BaseException | None) -> None:
            answer = Returned(message.number, body) if error is None else Raised(message.number, failure_of(error))
            try:
                link.send(answer)
            except RrError as refusal:  # too long for a frame
                link.send(Raised(message.number, failure_of(refusal)))
            link.flush()

        try:
            workers.submit(self._call, message, done=done)
        except Unavailable as error:
            done(b"", error)

    def _call(self, message: Call) -> bytes:
        if message.method not in METHODS:
            raise Unavailable(f"registrar handle: no method {message.method!r}")
        args, kwargs = pickling.loads(message.body)
        return pickling.dumps(getattr(self._registrar, message.method)(*args, **kwargs), "result")

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Whoever called has gone; what runs goes on."""


class HandleLine:
    """The caller's end: calls methods of one registrar, wherever it is now."""

    def __init__(self, node: Any, registrar: str) -> None:
        self._node = node
        self._registrar = registrar
        self._link: Link | None = None
        self._calls: dict[int, Reply[Any]] = {}
        self._numbers = itertools.count(1)

    def call(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Reply[Any]:
        """Call a method; the reply is set with what it returned or raised. From any thread.

        Raises:
            NotSerializable: an argument cannot travel.
        """
        body = pickling.dumps((args, kwargs), f"{self._registrar}.{method}()")
        reply: Reply[Any] = Reply()
        self._node.dispatcher.call(self._begin, method, body, reply)
        return reply

    def _begin(self, method: str, body: bytes, reply: Reply[Any]) -> None:
        number = next(self._numbers)
        self._calls[number] = reply
        if self._link is not None:
            self._send(self._link, Call(number, method, body))
        else:
            self._node.dispatcher.loop.create_task(self._connect(Call(number, method, body)))

    async def _connect(self, call: Call) -> None:
        try:
            if self._link is None:
                address = self._where()
                hello = Hello(KIND, self._registrar, self._node.path, 0)
                link = await self._node.transport.connect(address, hello, self._attach)
                self._link = self._link or link
            assert self._link is not None
            self._send(self._link, call)
        except Exception as error:
            self._fail(call.number, error)

    def _attach(self, _link: Link) -> HandleLine:
        return self

    def _where(self) -> str:
        entry = self._node.directory.lookup(registrar_key(self._registrar))
        if entry is None:
            raise self._node.directory.no_registrar(self._registrar)
        if entry.status is not Status.UP:
            text = f"registrar {self._registrar!r}: {entry.status}"
            raise RegistrarDown(text, registrar=self._registrar, status=str(entry.status))
        return entry.address

    def _send(self, link: Link, call: Call) -> None:
        try:
            link.send(call)
            link.flush()
        except RrError as error:
            self._fail(call.number, error)

    def _fail(self, number: int, error: BaseException) -> None:
        reply = self._calls.pop(number, None)
        if reply is not None:
            fail(reply, error)

    def received(self, link: Link, message: Any) -> None:
        """An answer."""
        reply = self._calls.pop(message.number, None)
        if reply is None:
            return
        if isinstance(message, Returned):
            reply.set_unopened(functools.partial(pickling.loads, message.body))
        else:
            fail(reply, error_of(message.failure))

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Its process is gone, or the registrar closed: open calls fail."""
        if self._link is link:
            self._link = None
        down = RegistrarDown(
            f"registrar {self._registrar!r}: its process went away during the call",
            registrar=self._registrar,
            status="down",
        )
        for number in list(self._calls):
            self._fail(number, down)

    def close(self) -> None:
        """Let the link go. On the loop."""
        if self._link is not None:
            self._link.close()


def accept_handle(node: Any, find: Callable[[str], Any], hello: Hello) -> tuple[Welcome, Attach]:
    """Let a handle's link in.

    Raises:
        UnknownRegistrar: not in this process.
    """
    registrar = find(hello.to)
    if registrar is None:
        raise UnknownRegistrar(f"registrar {hello.to!r}: not in this process", registrar=hello.to)
    return Welcome(0), functools.partial(Door, node, registrar)
