"""Control: the messages between a supervisor and the process of one of its children, over their own socket pair.

Parent to child: Start, Stop, Ping, AskStacks. Child to parent: Ready, Ignored or Failed, once; Pong; FoundStacks; News;
Exiting, last. Messages are decoded by type. Pickled values of users stay bytes here; a worker unpickles them.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Any, cast

import msgspec

from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import ProcessStacks
from rr_actors.wire.frames import FrameReader, decoder_of, framed

logger = Log("rr_actors")

_LIMIT_BYTES = 64 * 2**20
_REST_S = 0.01


class Start(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """Start the actor: the siblings before it are ready. `by_hand`: start_child or restart_child asks for it."""

    by_hand: bool = False


class Stop(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """Stop the actor and end the process. `final`: the actor will not be started again."""

    final: bool = False


class Ping(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """Answer with a Pong if the loop is alive."""


class Pong(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The loop is alive. `trouble`: why the process cannot work any more, "" if it can."""

    trouble: str = ""


class AskStacks(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """Answer with FoundStacks of this number: where the threads are of the process in which the child at `path` runs.

    It is this process, or one below it, which has `limit_s` seconds to answer.
    """

    number: int
    path: str
    limit_s: float


class FoundStacks(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The answer to AskStacks. `error`: why there are none."""

    number: int
    stacks: ProcessStacks | None
    error: str = ""


class ChildReady(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The actor's on_start has returned; others can reach it."""


class Ignored(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The actor's on_start returned IGNORE; the process ends."""


class Failed(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The actor did not start; the process ends. `error`: the pickled exception, empty if it cannot be pickled.

    `wanted`: what was wanting (base/scarcity.py), since an exception leaves its causes behind.
    """

    text: str
    traceback: str
    error: bytes = b""
    wanted: str = ""


class DiedInCallback(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The child's last process died while callbacks of resources ran. `runs` names them.

    `is_proven`: processes have died in each of several runs of one of them, which is not run again.
    """

    runs: str
    is_proven: bool = False


class CallbacksAcquitted(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """All callbacks that ran when the child's last process died have run again, and the child lives."""


class Resumed(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """A callback of a resource goes on with work of before a crash, while the actor is starting. `run` names it."""

    run: str


class Exiting(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """The actor has ended with this reason; the process ends, too."""

    reason: str
    detail: str
    traceback: str


class News(msgspec.Struct, tag=True, array_like=True, frozen=True):
    """Something happened in the child's process or below it, as plain data."""

    event: dict[str, Any]


Message = (Start | Stop | Ping | AskStacks) | (
    ChildReady | Ignored | Failed | DiedInCallback | CallbacksAcquitted | Resumed | Pong | FoundStacks | News | Exiting
)


def send_first(end: socket.socket, message: Message) -> None:
    """Send a message on an end that has no channel yet. Blocks."""
    end.setblocking(True)
    end.sendall(framed(message, _LIMIT_BYTES))


class Channel(asyncio.Protocol):
    """One end of the socket pair, on the loop. Messages travel in frames (rr_actors/wire/frames.py).

    Args:
        path: the child's, for the log.
        received: called with each message.
        lost: called once, when the other end is gone or has sent something that is no message.
    """

    def __init__(self, path: str, received: Callable[[Message], None], lost: Callable[[], None]) -> None:
        self._path = path
        self._received = received
        self._lost = lost
        self._reader: FrameReader[Message] = FrameReader(decoder_of(Message), _LIMIT_BYTES)
        self._transport: asyncio.Transport | None = None
        self._resting: asyncio.TimerHandle | None = None
        self._gone = asyncio.Event()

    @classmethod
    async def open(
        cls, end: socket.socket, path: str, received: Callable[[Message], None], lost: Callable[[], None]
    ) -> Channel:
        """Return the channel on `end`, which belongs to it from now on."""
        end.setblocking(False)
        loop = asyncio.get_running_loop()
        _, channel = await loop.create_unix_connection(lambda: cls(path, received, lost), sock=end)
        return channel

    def send(self, message: Message) -> None:
        """Send a message, unless the other end is gone. Call on the loop.

        Raises:
            NotSerializable: the message has no MessagePack form, or is longer than 64 MiB.
        """
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(framed(message, _LIMIT_BYTES))

    def rest(self) -> None:
        """Read nothing for 10 ms, so that many messages wake this process once. They wait in the socket."""
        if self._resting is None and self._transport is not None and not self._transport.is_closing():
            self._transport.pause_reading()
            self._resting = asyncio.get_running_loop().call_later(_REST_S, self.go_on)

    def go_on(self) -> None:
        """Read on at once."""
        resting, self._resting = self._resting, None
        if resting is not None:
            resting.cancel()
            if self._transport is not None and not self._transport.is_closing():
                self._transport.resume_reading()

    def close(self) -> None:
        """Send the buffered messages and close the channel. `received` and `lost` are not called any more."""
        self.go_on()
        self._lost = _nobody
        self._received = _nobody
        if self._transport is not None:
            self._transport.close()

    async def finish(self, patience_s: float) -> None:
        """Close the channel, and wait until all messages are sent, or the other end reads nothing for `patience_s`."""
        self.close()
        while (transport := self._transport) is not None:
            unsent = transport.get_write_buffer_size()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(patience_s):
                    await self._gone.wait()
            if transport.get_write_buffer_size() == unsent:
                return

    # -- asyncio.Protocol ------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        for message in self._reader.feed(data):
            self._received(message)
        if self._reader.error is not None or self._reader.ended:  # neither end sends a last, empty frame
            logger.error("%s: control channel closed: %s", self._path, self._reader.error or "an empty frame")
            if self._transport is not None:
                self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._gone.set()
        self.go_on()
        lost, self._lost = self._lost, _nobody
        lost()


def _nobody(*_: object) -> None:
    pass
