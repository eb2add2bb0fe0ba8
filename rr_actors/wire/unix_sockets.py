"""Unix sockets in a directory, and the process and user at the other end of a connection."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import re
import socket
import stat
import struct

import msgspec

from rr_actors.base.errors import ConfigError
from rr_actors.base.folder import Folder
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.processes.lifeline import stopped

_CREDENTIALS = struct.Struct("3i")  # process, user, group

_OF_PROCESS = re.compile(r"(\d+)-[0-9a-f]{8}\.sock")


NO_PROC = "/proc is not mounted, and processes reach their sockets by it: mount it (mount -t proc proc /proc)"
"""What a system lacks where has_proc() is false."""


def has_proc() -> bool:
    """Return whether a process finds its own descriptors below /proc."""
    return os.path.isdir("/proc/self/fd")


def new_name() -> str:
    """Return a new, unique name for a socket of this process."""
    return f"{os.getpid()}-{os.urandom(4).hex()}.sock"


def pid_of(name: str) -> int | None:
    """Return the id of the process that made a socket of this name; None if the name has another form."""
    found = _OF_PROCESS.fullmatch(name)
    return None if found is None else int(found[1])


def paused(name: str) -> str:
    """Return words for the process that made this socket if a signal has stopped it; "" for another."""
    pid = pid_of(name)
    return "" if pid is None else stopped(pid)


def _is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # the process belongs to another user
        return True
    return True


class SocketPeer(msgspec.Struct, frozen=True):
    """The process and user at the other end, as the kernel names them."""

    pid: int  # 0: the process runs in another container and has no id in this one
    uid: int

    @property
    def trusted(self) -> bool:
        """Whether the peer is of this process's user, or root."""
        return self.uid in (0, os.geteuid())

    def named(self, name: str) -> str:
        """Return the peer's name for people: "cameras (pid 4711)"."""
        return f"{name} ({self})"

    def __str__(self) -> str:
        return f"pid {self.pid}" if self.pid else "unknown process"


def peer_of(transport: asyncio.BaseTransport) -> SocketPeer:
    """Return the process and user at the other end of a connection."""
    return peer_at(transport.get_extra_info("socket"))


def peer_at(connected: socket.socket) -> SocketPeer:
    """Return the process and user at the socket's other end."""
    raw = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(raw)
    return SocketPeer(pid, uid)


REFUSALS_S = 10.0
"""Seconds for which the connections that are refused after the first are counted, and then summed up in one line."""


class Refusals:
    """The log of refused connections: the first at once, and then one line in REFUSALS_S. On the loop."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._timer: asyncio.TimerHandle | None = None
        self._unsaid = 0
        self._last = ""

    def note(self, text: str) -> None:
        """Log a refusal, or count it."""
        if self._timer is None:
            self._log.error("%s", text)
            self._timer = asyncio.get_running_loop().call_later(REFUSALS_S, self._sum_up)
        else:
            self._unsaid, self._last = self._unsaid + 1, text

    def _sum_up(self) -> None:
        self._timer = None
        if self._unsaid:
            self._say_rest()
            self._timer = asyncio.get_running_loop().call_later(REFUSALS_S, self._sum_up)

    def _say_rest(self) -> None:
        count, self._unsaid = self._unsaid, 0
        if count:
            self._log.error("%d more connections were refused within %g s; the last: %s", count, REFUSALS_S, self._last)

    def close(self) -> None:
        """Sum up what is left."""
        if self._timer is not None:
            self._timer.cancel()
        self._say_rest()


class SocketDir:
    """The socket files of a directory, reached by its descriptor: its path may be of any length, and change.

    Any thread may use it. The first thread that binds or connects opens the descriptor, which stays open. A thread that
    uses it holds the Folder until it is done: another one may find the directory removed and open it anew meanwhile.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = os.fspath(path)  # of a StateDir.run_dir, which is a real path
        self._folder: Folder | None = None
        self._closed = False

    def bind(self, name: str) -> socket.socket:
        """Make the socket file with mode 0600; it refuses connections until the caller listens.

        Raise ConfigError if the file cannot be made, or exists.
        """
        unbound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            os.fchmod(unbound.fileno(), 0o600)  # the file gets the socket's own mode
            folder = self._opened()
            unbound.bind(_address(folder, name))
        except OSError as error:
            unbound.close()
            why = wanted_by(error) or (NO_PROC if not has_proc() else error.strerror) or error
            file = f"{self._path}/{name}"
            raise ConfigError(f"cannot make the socket {file}: {why}", file=file) from error
        except BaseException:
            unbound.close()
            raise
        return unbound

    def connect(self, name: str) -> socket.socket:
        """Connect to the socket of this name without waiting.

        Raises:
            OSError: no process listens. BlockingIOError: the queue of the listening process is full.
            ValueError: the name cannot be the name of a socket.
        """
        if not name or "/" in name:
            raise ValueError(f"{name!r} is not the name of a socket")
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connected.setblocking(False)
            folder = self._opened()
            if not self.has(name):
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), f"{self._path}/{name}")
            connected.connect(_address(folder, name))
        except BaseException:
            connected.close()
            raise
        return connected

    def has(self, name: str) -> bool:
        """Return whether a socket file of this name exists; a symbolic link to one does not count."""
        try:
            folder = self._opened()
            return stat.S_ISSOCK(os.stat(name, dir_fd=folder.fd, follow_symlinks=False).st_mode)
        except OSError:
            return False

    def unlink(self, name: str) -> None:
        """Remove the socket file, if it exists."""
        with contextlib.suppress(OSError):
            self._opened().unlink(name)

    def sweep(self) -> None:
        """Remove the sockets of dead processes: a process that was killed could not do so itself."""
        folder = self._opened()
        for name in folder.names():
            pid = pid_of(name)
            if pid is not None and not _is_there(pid):
                folder.discard(name)

    def close(self) -> None:
        """Close the descriptor as soon as no thread uses it; later calls of connect() fail."""
        self._closed = True
        self._folder = None

    def _opened(self) -> Folder:
        if self._closed:
            raise FileNotFoundError(errno.ENOENT, "closed: its process is ending", self._path)
        folder = self._folder
        if folder is None or not folder.is_there():  # not opened yet; or removed, and perhaps made again
            folder = self._folder = Folder.unlinked(self._path)
        return folder


def _address(folder: Folder, name: str) -> str:
    return f"/proc/self/fd/{folder.fd}/{name}"
