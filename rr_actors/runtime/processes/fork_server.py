"""The fork server as those see it who start processes: launched, asked for a child, ended.

A fork server is a small process without threads that has imported the package already; it forks children, collects
them and tells their exit codes. Its main loop is the standard library's
(rr_actors/runtime/processes/child_bootstrap.py). It is launched and asked
by our own few lines, because those of multiprocessing.forkserver.ForkServer tie it to a resource tracker and to this
process's default start method, and do not use the server that a child inherits. Unlike there, the parent's __main__ is
not run again in the child: what a child needs travels by value.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing import process, reduction
from multiprocessing.context import ForkServerProcess, set_spawning_popen
from typing import Any

import msgspec

from rr_actors.runtime.processes import lifeline

# What the standard library keeps for itself; the same in Python 3.11, 3.12 and 3.13.
_ORIGINAL_DIR: str | None = vars(process)["ORIGINAL_DIR"]
_interpreter_flags: Callable[[], list[str]] = vars(subprocess)["_args_from_interpreter_flags"]

_LEAVE_GRACE_S = 2.0
ANSWER_S = 5.0
"""How long a server that has answered before may take; the first answer waits for its imports."""
_ALIKE_BYTES = 1 << 24
"""Branches of two processes that are this far apart, or a multiple of it, are one branch to some processors, which then
predict those of both wrongly: messages between the two take a third longer on one core (docs/performance.md)."""
_PLACINGS = 5
_SIGNED = struct.Struct("q")  # how the standard library's fork server writes process ids and exit codes


class Inherited(msgspec.Struct, frozen=True):
    """What the entry function of a child process is called with."""

    name: str
    payload: bytes
    control: socket.socket


class Forked(msgspec.Struct, frozen=True):
    """A new process: its id, a pipe that will tell its exit code, and one that takes its launch message."""

    pid: int
    status: int
    data: int


class ForkServer:
    """A running fork server: one's own, launched here, or the one that this process was forked by.

    Args:
        address: a descriptor of its socket's file, which is unlinked.
        alive: the write end of a pipe: the server ends when this closes. No child has it, nor what a child starts: a
            process that outlived its parent would keep the server from ending. -1: another process has it.
        server: as it was launched here; an int: our parent's id, as long as it lives.
    """

    def __init__(self, address: int, alive: int, server: subprocess.Popen[bytes] | int) -> None:
        self._address = address
        self._alive = alive
        self._server = server
        self._has_answered = isinstance(server, int)

    @classmethod
    def launch(cls, preload: Sequence[str], family: int) -> ForkServer:
        """Start a server that has imported the modules `preload`. Returns at once; the first child waits for it."""
        with contextlib.ExitStack() as on_failure, contextlib.ExitStack() as theirs:
            listener = theirs.enter_context(socket.socket(socket.AF_UNIX))
            address = _bind(listener)
            on_failure.callback(os.close, address)
            listener.listen(512)
            alive_r, alive_w = _pipe(theirs, on_failure)
            fds = (listener.fileno(), alive_r, address)
            call = (
                f"{_placed_apart()}; sys.path[:] = {_sys_path()!r}; "
                "from rr_actors.runtime.processes.child_bootstrap import serve; "
                f"serve({fds[0]}, {fds[1]}, {fds[2]}, {tuple(preload)!r}, {family})"
            )
            server = _interpreter(call, fds)
            on_failure.pop_all()
        return cls(address, alive_w, server)

    def fork(self, fds: Sequence[int], deadline: float) -> Forked:
        """Make a process that inherits `fds`. Blocks until `deadline` (time.monotonic) at most.

        Raises:
            TimeoutError: the server has not answered in time.
            OSError, EOFError: there is no server.
        """
        if self._has_answered:
            deadline = min(deadline, time.monotonic() + ANSWER_S)
        with contextlib.ExitStack() as on_failure, contextlib.ExitStack() as theirs:
            status_r, status_w = _pipe(on_failure, theirs)
            data_r, data_w = _pipe(theirs, on_failure)
            null = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
            theirs.callback(os.close, null)
            tracker = _tracker()
            with socket.socket(socket.AF_UNIX) as client:
                client.settimeout(max(0.001, deadline - time.monotonic()))
                client.connect(f"/proc/self/fd/{self._address}")
                reduction.sendfds(client, [data_r, status_w, null, null if tracker is None else tracker, *fds])
            theirs.close()  # or the pipe would not tell that the server died
            if not lifeline.is_readable(status_r, deadline - time.monotonic()):
                raise TimeoutError("the fork server did not answer in time")
            pid = _read_signed(status_r)
            on_failure.pop_all()
        self._has_answered = True
        return Forked(pid, status_r, data_w)

    def is_running(self) -> bool:
        """Whether processes can be made."""
        if isinstance(self._server, int):
            return os.getppid() == self._server
        return self._server.poll() is None

    def kill(self) -> None:
        """End a server that does not answer. Its processes live on."""
        if not isinstance(self._server, int):
            self._server.kill()
            return
        if lifeline.signal_if(self._server, signal.SIGKILL, self.is_running):
            lifeline.wait_gone((self._server,), _LEAVE_GRACE_S)

    def close(self) -> None:
        """End the server, if it was launched here; its processes must have ended. After 2 s it is killed."""
        if isinstance(self._server, int):
            return  # it is not ours
        if self._alive >= 0:
            os.close(self._alive)
            os.close(self._address)
            self._alive = self._address = -1
        try:
            self._server.wait(_LEAVE_GRACE_S)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()


def _pipe(reader: contextlib.ExitStack, writer: contextlib.ExitStack) -> tuple[int, int]:
    """Return a new pipe's ends; each is closed with its stack."""
    read, write = os.pipe()
    reader.callback(os.close, read)
    writer.callback(os.close, write)
    return read, write


def _bind(listener: socket.socket) -> int:
    """Bind the socket, unlink its file, and return a descriptor of that file (O_PATH).

    So nothing of it is left, however its processes end, and only processes that have the descriptor can connect: to
    connect is to run code there. In TMPDIR, as tempfile has it, or where else there is room.
    """
    os.fchmod(listener.fileno(), 0o600)  # the file gets the socket's own mode
    failure: OSError | None = None
    for parent in filter(None, (*map(os.environ.get, ("TMPDIR", "TEMP", "TMP")), "/tmp", "/var/tmp")):
        file = os.path.join(parent, f"rr-fork-{os.urandom(8).hex()}")
        try:
            listener.bind(file)
        except OSError as error:  # too long for an address, too
            failure = failure or error
            continue
        try:
            return os.open(file, os.O_PATH | os.O_NOFOLLOW)
        finally:
            os.unlink(file)
    raise failure or OSError("no directory for temporary files")


def _tracker() -> int | None:
    """The resource tracker of multiprocessing, if this process has one running: it is shared, none is started."""
    tracker = sys.modules.get("multiprocessing.resource_tracker")
    return None if tracker is None else vars(tracker)["_resource_tracker"]._fd


def _read_signed(fd: int) -> int:
    """Blocks.

    Raises:
        EOFError: the process that should have written it has ended.
    """
    data = b""
    while len(data) < _SIGNED.size:
        more = os.read(fd, _SIGNED.size - len(data))
        if not more:
            raise EOFError("nobody is left to write to this pipe")
        data += more
    return _SIGNED.unpack(data)[0]


def _interpreter(call: str, fds: Sequence[int]) -> subprocess.Popen[bytes]:
    command = [_executable(), *_interpreter_flags(), "-c", call]
    # A process group of its own, so that a ^C at the terminal reaches the parent alone, which decides.
    return subprocess.Popen(command, pass_fds=fds, stdin=subprocess.DEVNULL, process_group=0)


def _placed_apart() -> str:
    """Statements that start their interpreter again if it is as far from this process's as _ALIKE_BYTES says.

    The kernel places each program anew, at random. In an interpreter the type `type` has a fixed place.
    """
    is_alike = f"(id(type) - {id(type)}) % {_ALIKE_BYTES} == 0 != id(type) - {id(type)}"
    again = "os.execv(sys.executable, [*sys.orig_argv, 'again'])"
    return f"import os, sys; {is_alike} and len(sys.argv) < {_PLACINGS} and {again}"


def _executable() -> str:
    """What multiprocessing starts, too; unless its spawn is there, nobody has told it to start anything else."""
    spawn = sys.modules.get("multiprocessing.spawn")
    return sys.executable if spawn is None else os.fsdecode(vars(spawn)["get_executable"]())


def _sys_path() -> list[str]:
    return [path or _ORIGINAL_DIR or "" for path in sys.path]


inherited: ForkServer | None = None
"""The server that this process was forked by, or is; None in a process that rr_actors has not made. Set by
rr_actors/runtime/processes/child_bootstrap.py.
"""


def inherit_or_launch(preload: Sequence[str], family: int) -> ForkServer:
    """Return the server for this process: the inherited one while it lives, else a new one of our own."""
    if inherited is not None and inherited.is_running():
        return inherited
    return ForkServer.launch(preload, family)


def read_code(status: int) -> int | None:
    """The exit code in a status pipe, -N for signal N; None if the server ended without telling. Blocks."""
    try:
        return _read_signed(status)
    except (EOFError, OSError):
        return None


# -- the launch message: written by the parent, run by the child -----------------------------------------------------


def launch_message(entry: str, payload: bytes, name: str, family: int) -> bytes:
    """What the child reads from its data pipe: the parent's surroundings, and what to call."""
    surroundings: dict[str, Any] = {
        "name": name,
        "authkey": process.current_process().authkey,
        "sys_path": _sys_path(),
        "sys_argv": sys.argv,
        "orig_dir": _ORIGINAL_DIR,
    }
    with contextlib.suppress(OSError):  # the working directory may be gone
        surroundings["dir"] = os.getcwd()
    arguments = (entry, payload, name, dict(os.environ), os.getpid(), family)
    child = ForkServerProcess(
        target=call_by_name, args=("rr_actors.runtime.processes.child_bootstrap:enter", *arguments), name=name
    )
    message = io.BytesIO()
    spawning: Any = child
    set_spawning_popen(spawning)  # allows the authkey to be pickled, on this thread
    try:
        reduction.dump(surroundings, message)
        reduction.dump(child, message)
    finally:
        set_spawning_popen(None)
    return message.getvalue()


def call_by_name(function: str, *arguments: Any) -> Any:
    """Call what "module:function" names. The module is imported where it is called: a child's, in the child."""
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)(*arguments)
