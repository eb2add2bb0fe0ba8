"""Processes: start, watch, signal and fence child processes.

A child is made by a fork server (rr_actors.runtime.processes.fork_server), leads a process group of its own and is tied
to its parent (rr_actors.runtime.processes.lifeline). A pidfd shows its death. The fork server reports its exit code a
moment later; the code is unknown if the server died before.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import resource
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rr_actors.base.errors import StartFailed, text_of
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.processes import fork_server, lifeline
from rr_actors.runtime.processes.fork_server import ForkServer
from rr_actors.runtime.processes.forked_process import CODE_GRACE_S, EntryCall, ForkedProcess, Popen, launch_message

_CHILD_FDS = 4  # of a Process: its pidfd, its status, its lifeline and its control channel
_SPARE_FDS = 16  # for the fork server, the start of a child, a registrar


def keep_standard_fds() -> None:
    """Open /dev/null in the place of closed standard streams, such as a daemon's.

    Otherwise the next files and sockets get their numbers. Children would write their output into them, and uvloop ends
    the process (SIGABRT) when it has to close one of these numbers.
    """
    for fd in range(3):
        try:
            os.fstat(fd)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            os.dup2(opened, fd)  # inheritable
            if opened != fd:
                os.close(opened)
            else:
                os.set_inheritable(fd, True)


def check_descriptors(children: int, path: str) -> None:
    """Check that this process may have the descriptors for so many child processes of the supervisor at `path`.

    Raises:
        StartFailed: it may not; the text has the sum.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if not children or soft == resource.RLIM_INFINITY:
        return
    open_now = len(os.listdir("/proc/self/fd"))
    needed = open_now + _SPARE_FDS + children * _CHILD_FDS
    if needed > soft:
        text = (
            f"{path}: expected at least {needed} descriptors, which its process may have open (ulimit -n), got {soft} "
            f"(the hard limit is {hard}): {_CHILD_FDS} for each of {children} child processes, {open_now} are open, "
            f"{_SPARE_FDS} to spare"
        )
        raise StartFailed(text, id=path, wanted=wanted_by(OSError(errno.EMFILE, "")))


class Exited(NamedTuple):
    """The end of a process. `code` is its exit status, -N for signal N, or None if it is unknown."""

    code: int | None
    at: float  # time.monotonic() when it was noticed


class Process:
    """A child process for its supervisor, made by Spawner.start(). Call close() when it is dead and no longer needed.

    One thread at a time uses it: the starting thread, and then the loop's. The user's code has the ForkedProcess.
    """

    def __init__(self, child: ForkedProcess, life: int, control: socket.socket) -> None:
        self.pid = child.launched.pid
        self.control = control
        self.exited: Exited | None = None
        self._child = child
        self._popen = child.launched
        self._lifeline = life
        self._dead_at: float | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._callback: Callable[[Exited], None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._watched: int | None = None
        if self._popen.returncode is not None:
            self._collect()

    def watch(self, loop: asyncio.AbstractEventLoop, callback: Callable[[Exited], None]) -> None:
        """Call `callback` once, on `loop`, when the process has ended. Only for the loop's thread."""
        self._loop, self._callback = loop, callback
        if self.exited is not None:
            loop.call_soon(self._notify)
        else:
            self._add_reader(self._popen.sentinel, self._noticed)

    def kill(self, sig: int = signal.SIGKILL) -> bool:
        """Send a signal; return False if the process has ended. Never signals a later process with the same id."""
        return self.exited is None and self._dead_at is None and self._popen.send(sig)

    def wait(self, timeout_s: float) -> Exited | None:
        """Wait for the end of a process that is not watched, and return it; None: it has not ended in time."""
        if self.exited is None and self._popen.wait(timeout_s) is not None:
            self._collect()
        return self.exited

    def close(self) -> None:
        """Kill the process if it lives, and close its descriptors. On the loop's thread if it is watched."""
        if self._lifeline < 0:
            return
        self.kill()
        self._remove_reader()
        if self._timer is not None:
            self._timer.cancel()
        self._callback = None
        self._collect()
        with contextlib.suppress(ValueError):  # the user's code has closed it
            self._child.join(0)  # takes it from multiprocessing's active_children()
        del self._child, self._popen  # the user's code may still have them, and wait for the sentinel
        os.close(self._lifeline)
        self._lifeline = -1
        self.control.close()

    # -- on the loop: the process has died; then its exit code has come ---------------------------------------------

    def _noticed(self) -> None:
        assert self._loop is not None
        self._remove_reader()
        self._dead_at = time.monotonic()
        if lifeline.is_readable(self._popen.status):
            self._conclude()
        else:
            self._add_reader(self._popen.status, self._conclude)
            self._timer = self._loop.call_later(CODE_GRACE_S, self._conclude)

    def _conclude(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._remove_reader()
        self._collect()
        self._notify()

    def _notify(self) -> None:
        callback, self._callback = self._callback, None
        if callback is not None and self.exited is not None:
            callback(self.exited)

    def _add_reader(self, fd: int, callback: Callable[[], None]) -> None:
        assert self._loop is not None
        self._watched = fd
        self._loop.add_reader(fd, callback)

    def _remove_reader(self) -> None:
        fd, self._watched = self._watched, None
        if fd is not None and self._loop is not None:
            self._loop.remove_reader(fd)

    def _collect(self) -> None:
        self._popen.collect()
        self.exited = self.exited or Exited(self._popen.code, self._dead_at or time.monotonic())


class Spawner:
    """A starter of child processes for this process.

    Inside a child process it uses the fork server that made the child, while that runs. Otherwise it launches a server
    of its own at the first start, and again when it was killed. close() ends that server.

    Args:
        preload: modules that the fork server imports besides this package's, so that children need not.
        directory: for the fork server's socket, if no directory for temporary files can be used.
    """

    def __init__(self, preload: Sequence[str] = (), directory: str = "") -> None:
        self._preload = tuple(preload)
        self._directory = directory
        self._last_words = ""  # of the fork server that could not serve
        self._family = lifeline.new_family()
        self._lock = threading.Lock()
        self._server: ForkServer | None = None
        self._closed = False

    def start(self, entry: str, payload: bytes, *, name: str, timeout_s: float = 30.0) -> Process:
        """Start a process that calls the function `entry` ("module:function") with an Inherited.

        The function returns the exit code; then the process ends without waiting for its threads. This call blocks
        until the process exists and has read its payload, so it is not for the loop's thread.

        Args:
            timeout_s: the limit for the whole call.

        Raises:
            StartFailed: no process was started; a process that did not read its payload in time is killed.
        """
        deadline = time.monotonic() + timeout_s
        call = EntryCall(entry, payload, fork_server.environment_block())
        try:
            return self._start(call, name, deadline)
        except (OSError, EOFError) as error:
            wanted = wanted_by(error)
            if isinstance(error, EOFError | ConnectionError):  # two servers have ended in their start
                wanted = f"fork server: it ends before it answers: {self._last_words or 'it has said nothing'}"
            text = f"process {name!r} could not be started: {wanted or text_of(error)}"
            raise StartFailed(text, id=name, wanted=wanted) from error

    def _start(self, call: EntryCall, name: str, deadline: float) -> Process:
        with contextlib.ExitStack() as on_failure, contextlib.ExitStack() as theirs:
            ends = socket.socketpair()
            control = on_failure.enter_context(ends[0])
            theirs.enter_context(ends[1])
            life_r, life_w = os.pipe()
            theirs.callback(os.close, life_r)
            on_failure.callback(os.close, life_w)

            def launch(child: ForkedProcess) -> Popen:
                message = launch_message(child)
                popen = Popen(self._fork(ends[1].fileno(), life_r, deadline))
                try:
                    _write_all(life_w, message, deadline)
                except BrokenPipeError:
                    pass  # it has ended already: its last message or its exit code says why
                except OSError as error:
                    popen.kill()
                    text = f"process {name!r} (pid {popen.pid}) did not start: {error!r}"
                    raise StartFailed(text, id=name) from error
                return popen

            child = ForkedProcess(name, call, launch)
            child.start()
            on_failure.pop_all()
        return Process(child, life_w, control)

    def sweep(self) -> int:
        """SIGKILL the descendants that dead children left behind, anywhere in this process's application.

        Return their number. Blocks for a few ms. Programs that are meant to outlive their owner live on.
        """
        return lifeline.sweep(self._family)

    def reap(self) -> None:
        """Collect the ended descendants of children that this process has adopted. Quick; from any thread."""
        if self._lock.acquire(blocking=False):  # else a fork server is ending: the next call is soon enough
            try:
                lifeline.reap(self._family, None if self._server is None else self._server.pid)
            finally:
                self._lock.release()

    def close(self) -> None:
        """End the fork server if it is this spawner's own, and the descendants that children left. All children must
        have ended. Blocks for up to 2 s."""
        with self._lock:
            self._closed = True
            server, self._server = self._server, None
        if server is not None:
            server.close()
            self.sweep()

    def _fork(self, control: int, life: int, deadline: float) -> fork_server.Forked:
        began, server = time.monotonic(), self._running()
        try:
            return server.fork(control, life, deadline)
        except TimeoutError:
            if time.monotonic() - began < fork_server.ANSWER_S:
                raise  # there was little time: the server may be well
            server.kill()
            self._discard(server)
            if time.monotonic() >= deadline:
                raise
        except (ConnectionError, FileNotFoundError, EOFError):
            self._discard(server)
        return self._running().fork(control, life, deadline)  # the server was killed, or hung: try again with a new one

    def _running(self) -> ForkServer:
        with self._lock:
            if self._closed:
                raise StartFailed("the system is stopping: no process can be started any more")
            if self._server is not None and not self._server.is_running():
                self._end(self._server)
                self._server = None
            if self._server is None:
                server = fork_server.inherited
                if server is None or not server.is_running():
                    server = ForkServer.launch(self._preload, self._family, self._directory)
                self._server = server
            return self._server

    def _discard(self, server: ForkServer) -> None:
        with self._lock:
            if self._server is server:
                self._server = None
                self._end(server)

    def _end(self, server: ForkServer) -> None:
        server.close()
        self._last_words = server.last_words


def signal_name(number: int) -> str:
    """Return the name of a signal, "SIGKILL" for 9."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _write_all(fd: int, message: bytes, deadline: float) -> None:
    os.set_blocking(fd, False)
    writable = select.poll()
    writable.register(fd, select.POLLOUT)
    rest = memoryview(message)
    while rest:
        if not writable.poll(max(0.0, deadline - time.monotonic()) * 1000):
            raise TimeoutError("it did not read what it was sent in time")
        rest = rest[os.write(fd, rest) :]
