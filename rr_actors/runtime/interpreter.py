"""The interpreter's shared parts: its lock, its signal handlers, its exit handlers, and patches of its modules."""

from __future__ import annotations

import _thread
import atexit
import contextlib
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import ModuleType
from typing import TypeVar

from rr_actors.base.errors import UsageError

# Turns: how long this process's loop waits for Python's lock while a callback computes.
#
# A computing thread keeps the lock until another thread has waited for the switch interval. The loop needs the lock
# when something arrives, and again after each write of a commit, which releases it. Those later waits are made short,
# as the loop had the lock just before. Python's interval is that of the whole process, so nothing is changed in a
# process of the user's.

A = TypeVar("A")

_SWITCH_S = 0.0003  # Python's own 5 ms would slow each load; a shorter one would slow the callback's computing
_AGAIN_S = 0.00001


class _Process:
    def __init__(self) -> None:
        self.interval_s = _SWITCH_S  # the interval outside of hurried(): a callback may have set another
        self.hurried_s = 0.0  # _AGAIN_S as Python rounds it; 0 in a process of the user's


_process = _Process()


def begin() -> None:
    """Make the switch interval short in this process, which this package has started."""
    sys.setswitchinterval(_AGAIN_S)
    _process.hurried_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)


def python(what: str) -> str:
    """Return the path of this Python interpreter, by which `what` runs a program of this package.

    Raises:
        UsageError: this is a frozen program, which would run itself again, or Python is built into a program.
    """
    if sys.executable and not is_frozen():
        return sys.executable
    raise UsageError(f"{what}: refused in a frozen program, which has no Python interpreter (sys.executable) to run it")


def is_frozen() -> bool:
    """Return whether this is a frozen program (PyInstaller, cx_Freeze, Nuitka): sys.executable is the program."""
    return getattr(sys, "frozen", False)


def name_process(name: str) -> None:
    """Set the name by which ps, top and htop show this process; the kernel keeps 15 bytes. From any thread."""
    with contextlib.suppress(OSError):  # a system without /proc: the name stays "python"
        comm = os.open("/proc/self/comm", os.O_WRONLY | os.O_CLOEXEC)
        try:
            os.write(comm, name.encode()[:15])
        finally:
            os.close(comm)


def hurried(work: Callable[[A], object], argument: A) -> None:
    """Call work(argument), which releases Python's lock for a moment, and get the lock back soon. From any thread."""
    if not _process.hurried_s:
        work(argument)
        return
    interval_s = sys.getswitchinterval()
    if interval_s != _process.hurried_s:  # otherwise another thread is in hurried(), too
        _process.interval_s = interval_s
    try:
        sys.setswitchinterval(_AGAIN_S)
        work(argument)
    finally:
        sys.setswitchinterval(_process.interval_s)


# Interruptions: whether a Python signal handler may run in this thread between any two of its instructions.
#
# A handler may stop the system, or make another call that waits for the loop. The thread must then hold no lock that
# the loop needs. Only the main thread runs handlers, and by default the only one is that of Ctrl-C, which raises.

_SIGNALS = tuple(signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP})
_LOOK_AGAIN_S = 0.05  # asking for all handlers takes some 40 us


class _Interruptions:
    def __init__(self) -> None:
        self.main = threading.main_thread().ident
        self.look_at = 0.0
        self.found = False


_interruptions = _Interruptions()


def possible() -> bool:
    """Return whether a handler other than that of Ctrl-C may interrupt the calling thread; up to 50 ms old."""
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


# Exit handlers: a process that a fork server makes leaves the inherited handlers to the server. Those that this package
# registers run in each process.

of_each_process: list[Callable[[], object]] = []
"""The handlers that at_exit() has registered."""


def at_exit(handler: Callable[[], object]) -> None:
    """Register a handler for the orderly end of this process, and of each process that a fork server forks from it."""
    of_each_process.append(handler)
    atexit.register(handler)


# Patches: gevent and eventlet put functions of their own into modules of the standard library. A thread is then a
# greenlet of the thread that made it, and the first one that waits in C code, as an event loop does, stops them all.

_PATCHED = {
    "thread": (_thread, "start_new_thread"),
    "select": (select, "select"),
    "socket": (socket, "socket"),
    "subprocess": (subprocess, "Popen"),
    "queue": (queue, "SimpleQueue"),
    "os": (os, "read"),
}
_PATCHERS = {
    "gevent": ("gevent.monkey.patch_all", ("thread", "select", "socket", "subprocess", "queue")),
    "eventlet": ("eventlet.monkey_patch", ("thread", "select", "socket", "subprocess", "os")),
}


def patched() -> str:
    """Say what gevent or eventlet has replaced of what this package's threads and processes need; "" if nothing."""
    for patcher, (patch, parts) in _PATCHERS.items():
        if found := [part for part in parts if _source(*_PATCHED[part]).partition(".")[0] == patcher]:
            return (
                f"{patcher} has patched {', '.join(found)} in process {os.getpid()}: no event loop can run there in a "
                f"thread of its own. Call {patch}({', '.join(f'{part}=False' for part in parts)}), or run the system "
                "in a process that is not patched: its clients (rr.connect) may be"
            )
    return ""


def check_not_patched() -> None:
    """Raise UsageError if patched()."""
    if text := patched():
        raise UsageError(text)


def _source(module: ModuleType, name: str) -> str:
    return str(getattr(getattr(module, name, None), "__module__", ""))
