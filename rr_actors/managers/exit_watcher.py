"""ExitWatcher: learns by pidfds when processes end, children or not. One thread watches all of them."""

from __future__ import annotations

import contextlib
import os
import select
import selectors
import signal
import socket
import threading
from collections.abc import Callable

from rr_actors.base.reporting.log import Log
from rr_actors.managers.shim import start_ticks

logger = Log("rr_actors.managers.exit_watcher")


class ProcessHandle:
    """A handle on one process, never on a later process with the same pid. Close it when done."""

    def __init__(self, pid: int, ticks: int | None = None) -> None:
        """Open a handle on the process `pid` that started `ticks` clock ticks after boot (None: any start).

        Raises:
            ProcessLookupError: the process is gone.
            OSError: no descriptor is left.
        """
        self.pid = pid
        self._fd = os.pidfd_open(pid)
        try:
            if ticks is not None and start_ticks(pid) != ticks:
                raise ProcessLookupError(f"pid {pid} is another process by now")
        except OSError as error:
            os.close(self._fd)
            if isinstance(error, FileNotFoundError):
                raise ProcessLookupError(str(error)) from error
            raise

    def fileno(self) -> int:
        """Return the process's pidfd, which becomes readable when the process ends."""
        return self._fd

    def send_signal(self, number: int) -> None:
        """Send the process a signal; do nothing if it has ended."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._fd, number)

    def wait(self, timeout_s: float) -> bool:
        """Wait, and return whether the process has ended within the time. A child of this process is then reaped."""
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        if not poll.poll(max(0.0, timeout_s) * 1000):
            return False
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PIDFD, self._fd, os.WEXITED)
        return True

    def close(self) -> None:
        """Close the handle; the process runs on."""
        os.close(self._fd)


class ExitWatcher:
    """Calls back when a process ends. `watch` and `forget` may come from any thread; callbacks run in the watcher's."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callbacks: dict[ProcessHandle, Callable[[], None]] = {}
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="exit-watcher", daemon=True)
        self._thread.start()

    def watch(self, handle: ProcessHandle, callback: Callable[[], None]) -> None:
        """Have `callback` called once when the process ends, or at once if it has. The watcher closes the handle."""
        with self._lock:
            if self._closed:
                handle.close()
                return
            self._callbacks[handle] = callback
            self._selector.register(handle, selectors.EVENT_READ)

    def forget(self, handle: ProcessHandle) -> bool:
        """Stop watching a process; return False if its callback has been called, or is about to be."""
        with self._lock:
            if self._callbacks.pop(handle, None) is None:
                return False
            self._selector.unregister(handle)
            handle.close()
            return True

    def close(self) -> None:
        """Stop watching all processes, which run on, and return when no callback runs any more."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._wake.send(b"x")  # under the lock, without which the watcher's thread does not close the socket
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while not self._closed:
            for key, _ in self._selector.select():
                if isinstance(key.fileobj, ProcessHandle):
                    self._ended(key.fileobj)
        with self._lock:
            for handle in self._callbacks:
                handle.close()
            self._callbacks.clear()
        self._selector.close()
        self._wake.close()
        self._woken.close()

    def _ended(self, handle: ProcessHandle) -> None:
        with self._lock:
            if handle not in self._callbacks or not handle.wait(0):
                return  # forgotten meanwhile, or its descriptor belongs to another process by now
            callback = self._callbacks.pop(handle)
            self._selector.unregister(handle)
            handle.close()
        try:
            callback()
        except Exception:  # a defect, or no descriptor is left: the thread has to hear of other ends
            logger.exception("pid %d has ended, and its callback failed", handle.pid)
