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

    With `surplus_at` and `settled_at` a reading may also say that there is too much: a frequency that is too high, a
    battery that is full. At `surplus_at`, or beyond it, one more of the pool's sinks is loaded; at `settled_at`, or
    beyond it, one is released. Between them nothing changes.

    Attributes:
        probe: a function without arguments that returns a number; or its name, "package.module:function"; or
            "psi:cpu", "psi:memory" or "psi:io". Those are the percentage of the last ten seconds in which something
            had to wait for it, by the kernel's pressure stall information.
        every_s: seconds from a reading to the next.
        timeout_s: seconds that a probe may take. One that hangs is not begun again until it has returned.
        shed_at, restore_at: readings. Both are given, or neither.
        surplus_at, settled_at: readings. Both are given, or neither. `surplus_at` is on the other side of `restore_at`
            than `shed_at`.
        step: in the unit of the pool.
    """

    probe: Any
    every_s: float = 1.0
    timeout_s: float = 5.0
    shed_at: float | None = None
    restore_at: float | None = None
    step: float = 0.0
    surplus_at: float | None = None
    settled_at: float | None = None


def faults(measure: Measure) -> Iterator[tuple[str, str]]:
    """Return each field that is wrong, with what is expected of it."""
    for field, value in (("every_s", measure.every_s), ("timeout_s", measure.timeout_s)):
        if not is_number(value) or value <= 0:
            yield field, "a number above 0"
    for first, second in (("shed_at", "restore_at"), ("surplus_at", "settled_at")):
        signs = {first: getattr(measure, first), second: getattr(measure, second)}
        wrong = [field for field, value in signs.items() if value is not None and not is_number(value)]
        yield from ((field, "a number") for field in wrong)
        given = [value for value in signs.values() if value is not None]
        if not wrong and (len(given) == 1 or (len(given) == 2 and given[0] == given[1])):
            yield second, f"another number than {first}; both or neither"
    signs = measure.shed_at, measure.restore_at, measure.settled_at, measure.surplus_at
    order = [value for value in signs if value is not None and is_number(value)]
    if len(order) == len(signs) and order not in (sorted(order), sorted(order, reverse=True)):
        yield "surplus_at", "shed_at, restore_at, settled_at and surplus_at in this order, rising or falling"
    given = [value for value in signs[:2] if value is not None]
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


def surplus(measure: Measure, reading: float) -> int:
    """Return 1 if a reading says that there is too much, -1 if there is not any more, and 0 in between."""
    surplus_at, settled_at = measure.surplus_at, measure.settled_at
    if surplus_at is None or settled_at is None:
        return 0
    sign = 1 if surplus_at > settled_at else -1
    if sign * reading >= sign * surplus_at:
        return 1
    return -1 if sign * reading <= sign * settled_at else 0
