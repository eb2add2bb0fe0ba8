"""A consumer and a provider in another process, beside a raw pipe, both placed alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rr_actors as rr
from benchmarks import placement as placement_of
from benchmarks.workload import DURABILITIES, PAYLOAD, Durability, running
from benchmarks.yardsticks import pipe_echo


def cases() -> Iterator[tuple[str, Durability]]:
    """Every placement with every durability; "power", which waits for the disk, only as the kernel places it."""
    for placement in placement_of.placements():
        for durability in DURABILITIES:
            if durability != "power" or placement == placement_of.AS_IT_COMES:
                yield placement, durability


def provider_processes(times: int) -> int:
    """How many provider processes one figure is measured with, one after another; in a quick run one.

    The pipe's process may be one that is slower for its whole life (docs/performance.md): the median leaves it out.
    """
    return 5 if times >= 500 else 1


@contextmanager
def placed(placement: str, durability: Durability) -> Iterator[tuple[Callable[[], Any], rr.System, rr.Registrar]]:
    """The echo of the pipe, and a system with its consumer, placed alike."""
    with placement_of.here(placement), pipe_echo(PAYLOAD) as echo, running(durability) as (system, consumer):
        placement_of.part(placement)
        yield echo, system, consumer
