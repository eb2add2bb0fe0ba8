"""python -m simulation: run simulated worlds, by fresh or given seeds, and report the first that breaks."""

from __future__ import annotations

import argparse
import random
import sys
import time

from simulation.process_faults import EXCLUSIVE_FIRST, HOSTS_FIRST
from simulation.runner import Outcome, report, run

_EVERY_S = 2.0


def main(arguments: list[str] | None = None) -> int:
    """Run as many worlds as asked; 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m simulation", description="Simulated worlds of registrars.")
    parser.add_argument("runs", nargs="?", type=int, help="how many worlds (default: as many as fit in --seconds)")
    parser.add_argument("--seed", type=int, help="of the first world (default: fresh, from 2**54 on)")
    parser.add_argument("--steps", type=int, default=400, help="steps of chance in each world (default: 400)")
    parser.add_argument("--seconds", type=float, default=60.0, help="without a number of runs: for how long")
    options = parser.parse_args(arguments)
    fresh = random.SystemRandom().randrange(EXCLUSIVE_FIRST, 2 * HOSTS_FIRST)
    first: int = fresh if options.seed is None else options.seed
    broken = _run(first, options.runs, options.steps, options.seconds)
    if broken is None:
        return 0
    sys.stdout.write(f"\nseed {broken.seed}: {broken.violation!r}\nlooking for the shortest history ...\n")
    sys.stdout.write(report(broken) + "\n")
    return 1


def _run(first: int, runs: int | None, steps: int, seconds: float) -> Outcome | None:
    sys.stdout.write(f"worlds from seed {first} on, {steps} steps of chance each, then rest and checks\n")
    began = shown = time.monotonic()
    total = done = 0
    while done < runs if runs is not None else time.monotonic() - began < seconds:
        outcome = run(first + done, steps)
        done += 1
        total += outcome.steps
        if outcome.violation is not None:
            return outcome
        now = time.monotonic()
        if now - shown > _EVERY_S:
            shown = now
            _show(done, total, now - began)
    _show(done, total, time.monotonic() - began)
    sys.stdout.write("\nno promise was broken\n")
    return None


def _show(done: int, total: int, took_s: float) -> None:
    rate = total / took_s * 60 if took_s else 0
    sys.stdout.write(f"\r{done} worlds, {total} steps, {rate / 1e6:.1f} M steps a minute   ")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
