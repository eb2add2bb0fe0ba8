"""`python -m rr_actors.tools.experiments PROGRAM STATE_DIR LEVERS`: run one experiment, while the lab lives.

PROGRAM is a module below this package, or a file that ends in .py. LEVERS is a JSON object: arguments of its main().
"""

from __future__ import annotations

import importlib
import json
import logging
import os
import signal
import sys
from pathlib import Path

from rr_actors.runtime.processes import lifeline

LIMIT_S = 90
"""The longest time of an experiment: then its process ends, with all processes that it has started."""


def main() -> None:
    """Run the experiment that the arguments name. It ends when the process that holds its standard input ends."""
    program, state_dir, levers = sys.argv[1:]
    lifeline.hold(sys.stdin.fileno(), os.getppid())
    logging.getLogger("rr_actors").addHandler(logging.NullHandler())  # the picture shows the events
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(LIMIT_S)
    try:
        importlib.import_module(_module(program)).main(state_dir, **json.loads(levers))
    except KeyboardInterrupt:
        sys.exit(130)


def _module(program: str) -> str:
    """Return the name by which this process, and the children of its system, import a program."""
    if not program.endswith(".py"):
        return f"{__package__}.{program}"
    sys.path.insert(0, str(Path(program).parent))
    return Path(program).stem


def _stop(_number: int, _frame: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _stop)
    main()
