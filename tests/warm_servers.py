"""Fork servers of tests begin warm: one process forks them, which has imported what each of them would import.

Each system whose children have processes starts a fork server of its own. Its interpreter and its imports take 0.35 s
of a processor, and each child imports pytest and Hypothesis with its test module, which takes as long again. Here a
fork server is forked from a process with all of that, and goes on as it always does: by the code, the descriptors and
the environment that its launcher gives it. It has its own process group, and ends with its launcher.

Where the process that launches it differs from the one that began the tests, a new interpreter runs as without this: in
another program, in a fork, with other resource limits, other ignored signals, or other variables for the interpreter.
A new one runs, too, in all folders of tests whose conftest.py does not ask for this.
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
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from rr_actors.runtime.processes import fork_server
from rr_actors.runtime.processes.child_bootstrap import PRELOAD
from support import WARM

_IMPORTED = (*PRELOAD, "rr_actors.managers", "pytest", "hypothesis", "psutil", "support", "support_managers")
_HIGH = 400  # descriptors wait there until all others are closed
_LENGTH = struct.Struct("i")
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


class WarmServer:
    """A fork server's process, as its launcher wants it: with what it uses of subprocess.Popen."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        try:
            self._pidfd = os.pidfd_open(pid)
        except ProcessLookupError:
            self._pidfd, self.returncode = -1, 0

    def poll(self) -> int | None:
        """0 if the process has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.wait(0)
        return None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process.

        Raises:
            subprocess.TimeoutExpired: it lives.
        """
        if self.returncode is None:
            poll = select.poll()
            poll.register(self._pidfd, select.POLLIN)
            if not poll.poll(None if timeout is None else timeout * 1000):
                raise subprocess.TimeoutExpired("fork server", timeout or 0.0)
            self.returncode = 0
            self._close()
        return self.returncode

    def kill(self) -> None:
        """SIGKILL."""
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def _close(self) -> None:
        fd, self._pidfd = self._pidfd, -1
        if fd >= 0:
            os.close(fd)

    def __del__(self) -> None:
        self._close()


class WarmServers:
    """The process that forks fork servers; used from any thread.

    Attributes:
        is_on: whether it does. Else an interpreter is started for each.
    """

    def __init__(self) -> None:
        self.is_on = False
        self._lock = threading.Lock()
        self._owner = os.getpid()
        self._surroundings = _surroundings()
        self._interpreter: Any = vars(fork_server)["_interpreter"]
        self._socket, theirs = socket.socketpair()
        serving = f"import warm_servers; warm_servers.serve({theirs.fileno()})"
        code = f"import sys; sys.path[:] = {fork_server.sys_path()!r}; {serving}"
        command = [sys.executable, *vars(fork_server)["_interpreter_flags"](), "-c", code]
        with theirs:
            self._program = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, process_group=0
            )
        WARM.add(self._program.pid)

    def close(self) -> None:
        """End the process. The fork servers live as long as their launchers want."""
        self._socket.close()
        self._program.wait()
        WARM.discard(self._program.pid)

    def begin(self, call: str, fds: Sequence[int], words: int) -> Any:
        """Start a fork server, in the place of fork_server._interpreter()."""
        spawn = sys.modules.get("multiprocessing.spawn")
        other = spawn is not None and os.fsdecode(vars(spawn)["get_executable"]() or b"") != sys.executable
        if not self.is_on or other or os.getpid() != self._owner or self._surroundings != _surroundings():
            return self._interpreter(call, fds, words)
        try:
            directory = os.getcwd()
        except FileNotFoundError:
            return self._interpreter(call, fds, words)
        environment = {name.hex(): value.hex() for name, value in os.environb.items()}
        order = json.dumps([call, list(fds), directory, environment]).encode()
        with self._lock:
            socket.send_fds(self._socket, [_LENGTH.pack(len(order))], [*fds, 1, words])
            self._socket.sendall(order)
            return WarmServer(_LENGTH.unpack(_received(self._socket, _LENGTH.size))[0])


@contextlib.contextmanager
def warm_servers() -> Iterator[WarmServers]:
    """Have fork servers of this process begin warm in this block."""
    servers = WarmServers()
    setattr(fork_server, "_interpreter", servers.begin)  # noqa: B010
    try:
        yield servers
    finally:
        setattr(fork_server, "_interpreter", servers._interpreter)  # noqa: B010
        servers.close()


# -- in the process that forks them ----------------------------------------------------------------------------------


def serve(fd: int) -> NoReturn:
    """Fork a fork server for each request, until the tests have ended."""
    for module in _IMPORTED:
        importlib.import_module(module)
    gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, _reap)
    orders = socket.socket(fileno=fd)
    while True:
        length, received, _, _ = socket.recv_fds(orders, _LENGTH.size, 16)
        if not length:
            os._exit(0)
        order = json.loads(_received(orders, _LENGTH.unpack(length)[0]))
        pid = os.fork()
        if pid == 0:
            orders.detach()
            _be_fork_server(received, *order)
        orders.sendall(_LENGTH.pack(pid))
        for each in received:
            os.close(each)


def _reap(*_: object) -> None:
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _received(source: socket.socket, length: int) -> bytes:
    data = b""
    while len(data) < length:
        more = source.recv(length - len(data))
        if not more:
            raise EOFError("the other process has ended")
        data += more
    return data


def _be_fork_server(
    received: Sequence[int], call: str, fds: Sequence[int], directory: str, environment: dict[str, str]
) -> NoReturn:
    try:
        os.setpgid(0, 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        high = [fcntl.fcntl(each, fcntl.F_DUPFD, _HIGH) for each in received]
        os.closerange(0, _HIGH)
        os.open(os.devnull, os.O_RDWR)
        for each, number in zip(high, [*fds, 1, 2], strict=True):
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
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(1)
