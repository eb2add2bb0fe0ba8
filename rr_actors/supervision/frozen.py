"""Frozen programs (PyInstaller, cx_Freeze, Nuitka): how one of them becomes a fork server and not the user's program.

There is no interpreter to start, only the program itself. It is started with an argument of its own, and runs to its
first `import rr_actors`. That import fails, which unwinds all imports that are in progress, so that no lock of them is
held; then the fork server's main program runs in the place of the report of that error.
"""

from __future__ import annotations

import os
import sys
import threading
from types import TracebackType
from typing import NoReturn


class _ForkServerError(BaseException):
    """Ends the program, also where it catches every Exception."""


def become_fork_server() -> NoReturn:
    """Unwind the program, and be a fork server at its end. Called at the first import of the package."""
    if threading.current_thread() is not threading.main_thread():
        sys.stderr.write("a frozen program must import rr_actors in its main thread, before it does anything else\n")
        sys.stderr.flush()
        os._exit(1)
    sys.excepthook = _serve
    raise _ForkServerError


def _serve(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    sys.excepthook = sys.__excepthook__
    if kind is not _ForkServerError:
        sys.excepthook(kind, error, trace)
        return
    call = sys.argv[2]
    del sys.argv[1:]
    for name in [name for name in sys.modules if name.partition(".")[0] == "rr_actors"]:
        del sys.modules[name]
    # What is imported by name later stands here, so that freezers find it.
    from rr_actors.runtime.processes import child_bootstrap, terminal_debugger
    from rr_actors.supervision import child_main

    exec(call, {"frozen": (child_bootstrap, terminal_debugger, child_main)})
