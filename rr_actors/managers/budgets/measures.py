"""Measures: how the capacity of a pool follows what a probe reads. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from rr_actors.base.checks import is_number

Probe = Callable[[], float]


class Measure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a pool's capacity is measured. The pool's own `capacity` is the most that it can be.

    With `probe` alone a reading is the capacity. A lower one counts at once, and a higher one if it is more than
    `step` higher, or the most that there can be: readings that waver take away as little as they can.

    With `shed_at` and `restore_at` a reading is a sign of strain: a frequency, a temperature, a pressure. At
    `shed_at`, or beyond it, the capacity falls by `step`; at `restore_at`, or beyond it, it rises by `step`. Between
    them it stays. If `shed_at` is the greater one, great readings are bad, otherwise small ones.

    Attributes:
        probe: a function without arguments that returns a number; or its name, "package.module:function"; or
            "psi:cpu", "psi:memory" or "psi:io". Those are the percentage of the last ten seconds in which something
            had to wait for it, by the kernel's pressure stall information.
        every_s: seconds from a reading to the next.
        timeout_s: seconds that a probe may take. One that hangs is not begun again until it has returned.
        shed_at, restore_at: readings. Both are given, or neither.
        step: in the unit of the pool.
    """

    probe: Any
    every_s: float = 1.0
    timeout_s: float = 5.0
    shed_at: float | None = None
    restore_at: float | None = None
    step: float = 0.0


def faults(measure: Measure) -> Iterator[tuple[str, str]]:
    """Return each field that is wrong, with what is expected of it."""
    for field, value in (("every_s", measure.every_s), ("timeout_s", measure.timeout_s)):
        if not is_number(value) or value <= 0:
            yield field, "a number above 0"
    signs = {"shed_at": measure.shed_at, "restore_at": measure.restore_at}
    for field, value in signs.items():
        if value is not None and not is_number(value):
            yield field, "a number"
    given = [value for value in signs.values() if value is not None]
    if len(given) == 1 or (len(given) == 2 and given[0] == given[1]):
        yield "restore_at", "another number than shed_at; both or neither"
    if not is_number(measure.step) or measure.step < 0 or (given and measure.step == 0):
        yield "step", "a number above 0" if given else "a number of at least 0"


def next_capacity(measure: Measure, most: float, before: float, reading: float) -> float:
    """Return the capacity after a reading, from 0 to `most`; `before`: the capacity until now."""
    before = min(before, most)
    shed_at, restore_at = measure.shed_at, measure.restore_at
    if shed_at is None or restore_at is None:
        reading = min(max(reading, 0.0), most)
        counts = reading < before or reading > before + measure.step or reading == most
        return reading if counts else before
    sign = 1 if shed_at > restore_at else -1
    if sign * reading >= sign * shed_at:
        return max(0.0, before - measure.step)
    return min(most, before + measure.step) if sign * reading <= sign * restore_at else before
