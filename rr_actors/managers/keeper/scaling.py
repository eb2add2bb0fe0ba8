"""How many replicas of a thing are wanted, by what it has to do. Pure.

The rule is that of Kubernetes' HorizontalPodAutoscaler (its page "Algorithm details"): as many replicas as bring what
is read to its target; no change within the tolerance; up at once, and down only to the most that was right at any time
within the window.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Literal

import msgspec

from rr_actors.base.checks import is_number

_FUZZ = 1e-9  # 1.1 / 0.1 is a little more than 11
_HUGE = 1e9  # more replicas than any limit allows


class ScaleOn(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the number of replicas follows. It has a `usage` or a `probe`.

    Attributes:
        target: what is right for one replica, above 0.
        usage: a number of the usage callbacks of what is kept, such as "cpu". The mean of the replicas that are ready
            is compared with the target. It counts what the kept resource says itself, without its dependencies.
        probe: a function without arguments that returns a number, or its name, "package.module:function", or
            "psi:cpu", "psi:memory" or "psi:io", as for a Measure.
        kind: what a reading of the probe is. "total": what all replicas have to do together, such as the length of a
            queue; the target is the part of one. "level": what each of them has, such as a latency.
        tolerance: the part of the target by which a reading may be off without a change.
        down_s: seconds for which fewer replicas must have been enough, before some are released.
        every_s: seconds from a reading to the next.
        timeout_s: seconds that a reading may take.
    """

    target: float
    usage: str = ""
    probe: Any = None
    kind: Literal["total", "level"] = "total"
    tolerance: float = 0.1
    down_s: float = 300.0
    every_s: float = 5.0
    timeout_s: float = 5.0

    @property
    def label(self) -> str:
        """What is read, as people call it."""
        return self.usage or str(self.probe).rpartition(".")[2]


class Range(msgspec.Struct, frozen=True):
    """The least and the most replicas, and what decides between them."""

    least: int
    most: int
    scale_on: ScaleOn


class Reading(msgspec.Struct, frozen=True):
    """What was read. `count`: of how many replicas a level is the mean; those that say nothing do not count."""

    value: float
    count: int = 0


class Advice(msgspec.Struct, frozen=True):
    """How many replicas were right at a time, by the monotonic clock."""

    at: float
    count: int


class Scale(msgspec.Struct, frozen=True):
    """How many replicas are wanted.

    Attributes:
        wanted: how many.
        why: the reason of the last change, "2 -> 3: cpu is 0.93, the target 0.7"; "" if there was none.
        recent: what was right within the window, the most first: a later one that is as great replaces the others.
    """

    wanted: int
    why: str = ""
    recent: tuple[Advice, ...] = ()


def begun(range_: Range, wanted: int, why: str, now: float) -> Scale:
    """Return the scale to begin with: at a start, of what was wanted before it. Nothing is released for `down_s`."""
    count = min(max(wanted, range_.least), range_.most)
    return Scale(count, why, (Advice(now, count),))


def within(range_: Range, scale: Scale) -> Scale:
    """Return the scale inside its limits, which another file may have changed."""
    if scale.wanted < range_.least:
        return _changed(scale, range_.least, f"min is {range_.least}")
    if scale.wanted > range_.most:
        return _changed(scale, range_.most, f"max is {range_.most}")
    return scale


def next_scale(range_: Range, scale: Scale, reading: Reading, now: float) -> Scale:
    """Return the scale after a reading."""
    on = range_.scale_on
    right = min(max(_right_count(on, scale.wanted, reading), range_.least), range_.most)
    window = tuple(one for one in scale.recent if one.at > now - on.down_s and one.count > right)
    recent = (*window, Advice(now, right))
    scale = msgspec.structs.replace(scale, recent=recent)
    count = right if right > scale.wanted else min(scale.wanted, recent[0].count)
    each = " each" if on.kind == "total" and not on.usage else ""
    return _changed(scale, count, f"{on.label} is {reading.value:.4g}, the target {on.target:g}{each}")


def _changed(scale: Scale, count: int, why: str) -> Scale:
    if count == scale.wanted:
        return scale
    return msgspec.structs.replace(scale, wanted=count, why=f"{scale.wanted} -> {count}: {why}")


def _right_count(on: ScaleOn, wanted: int, reading: Reading) -> int:
    """Return how many replicas bring the reading to its target."""
    ratio = min(max(reading.value, 0.0) / on.target, _HUGE)
    if on.probe is not None and on.kind == "total":
        return wanted if wanted and _is_near(on, ratio / wanted) else _ceil(ratio)
    if wanted == 0:
        return _ceil(ratio)
    return _by_level(on, wanted, ratio, min(reading.count, wanted))


def _by_level(on: ScaleOn, wanted: int, ratio: float, count: int) -> int:
    """Return the right number where `count` of the wanted replicas have `ratio` times the target on average.

    Those that say nothing count as idle if there are too few replicas, and as loaded as is right if there are too many:
    the change is rather too small, and what is still starting leads to no more of it.
    """
    if count == 0 or _is_near(on, ratio):
        return wanted
    filled = (ratio * count + (wanted - count if ratio < 1 else 0)) / wanted
    if _is_near(on, filled) or (filled < 1) != (ratio < 1):
        return wanted
    return _ceil(filled * wanted)


def _is_near(on: ScaleOn, ratio: float) -> bool:
    return abs(ratio - 1) <= on.tolerance + _FUZZ


def _ceil(number: float) -> int:
    return math.ceil(number - _FUZZ)


def faults(on: ScaleOn) -> Iterator[tuple[str, str]]:
    """Return each field that is wrong, with what is expected of it. The probe is looked up by its reader."""
    for field, value in (("target", on.target), ("every_s", on.every_s), ("timeout_s", on.timeout_s)):
        if not is_number(value) or value <= 0:
            yield field, "a number above 0"
    for field, value in (("tolerance", on.tolerance), ("down_s", on.down_s)):
        if not is_number(value) or value < 0:
            yield field, "a number of at least 0"
    if bool(on.usage) == (on.probe is not None):
        yield "usage", "a usage or a probe, and not both"
    elif on.usage and on.kind != "total":
        yield "kind", "none, as a usage is that of each replica"
