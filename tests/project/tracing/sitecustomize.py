"""Note which functions of the package each thread of this process enters, from the interpreter's start on.

Python imports a module of this name before any other. A fork server has it, too, and its children inherit the profile
function: so a child's event loop, which starts before any code of a test runs there, is watched like all other threads.
All processes share one file of two bytes: the first says whether calls are noted now, the second is a test's own.
"""

from __future__ import annotations

import mmap
import os
import sys
import threading
from pathlib import Path
from types import FrameType

_DIRECTORY = "/rr_actors/"

entered: set[tuple[str, str]] = set()
"""The files that were entered, each with the file from which it was called."""

with Path(os.environ["RR_TRACING"]).open("r+b") as _file:
    shared = mmap.mmap(_file.fileno(), 2)
    """Two bytes that all processes see."""


def _note(frame: FrameType, event: str, _arg: object) -> None:
    if shared[0] and event == "call" and frame.f_code.co_name != "<module>":
        file = frame.f_code.co_filename
        if _DIRECTORY in file:
            caller = frame.f_back
            entered.add((file, "" if caller is None else caller.f_code.co_filename))


sys.setprofile(_note)
threading.setprofile(_note)
