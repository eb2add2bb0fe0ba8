"""Programs: the manager of external programs (the thesis's External Resource Manager).

A program is a resource. Equal requests, for the same command with the same arguments, share one instance. It is ended
when its last holder releases it. It outlives a crash of its manager, and the manager's next incarnation finds it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shlex
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec.structs import replace

from rr_actors.base.errors import CatalogError, InvalidRequest, NotFound, RrError, UsageError, is_a, shown
from rr_actors.base.names import check_name
from rr_actors.base.reporting.log import Log
from rr_actors.managers.external_programs import (
    LONGEST_S,
    ExternalPrograms,
    Order,
    ProgramExit,
    RunningProgram,
    with_output,
)
from rr_actors.managers.program_conditions import (
    Condition,
    Probe,
    ProgramCheck,
    ProgramHealth,
    file_is_written,
    port_accepts,
    probe_agrees,
    what_is_missing,
)
from rr_actors.managers.program_directory import OutputLog
from rr_actors.registrar.declarations import costing, server
from rr_actors.registrar.engine.server import ServerSpec, checked_spec, checked_whole
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.health import Health, HealthOf
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Status
from rr_actors.registrar.servers.callback_context import current
from rr_actors.runtime.processes.control_groups import CONTROLLERS

logger = Log("rr_actors.managers.programs")

_TOLD_AGAIN_S = 0.5

Seconds = Annotated[float, msgspec.Meta(ge=0)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65_535)]


class Ready(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The conditions under which a program is ready. All given conditions must hold; with none it is ready at once.

    Attributes:
        line: a regular expression that is found in a line of its output.
        file: a file that was written since the program started.
        port: a TCP port that accepts a connection, on `host`.
        probe: the name of a function that gets the program's pid and returns whether it is ready. The manager was
            given it by that name, or the name is "package.module:function". It runs in a thread of its own.
        timeout_s: seconds to become ready. After that the program is ended and the load fails.
    """

    line: str | None = None
    file: str | None = None
    port: Port | None = None
    host: str = "127.0.0.1"
    probe: str | None = None
    timeout_s: Seconds = 10.0


class RunProgram(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to run this program.

    Attributes:
        command: the program, looked up in PATH.
        arguments: its arguments.
        environment: variables that are added to the manager's own, or replace them.
        directory: its working directory; a relative path begins at the manager's. Default: the manager's.
        ready: the conditions under which it is ready.
        stop_signal: the signal that asks the program to end, and each process that it has started.
        grace_s: seconds until SIGKILL follows; infinite: it does not.
        instance: a name that distinguishes requests that are otherwise the same: each name gets its own program.
        cost: what it costs of the pools of the manager's Budgets, as ``{"cpu": 0.5, "memory_bytes": 2e8}``: the shares
            are loaded before it starts. It can use no more than these two, where a control group can be made for it.
        health: what is expected of it while it runs. None: it may be silent.
    """

    command: str
    arguments: tuple[str, ...] = ()
    environment: dict[str, str] = {}
    directory: str | None = None
    ready: Ready = Ready()
    stop_signal: str = "SIGTERM"
    grace_s: Seconds = 5.0
    instance: str = ""
    cost: dict[str, float] = {}
    health: ProgramHealth | None = None

    def __rr_title__(self) -> str:
        called = shlex.join([self.command.rpartition("/")[2] or self.command, *self.arguments])
        return f"{called} ({self.instance})" if self.instance else called


def _cost(request: RunProgram) -> dict[str, float]:
    return request.cost


class Program(msgspec.Struct, frozen=True):
    """The response: the program's pid, and its start in seconds since boot. Together they always name one process."""

    pid: int
    start_time: float


class Programs(Manager):
    """Serves `program`: starts, watches and ends external programs.

    If a program ends unexpectedly, its holders hear FATAL, with the exit code or signal and the last lines of output.
    A program that is FATAL for another reason is ended before its holders hear of that: its health has found it silent,
    or a holder has said so.
    Programs must stay in the foreground: a daemon that a program leaves is ended with it. Linux only.
    """

    _rr_side_by_side = True

    def __init__(
        self,
        directory: str | None = None,
        probes: Mapping[str, Probe] | None = None,
        *,
        idle: Literal["unload", "pause"] = "unload",
        linger_s: float = 0.0,
        paused_s: float | None = None,
        cost_from: str = "budgets",
        output: Literal["file", "log", "inherit"] = "file",
    ) -> None:
        """Keep a directory for each program below `directory` (default: "programs" beside the registrar's catalog).

        Args:
            probes: functions that requests may name as the probe of their readiness or health.
            idle, linger_s, paused_s: what becomes of a program that nobody needs, as for register_server(). A paused
                program keeps its memory and takes no CPU: its control group is frozen, with all that it started.
                Where none can be made, each of its processes is stopped by SIGSTOP.
            cost_from: the child of the system that runs Budgets, for the requests with a `cost`, as for @rr.server.
            output: where the output of the programs goes. It is always in a file, of at most 512 KiB for each program:
                output() and ``rr-actors logs`` show its last lines. "log": each line is a log line of this manager,
                too. "inherit": it goes to the standard output of this process, too, as a journal or a container
                collects it; what nobody reads in time is left out there.

        Raises:
            InvalidName: `cost_from` is no name.
            UsageError: `output` is none of these.
        """
        if output not in ("file", "log", "inherit"):
            raise UsageError(f"Programs: output: expected 'file', 'log' or 'inherit', got {shown(output)}")
        self._inherits = output == "inherit"
        self._output_log = OutputLog() if output == "log" else None
        self._directory = directory
        self._probes = dict(probes or {})
        self._cost_from = check_name(cost_from, "cost_from")
        self._idleness = {"idle": idle, "linger_s": linger_s, "paused_s": paused_s}
        self._lock = threading.Lock()
        self._is_stopped = threading.Event()
        self._programs: ExternalPrograms | None = None
        self._checks: dict[str, ProgramCheck] = {}  # by resource

    def on_stop(self) -> None:
        """Stop watching the programs. They run until their holders release them; a last stop ends those that start."""
        self._is_stopped.set()
        self._external.close(final=self._rr_final)
        if self._output_log is not None:
            self._output_log.close()

    def output(self, program: str, lines: int = 20) -> list[str]:
        """Return the last lines of a program's output, whether it runs or has ended unasked.

        Args:
            program: the id of its resource.

        Raises:
            NotFound: there is no such program. `.id`, `.known`
            UsageError: `lines` is no number of at least 1.
        """
        known = tuple(info.id for info in self.registrar.resources())
        if not is_a(lines, int) or is_a(lines, bool) or lines < 1:
            raise UsageError(f"output: lines: expected a whole number of at least 1, got {shown(lines)}")
        if program not in known:
            text = f"no program {shown(program)}: expected one of {', '.join(known) or 'none'}"
            raise NotFound(text, id=program, known=known)
        return list(self._external.last_output(program, lines))

    @server("program", idle="pause", health=Health())  # each as its request and its manager say: see _rr_adapted()
    def run_program(self, request: RunProgram) -> Program:
        """Start a program, or adopt one that an interrupted load has started."""
        me = current()
        order, missing = _order(request, self._inherits), self._missing(request.ready, repeated=me.attempt > 1)
        timeout_s = request.ready.timeout_s
        check = self._check(request)
        stop = me.stopping.is_set
        start = functools.partial(self._external.start, missing=missing, timeout_s=timeout_s, is_unwanted=stop)
        self._log_output(request, from_start=me.attempt == 1)
        try:
            running = start(me.resource_id, order, attempt=me.attempt)
        except BaseException:
            self._log_no_more(me.resource_id)
            raise
        self._begin_checks(check)
        return Program(*running)

    @run_program.unload
    def end_program(self, request: RunProgram, response: Program) -> None:
        """End the program and all its descendants."""
        self._checks.pop(current().resource_id, None)
        self._external.stop(current().resource_id)
        self._log_no_more(current().resource_id)
        if self._directory is None:
            with contextlib.suppress(OSError):  # others run
                self._beside.rmdir()

    @run_program.recover
    def find_program(self, request: RunProgram, response: Program) -> Program:
        """Watch the program again if it still runs."""
        running = self._external.attach(current().resource_id)
        self._log_output(request, from_start=False)
        self._begin_checks(self._check(request))
        return Program(*running)

    @run_program.health
    def check_program(self, request: RunProgram, response: Program) -> Status | None:
        """Return what is seen of a program that is not as its health expects."""
        id = current().resource_id
        check = self._checks.get(id)
        seen = "" if check is None else check.seen(RunningProgram(response.pid, response.start_time))
        return Status(State.ERROR, with_output(seen, self._external.last_output(id))) if seen else None

    @run_program.status
    def program_status(self, request: RunProgram, status: Status) -> None:
        """End a program that is lost, so that another can take its place: it may hold a device or a port."""
        if status.state is State.FATAL and status.resource_id == current().resource_id:
            self._external.stop(status.resource_id)

    @run_program.usage
    def program_usage(self, request: RunProgram, response: Program) -> dict[str, float]:
        """Return "cpu_s", "cpu", "memory_bytes" and "threads" of the program and all its descendants."""
        return self._external.usage(current().resource_id)

    @run_program.pause
    def pause_program(self, request: RunProgram, response: Program) -> None:
        """Freeze the program with all that it started, or stop each of these processes."""
        self._external.pause(current().resource_id)

    @run_program.resume
    def resume_program(self, request: RunProgram, response: Program) -> None:
        """Have it go on."""
        self._external.resume(current().resource_id)
        if (check := self._checks.get(current().resource_id)) is not None:
            check.begin_anew()

    def _rr_adapted(self, spec: ServerSpec) -> ServerSpec:
        unused = {} if self._pauses else {"pause": None, "resume": None}
        spec = costing(spec, _cost, self._cost_from, self)
        return checked_whole(checked_spec(replace(spec, **self._idleness, **unused, health=HealthOf(self._health_of))))

    @property
    def _external(self) -> ExternalPrograms:
        """The external programs, made at first use: recover callbacks run before on_start, and in parallel."""
        with self._lock:
            if self._programs is None:
                directory = Path(self._directory or self._beside).absolute()
                self._programs = ExternalPrograms(directory, self._program_ended, pauses=self._pauses)
            return self._programs

    @property
    def _pauses(self) -> bool:
        return self._idleness["idle"] == "pause"

    @property
    def _beside(self) -> Path:
        return self.registrar.directory / "programs"

    def _program_ended(self, resource_id: str, end: ProgramExit) -> None:
        """Send the holders of a program that has ended unasked a FATAL status, on a full disk when it has room."""
        status = Status(State.FATAL, f"the program {end}")
        try:
            self.registrar.send_status(resource_id, status)
        except CatalogError as error:
            logger.warning("%s: the program %s; its holders hear that later: %s", resource_id, end, error)
            threading.Thread(target=self._tell_later, args=(resource_id, status), name="ended", daemon=True).start()
        except RrError as error:
            logger.warning("%s: the program %s; its holders could not be told: %s", resource_id, end, error)

    def _tell_later(self, resource_id: str, status: Status) -> None:
        while not self._is_stopped.wait(_TOLD_AGAIN_S):
            try:
                self.registrar.send_status(resource_id, status)
            except CatalogError:
                continue
            except RrError as error:  # it is unloaded, or this process stops, and the next one finds it ended
                logger.info("%s: %s", resource_id, error)
            return

    def _log_output(self, request: RunProgram, *, from_start: bool) -> None:
        if self._output_log is not None:
            id = current().resource_id
            name = f"{Path(request.command).name} {request.instance}".rstrip()
            self._output_log.follow(id, name, self._external.output_file(id), from_start=from_start)

    def _log_no_more(self, resource_id: str) -> None:
        if self._output_log is not None:
            self._output_log.leave(resource_id)

    def _check(self, request: RunProgram) -> ProgramCheck | None:
        if request.health is None:
            return None
        return ProgramCheck(request.health, self._external.output_file(current().resource_id), self._probes)

    def _begin_checks(self, check: ProgramCheck | None) -> None:
        if check is not None:
            check.begin_anew()
            self._checks[current().resource_id] = check

    def _health_of(self, resource_id: str) -> Health | None:
        check = self._checks.get(resource_id)
        return None if check is None else check.health

    def _missing(self, ready: Ready, *, repeated: bool) -> Condition:
        """Return what says which conditions of a program's readiness do not hold. The probe is asked last."""
        conditions: list[Condition] = []
        if ready.file is not None:
            conditions.append(file_is_written(Path(ready.file), repeated=repeated))
        if ready.port is not None:
            conditions.append(port_accepts(ready.host, ready.port))
        if ready.probe is None:
            return functools.partial(what_is_missing, conditions)
        probe = probe_agrees(ready.probe, self._probes, "ready.probe")
        return lambda running: what_is_missing(conditions, running) or probe(running)


def _order(request: RunProgram, inherit: bool) -> Order:
    return Order(
        request.command,
        list(request.arguments),
        {**os.environ, **request.environment},
        str(Path(request.directory or ".").absolute()),
        _checked_pattern(request.ready.line),
        _signal_number(request.stop_signal),
        min(request.grace_s, LONGEST_S),
        {what: amount for what, amount in request.cost.items() if what in CONTROLLERS},
        inherit,
    )


def _checked_pattern(line: str | None) -> str | None:
    try:
        return line if line is None else re.compile(line.encode()).pattern.decode()
    except (ValueError, re.error) as error:
        text = f"ready.line: expected a regular expression, got {shown(line)}: {error}"
        raise InvalidRequest(text, path="ready.line", expected="a regular expression") from None


def _signal_number(name: str) -> int:
    try:
        return signal.Signals[name]
    except KeyError:
        text = f"stop_signal: expected a name like 'SIGTERM', got {shown(name)}"
        raise InvalidRequest(text, path="stop_signal", expected="a signal's name") from None
