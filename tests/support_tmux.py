"""A real terminal for tests: tmux, without a user's settings."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from support import TEST_PATHS

Tmux = Callable[..., str]
"""Runs a command of tmux, such as ("send-keys", "j"), and returns what it prints."""

needs_tmux = pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux: apt-get install tmux")


@contextmanager
def terminal(folder: Path, *command: str, columns: int, lines: int, then: str = "") -> Iterator[Tmux]:
    """Run a verb of rr-actors in a terminal of this size. At its end, show its exit code, then what `then` prints."""

    def tmux(*arguments: str) -> str:
        words = ["tmux", "-S", str(folder / "tmux"), "-f", "/dev/null", *arguments]
        environment = os.environ | {"PYTHONPATH": TEST_PATHS, "LC_ALL": "C.UTF-8"}
        return subprocess.run(words, capture_output=True, text=True, check=True, env=environment).stdout

    verb = shlex.join([sys.executable, "-m", "rr_actors", *command])
    size = ("-x", str(columns), "-y", str(lines))
    tmux("new-session", "-d", *size, f"{verb}; echo exit code $?; {then}read line")
    try:
        yield tmux
    finally:
        tmux("kill-server")
        (folder / "tmux").unlink(missing_ok=True)
