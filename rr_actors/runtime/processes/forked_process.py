"""ForkedProcess: a process of multiprocessing that this package's own fork server makes.

multiprocessing.active_children() lists it in the parent; in the child, current_process() returns it. Only the launch is
this package's own. multiprocessing asks a class of processes for a `_Popen`, and that for poll(), wait(), terminate(),
kill(), close(), `pid` and `sentinel`. In the child, multiprocessing.spawn.spawn_main() reads what launch_message() has
written, and begins the process.

This module has the two private names of multiprocessing that this package uses:

- `_Popen`: by it each class of processes has a launch of its own. multiprocessing's launch by a fork server waits
  without a limit, and takes the end of that server for the end of its children (docs/on-multiprocessing.md).
- `_exit_function`: the handler at the exit of each process. A child registers it anew, as the handlers of the fork
  server are not its own. multiprocessing would call it, too, but then wait for the child's threads without a limit.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable
from multiprocessing import process, reduction, util
from multiprocessing.context import ForkServerProcess, set_spawning_popen
from typing import Any, cast

import msgspec

from rr_actors.base.errors import StartFailed
from rr_actors.runtime.processes import fork_server, lifeline
from rr_actors.runtime.processes.fork_server import Forked

end_multiprocessing: Callable[[], None] = vars(util)["_exit_function"]
"""multiprocessing's handler for the exit of a process."""

LOST = 255
"""The exit code for multiprocessing if nobody knows it. multiprocessing's own fork server has the same."""
CODE_GRACE_S = 0.25
"""The longest wait for the exit code after a death, in seconds."""


class EntryCall(msgspec.Struct, frozen=True):
    """What a child does: call the function `entry`, "module:function", in this environment_block()."""

    entry: str
    payload: bytes
    environment: bytes


def _nowhere(call: EntryCall) -> None:
    raise RuntimeError(f"{call.entry}: expected a child of a fork server of rr_actors, got process {os.getpid()}")


run_call: Callable[[EntryCall], None] = _nowhere
"""What a child does with its EntryCall. Set by rr_actors/runtime/processes/child_bootstrap.py in a child."""


def _run(call: EntryCall) -> None:
    run_call(call)


class ForkedProcess(ForkServerProcess):
    """A child process, for multiprocessing. start() makes it by `launch`, and raises what that raises.

    Raises:
        StartFailed: this process is daemonic: multiprocessing lets it have no children.
    """

    launched: Popen
    """What start() has launched."""

    def __init__(self, name: str, call: EntryCall, launch: Callable[[ForkedProcess], Popen]) -> None:
        if process.current_process().daemon:
            text = (
                f"process {name!r} could not be started: this process ({process.current_process().name}) is daemonic, "
                "and multiprocessing lets daemonic processes have no children: make it by "
                "multiprocessing.Process(daemon=False) or concurrent.futures.ProcessPoolExecutor"
            )
            raise StartFailed(text, id=name)
        super().__init__(target=_run, args=(call,), name=name)
        self.launch = launch

    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802  # multiprocessing calls it in start()
        launch = process_obj.__dict__.pop("launch")  # it is not pickled
        process_obj.launched = launch(process_obj)
        return process_obj.launched


class Popen:
    """A launched process, as multiprocessing wants it. Used from any thread.

    Its descriptors are closed when nothing refers to it any more, as a user's thread may wait for the sentinel.

    Attributes:
        returncode: its exit code, -N for signal N, or LOST; None while it lives, as far as anybody has looked.
        code: the same, but None if it is unknown.
        sentinel: a descriptor that is readable once it has ended.
        status: a descriptor that is readable once its exit code is known, or can be known no more.
    """

    def __init__(self, forked: Forked) -> None:
        self.pid = forked.pid
        self.returncode: int | None = None
        self.code: int | None = None
        self.status = forked.status
        self._parent = os.getpid()
        self._lock = threading.Lock()
        self._pidfd = -1  # a Python that was built on a Linux before 5.3 has no pidfds
        fds = [self.status]
        weakref.finalize(self, _close, os.getpid(), fds).atexit = False
        if hasattr(os, "pidfd_open"):
            try:
                self._pidfd = os.pidfd_open(self.pid)
                fds.append(self._pidfd)
            except ProcessLookupError:
                self.collect(CODE_GRACE_S)
        self.sentinel = self._pidfd if self._pidfd >= 0 else self.status
        if lifeline.is_readable(self.status):
            self.collect()  # it died before the pidfd was opened, which may belong to another process

    def poll(self, flag: int = os.WNOHANG) -> int | None:
        """Return the exit code if the process has ended. In a process that was forked from the parent: LOST."""
        if self._parent != os.getpid():
            return LOST  # so multiprocessing does not take it for a child of that process, which cannot wait for it
        if self.returncode is None and lifeline.is_readable(self.sentinel):
            self.collect(CODE_GRACE_S)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait `timeout` seconds at most for the end, and return the exit code; None: it lives.

        While the interpreter exits, a wait without a limit returns LOST: what lives then ends after the interpreter.
        """
        if self._parent == os.getpid() and self.returncode is None:
            if timeout is None and util.is_exiting():
                return LOST
            lifeline.is_readable(self.sentinel, timeout)
        return self.poll()

    def send(self, number: int) -> bool:
        """Send a signal; return False if the process has ended. Never signals a later process with the same id."""
        if self.returncode is not None or self._parent != os.getpid():
            return False
        try:
            if self._pidfd >= 0:
                signal.pidfd_send_signal(self._pidfd, number)
            else:
                os.kill(self.pid, number)
        except ProcessLookupError:
            return False
        return True

    def interrupt(self) -> None:
        """Send SIGINT."""
        self.send(signal.SIGINT)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send(signal.SIGKILL)

    def close(self) -> None:
        """Do nothing: its supervisor may still use it."""

    def collect(self, grace_s: float = 0.0) -> None:
        """Take the exit code of a process that has ended, when it has come, but `grace_s` from now at the latest."""
        has_come = lifeline.is_readable(self.status, grace_s)
        with self._lock:
            if self.returncode is not None:
                return
            if has_come:
                with contextlib.suppress(EOFError, OSError):  # the fork server has ended before
                    self.code = fork_server.read_signed(self.status)
            self.returncode = LOST if self.code is None else self.code


def _close(owner: int, fds: list[int]) -> None:
    if owner == os.getpid():
        for fd in fds:
            os.close(fd)


def launch_message(child: ForkedProcess) -> bytes:
    """Return what multiprocessing.spawn.spawn_main() reads in the child: surroundings, and the process.

    The parent's __main__ is not among them, which multiprocessing would run again in the child. Nor does this fix the
    parent's start method, as multiprocessing's own launch does.
    """
    surroundings: dict[str, Any] = {
        "name": child.name,
        "authkey": bytes(process.current_process().authkey),  # multiprocessing's class refuses to be pickled
        "sys_path": fork_server.sys_path(),
        "sys_argv": sys.argv,
        "orig_dir": fork_server.ORIGINAL_DIR,
        "start_method": "forkserver",
        **_logging(),
    }
    with contextlib.suppress(OSError):  # the working directory may be gone
        surroundings["dir"] = os.getcwd()
    message = io.BytesIO()
    set_spawning_popen(cast("Any", child))  # by it the authkey of the child can be pickled
    try:
        reduction.dump(surroundings, message)
        reduction.dump(child, message)
    finally:
        set_spawning_popen(None)
    return message.getvalue()


def _logging() -> dict[str, Any]:
    """Return what the child does for multiprocessing's log, as log_to_stderr() and the level of its logger say here."""
    logger = logging.getLogger(util.LOGGER_NAME)
    if logger.level == logging.NOTSET and not logger.handlers:
        return {}
    shows = any(type(handler) is logging.StreamHandler for handler in logger.handlers)  # a FileHandler is one, too
    return {"log_to_stderr": shows, "log_level": logger.getEffectiveLevel()}
