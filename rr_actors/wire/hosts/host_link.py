"""A Link between two hosts: frames in numbered packets, acknowledged, over anything that carries bytes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.wire.frames import GOODBYE, FrameReader, framed
from rr_actors.wire.hosts.byte_window import ACKNOWLEDGED, BROKEN, DATA, ReceivedBytes, SendWindow, packet, read_packet
from rr_actors.wire.transport import Attach, Hello, Receiver, Welcome
from rr_actors.wire.unix_link import BUFFER_LIMIT_BYTES, CLOSE_LIMIT_S, Wire

_log = Log(__name__)


class HostLink:
    """One end of a link between hosts. `closed` is set when `lost` is called; `address` is that of the other end.

    Args:
        links: the open links by their keys; this one is in it while it is open.
        key: the other end's address, and the id of the link.
        put: sends a packet to the other end; it neither waits nor raises.
        name: the other end's name, for people.
    """

    more = False
    pid = 0

    def __init__(
        self,
        links: dict[tuple[str, str], HostLink],
        key: tuple[str, str],
        put: Callable[[bytes], None],
        wire: Wire,
        hello: Hello,
        welcome: Welcome,
        name: str,
    ) -> None:
        self.hello = hello
        self.welcome = welcome
        self.address = key[0]
        self.peer = f"{name} (at {key[0]})"
        self.closed = asyncio.Event()
        self._links = links
        self._key = key
        self._put = put
        self._frame_limit = wire.frame_limit_bytes
        self._reader: FrameReader[Any] = FrameReader(wire.decoder, wire.frame_limit_bytes)
        self._loop = asyncio.get_running_loop()
        self._buffer = bytearray()
        self._window = SendWindow()
        self._received = ReceivedBytes()
        self._acknowledges = False  # a call of _acknowledge is on its way
        self._open = True
        self._started = False
        self._receiver: Receiver | None = None
        self._timer: asyncio.TimerHandle | None = None

    def attach(self, attach: Attach) -> None:
        """Set the receiver of the link; from now on the link calls its `lost` at the end."""
        self._receiver = attach(self)
        self._links[self._key] = self

    def start(self) -> None:
        """Begin to send: the other end is ready."""
        self._started = True
        self._pump()

    @property
    def behind(self) -> bool:
        return self._window.waiting > 0

    def send(self, message: Any) -> None:
        if not self._open:
            return
        waiting = len(self._buffer) + self._window.waiting
        if waiting > BUFFER_LIMIT_BYTES:
            raise MailboxFull(
                f"{waiting} bytes wait for {self.peer}, over the limit of {BUFFER_LIMIT_BYTES}: "
                "it does not read; try again when it does",
                name=self.peer,
                limit=BUFFER_LIMIT_BYTES,
            )
        self._buffer += framed(message, self._frame_limit)

    def flush(self) -> None:
        if self._open and self._buffer:
            self._window.add(self._buffer)
            self._buffer = bytearray()
            self._pump()

    def send_now(self, message: Any) -> None:
        self.send(message)
        self.flush()

    def close(self) -> None:
        """Send the queued messages and close; wait for the other end's acknowledgement for CLOSE_LIMIT_S at most."""
        if not self._open:
            return
        self._window.add(self._buffer + GOODBYE)
        self._buffer = bytearray()
        self._open = False
        self._timer = self._loop.call_later(CLOSE_LIMIT_S, self.end, None)
        self._pump()

    def _pump(self) -> None:
        if self._started:
            for data in self._window.take():
                self._put(data)

    def take(self, data: bytes) -> None:
        """Take a packet from the other end. One that breaks the rules breaks this link, and no other."""
        if self.closed.is_set():
            return
        try:
            kind, number, rest = read_packet(data)
            if kind == ACKNOWLEDGED:
                self._window.acknowledge(number)
            elif kind == DATA:
                self._received.take(number, rest)
        except Unavailable as error:
            self.break_off(error)
            return
        if kind == BROKEN:
            self.end(Unavailable(f"{self.peer} broke off the link: {rest.decode('utf-8', 'replace')}"))
        elif kind == ACKNOWLEDGED:
            self._pump()
            if not self._open and self._window.empty:
                self.end(None)
        else:
            self._read(rest)

    def _read(self, data: bytes) -> None:
        if not self._acknowledges:
            self._acknowledges = True
            self._loop.call_soon(self._acknowledge)
        messages = self._reader.feed(data)
        left = len(messages)
        for message in messages:
            if not self._open or self._receiver is None:
                break
            left -= 1
            self.more = left > 0
            try:
                self._receiver.received(self, message)
            except Exception as error:
                said = type(message).__name__
                if isinstance(error, Unavailable):
                    _log.warning("closing the link with %s: %s: %s", self.peer, said, error)
                else:
                    _log.exception("closing the link with %s: its receiver failed on %s", self.peer, said)
                self.break_off(error)
                return
        if self._reader.error is not None:
            _log.warning("closing the link with %s: %s", self.peer, self._reader.error)
            self.break_off(self._reader.error)
        elif self._reader.ended:
            self._acknowledge()
            self.end(None)

    def _acknowledge(self) -> None:
        self._acknowledges = False
        if not self.closed.is_set():
            self._put(packet(ACKNOWLEDGED, self._received.total))

    def break_off(self, reason: Exception) -> None:
        """End the link at once, and name the reason to the other end."""
        if not self.closed.is_set():
            self._put(packet(BROKEN, 0, str(reason).encode("utf-8", "replace")[:1000]))
            self.end(reason)

    def end(self, reason: Exception | None) -> None:
        """End the link at once; the other end hears nothing of it."""
        self._open = False
        if self.closed.is_set():
            return
        self.closed.set()
        if self._timer is not None:
            self._timer.cancel()
        self._links.pop(self._key, None)
        if self._receiver is not None:
            try:
                self._receiver.lost(self, reason)
            except Exception:
                _log.exception("the receiver of the link with %s failed when it was lost", self.peer)
