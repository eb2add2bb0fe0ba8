"""ThreadConnections: the connections to one other process that threads of this one have to themselves.

A thread that sends a question and waits for the answer writes the one and reads the other itself: this process's loop
has no part in it. Actors are asked so, and registrars load and unload so. Each connection is one thread's until it is
given back; when there is none to be had, the question goes by the link that the loop has.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from rr_actors.base.errors import RrError
from rr_actors.wire.transport import Exchange

_DIAL_S = 0.1  # a process that takes longer to shake hands is busy, or hangs: the loop has more patience
_AGAIN_S = 1.0
_LIMIT = 16  # each takes a file descriptor here, and two there; more threads than that share the link

E = TypeVar("E", bound=Exchange)


class ThreadConnections(Generic[E]):
    """Those of one process to another one, as long as the link beside them is up. From any thread.

    Attributes:
        closed: whether there are none any more.

    Args:
        dial: makes one, within so many seconds; None if there are none.
    """

    def __init__(self, dial: Callable[[float], E | None]) -> None:
        self._dial = dial
        self._lock = threading.Lock()  # of who dials, or closes
        self._idle: list[E] = []
        self._in_use: dict[E, int] = {}  # by which thread
        self._dialling: set[int] = set()  # the threads that dial
        self._dial_after = 0.0
        self.closed = False

    def take(self, timeout_s: float | None) -> E | None:
        """Return one for the calling thread alone, which must give it back or take it out; None: there is none now.

        Args:
            timeout_s: the most that dialling may take, if it is less than what it may take anyway.
        """
        try:
            line = self._idle.pop()
        except IndexError:
            return self._dialled(timeout_s)
        self._in_use[line] = threading.get_ident()
        if self.closed:  # perhaps since those in use were cut
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
            return self._open(me, _DIAL_S if timeout_s is None else min(timeout_s, _DIAL_S))
        except BaseException:  # KeyboardInterrupt, say: nobody has it
            self.drop_mine()
            raise
        finally:
            self._dialling.discard(me)

    def _open(self, me: int, timeout_s: float) -> E | None:
        if time.monotonic() < self._dial_after:
            return None
        try:
            line = self._dial(timeout_s)
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

    def give_back(self, line: E) -> None:
        """It has been answered, and is for the next."""
        if self._in_use.pop(line, None) is None:
            line.close()
            return
        self._idle.append(line)
        if self.closed:  # perhaps since all that were there were closed
            self._close_idle()

    def take_out(self, line: E) -> bool:
        """It is not for anybody else, and the caller's to close; False if the calling thread has given it back."""
        return self._in_use.get(line) == threading.get_ident() and self._in_use.pop(line, None) is not None

    def drop(self, line: E) -> None:
        """Close one that is lost, or whose answer nobody waits for, unless the calling thread has given it back."""
        if self.take_out(line):
            line.close()

    def drop_mine(self) -> None:
        """As drop(), of whatever the calling thread has: it may have been interrupted as it got it."""
        me = threading.get_ident()
        for line in [line for line, thread in list(self._in_use.items()) if thread == me]:
            self.drop(line)

    def cut(self, line: E) -> None:
        """Have the thread that waits on it hear that it is lost; nothing happens if none does."""
        if line in self._in_use:
            line.cut()

    def close(self) -> None:
        """Let all of them go; threads that wait hear that they are lost."""
        with self._lock:
            self.closed = True
        for line in list(self._in_use):
            line.cut()
        self._close_idle()

    def _close_idle(self) -> None:
        while self._idle:
            with contextlib.suppress(IndexError):  # another thread was faster
                self._idle.pop().close()
