"""Unix sockets in a directory, and what the kernel says of who is at the other end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
import sys
from pathlib import Path

import msgspec

from rr_actors.errors import ConfigError

_SUN_PATH_BYTES = 100  # sockaddr_un.sun_path holds 108 with its end on Linux, 104 on macOS


class Peer(msgspec.Struct, frozen=True):
    """Who the kernel says is at the other end; None where it does not say."""

    pid: int | None
    uid: int | None

    @property
    def trusted(self) -> bool:
        """Whether it is our own user, or root."""
        return self.uid is None or self.uid in (0, os.geteuid())

    def named(self, name: str) -> str:
        """Return its name for people: "cameras (pid 4711)"."""
        return f"{name} ({self})"

    def __str__(self) -> str:
        return f"pid {self.pid}" if self.pid else "unknown process"


def peer_of(transport: asyncio.BaseTransport) -> Peer:
    """Return who is at the other end of a connection."""
    option = getattr(socket, "SO_PEERCRED", None)  # Linux
    if option is None:
        return Peer(None, None)
    credentials = struct.Struct("3i")
    try:
        raw = transport.get_extra_info("socket").getsockopt(socket.SOL_SOCKET, option, credentials.size)
    except OSError:  # it has gone already
        return Peer(None, None)
    pid, uid, _ = credentials.unpack(raw)
    return Peer(pid, uid)


class SocketDir:
    """The socket files of a directory, however long its path is.

    A path over the limit of sockaddr_un is reached through /proc/self/fd, by a descriptor of the directory.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._fd = -1

    def bind(self, name: str) -> socket.socket:
        """Make the socket file, mode 0600; it refuses connections until somebody listens."""
        unbound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            address = self._address_of(name)
            unbound.bind(address)
            os.chmod(address, 0o600)
        except OSError as error:
            unbound.close()
            raise ConfigError(
                f"cannot make the socket {self._path / name}: {error.strerror or error}", file=str(self._path / name)
            ) from error
        except BaseException:
            unbound.close()
            raise
        return unbound

    def connect(self, name: str) -> socket.socket:
        """Connect, without waiting.

        Raises:
            OSError: nobody is there. BlockingIOError: too many wait there to be accepted.
            ValueError: that is no socket's name.
        """
        if not name or "/" in name:
            raise ValueError(f"{name!r} is not the name of a socket")
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connected.setblocking(False)
            connected.connect(self._address_of(name))
        except BaseException:
            connected.close()
            raise
        return connected

    def unlink(self, name: str) -> None:
        """Remove the socket file, if it is there."""
        with contextlib.suppress(OSError):
            os.unlink(self._path / name)

    def close(self) -> None:
        """Give the descriptor back."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _address_of(self, name: str) -> str:
        path = str(self._path / name)
        if len(os.fsencode(path)) <= _SUN_PATH_BYTES:
            return path
        if not sys.platform.startswith("linux"):
            raise ConfigError(
                f"the path of a socket is too long: {path!r}; expected at most {_SUN_PATH_BYTES} bytes: "
                "choose a shorter state_dir",
                expected=_SUN_PATH_BYTES,
                got=len(os.fsencode(path)),
            )
        if self._fd < 0:
            self._fd = os.open(self._path, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        return f"/proc/self/fd/{self._fd}/{name}"
