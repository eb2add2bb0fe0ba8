"""A process that measures the same in turns with this one: what the machine does meanwhile, both see."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing.connection import Connection

from benchmarks import placement
from benchmarks.measure import Samples
from benchmarks.table import Row

Measured = dict[str, list[float]]
"""Seconds that each operation took, by its name."""

Grown = tuple[Callable[[int], object], Callable[[], Measured]]
"""Something that grows: to be called with the size it is to have, and to measure it."""

Opens = Callable[[int], AbstractContextManager[Grown]]
"""Sets something up that grows; called with how often each operation is to be timed in a measurement."""

ROUNDS = 10
AIM = 1.25


class Bystander:
    """What `opens(times)` sets up, of one size, in a process of its own. `opens` is a function of a module."""

    def __init__(self, opens: Opens, times: int, size: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, opens, times, size))
        self._process.start()
        theirs.close()

    def measure(self) -> Measured:
        """Have it measure once.

        Raises:
            EOFError: it failed; its traceback is on stderr.
        """
        self._connection.send(True)
        return self._connection.recv()

    def close(self) -> None:
        """End it."""
        self._connection.close()
        self._process.join()

    def __enter__(self) -> Bystander:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _serve(connection: Connection, opens: Opens, times: int, size: int) -> None:
    with opens(times) as (fill, measure):
        fill(size)
        while True:
            try:
                connection.recv()
            except EOFError:
                return
            connection.send(measure())


@contextmanager
def beside(opens: Opens, times: int, small: int) -> Iterator[tuple[Grown, Bystander]]:
    """What `opens(times)` sets up, here, and there with a size that stays `small`.

    Both on one core where that can be chosen: else the one or the other is quicker for where the kernel has put it.
    """
    with placement.here(placement.placements()[0]), Bystander(opens, times, small) as bystander, opens(times) as grown:
        yield grown, bystander


def compared(size: int, small: int, measure: Callable[[], Measured], bystander: Bystander) -> list[Row]:
    """Measure here, where `size` are held, in turns with there, where `small` are; one beside the other."""
    here: Measured = {}
    there: Measured = {}
    for _ in range(ROUNDS):
        for taken, gathered in ((bystander.measure(), there), (measure(), here)):
            for what, seconds in taken.items():
                gathered.setdefault(what, []).extend(seconds)
    rows: list[Row] = []
    for what, seconds in here.items():
        samples = Samples(tuple(seconds))
        ratio = None if size == small else samples.median / Samples(tuple(there[what])).median
        against = "" if ratio is None else f"at {small:,}"
        aim = None if ratio is None else AIM
        name = f"{size:,} held: {what}"
        rows.append(Row(name, samples.median * 1e6, "µs", samples.p99 * 1e6, ratio, against, at_most=aim))
    return rows
