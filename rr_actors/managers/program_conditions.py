"""Conditions: what a program needs to be ready, or to be well, and what is seen where it is not so."""

from __future__ import annotations

import functools
import importlib
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rr_actors.base.errors import InvalidRequest, shown, text_of
from rr_actors.managers.external_programs import Running

Probe = Callable[[int], bool]
"""A user's function: it gets the pid of a program, and returns whether the program is ready, or well."""
Condition = Callable[[Running], str]
"""Returns what is seen instead of what is expected; "" if it holds."""

_CONNECT_LIMIT_S = 0.2
_CLOCK_SLACK_S = 0.05  # a process's start is known to 10 ms, a file's time to one tick of the kernel


def what_is_missing(conditions: Iterable[Condition], running: Running) -> str:
    """Return what is seen of all conditions that do not hold; "" if each holds."""
    return "; ".join(filter(None, [condition(running) for condition in conditions]))


def file_is_written(path: Path, *, repeated: bool) -> Condition:
    """Expect that the file is written after the program was started, even if the clock is set.

    Args:
        repeated: an earlier attempt may have started the program. Its file may then exist already, and its time is
            compared with the program's start.
    """
    before = look_of(path)

    def condition(running: Running) -> str:
        found = look_of(path)
        if found is None:
            return f"file {path}: not there"
        if found != before or (repeated and _is_of(found, running)):
            return ""
        return f"file {path}: not written since the start"

    return condition


def _is_of(found: tuple[int, ...], running: Running) -> bool:
    started = time.time() - (time.clock_gettime(time.CLOCK_BOOTTIME) - running.start_time)
    return found[-1] / 1e9 >= started - _CLOCK_SLACK_S


def look_of(path: Path) -> tuple[int, ...] | None:
    """Return a value that changes when the file is written again; None if there is no file."""
    try:
        found = os.stat(path)  # it is asked often
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def port_accepts(host: str, port: int) -> Condition:
    """Expect that a TCP port accepts a connection."""
    return functools.partial(_accepts, host, port)


def _accepts(host: str, port: int, running: Running) -> str:
    try:
        socket.create_connection((host, port), _CONNECT_LIMIT_S).close()
    except OSError as error:
        return f"port {port} of {host}: {text_of(error)}"
    return ""


def probe_agrees(name: str, probes: Mapping[str, Probe], path: str) -> Condition:
    """Expect that a probe returns a true value: one of `probes`, or the function "package.module:function".

    Raises:
        InvalidRequest: there is no such function; `path` is the field that names it.
    """
    probe = probes.get(name) or _import(name, path)

    def condition(running: Running) -> str:
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
