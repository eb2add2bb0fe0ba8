"""What the two ends of a stream say to each other, where they meet, and that a child of fork has neither.

The name of a publisher's socket is in the kernel's abstract namespace. So nothing is left when the process is killed,
and a respawned manager can take the name at once.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import termios
import weakref
from pathlib import Path
from typing import Protocol

import msgspec

from rr_actors.base.errors import UsageError
from rr_actors.streams.stream import Keep, Stream
from rr_actors.wire.segments import Parcel

IN_BAND_BYTES = 128 * 1024
"""The longest frame that goes over the socket if there is no shared memory for it."""

LARGE_FRAME_BYTES = 64 * 1024
"""How long a frame is at least that goes through shared memory: there it is once, for all readers."""

PACKET_BYTES = IN_BAND_BYTES + 4096
MOST_DEPTH = 1000

WISH, AWAY, LOOK = b"\0", b"\1", b"\2"
"""What a reader sends: that it can take one frame more; that it waits no longer, and will look later what there is; and
that it looks now. Who looks gets the newest frame, or the note NOTHING_NEWER."""

NOTHING_NEWER = "nothing newer"
"""A note: the newest frame has been sent."""

OPENED = "opened"
OPENED_ONCE = "its server has recovery='keep' and no recover callback, so nobody opens the stream again"
"""The notes of which the publisher sends one to each new reader, with the time at which the stream was opened."""

_LISTENS = 0x10000  # the flag of a listening socket in /proc/net/unix
_FIELDS = 8  # of a line there that has a name
_CREDENTIALS = struct.Struct("3i")
_COUNT = struct.Struct("i")


class Hello(msgspec.Struct, frozen=True, array_like=True):
    """The first packet of a reader. `before`: the stream that it has read until now."""

    keep: Keep
    depth: int
    registrar: str = ""
    before: Stream | None = None


class Packet(msgspec.Struct, frozen=True, array_like=True):
    """A packet of the publisher: a frame, or a note about frames that are not sent."""

    number: int
    published_at: float
    body: bytes | Parcel
    note: str = ""


hello_of = msgspec.msgpack.Decoder(Hello).decode
packet_of = msgspec.msgpack.Decoder(Packet).decode


def address_of(stream: Stream) -> str:
    """Return the address of a stream's publisher."""
    return f"\0rr_actors/{stream.resource_id}/{stream.name}"


def known_streams(resource_id: str) -> dict[str, bool]:
    """Return the names of the streams that the resource has now, and whether readers are let in."""
    start = f"@rr_actors/{resource_id}/".encode()
    known: dict[str, bool] = {}
    for line in Path("/proc/net/unix").read_bytes().split(b"\n"):  # the sockets of all programs: names are any bytes
        fields = line.split(None, _FIELDS - 1)
        if len(fields) == _FIELDS and fields[-1].startswith(start):
            name = fields[-1].removeprefix(start).decode(errors="replace")
            known[name] = known.get(name, False) or bool(int(fields[3], 16) & _LISTENS)
    return known


def pid_of(connected: socket.socket) -> int:
    """Return the other end's process; raise PermissionError if it runs as another user."""
    raw = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(raw)
    if uid != os.geteuid():
        raise PermissionError("the other end of the stream runs as another user")
    return pid


class ReaderSocket:
    """The publisher's end of a reader's connection. It does not block."""

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        self.pid = pid_of(connected)
        self._socket = connected
        self.recv = connected.recv
        self.send = connected.send
        self.fileno = connected.fileno
        self.close = connected.close

    def has_unread(self) -> bool:
        """Return whether the reader has still to read a packet."""
        with contextlib.suppress(OSError):
            return _COUNT.unpack(fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(_COUNT.size)))[0] > 0
        return False

    def end(self) -> None:
        """Have the reader hear that it gets nothing more here. It connects again, and says when it has no values."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)


class Forkable(Protocol):
    """What has descriptors that a child of fork must not have."""

    def close_in_child(self) -> None:
        """Close them. In the child, which has no other thread."""


_forkables: weakref.WeakSet[Forkable] = weakref.WeakSet()

close_in_children = _forkables.add
"""Have the descriptors of an object closed in each child of fork, as long as the object lives."""


def _after_fork_in_child() -> None:
    for forkable in list(_forkables):
        with contextlib.suppress(OSError):
            forkable.close_in_child()


os.register_at_fork(after_in_child=_after_fork_in_child)


def check_process(pid: int, what: str) -> None:
    """Raise UsageError in a child of the process that has opened something."""
    if os.getpid() != pid:
        raise UsageError(f"{what}: process {pid} has opened it, and this is another: a child of fork cannot use it")
