"""Bells: an idle worker thread waits for its bell.

A thread that is woken while its waker holds Python's lock sleeps again at once, until it gets the lock: that is most of
the cost of a hand-over between threads. An EventBell is rung without the lock. It takes two file descriptors, so only a
few workers have one.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections import deque


def new_bell(*, quick: bool) -> Bell:
    """Return an EventBell if `quick` is true and file descriptors are left, else a LockBell."""
    if quick:
        try:
            return EventBell()
        except OSError:
            pass  # no descriptors: a LockBell is slower
    return LockBell()


class LockBell:
    """A bell without a descriptor: there may be any number of them."""

    __slots__ = ("_lock",)

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def ring(self) -> None:
        """End the present wait, or the next one."""
        with contextlib.suppress(RuntimeError):  # it has been rung
            self._lock.release()

    def wait(self, timeout_s: float = -1) -> bool:
        """Wait for a ring, at most `timeout_s` seconds (for ever if negative); return whether there was one."""
        return self._lock.acquire(timeout=timeout_s)

    def close(self) -> None:
        """Close the bell's descriptors, of which this one has none. No thread may ring it any more."""


class EventBell:
    """A bell that wakes quickly, with the methods of LockBell.

    The thread that rings it releases Python's lock, so the woken thread can begin at once. It is closed at the latest
    when its last reference is gone.

    Raises:
        OSError: the process has no file descriptors left.
    """

    __slots__ = ("_fd", "_held", "_poll")

    def __init__(self) -> None:
        self._held: list[int] = []
        self._poll = select.epoll()
        # All in C: a signal handler runs before this line or after it, so the descriptor is never lost.
        self._held.extend(map(os.eventfd, (0,)))
        self._fd = self._held[0]
        self._poll.register(self._fd, select.EPOLLIN | select.EPOLLET)  # each ring is seen once: no need to read it

    def ring(self) -> None:
        os.eventfd_write(self._fd, 1)

    def wait(self, timeout_s: float = -1) -> bool:
        return bool(self._poll.poll(timeout_s, 1))

    def close(self) -> None:
        """Close the bell's descriptors. A second call does nothing."""
        self._poll.close()
        self._fd = -1
        deque(map(os.close, map(self._held.pop, (0,) * len(self._held))), maxlen=0)  # in C, as above

    def __del__(self) -> None:
        if getattr(self, "_held", None):  # it is missing if __init__ was interrupted at once
            self.close()


Bell = LockBell | EventBell
"""A bell that any thread rings, once for each wait."""
