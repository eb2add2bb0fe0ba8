"""`python -m rr_actors.tools.web.lab PROGRAM FOLDER STATE_DIR LEVERS`: run one experiment, while the lab lives.

PROGRAM is a Python file, which can import what is in FOLDER. LEVERS is a JSON object: arguments of its main().
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
    program, folder, state_dir, levers = sys.argv[1:]
    lifeline.hold(sys.stdin.fileno(), os.getppid())
    logging.getLogger("rr_actors").addHandler(logging.NullHandler())  # the picture shows the events
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(LIMIT_S)
    try:
        sys.path[:0] = dict.fromkeys((str(Path(program).parent), folder))  # the children of its system import it, too
        importlib.import_module(Path(program).stem).main(state_dir, **json.loads(levers))
    except KeyboardInterrupt:
        sys.exit(130)


def _stop(_number: int, _frame: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _stop)
    main()
