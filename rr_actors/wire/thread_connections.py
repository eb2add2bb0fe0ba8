"""ThreadConnections: connections to one other process, each for one thread of this process at a time.

A thread that waits for an answer writes the question and reads the answer itself, without this process's event loop.
Asks of actors use this, and loads and unloads of registrars. A thread has its connection alone until it gives it back.
If no connection is available, the question goes over the loop's link.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from rr_actors.base.errors import RrError
from rr_actors.wire.transport import Exchange

_DIAL_S = 0.1  # a process with a slower handshake is busy, or hangs: then the loop waits for it
_AGAIN_S = 1.0
_LIMIT = 16  # each takes one file descriptor in this process, two in the other; more threads share the link

E = TypeVar("E", bound=Exchange)


class ThreadConnections(Generic[E]):
    """The connections of one process to another, as long as the link beside them is up. From any thread.

    Attributes:
        closed: whether close() was called.

    Args:
        dial: opens a connection within the given number of seconds; returns None if it cannot.
    """

    def __init__(self, dial: Callable[[float], E | None]) -> None:
        self._dial = dial
        self._lock = threading.Lock()  # held to begin dialling, and to close
        self._idle: list[E] = []
        self._in_use: dict[E, int] = {}  # and the thread that uses it
        self._dialling: set[int] = set()  # the threads that dial
        self._dial_after = 0.0
        self.closed = False

    def take(self, timeout_s: float | None) -> E | None:
        """Return a connection for the calling thread alone, which must give it back or take it out; None: none is free.

        Args:
            timeout_s: how long opening a connection may take, if that is less than the usual limit of 0.1 s.
        """
        try:
            line = self._idle.pop()
        except IndexError:
            return self._dialled(timeout_s)
        self._in_use[line] = threading.get_ident()
        if self.closed:  # perhaps after close() had cut the connections in use
            self.drop(line)
            return None
        return line

    def _dialled(self, timeout_s: float | None) -> E | None:
        me = threading.get_ident()
        try:
            with self._lock:
                if self.closed or len(self._in_use) + len(self._dialling) >= _LIMIT:
                    return None
                self._dialling.add(me)
            if time.monotonic() < self._dial_after:
                return None
            try:
                line = self._dial(_DIAL_S if timeout_s is None else min(timeout_s, _DIAL_S))
            except RrError:
                line = None
            if line is None:
                self._dial_after = time.monotonic() + _AGAIN_S
                return None
            self._in_use[line] = me
            if self.closed:
                self.drop(line)
                return None
            return line
        except BaseException:  # such as KeyboardInterrupt: no caller gets the connection
            self.drop_mine()
            raise
        finally:
            self._dialling.discard(me)

    def give_back(self, line: E) -> None:
        """Make a connection available to other threads: its question has been answered."""
        if self._in_use.pop(line, None) is None:
            line.close()
            return
        self._idle.append(line)
        if self.closed:  # perhaps after close() had closed the idle connections
            self._close_idle()

    def take_out(self, line: E) -> bool:
        """Remove a connection, which the caller must close; return False if the calling thread has given it back."""
        return self._in_use.get(line) == threading.get_ident() and self._in_use.pop(line, None) is not None

    def drop(self, line: E) -> None:
        """Close a connection that is lost or has an answer to come, unless the calling thread has given it back."""
        if self.take_out(line):
            line.close()

    def drop_mine(self) -> None:
        """Drop all connections of the calling thread, which may have been interrupted in take()."""
        me = threading.get_ident()
        for line in [line for line, thread in list(self._in_use.items()) if thread == me]:
            self.drop(line)

    def cut(self, line: E) -> None:
        """End a connection that is in use: for the thread that waits on it, it is lost. Else do nothing."""
        if line in self._in_use:
            line.cut()

    def close(self) -> None:
        """Close all connections; for threads that wait on them, they are lost."""
        with self._lock:
            self.closed = True
        for line in list(self._in_use):
            line.cut()
        self._close_idle()

    def _close_idle(self) -> None:
        while self._idle:
            with contextlib.suppress(IndexError):  # another thread was faster
                self._idle.pop().close()
