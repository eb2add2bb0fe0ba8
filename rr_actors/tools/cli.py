"""The command `rr-actors`. What goes wrong is said in one line on the error output, with exit code 2: no tracebacks."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

from rr_actors.base.errors import RrError

_NEEDS = "rr-actors: the command line needs two libraries more. Install them with: pip install 'rr-actors[cli]'"


def main() -> None:
    """Run the command line with the arguments of this process, and exit."""
    try:
        from rr_actors.tools.cli_commands import app  # only here: import rr_actors.tools.cli works without the extra
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("rich", "typer"):
            raise
        _leave(_NEEDS)
    try:
        app(standalone_mode=True)
    except RrError as error:
        _leave(f"rr-actors: {error}")
    except BrokenPipeError:
        # Whoever read our output has enough of it. Python would complain again when it flushes at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _leave(f"rr-actors: {where}{error.strerror or error}")


def _leave(message: str) -> NoReturn:
    sys.stderr.write(message.replace("\n", " ") + "\n")
    sys.exit(2)
