"""Bells: what an idle worker thread waits for.

A thread that is woken while its waker holds Python's lock goes to sleep again at once, for the lock: that is most of
what a hand-over between threads costs. An EventBell is rung without the lock. It takes two file descriptors, so only a
few workers have one.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
from collections import deque
from typing import Protocol


def new_bell(*, quick: bool) -> Bell:
    """An EventBell, if it is to be quick and there are file descriptors, else a LockBell."""
    if quick:
        try:
            return EventBell()
        except OSError:
            pass  # it will be slower
    return LockBell()


class Bell(Protocol):
    """Rung once for each wait; by whichever thread."""

    def ring(self) -> None:
        """Let the wait return, or the next one."""
        ...

    def wait(self, timeout_s: float = -1) -> bool:
        """Wait until it is rung, at most `timeout_s` seconds (for ever if negative); whether it was."""
        ...

    def close(self) -> None:
        """Give its descriptors back. Nobody may ring it any more."""
        ...


class LockBell:
    """A Bell that has no descriptor: there may be as many as you like."""

    __slots__ = ("_lock",)

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def ring(self) -> None:
        with contextlib.suppress(RuntimeError):  # it has been rung
            self._lock.release()

    def wait(self, timeout_s: float = -1) -> bool:
        return self._lock.acquire(timeout=timeout_s)

    def close(self) -> None:
        """It has no descriptor to give back."""


class EventBell:
    """A Bell that wakes quickly.

    The thread that rings it releases Python's lock, so the woken thread can begin at once. Closed at the
    latest when nobody has it any more.

    Raises:
        OSError: the process has no file descriptors left.
    """

    __slots__ = ("_fd", "_held", "_poll")

    def __init__(self) -> None:
        self._held: list[int] = []
        self._poll = select.epoll()
        # In C from the call to the list: an interrupt comes before it or after it, and never loses the descriptor.
        self._held.extend(map(os.eventfd, (0,)))
        self._fd = self._held[0]
        self._poll.register(self._fd, select.EPOLLIN | select.EPOLLET)  # each ring is seen once: no need to read it

    def ring(self) -> None:
        os.eventfd_write(self._fd, 1)

    def wait(self, timeout_s: float = -1) -> bool:
        return bool(self._poll.poll(timeout_s, 1))

    def close(self) -> None:
        """Give its descriptors back. A second call does nothing."""
        self._poll.close()
        self._fd = -1
        deque(map(os.close, map(self._held.pop, (0,) * len(self._held))), maxlen=0)  # in C, as above

    def __del__(self) -> None:
        if getattr(self, "_held", None):  # not there if its making was interrupted at once
            self.close()
