"""Links between processes of one system: Unix sockets in a private directory, authenticated with the system's key.

Each process has one socket. A link is one connection, which stays open; the side that wants something makes it. The
bytes are described in frames.py and handshake.py. This file has the connections and their limits. If a peer breaks the
rules, only its own connection is closed, and the log names the peer.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Mapping
from typing import Any, cast

from rr_actors.base.errors import RrError, Unavailable, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.steps import Steps
from rr_actors.wire.frames import FRAME_LIMIT_BYTES, decoder_of
from rr_actors.wire.handshake import AcceptorHandshake, DiallerHandshake, check_key
from rr_actors.wire.segments import Segments
from rr_actors.wire.thread_connections import BlockingLink
from rr_actors.wire.transport import Accept, Attach, Hello, Link, NotAnswering, Welcome
from rr_actors.wire.unix_link import CLOSE_LIMIT_S, UnixLink, Wire
from rr_actors.wire.unix_sockets import Refusals, SocketDir, new_name, peer_of

_log = Log(__name__)

HANDSHAKE_TIMEOUT_S = 5.0
"""How long the handshake of a peer may take."""
STRANGERS_LIMIT = 128
"""How many connections may be in their handshake at a time; further ones are closed at once."""
PATIENCE_S = 0.25
"""How old a handshake must be for another one to take its place."""
_BACKLOG = 1024
_RETRY_S = 0.01


class UnixTransport:
    """A Transport over Unix sockets in `socket_dir`; an address is the name of a socket file there.

    Args:
        socket_dir: a directory of mode 0700 that all processes of the system use.
        key: the system's 32 secret bytes.
        codecs: the message type of each kind of link (`Hello.kind`).
        frame_limit_bytes: the length of the longest message, on either side.
        segments_limit_bytes: the memory that large values to other processes may take. Default: a quarter of all.

    Attributes:
        segments: the shared memory for large values.
        address: the socket file's name in the socket directory.
    """

    def __init__(
        self,
        socket_dir: str | os.PathLike[str],
        key: bytes,
        codecs: Mapping[str, Any],
        *,
        frame_limit_bytes: int = FRAME_LIMIT_BYTES,
        segments_limit_bytes: int | None = None,
    ) -> None:
        self._sockets = SocketDir(socket_dir)
        self._key = check_key(key)
        self.wires = {kind: Wire(decoder_of(message_type), frame_limit_bytes) for kind, message_type in codecs.items()}
        self.segments = Segments(segments_limit_bytes, frame_limit_bytes)
        self.address = new_name()
        self._server: asyncio.AbstractServer | None = None
        self._closed = False
        self._crowded = False
        self.accept: Accept | None = None
        self.strangers: dict[_Acceptor, None] = {}  # oldest first
        self.refusals = Refusals(_log)
        self.diallers: set[_Dialler] = set()
        self.links: set[UnixLink] = set()

    async def listen(self, accept: Accept) -> None:
        """Accept links from now on; raise ConfigError if the socket cannot be made."""
        if self._server is not None or self._closed:
            raise UsageError(f"transport {self.address}: listens already, or is closed")
        self.accept = accept
        self.segments.loop = asyncio.get_running_loop()
        self._server = await self._serve()

    async def _serve(self) -> asyncio.AbstractServer:
        listener = self._sockets.bind(self.address)
        loop = asyncio.get_running_loop()
        return await loop.create_unix_server(lambda: _Acceptor(self, self._key), sock=listener, backlog=_BACKLOG)

    async def keep(self) -> bool:
        """Make the socket's file again if it was removed, or raise ConfigError; return whether it was.

        Open links are not affected.
        """
        if self._server is None or self._closed or self._sockets.has(self.address):
            return False
        lost, self._server = self._server, await self._serve()
        lost.close()
        return True

    async def connect(self, address: str, hello: Hello, attach: Attach) -> Link:
        if hello.kind not in self.wires:
            raise UsageError(f"no codec for links of kind {hello.kind!r}: this transport has {sorted(self.wires)}")
        loop = asyncio.get_running_loop()
        deadline = loop.time() + HANDSHAKE_TIMEOUT_S
        while True:
            handshake = DiallerHandshake(self._key, hello)
            since = loop.time()
            connected = await self._dial(address, hello, deadline)
            dialler = _Dialler(self, handshake, hello, attach, since, deadline)
            try:
                await loop.create_unix_connection(lambda dialler=dialler: dialler, sock=connected)
                return await dialler.done
            except _TurnedAway as error:
                if loop.time() + _RETRY_S >= deadline:
                    raise NotAnswering(f"{hello.to} closes each connection: too many others want one") from error
                await asyncio.sleep(_RETRY_S)
            except BaseException:  # cancelled, or the peer's refusal
                dialler.abandon()
                raise

    def dial(self, address: str, hello: Hello, timeout_s: float) -> BlockingLink:
        """Open a connection for the calling thread alone. From any thread. Raises the errors of connect()."""
        wire = self.wires[hello.kind]
        return BlockingLink(self._sockets, self._key, address, hello, wire, timeout_s, self.segments)

    async def _dial(self, address: str, hello: Hello, deadline: float) -> socket.socket:
        loop = asyncio.get_running_loop()
        while True:
            if self._closed:
                raise Unavailable(f"cannot connect to {hello.to}: this transport is closed")
            try:
                return self._sockets.connect(address)
            except BlockingIOError as error:  # its backlog is full
                if loop.time() >= deadline:
                    raise NotAnswering(f"{hello.to} does not accept connections at {address}") from error
                await asyncio.sleep(_RETRY_S)
            except (OSError, ValueError) as error:
                if wanted := wanted_by(error):  # this process lacks something: waiting for the peer would not help
                    raise RrError(f"cannot connect to {hello.to}: {wanted}") from error
                raise Unavailable(f"nobody listens for {hello.to} at {address}: {error}") from error

    def sweep(self) -> None:
        """Remove the sockets of dead processes; raise OSError if the directory cannot be read. From any thread."""
        self._sockets.sweep()

    async def close(self) -> None:
        """Stop listening, send the queued messages (for a second at most), close all links, call `lost` for each."""
        self._closed = True
        steps = Steps()
        self.refusals.close()
        if self._server is not None:
            steps.take("closing the socket", self._server.close)
            steps.take("removing the socket", self._sockets.unlink, self.address)
        for stranger in [*self.strangers]:
            steps.take("closing a new connection", stranger.abort)
        for dialler in [*self.diallers]:
            closed = Unavailable(f"cannot connect to {dialler.hello.to}: this transport was closed")
            steps.take("giving up a connection", dialler.fail, closed)
        try:
            await steps.take_async("closing the links", self._close_links())
        finally:
            for link in [*self.links]:  # this call was cancelled, or the link's own time limit is late
                steps.take("closing a link", link.abort, None)
                steps.take("closing a link", link.connection_lost, None)
            steps.take("closing the directory of sockets", self._sockets.close)
        steps.end(f"transport {self.address}: not closed altogether")
        for _ in range(3):
            await asyncio.sleep(0)  # the loop closes aborted connections in its next turns

    async def _close_links(self) -> None:
        links = [*self.links]
        for link in links:
            link.close()
        with contextlib.suppress(TimeoutError):  # do not wait for a peer that does not read
            async with asyncio.timeout(2 * CLOSE_LIMIT_S):
                for link in links:
                    await link.closed.wait()

    def let_in(self, stranger: _Acceptor) -> bool:
        """Add a new connection to `strangers`; return False if there is no room.

        The oldest connection makes room if it is slow: a handshake takes milliseconds. So a peer gets its link although
        others hold connections open and send nothing.
        """
        if self._closed:
            return False
        if len(self.strangers) >= STRANGERS_LIMIT:
            if not self._crowded:
                self._crowded = True  # logged once, until there are fewer again
                _log.warning("%s: %d connections in their handshake, no room for more", self.address, STRANGERS_LIMIT)
            oldest = next(iter(self.strangers))
            if oldest.since + PATIENCE_S > stranger.since:
                return False
            oldest.abort()
            self.forget(oldest)
        self.strangers[stranger] = None
        return True

    def forget(self, stranger: _Acceptor) -> None:
        """Remove a connection from `strangers`: it has become a link, or is closed."""
        self.strangers.pop(stranger, None)
        if len(self.strangers) < STRANGERS_LIMIT // 2:
            self._crowded = False


# -- handshakes on sockets -----------------------------------------------------------------------------------------


class _TurnedAway(Exception):
    """The acceptor closed the connection to make room: before it sent anything, or after PATIENCE_S.

    It closes one of somebody without its key at once. But where many connect, or where both sides wait for their core,
    an honest handshake is old enough to make room for another.
    """


class _Acceptor(asyncio.Protocol):
    """An accepted connection that has not sent its proof and its Hello yet; after them a UnixLink takes its place."""

    def __init__(self, owner: UnixTransport, key: bytes) -> None:
        self._owner = owner
        self._handshake = AcceptorHandshake(key)
        self._over = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._peer = peer_of(self._transport)
        loop = asyncio.get_running_loop()
        self.since = loop.time()
        self._timer = loop.call_later(HANDSHAKE_TIMEOUT_S, self._time_out)
        if not self._owner.let_in(self):
            self.abort()
        elif not self._peer.trusted:
            self._refuse_stranger(f"it runs as user {self._peer.uid}, not as ours")
        else:
            self._transport.write(self._handshake.greeting)

    def data_received(self, data: bytes) -> None:
        if self._over:
            return
        try:
            reply = self._handshake.receive(data)
        except Unavailable as error:
            self._refuse_stranger(str(error))
            return
        if reply:
            self._transport.write(reply)
        if self._handshake.done:
            self._over = True
            self._answer(self._handshake.hello)

    def _answer(self, hello: Hello) -> None:
        try:
            link = self._open_link(hello)
        except Exception as error:
            if not isinstance(error, RrError):
                _log.exception("refusing a link of %s: accepting it failed", self._peer.named(hello.origin))
            self._transport.write(self._handshake.refuse(error))
            self._transport.close()  # the timer stays, for a dialler that does not read
            return
        self._timer.cancel()
        self._owner.forget(self)
        self._transport.set_protocol(link)
        link.flush()
        if self._handshake.rest:
            link.data_received(self._handshake.rest)

    def _open_link(self, hello: Hello) -> UnixLink:
        owner = self._owner
        if hello.kind not in owner.wires or owner.accept is None:
            raise Unavailable(f"{hello.to} takes no links of kind {hello.kind!r}, only {sorted(owner.wires)}")
        welcome, attach = owner.accept(hello)
        start = self._handshake.welcome(welcome)  # goes before whatever attach sends
        link = UnixLink(
            owner.links, self._transport, owner.wires[hello.kind], hello, welcome, self._peer, hello.origin, start
        )
        link.attach(attach)
        return link

    def _time_out(self) -> None:
        if not self._over:
            what = self._handshake.waits_for
            self._refuse_stranger(f"it did not send {what} within {HANDSHAKE_TIMEOUT_S:g} s")
        else:
            self.abort()

    def _refuse_stranger(self, why: str) -> None:
        self._owner.refusals.note(f"closing a connection of {self._peer} to {self._owner.address}: {why}")
        self.abort()

    def abort(self) -> None:
        self._over = True
        self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        self._owner.forget(self)


class _Dialler(asyncio.Protocol):
    """The connecting side of the handshake; the result of `done` is the link, or the error.

    This is a protocol, and not a coroutine that reads the socket and then hands it over: uvloop would read before the
    coroutine goes on, and these bytes would be lost.
    """

    def __init__(
        self,
        owner: UnixTransport,
        handshake: DiallerHandshake,
        hello: Hello,
        attach: Attach,
        since: float,
        deadline: float,
    ) -> None:
        self.hello = hello
        loop = asyncio.get_running_loop()
        self.done: asyncio.Future[Link] = loop.create_future()
        self._owner = owner
        self._handshake = handshake
        self._attach = attach
        self._since = since
        self._link: UnixLink | None = None
        self._transport: asyncio.Transport | None = None
        self._timer = loop.call_at(deadline, self._time_out)
        owner.diallers.add(self)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._peer = peer_of(self._transport)
        if not self._peer.trusted:
            self._fail(f"it runs as user {self._peer.uid}, not as ours")
        elif self.done.done():
            self._abort()

    def data_received(self, data: bytes) -> None:
        if self.done.done():
            return
        handshake = self._handshake
        try:
            reply = handshake.receive(data)
        except Unavailable as error:
            self._fail(str(error))
            return
        if reply and self._transport is not None:
            self._transport.write(reply)
        if handshake.refusal is not None:
            self.fail(handshake.refusal)
        elif handshake.welcome is not None:
            self._open_link(handshake.welcome)

    def _open_link(self, welcome: Welcome) -> None:
        transport = cast(asyncio.Transport, self._transport)
        owner = self._owner
        wire = owner.wires[self.hello.kind]
        link = UnixLink(owner.links, transport, wire, self.hello, welcome, self._peer, self.hello.to)
        try:
            link.attach(self._attach)
        except Exception as error:
            self.fail(error)
            return
        self._link = link
        self._forget()
        transport.set_protocol(link)
        self.done.set_result(link)
        link.flush()
        if self._handshake.rest:
            link.data_received(self._handshake.rest)

    def _time_out(self) -> None:
        self._fail(f"it did not send {self._handshake.waits_for} within {HANDSHAKE_TIMEOUT_S:g} s", NotAnswering)

    def _fail(self, why: str, kind: type[Unavailable] = Unavailable) -> None:
        peer = self._peer.named(self.hello.to) if self._transport is not None else self.hello.to
        self.fail(kind(f"cannot open a link to {peer}: {why}"))

    def fail(self, error: Exception) -> None:
        """Close the connection, and make connect() raise `error`."""
        self._forget()
        if not self.done.done():
            self.done.set_exception(error)
        self._abort()

    def abandon(self) -> None:
        """Close the link or the connection: connect() does not wait for it any more."""
        self._forget()
        self.done.cancel()
        if self._link is not None:
            self._link.close()
        else:
            self._abort()

    def _abort(self) -> None:
        """Close the connection, in a later call of the loop.

        uvloop takes the socket from its Python object only after connection_made(). If the connection is aborted there,
        the object closes the same descriptor number once more, when it is collected.
        """
        if self._transport is not None:
            asyncio.get_running_loop().call_soon(self._transport.abort)

    def _forget(self) -> None:
        self._timer.cancel()
        self._owner.diallers.discard(self)

    def connection_lost(self, exc: Exception | None) -> None:
        if self.done.done():
            self._forget()
        elif not self._handshake.greeted or asyncio.get_running_loop().time() >= self._since + PATIENCE_S:
            self.fail(_TurnedAway())
        else:
            self._fail("it closed the connection instead of answering: it has another key, or died")
