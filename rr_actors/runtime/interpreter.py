"""The interpreter's shared parts: its lock, its exit handlers, its signal handlers, and patches of its modules."""

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
from collections.abc import Callable
from types import FrameType, ModuleType
from typing import Any

from rr_actors.base.errors import UsageError

# Turns: how long this process's loop waits for Python's lock while a callback computes.
#
# A computing thread keeps the lock until another thread has waited for the switch interval. The loop needs the lock
# when something arrives, and again after each write of a commit, which releases it. Those later waits are made short,
# as the loop had the lock just before. Python's interval is that of the whole process, so nothing is changed in a
# process of the user's.

_SWITCH_S = 0.0003  # Python's own 5 ms would slow each load; a shorter one would slow the callback's computing
HURRIED_S = 0.00001
"""The switch interval of a commit (CommitLog)."""


class Turns:
    """The switch intervals of this process.

    Attributes:
        interval_s: the interval outside of commits: a callback may have set another.
        hurried_s: HURRIED_S as Python rounds it; 0 in a process of the user's.
    """

    def __init__(self) -> None:
        self.interval_s = _SWITCH_S
        self.hurried_s = 0.0


turns = Turns()
"""Those of this process."""


def begin() -> None:
    """Make the switch interval short in this process, which this package has started."""
    sys.setswitchinterval(HURRIED_S)
    turns.hurried_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)


# Signal handlers: a process that is forked from this one, as a worker of multiprocessing, inherits them. What they stop
# is not in it, so it would ignore SIGTERM: terminate() of such a process would do nothing, and of a Pool would hang. It
# has the handlers before them again. A signal that comes sooner waits for that: Python forgets it at a fork.

_handlers: dict[signal.Signals, tuple[Any, Any]] = {}  # this package's, and those before them
_masks = threading.local()


def handle_signal(number: signal.Signals, handler: Callable[[int, FrameType | None], object]) -> Any:
    """Have this process handle a signal, and return the handler before. A forked process has that one again."""
    before = signal.signal(number, handler)
    _handlers[number] = handler, before
    return before


def give_signal_back(number: signal.Signals, before: Any) -> None:
    """Set the handler that handle_signal() has returned."""
    _handlers.pop(number, None)
    signal.signal(number, signal.SIG_DFL if before is None else before)  # None: not set from Python


def _before_fork() -> None:
    _masks.before = signal.pthread_sigmask(signal.SIG_BLOCK, _handlers)


def _after_fork() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _masks.before)


def _after_fork_in_child() -> None:
    for number, (handler, before) in list(_handlers.items()):
        now: Any = signal.getsignal(number)
        if handler in (now, getattr(now, "handler", None)):  # a turn wraps it (actors/turns.py)
            give_signal_back(number, before)
    _after_fork()


os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork_in_child)


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


# Exit handlers: a process that a fork server makes leaves the inherited handlers to the server. Those that this package
# registers run in each process.

of_each_process: list[Callable[[], object]] = []
"""The handlers that at_exit() has registered."""


def at_exit(handler: Callable[[], object]) -> None:
    """Register a handler for the clean end of this process, and of each process that a fork server forks from it."""
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
        if patcher not in sys.modules:
            continue
        if found := [part for part in parts if _source(*_PATCHED[part]).partition(".")[0] == patcher]:
            return (
                f"{patcher} has patched {', '.join(found)} in process {os.getpid()}: no event loop can run there in a "
                f"thread of its own. Call {patch}({', '.join(f'{part}=False' for part in parts)}), or run the system "
                "in a process that is not patched: programs that connect to it (rr.connect) may be"
            )
    return ""


def check_not_patched() -> None:
    """Raise UsageError if patched()."""
    if text := patched():
        raise UsageError(text)


def _source(module: ModuleType, name: str) -> str:
    return str(getattr(getattr(module, name, None), "__module__", ""))
