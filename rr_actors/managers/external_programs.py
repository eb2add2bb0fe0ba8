"""ExternalPrograms: starts, watches and ends programs, and finds the programs again that its predecessor started.

It needs no registrar: a program is known by a key (the manager uses the resource id). Each program has a directory of
its own, below one that outlives the manager, and a shim (shim.py) as its parent. The shim holds the directory's lock,
so at most one instance of a key runs at any moment. A start that was interrupted anywhere can therefore be repeated:
it takes over the program that it finds.

Linux: uses pidfds, /proc, and a subreaper.
"""

from __future__ import annotations

import contextlib
import contextvars
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from rr_actors.base.errors import RrError, shown
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.managers.exit_watcher import ExitWatcher, ProcessHandle
from rr_actors.managers.process_marks import VARIABLE, kill_allocation
from rr_actors.managers.program_directory import OUTPUT, Home, remove_retired, shim_of
from rr_actors.managers.program_usage import ProgramUsage
from rr_actors.runtime import interpreter
from rr_actors.runtime.processes.control_groups import ControlGroups
from rr_actors.runtime.processes.process import signal_name
from rr_actors.runtime.time_limits import RunningLimit

logger = Log("rr_actors.managers.external_programs")

TAIL_LINES = 10
_SHIM = str(Path(__file__).with_name("shim.py"))
_POLL_S = 0.005  # between two looks whether a program is ready
LONGEST_S = 2e6  # 23 days: nearly the longest time that poll() can wait
_SHIM_LIMIT_S = 5.0  # for a shim's step that usually takes milliseconds


class ProgramFailed(RrError):
    """A program did not start, did not become ready, or is gone. `.exit` says how it ended, if it did.

    `.wanted`: what the machine had no more of for it, "ENOSPC: ..."; "" if it failed for another reason.
    """

    exit: ProgramExit | None = None
    wanted: str = ""


class RunningProgram(NamedTuple):
    """A running program: its pid, and its start in seconds since boot. Together they always name one process."""

    pid: int
    start_time: float


@dataclass(frozen=True)
class ProgramExit:
    """A program's exit code or signal (both None: no process saw the end), and the last lines of its output."""

    code: int | None
    signal: int | None
    output: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.signal is not None:
            how = f"was ended by signal {self.signal} ({signal_name(self.signal)})"
        elif self.code is not None:
            how = f"exited with code {self.code}"
        else:
            how = "has ended unseen: the process that watched over it was killed, or could not write (a full disk?)"
        return with_output(how, self.output)


def with_output(text: str, output: Sequence[str]) -> str:
    """Return a text about a program with the last lines of its output, if it has had any."""
    return f"{text}; last output:\n" + "\n".join(f"  {line}" for line in output) if output else text


@dataclass(frozen=True)
class Order:
    """The order that the shim gets. `environment` is the program's whole environment, `directory` is absolute.

    `limits`: what the program may use at most, of "cpu" (CPUs) and "memory_bytes", where a control group enforces it.
    """

    command: str
    arguments: list[str]
    environment: dict[str, str]
    directory: str
    ready_line: str | None = None  # a regular expression that a line of the output must contain
    stop_signal: int = signal.SIGTERM
    grace_s: float = 5.0  # at most LONGEST_S
    limits: dict[str, float] = field(default_factory=dict[str, float])
    inherit: bool = False  # its output goes to this process's, too


class ExternalPrograms:
    """The programs below one directory. Its methods block. Any thread may call them, one at a time for each key.

    A thread of its own calls `on_exit(key, exit)` when a running program ends unasked.
    """

    def __init__(
        self,
        directory: Path,
        on_exit: Callable[[str, ProgramExit], None],
        *,
        pauses: bool = False,
        groups: ControlGroups | None = None,
    ) -> None:
        """Work below `directory`, which is made for the first program if it does not exist.

        Args:
            on_exit: see above.
            pauses: programs will be paused. Each then has a control group, where one can be made, as each with limits.
            groups: where control groups are made. Default: beside or below that of this process.

        Raises:
            ProgramFailed: this Python has no pidfds.
        """
        if not hasattr(os, "pidfd_open"):
            raise ProgramFailed("external programs need pidfds: Linux 5.3 or later, and a Python that was built for it")
        self._directory = directory
        self._on_exit = on_exit
        self._pauses = pauses
        self._groups = groups or ControlGroups.of_this_process()
        self._watcher = ExitWatcher()
        self._lock = threading.Lock()
        self._watched: dict[str, ProcessHandle] = {}
        self._usages: dict[str, ProgramUsage] = {}
        self._is_closed = self._gives_up = False
        remove_retired(directory)  # a killed predecessor left them

    def start(
        self,
        key: str,
        order: Order,
        *,
        attempt: int = 1,
        missing: Callable[[RunningProgram], str] = lambda running: "",
        timeout_s: float = 10.0,
        is_unwanted: Callable[[], bool] = lambda: False,
    ) -> RunningProgram:
        """Start a program, or take over the one that an interrupted start of this key left; return once it is ready.

        The program is ready when its output has had the order's `ready_line` and `missing(running)` returns "". Until
        then it returns what is missing. If `is_unwanted()` meanwhile, nobody waits for the program any more.

        Raises:
            ProgramFailed: the program could not be started, ended, was not ready in time, or is unwanted. No process of
                it is left.
        """
        home = self._home(key)
        spawned: ProcessHandle | None = None
        try:
            with _naming_wants(order.command):
                if not home.is_held():
                    self._clear(home)
                    spawned = self._spawn(home, order, f"{key}.{attempt}")
            return self._wait_ready(home, order, missing, timeout_s, spawned, is_unwanted)
        except BaseException:
            if spawned is not None:
                spawned.send_signal(signal.SIGTERM)
            with contextlib.suppress(OSError):  # no descriptor is left: the shim ends with its program all the same
                self.stop(key)
            raise
        finally:
            if spawned is not None:
                spawned.close()

    def attach(self, key: str) -> RunningProgram:
        """Watch a program that a predecessor started and that was ready.

        Raises:
            ProgramFailed: the program has ended, or its shim's state file is damaged: then the program is ended.
        """
        home = self._home(key)
        limit = RunningLimit(_SHIM_LIMIT_S)
        while home.is_held() and not limit.is_over():
            state = home.state()
            if "damaged" in state:
                raise ProgramFailed(state["damaged"])
            if "program" in state and "ended" not in state and self._watch(key, state):
                return _running(state)
            time.sleep(_POLL_S)  # the shim is just starting, or just ending
        end = self._end_of(home)
        raise ProgramFailed(f"the program {end}", exit=end)

    def stop(self, key: str) -> None:
        """End a program: the order's signal to it and all its descendants, and after the grace SIGKILL.

        Returns when no process of the program is left: at once if it is gone already.

        Raises:
            ProgramFailed: the program cannot be ended, even with SIGKILL.
        """
        with self._lock:
            watched = self._watched.pop(key, None)
            self._usages.pop(key, None)
        if watched is not None:
            self._watcher.forget(watched)
        home = self._home(key)
        for _ in range(3):  # more than once only if another shim took the lock just then
            if not home.exists():
                return
            with home.held() as mine:
                if mine:  # no shim has the lock, and none can take it while this thread has it
                    if not home.state().keys() & {"ended", "failed"}:
                        kill_allocation(key)  # its shim was killed
                    home.retire()
                    break
            self._stop_shim(home)
        remove_retired(self._directory)  # without the lock's file open
        if home.exists():
            held = f"its shim holds {home.path}/lock and does not react"
            raise ProgramFailed(f"the program of {home.path} cannot be ended: {held}")

    def pause(self, key: str) -> None:
        """Stop a program where it is, with all that it started, until resume(), or stop(), which ends them.

        Its control group is frozen. Without one, it and all its descendants are stopped by SIGSTOP.

        Raises:
            ProgramFailed: the program has ended.
        """
        with self._shim(key) as (shim, program):
            group = self._home(key).group()
            if group is None or not group.freeze(program.pid):
                _signal_all(shim, program, signal.SIGSTOP)

    def resume(self, key: str) -> None:
        """Let a paused program go on; one that is not paused does so in any case. Raises as pause() does."""
        with self._shim(key) as (shim, program):
            group = self._home(key).group()
            if group is not None:
                group.thaw()
            _signal_all(shim, program, signal.SIGCONT)

    @contextlib.contextmanager
    def _shim(self, key: str) -> Generator[tuple[ProcessHandle, RunningProgram]]:
        """Yield the shim of a running program, and the program."""
        state = self._home(key).state()
        shim = shim_of(state)
        if shim is None or "program" not in state:
            raise ProgramFailed("the program has ended")
        with contextlib.closing(shim):
            yield shim, _running(state)

    def usage(self, key: str) -> dict[str, float]:
        """Return what a running program uses, with all that it has started, as ProgramUsage.now() does.

        Raises:
            ProgramFailed: the program has ended.
        """
        with self._shim(key) as (shim, running):
            known = self._usages.get(key)
            if known is None or known.pid != running.pid:
                known = self._usages[key] = ProgramUsage(shim.pid, *running)
            try:
                return known.now()
            except psutil.Error:
                raise ProgramFailed("the program has ended") from None

    def output_file(self, key: str) -> Path:
        """Return the file to which the output of a program is written while it runs."""
        return self._home(key).path / OUTPUT

    def last_output(self, key: str, lines: int = TAIL_LINES) -> tuple[str, ...]:
        """Return the last lines of a program's output."""
        return self._home(key).output(lines)

    def close(self, *, final: bool = False) -> None:
        """Stop watching the programs. They run on, and can be attached to again.

        `final`: nobody will; the starts that have not returned yet end their programs, and fail.
        """
        self._gives_up, self._is_closed = final, True
        self._watcher.close()
        with self._lock:
            self._watched.clear()

    def _home(self, key: str) -> Home:
        return Home(self._directory / key)

    # -- starting --------------------------------------------------------------------------------------------------

    def _clear(self, home: Home) -> None:
        """Make an empty directory, after ending the processes that a killed shim has left running."""
        if home.exists():
            self.stop(home.key)
        home.make()

    def _spawn(self, home: Home, order: Order, allocation: str) -> ProcessHandle:
        """Start a shim; the watcher reaps it when it ends."""
        executable = interpreter.python(f"external program {order.command!r}")
        group = self._make_group(home, order)
        order_end, written = os.pipe()  # both close-on-exec
        environment = {**order.environment, VARIABLE: allocation}
        message = {**asdict(order), "environment": environment, "group": group}
        try:
            pid = os.posix_spawn(
                executable,
                [executable, "-I", "-S", _SHIM, str(home.path)],
                os.environ,
                file_actions=[
                    (os.POSIX_SPAWN_DUP2, order_end, 0),
                    *(() if order.inherit else ((os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),)),
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
        with contextlib.ExitStack() as undo:
            undo.callback(os.waitpid, pid, 0)
            undo.callback(os.close, written)  # a shim without an order ends at once
            spawned = ProcessHandle(pid)
            undo.callback(spawned.close)
            self._watcher.watch(ProcessHandle(pid), lambda: None)
            undo.pop_all()
        with contextlib.suppress(BrokenPipeError), os.fdopen(written, "w") as file:
            json.dump(message, file)
        return spawned

    def _make_group(self, home: Home, order: Order) -> str | None:
        """Make a control group for a program that needs one, where one can be made, and return its path."""
        if not self._pauses and not order.limits:
            return None
        group, hold = self._groups.place(f"rr-{home.key}", order.limits), dict[str, float]()
        if group is not None:
            home.note_group(group)
            try:
                hold = group.make(order.limits)
            except OSError as error:
                logger.warning("%s: no control group: %s", home.key, error)
                group = None
        for what in sorted(order.limits.keys() - hold):
            logger.warning("%s: its share of %s is counted, not enforced: see rr-actors doctor", home.key, what)
        return None if group is None else str(group.path)

    def _wait_ready(
        self,
        home: Home,
        order: Order,
        missing: Callable[[RunningProgram], str],
        timeout_s: float,
        spawned: ProcessHandle | None,
        is_unwanted: Callable[[], bool],
    ) -> RunningProgram:
        limit = RunningLimit(timeout_s)
        asked: Future[str] | None = None
        command, seen = order.command, ""
        while True:
            state = home.state()
            if state:
                self._check_alive(home, command, state)
            elif (spawned is None or spawned.wait(0)) and not (home.is_held() or home.state()):
                with _naming_wants(command):
                    home.check_room()
                raise ProgramFailed(f"cannot start {command!r}: its shim ended ({sys.executable} {_SHIM})")
            if state.get("ready") and asked is None:
                asked = _ask(missing, _running(state))
                wait((asked,), _POLL_S)
            if asked is not None and asked.done():
                seen = asked.result()
                if not seen and self._watch(home.key, state):
                    if spawned is not None and spawned.pid != state["shim"][0]:
                        spawned.send_signal(signal.SIGKILL)  # not needed: an interrupted start's shim has the lock
                    return _running(state)
                asked = None
            if self._gives_up:
                raise ProgramFailed(f"{command!r} was not ready yet, and its manager is being stopped")
            if not self._is_closed and is_unwanted():  # a restart of the manager goes on with it
                raise ProgramFailed(f"{command!r} was not ready yet, and nobody waits for it any more")
            if limit.is_over():
                with _naming_wants(command):
                    home.check_room()  # else its shim cannot say that it is ready
                output = "\n".join(f"  {line}" for line in home.output(TAIL_LINES)) or "  (none)"
                if asked is None and not seen:
                    seen = f"no line of its output has {shown(order.ready_line)}"
                seen = seen or "the check whether it is ready has not returned"
                raise ProgramFailed(f"{command!r} was not ready within {timeout_s:g} s: {seen}; its output:\n{output}")
            time.sleep(_POLL_S)

    def _check_alive(self, home: Home, command: str, state: dict[str, Any]) -> None:
        if "damaged" in state:
            raise ProgramFailed(f"cannot take {command!r} over: {state['damaged']}")
        if "failed" in state:
            wanted = wanted_by(OSError(state.get("errno", 0), ""))
            raise ProgramFailed(f"cannot start {command!r}: {state['failed']}", wanted=wanted)
        if not home.is_over(state):
            return
        end = self._end_of(home)
        raise ProgramFailed(f"{command!r} was not ready yet and {end}", exit=end)

    # -- watching and ending ---------------------------------------------------------------------------------------

    def _watch(self, key: str, state: dict[str, Any]) -> bool:
        """Watch the program's shim from now on; return False if the shim has ended already."""
        handle = shim_of(state)
        if handle is None:
            return False
        with self._lock:
            self._watched[key] = handle
        self._watcher.watch(handle, lambda: self._ended(key, handle))
        return True

    def _ended(self, key: str, handle: ProcessHandle) -> None:
        with self._lock:
            if self._watched.get(key) is not handle:
                return  # stop() ends it
            del self._watched[key]
        self._on_exit(key, self._end_of(self._home(key)))

    @staticmethod
    def _end_of(home: Home) -> ProgramExit:
        """Return how a program ended whose shim is gone; end the processes that a killed shim has left."""
        ended: dict[str, int] = home.state().get("ended", {})
        if not ended:
            kill_allocation(home.key)  # the program was killed with its shim, but its children were not
        return ProgramExit(ended.get("code"), ended.get("signal"), home.output(TAIL_LINES))

    def _stop_shim(self, home: Home) -> None:
        """Ask the shim that holds the lock to end its program, and wait until the shim has ended."""
        limit = RunningLimit(_SHIM_LIMIT_S)
        while (shim := shim_of(state := home.state())) is None or shim.wait(0):
            if shim is not None:
                shim.close()  # the previous shim, which has ended
            if not home.is_held():
                return
            if limit.is_over():
                kill_allocation(home.key)  # the shim cannot write (a full disk?): it ends with its program
                return
            time.sleep(_POLL_S)  # the shim is just starting
        with contextlib.closing(shim):
            shim.send_signal(signal.SIGTERM)
            if not _has_ended(shim, state["grace_s"] + _SHIM_LIMIT_S):
                shim.send_signal(signal.SIGKILL)
                shim.wait(_SHIM_LIMIT_S)


@contextlib.contextmanager
def _naming_wants(command: str) -> Generator[None]:
    """Raise ProgramFailed for an error that says that the machine has no more of something."""
    try:
        yield
    except (OSError, RuntimeError, MemoryError) as error:
        if wanted := wanted_by(error):
            raise ProgramFailed(f"cannot start {command!r}: {wanted}", wanted=wanted) from error
        raise


def _has_ended(shim: ProcessHandle, limit_s: float) -> bool:
    """Wait, and return whether the shim has ended within the time. It may have stood still with this process."""
    limit = RunningLimit(limit_s)
    while not shim.wait(limit.slice_s):
        if limit.is_over():
            return False
    return True


def _signal_all(shim: ProcessHandle, program: RunningProgram, number: int) -> None:
    """Send a signal to the program's process group at once, and to each descendant outside of it.

    It looks again until there is no new one: a process that is not stopped yet may start another.
    """
    with contextlib.suppress(ProcessLookupError):
        os.killpg(program.pid, number)
    done: set[psutil.Process] = set()
    while new := set(_outside(shim.pid, program.pid)) - done:
        for process in new:
            with contextlib.suppress(psutil.Error):  # psutil compares the start time: it never signals a reused pid
                process.send_signal(number)
        done |= new


def _outside(shim: int, group: int) -> Iterator[psutil.Process]:
    """Return the living processes below a shim, which adopts the program's orphans, that are not in the group."""
    with contextlib.suppress(psutil.Error):
        for process in psutil.Process(shim).children(recursive=True):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                if os.getpgid(process.pid) != group:
                    yield process


def _ask(missing: Callable[[RunningProgram], str], running: RunningProgram) -> Future[str]:
    """Call missing(running) in a thread of its own, in the caller's context: it may be a user's probe, and hang."""
    answer: Future[str] = Future()

    def run() -> None:
        try:
            answer.set_result(missing(running))
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=contextvars.copy_context().run, args=(run,), name="rr-ready", daemon=True).start()
    return answer


def _running(state: dict[str, Any]) -> RunningProgram:
    pid, ticks = state["program"]
    return RunningProgram(pid, ticks / os.sysconf("SC_CLK_TCK"))
