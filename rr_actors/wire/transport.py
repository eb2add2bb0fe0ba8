"""Transport: the contract of how messages reach another actor. Implementations stand beside it; one contract test
suite runs over all.

A link is one connection between two of them, opened by the one who wants something. Guarantees: messages arrive whole,
in the order they were sent, each at most once; when a link is lost, what was sent last may or may not have arrived, and
`lost` is called exactly once on each side, after everything that did arrive. The sender may send again on a new link.

Everything here but an Exchange runs on the process's loop, and no Receiver is called from within another's `send`,
`flush` or `close`. Obligations: after one or more `send`, call `flush` before returning to the loop; a Receiver must
not block; close the transport before the loop ends, or nobody hears `lost`. A Receiver that raises loses its link.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import msgspec


class Hello(msgspec.Struct, frozen=True, array_like=True):
    """What the side that opens a link says first: what it is for, to whom, from whom, of which incarnation."""

    kind: str  # "registrar", "direct" or "actors"
    to: str
    origin: str
    epoch: int


class Welcome(msgspec.Struct, frozen=True, array_like=True):
    """The answer to Hello: the incarnation of who answers."""

    epoch: int


class Link(Protocol):
    """One open connection."""

    hello: Hello
    welcome: Welcome

    @property
    def more(self) -> bool:
        """Whether another message, which came with the one that is being received, follows it at once."""
        ...

    @property
    def peer(self) -> str:
        """Who is at the other end, for people: "cameras (pid 4711)"."""
        ...

    @property
    def behind(self) -> bool:
        """Whether the other end is slow to take what was flushed before: what may be lost is better not sent now."""
        ...

    def send(self, message: Any) -> None:
        """Queue a message; dropped silently when the link is lost.

        Raises:
            MailboxFull: between processes: the peer does not read and the buffer has reached its limit; the message was
                not queued.
            NotSerializable: between processes: it cannot be encoded, or is longer than the limit; it was not queued.
        """
        ...

    def flush(self) -> None:
        """Hand everything queued to the other side in one go."""
        ...

    def send_now(self, message: Any) -> None:
        """Send one message, with whatever is queued. Raises what send() does."""
        ...

    def close(self) -> None:
        """Send what is queued and close; both sides hear `lost`."""
        ...


class Receiver(Protocol):
    """Who takes what arrives on a link."""

    def received(self, link: Link, message: Any) -> None:
        """One message, decoded."""
        ...

    def lost(self, link: Link, reason: Exception | None) -> None:
        """The link is closed; None if either side closed it, else what happened, as far as can be told.

        Called once for each `attach` that has returned.
        """
        ...


class Exchange(Protocol):
    """One way for a thread to ask and wait: a message there, one back, one thread at a time.

    Attributes:
        epoch: the other side's, as its Welcome says.
    """

    epoch: int

    def exchange(self, message: Any, timeout_s: float | None) -> Any:
        """Write a message and return the one that comes back.

        Raises:
            TimeoutError: none came within `timeout_s` seconds; it is not to be used again.
            OSError: the connection is lost; the message may have arrived.
            NotSerializable: too long for a frame; it is as it was.
        """
        ...

    def cut(self) -> None:
        """End it now: the thread that waits, if there is one, hears that it is lost. From any thread."""
        ...

    def close(self) -> None:
        """Let it go."""
        ...


Attach = Callable[[Link], Receiver]
Accept = Callable[[Hello], tuple[Welcome, Attach]]


class Transport(Protocol):
    """Opens and accepts links."""

    @property
    def address(self) -> str:
        """Where others reach this transport once it listens."""
        ...

    async def listen(self, accept: Accept) -> None:
        """Accept links from now on. An RrError that `accept` raises is what the other side's connect raises."""
        ...

    async def connect(self, address: str, hello: Hello, attach: Attach) -> Link:
        """Open a link. What the other side sends at once may reach the Receiver before this returns.

        Raises:
            RrError: what the other side's accept raised.
            Unavailable: nobody listens there, or the handshake failed or took too long.
        """
        ...

    async def close(self) -> None:
        """Stop listening, close every link; each receiver has heard `lost` when this returns."""
        ...
