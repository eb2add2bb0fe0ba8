"""A wall clock that a test can set in all processes of a system: those that import this module.

The machine's own clock is everybody's and stays as it is. Everything in rr_actors that asks for the time of day calls
time.time() or time.time_ns() by the module's name, so that these can be replaced.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

_VARIABLE = "RR_ACTORS_TEST_CLOCK"
_time, _time_ns = time.time, time.time_ns


def _offset_s() -> float:
    try:
        return float(Path(os.environ[_VARIABLE]).read_text() or 0)
    except (KeyError, OSError, ValueError):
        return 0.0


def begin(file: Path) -> None:
    """From now on this process, and those it starts, have a clock of their own."""
    file.write_text("0")
    os.environ[_VARIABLE] = str(file)
    install()


def end() -> None:
    """This process has the machine's clock again."""
    os.environ.pop(_VARIABLE, None)
    time.time, time.time_ns = _time, _time_ns


def jump(offset_s: float) -> None:
    """Set the clock of all of them: so much later, or earlier, than the machine's."""
    file = Path(os.environ[_VARIABLE])
    new = file.with_suffix(".new")
    new.write_text(str(offset_s))
    new.replace(file)


def install() -> None:
    """Have this process ask that clock, if there is one."""
    if _VARIABLE in os.environ:
        time.time = lambda: _time() + _offset_s()
        time.time_ns = lambda: _time_ns() + int(_offset_s() * 1e9)


install()
