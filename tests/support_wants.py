"""A counting shim for want: the n-th request for something outside is refused, in the process that a test chooses.

The application calls `Wants(path)`; its fork server imports this module (SystemConfig.preload), and its children have
it from there. What is refused and counted is in a file that all of them map. Only requests of the package count, not
those of tests.
"""

from __future__ import annotations

import errno
import mmap
import os
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rr_actors

PLACE = "RR_TESTS_WANTS"
ROLES = ("application", "server", "child")
_STATE = struct.Struct("6q")  # armed: role, kind, the first and last number; counted; refused
_PACKAGE = str(Path(rr_actors.__file__).parent)
_lock = threading.Lock()

KINDS: dict[str, int] = {
    "memory": errno.ENOMEM,
    "processes": errno.EAGAIN,
    "threads": errno.EAGAIN,
    "descriptors": errno.EMFILE,
    "inodes": errno.ENOSPC,
}
_NAMES = tuple(KINDS)


class _Shim:
    """What refuses in this process."""

    def __init__(self, path: str, role: str) -> None:
        self._role = role
        self._pid = os.getpid()
        self._replaced: list[tuple[Any, str, Any]] = []
        with open(path, "r+b", buffering=0) as file:  # noqa: PTH123
            self.state = mmap.mmap(file.fileno(), _STATE.size)

    def _is_refused(self, kind: str) -> bool:
        role, armed, at, last, counted, refused = _STATE.unpack_from(self.state)
        mine = self._role if os.getpid() == self._pid else "child"
        if not at or _NAMES[armed] != kind or ROLES[role] != mine or not _is_of_package():
            return False
        with _lock:
            role, armed, at, last, counted, refused = _STATE.unpack_from(self.state)
            counted += 1
            refuses = at <= counted <= last
            _STATE.pack_into(self.state, 0, role, armed, at, last, counted, refused + refuses)
        return refuses

    def check(self, *kinds: str) -> None:
        """Raise what the kernel or Python raises if the request is refused."""
        for kind in kinds:
            if self._is_refused(kind):
                if kind == "threads":
                    raise RuntimeError("can't start new thread")
                number = KINDS[kind]
                raise OSError(number, os.strerror(number))

    def put(self, owner: Any, name: str, *kinds: str, when: Callable[..., bool] = lambda *_, **__: True) -> None:
        """Replace a function or method by one that may refuse."""
        real = getattr(owner, name, None)
        if real is None:  # another Python
            return

        def asked(*args: Any, **options: Any) -> Any:
            if when(*args, **options):
                self.check(*kinds)
            return real(*args, **options)

        self._replaced.append((owner, name, vars(owner).get(name)))
        setattr(owner, name, asked)

    def remove(self) -> None:
        """Put everything back in its place."""
        for owner, name, own in reversed(self._replaced):
            if own is None:  # it was the base class's
                delattr(owner, name)
            else:
                setattr(owner, name, own)

    def install(self) -> None:
        """Replace all that asks for something outside."""
        for name in ("_start_new_thread", "_start_joinable_thread"):
            self.put(threading, name, "threads")
        self.put(os, "fork", "processes", "memory")
        self.put(subprocess, "_fork_exec", "processes", "memory")
        self.put(mmap, "mmap", "memory")
        for name in ("pipe", "pipe2", "eventfd", "dup", "pidfd_open", "listdir"):
            self.put(os, name, "descriptors")
        self.put(os, "open", "descriptors")
        self.put(os, "open", "inodes", when=lambda _path, flags, *_, **__: bool(flags & os.O_CREAT))
        for name in ("mkdir", "symlink"):
            self.put(os, name, "inodes")
        self.put(socket, "socketpair", "descriptors")
        self.put(socket.socket, "_accept", "descriptors")
        self.put(socket.socket, "bind", "inodes", when=lambda end, *_: end.family == socket.AF_UNIX)
        self.put(socket.socket, "__init__", "descriptors", when=_is_new)


def _is_new(_self: Any, *args: Any, fileno: int | None = None, **_: Any) -> bool:
    return fileno is None and len(args) < 4


def _is_of_package() -> bool:
    frame = sys._getframe(3)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(_PACKAGE):
            return True
        frame = frame.f_back
    return False


class Wants:
    """The shim of a test, in the test's own process: the application."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(bytes(_STATE.size))
        os.environ[PLACE] = str(path)
        self._shim = _Shim(str(path), "application")
        self._shim.install()

    def remove(self) -> None:
        """Take the shim out of this process."""
        self.disarm()
        self._shim.remove()

    def arm(self, role: str, kind: str, at: int, *, lasts: bool = False) -> None:
        """Refuse request number `at`, from 1, for this in such a process; and all later ones if the want `lasts`."""
        last = 2**62 if lasts else at
        _STATE.pack_into(self._shim.state, 0, ROLES.index(role), _NAMES.index(kind), at, last, 0, 0)

    @property
    def refused(self) -> int:
        """How many requests were refused since arm()."""
        return _STATE.unpack_from(self._shim.state)[5]

    def disarm(self) -> bool:
        """Refuse nothing any more. Return whether a request was refused."""
        refused = self.refused
        _STATE.pack_into(self._shim.state, 0, 0, 0, 0, 0, 0, 0)
        return bool(refused)


if PLACE in os.environ and "pytest" not in sys.modules:
    _Shim(os.environ[PLACE], "server").install()
