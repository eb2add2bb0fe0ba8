"""`python -m rr_actors.tools.web.lab PROGRAM FOLDER STATE_DIR LEVERS`: run one experiment, while the lab lives.

PROGRAM is a Python file, which can import what is in FOLDER. LEVERS is a JSON object: arguments of its main().
"""

from __future__ import annotations

import importlib
import io
import json
import logging
import os
import signal
import sys
import threading
from pathlib import Path
from typing import TextIO

from rr_actors.runtime.processes import lifeline

LIMIT_S = 90
"""The longest time of an experiment: then its process ends, with all processes that it has started."""


class WholeLines(io.TextIOBase):
    """Writes whole lines. print() writes a line and then its end, and another thread may come between."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._begun = threading.local()

    def write(self, text: str) -> int:
        """Write the lines that `text` completes; keep the rest for this thread's next text."""
        whole, end, self._begun.text = (getattr(self._begun, "text", "") + text).rpartition("\n")
        self._out.write(whole + end)
        return len(text)

    def flush(self) -> None:
        """Write what this thread has begun, too."""
        self._out.write(getattr(self._begun, "text", ""))
        self._begun.text = ""
        self._out.flush()

    def fileno(self) -> int:
        """Return the descriptor, which a program that is started may write to."""
        return self._out.fileno()


def main() -> None:
    """Run the experiment that the arguments name. It ends when the process that holds its standard input ends."""
    program, folder, state_dir, levers = sys.argv[1:]
    lifeline.hold(sys.stdin.fileno(), os.getppid())
    logging.getLogger("rr_actors").addHandler(logging.NullHandler())  # the picture shows the events
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(LIMIT_S)
    sys.stdout = WholeLines(sys.stdout)
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
