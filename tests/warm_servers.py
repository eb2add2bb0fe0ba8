"""Fork servers and web pages of tests begin warm: forked from a process that has imported what each would import.

Each system whose children have processes starts a fork server of its own. Its interpreter and its imports take 0.35 s
of a processor, and each child imports pytest and Hypothesis with its test module, which takes as long again. A web
page is a program of its own, which imports NiceGUI in 1.9 s. Here both are forked from a process with all of that, one
for fork servers and one for pages, and go on as they always do: by the code or the arguments, the descriptors and the
environment that their launcher gives them. Each has its own process group, and ends as it would.

A new interpreter runs as without this where the process that launches it differs from the one that began the tests: in
another program, in a fork, with other resource limits, other ignored signals, or other variables for the interpreter.
A new one runs, too, for tests with the mark `cold`, which look at how fork servers or pages start.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import importlib
import json
import os
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import IO, Any, Self

from rr_actors.runtime.processes import fork_server
from rr_actors.runtime.processes.child_bootstrap import PRELOAD
from rr_actors.system import web_process
from support import WARM

_FOR_SERVERS = (*PRELOAD, "rr_actors.managers", "pytest", "hypothesis", "psutil", "support", "support_managers")
_FOR_PAGES = ("rr_actors.tools.cli", "rr_actors.tools.web.web_server")  # NiceGUI behaves otherwise beside pytest
_HIGH = 400  # descriptors wait there until all others are closed
_NUMBER = struct.Struct("i")
_LIMITS = 16  # of the kernel, whose numbers begin at 0
_OF_THE_INTERPRETER = ("PYTHON", "LC_", "LANG", "LD_", "MALLOC_", "TMPDIR")
_STATUS = ("Umask", "Uid", "Gid", "SigBlk", "SigIgn", "CapEff", "Cpus_allowed", "Seccomp")


def _surroundings() -> list[object]:
    """What an interpreter takes over from the process and the thread that start it, besides what is sent."""
    status = Path("/proc/thread-self/status").read_text().splitlines()
    variables = {n: v for n, v in os.environ.items() if n.startswith(_OF_THE_INTERPRETER) and n != "PYTHONPATH"}
    limits = [resource.getrlimit(number) for number in range(_LIMITS)]
    own = [line for line in status if line.startswith(_STATUS)]
    return [own, variables, limits, os.getpriority(os.PRIO_PROCESS, 0), Path("/proc/self/cgroup").read_text()]


class WarmProcess:
    """A fork server's or a page's process, as its launcher wants it: with what it uses of subprocess.Popen."""

    def __init__(self, pid: int, status: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self.stdin: IO[Any] | None = None
        self.stdout: IO[Any] | None = None
        self._status = status
        try:
            self._pidfd = os.pidfd_open(pid)
        except ProcessLookupError:
            self._pidfd = -1

    def poll(self) -> int | None:
        """The exit code if the process has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.wait(0)
        return None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process, and return its exit code.

        Raises:
            subprocess.TimeoutExpired: it lives.
        """
        if self.returncode is None:
            poll = select.poll()
            poll.register(self._status, select.POLLIN)
            if not poll.poll(None if timeout is None else timeout * 1000):
                raise subprocess.TimeoutExpired("a warm process", timeout or 0.0)
            (self.returncode,) = _NUMBER.unpack(os.read(self._status, _NUMBER.size))
            self._close()
        assert self.returncode is not None
        return self.returncode

    def kill(self) -> None:
        """SIGKILL."""
        self._send(signal.SIGKILL)

    def terminate(self) -> None:
        """SIGTERM."""
        self._send(signal.SIGTERM)

    def _send(self, number: int) -> None:
        if self.returncode is None and self._pidfd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def _close(self) -> None:
        for fd in (self._pidfd, self._status):
            if fd >= 0:
                os.close(fd)
        self._pidfd = self._status = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for pipe in (self.stdin, self.stdout):
            if pipe is not None:
                pipe.close()
        self.wait()

    def __del__(self) -> None:
        self._close()


class _Forking:
    """The process that forks warm processes of one kind. It is started for the first of them; used from any thread."""

    def __init__(self, imported: Sequence[str]) -> None:
        self._imported = imported
        self._lock = threading.Lock()
        self._began = (os.getcwd(), dict(os.environ), fork_server.sys_path())
        self._socket, self._theirs = socket.socketpair()
        self._program: subprocess.Popen[bytes] | None = None

    def fork(self, call: str, fds: dict[int, int], directory: str) -> WarmProcess:
        """Have a process run `call` in a directory, with these descriptors under the numbers that are the keys."""
        environment = {name.hex(): value.hex() for name, value in os.environb.items()}
        order = json.dumps([call, list(fds), directory, environment]).encode()
        status, theirs = os.pipe()
        try:
            with self._lock:
                if self._program is None:
                    self._program = self._begun()
                socket.send_fds(self._socket, [_NUMBER.pack(len(order))], [*fds.values(), theirs])
                self._socket.sendall(order)
                return WarmProcess(_NUMBER.unpack(_received(self._socket, _NUMBER.size))[0], status)
        finally:
            os.close(theirs)

    def _begun(self) -> subprocess.Popen[bytes]:
        directory, environment, path = self._began
        serving = f"import warm_servers; warm_servers.serve({self._theirs.fileno()}, {self._imported!r})"
        code = f"import sys; sys.path[:] = {path!r}; {serving}"
        command = [sys.executable, *vars(fork_server)["_interpreter_flags"](), "-c", code]
        with self._theirs:
            program = subprocess.Popen(
                command,
                pass_fds=[self._theirs.fileno()],
                stdin=subprocess.DEVNULL,
                process_group=0,
                cwd=directory,
                env=environment,
            )
        WARM.add(program.pid)
        return program

    def close(self) -> None:
        """End the process. Those that it has forked live as long as their launchers want."""
        self._socket.close()
        self._theirs.close()
        if self._program is not None:
            self._program.wait()
            WARM.discard(self._program.pid)


class WarmServers:
    """The launching of fork servers and pages, used from any thread.

    Attributes:
        is_on: whether they are forked from a warm process. Else an interpreter is started for each.
    """

    def __init__(self) -> None:
        self.is_on = True
        self._owner = os.getpid()
        self._surroundings = _surroundings()
        self._executable = sys.executable
        self._interpreter: Any = vars(fork_server)["_interpreter"]
        self._servers, self._pages = _Forking(_FOR_SERVERS), _Forking(_FOR_PAGES)

    def close(self) -> None:
        """End the processes that fork."""
        self._servers.close()
        self._pages.close()

    def begin_server(self, call: str, fds: Sequence[int], words: int) -> Any:
        """Start a fork server, in the place of fork_server._interpreter()."""
        spawn = sys.modules.get("multiprocessing.spawn")
        executable = sys.executable if spawn is None else os.fsdecode(vars(spawn)["get_executable"]() or b"")
        directory = self._directory(executable)
        if directory is None:
            return self._interpreter(call, fds, words)
        return self._servers.fork(call, {**{fd: fd for fd in fds}, 1: 1, 2: words}, directory)

    def begin_page(
        self,
        command: Sequence[str],
        *,
        stdin: int | None = None,
        stdout: int | None = None,
        bufsize: int = -1,
        text: bool = False,
        process_group: int | None = None,
    ) -> Any:
        """Start a page, in the place of subprocess.Popen()."""
        executable, *arguments = command
        directory = self._directory(executable)
        if directory is None or arguments[:3] != ["-m", "rr_actors", "web"]:
            return subprocess.Popen(
                command, stdin=stdin, stdout=stdout, bufsize=bufsize, text=text, process_group=process_group
            )
        call = (
            f"import runpy, sys; sys.argv[:] = {['-m', *arguments[2:]]!r}; "
            "runpy.run_module('rr_actors', run_name='__main__', alter_sys=True)"
        )
        with contextlib.ExitStack() as theirs:
            fds, pipes = {0: 0, 1: 1, 2: 2}, dict[int, int]()
            for number, asked in enumerate((stdin, stdout)):
                if asked == subprocess.PIPE:
                    ends = os.pipe()
                    fds[number], pipes[number] = ends[number], ends[1 - number]
                    theirs.callback(os.close, fds[number])
            process = self._pages.fork(call, fds, directory)
        if 0 in pipes:
            process.stdin = os.fdopen(pipes[0], "w" if text else "wb", bufsize)
        if 1 in pipes:
            process.stdout = os.fdopen(pipes[1], "r" if text else "rb", bufsize)
        return process

    def _directory(self, executable: str) -> str | None:
        """The directory for a warm process; None if a new interpreter has to run."""
        if not self.is_on or executable != self._executable or os.getpid() != self._owner:
            return None
        try:
            return os.getcwd() if self._surroundings == _surroundings() else None
        except FileNotFoundError:
            return None


class _WarmPages(ModuleType):
    """subprocess, as rr_actors/system/web_process.py finds it."""

    def __init__(self, servers: WarmServers) -> None:
        super().__init__("subprocess")
        vars(self).update(vars(subprocess), Popen=servers.begin_page)


@contextlib.contextmanager
def warm_servers() -> Iterator[WarmServers]:
    """Have fork servers and pages of this process begin warm in this block."""
    servers = WarmServers()
    setattr(fork_server, "_interpreter", servers.begin_server)  # noqa: B010
    setattr(web_process, "subprocess", _WarmPages(servers))  # noqa: B010
    try:
        yield servers
    finally:
        setattr(fork_server, "_interpreter", servers._interpreter)  # noqa: B010
        setattr(web_process, "subprocess", subprocess)  # noqa: B010
        servers.close()


# -- in a process that forks them ------------------------------------------------------------------------------------

_statuses: dict[int, int] = {}  # the pipe for the exit code of each process


def serve(fd: int, imported: Sequence[str]) -> None:
    """Fork a process for each request, until the tests have ended.

    Returns in a forked process whose code has come to its end, and leaves what that raises to the interpreter.
    """
    for module in imported:
        importlib.import_module(module)
    gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, _reap)
    orders = socket.socket(fileno=fd)
    while True:
        length, (*received, status) = _order(orders)
        order = json.loads(_received(orders, length))
        pid = os.fork()
        if pid == 0:
            orders.detach()
            os.close(status)
            _run(received, *order)
            return
        _statuses[pid] = status
        _reap()
        orders.sendall(_NUMBER.pack(pid))
        for each in received:
            os.close(each)


def _order(orders: socket.socket) -> tuple[int, list[int]]:
    """The length of the next order, and its descriptors. This process ends with the one that orders."""
    length, received, _, _ = socket.recv_fds(orders, _NUMBER.size, 16)
    if not length:
        os._exit(0)
    return _NUMBER.unpack(length)[0], received


def _reap(*_: object) -> None:
    """Write the exit codes of processes that have ended."""
    for pid in list(_statuses):
        with contextlib.suppress(ChildProcessError, KeyError):
            ended, code = os.waitpid(pid, os.WNOHANG)
            if ended:
                status = _statuses.pop(pid)
                with contextlib.suppress(BrokenPipeError):
                    os.write(status, _NUMBER.pack(os.waitstatus_to_exitcode(code)))
                os.close(status)


def _received(source: socket.socket, length: int) -> bytes:
    data = b""
    while len(data) < length:
        more = source.recv(length - len(data))
        if not more:
            raise EOFError("the other process has ended")
        data += more
    return data


def _run(
    received: Sequence[int], call: str, numbers: Sequence[int], directory: str, environment: dict[str, str]
) -> None:
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    high = [fcntl.fcntl(each, fcntl.F_DUPFD, _HIGH) for each in received]
    os.closerange(0, _HIGH)
    os.open(os.devnull, os.O_RDWR)
    for each, number in zip(high, numbers, strict=True):
        os.dup2(each, number)
        os.close(each)
    os.environb.clear()
    os.environb.update({bytes.fromhex(name): bytes.fromhex(value) for name, value in environment.items()})
    time.tzset()
    os.chdir(directory)
    gc.unfreeze()
    main = vars(sys.modules["__main__"])
    for name in [name for name in main if not name.startswith("__")]:
        del main[name]
    exec(call, main)
