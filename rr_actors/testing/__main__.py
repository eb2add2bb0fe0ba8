"""`python -m rr_actors.testing`: the same as `rr-actors chaos`, without the libraries of the command line."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from rr_actors.base.errors import UsageError
from rr_actors.testing.run import Options, run

_WHAT = "Run a system of its own, kill and harm its processes at random, and check every promise in the end."


def main() -> int:
    """Run chaos with this process's arguments; return 1 if a promise was broken, or could not be checked."""
    parser = argparse.ArgumentParser(prog="python -m rr_actors.testing", description=_WHAT)
    parser.add_argument("--kills", type=int, default=Options.kills, help="end after so many SIGKILLs: %(default)s")
    parser.add_argument("--seconds", type=float, default=None, help="end after so many seconds, if that is sooner")
    parser.add_argument("--seed", type=int, default=None, help="of what happens when; by default a new one")
    parser.add_argument("--state-dir", type=Path, default=None, help="kept afterwards; by default a temporary one")
    parser.add_argument("--json", type=Path, default=None, help="write the report here, too")
    parser.add_argument("--soak", type=float, default=None, help="no harm: so many seconds of load, watched for growth")
    parser.add_argument("--churn", type=float, default=None, help="of a soak: mean seconds until a manager is replaced")
    parser.add_argument("--pace", type=float, default=Options.pace_s, help="mean seconds between faults: %(default)s")
    parser.add_argument(
        "--patience", type=float, default=Options.patience_s, help="seconds for one deed or one check: %(default)s"
    )
    given = parser.parse_args()
    try:
        options = Options.of(
            kills=given.kills,
            seconds=given.seconds,
            seed=given.seed,
            state_dir=given.state_dir,
            soak_s=given.soak,
            churn_s=given.churn,
            pace_s=given.pace,
            patience_s=given.patience,
        )
    except UsageError as error:
        parser.error(str(error))
    try:
        report = run(options, show=_show)
    except KeyboardInterrupt:
        _show("interrupted; everything is stopped")
        return 130
    sys.stdout.write(report.text() + "\n")
    if given.json is not None:
        given.json.write_text(report.json())
    return 0 if report.passed else 1


def _show(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # does not wait for threads that stand still
