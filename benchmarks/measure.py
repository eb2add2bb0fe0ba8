"""Samples of durations, taken so that the things compared see the same machine."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Samples:
    """Durations of one operation, in seconds."""

    seconds: tuple[float, ...]

    def __add__(self, other: Samples) -> Samples:
        return Samples(self.seconds + other.seconds)

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    @property
    def p99(self) -> float:
        ordered = sorted(self.seconds)
        return ordered[min(len(ordered) - 1, int(len(ordered) * 0.99))]


def time_each(operation: Callable[[], object], times: int) -> list[float]:
    """Seconds that each of `times` calls took. The garbage collector stays on, as in real use."""
    clock = time.perf_counter
    seconds: list[float] = []
    for _ in range(times):
        start = clock()
        operation()
        seconds.append(clock() - start)
    return seconds


def time_with(operation: Callable[[Any], object], values: Iterable[Any]) -> list[float]:
    """Seconds that `operation` took for each of `values`; making the value is not counted."""
    clock = time.perf_counter
    seconds: list[float] = []
    for value in values:
        start = clock()
        operation(value)
        seconds.append(clock() - start)
    return seconds


def interleaved(
    operations: dict[str, Callable[[], object]],
    *,
    times: int,
    rounds: int = 10,
    after_turn: Callable[[], object] = lambda: None,
) -> dict[str, Samples]:
    """Measure several operations in turns, `times` calls each in all: a slow second of the machine is everyone's.

    A tenth of a round goes before each turn unmeasured, to warm the caches that the others have cooled. `after_turn`
    clears up, unmeasured too.
    """
    a_round = max(1, times // rounds)
    seconds: dict[str, list[float]] = {name: [] for name in operations}
    gc.collect()
    for _ in range(rounds):
        for name, operation in operations.items():
            time_each(operation, max(1, a_round // 10))
            seconds[name] += time_each(operation, a_round)
            after_turn()
    return {name: Samples(tuple(taken)) for name, taken in seconds.items()}
