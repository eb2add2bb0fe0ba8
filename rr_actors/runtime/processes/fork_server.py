"""The fork server's client: launch a fork server, ask it for a child, and end it.

A fork server is a small process without threads that has imported the package already; it forks children, collects
them and reports their exit codes (rr_actors/runtime/processes/child_bootstrap.py). Server and client are this package's
own: multiprocessing.forkserver's server ends when it cannot fork and cannot be ended, its client waits without a limit
and does not use the server that a child inherits, and all code of a process shares one of them
(docs/on-multiprocessing.md). The children are processes of multiprocessing all the same
(rr_actors/runtime/processes/forked_process.py).
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.machinery import PathFinder
from multiprocessing import process

import msgspec

from rr_actors.base.errors import UsageError, readable
from rr_actors.runtime import interpreter
from rr_actors.runtime.processes import lifeline

# Parts of the standard library without documentation; the same in Python 3.11, 3.12 and 3.13.
ORIGINAL_DIR: str | None = vars(process)["ORIGINAL_DIR"]
"""The working directory at this process's first import of multiprocessing."""
_interpreter_flags: Callable[[], list[str]] = vars(subprocess)["_args_from_interpreter_flags"]

_LEAVE_GRACE_S = 2.0
ANSWER_S = 5.0
"""The longest time for an answer after the first, which waits for the server's imports."""
_ALIKE_BYTES = 1 << 24
"""Some processors take branches of two processes for one branch if they are this far apart, or a multiple of it. Both
are then predicted wrongly: messages between the two take a third longer on one core (docs/performance.md)."""
_PLACINGS = 5
_IN_FROZEN = "--rr-actors-fork-server"
"""The first argument of a frozen program that is started as a fork server; the code to run is the second."""
_WORDS = 2_000  # the most characters of a server's last words
_LONGEST_VARIABLE = 128 * 1024 - 1  # bytes of "name=value" that the kernel gives a program
_SIGNED = struct.Struct("q")  # process ids, numbers of errors, exit codes and lengths
TRACKED = b"t"
"""A request whose third descriptor is that of a resource tracker; another request has none."""
_PLAIN = b"p"


class Inherited(msgspec.Struct, frozen=True):
    """The argument of a child process's entry function."""

    name: str
    payload: bytes
    control: socket.socket


class Forked(msgspec.Struct, frozen=True):
    """A new process: its id, and the pipe for its exit code."""

    pid: int
    status: int


class ForkServer:
    """A running fork server: either launched by this process, or the server that forked this process.

    Args:
        address: a descriptor of its socket's file, which is unlinked.
        alive: the write end of a pipe: the server ends when it closes. No descendant of the server has it: one that
            outlived its parent would keep the server alive. -1: another process has it.
        server: the process that was launched here; or the server's id, if this process is its child.
        words: the standard error of a server that was launched here, until it serves.
    """

    def __init__(
        self, address: int, alive: int, server: subprocess.Popen[bytes] | int, words: io.FileIO | None = None
    ) -> None:
        self._address = address
        self._alive = alive
        self._server = server
        self._words = words
        self.last_words = ""
        """The end of what a server that never served has written to its standard error, once it is closed."""
        self._has_answered = isinstance(server, int)

    @classmethod
    def launch(cls, preload: Sequence[str], family: int, directory: str = "") -> ForkServer:
        """Start a server that has imported the modules `preload`. Returns at once; the first child waits for it.

        Args:
            directory: for its socket, if no directory for temporary files can be used.
        """
        with contextlib.ExitStack() as on_failure, contextlib.ExitStack() as theirs:
            listener = theirs.enter_context(socket.socket(socket.AF_UNIX))
            address = _bind(listener, directory)
            on_failure.callback(os.close, address)
            listener.listen(512)
            alive_r, alive_w = _pipe(theirs, on_failure)
            words = io.FileIO(os.memfd_create("rr-last-words"), "r+")
            on_failure.callback(words.close)
            errors = os.dup(2)
            theirs.callback(os.close, errors)
            fds = (listener.fileno(), alive_r, address, errors)
            call = (
                f"import gc, sys; gc.disable(); sys.path[:] = {sys_path()!r}; "
                "from rr_actors.runtime.processes.child_bootstrap import serve; "
                f"serve({fds[0]}, {fds[1]}, {fds[2]}, {fds[3]}, {tuple(preload)!r}, {family})"
            )
            server = _interpreter(call, fds, words.fileno())
            on_failure.pop_all()
        return cls(address, alive_w, server, words)

    def fork(self, control: int, life: int, deadline: float) -> Forked:
        """Make a process that inherits two descriptors. Blocks until `deadline` (time.monotonic) at most.

        Args:
            control: its control channel.
            life: the read end of its lifeline, by which its launch message comes first.

        Raises:
            TimeoutError: the server has not answered in time.
            ConnectionError, EOFError: the server does not run.
            OSError: the server could not fork, or this process lacks descriptors.
        """
        if self._has_answered:
            deadline = min(deadline, time.monotonic() + ANSWER_S)
        with contextlib.ExitStack() as on_failure, contextlib.ExitStack() as theirs:
            status_r, status_w = _pipe(on_failure, theirs)
            tracker = _tracker()
            kind, trackers = (_PLAIN, ()) if tracker is None else (TRACKED, (tracker,))
            with socket.socket(socket.AF_UNIX) as client:
                client.settimeout(max(0.001, deadline - time.monotonic()))
                client.connect(f"/proc/self/fd/{self._address}")
                socket.send_fds(client, [kind], [status_w, *trackers, control, life])
                if not lifeline.is_readable(client.fileno(), deadline - time.monotonic()):
                    raise TimeoutError("the fork server did not answer in time")
                pid = read_signed(client.fileno())
            if pid < 0:
                raise OSError(-pid, f"the fork server could not fork: {os.strerror(-pid)}")
            on_failure.pop_all()
        self._has_answered = True
        if self._words is not None:
            self._words.close()
        return Forked(pid, status_r)

    @property
    def pid(self) -> int:
        """The id of its process."""
        return self._server if isinstance(self._server, int) else self._server.pid

    def is_running(self) -> bool:
        """Return whether the server runs."""
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
            return  # another process has launched it
        if self._alive >= 0:
            os.close(self._alive)
            os.close(self._address)
            self._alive = self._address = -1
        try:
            self._server.wait(_LEAVE_GRACE_S)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()
        if self._words is not None and not self._words.closed:
            self._words.seek(0)
            said = readable(self._words.readall().decode(errors="replace").strip()[-_WORDS:])
            self.last_words = "\n".join(filter(None, (_hiding(), said)))
            self._words.close()


def _pipe(reader: contextlib.ExitStack, writer: contextlib.ExitStack) -> tuple[int, int]:
    """Return a new pipe's ends; each is closed with its stack."""
    read, write = os.pipe()
    reader.callback(os.close, read)
    writer.callback(os.close, write)
    return read, write


def _bind(listener: socket.socket, directory: str) -> int:
    """Bind the socket, unlink its file, and return a descriptor of that file (O_PATH).

    So no file is left, however its processes end, and only processes that have the descriptor can connect. A process
    that connects can run code in the server. The file is in TMPDIR, as tempfile's are, or in the next usable directory;
    `directory` is the last of them.
    """
    os.fchmod(listener.fileno(), 0o600)  # the file gets the socket's own mode
    failure: OSError | None = None
    for parent in filter(None, (*map(os.environ.get, ("TMPDIR", "TEMP", "TMP")), "/tmp", "/var/tmp", directory)):
        try:
            at = os.open(parent, os.O_PATH | os.O_DIRECTORY)
        except OSError as error:
            failure = failure or error
            continue
        try:
            file = f"/proc/self/fd/{at}/rr-fork-{os.urandom(8).hex()}"  # a longer path could be no address
            listener.bind(file)
            try:
                return os.open(file, os.O_PATH | os.O_NOFOLLOW)
            finally:
                os.unlink(file)
        except OSError as error:
            error.filename = parent
            failure = failure or error
        finally:
            os.close(at)
    raise failure or OSError("no directory for temporary files")


def _tracker() -> int | None:
    """Return the descriptor of multiprocessing's resource tracker, which is started if need be.

    None in a process that has imported no shared memory, and was given no tracker: its children need none.
    """
    if not (is_tracked or "multiprocessing.shared_memory" in sys.modules):
        return None
    return sys.modules["multiprocessing.resource_tracker"].getfd()


def signed(number: int) -> bytes:
    """Return the bytes that read_signed() reads as this number."""
    return _SIGNED.pack(number)


def read_signed(fd: int) -> int:
    """Read a number from a pipe; raise EOFError if the writing process has ended before. Blocks."""
    number = os.read(fd, _SIGNED.size)  # a pipe gives so few bytes together
    if len(number) < _SIGNED.size:
        raise EOFError("nobody is left to write to this pipe")
    return _SIGNED.unpack(number)[0]


def _interpreter(call: str, fds: Sequence[int], words: int) -> subprocess.Popen[bytes]:
    spawn = sys.modules.get("multiprocessing.spawn")  # only this module can have another interpreter set
    executable = sys.executable if spawn is None else os.fsdecode(vars(spawn)["get_executable"]() or b"")
    if not executable:
        raise UsageError(
            "sys.executable is not set, as in a program with Python built in: name the Python interpreter whose "
            "packages these are, multiprocessing.set_executable('/usr/bin/python3')"
        )
    if not interpreter.is_frozen():
        command = [executable, *_interpreter_flags(), "-c", f"{_placed_apart()}; {call}"]
    elif _IN_FROZEN in sys.argv:
        raise UsageError("this process was to be a fork server: a frozen program must not catch what an import raises")
    else:
        command = [executable, _IN_FROZEN, call]  # rr_actors/supervision/frozen.py
    # The kernel would refuse a longer variable. Children have all, by their launch messages.
    environment = {
        name: value for name, value in os.environb.items() if len(name) + len(value) + 1 <= _LONGEST_VARIABLE
    }
    # A process group of its own, so that a ^C at the terminal reaches the parent alone, which decides.
    return subprocess.Popen(
        command, pass_fds=fds, stdin=subprocess.DEVNULL, stderr=words, process_group=0, env=environment
    )


def _placed_apart() -> str:
    """Return code that restarts its interpreter if the distance to this process's is a multiple of _ALIKE_BYTES.

    The kernel puts each program at a random address. In an interpreter the type `type` has a fixed place.
    """
    is_alike = f"(id(type) - {id(type)}) % {_ALIKE_BYTES} == 0 != id(type) - {id(type)}"
    again = "os.execv(sys.executable, [*sys.orig_argv, 'again'])"
    return f"import os, sys; {is_alike} and len(sys.argv) < {_PLACINGS} and {again}"


def sys_path() -> list[str]:
    """Return sys.path with the directory that "" stands for."""
    return [path or ORIGINAL_DIR or "" for path in sys.path]


def _hiding() -> str:
    """Name the files that a new interpreter would import in place of modules of the standard library; "" if none."""
    library = os.path.dirname(os.__file__)
    specs = (PathFinder.find_spec(name, sys_path()) for name in sorted(sys.stdlib_module_names))
    files = [spec.origin for spec in specs if spec and spec.origin and not spec.origin.startswith(library)]
    return f"these files hide modules of the standard library: {', '.join(files)}" if files else ""


is_tracked = False
"""Whether the parent of this process has given it a resource tracker. Set by child_bootstrap.py, too."""

inherited: ForkServer | None = None
"""The server that forked this process, or that this process is; None in a process that rr_actors has not made. Set by
rr_actors/runtime/processes/child_bootstrap.py.
"""


def environment_block() -> bytes:
    """Return this process's environment, as bytes that are equal for equal environments of the same order."""
    return b"\0".join([b"%b=%b" % variable for variable in os.environb.items()])
