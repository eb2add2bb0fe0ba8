"""The interpreter that everything shares: its lock, its signal handlers, and its exit handlers."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

# Turns: how long this process's loop waits for Python's lock while a callback computes.
#
# A thread that computes keeps the lock until another thread has waited for as long as the switch interval. The loop
# needs it once when something arrives, and again each time that a commit has released it (for each write): those waits
# are cut short, as the loop has only just given the lock away. Python's interval is the process's, so nothing is
# changed where the process is the user's.

A = TypeVar("A")

_SWITCH_S = 0.0003  # Python's own 5 ms would be felt in each load; less takes much of what the callback could compute
_AGAIN_S = 0.00001


class _Process:
    def __init__(self) -> None:
        self.ours = False
        self.interval_s = _SWITCH_S  # while nobody is in a hurry: a callback may have set another
        self.hurried_s = 0.0  # as Python has it, which is not quite _AGAIN_S


_process = _Process()


def begin() -> None:
    """Make the interval short in this process, which is one of this package's own."""
    sys.setswitchinterval(_AGAIN_S)
    _process.hurried_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    _process.ours = True


def name_process(name: str) -> None:
    """Have ps, top and htop show this process by a name, of which the kernel keeps 15 bytes. From any thread."""
    with contextlib.suppress(OSError):  # a system without /proc: it goes by python then
        Path("/proc/self/comm").write_bytes(name.encode()[:15])


def hurried(work: Callable[[A], object], argument: A) -> None:
    """Call work(argument), which releases the lock for a moment, and is to have it again soon. From any thread."""
    if not _process.ours:
        work(argument)
        return
    interval_s = sys.getswitchinterval()
    if interval_s != _process.hurried_s:  # else another thread is in a hurry, too
        _process.interval_s = interval_s
    try:
        sys.setswitchinterval(_AGAIN_S)
        work(argument)
    finally:
        sys.setswitchinterval(_process.interval_s)


# Interruptions: whether a Python signal handler may run in this thread between any two of its instructions.
#
# A handler may stop the system, or call anything else that waits for the loop: what the loop may have to wait for must
# not be held then. Only the main thread runs handlers, and by default there is none but that of Ctrl-C, which raises.

_SIGNALS = tuple(signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP})
_LOOK_AGAIN_S = 0.05  # looking takes some 40 us


class _Interruptions:
    def __init__(self) -> None:
        self.main = threading.main_thread().ident
        self.look_at = 0.0
        self.found = False


_interruptions = _Interruptions()


def possible() -> bool:
    """Whether a handler other than that of Ctrl-C may interrupt the calling thread; as it was lately."""
    if threading.get_ident() != _interruptions.main:
        return False
    now = time.monotonic()
    if now >= _interruptions.look_at:
        _interruptions.found = any(_waits(signal.getsignal(number)) for number in _SIGNALS)
        _interruptions.look_at = now + _LOOK_AGAIN_S
    return _interruptions.found


def _waits(handler: object) -> bool:
    return callable(handler) and handler is not signal.default_int_handler


def _look_who_is_main() -> None:
    _interruptions.main = threading.main_thread().ident  # in a forked child it is the thread that forked


os.register_at_fork(after_in_child=_look_who_is_main)


# Exit handlers: a process that a fork server makes leaves those to the server that it was forked with. What this
# package registers is for each process.

of_each_process: list[Callable[[], object]] = []
"""What at_exit() has registered."""


def at_exit(handler: Callable[[], object]) -> None:
    """Have `handler` called when this process ends in order, and when one does that a fork server makes of it."""
    of_each_process.append(handler)
    atexit.register(handler)
