"""What the tests of transports share: event loops, a message, receivers that write everything down."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.wire.handshake import DiallerHandshake
from rr_actors.wire.transport import Attach, Hello, Link, Receiver, Welcome

try:
    import uvloop
except ImportError:
    LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {"asyncio": asyncio.new_event_loop}
else:
    LOOPS = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


class Note(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """What the tests send."""

    number: int
    text: bytes = b""


def free_port() -> int:
    """Return a port of 127.0.0.1 that nothing uses now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


HELLO = Hello("registrar", "cameras", "app", 7)
KEY = bytes(range(32))


class Inbox:
    """A Receiver that writes everything down, and lets tests wait for it."""

    def __init__(self, on_message: Callable[[Link, Any], None] | None = None) -> None:
        self.link: Link | None = None
        self.messages: list[Any] = []
        self.history: list[Any] = []
        self.lost_reasons: list[Exception | None] = []
        self._on_message = on_message
        self._changed = asyncio.Event()

    def attach(self, link: Link) -> Receiver:
        self.link = link
        return self

    def received(self, link: Link, message: Any) -> None:
        assert link is self.link
        assert not self.lost_reasons
        self.messages.append(message)
        if self._on_message is not None:
            self._on_message(link, message)
        self._changed.set()

    def lost(self, link: Link, reason: Exception | None) -> None:
        assert link is self.link
        self.lost_reasons.append(reason)
        self._changed.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(20):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    async def messages_are(self, count: int) -> list[Any]:
        await self.until(lambda: len(self.messages) >= count)
        return self.messages

    async def is_lost(self) -> Exception | None:
        await self.until(lambda: bool(self.lost_reasons))
        return self.lost_reasons[0]


class Door:
    """An Accept that gives each link an Inbox, or raises."""

    def __init__(self, *, refuse: Exception | None = None, greeting: int = 0) -> None:
        self.refuse = refuse
        self.greeting = greeting
        self.hellos: list[Hello] = []
        self.inboxes: list[Inbox] = []
        self._opened = asyncio.Event()

    async def opened(self) -> Inbox:
        """Wait for the first link."""
        await self._opened.wait()
        return self.inboxes[0]

    def __call__(self, hello: Hello) -> tuple[Welcome, Attach]:
        if self.refuse is not None:
            raise self.refuse
        self.hellos.append(hello)
        inbox = Inbox()
        self.inboxes.append(inbox)
        self._opened.set()

        def attach(link: Link) -> Receiver:
            for number in range(self.greeting):
                link.send(Note(number))
            link.flush()
            return inbox.attach(link)

        return Welcome(42), attach


@contextmanager
def loop_of(kind: str) -> Iterator[asyncio.AbstractEventLoop]:
    """An event loop that nothing may be left on, and that has had nothing to complain about."""
    loop = LOOPS[kind]()
    complaints: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda _, context: complaints.append(context))
    yield loop
    assert not asyncio.all_tasks(loop)
    loop.close()
    assert not complaints


def frame(body: bytes) -> bytes:
    """The frame of any bytes."""
    return len(body).to_bytes(4, "big") + body


@asynccontextmanager
async def stream(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection that knows nothing of rr_actors."""
    reader, writer = await asyncio.open_unix_connection(path)
    try:
        yield reader, writer
    finally:
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()


async def authenticated(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, hello: Hello = HELLO) -> bytes:
    """Do the handshake, as somebody who has the key; return what came after the Welcome."""
    handshake = DiallerHandshake(KEY, hello)
    while not handshake.done:
        writer.write(handshake.receive(await reader.read(65536)))
    assert handshake.welcome is not None
    return handshake.rest
