"""Lifeline: nothing that a process started outlives it, however it died.

A child process leads a process group of its own and holds the read end of a pipe whose write end is its parent's. When
the parent is gone the pipe closes, and the kernel itself kills the whole group (signal-driven I/O, with SIGKILL as the
signal), so a child that is stopped, or holds the interpreter in an endless loop, dies as well. A thread watches too,
for platforms without that, and for parents that were forked and left a copy of the pipe open.

What left the group (its own session) is found by a mark in its environment and swept. Programs that are meant to
outlive the one who started them are given a session of their own and an environment without the mark: unmarked().
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

MARK = "RR_ACTORS_PROCESS"
"""Environment variable of every process below a Spawner: the marks of its ancestors and its own, joined by "/"."""

_F_SETSIG = 10  # fcntl's number on Linux; Python's fcntl module has no name for it


def hold(lifeline: int, parent_pid: int) -> None:
    """Tie this process and its group to the parent that holds the other end of the pipe `lifeline`.

    The caller must lead its process group. Nothing may ever be written to the pipe.
    """
    if sys.platform == "linux":
        fcntl.fcntl(lifeline, _F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpid())
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
    # The thread also sees a parent that died before the signal was armed.
    threading.Thread(target=_watch, args=(lifeline, parent_pid), name="rr-lifeline", daemon=True).start()


def _watch(lifeline: int, parent_pid: int) -> None:
    poll = select.poll()
    poll.register(lifeline, select.POLLIN)
    parent = -1
    with contextlib.suppress(AttributeError, OSError):
        parent = os.pidfd_open(parent_pid)
        poll.register(parent, select.POLLIN)
    if not (hasattr(os, "pidfd_open") and parent < 0):  # with pidfds and none to be had, the parent is dead already
        poll.poll()
    with contextlib.suppress(OSError):
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


def kill_group(leader: int) -> None:
    """SIGKILL what is left of the process group that `leader` led."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def sweep(*marks: str) -> int:
    """SIGKILL every process whose environment has one of these marks; return how many. Blocks for a few ms.

    Needs /proc; elsewhere it finds nothing.
    """
    swept = 0
    wanted = {mark.encode() for mark in marks}
    for entry in Path("/proc").glob("[0-9]*"):
        pid = int(entry.name)
        if pid == os.getpid() or not _is_marked(pid, wanted):
            continue
        with contextlib.suppress(OSError):
            handle = os.pidfd_open(pid)
            try:
                if _is_marked(pid, wanted):  # read again under the handle: the id may have gone to another process
                    signal.pidfd_send_signal(handle, signal.SIGKILL)
                    swept += 1
            finally:
                os.close(handle)
    return swept


def wait_gone(pids: Iterable[int], timeout_s: float) -> bool:
    """Block until these processes, which are being killed, have ended; False if one has not within `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    return all(_wait_gone(pid, deadline) for pid in pids)


def _wait_gone(pid: int, deadline: float) -> bool:
    try:
        handle = os.pidfd_open(pid)
    except (AttributeError, OSError):
        return True
    try:
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        return bool(poll.poll(max(0.0, deadline - time.monotonic()) * 1000))
    finally:
        os.close(handle)


def unmarked(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for a program that is to outlive whoever starts it; it needs a session of its own, too."""
    return {name: value for name, value in environment.items() if name != MARK}


def _is_marked(pid: int, wanted: set[bytes]) -> bool:
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
    prefix = f"{MARK}=".encode()
    return any(wanted.intersection(v[len(prefix) :].split(b"/")) for v in variables if v.startswith(prefix))
