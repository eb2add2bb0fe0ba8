"""`make chaos`: run a system of its own, harm it, and check it. `PYTHONPATH=tests python -m chaos` is the same."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

from chaos.run import Options, run
from rr_actors.base.errors import UsageError

_WHAT = "Run a system of its own, kill and harm its processes at random, and check every promise in the end."


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m chaos", description=_WHAT, argument_default=argparse.SUPPRESS)

    def option(name: str, kind: Callable[[str], object], what: str, field: str | None = None) -> None:
        parser.add_argument(f"--{name}", type=kind, dest=field or name, metavar=name.upper(), help=what)

    option("kills", int, f"end after this number of SIGKILLs: {Options.kills}")
    option("seconds", float, "end after this number of seconds, if that is sooner")
    option("seed", int, "the seed of the faults; by default a new one")
    option("state-dir", Path, "keep the state here; by default in a temporary directory", "state_dir")
    option("json", Path, "also write the report to this file")
    option("soak", float, "do no harm: watch this many seconds of load for growth", "soak_s")
    option("churn", float, "of a soak: the mean seconds between replaced managers", "churn_s")
    option("pace", float, f"the mean number of seconds between two faults: {Options.pace_s:g}", "pace_s")
    option("patience", float, f"seconds that one fault or one check may take: {Options.patience_s:g}", "patience_s")
    return parser


def main() -> int:
    """Run chaos with this process's arguments; return 1 if a promise was broken, or could not be checked."""
    parser = _parser()
    given = vars(parser.parse_args())
    report_file: Path | None = given.pop("json", None)
    try:
        options = Options(**given)
    except UsageError as error:
        parser.error(str(error))
    try:
        report = run(options, show=_show)
    except KeyboardInterrupt:
        _show("interrupted; everything is stopped")
        return 130
    sys.stdout.write(report.text() + "\n")
    if report_file is not None:
        report_file.write_text(report.json())
    return 0 if report.passed else 1


def _show(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # does not wait for threads that stand still
