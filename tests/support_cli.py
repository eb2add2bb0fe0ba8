"""The command line, run in this process: a process of its own for each command takes a third of a second."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from unittest import mock

from rr_actors.tools.cli import main


def run_cli(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `rr-actors` with these arguments; what it printed, and its exit code."""
    words = [str(argument) for argument in arguments]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["rr-actors", *words]),
        mock.patch.object(sys.modules["__main__"], "__package__", None),  # else its usage names `python -m pytest`
        mock.patch.dict(os.environ, environment),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())
