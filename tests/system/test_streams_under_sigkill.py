"""Streams with checksums, while their publisher and their readers are killed at random: no reader sees a wrong byte."""

from __future__ import annotations

import itertools
import os
import random
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

import rr_actors as rr
from support import kill
from support_slow import few_now
from support_stream_soak import Figures
from support_stream_traffic import CHILDREN, Traffic, limits, tree, wait_for_more, watching

Start = Callable[..., rr.System]


def kills(seconds: float) -> Iterable[int]:
    """Yield the numbers of kills: three, or as many as there is time for."""
    until = time.monotonic() + seconds
    return itertools.takewhile(lambda number: number < 3 or time.monotonic() < until, itertools.count())


@pytest.mark.parametrize("seconds", few_now([0], [20]))
def test_no_reader_sees_a_wrong_byte_whoever_is_killed(start: Start, tmp_path: Path, seconds: float) -> None:
    told = tmp_path / "told"
    told.mkdir()
    system = start(tree(told), config=limits())
    queries = watching(system)
    traffic, chance = Traffic(told), random.Random(11)

    for _ in kills(seconds):
        wait_for_more(traffic, lambda: chance.randrange(1, 100))
        kill(system, chance.choice(CHILDREN))
    wait_for_more(traffic, lambda: 1)
    for query in queries:
        query.unload()
    traffic.check()
    print(f"{traffic.frames()} frames, none wrong")


def test_the_figures_of_processes_count_what_they_have() -> None:
    before = Figures.of([os.getpid()])
    more = [os.open("/dev/null", os.O_RDONLY) for _ in range(5)]
    after = Figures.of([os.getpid()])
    for descriptor in more:
        os.close(descriptor)

    assert after.descriptors == before.descriptors + 5
    assert min(before) > 1
