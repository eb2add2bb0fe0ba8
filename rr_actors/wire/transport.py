"""Transport: the contract of how messages reach another actor. Implementations stand beside it; one contract test
suite runs over all.

A link is one connection between two sides; the side that wants something opens it. Guarantees: messages arrive whole,
in the order they were sent, each at most once. When a link is lost, the last messages may or may not have arrived.
`lost` is called exactly once on each side, after all messages that did arrive. The sender may send again on a new link.

All but an Exchange runs on the process's event loop. No Receiver is called from within the `send`, `flush` or `close`
of another one. Obligations: after one or more `send`, call `flush` before returning to the loop; a Receiver must not
block; close the transport before the loop ends, or no Receiver hears `lost`. A Receiver that raises loses its link.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from rr_actors.base.errors import Unavailable


class Hello(msgspec.Struct, frozen=True, array_like=True):
    """The first message of the side that opens a link: its purpose, the receiver, the sender and its incarnation."""

    kind: str  # "registrar", "direct" or "actors"
    to: str
    origin: str
    epoch: int


class Welcome(msgspec.Struct, frozen=True, array_like=True):
    """The answer to Hello: the incarnation of the side that answers."""

    epoch: int


class Link(Protocol):
    """One open connection."""

    hello: Hello
    welcome: Welcome

    @property
    def pid(self) -> int:
        """The id of the process at the other end; 0 if it is not known."""
        ...

    @property
    def more(self) -> bool:
        """Whether another message, which arrived together with the current one, follows it at once."""
        ...

    @property
    def peer(self) -> str:
        """The name of the other end, for people: "cameras (pid 4711)"."""
        ...

    @property
    def behind(self) -> bool:
        """Whether the other end has not taken all flushed data yet: then send no messages that may be lost."""
        ...

    def send(self, message: Any) -> None:
        """Queue a message, or drop it silently if the link is lost.

        Raises:
            MailboxFull: between processes: the peer does not read, and the buffer is full; nothing was queued.
            NotSerializable: between processes: the message cannot be encoded, or is too long; nothing was queued.
        """
        ...

    def flush(self) -> None:
        """Hand all queued messages to the other side at once."""
        ...

    def send_now(self, message: Any) -> None:
        """Send one message, and all queued messages before it. Raises the errors of send()."""
        ...

    def close(self) -> None:
        """Send the queued messages and close the link; `lost` is called on both sides."""
        ...


class Receiver(Protocol):
    """The object that takes the messages of a link."""

    def received(self, link: Link, message: Any) -> None:
        """Take one decoded message."""
        ...

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Note that the link is closed; `reason` is None if either side closed it, else the error, if it is known.

        Called once for each `attach` that has returned.
        """
        ...


class Exchange(Protocol):
    """A connection for a thread that asks and waits: one message out, one back, one thread at a time.

    Attributes:
        epoch: the other side's epoch, from its Welcome.
    """

    epoch: int

    def exchange(self, message: Any, deadline: float) -> Any:
        """Write a message and return the answer.

        Raises:
            TimeoutError: no answer came until the deadline (time_limits.deadline_of); do not use the connection again.
            OSError: the connection is lost; the message may have arrived.
            NotSerializable: the message is too long for a frame; the connection can still be used.
        """
        ...

    def cut(self) -> None:
        """End the connection now: for a thread that waits on it, the connection is lost. From any thread."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


Attach = Callable[[Link], Receiver]
Accept = Callable[[Hello], tuple[Welcome, Attach]]


class NotAnswering(Unavailable):
    """The peer's process has its socket, but did not finish the handshake in time: it is stopped, busy, or hangs."""


class Transport(Protocol):
    """Opens and accepts links."""

    @property
    def address(self) -> str:
        """The address at which others reach this transport once it listens."""
        ...

    async def listen(self, accept: Accept) -> None:
        """Accept links from now on. If `accept` raises an RrError, the other side's connect() raises it, too."""
        ...

    async def connect(self, address: str, hello: Hello, attach: Attach) -> Link:
        """Open a link. Messages that the other side sends at once may reach the Receiver before this returns.

        Raises:
            RrError: the error that the other side's accept raised.
            Unavailable: no transport listens at the address, or the handshake failed.
            NotAnswering: the handshake took too long.
        """
        ...

    async def close(self) -> None:
        """Stop listening and close all links; when this returns, `lost` has been called on each Receiver."""
        ...
