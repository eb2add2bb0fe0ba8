"""A debugger at the terminal, for breakpoint() in a child process.

A child has no standard input, and reading from the terminal would stop it: it is in a background process group. So the
debugger opens the terminal itself, and puts the child's group into the foreground while it asks. One thread of one
process asks at a time. The child's event loop keeps running, and so does its heartbeat.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pdb
import signal
import threading
from types import FrameType
from typing import Any, TextIO

from rr_actors.base.reporting.log import Log

logger = Log("rr_actors")


class Terminal:
    """The terminal that this process was started at.

    Raises:
        OSError: the process has no terminal.
    """

    def __init__(self) -> None:
        fd = _open()
        self.input: TextIO = os.fdopen(fd, "r")
        self.output: TextIO = os.fdopen(os.dup(fd), "w")
        self._lock = threading.RLock()
        self._depth = 0
        self._foreground = 0

    def __enter__(self) -> Terminal:
        """Take the terminal. Waits while another thread or process has it."""
        self._lock.acquire()
        self._depth += 1
        if self._depth == 1:
            fcntl.flock(self.input, fcntl.LOCK_EX)
            with contextlib.suppress(OSError):  # it controls no process group of this session
                self._foreground = os.tcgetpgrp(self.input.fileno())
                self._put_forward(os.getpgrp())
        return self

    def __exit__(self, *_: object) -> None:
        """Release the terminal."""
        self._depth -= 1
        if not self._depth:
            with contextlib.suppress(OSError):  # the group that had it has ended
                self._put_forward(self._foreground)
            fcntl.flock(self.input, fcntl.LOCK_UN)
        self._lock.release()

    def _put_forward(self, group: int) -> None:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})  # would stop a background process
        try:
            os.tcsetpgrp(self.input.fileno(), group)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _open() -> int:
    with contextlib.suppress(OSError):
        return os.open("/dev/tty", os.O_RDWR | os.O_CLOEXEC)
    for fd in (2, 1):  # without a controlling terminal, the process may still write to one
        with contextlib.suppress(OSError):
            return os.open(os.ttyname(fd), os.O_RDWR | os.O_CLOEXEC | os.O_NOCTTY)
    raise OSError("no terminal")


class Debugger(pdb.Pdb):
    """Python's debugger, which holds the terminal while it asks. It does not stop in this package's own code."""

    def __init__(self, terminal: Terminal, name: str) -> None:
        super().__init__(stdin=terminal.input, stdout=terminal.output, skip=["rr_actors.*"], nosigint=True)
        self.prompt = f"(Pdb {name}) "
        self._terminal = terminal

    def interaction(self, *args: Any, **kwargs: Any) -> None:
        """Ask what to do next (pdb calls this)."""
        with self._terminal:
            super().interaction(*args, **kwargs)


_terminal: list[Terminal] = []  # of this process: opened once
_opening = threading.Lock()


def break_at(frame: FrameType, name: str) -> None:
    """Stop at the next line of the frame, and ask at the terminal. Without a terminal, log that and continue."""
    try:
        with _opening:
            if not _terminal:
                _terminal.append(Terminal())
    except OSError:
        where = f"{frame.f_code.co_filename}:{frame.f_lineno}"
        logger.warning("%s: breakpoint() at %s: there is no terminal to ask at, so it goes on", name, where)
        return
    Debugger(_terminal[0], name).set_trace(frame)
