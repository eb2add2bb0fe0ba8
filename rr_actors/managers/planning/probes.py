"""Probes by name: functions of a module, and the kernel's pressure stall information (PSI)."""

from __future__ import annotations

import functools
import importlib
from pathlib import Path
from typing import cast

from rr_actors.base.errors import shown, text_of
from rr_actors.managers.budgets.measures import Probe

PRESSURE = Path("/proc/pressure")
_PSI = ("psi:cpu", "psi:memory", "psi:io")
_EXPECTED = f"a function, its name 'package.module:function', or one of {', '.join(_PSI)}"


class NoProbe(Exception):
    """A measure names no probe that could be asked: what was `expected`, and what was found instead."""

    def __init__(self, expected: str, found: str) -> None:
        super().__init__(f"expected {expected}, got {found}")
        self.expected, self.found = expected, found


def probe_of(named: object, pressure: Path = PRESSURE) -> Probe:
    """Return the probe that a measure names.

    Raises:
        NoProbe: there is none of this name, or this kernel does not measure its pressure.
    """
    if isinstance(named, str) and named.startswith("psi:"):
        return _pressure_probe(named, pressure)
    found = _imported(named) if isinstance(named, str) else named
    if not callable(found):
        raise NoProbe(_EXPECTED, shown(named))
    return cast("Probe", found)


def _imported(name: str) -> object:
    module, _, function = name.partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except (Exception, SystemExit) as error:  # importing runs the module: it may raise anything
        raise NoProbe(_EXPECTED, f"{shown(name)}: {text_of(error)}") from error


def _pressure_probe(name: str, folder: Path) -> Probe:
    if name not in _PSI:
        raise NoProbe(_EXPECTED, shown(name))
    file = folder / name.removeprefix("psi:")
    try:
        _read_pressure(file)
    except OSError as error:
        todo = "a kernel that measures its pressure: Linux 4.20 or later, booted with psi=1"
        raise NoProbe(todo, f"{file}: {error.strerror}") from error
    return functools.partial(_read_pressure, file)


def _read_pressure(file: Path) -> float:
    """Return the percentage of the last ten seconds in which something waited: "some avg10=0.12 avg60=..."."""
    some = file.read_text().split()
    return float(some[1].removeprefix("avg10="))
