"""python -m support_stream_soak: streams with checksums, while their publisher and their readers are killed.

By default a million frames of all sizes; with --steady SECONDS thirty pictures a second, and the memory, descriptors
and mappings of all processes. `make streams` runs it.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import rr_actors as rr
from support import kill, pid_of
from support_stream_traffic import CHILDREN, Traffic, limits, tree, wait_for_more, watching


class Figures(NamedTuple):
    """What the processes of a system have, all together."""

    mib: float
    descriptors: int
    mappings: int

    @classmethod
    def of(cls, pids: Iterable[int]) -> Figures:
        """Measure these processes. What they share counts once."""
        mib, descriptors, mappings = 0.0, 0, 0
        for pid in pids:
            place = Path(f"/proc/{pid}")
            pss = next(line for line in (place / "smaps_rollup").read_text().splitlines() if line.startswith("Pss:"))
            mib += int(pss.split()[1]) / 1024
            descriptors += len(os.listdir(place / "fd"))
            mappings += len((place / "maps").read_text().splitlines())
        return cls(mib, descriptors, mappings)


def _traffic(told: Path, system: rr.System, frames: int, seed: int) -> None:
    """Kill one process after the other until the readers have had so many frames."""
    traffic, chance = Traffic(told), random.Random(seed)
    began = time.monotonic()
    kills = 0
    while (count := traffic.frames()) < frames:
        wait_for_more(traffic, lambda: chance.randrange(1, 1000))
        kill(system, chance.choice(CHILDREN))
        kills += 1
        if kills % 50 == 0:
            _say(f"{time.monotonic() - began:5.0f} s: {count} frames, {kills} kills, none wrong")
    wait_for_more(traffic, lambda: 1)
    _say(f"{time.monotonic() - began:5.0f} s: {traffic.frames()} frames, {kills} kills, none wrong")


def _steady(told: Path, system: rr.System, seconds: float, every_s: float, seed: int) -> None:
    """Kill one process in each `every_s`, and measure all of them just before."""
    traffic, chance = Traffic(told), random.Random(seed)
    wait_for_more(traffic, lambda: 10)
    samples: list[Figures] = []
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        threading.Event().wait(every_s)
        wait_for_more(traffic, lambda: 1)
        samples.append(Figures.of([os.getpid(), *(pid_of(system, id) for id in CHILDREN)]))
        _say(f"{time.monotonic() - began:5.0f} s: {traffic.frames()} frames, none wrong; {_text(samples[-1:])}")
        kill(system, chance.choice(CHILDREN))
    third = len(samples) // 3
    _say(f"{len(samples)} kills; the first third, in the middle: {_text(samples[:third])}")
    _say(f"{len(samples)} kills; the last third, in the middle:  {_text(samples[-third:])}")


def _text(samples: list[Figures]) -> str:
    mib, descriptors, mappings = (statistics.median(column) for column in zip(*samples, strict=True))
    return f"{mib:.1f} MiB, {descriptors:g} descriptors, {mappings:g} mappings"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Run with this process's arguments; raise AssertionError at the first wrong frame."""
    parser = argparse.ArgumentParser(prog="python -m support_stream_soak", description="Streams with checksums.")
    parser.add_argument(
        "--frames", type=int, default=1_000_000, help="until the readers have had so many (default: 10^6)"
    )
    parser.add_argument("--steady", type=float, metavar="SECONDS", help="pictures, and the figures of all processes")
    parser.add_argument(
        "--every", type=float, default=10.0, help="of --steady: seconds between two kills (default: 10)"
    )
    parser.add_argument("--seed", type=int, default=11, help="of who is killed, and when")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rr-traffic-") as place:
        told = Path(place) / "told"
        told.mkdir()
        pictures_hz = 15.0 if options.steady else 0.0  # each of two threads
        with rr.System(tree(told, pictures_hz), config=limits(pictures_hz), state_dir=Path(place) / "state") as system:
            queries = watching(system)
            if options.steady:
                _steady(told, system, options.steady, options.every, options.seed)
            else:
                _traffic(told, system, options.frames, options.seed)
            for query in queries:
                query.unload()


if __name__ == "__main__":
    main()
