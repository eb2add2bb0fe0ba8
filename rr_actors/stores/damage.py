"""Damage: what is stored is not what was written."""

from __future__ import annotations

import stat
from pathlib import Path


class Damage(Exception):
    """Something read is not what a catalog has there. The text goes on from "expected a catalog, got"."""


def check_can_be_read(path: Path) -> None:
    """Refuse what never ends, or waits for somebody who writes, when it is read.

    Raises:
        Damage: it is a pipe, a socket or a device.
        OSError: it is not there.
    """
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise Damage(f"{path.name}, which is no file but a pipe, a socket or a device")
