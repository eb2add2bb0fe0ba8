"""Handles: calling the methods of a registrar in another process.

A link of kind "handle" carries numbered calls. Arguments and results travel by cloudpickle, between processes of one
system only. They are unpickled by workers or callers, never on the loop. Calls run side by side. A call waits a while
for a registrar that is being started or respawned. If the process dies during a call, only a call that changes nothing
is sent again.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import msgspec

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base import pickling
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import MailboxFull, RegistrarDown, RrError, Unavailable, UnknownRegistrar
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.runtime.callback_errors import Raised, described
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.wire.name_service import Directory, Presence, registrar_key
from rr_actors.wire.transport import Hello, Link, NotAnswering, Transport
from rr_actors.wire.unix_sockets import paused

logger = Log("rr_actors")

KIND = "handle"


class CallMethod(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """Call a method; `body` has its arguments. Its `timeout_s` is shortened by `late_s`, its wait to be sent."""

    number: int
    method: str
    body: bytes
    late_s: float = 0.0


class Returned(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """The result of a call, or a part of it, if it does not fit a frame; then `more` parts follow."""

    number: int
    body: bytes
    more: bool = False


class CallRaised(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """The error of a call."""

    number: int
    failure: Failure


HandleMessage = CallMethod | Returned | CallRaised

_repeatable: dict[str, bool] = {}
"""The methods of a Registrar that a handle may call; whether each may be called again if the process dies meanwhile."""

F = TypeVar("F", bound=Callable[..., Any])


def for_handles(*, repeatable: bool) -> Callable[[F], F]:
    """Declare a method of a Registrar as one that a handle calls in the registrar's process.

    Args:
        repeatable: the method changes nothing and runs no code of users, so a call is sent again if the process dies
            during it.
    """

    def declare(method: F) -> F:
        _repeatable[method.__name__] = repeatable
        return method

    return declare


def is_for_handles(name: str) -> bool:
    """Return whether a handle may call the method of this name."""
    return name in _repeatable


def is_repeatable(name: str) -> bool:
    """Return whether a call of the method is sent again if the process dies during it."""
    return _repeatable.get(name, False)


_RETRY_S = 0.01  # a look at the directory takes 2 µs
GRACE_S = 10.0
"""Seconds after a time limit until the other process has to have said how the call ended: it may have stood still."""


class LinkHost(Protocol):
    """What both ends of a handle's link use of their process (hosting/node.py)."""

    dispatcher: Dispatcher
    config: SystemConfig
    directory: Directory
    path: str

    @property
    def transport(self) -> Transport:
        """The links to other processes."""
        ...


class Door:
    """The end of a handle's link where the registrar lives."""

    def __init__(self, node: LinkHost, registrar: object, _link: Link) -> None:
        self._node = node
        self._registrar = registrar
        self._calling = described(self._call, "a handle's call", failure_of)

    def received(self, link: Link, message: CallMethod) -> None:
        """Run the call in a worker and send its answer."""
        workers = self._node.dispatcher.workers

        def done(body: bytes, error: BaseException | None) -> None:
            if error is None:
                self._send_parts(link, message.number, memoryview(body))
            else:
                own = error.details if type(error) is Raised else failure_of(error)
                self._send_error(link, CallRaised(message.number, own))

        try:
            workers.submit(self._calling, message, done=done)
        except Unavailable as error:
            done(b"", error)

    def _call(self, message: CallMethod) -> bytes:
        if not is_for_handles(message.method):
            raise Unavailable(f"registrar handle: no method {message.method!r}")
        args, kwargs = pickling.loads(message.body)
        if message.late_s and kwargs.get("timeout_s") is not None:
            kwargs["timeout_s"] = max(0.0, kwargs["timeout_s"] - message.late_s)
        return pickling.dumps(getattr(self._registrar, message.method)(*args, **kwargs), "result")

    def _send_parts(self, link: Link, number: int, left: memoryview) -> None:
        """Send as much of a call's result as the link takes now, and the rest every 10 ms."""
        size = max(1, self._node.config.frame_limit_bytes // 2)
        try:
            while len(left) > size:
                link.send(Returned(number, bytes(left[:size]), more=True))
                left = left[size:]
            link.send(Returned(number, bytes(left)))
        except MailboxFull:  # the caller must read a part of it first
            self._node.dispatcher.loop.call_later(_RETRY_S, self._send_parts, link, number, left)
        link.flush()

    def _send_error(self, link: Link, error: CallRaised) -> None:
        """Send a call's error, if need be every 10 ms until the link takes it."""
        try:
            link.send(error)
        except MailboxFull:
            self._node.dispatcher.loop.call_later(_RETRY_S, self._send_error, link, error)
        link.flush()

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Do nothing when the caller is gone: its calls run to their end."""


class _Coming(Exception):
    """The registrar is not up yet, but will be. When the caller's patience ends, it gets `error`."""

    def __init__(self, error: RrError) -> None:
        super().__init__(str(error))
        self.error = error


class _Open(msgspec.Struct):
    """A call that was sent: the future of its answer, and the parts that have arrived."""

    method: str
    answer: asyncio.Future[bytes]
    parts: list[bytes] = msgspec.field(default_factory=list[bytes])


class HandleLine:
    """The caller's end of a handle's link. It calls methods of one registrar, in whatever process that is now."""

    def __init__(self, node: LinkHost, registrar: str) -> None:
        self._node = node
        self._registrar = registrar
        self._link: Link | None = None
        self._dialing = asyncio.Lock()
        self._calls: set[asyncio.Task[None]] = set()
        self._open: dict[int, _Open] = {}
        self._numbers = itertools.count(1)
        self._closed = False

    def call(
        self,
        method: str,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        patience_s: float | None = 0.0,
        reply: Reply[Any] | None = None,
        limit_s: float | None = None,
    ) -> Reply[Any]:
        """Call a method. The reply gets its result or error. From any thread.

        It waits `patience_s` seconds for a registrar that is being started or respawned; None: without limit. A moment
        after `limit_s` seconds the reply gets Unavailable, and what the method returns later is dropped; None: never. A
        caller that gives the reply has it also when the call is interrupted.

        Raises:
            NotSerializable: an argument cannot be pickled.
        """
        body = pickling.dumps((args, kwargs), f"{self._registrar}.{method.lstrip('_')}()")
        reply = Reply() if reply is None else reply
        self._node.dispatcher.call(self._begin, method, body, reply, patience_s, limit_s)
        return reply

    def _begin(
        self, method: str, body: bytes, reply: Reply[Any], patience_s: float | None, limit_s: float | None
    ) -> None:
        task = self._node.dispatcher.loop.create_task(self._call(method, body, reply, patience_s, limit_s))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    async def _call(
        self, method: str, body: bytes, reply: Reply[Any], patience_s: float | None, limit_s: float | None
    ) -> None:
        limit = asyncio.timeout(None if limit_s is None else limit_s + GRACE_S)
        try:
            async with limit:
                result = await self._result(method, body, patience_s)
        except asyncio.CancelledError:
            fail(reply, self._down("stopped"))
        except Exception as error:
            fail(reply, self.overdue(limit_s) if limit.expired() else error)
        else:
            reply.set_unopened(functools.partial(pickling.loads, result))
        finally:
            del reply  # the error has a traceback with this frame

    async def _result(self, method: str, body: bytes, patience_s: float | None) -> bytes:
        """Call the method. Try again while the registrar is not up yet and the caller is patient.

        Raises:
            RrError: the error of the method, or why it was not called.
        """
        loop = asyncio.get_running_loop()
        since = loop.time()
        while True:
            try:
                link = await self._linked()
                return await self._answer(link, method, body, loop.time() - since)
            except _Coming as why:
                error = why.error
            if patience_s is not None and loop.time() - since >= patience_s:
                raise error
            await asyncio.sleep(_RETRY_S)

    async def _answer(self, link: Link, method: str, body: bytes, late_s: float) -> bytes:
        number = next(self._numbers)
        call = self._open[number] = _Open(method, asyncio.get_running_loop().create_future())
        try:
            link.send(CallMethod(number, method, body, late_s if late_s >= _RETRY_S else 0.0))
            link.flush()
            return await call.answer
        finally:
            del self._open[number], call  # the error has a traceback with this frame

    async def _linked(self) -> Link:
        """Return the link, and open it first if there is none.

        Raises:
            _Coming: the registrar is not up yet, but will be.
            RrError: the registrar is not up, and will not be.
        """
        async with self._dialing:
            if self._closed:
                raise self._down("stopped")
            if self._link is None:
                address = self._where()
                hello = Hello(KIND, self._registrar, self._node.path, 0)
                try:
                    self._link = await self._node.transport.connect(address, hello, self._attach)
                except NotAnswering as error:
                    text = f"registrar {self._registrar!r}: its process does not answer{self.paused()}"
                    raise _Coming(Unavailable(text)) from error
                except (Unavailable, UnknownRegistrar) as error:  # its process has just died, or does not serve it yet
                    raise _Coming(error) from error
            assert self._link is not None
            return self._link

    def _attach(self, _link: Link) -> HandleLine:
        return self

    def _where(self) -> str:
        entry = self._node.directory.lookup(registrar_key(self._registrar))
        if entry is None:
            raise self._node.directory.no_registrar(self._registrar)
        if entry.status is Presence.STARTING:
            raise _Coming(self._down(entry.status))
        if entry.status is not Presence.UP:
            raise self._down(entry.status, entry.because)
        return entry.address

    def overdue(self, limit_s: float | None) -> Unavailable:
        """Return the error that no answer came within the time limit of a call."""
        return Unavailable(f"registrar {self._registrar!r}: no answer within {limit_s:g} s{self.paused()}")

    def paused(self) -> str:
        """Return words, "; it is ...", for an error if a signal has stopped the registrar's process; "" else."""
        entry = self._node.directory.lookup(registrar_key(self._registrar))
        why = "" if entry is None else paused(entry.address)
        return why and f"; it is {why}"

    def _down(self, status: str, because: str = "") -> RegistrarDown:
        text = f"registrar {self._registrar!r}: {status}{because}"
        return RegistrarDown(text, registrar=self._registrar, status=str(status))

    def received(self, link: Link, message: Returned | CallRaised) -> None:
        """Note an answer, or a part of one, for its call."""
        call = self._open.get(message.number)
        if call is None or call.answer.done():
            return
        if isinstance(message, CallRaised):
            call.answer.set_exception(error_of(message.failure))
            return
        call.parts.append(message.body)
        if not message.more:
            call.answer.set_result(b"".join(call.parts))

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Fail the open calls, as the process or the registrar is gone. Calls that change nothing are sent again."""
        if self._link is link:
            self._link = None
        text = f"registrar {self._registrar!r}: its process went away during the call"
        for call in self._open.values():
            error = RegistrarDown(text, registrar=self._registrar, status="down")
            if not call.answer.done():
                call.answer.set_exception(_Coming(error) if is_repeatable(call.method) else error)

    def close(self) -> None:
        """Close the link and cancel all calls. On the loop."""
        self._closed = True
        if self._link is not None:
            self._link.close()
        for call in list(self._calls):
            call.cancel()
