"""The interpreter that the targets run in: one with atheris, in an environment of its own."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parent.parent
REQUIREMENTS = Path(__file__).parent / "requirements.txt"
PLACE = ROOT / f".venv-fuzz-{sys.version_info.major}.{sys.version_info.minor}"  # one for each Python
_INSTALL_LIMIT_S = 900.0


def interpreter() -> str:
    """Return its path. The first time it installs what requirements.txt names.

    Raises:
        SystemExit: that cannot be had here.
    """
    python = PLACE / "bin" / "python"
    stamp = PLACE / ".installed"
    if stamp.exists() and stamp.stat().st_mtime >= REQUIREMENTS.stat().st_mtime:
        return str(python)
    print(f"installing {REQUIREMENTS.name} in {PLACE.name}", file=sys.stderr)
    if not python.exists():
        venv.create(PLACE, with_pip=True)
    install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--requirement", REQUIREMENTS]
    try:
        code = subprocess.run(install, check=False, timeout=_INSTALL_LIMIT_S).returncode
    except subprocess.TimeoutExpired:
        code = -1
    if code != 0:
        raise SystemExit(f"{REQUIREMENTS.name} could not be installed: is there an atheris for this Python?")
    stamp.touch()
    return str(python)
