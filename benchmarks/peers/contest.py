"""One contestant: echoes, in turns with a raw pipe of the same process, and writes what it took.

Run as `python -m benchmarks.peers.contest NAME OUT [--calls N] [--kills N]`, in a process of its own: whatever it
imports, starts or breaks is no other contestant's concern.
"""

from __future__ import annotations

import argparse
import importlib
import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measure import Samples, time_each
from benchmarks.yardsticks import pipe_echo

PAYLOAD = b"x" * 200
IN_FLIGHT = 256
ROUNDS = 10
PIPELINED_ROUNDS = 5

CONTESTANTS = {
    "pykka": "pykka ask, same process",
    "actor": "rr_actors Actor ask",
    "load": "rr_actors warm durable load",
    "xoscar": "xoscar actor call",
    "thespian": "Thespian ask",
    "ray": "Ray actor call",
}
"""Module of this package and what it measures; all but Pykka's talk to another process."""


@dataclass(frozen=True)
class Contest:
    """A contestant that is ready.

    Attributes:
        version: of what is measured.
        calls: makes so many calls, each waiting for its answer; the seconds of each.
        pipelined: makes so many with IN_FLIGHT of them in flight; the seconds they took together. None: it cannot.
        kill: SIGKILLs the process that answers and returns the seconds until it answers again. None: it does not.
        between: clears up after a round, unmeasured.
    """

    version: str
    calls: Callable[[int], list[float]]
    pipelined: Callable[[int], float] | None = None
    kill: Callable[[], float] | None = None
    between: Callable[[], object] = lambda: None


def measure(contest: Contest, calls: int, kills: int) -> dict[str, object]:
    """Everything a contestant is asked for, as plain data; times in seconds."""
    mine: list[float] = []
    pipe: list[float] = []
    a_round = max(1, calls // ROUNDS)
    contest.calls(max(10, a_round))  # connects, and warms up
    contest.between()
    with pipe_echo(PAYLOAD) as echo:
        for _ in range(ROUNDS):
            time_each(echo, max(1, a_round // 10))
            pipe += time_each(echo, a_round)
            contest.calls(max(1, a_round // 10))
            mine += contest.calls(a_round)
            contest.between()
    taken, raw = Samples(tuple(mine)), Samples(tuple(pipe))
    rate = None
    if contest.pipelined is not None:
        seconds: list[float] = []
        for _ in range(PIPELINED_ROUNDS):
            seconds.append(contest.pipelined(calls))
            contest.between()
        rate = calls / min(seconds)
    killed = [contest.kill() for _ in range(kills)] if contest.kill is not None else []
    return {
        "version": contest.version,
        "median": taken.median,
        "p99": taken.p99,
        "pipe": raw.median,
        "rate": rate,
        "recovery": Samples(tuple(killed)).median if killed else None,
    }


def main() -> None:
    """Measure the contestant named and write the result."""
    parser = argparse.ArgumentParser(prog="benchmarks.peers.contest")
    parser.add_argument("name", choices=CONTESTANTS)
    parser.add_argument("out", type=Path)
    parser.add_argument("--calls", type=int, default=2_000)
    parser.add_argument("--kills", type=int, default=3)
    arguments = parser.parse_args()
    module = importlib.import_module(f"benchmarks.peers.{arguments.name}_peer")
    enter: Callable[[], AbstractContextManager[Contest]] = module.contest
    with enter() as contest:
        result = measure(contest, arguments.calls, arguments.kills)
        arguments.out.write_text(json.dumps(result))


if __name__ == "__main__":
    main()
