"""Run: start a plant, harm it or only watch it, and report."""

from __future__ import annotations

import logging
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from traceback import format_exception

from chaos.callback_log import Line, read_journal
from chaos.monkey import Monkey
from chaos.report import Report, Tally
from chaos.soak import ENOUGH_SAMPLES, Churn, Soak
from chaos.victim_managers import CREW, SUCCEEDED, UNEXPECTED, log_to
from chaos.victim_system import Plant
from chaos.watchdog import Standstill, Watch
from rr_actors.base.errors import UsageError
from rr_actors.tools.inspection import read_state

_SHOW_S = 1.0
_SAMPLES = 200
_SAMPLE_S = 5.0  # at most, between two
_CHURN_LOOK_S = 0.2
STALLED_S = 60.0
_STALLED_DEEDS = 50  # a third of the deeds kill nothing


@dataclass(frozen=True)
class Options:
    """The options of a run.

    Attributes:
        kills: end after this number of SIGKILLs.
        seconds: end after this number of seconds, if that is sooner.
        seed: the seed of the faults; by default a new one.
        state_dir: must be empty or missing; it is kept. None: a temporary directory.
        soak_s: for this number of seconds, and until there are samples enough, measure growth instead of harming.
        churn_s: in a soak, the mean seconds between two managers that are killed, restarted, or added and removed.
        pace_s: mean seconds between two deeds of the monkey.
        patience_s: seconds that one deed or one check may take; after that the run stands still.

    Raises:
        UsageError: a value is out of range, or the directory is not empty.
    """

    kills: int = 100
    seconds: float | None = None
    seed: int = field(default_factory=lambda: random.SystemRandom().randrange(1_000_000))
    state_dir: Path | None = None
    soak_s: float | None = None
    churn_s: float | None = None
    pace_s: float = 0.15
    patience_s: float = 180.0

    def __post_init__(self) -> None:
        for name in ("kills", "seconds", "soak_s", "churn_s", "pace_s", "patience_s"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise UsageError(f"chaos: {name.removesuffix('_s')}: expected a number above 0, got {value}")
        if self.churn_s is not None and self.soak_s is None:
            raise UsageError("chaos: churn: expected a soak with it, got none")
        place = self.state_dir
        if place is not None and place.is_dir() and any(place.iterdir()):
            raise UsageError(f"chaos: {place}: expected an empty directory or none, got one that holds something")


def run(options: Options, show: Callable[[str], None] = lambda line: None) -> Report:
    """Run chaos or a soak, and return the report. `show` is called every second with a line for people.

    If the system stands still, its processes are killed, and threads of this process may be left waiting for it.
    """
    tally = Tally()
    watch = Watch(options.patience_s)
    report = Report(options.seed)
    plant = Plant(options.state_dir, options.seed, tally)
    report.state_dir = str(plant.state_dir)
    logger = logging.getLogger("rr_actors")
    before = list(logger.handlers), logger.propagate, logging.raiseExceptions
    log_to(plant.journal_dir)
    show(f"seed {options.seed}, state in {plant.state_dir}")

    def work() -> None:
        watch.phase("starting")
        with plant:
            if options.soak_s is not None:
                churn = Churn(plant, tally, options.seed, options.churn_s) if options.churn_s is not None else None
                _soak(plant, options.soak_s, churn, report, tally, watch, show)
            else:
                _harm(plant, options, tally, watch, show)
            checked = plant.check(watch, show)
            watch.phase("stopping")
        watch.phase("summing up")
        _sum_up(plant, report, tally)
        report.verdict = checked

    discard = False
    try:
        watch.run(work)
        discard = report.passed
    except KeyboardInterrupt:  # no result: there is nothing to look into
        discard = True
        raise
    except Exception as error:
        failed = "no verdict, as the run itself failed: "
        tally.violation(str(error) if isinstance(error, Standstill) else failed + "".join(format_exception(error)))
        plant.abandon()
        report.seconds, report.violations = time.monotonic() - tally.since, list(tally.violations)
        report.faults, report.operations, report.errors = map(dict, (tally.faults, tally.operations, tally.errors))
    finally:
        for handler in set(logger.handlers) - set(before[0]):
            logger.removeHandler(handler)
            handler.close()
        logger.propagate, logging.raiseExceptions = before[1:]
        if discard:
            plant.discard()  # last, when no handler writes a log there any more
    return report


def _harm(plant: Plant, options: Options, tally: Tally, watch: Watch, show: Callable[[str], None]) -> None:
    monkey = Monkey(plant, tally, options.seed, options.pace_s)
    started = shown = time.monotonic()
    last = (0, started)
    stalled_s = max(STALLED_S, _STALLED_DEEDS * options.pace_s)
    try:
        while tally.kills < options.kills and not tally.violations:
            now = time.monotonic()
            if options.seconds is not None and now - started > options.seconds:
                break
            if tally.kills > last[0]:
                last = (tally.kills, now)
            elif now - last[1] > stalled_s:
                tally.violation(f"nothing to kill for {stalled_s:g} s: the system does not come back")
            monkey.pause(lambda: watch.phase("the moment before the next fault"))
            watch.phase(f"after {sum(tally.faults.values())} faults, the next")
            monkey.step()
            if now - shown >= _SHOW_S:
                shown = now
                show(tally.line())
    finally:
        monkey.recover()


def _soak(
    plant: Plant,
    seconds: float,
    churn: Churn | None,
    report: Report,
    tally: Tally,
    watch: Watch,
    show: Callable[[str], None],
) -> None:
    soak = Soak(plant)
    until = time.monotonic() + seconds
    pause_s = min(max(seconds / _SAMPLES, 0.2), _SAMPLE_S)
    sampled = shown = float("-inf")
    samples = 0
    while (now := time.monotonic()) < until or samples < ENOUGH_SAMPLES:
        watch.phase("a sample of the soak, or a manager that is replaced")
        if now - sampled >= pause_s:
            sampled = now
            samples += 1
            soak.sample()
        if now - shown >= _SHOW_S:
            shown = now
            show(tally.line())
        if churn is not None:
            churn.step()
        time.sleep(min(pause_s, _CHURN_LOOK_S))
    report.growth, grown = soak.growth()
    tally.violation(*grown)


def _sum_up(plant: Plant, report: Report, tally: Tally) -> None:
    lines = read_journal(plant.journal_dir)
    callbacks = Counter(line.what for line in lines if line.what in ("load", "unload"))
    state = read_state(plant.state_dir)
    damaged = [contents.damage for contents in state.values() if contents.damage]
    tally.violation(*damaged)
    report.seconds = time.monotonic() - tally.since
    report.faults = dict(tally.faults)
    report.operations = dict(tally.operations + _of_crews(lines, succeeded=True))
    report.errors = dict(tally.errors + _of_crews(lines, succeeded=False))
    report.longest_wait_s, report.longest_wait_for = tally.longest_wait_s, tally.longest_wait_for
    report.callbacks = dict(callbacks)
    report.repeated = sum(line.attempt > 1 for line in lines if line.what in callbacks)
    report.catalogs, report.catalogs_damaged = len(state), len(damaged)
    report.violations = list(tally.violations)
    report.violations += [f"{line.registrar}: {line.subject}" for line in lines if line.what == UNEXPECTED]


def _of_crews(lines: list[Line], *, succeeded: bool) -> Counter[str]:
    """Count the operations of consumers in processes of their own, from their journal."""
    of = [line for line in lines if line.what.startswith(CREW) and (line.subject == SUCCEEDED) is succeeded]
    if succeeded:
        return Counter(f"{line.what.removeprefix(CREW)} by a crew" for line in of)
    return Counter(f"{line.what.removeprefix(CREW)} by a crew: {line.subject}" for line in of)
