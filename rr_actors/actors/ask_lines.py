"""AskLines: connections to one other process for threads that ask its actors, and wait.

The shortest way: the thread writes its question and reads the answer itself; this process's loop has no part in it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rr_actors.errors import RrError
from rr_actors.transport import Exchange

_DIAL_S = 0.1  # a process that takes longer to shake hands is busy, or hangs: the loop has more patience
_AGAIN_S = 1.0
_LIMIT = 16  # each takes a file descriptor here, and two there; more threads than that share the link


class AskLines:
    """Those of one process to another one. From any thread.

    Attributes:
        closed: whether there are none any more.

    Args:
        dial: makes one, within so many seconds; None if there are none.
    """

    def __init__(self, dial: Callable[[float], Exchange | None]) -> None:
        self._dial = dial
        self._lock = threading.Lock()
        self._idle: list[Exchange] = []
        self._in_use: dict[Exchange, int] = {}  # by which thread
        self._dialling: set[int] = set()  # the threads that dial
        self._dial_after = 0.0
        self.closed = False

    def take(self, timeout_s: float | None) -> Exchange | None:
        """Return one for the calling thread alone, which must give it back or take it out; None: there is none now.

        Args:
            timeout_s: the most that dialling may take, if it is less than what it may take anyway.
        """
        me = threading.get_ident()
        try:
            with self._lock:
                if self.closed or len(self._in_use) + len(self._dialling) >= _LIMIT:
                    return None
                if self._idle:
                    line = self._idle[-1]
                    self._in_use[line] = me
                    del self._idle[-1]
                    return line
                self._dialling.add(me)
            return self._open(me, _DIAL_S if timeout_s is None else min(timeout_s, _DIAL_S))
        except BaseException:  # KeyboardInterrupt, say: nobody has it
            self._drop_mine(me)
            raise
        finally:
            self._dialling.discard(me)

    def _open(self, me: int, timeout_s: float) -> Exchange | None:
        if time.monotonic() < self._dial_after:
            return None
        try:
            line = self._dial(timeout_s)
        except RrError:
            line = None
        if line is None:
            self._dial_after = time.monotonic() + _AGAIN_S
            return None
        with self._lock:
            if not self.closed:
                self._in_use[line] = me
                return line
        line.close()
        return None

    def _drop_mine(self, me: int) -> None:
        with self._lock:
            mine = [line for line, thread in self._in_use.items() if thread == me]
            for line in mine:
                del self._in_use[line]
        for line in mine:
            line.close()

    def give_back(self, line: Exchange) -> None:
        """It has been answered, and is for the next."""
        with self._lock:
            self._in_use.pop(line, None)
            if not self.closed:
                self._idle.append(line)
                return
        line.close()

    def take_out(self, line: Exchange) -> bool:
        """It is not for anybody else, and the caller's to close; False if the calling thread has given it back."""
        with self._lock:
            if self._in_use.get(line) != threading.get_ident():
                return False
            del self._in_use[line]
            return True

    def close(self) -> None:
        """Let all of them go; threads that wait hear that they are lost."""
        with self._lock:
            self.closed = True
            idle, self._idle = self._idle, []
            for line in self._in_use:
                line.cut()
        for line in idle:
            line.close()
