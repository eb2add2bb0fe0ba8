"""The interpreter that the contestants run in: this one if all of them can be imported, else one made for them."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import venv
from pathlib import Path

_HERE = Path(__file__).parent
REQUIREMENTS = _HERE / "requirements.txt"
PLACE = _HERE.parent.parent / ".venv-peers"
_INSTALL_LIMIT_S = 900.0


def interpreter() -> str:
    """Return its path. The first time it installs what requirements.txt names, as far as that can be had."""
    if all(importlib.util.find_spec(module) for module in ("xoscar", "thespian", "ray")):
        return sys.executable
    python = PLACE / "bin" / "python"
    stamp = PLACE / ".installed"
    if stamp.exists() and stamp.stat().st_mtime >= REQUIREMENTS.stat().st_mtime:
        return str(python)
    print(f"installing {REQUIREMENTS.name} in {PLACE.name}", file=sys.stderr)
    if not python.exists():
        venv.create(PLACE, with_pip=True)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if _run([*pip, "--requirement", str(REQUIREMENTS)]):
        stamp.touch()
        return str(python)
    for line in REQUIREMENTS.read_text().splitlines():  # one that cannot be had does not keep the others out
        if line and not line.startswith("#") and not _run([*pip, line]):
            print(f"not installed: {line}", file=sys.stderr)
    return str(python)


def _run(command: list[str]) -> bool:
    try:
        return subprocess.run(command, check=False, timeout=_INSTALL_LIMIT_S).returncode == 0
    except subprocess.TimeoutExpired:
        return False
