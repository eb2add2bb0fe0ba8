"""The mission: a robot drives along a corridor while a lidar is disconnected, and programs and managers are killed.

    python examples/mission.py                  three runs: without faults, with faults, with faults and no recovery
    python examples/mission.py --speed 4        the robot, and its world, four times as fast
    python examples/mission.py --no-faults      the first run alone
    python examples/mission.py --no-recovery    the last run alone

It ends with a table beside the figures of the thesis, and writes path.png, distance.png and a timeline of each run to
the output directory.
The graph of its actions is mission/mission.json, and what they do is in mission/action.py; the programs of the robot
are beside that.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import signal
import sys
import tempfile
import uuid
from pathlib import Path

try:
    import matplotlib as _matplotlib  # noqa: F401
    from rich.console import Console
except ImportError as missing:
    sys.exit(f"The mission needs {missing.name}: pip install '.[demo]' in the checkout, or run it with make demo.")

from mission.action import Plan, run
from mission.figures import draw
from mission.record import Record
from mission.table import make_table
from mission.view import LiveView, PlainView

import rr_actors as rr
from rr_actors.managers.process_marks import find_processes

FAULTS_AT = (0.13, 0.28, 0.43, 0.57, 0.72, 0.86)  # of the way
MARK = "RR_MISSION"  # in the environment of every process of the mission, so that those left over can be counted


def main() -> int:
    options = _options()
    console = Console(width=None if sys.stdout.isatty() else 110)
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        _log_to(options.output / "mission.log")
    except OSError as error:
        sys.exit(f"The mission cannot write to {options.output}: {error.strerror}: choose another --output.")
    _end_in_order()
    os.environ[MARK] = uuid.uuid4().hex
    try:
        records = [_run(plan, console) for plan in plans(options)]
    except rr.RrError as error:
        console.print(f"The mission failed: {error}", markup=False)
        return 1
    except KeyboardInterrupt:
        console.print("Interrupted; everything is unloaded and stopped.")
        return 130
    console.print(make_table(records, options.speed))
    for figure in draw(records, options.output):
        console.print(f"wrote {figure}", highlight=False, soft_wrap=True)
    return 0


def plans(options: argparse.Namespace) -> list[Plan]:
    """The runs asked for. The seed moves the faults a little, and is the lidars' noise."""
    chance = random.Random(options.seed)
    faults = tuple(share + chance.uniform(-0.03, 0.03) for share in FAULTS_AT)
    common = {"speed": options.speed, "seed": options.seed}
    if options.no_faults:
        return [Plan("without faults", recovery=not options.no_recovery, **common)]
    without_recovery = Plan("without recovery", faults, recovery=False, **common)
    if options.no_recovery:
        return [without_recovery]
    return [Plan("without faults", **common), Plan("with faults", faults, **common), without_recovery]


def _run(plan: Plan, console: Console) -> Record:
    """One run, in a directory of its own that is gone afterwards."""
    console.rule(plan.title, align="left")
    with tempfile.TemporaryDirectory(prefix="mission-") as directory:
        with LiveView(console) if console.is_terminal else PlainView(console) as view:
            record = run(plan, Path(directory), view)
        record.processes_left = len(find_processes(MARK, os.environ[MARK]))
    console.print(f"{record.title}: {record.outcome} after {record.time_s:.1f} s", highlight=False)
    return record


def _end_in_order() -> None:
    """Have SIGTERM and the end of the terminal leave every `with` block: programs outlive a system that was killed."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:  # else somebody wants it ignored, as nohup does
            signal.signal(number, lambda number, _: sys.exit(128 + number))


def _log_to(path: Path) -> None:
    """Have this process, and all that it starts, log into a file: the console is for the story."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
    os.dup2(descriptor, sys.stderr.fileno())
    os.close(descriptor)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--speed", type=_speed, default=1.0, help="how much faster than real, 0.25 to 8 (default 1)")
    parser.add_argument("--seed", type=int, default=1, help="of the noise, and of where the faults strike")
    parser.add_argument("--no-faults", action="store_true", help="the run without faults alone")
    parser.add_argument("--no-recovery", action="store_true", help="the run without recovery alone")
    parser.add_argument("--output", type=Path, default=Path("out"), help="where the figures go (default: out)")
    return parser.parse_args()


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.25 <= speed <= 8.0:
        raise argparse.ArgumentTypeError(f"expected a number from 0.25 to 8, got {text!r}")
    return speed


if __name__ == "__main__":
    sys.exit(main())
