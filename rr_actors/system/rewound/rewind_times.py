"""Times that a person types for a moment of a recording: of the clock, or from its beginning or end. Pure."""

from __future__ import annotations

import contextlib
import math
import time

from rr_actors.base.errors import UsageError, shown
from rr_actors.system.recording.event_texts import clock

_FORMS = ("%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%d %H:%M", "%Y-%m-%dT%H:%M")
_OF_A_DAY = ("%H:%M:%S", "%H:%M")
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_EPOCH = 10**8  # a number above it is a time in seconds since the epoch
_NEAR_S = 0.001
"""How far outside a time may be: people see milliseconds."""


def time_meant(text: str, since: float, until: float, option: str = "--at") -> float:
    """Return the time that a person means, in seconds since the epoch.

    Args:
        text: "12:46:55.020", of the day of the recording; "2026-11-30 12:46:55"; "+12.5s", "+3m" from the beginning;
            "-10s" before the end; "start" or "end"; or seconds since the epoch.
        since, until: the first and the last time of the recording.

    Raises:
        UsageError: it is no time, or it is before the beginning or after the end.
    """
    at = _parsed(text.strip(), since, until)
    if at is None:
        expected = (
            "a time (12:46:55.020, 2026-11-30 12:46:55.020, +12.5s from the beginning, -3m before the end, start, end)"
        )
        raise UsageError(f"{option}: expected {expected}, got {shown(text)}")
    if not since - _NEAR_S <= at <= until + _NEAR_S:
        expected = f"a time from {_said(since)} to {_said(until)}"
        raise UsageError(f"{option}: expected {expected}, got {_said(at)}")
    return max(at, since)


def _said(at: float) -> str:
    with contextlib.suppress(OverflowError, ValueError, OSError):
        return clock(at)
    return f"{at:g}"


def _parsed(text: str, since: float, until: float) -> float | None:
    if text in ("start", "end"):
        return since if text == "start" else until
    if text[:1] in ("+", "-"):
        seconds = _seconds(text[1:])
        return None if seconds is None else since + seconds if text[0] == "+" else until - seconds
    whole, dot, fraction = text.partition(".")
    part = 0.0
    if dot:
        if not fraction.isdecimal():
            return None
        part = float(f"0.{fraction}")
    if text.replace(".", "", 1).isdecimal() and float(text) > _EPOCH:
        return float(text)
    with contextlib.suppress(OverflowError, ValueError):
        for form in _FORMS:
            with contextlib.suppress(ValueError):
                return time.mktime(time.strptime(whole, form)) + part
        for form in _OF_A_DAY:
            with contextlib.suppress(ValueError):
                return _of_its_day(time.strptime(whole, form), since) + part
    return None


def _of_its_day(clock_time: time.struct_time, since: float) -> float:
    """Return the first time after the recording's beginning, or within the second of it, when the clock says so."""
    day = time.localtime(since)
    hour, minute, second = clock_time[3:6]
    for later in (0, 1):
        at = time.mktime((day.tm_year, day.tm_mon, day.tm_mday + later, hour, minute, second, 0, 0, -1))
        if at >= math.floor(since):
            break
    return at


def _seconds(text: str) -> float | None:
    number, unit = (text[:-1], _UNITS[text[-1]]) if text[-1:] in _UNITS and text else (text, 1.0)
    with contextlib.suppress(ValueError):
        if 0 <= (seconds := float(number) * unit) < math.inf:
            return seconds
    return None
