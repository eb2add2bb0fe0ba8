"""ExternalPrograms: starts programs, watches them, ends them, and finds again what a predecessor started.

Needs no registrar: a program is known by a key (the manager uses the resource id). Each has a directory of its own
below one that outlives the manager, and a shim (shim.py) that is its parent. At any moment there is at most one
instance of a key, for its shim holds the directory's lock: a start that was interrupted anywhere, and is repeated,
takes over what it finds.

Linux: uses pidfds, /proc, and a subreaper.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, NotRequired, TypedDict, cast

import msgspec

from rr_actors.errors import RrError
from rr_actors.lifeline import unmarked
from rr_actors.managers.allocations import VARIABLE, kill_allocation
from rr_actors.managers.exits import ExitWatcher, ProcessHandle

logger = logging.getLogger("rr_actors.managers.external")

TAIL_LINES = 10
_LINE_LIMIT = 500  # characters
_SHIM = str(Path(__file__).with_name("shim.py"))
_POLL_S = 0.005  # while waiting for a program to become ready; its end is heard of at once all the same
_SHIM_LIMIT_S = 5.0  # for a shim to do what takes it milliseconds


class ProgramFailed(RrError):
    """A program did not start, did not become ready, or is gone. `.exit` where it ended."""

    exit: Exit | None = None


class Running(NamedTuple):
    """A program that runs: its pid, and its start in seconds since boot. Together they name one process for good."""

    pid: int
    start_time: float


@dataclass(frozen=True)
class Exit:
    """How a program ended (both None: nobody was there to see it), and the last lines of its output."""

    code: int | None
    signal: int | None
    output: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.signal is not None:
            how = f"was ended by signal {self.signal} ({_signal_name(self.signal)})"
        elif self.code is not None:
            how = f"exited with code {self.code}"
        else:
            how = "was killed together with the process that watched over it"
        return f"{how}; last output:\n" + "\n".join(f"  {line}" for line in self.output) if self.output else how


@dataclass(frozen=True)
class Order:
    """What the shim is told. `environment` is the whole of it, `directory` absolute."""

    command: str
    arguments: list[str]
    environment: dict[str, str]
    directory: str
    ready_line: str | None = None  # a regular expression that a line of the output must contain
    stop_signal: int = signal.SIGTERM
    grace_s: float = 5.0


class _End(TypedDict, total=False):
    code: int
    signal: int


class _State(TypedDict):
    """What the shim writes; a process is [pid, start ticks]."""

    shim: tuple[int, int]
    grace_s: float
    ready: bool
    program: NotRequired[tuple[int, int]]
    failed: NotRequired[str]
    stopped: NotRequired[bool]
    ended: NotRequired[_End]


class ExternalPrograms:
    """The programs below one directory. Its methods block, and may be called from any thread, one at a time per key.

    `on_exit(key, exit)` is called from a thread of its own when a running program ends without having been told to.
    """

    def __init__(self, directory: Path, on_exit: Callable[[str, Exit], None]) -> None:
        """Work below `directory`, which is made if need be.

        Raises:
            ProgramFailed: this platform has no pidfds.
        """
        if not hasattr(os, "pidfd_open"):
            raise ProgramFailed(f"external programs need Linux (pidfds, /proc); this is {sys.platform}")
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._directory = directory
        self._on_exit = on_exit
        self._watcher = ExitWatcher()
        self._lock = threading.Lock()
        self._watched: dict[str, ProcessHandle] = {}

    def start(
        self,
        key: str,
        order: Order,
        *,
        attempt: int = 1,
        ready: Callable[[Running], bool] = lambda running: True,
        timeout_s: float = 10.0,
    ) -> Running:
        """Start a program, or take over the one an interrupted start of this key left; return once it is ready.

        It is ready when its output has had the order's `ready_line` and `ready(running)` is true.

        Raises:
            ProgramFailed: it could not be started, ended, or was not ready in time; nothing of it is left.
        """
        home = self._directory / key
        spawned: ProcessHandle | None = None
        try:
            if not _is_held(home):
                self._clear(key)
                spawned = self._spawn(home, order, f"{key}.{attempt}")
            return self._wait_ready(key, order.command, ready, timeout_s, spawned)
        except BaseException:
            self.stop(key)
            raise
        finally:
            if spawned is not None:
                spawned.close()

    def attach(self, key: str) -> Running:
        """Watch a program that a predecessor started and that was ready.

        Raises:
            ProgramFailed: it has ended, or what its shim has written is damaged: then it is ended.
        """
        home = self._directory / key
        deadline = time.monotonic() + _SHIM_LIMIT_S
        while _is_held(home) and time.monotonic() < deadline:
            state = _read_state(home)
            if "damaged" in state:
                raise ProgramFailed(state["damaged"])
            if "program" in state and self._watch(key, state):
                return _running(state)
            time.sleep(_POLL_S)  # the shim is just beginning, or just ending
        end = self._end_of(key)
        raise ProgramFailed(f"the program {end}", exit=end)

    def stop(self, key: str) -> None:
        """End a program: the order's signal, after its grace SIGKILL, for its whole group and all its descendants.

        Returns when nothing of it is left; at once if it is gone already.

        Raises:
            ProgramFailed: it cannot be ended, even with SIGKILL.
        """
        with self._lock:
            watched = self._watched.pop(key, None)
        if watched is not None:
            self._watcher.forget(watched)
        home = self._directory / key
        for _ in range(3):  # more than once only if another shim came just then
            if not home.exists():
                return
            with _held(home) as mine:
                if mine:  # no shim has it, and none can take it while we do
                    if not _read_state(home).keys() & {"ended", "failed"}:
                        kill_allocation(key)  # its shim was killed
                    shutil.rmtree(home)
                    return
            self._stop_shim(home)
        if home.exists():
            raise ProgramFailed(f"the program of {home} cannot be ended: its shim holds {home}/lock and does not react")

    def output(self, key: str, lines: int = TAIL_LINES) -> tuple[str, ...]:
        """The last lines of a program's output, running or ended."""
        data = b""
        for name in ("output.old", "output.log"):
            with contextlib.suppress(OSError):  # there is none yet
                data += (self._directory / key / name).read_bytes()
        last = data.decode(errors="replace").rstrip("\n").split("\n")[-lines:] if data else []
        return tuple(line[:_LINE_LIMIT] for line in last)

    def close(self) -> None:
        """Stop watching. The programs run on, and can be attached to again."""
        self._watcher.close()
        with self._lock:
            self._watched.clear()

    # -- starting --------------------------------------------------------------------------------------------------

    def _clear(self, key: str) -> None:
        """Make an empty directory; whatever a killed shim has left running is ended first."""
        home = self._directory / key
        if home.exists():
            self.stop(key)
        home.mkdir(mode=0o700)
        (home / "lock").touch(mode=0o600)

    def _spawn(self, home: Path, order: Order, allocation: str) -> ProcessHandle:
        """Start a shim, which is reaped when it ends."""
        order_end, written = os.pipe()  # both close-on-exec
        message = {**asdict(order), "environment": {**unmarked(order.environment), VARIABLE: allocation}}
        try:
            pid = os.posix_spawn(
                sys.executable,
                [sys.executable, "-I", "-S", _SHIM, str(home)],
                unmarked(os.environ),
                file_actions=[
                    (os.POSIX_SPAWN_DUP2, order_end, 0),
                    (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
                    (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
                ],
                setsid=True,
                setsigmask=(),
                setsigdef=(signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGCHLD, signal.SIGPIPE),
            )
        except BaseException:
            os.close(written)
            raise
        finally:
            os.close(order_end)
        spawned = ProcessHandle(pid)
        self._watcher.watch(ProcessHandle(pid), lambda: None)
        with contextlib.suppress(BrokenPipeError), os.fdopen(written, "w") as file:
            json.dump(message, file)
        return spawned

    def _wait_ready(
        self,
        key: str,
        command: str,
        ready: Callable[[Running], bool],
        timeout_s: float,
        spawned: ProcessHandle | None,
    ) -> Running:
        home = self._directory / key
        deadline = time.monotonic() + timeout_s
        while True:
            state = _read_state(home)
            if state:
                self._check_alive(key, command, state)
            elif (spawned is None or spawned.wait(0)) and not (_is_held(home) or _read_state(home)):
                raise ProgramFailed(f"cannot start {command!r}: its shim ended ({sys.executable} {_SHIM})")
            if state.get("ready") and ready(_running(state)) and self._watch(key, state):
                if spawned is not None and spawned.pid != state["shim"][0]:
                    spawned.send_signal(
                        signal.SIGKILL
                    )  # an interrupted start's shim was faster: this one is not needed
                return _running(state)
            if time.monotonic() > deadline:
                output = "\n".join(f"  {line}" for line in self.output(key)) or "  (none)"
                raise ProgramFailed(f"{command!r} was not ready within {timeout_s:g} s; its output:\n{output}")
            time.sleep(_POLL_S)

    def _check_alive(self, key: str, command: str, state: dict[str, Any]) -> None:
        if "damaged" in state:
            raise ProgramFailed(f"cannot take {command!r} over: {state['damaged']}")
        if "failed" in state:
            raise ProgramFailed(f"cannot start {command!r}: {state['failed']}")
        if not _is_over(self._directory / key, state):
            return
        end = self._end_of(key)
        raise ProgramFailed(f"{command!r} was not ready yet and {end}", exit=end)

    # -- watching and ending ---------------------------------------------------------------------------------------

    def _watch(self, key: str, state: dict[str, Any]) -> bool:
        """Hear of the program's end from now on; False if it is here already."""
        handle = _open_shim(state)
        if handle is None:
            return False
        with self._lock:
            self._watched[key] = handle
        self._watcher.watch(handle, lambda: self._ended(key, handle))
        return True

    def _ended(self, key: str, handle: ProcessHandle) -> None:
        with self._lock:
            if self._watched.get(key) is not handle:
                return  # it was told to
            del self._watched[key]
        self._on_exit(key, self._end_of(key))

    def _end_of(self, key: str) -> Exit:
        """How it ended, its shim being gone."""
        ended: dict[str, int] = _read_state(self._directory / key).get("ended", {})
        if not ended:
            kill_allocation(key)  # the shim was killed, and took the program with it, but not the program's children
        return Exit(ended.get("code"), ended.get("signal"), self.output(key))

    def _stop_shim(self, home: Path) -> None:
        """Tell the shim that holds the lock to end its program, and wait until it has."""
        deadline = time.monotonic() + _SHIM_LIMIT_S
        while (shim := _open_shim(state := _read_state(home))) is None or shim.wait(0):
            if shim is not None:
                shim.close()  # the one before
            if not _is_held(home):
                return
            if time.monotonic() > deadline:
                kill_allocation(home.name)  # it cannot write, to a full disk for instance: it ends with its program
                return
            time.sleep(_POLL_S)  # it is only just starting
        with contextlib.closing(shim):
            shim.send_signal(signal.SIGTERM)
            if not shim.wait(state["grace_s"] + _SHIM_LIMIT_S):
                shim.send_signal(signal.SIGKILL)
                shim.wait(_SHIM_LIMIT_S)


def _is_over(home: Path, state: dict[str, Any]) -> bool:
    """Whether the shim that wrote this has ended, and no other has taken its place, which will write anew."""
    shim = _open_shim(state)
    if shim is None:
        return not _is_held(home)
    with contextlib.closing(shim):
        return shim.wait(0) and not _is_held(home)


def _open_shim(state: dict[str, Any]) -> ProcessHandle | None:
    if "shim" not in state:
        return None
    try:
        return ProcessHandle(*state["shim"])
    except ProcessLookupError:
        return None


def _running(state: dict[str, Any]) -> Running:
    pid, ticks = state["program"]
    return Running(pid, ticks / os.sysconf("SC_CLK_TCK"))


def _read_state(home: Path) -> dict[str, Any]:
    """What the shim last wrote; empty before its first word.

    A damaged file is set aside, and what was wrong with it is given once, as "damaged". What runs here is ended, since
    nobody can tell what it is; the shim writes anew if it lives.
    """
    path = home / "state.json"
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return {}
    try:
        return cast("dict[str, Any]", msgspec.json.decode(data, type=_State))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        aside = home.with_name(f"{home.name}.state.damaged")
        with contextlib.suppress(FileNotFoundError):  # another reader was faster
            path.replace(aside)
        damage = f"{path}: expected the JSON object that the program's shim writes, got {data[:60]!r} ({error})"
        logger.error("%s; it is kept as %s, and the program is ended, if it runs: load it again", damage, aside)
        kill_allocation(home.name)
        return {"damaged": f"{damage}; kept as {aside}; the program was ended"}


@contextlib.contextmanager
def _held(home: Path) -> Generator[bool]:
    """Hold the directory's lock; False if a shim does."""
    try:
        descriptor = os.open(home / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except FileNotFoundError:
        yield False  # the directory has gone meanwhile
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def _is_held(home: Path) -> bool:
    """Whether a shim lives for this directory."""
    if not (home / "lock").exists():
        return False
    with _held(home) as mine:
        return not mine


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
