"""Lifeline: no descendant of a process outlives it, however it died.

A child process leads a process group of its own and holds the read end of a pipe; its parent holds the write end. When
the parent is gone the pipe closes, and the kernel kills the whole group (signal-driven I/O, with SIGKILL as the
signal). So a child that is stopped, or holds the interpreter in an endless loop, dies as well. A thread watches the
parent, too, because a parent that was forked may have left a copy of the pipe open.

Descendants outside of the group are found by their mark, and swept. The mark is a resource limit that no kernel since
Linux 2.4 uses: the soft limit of RLIMIT_LOCKS. Every descendant inherits it, through fork, setsid, exec with another
environment, a change of name or of user, and without an open descriptor. Its upper bits are the family: all processes
of one application. Its lower bits are the owner: the process id of the child to which the descendants belong. When the
owner is dead, they are killed. A program that is meant to outlive its owner has the mark OUTLIVES, as managers/shim.py.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import select
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rr_actors.base.reporting.log import Log

logger = Log("rr_actors")

_LOCKS = 10
"""RLIMIT_LOCKS on every architecture of Linux; Python's resource module has no name for it."""
_PID_BITS = 22  # the kernel's own limit for process ids
_FAMILY_BITS = 40  # 62 in all: Python takes a limit for a signed number
OUTLIVES = 0
"""The mark of what belongs to an application, and to none of its processes."""
_ROUNDS = 20
_LOOK_S = 0.005  # between two checks of a process, if there are no pidfds
_END_S = 1.0  # the longest wait for the end of a swept process

_ENDED = (b"Z", b"X", b"")  # states of a process
_FLAGS = 6  # the place of its flags after its state
_EXITING = 0x4  # PF_EXITING

_F_SETSIG = 10  # fcntl's number on Linux; Python's fcntl module has no name for it


def hold(lifeline: int, parent_pid: int) -> None:
    """Tie this process and its group to the parent that holds the other end of the pipe `lifeline`.

    The caller must lead its process group. No process may ever write to the pipe.
    """
    fcntl.fcntl(lifeline, _F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
    # The thread also sees a parent that died before the signal was armed.
    threading.Thread(target=_watch, args=(lifeline, parent_pid), name="rr-lifeline", daemon=True).start()


def _watch(lifeline: int, parent_pid: int) -> None:
    poll = select.poll()
    poll.register(lifeline, select.POLLIN)
    with contextlib.suppress(ProcessLookupError):  # it is dead already
        parent = _pidfd(parent_pid)
        if parent >= 0:
            poll.register(parent, select.POLLIN)
        poll.poll()
    with contextlib.suppress(OSError):
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


def kill_group(leader: int) -> None:
    """SIGKILL the rest of the process group that `leader` led."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def signal_if(pid: int, number: int, is_meant: Callable[[], bool]) -> bool:
    """Send a signal to a process if `is_meant()` is true. Return whether it was sent.

    If there are pidfds, the signal never goes to a later process with the same id.
    """
    handle = -1
    try:
        handle = _pidfd(pid)
        if not is_meant():
            return False
        if handle >= 0:
            signal.pidfd_send_signal(handle, number)
        else:
            os.kill(pid, number)
    except ProcessLookupError:
        return False
    finally:
        if handle >= 0:
            os.close(handle)
    return True


def _pidfd(pid: int) -> int:
    """Return a descriptor of a process, or -1 without pidfds or without free descriptors.

    Raises:
        ProcessLookupError: there is no such process.
    """
    if not hasattr(os, "pidfd_open"):
        return -1
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        raise
    except OSError:
        return -1


def new_family() -> int:
    """Return this process's family if it was marked as an owner, else a new one at random."""
    return _own_family if _own_family is not None else int.from_bytes(os.urandom(8), "big") >> (64 - _FAMILY_BITS)


_own_family: int | None = None


def mark(family: int) -> None:
    """Make this process the owner of all descendants from now on, in the family `family`."""
    global _own_family
    _own_family = family
    hard = resource.getrlimit(_LOCKS)[1]
    try:
        resource.setrlimit(_LOCKS, (family << _PID_BITS | os.getpid(), hard))
    except (ValueError, OSError) as error:
        logger.warning(
            "what this process starts outside its process group cannot be found after its end: expected no hard limit"
            " of RLIMIT_LOCKS (ulimit -H -x), got %d (%s)",
            hard,
            error,
        )


def sweep(family: int) -> int:
    """SIGKILL every process of `family` whose owner is dead; return their number once they have ended.

    Processes that they start meanwhile are found, too. Blocks for a few ms, or for a second if one does not end.
    Without /proc it finds nothing.
    """
    swept: set[int] = set()
    for _ in range(_ROUNDS):
        orphans = list(_orphans(family))  # all of them, before the first is killed
        killed = [pid for pid, mark in orphans if _kill_marked(pid, mark)]
        deadline = time.monotonic() + _END_S
        ended = {pid for pid in killed if _wait_gone(pid, deadline)}
        swept |= ended
        if len(ended) < len(killed) or not killed:
            break
    return len(swept)


def reap(family: int, own: int | None) -> None:
    """Collect the ended processes of a family that this one has adopted, as process 1 or as a subreaper.

    They are known by a mark that this process never gives: what it starts itself has its own mark, or none. So no exit
    status is taken away for which somebody waits.

    Args:
        own: the fork server that this process has launched, which marks itself; None without one.
    """
    with contextlib.suppress(OSError):  # no children, or no such files
        if os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            return  # none has ended
        ours = _mark_of("self")
        for task in Path("/proc/self/task").iterdir():
            for pid in map(int, (task / "children").read_text().split()):
                mark = _mark_of(str(pid))
                if mark is None or mark == ours or pid == own or _stat(pid)[0] != b"Z":
                    continue
                if mark == OUTLIVES or mark >> _PID_BITS == family:
                    os.waitpid(pid, os.WNOHANG)


def _kill_marked(pid: int, mark: int) -> bool:
    try:
        return signal_if(pid, signal.SIGKILL, lambda: _mark_of(str(pid)) == mark)
    except PermissionError:  # it has become another user
        return False


def _orphans(family: int) -> Iterator[tuple[int, int]]:
    """Yield the processes of a family whose owner is dead, each with its mark."""
    names: list[str] = []
    with contextlib.suppress(OSError):
        names = os.listdir("/proc")
    marks = ((int(name), _mark_of(name)) for name in names if name.isdigit())
    members = {pid: found for pid, found in marks if found is not None and found >> _PID_BITS == family}
    for pid, found in members.items():
        owner = found & ((1 << _PID_BITS) - 1)
        if not (members.get(owner) == found and _is_alive(owner)) and _is_alive(pid):
            yield pid, found


def _mark_of(pid: str) -> int | None:
    try:
        with open(f"/proc/{pid}/limits", "rb") as file:  # noqa: PTH123  # of every process, each time
            limits = file.read()
    except OSError:
        return None
    _, found, rest = limits.partition(b"Max file locks")
    soft = rest.split(None, 1)[0] if found else b""
    return int(soft) if soft.isdigit() else None


def _is_alive(pid: int) -> bool:
    return _stat(pid)[0] not in _ENDED


def is_ending(pid: int) -> bool:
    """Return whether a process ends, or is not there: true before the kernel closes the first of its descriptors."""
    stat = _stat(pid)
    return stat[0] in _ENDED or bool(int(stat[_FLAGS]) & _EXITING)


def _stat(pid: int) -> list[bytes]:
    """Return what the kernel says of a process, from its state on; no state if the process is not there."""
    with contextlib.suppress(OSError), open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123
        return file.read().rpartition(b")")[2].split() or [b""]
    return [b""]


def stopped(pid: int) -> str:
    """Return words for a process that a signal has stopped, and that does nothing until it goes on; "" for another."""
    if _stat(pid)[0] != b"T":
        return ""
    return (
        "stopped by a signal, such as the terminal sends to a process in the background that uses it "
        f"(`kill -CONT {pid}` continues it)"
    )


def starved_s(pid: int) -> float:
    """Return how many seconds the main thread of a process has waited for a processor; 0 if the kernel does not say."""
    try:
        with open(f"/proc/{pid}/schedstat", "rb") as file:  # noqa: PTH123
            return int(file.read().split()[1]) / 1e9
    except (OSError, IndexError, ValueError):
        return 0.0


def wait_gone(pids: Iterable[int], timeout_s: float) -> bool:
    """Block until these killed processes have ended; return False if one has not within `timeout_s` seconds."""
    deadline = time.monotonic() + timeout_s
    return all(_wait_gone(pid, deadline) for pid in pids)


def _wait_gone(pid: int, deadline: float) -> bool:
    try:
        handle = _pidfd(pid)
    except ProcessLookupError:
        return True
    if handle < 0:
        return _is_seen_to_end(pid, deadline)
    try:
        return is_readable(handle, deadline - time.monotonic())
    finally:
        os.close(handle)


def _is_seen_to_end(pid: int, deadline: float) -> bool:
    while _is_alive(pid):
        if time.monotonic() >= deadline:
            return False
        time.sleep(_LOOK_S)
    return True


def is_readable(fd: int, timeout_s: float | None = 0.0) -> bool:
    """Return whether data or the end can be read within `timeout_s`; for a pidfd, whether its process has ended.

    None: wait without a limit.
    """
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(None if timeout_s is None else max(0.0, timeout_s) * 1000))
