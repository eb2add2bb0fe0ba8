"""A class of thirty students without rr_actors: one crash breaks the pool for all."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

GOOD = "result = sum(range(100))"
BAD = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"


def run(program: str) -> int:
    names: dict[str, Any] = {"robot": "a simulator for each: nobody shares it"}
    exec(program, names)
    return names["result"]


def main() -> None:
    with ProcessPoolExecutor(30) as desks:
        print("right:", list(desks.map(run, [GOOD] * 30)).count(4950))
        try:
            desks.submit(run, BAD).result()
        except BrokenProcessPool:
            print("student7 crashes")
        try:
            desks.submit(run, GOOD).result()
        except BrokenProcessPool:
            print("and nobody can go on: the pool is broken")


if __name__ == "__main__":
    main()
