"""Wake: wakes readers that wait for a frame."""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
from collections.abc import Sequence
from typing import Protocol

from rr_actors.streams.stream_sockets import close_in_children


class Readable(Protocol):
    """What has a descriptor."""

    def fileno(self) -> int: ...


class Wake:
    """A flag that one look takes away, and for which threads and tasks wait. It needs no lock.

    Its descriptor is closed when nobody has it any more: a finalizer cannot close it while a thread uses it.
    """

    _fd = -1
    _is_set = False

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        close_in_children(self)

    def set(self) -> None:
        """Wake who waits, or the next that does."""
        if self._fd >= 0:
            os.eventfd_write(self._fd, 1)
            self._is_set = True

    def take(self) -> bool:
        """Take the flag away; return whether it was set."""
        if not self._is_set:
            return False
        self._is_set = False
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._fd)
        return True

    def wait(self, more: Sequence[Readable], timeout_s: float | None) -> None:
        """Wait until the flag is set, or there is something to read.

        What it waits for must stay open meanwhile: its descriptor would be that of another file.
        """
        poll = select.poll()
        for fd in (self._fd, *(each.fileno() for each in more)):
            poll.register(fd, select.POLLIN)
        poll.poll(None if timeout_s is None else timeout_s * 1000)

    async def wait_async(self, more: Sequence[Readable], timeout_s: float | None) -> None:
        """Wait as wait() does, in the running loop, without a thread."""
        loop = asyncio.get_running_loop()
        ready: asyncio.Future[None] = loop.create_future()
        fds = (self._fd, *(each.fileno() for each in more))
        try:
            for fd in fds:
                loop.add_reader(fd, _end, ready)
            await asyncio.wait((ready,), timeout=timeout_s)
        finally:
            for fd in fds:
                loop.remove_reader(fd)

    def close_in_child(self) -> None:
        """Close the descriptor in a child of fork."""
        fd, self._fd = self._fd, -1
        os.close(fd)

    def __del__(self) -> None:
        fd, self._fd = self._fd, -1  # finalizers of a cycle run in any order: a reader may set it after this
        if fd >= 0:
            os.close(fd)


def _end(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)
