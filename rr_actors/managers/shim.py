"""The shim: a small process between the program manager and one program, which outlives the manager.

The shim is the program's parent, whether the manager lives or not: it learns the exit code, and reaps the program. It
reads the output, so that the last lines are kept. It holds a lock while it lives: so one instance of a program runs,
however often a start was interrupted and repeated. It shares no pipe with the manager.

Run as ``python -I -S shim.py DIRECTORY`` with the order (a JSON object, see `Order` in external_programs.py) on
standard input.
In DIRECTORY, which the manager makes and removes:

- ``lock``         held (flock) while this process lives
- ``state.json``   the state, replaced atomically: shim and program [pid, start ticks], ready, failed, ended ...
- ``output.log``   the program's output; when it gets long it becomes output.old and begins anew. With `inherit` in its
                 order it goes to the shim's own output, too: that of the manager.

At SIGTERM the shim ends the program. It imports only the standard library, so it starts in 15 ms and needs 9 MB.
"""
# ruff: noqa: PTH123 (pathlib would make the start a third longer)

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import re
import resource
import select
import signal
import sys
import time
from types import FrameType
from typing import Any, NamedTuple

LOG_LIMIT_BYTES = 256 * 1024
LINE_LIMIT_BYTES = 64 * 1024
_LONGEST_SLICE_S = 0.25  # of the grace
_SAVED_AGAIN_S = 0.25
TAKEN = 75  # exit code of a shim that is not needed: another holds the lock, the directory is gone, or no order came

_PR_SET_PDEATHSIG = 1
_RLIMIT_LOCKS = 10
_PR_SET_CHILD_SUBREAPER = 36


def start_ticks(pid: int) -> int:
    """Return when the process started, in clock ticks since boot. With the pid this always names one process.

    Raises:
        OSError: there is no such process.
    """
    with open(f"/proc/{pid}/stat", "rb") as file:
        return int(file.read().rpartition(b")")[2].split()[19])  # the name in parentheses may hold anything


def main(directory: str) -> int:
    """Run one program to its end, and return this shim's exit code."""
    _outlive()
    try:
        order: dict[str, Any] = json.loads(sys.stdin.buffer.read())
    except ValueError:
        return TAKEN  # the manager died while it was writing: the next one orders again
    if not _lock(directory):
        return TAKEN
    _adopt_orphans()
    Shim(order).run()
    return 0


def _outlive() -> None:
    """Replace the mark of processes that end with the manager (OUTLIVES in rr_actors/runtime/processes/lifeline.py)."""
    resource.setrlimit(_RLIMIT_LOCKS, (0, resource.getrlimit(_RLIMIT_LOCKS)[1]))


def _lock(directory: str) -> bool:
    """Enter the directory and lock it; return whether this shim has the lock. The descriptor stays open to keep it."""
    try:
        os.chdir(directory)
        descriptor = os.open("lock", os.O_RDWR | os.O_CLOEXEC)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.fstat(descriptor).st_ino == os.stat("lock").st_ino  # else it was removed meanwhile: not needed
    except OSError:
        return False


def _adopt_orphans() -> None:
    """Become the parent of descendants whose own parent dies, so that the shim can end the program's daemons, too."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


class _Interrupted(Exception):
    """A signal came during the search for the line that says ready."""


class Shim:
    """One program, from its start to the end of its last descendant."""

    def __init__(self, order: dict[str, Any]) -> None:
        self._order = order
        self._pattern = re.compile(order["ready_line"].encode()) if order["ready_line"] else None
        self._state: dict[str, Any] = {
            "shim": [os.getpid(), start_ticks(os.getpid())],
            "grace_s": order["grace_s"],
            "ready": self._pattern is None,
        }
        self._pid = 0
        self._output = -1
        self._line = b""
        self._log_bytes = 0
        self._asked = False  # to stop
        self._searching = False
        self._grace_s: float | None = None  # what is left of it, once the program is being stopped
        self._slice_s = min(order["grace_s"] / 16, _LONGEST_SLICE_S)
        self._counted_at = 0.0
        self._ended = False
        self._is_behind = False  # the state on disk
        self._wakeup = self._catch_signals()

    def run(self) -> None:
        """Start the program and copy its output, until the program and all its descendants are gone."""
        if not self._start():
            return
        while not self._ended:
            self._wait()
            if self._is_behind:
                self._save()
            self._reap()
            if self._asked and self._grace_s is None:
                self._begin_stop()
            if self._is_grace_over():
                break
        self._kill_all()
        self._copy_output()
        self._save()  # after the last line of the output is in the log

    # -- start -----------------------------------------------------------------------------------------------------

    def _catch_signals(self) -> int:
        wakeup, written = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.set_wakeup_fd(written, warn_on_full_buffer=False)
        signal.signal(signal.SIGTERM, self._asked_to_stop)
        signal.signal(signal.SIGCHLD, _ignore)  # with a handler the signal wakes the poll
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
            signal.signal(number, signal.SIG_IGN)
        return wakeup

    def _start(self) -> bool:
        self._output, output_end = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        failure, failure_end = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(output_end, True)
        parent = os.getpid()
        self._pid = os.fork()  # this process has one thread, so fork is safe
        if self._pid == 0:
            _become(self._order, output_end, failure_end, parent)
        os.close(output_end)
        os.close(failure_end)
        with open(failure, "rb") as file:
            error = file.read().decode(errors="replace")  # the read ends when exec has closed the other end
        if error:
            os.waitpid(self._pid, 0)
            number, _, self._state["failed"] = error.partition(" ")
            self._state["errno"] = int(number)
        else:
            self._state["program"] = [self._pid, start_ticks(self._pid)]
        self._save()
        return not error

    # -- while it runs ---------------------------------------------------------------------------------------------

    def _wait(self) -> None:
        """Sleep until there is output, a child's end, a signal, or a slice of the grace is over."""
        poll = select.poll()
        poll.register(self._wakeup, select.POLLIN)
        if self._output >= 0:
            poll.register(self._output, select.POLLIN)
        slice_s = None if self._grace_s is None else min(self._grace_s, self._slice_s)
        if self._is_behind:
            slice_s = _SAVED_AGAIN_S if slice_s is None else min(slice_s, _SAVED_AGAIN_S)
        for descriptor, _ in poll.poll(None if slice_s is None else int(slice_s * 1000) + 1):
            if descriptor == self._output:
                self._copy_output()
            else:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wakeup, 4096)

    def _copy_output(self) -> None:
        while self._output >= 0:
            try:
                data = os.read(self._output, 65536)
            except BlockingIOError:
                return
            if not data:
                os.close(self._output)
                self._output = -1
            self._log(data)
            self._pass_on(data)
            self._look_for_ready(data)
            if not self._ended:
                return  # a program that writes without end must not delay the handling of signals

    def _log(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # a full disk must not end the program
            if self._log_bytes > LOG_LIMIT_BYTES:
                os.replace("output.log", "output.old")
                self._log_bytes = 0
            with open("output.log", "ab", buffering=0) as file:
                file.write(data)
            self._log_bytes += len(data)

    def _pass_on(self, data: bytes) -> None:
        """Copy the output to where the manager's goes, as far as somebody reads that now."""
        if not self._order.get("inherit"):
            return
        ready = select.poll()
        ready.register(1, select.POLLOUT)
        for begin in range(0, len(data), select.PIPE_BUF):  # that much is written without waiting, or nothing
            with contextlib.suppress(OSError):
                if ready.poll(0) and os.write(1, data[begin : begin + select.PIPE_BUF]) >= 0:
                    continue
            return

    def _look_for_ready(self, data: bytes) -> None:
        if self._pattern is None:
            return
        *lines, self._line = (self._line + data).split(b"\n")
        self._line = self._line[-LINE_LIMIT_BYTES:]
        try:
            self._searching = True
            found = any(self._pattern.search(line) for line in lines)
            self._searching = False
        except _Interrupted:
            return
        if found:
            self._pattern = None
            self._state["ready"] = True
            self._save()

    # -- the end ---------------------------------------------------------------------------------------------------

    def _asked_to_stop(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        if self._searching:  # the user's pattern, which may take for ever: this breaks it off
            self._searching = False
            raise _Interrupted

    def _begin_stop(self) -> None:
        self._grace_s = self._order["grace_s"]
        self._counted_at = time.monotonic()
        self._state["stopped"] = True
        self._signal_all(self._order["stop_signal"])
        _write(self._order["group"], "cgroup.freeze", "0")  # a paused program acts on no signal
        self._signal_all(signal.SIGCONT)

    def _is_grace_over(self) -> bool:
        """Count a slice at most: this process may have stood still longer, and the program with it."""
        if self._grace_s is None:
            return False
        now = time.monotonic()
        self._grace_s -= min(now - self._counted_at, self._slice_s)
        self._counted_at = now
        return self._grace_s <= 0

    def _reap(self) -> None:
        """Reap every child that has ended, and note the end of the program."""
        with contextlib.suppress(ChildProcessError):
            while True:
                pid, status = os.waitpid(-1, os.WNOHANG)
                if pid == 0:
                    return
                if self._note_end(pid, status) and self._grace_s is None:
                    self._ended = True  # it ended unasked: its descendants have no purpose any more
        self._ended = True  # no child is left

    def _note_end(self, pid: int, status: int) -> bool:
        if pid != self._pid:
            return False
        code = os.waitstatus_to_exitcode(status)
        self._state["ended"] = {"code": code} if code >= 0 else {"signal": -code}
        return True

    def _kill_all(self) -> None:
        """Send SIGKILL to the group and every descendant, round by round, until none of this user is left."""
        self._signal_group(signal.SIGKILL)
        while [pid for pid in _children() if _kill(pid)]:
            self._note_end(*os.waitpid(-1, 0))
        self._reap()
        self._ended = True

    def _signal_all(self, number: int) -> None:
        """Send a signal once to the group, and to each descendant that has left it for a session or group of its own.

        What they start while they act on it, such as a command that cleans up, does not get it.
        """
        outside = [one for one in _descendants() if one.group != self._pid]
        self._signal_group(number)
        for one in outside:
            one.signal(number)

    def _signal_group(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._pid, number)

    def _save(self) -> None:
        """Write the state; if the disk is full, which must not end the program, do so when it has room again."""
        self._is_behind = True
        with contextlib.suppress(OSError):
            with open("state.json.new", "w") as file:
                json.dump(self._state, file)
            os.replace("state.json.new", "state.json")
            self._is_behind = False


def _become(order: dict[str, Any], output: int, failure: int, parent: int) -> None:
    """Turn the forked child into the program; never return."""
    try:
        signal.set_wakeup_fd(-1)
        for number in (signal.SIGTERM, signal.SIGCHLD, signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
            signal.signal(number, signal.SIG_DFL)
        os.setsid()
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:
            os._exit(127)  # the shim died before the death signal was set
        _write(order["group"], "cgroup.procs", "0")
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(order["directory"])
        _execute(order["command"], order["arguments"], order["environment"])
    except BaseException as error:  # nothing may unwind into the shim's own loop
        number = getattr(error, "errno", None) or 0
        os.write(failure, f"{number} {type(error).__name__}: {error}".encode())
    finally:
        os._exit(127)


def _write(group: str | None, file: str, text: str) -> None:
    """Write to a file of the program's control group, if it has one."""
    if group is not None:
        with contextlib.suppress(OSError), open(f"{group}/{file}", "w") as found:
            found.write(text)


def _execute(command: str, arguments: list[str], environment: dict[str, str]) -> None:
    try:
        os.execvpe(command, [command, *arguments], environment)
    except FileNotFoundError:
        import shutil  # here, since it takes ms

        found = shutil.which(command, path=environment.get("PATH"))
        if found is None:
            raise
        with open(found, "rb") as file:
            first = file.readline(200).decode(errors="replace").removesuffix("\n")
        what = f"its interpreter {first[2:]!r}" if first.startswith("#!") else "its loader"
        raise FileNotFoundError(f"{found} is there, but not {what}") from None


class _Process(NamedTuple):
    """A process as /proc has it; pid and start together always name one process."""

    pid: int
    parent: int
    group: int
    start: int

    def signal(self, number: int) -> None:
        """Send it a signal; do nothing if it is gone, or this user may not."""
        with contextlib.suppress(OSError):
            descriptor = os.pidfd_open(self.pid)
            try:
                if start_ticks(self.pid) == self.start:  # else another process has got the pid
                    signal.pidfd_send_signal(descriptor, number)
            finally:
                os.close(descriptor)


def _processes() -> list[_Process]:
    """Return all processes, zombies too (/proc/*/task/*/children is not in every kernel)."""
    found: list[_Process] = []
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
                words = file.read().rpartition(b")")[2].split()  # the name in parentheses may hold anything
                found.append(_Process(int(name), int(words[1]), int(words[2]), int(words[19])))
    return found


def _children() -> list[int]:
    return [one.pid for one in _processes() if one.parent == os.getpid()]


def _descendants() -> list[_Process]:
    """Return all that the program has started: this process is the parent of those whose own parent has ended."""
    below: dict[int, list[_Process]] = {}
    for one in _processes():
        below.setdefault(one.parent, []).append(one)
    found = below.get(os.getpid(), [])
    for one in found:  # which grows meanwhile
        found.extend(below.get(one.pid, []))
    return found


def _kill(pid: int) -> bool:
    """Send SIGKILL to a child; return False if this user may not, as after sudo."""
    try:
        os.kill(pid, signal.SIGKILL)
    except PermissionError:
        return False
    return True


def _ignore(number: int, frame: FrameType | None) -> None:
    """Do nothing: the signal has woken the poll."""


if __name__ == "__main__":
    code = main(sys.argv[1])
    os._exit(code)  # without the interpreter's clean-up, which takes a few ms
