"""Links within one process: the event loop hands over the message objects themselves, a batch at a time.

A Receiver is never called from within the `send` or `flush` of another: the loop delivers each flush by a later call.
"""

from __future__ import annotations

import asyncio
import os
from typing import Any

from rr_actors.base.errors import RrError, Unavailable, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import error_of, failure_of
from rr_actors.wire.transport import Accept, Attach, Hello, Link, Receiver, Welcome

_log = Log(__name__)


class LocalTransport:
    """A Transport that reaches itself alone: both ends of each link are in this process."""

    address = "local"

    def __init__(self) -> None:
        self._accept: Accept | None = None
        self._closed = False
        self._links: set[LocalLink] = set()

    async def listen(self, accept: Accept) -> None:
        if self._accept is not None or self._closed:
            raise UsageError(f"transport {self.address}: listens already, or is closed")
        self._accept = accept

    async def connect(self, address: str, hello: Hello, attach: Attach) -> Link:
        if self._closed:
            raise Unavailable(f"cannot connect to {hello.to}: this transport is closed")
        if address != self.address or self._accept is None:
            raise Unavailable(f"nobody listens for {hello.to} at {address}")
        try:
            welcome, attach_far = self._accept(hello)
            near = LocalLink(self._links, hello, welcome, hello.to)
            far = LocalLink(self._links, hello, welcome, hello.origin)
            near.other, far.other = far, near
            far.attach(attach_far)
        except RrError:
            raise
        except Exception as error:
            _log.exception("refusing a link of %s (this process): accepting it failed", hello.origin)
            raise error_of(failure_of(error)) from error
        try:
            near.attach(attach)
        except BaseException:
            far.close()
            raise
        return near

    async def close(self) -> None:
        self._closed = True
        links = [*self._links]
        for link in links:
            link.close()
        for link in links:
            await link.closed.wait()


class LocalLink:
    """A Link within one process: one end of it; `other` is the other end."""

    more = False
    behind = False
    other: LocalLink

    def __init__(self, links: set[LocalLink], hello: Hello, welcome: Welcome, peer: str) -> None:
        """Make one end of the link; it is in `links` while it is open."""
        self.hello = hello
        self.welcome = welcome
        self.peer = f"{peer} (this process)"
        self.pid = os.getpid()
        self.closed = asyncio.Event()
        self._links = links
        self._loop = asyncio.get_running_loop()
        self._outbox: list[Any] = []
        self._open = True
        self._receiver: Receiver | None = None

    def attach(self, attach: Attach) -> None:
        """Set the receiver of the link; from now on the link calls its `lost` at the end."""
        self._receiver = attach(self)
        self._links.add(self)

    def send(self, message: Any) -> None:
        if self._open:
            self._outbox.append(message)

    def flush(self) -> None:
        if self._outbox:
            batch, self._outbox = self._outbox, []
            self._loop.call_soon(self.other.deliver, batch)

    def send_now(self, message: Any) -> None:
        self.send(message)
        self.flush()

    def close(self) -> None:
        """Send the queued messages and close; when they have arrived, `lost` is called at both ends."""
        self._close(None)

    def _close(self, reason: Exception | None) -> None:
        if self._open:
            self.flush()
            self._open = False
            self._loop.call_soon(self.other.lose, reason)
            self._loop.call_soon(self.lose, reason)

    def deliver(self, batch: list[Any]) -> None:
        """Hand the receiver a batch of messages from the other end."""
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

    def lose(self, reason: Exception | None) -> None:
        """Call `lost` of the receiver, unless it was called before."""
        self._open = False
        if self.closed.is_set():
            return
        self.closed.set()
        self._links.discard(self)
        if self._receiver is not None:
            try:
                self._receiver.lost(self, reason)
            except Exception:
                _log.exception("the receiver of the link with %s failed when it was lost", self.peer)
