"""Conditions: what a program needs to be ready, or to be well, and what is seen where it is not so.

A program may live and do nothing any more: its device was disconnected, or it hangs. Its health notices that.
"""

from __future__ import annotations

import functools
import importlib
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.base.checks import check_number, invalid
from rr_actors.base.errors import InvalidRequest, is_a, shown, text_of
from rr_actors.managers.external_programs import RunningProgram
from rr_actors.registrar.model.health import LONGEST_S, SHORTEST_S, Health, check_count
from rr_actors.runtime.time_limits import RunningLimit, RunningTime

Probe = Callable[[int], bool]
"""A user's function: it gets the pid of a program, and returns whether the program is ready, or well."""
Condition = Callable[[RunningProgram], str]
"""Returns what is seen instead of what is expected; "" if it holds."""

_CONNECT_LIMIT_S = 0.2
_ACCEPT_POLL_S = 0.01
_LOOK_S = 0.25  # looks that are closer together are often late by more than their period
_ESTABLISHED = "01"
_OF_TIMEOUT = 0.5  # of a check's time limit, for a connection: then its own words say what is wrong
_CLOCK_SLACK_S = 0.05  # a process's start is known to 10 ms, a file's time to one tick of the kernel


def what_is_missing(conditions: Iterable[Condition], running: RunningProgram) -> str:
    """Return what is seen of all conditions that do not hold; "" if each holds."""
    return "; ".join(filter(None, [condition(running) for condition in conditions]))


def file_is_written(path: Path, *, repeated: bool) -> Condition:
    """Expect that the file is written after the program was started, even if the clock is set.

    Args:
        repeated: an earlier attempt may have started the program. Its file may then exist already, and its time is
            compared with the program's start.
    """
    before = look_of(path)

    def condition(running: RunningProgram) -> str:
        found = look_of(path)
        if found is None:
            return f"file {path}: not there"
        if found != before or (repeated and _is_of(found, running)):
            return ""
        return f"file {path}: not written since the start"

    return condition


def _is_of(found: tuple[int, ...], running: RunningProgram) -> bool:
    started = time.time() - (time.clock_gettime(time.CLOCK_BOOTTIME) - running.start_time)
    return found[-1] / 1e9 >= started - _CLOCK_SLACK_S


def look_of(path: Path) -> tuple[int, ...] | None:
    """Return a value that changes when the file is written again; None if there is no file."""
    try:
        found = os.stat(path)  # it is asked often
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


class OutputGoesOn:
    """Expect that a file of output is written to again and again. One thread at a time.

    Args:
        file: the file; when it gets long, another takes its name.
        within_s: seconds within which it is written to again, without standstills of this process.
        look_s: seconds between two looks.
    """

    def __init__(self, file: Path, within_s: float, look_s: float) -> None:
        self._file, self._within_s = file, within_s
        self._ran = RunningTime(max(look_s, _LOOK_S))
        self.begin()

    def begin(self) -> None:
        """Begin to count now."""
        self._seen, self._looked_at = look_of(self._file), self._ran.read()
        self._written_at = self._looked_at

    def __call__(self, running: RunningProgram) -> str:
        found, now = look_of(self._file), self._ran.read()
        passed_s, self._looked_at = now - self._looked_at, now
        if found is not None and found != self._seen:
            ago_s = time.time() - found[-1] / 1e9
            self._seen, self._written_at = found, now - min(max(0.0, ago_s), passed_s)  # the clock may have been set
        silent_s = now - self._written_at
        return "" if silent_s < self._within_s else f"no line of its output for {silent_s:.1f} s"


def port_accepts(host: str, port: int) -> Condition:
    """Expect that a TCP port accepts a connection."""
    return functools.partial(_accepts, host, port)


def _accepts(host: str, port: int, running: RunningProgram) -> str:
    try:
        socket.create_connection((host, port), _CONNECT_LIMIT_S).close()
    except OSError as error:
        return f"port {port} of {host}: {text_of(error)}"
    return ""


def port_serves(host: str, port: int, limit_s: float) -> Condition:
    """Expect that the program accepts a connection at a TCP port within the limit, and not the kernel alone.

    The kernel answers for a program that hangs, and keeps the connection for it.
    """
    return functools.partial(
        _serves,
        lambda: socket.create_connection((host, port), limit_s),
        f"port {port} of {host}",
        _is_kept_of_tcp,
        limit_s,
    )


def socket_serves(path: str, limit_s: float) -> Condition:
    """Expect the same at a unix socket."""

    def connect() -> socket.socket:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.settimeout(limit_s)
            connection.connect(path)
        except BaseException:
            connection.close()
            raise
        return connection

    return functools.partial(_serves, connect, f"socket {path}", _is_kept_of_unix, limit_s)


def _serves(
    connect: Callable[[], socket.socket],
    what: str,
    is_kept: Callable[[socket.socket], bool],
    limit_s: float,
    running: RunningProgram,
) -> str:
    limit = RunningLimit(limit_s)
    try:
        with connect() as connection:
            while is_kept(connection):
                if limit.is_over():
                    return f"{what}: no connection was accepted within {limit_s:g} s"
                time.sleep(min(_ACCEPT_POLL_S, limit.slice_s))
    except OSError as error:
        return f"{what}: {text_of(error)}"
    return ""


def _is_kept_of_tcp(connection: socket.socket) -> bool:
    """Return whether the kernel keeps the other end of a connection for a program of this machine.

    Such an end is established, and has no inode until the program accepts it.
    """
    ports = f":{connection.getpeername()[1]:04X}", f":{connection.getsockname()[1]:04X}"
    for table in ("tcp", "tcp6"):
        for row in _rows(table):
            if row[1].endswith(ports[0]) and row[2].endswith(ports[1]):
                return row[3] == _ESTABLISHED and row[9] == "0"
    return False


def _is_kept_of_unix(connection: socket.socket) -> bool:
    """Return whether the kernel keeps connections for the program that listens at this path."""
    path = connection.getpeername()
    return any(row[6] == "0" and row[7:] == path.split() for row in _rows("unix"))


def _rows(table: str) -> list[list[str]]:
    """Return the rows of a table of sockets that the kernel has for this process; [] if it has none."""
    try:
        return [line.split() for line in Path("/proc/net", table).read_text().splitlines()[1:]]
    except OSError:
        return []


def probe_agrees(name: str, probes: Mapping[str, Probe], path: str) -> Condition:
    """Expect that a probe returns a true value: one of `probes`, or the function "package.module:function".

    Raises:
        InvalidRequest: there is no such function; `path` is the field that names it.
    """
    probe = probes.get(name) or _import(name, path)

    def condition(running: RunningProgram) -> str:
        said = probe(running.pid)
        return "" if said else f"probe {name}: it returned {shown(said)}"

    return condition


def _import(name: str, path: str) -> Probe:
    module, _, function = name.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), function)
    except (Exception, SystemExit) as error:  # importing runs the module: it may raise anything
        got = f"{shown(name)}: {text_of(error)}"
        text = f"{path}: expected a probe of the manager, or 'package.module:function', got {got}"
        raise InvalidRequest(text, path=path, expected="'package.module:function'") from error
    return found


# -- health ------------------------------------------------------------------------------------------------------------


class ProgramHealth(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is expected of a program while it runs. At least one condition is given, and all given ones must hold.

    A program of which `fail_after` checks in a row fail is **silent**. Its holders hear WARNING after the first of
    them. After the last one the program is ended, and they hear FATAL, as if it had ended by itself.

    Attributes:
        line_every_s: seconds within which it writes to its output again.
        port: a TCP port, on `host`, at which it accepts connections.
        socket: the path of a unix socket at which it accepts connections.
        probe: the name of a function that gets its pid and returns whether it is well, as `probe` of Ready.
        every_s: seconds from one check to the next.
        timeout_s: seconds after which a check that has not returned has failed.
        fail_after: failed checks in a row after which it is silent.

    Raises:
        InvalidSpec: a value is wrong, or no condition is given. `.field`, `.expected`, `.got`
    """

    line_every_s: float | None = None
    port: int | None = None
    host: str = "127.0.0.1"
    socket: str | None = None
    probe: str | None = None
    every_s: float = 1.0
    timeout_s: float = 1.0
    fail_after: int = 3

    def __post_init__(self) -> None:
        if (self.line_every_s, self.port, self.socket, self.probe) == (None,) * 4:
            raise invalid("ProgramHealth", "line_every_s", "this, port, socket or probe", None)
        for field in ("every_s", "timeout_s", "line_every_s"):
            if (seconds := getattr(self, field)) is not None:
                check_number(seconds, "ProgramHealth", field, least=SHORTEST_S, most=LONGEST_S)
        check_count(self.fail_after, "ProgramHealth", "fail_after")
        if self.port is not None and (type(self.port) is not int or not 1 <= self.port <= 65_535):
            raise invalid("ProgramHealth", "port", "a whole number from 1 to 65535", self.port)
        for field in ("host", "socket", "probe"):
            text = getattr(self, field)
            if (text is not None or field == "host") and (not is_a(text, str) or not text):
                raise invalid("ProgramHealth", field, "a text that is not empty", text)


class ProgramCheck:
    """The check of one program. One thread at a time.

    Attributes:
        health: how often it runs, and what follows.

    Raises:
        InvalidRequest: there is no such probe.
    """

    def __init__(self, wanted: ProgramHealth, output: Path, probes: Mapping[str, Probe]) -> None:
        fail_after = wanted.fail_after
        self.health = Health(wanted.every_s, wanted.timeout_s, fail_after=fail_after, fatal_after=fail_after)
        self._goes_on: OutputGoesOn | None = None
        if wanted.line_every_s is not None:
            self._goes_on = OutputGoesOn(output, wanted.line_every_s, wanted.every_s)
        self._conditions = [*_conditions(wanted, probes)]

    def seen(self, running: RunningProgram) -> str:
        """Return what is seen instead of what is expected; "" if the program is well."""
        goes_on = [] if self._goes_on is None else [self._goes_on]
        return what_is_missing([*goes_on, *self._conditions], running)

    def begin_anew(self) -> None:
        """Count no time before this moment as silence: the program was paused."""
        if self._goes_on is not None:
            self._goes_on.begin()


def _conditions(wanted: ProgramHealth, probes: Mapping[str, Probe]) -> Iterator[Condition]:
    limit_s = wanted.timeout_s * _OF_TIMEOUT
    if wanted.port is not None:
        yield port_serves(wanted.host, wanted.port, limit_s)
    if wanted.socket is not None:
        yield socket_serves(wanted.socket, limit_s)
    if wanted.probe is not None:
        yield probe_agrees(wanted.probe, probes, "health.probe")
