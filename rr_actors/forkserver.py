"""The fork server, and a child's first steps. The only user of multiprocessing.

A fork server is a small process without threads that has imported the package already; it forks children, collects
them and tells their exit codes. Its main loop is the standard library's. It is launched and asked by our own few lines,
because those of multiprocessing.forkserver.ForkServer tie it to a resource tracker and to this process's default start
method, and do not use the server that a child inherits. Unlike there, the parent's __main__ is not run again in the
child: what a child needs travels by value. Where there is no fork server, each child is an interpreter of its own.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import io
import logging
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing import forkserver, process, reduction, resource_tracker, spawn, util
from multiprocessing.context import ForkServerProcess, set_spawning_popen
from pathlib import Path
from typing import Any, NoReturn, Protocol

import msgspec

from rr_actors import lifeline

# What the standard library keeps for itself; the same in Python 3.11, 3.12 and 3.13.
_SERVER: Any = vars(forkserver)["_forkserver"]
_TRACKER: Any = vars(resource_tracker)["_resource_tracker"]
_ORIGINAL_DIR: str | None = vars(process)["ORIGINAL_DIR"]
_interpreter_flags: Callable[[], list[str]] = vars(util)["_args_from_interpreter_flags"]
_main: Callable[[int, int], int] = vars(spawn)["_main"]

_LEAVE_GRACE_S = 2.0


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


class Forker(Protocol):
    """Makes processes."""

    def fork(self, fds: Sequence[int], deadline: float) -> Forked:
        """A new process that inherits `fds`. Blocks until `deadline` (time.monotonic) at most.

        Raises:
            OSError, EOFError: there is none; is_running() tells whether it is worth asking again.
        """
        ...

    def is_running(self) -> bool:
        """Whether processes can be made."""
        ...

    def close(self) -> None:
        """End it; its processes must have ended."""
        ...


class ForkServer:
    """A running fork server: one's own, launched here, or the one that this process was forked by."""

    def __init__(self, address: str, alive: int, server: subprocess.Popen[bytes] | int) -> None:
        self._address = address
        self._alive = alive
        self._server = server  # an int: our parent's id, as long as it lives

    @classmethod
    def launch(cls, preload: Sequence[str], mark: str) -> ForkServer:
        """Start a server that has imported the modules `preload`. Returns at once; the first child waits for it."""
        directory = _private_directory()
        address = str(Path(directory, "s"))
        alive_r, alive_w = os.pipe()  # the server ends when nobody has the write end any more
        try:
            with socket.socket(socket.AF_UNIX) as listener:
                listener.bind(address)
                listener.listen(512)
                fds = (listener.fileno(), alive_r)
                call = (
                    f"import sys; sys.path[:] = {_sys_path()!r}; from rr_actors.forkserver import serve; "
                    f"serve({fds[0]}, {fds[1]}, {tuple(preload)!r}, {mark!r}, {directory!r})"
                )
                server = _interpreter(call, fds)
        except BaseException:
            os.close(alive_w)
            shutil.rmtree(directory, ignore_errors=True)
            raise
        finally:
            os.close(alive_r)
        return cls(address, alive_w, server)

    def fork(self, fds: Sequence[int], deadline: float) -> Forked:
        """See Forker."""
        status_r, status_w = os.pipe()
        data_r, data_w = os.pipe()
        tracker: int | None = _TRACKER._fd  # a running one is shared, none is started
        null = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
        try:
            with socket.socket(socket.AF_UNIX) as client:
                client.settimeout(max(0.001, deadline - time.monotonic()))
                client.connect(self._address)
                own = [data_r, status_w, self._alive, null if tracker is None else tracker]
                reduction.sendfds(client, [*own, *fds])
            os.close(status_w)  # or the pipe would not tell that the server died
            status_w = -1
            if not is_readable(status_r, deadline - time.monotonic()):
                raise TimeoutError("the fork server did not answer in time")
            pid = forkserver.read_signed(status_r)
        except BaseException:
            os.close(status_r)
            os.close(data_w)
            raise
        finally:
            for fd in (status_w, data_r, null):
                if fd >= 0:
                    os.close(fd)
        return Forked(pid, status_r, data_w)

    def is_running(self) -> bool:
        """See Forker."""
        if isinstance(self._server, int):
            return os.getppid() == self._server
        return self._server.poll() is None

    def close(self) -> None:
        """See Forker. One that does not end within 2 s, since a child lives still, is killed."""
        if isinstance(self._server, int):
            return  # it is not ours
        if self._alive >= 0:
            os.close(self._alive)
            self._alive = -1
        try:
            self._server.wait(_LEAVE_GRACE_S)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()
        shutil.rmtree(Path(self._address).parent, ignore_errors=True)


class Interpreters:
    """Makes each process a new interpreter: slower by some 30 ms, and needs nothing from the platform."""

    def fork(self, fds: Sequence[int], deadline: float) -> Forked:
        """See Forker."""
        status_r, status_w = os.pipe()
        data_r, data_w = os.pipe()
        try:
            call = (
                f"import sys; sys.path[:] = {_sys_path()!r}; from rr_actors.forkserver import spawned; "
                f"spawned({data_r}, {list(fds)!r})"
            )
            child = _interpreter(call, (data_r, *fds))
        except BaseException:
            for fd in (status_r, status_w, data_w):
                os.close(fd)
            raise
        finally:
            os.close(data_r)
        threading.Thread(target=_tell_code, args=(child, status_w), name="rr-reaper", daemon=True).start()
        return Forked(child.pid, status_r, data_w)

    def is_running(self) -> bool:
        """See Forker."""
        return True

    def close(self) -> None:
        """See Forker."""


def _private_directory() -> str:
    """For the socket: who can connect can run code. Its path must fit into an address (108 bytes)."""
    directory = tempfile.mkdtemp(prefix="rr-fork-")
    if len(os.fsencode(directory)) > 100:
        Path(directory).rmdir()
        directory = tempfile.mkdtemp(prefix="rr-fork-", dir="/tmp")
    return directory


def _tell_code(child: subprocess.Popen[bytes], status: int) -> None:
    code = child.wait()
    with contextlib.suppress(OSError):
        forkserver.write_signed(status, code)
    os.close(status)


def _interpreter(call: str, fds: Sequence[int]) -> subprocess.Popen[bytes]:
    command = [os.fsdecode(spawn.get_executable()), *_interpreter_flags(), "-c", call]
    # A process group of its own, so that a ^C at the terminal reaches the parent alone, which decides.
    return subprocess.Popen(command, pass_fds=fds, stdin=subprocess.DEVNULL, process_group=0)


def _sys_path() -> list[str]:
    return [path or _ORIGINAL_DIR or "" for path in sys.path]


def forker(preload: Sequence[str], mark: str) -> Forker:
    """The one to use in this process: the inherited server while it lives, else a server of our own."""
    if not reduction.HAVE_SEND_HANDLE:
        return Interpreters()
    if _inherited is not None and _inherited.is_running():
        return _inherited
    return ForkServer.launch(preload, mark)


def read_code(status: int) -> int | None:
    """The exit code in a status pipe, -N for signal N; None if the server ended without telling. Blocks."""
    try:
        return forkserver.read_signed(status)
    except (EOFError, OSError):
        return None


def is_readable(fd: int, timeout_s: float | None = 0.0) -> bool:
    """Whether there is something to read (or the end) within `timeout_s`; None waits for ever."""
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(None if timeout_s is None else max(0.0, timeout_s) * 1000))


# -- the launch message: written by the parent, run by the child -----------------------------------------------------


def launch_message(entry: str, payload: bytes, name: str, marks: str) -> bytes:
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
    environment = {**os.environ, lifeline.MARK: marks}
    child = ForkServerProcess(target=_enter, args=(entry, payload, name, environment, os.getpid()), name=name)
    message = io.BytesIO()
    spawning: Any = child
    set_spawning_popen(spawning)  # allows the authkey to be pickled, on this thread
    try:
        reduction.dump(surroundings, message)
        reduction.dump(child, message)
    finally:
        set_spawning_popen(None)
    return message.getvalue()


_inherited: ForkServer | None = None


def _enter(entry: str, payload: bytes, name: str, environment: dict[str, str], parent_pid: int) -> NoReturn:
    """The first function a child runs, on its main thread."""
    global _inherited
    code = 1
    try:
        os.setpgid(0, 0)
        _reset_signals()
        os.environ.clear()
        os.environ.update(environment)
        control, life = _SERVER._inherited_fds
        lifeline.hold(life, parent_pid)
        if _SERVER._forkserver_alive_fd is not None:
            os.set_inheritable(_SERVER._forkserver_alive_fd, False)
            _inherited = ForkServer(_SERVER._forkserver_address, _SERVER._forkserver_alive_fd, os.getppid())
        _forget_false_tracker()
        module, _, function = entry.partition(":")
        main: Callable[[Inherited], int] = getattr(importlib.import_module(module), function)
        code = main(Inherited(name, payload, socket.socket(fileno=control)))
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else int(left.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        leave(code)


def leave(code: int) -> NoReturn:
    """End this process now: what is written to the standard streams and logs goes out, threads are not waited for."""

    def flush() -> None:
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()

    thread = threading.Thread(target=flush, daemon=True)  # a thread: whoever holds a stream's lock may never let go
    thread.start()
    thread.join(_LEAVE_GRACE_S)
    os._exit(code)


def _reset_signals() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # The parent decides what a ^C means. Not SIG_IGN: that would be passed on to programs this process starts.
    signal.signal(signal.SIGINT, _ignore)


def _ignore(*_: object) -> None:
    pass


def _forget_false_tracker() -> None:
    """Where the parent had no resource tracker, the child was given /dev/null: it starts one itself if it needs one."""
    if _TRACKER._fd is None:
        return
    os.set_inheritable(_TRACKER._fd, False)
    if os.fstat(_TRACKER._fd).st_rdev == os.stat(os.devnull).st_rdev:
        os.close(_TRACKER._fd)
        _TRACKER._fd = None


def spawned(data: int, fds: list[int]) -> NoReturn:
    """The main program of a process made by Interpreters."""
    for fd in fds:
        os.set_inheritable(fd, False)
    _SERVER._inherited_fds = fds
    leave(_main(data, os.dup(data)))


# -- the fork server's main program ----------------------------------------------------------------------------------


def serve(listener: int, alive: int, preload: Sequence[str], mark: str, directory: str) -> None:
    """The main program of a fork server; ends when its launcher and all its children have ended."""
    for module in preload:
        try:
            importlib.import_module(module)
        except Exception:
            sys.stderr.write(f"rr_actors: could not preload {module!r}; children start without it\n")
            traceback.print_exc()
    os.environ[lifeline.MARK] = mark
    server = os.getpid()

    def clean_up() -> None:
        if os.getpid() == server:
            lifeline.sweep(mark)  # those that were started below, by now without anyone to end them
            shutil.rmtree(directory, ignore_errors=True)

    atexit.register(clean_up)
    gc.collect()
    gc.freeze()  # children share these objects' memory as long as no collection touches them
    forkserver.main(listener, alive, [])
