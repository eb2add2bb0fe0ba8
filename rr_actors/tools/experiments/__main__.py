"""`python -m rr_actors.tools.experiments NAME STATE_DIR`: run one experiment, while the lab lives."""

from __future__ import annotations

import importlib
import logging
import os
import signal
import sys

from rr_actors.runtime.processes import lifeline

LIMIT_S = 90
"""The longest time of an experiment: then its process ends, with all processes that it has started."""


def main() -> None:
    """Run the experiment that the arguments name. It ends when the process that holds its standard input ends."""
    name, state_dir = sys.argv[1:]
    lifeline.hold(sys.stdin.fileno(), os.getppid())
    logging.getLogger("rr_actors").addHandler(logging.NullHandler())  # the picture shows the events
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(LIMIT_S)
    try:
        importlib.import_module(f"rr_actors.tools.experiments.{name}").main(state_dir)
    except KeyboardInterrupt:
        sys.exit(130)


def _stop(_number: int, _frame: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _stop)
    main()
