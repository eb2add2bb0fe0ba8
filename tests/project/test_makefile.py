"""The Makefile: what it says while it sets up the virtual environment."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from support import REPOSITORY


def test_who_waits_for_the_virtual_environment_is_told_so_and_only_then(tmp_path: Path) -> None:
    venv = tmp_path / "venv"
    installed = tmp_path / "installed"
    python = venv / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\necho the install began\necho "$@" >> {installed}\n')
    python.chmod(0o755)

    outside = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}

    def make() -> list[str]:
        command = ["make", "--no-print-directory", f"PYTHON={sys.executable}", f"VENV={venv}", f"{venv}/.installed"]
        done = subprocess.run(
            command, cwd=REPOSITORY, env={**outside, "LC_ALL": "C"}, capture_output=True, text=True, check=True
        )
        assert done.stderr == ""
        return done.stdout.splitlines()

    said, then = make()
    assert said.startswith(f"Setting up {venv} ")
    assert "takes a minute or so" in said
    assert then == "the install began"
    assert installed.read_text().startswith("-m pip install ")
    assert make() == [f"make: '{venv}/.installed' is up to date."]
