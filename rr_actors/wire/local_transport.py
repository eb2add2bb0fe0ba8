"""Links within one process: the message objects themselves, handed over by the loop, a batch at a time.

A Receiver is never called from within another's `send` or `flush`: each flush becomes one call the loop makes later.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import MutableMapping
from typing import Any

from rr_actors.base.errors import MailboxFull, RrError, Unavailable, UsageError
from rr_actors.registrar.model.messages import error_of, failure_of
from rr_actors.wire.transport import Accept, Attach, Hello, Link, Receiver, Welcome

_log = logging.getLogger(__name__)

BUFFER_LIMIT = 1_000_000
"""How many messages may wait on a link: they are handed over when the loop turns, so only a runaway gets there."""

_BEHIND = 100


class LocalTransport:
    """A Transport inside one process; it reaches the transports that share its `space`, itself in any case.

    Args:
        name: its address.
        space: the transports by address. None: a space of its own.
        buffer_limit: how many messages may wait on one link.
    """

    def __init__(
        self,
        name: str = "local",
        space: MutableMapping[str, LocalTransport] | None = None,
        *,
        buffer_limit: int = BUFFER_LIMIT,
    ) -> None:
        self.address = name
        self._space: MutableMapping[str, LocalTransport] = {} if space is None else space
        self._closed = False
        self.accept: Accept | None = None
        self.buffer_limit = buffer_limit
        self.links: set[LocalLink] = set()

    async def listen(self, accept: Accept) -> None:
        if self.address in self._space or self._closed:
            raise UsageError(f"transport {self.address}: somebody listens there already, or it is closed")
        self.accept = accept
        self._space[self.address] = self

    async def connect(self, address: str, hello: Hello, attach: Attach) -> Link:
        if self._closed:
            raise Unavailable(f"cannot connect to {hello.to}: this transport is closed")
        there = self._space.get(address)
        if there is None or there.accept is None:
            raise Unavailable(f"nobody listens for {hello.to} at {address}")
        near, far = self._open(there, there.accept, hello)
        try:
            near.attach(attach)
        except BaseException:
            far.close()
            raise
        return near

    def dial(self, address: str, hello: Hello, timeout_s: float) -> None:
        """Do nothing: within one process there is nothing to connect to."""

    def _open(self, there: LocalTransport, accept: Accept, hello: Hello) -> tuple[LocalLink, LocalLink]:
        try:
            welcome, attach = accept(hello)
            near = LocalLink(self, hello, welcome, hello.to)
            far = LocalLink(there, hello, welcome, hello.origin)
            near.other, far.other = far, near
            far.attach(attach)
        except RrError:
            raise
        except Exception as error:
            _log.exception("refusing a link of %s (this process): accepting it failed", hello.origin)
            raise error_of(failure_of(error)) from error
        return near, far

    async def close(self) -> None:
        self._closed = True
        if self._space.get(self.address) is self:
            del self._space[self.address]
        links = [*self.links]
        for link in links:
            link.close()
        for link in links:
            await link.closed.wait()


class LocalLink:
    """A Link within one process: one end of it; `other` is the other end."""

    local = True
    more = False
    other: LocalLink

    def __init__(self, owner: LocalTransport, hello: Hello, welcome: Welcome, peer: str) -> None:
        self.hello = hello
        self.welcome = welcome
        self.peer = f"{peer} (this process)"
        self.closed = asyncio.Event()
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        self._outbox: list[Any] = []
        self._in_flight = 0  # flushed, and not yet handed over
        self._open = True
        self._receiver: Receiver | None = None

    def attach(self, attach: Attach) -> None:
        """Give it its receiver; from then on it will hear `lost`."""
        self._receiver = attach(self)
        self._owner.links.add(self)

    @property
    def behind(self) -> bool:
        return self._in_flight > _BEHIND

    def send(self, message: Any) -> None:
        if not self._open:
            return
        if len(self._outbox) + self._in_flight >= self._owner.buffer_limit:
            limit = self._owner.buffer_limit
            raise MailboxFull(
                f"{limit} messages wait for {self.peer}, the limit: let the loop turn", name=self.peer, limit=limit
            )
        self._outbox.append(message)

    def flush(self) -> None:
        if self._outbox:
            batch, self._outbox = self._outbox, []
            self._in_flight += len(batch)
            self._loop.call_soon(self.other.deliver, batch)

    def send_now(self, message: Any) -> None:
        self.send(message)
        self.flush()

    def open_outlet(self) -> None:
        """Do nothing: there is no descriptor to answer by."""

    def answering(self, message: Any) -> None:
        return

    def close(self) -> None:
        """Send what is queued and close; both ends hear `lost` when it has arrived."""
        self._close(None)

    def _close(self, reason: Exception | None) -> None:
        if self._open:
            self.flush()
            self._open = False
            self._loop.call_soon(self.other.lose, reason)
            self._loop.call_soon(self.lose, reason)

    def deliver(self, batch: list[Any]) -> None:
        """Take a batch of the other end."""
        self.other.batch_delivered(len(batch))
        if self._receiver is None:
            return
        received = self._receiver.received
        left = len(batch)
        for message in batch:
            if not self._open:
                return
            left -= 1
            self.more = left > 0
            try:
                received(self, message)
            except Exception as error:
                _log.exception("closing the link with %s: its receiver failed on %s", self.peer, type(message).__name__)
                self._close(error)

    def batch_delivered(self, count: int) -> None:
        """What this end flushed has arrived."""
        self._in_flight -= count

    def lose(self, reason: Exception | None) -> None:
        """Tell the receiver, once."""
        self._open = False
        if self.closed.is_set():
            return
        self.closed.set()
        self._owner.links.discard(self)
        if self._receiver is not None:
            try:
                self._receiver.lost(self, reason)
            except Exception:
                _log.exception("the receiver of the link with %s failed when it was lost", self.peer)
