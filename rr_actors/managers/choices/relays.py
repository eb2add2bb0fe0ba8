"""Relays: addresses that stay, while what is behind them changes.

A program connects to a relay as it would to the source of the bytes. The relay connects to the present source, and
passes on what both send. When the source changes or ends, the relay connects anew, and the program's connection stays
open. Nothing here knows about choices.

What each connection keeps is bounded: a side that sends faster than the other reads is not read from meanwhile. Without
a source, the relay keeps some of what the program sends for the next one. What a source sends after it was replaced is
thrown away.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import ipaddress
import os
import socket
import threading
from collections.abc import Collection
from pathlib import Path
from typing import cast

import msgspec

from rr_actors.base.errors import ConfigError, Unavailable, shown, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import wrong
from rr_actors.runtime.user_loop import start_loop_thread

logger = Log("rr_actors.managers.choices")

MOST_PROGRAMS = 64
"""How many programs may be connected to one relay; the connection of a further one is closed at once."""
KEPT_BYTES = 65_536
"""What a relay keeps of a program's bytes while there is no source, before it stops to read; at most one read more."""

_EXPECTED = "'unix:/path' or 'tcp:host:port'"
_PATH_BYTES = 107  # the longest path of a Unix socket
_ANSWER_S = 10.0
_CONNECT_S = 5.0
_RETRY_S = 0.05
_RETRY_LIMIT_S = 1.0
_FULL = 65_536  # a transport with so many bytes to write is full


class SocketAddress(msgspec.Struct, frozen=True):
    """The address of a socket of this machine, or of a host that was allowed. `port` is 0 for a Unix socket."""

    place: str
    port: int = 0

    def __str__(self) -> str:
        if not self.port:
            return f"unix:{self.place}"
        return f"tcp:[{self.place}]:{self.port}" if ":" in self.place else f"tcp:{self.place}:{self.port}"


def parse_address(text: object, hosts: Collection[str] = ()) -> SocketAddress:
    """Read an address.

    Args:
        hosts: the hosts that are allowed besides this machine.

    Raises:
        ConfigError: it is none, or it is of another host. `.key`, `.expected`, `.got`
    """
    kind, _, rest = text.partition(":") if isinstance(text, str) else ("", "", "")
    if kind == "unix" and rest.startswith("/") and "\0" not in rest:
        if len(os.fsencode(rest)) > _PATH_BYTES:
            raise _wrong(f"a path of at most {_PATH_BYTES} bytes", text)
        return SocketAddress(rest)
    host, _, port = rest.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if kind != "tcp" or not host or not (port.isascii() and port.isdigit()) or not 0 < int(port) < 65_536:
        raise _wrong(_EXPECTED, text)
    if host not in hosts and not _is_here(host):
        raise _wrong("an address of this machine, or of one of relay_hosts", text)
    return SocketAddress(host, int(port))


def _is_here(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _wrong(expected: str, got: object) -> ConfigError:
    return wrong(None, "address", expected, got, where="relay", said=shown(got))


class Relays:
    """The relays of one process by id, and the thread that passes their bytes on. From any thread.

    The thread begins with the first relay, and ends with stop().
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._relays: dict[str, _Relay] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._ending: asyncio.Future[None] | None = None

    def open(self, id: str, address: SocketAddress) -> SocketAddress:
        """Open a relay if it is not open, and return its address.

        Args:
            address: port 0 of "127.0.0.1" or a path, for a new one; or the address that it had before a crash.

        Raises:
            ConfigError: the path is too long.
            Unavailable: there can be no such socket, or no thread for it.
        """
        with self._lock:
            if id in self._relays:
                return self._relays[id].address
            try:
                listener = _listening(address)
            except OSError as error:
                raise Unavailable(f"a relay at {address}: {text_of(error)}") from error
            try:
                loop = self._running()
                relay = _Relay(loop, listener)
                asyncio.run_coroutine_threadsafe(relay.serve(), loop).result(_ANSWER_S)
            except BaseException:
                listener.close()
                raise
            self._relays[id] = relay
            return relay.address

    def point(self, id: str, source: SocketAddress | None) -> None:
        """Have a relay pass on the bytes of another source, or, with None, of nothing for now."""
        with self._lock:
            relay = self._relays.get(id)
            if relay is not None and self._loop is not None:
                self._loop.call_soon_threadsafe(relay.point, source)

    def close(self, id: str) -> None:
        """Close a relay if it is open, and the connections of its programs."""
        with self._lock:
            relay = self._relays.pop(id, None)
            if relay is not None and self._loop is not None:
                asyncio.run_coroutine_threadsafe(relay.close(), self._loop).result(_ANSWER_S)
                if not relay.address.port:
                    Path(relay.address.place).unlink(missing_ok=True)

    def stop(self) -> None:
        """Close all relays, and end the thread."""
        for id in list(self._relays):
            self.close(id)
        with self._lock:
            loop, thread, ending = self._loop, self._thread, self._ending
            self._loop = self._thread = self._ending = None
        if loop is not None and thread is not None and ending is not None:
            loop.call_soon_threadsafe(ending.set_result, None)
            thread.join(_ANSWER_S)

    def _running(self) -> asyncio.AbstractEventLoop:
        if self._loop is None:
            self._thread = start_loop_thread(self._begin, "choices-relays")
        assert self._loop is not None  # _begin() has set it
        return self._loop

    def _begin(self, loop: asyncio.AbstractEventLoop) -> asyncio.Future[None]:
        self._loop, self._ending = loop, loop.create_future()
        return self._ending


def _listening(address: SocketAddress) -> socket.socket:
    """Return a socket that listens there. What a process that was killed has left at a path is removed."""
    is_tcp = not address.place.startswith("/")
    listener = socket.socket(socket.AF_INET if is_tcp else socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if is_tcp:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((address.place, address.port))
        else:
            parse_address(str(address))
            Path(address.place).unlink(missing_ok=True)
            listener.bind(address.place)
        listener.listen(MOST_PROGRAMS)
        listener.setblocking(False)
    except BaseException:
        listener.close()
        raise
    return listener


# -- on the thread of the relays -----------------------------------------------------------------------------------


class _Relay:
    """One relay: its listening socket, its source, and the programs that are connected."""

    def __init__(self, loop: asyncio.AbstractEventLoop, listener: socket.socket) -> None:
        name = listener.getsockname()
        self.address = SocketAddress(name) if isinstance(name, str) else SocketAddress(name[0], name[1])
        self.loop = loop
        self.source: SocketAddress | None = None
        self._open: set[_Program | _Source] = set()
        self._is_empty = asyncio.Event()
        self._is_empty.set()
        self._listener = listener
        self._server: asyncio.Server | None = None

    async def serve(self) -> None:
        if self.address.port:
            self._server = await self.loop.create_server(self._accepted, sock=self._listener)
        else:
            self._server = await self.loop.create_unix_server(self._accepted, sock=self._listener)

    def _accepted(self) -> _Program:
        return _Program(self)

    def point(self, source: SocketAddress | None) -> None:
        if source != self.source:
            self.source = source
            for program in self.programs():
                program.change()

    def programs(self) -> list[_Program]:
        return [one for one in self._open if isinstance(one, _Program)]

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        self._listener.close()
        for one in list(self._open):  # also sources that have not taken all yet
            one.transport.abort()
        await self._is_empty.wait()

    def came(self, one: _Program | _Source) -> None:
        self._open.add(one)
        self._is_empty.clear()

    def went(self, one: _Program | _Source) -> None:
        self._open.discard(one)
        if not self._open:
            self._is_empty.set()


class _Program(asyncio.Protocol):
    """The connection of a program, and its connection to the source."""

    def __init__(self, relay: _Relay) -> None:
        self.is_full = False
        self._relay = relay
        self._source: _Source | None = None
        self._kept = bytearray()  # for the next source
        self._retry_s = _RETRY_S
        self._connecting: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        if len(self._relay.programs()) >= MOST_PROGRAMS:
            logger.warning("%s: %d programs are connected: no more can be", self._relay.address, MOST_PROGRAMS)
            self.transport.abort()
            return
        self.transport.set_write_buffer_limits(_FULL)
        self._relay.came(self)
        self.change()

    def connection_lost(self, exc: Exception | None) -> None:
        self._relay.went(self)
        self._leave()

    def data_received(self, data: bytes) -> None:
        if self._source is not None:
            self._source.transport.write(data)
        else:
            self._kept += data
        self.regulate()

    def pause_writing(self) -> None:
        self.is_full = True
        self.regulate()

    def resume_writing(self) -> None:
        self.is_full = False
        self.regulate()

    # -- the source ------------------------------------------------------------------------------------------------

    def change(self) -> None:
        """Leave the source, and connect to the one that the relay has now."""
        self._leave()
        self._retry_s = _RETRY_S
        self._connect(0.0)

    def joined(self, source: _Source) -> None:
        """Use a connection that has been made; give it what was kept."""
        self._source = source
        if self._kept:
            source.transport.write(bytes(self._kept))
            self._kept.clear()
        self.regulate()

    def got(self, source: _Source, data: bytes) -> None:
        if source is self._source:
            self._retry_s = _RETRY_S
            self.transport.write(data)

    def lost(self, source: _Source) -> None:
        """Connect again: the source has ended, and another one may be there soon."""
        if source is self._source:
            self._source = None
            self.regulate()
            self._connect(self._retry_s)
            self._retry_s = min(2 * self._retry_s, _RETRY_LIMIT_S)  # until a source sends something

    def regulate(self) -> None:
        """Read from each side as long as the other has room."""
        source = self._source
        _read_if(self.transport, len(self._kept) < KEPT_BYTES if source is None else not source.is_full)
        if source is not None:
            _read_if(source.transport, not self.is_full)

    def _leave(self) -> None:
        if self._connecting is not None:
            self._connecting.cancel()
        source, self._source = self._source, None
        if source is not None:
            source.transport.close()  # what was written is still sent

    def _connect(self, after_s: float) -> None:
        if self._relay.source is not None:
            self._connecting = self._relay.loop.create_task(self._connected(self._relay.source, after_s))

    async def _connected(self, address: SocketAddress, after_s: float) -> None:
        await asyncio.sleep(after_s)
        while True:
            try:
                async with asyncio.timeout(_CONNECT_S):
                    await self._reach(address)
                    return
            except OSError as error:  # a TimeoutError is one
                logger.debug("relay: %s cannot be reached: %s", address, error)
            await asyncio.sleep(self._retry_s)
            self._retry_s = min(2 * self._retry_s, _RETRY_LIMIT_S)

    async def _reach(self, address: SocketAddress) -> None:
        make = functools.partial(_Source, self._relay, self, asyncio.current_task())
        if address.port:
            await self._relay.loop.create_connection(make, address.place, address.port)
        else:
            await self._relay.loop.create_unix_connection(make, address.place)

    def waits_for(self, task: asyncio.Task[None] | None) -> bool:
        """Return whether a connection that this task has made is wanted still."""
        return task is not None and task is self._connecting and not task.cancelling()


class _Source(asyncio.Protocol):
    """A connection to a source, for one program."""

    def __init__(self, relay: _Relay, program: _Program, task: asyncio.Task[None] | None) -> None:
        self.is_full = False
        self._relay = relay
        self._program = program
        self._task = task

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        self.transport.set_write_buffer_limits(_FULL)
        self._relay.came(self)
        if self._program.waits_for(self._task):
            self._program.joined(self)
        else:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._relay.went(self)
        self._program.lost(self)

    def data_received(self, data: bytes) -> None:
        self._program.got(self, data)

    def pause_writing(self) -> None:
        self.is_full = True
        self._program.regulate()

    def resume_writing(self) -> None:
        self.is_full = False
        self._program.regulate()


def _read_if(transport: asyncio.Transport, has_room: bool) -> None:
    if not transport.is_closing():
        with contextlib.suppress(RuntimeError):  # it is so already
            (transport.resume_reading if has_room else transport.pause_reading)()
