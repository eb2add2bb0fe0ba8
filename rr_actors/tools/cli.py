"""The command `rr-actors`. It prints an error as one line on standard error, without a traceback.

Exit codes: 0 success; 1 the answer is no (of `check` or `chaos`, or a tree of `run` that gave up); 2 the call was
wrong, or names something that does not exist; 3 no running system was reached; 4 the system tried, and failed.
"""

from __future__ import annotations

import os
import sys
from typing import NoReturn

from rr_actors.base.checks import needing
from rr_actors.base.errors import CatalogError, NotRunning, RrError, UsageError
from rr_actors.tools.log_lines import printable

_INTERRUPTED = 130  # as a shell has it


def main() -> None:
    """Run the command line with the arguments of this process, and exit."""
    if sys.stdout is None:  # pyright: ignore[reportUnnecessaryComparison] - Python sets None if it was closed
        _leave("rr-actors: expected a standard output, got a closed one")
    try:
        with needing("the command line", "cli"):  # import rr_actors.tools.cli works without it
            from rr_actors.tools.verbs.verb_group import app
        app(standalone_mode=True)
    except RrError as error:
        _leave(f"rr-actors: {error}", _code(error))
    except KeyboardInterrupt:  # while the modules of the commands are imported
        sys.exit(_INTERRUPTED)
    except SystemExit as end:
        if not isinstance(end.__context__, BrokenPipeError):  # of which typer makes exit code 1
            raise
        _close_output()
    except BrokenPipeError:
        _close_output()
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _leave(f"rr-actors: {where}{error.strerror or error}")


def _close_output() -> NoReturn:
    """End with exit code 0, as the output's reader has closed it; else Python would raise again when it flushes."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(0)


def _code(error: RrError) -> int:
    if isinstance(error, NotRunning):
        return 3
    return 2 if isinstance(error, UsageError | CatalogError) else 4


def _leave(message: str, code: int = 2) -> NoReturn:
    sys.stderr.write(printable(message.replace("\n", " ")) + "\n")
    sys.exit(code)
