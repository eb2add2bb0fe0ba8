"""Limits of this process's control groups, of version 2 and 1, and of the groups above."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path


def group_limit(*names: str) -> int | None:
    """Return the least limit that a file of one of these names has in this process's groups; None: there is none."""
    found = (_read(folder / name).strip() for folder in _groups() for name in names)
    return min((int(text) for text in found if text.isdigit()), default=None)


def memory_bytes() -> int:
    """Return how much memory this process may have: the machine's, or that of its control group if it is less."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = group_limit("memory.max", "memory.limit_in_bytes")
    return machine if limit is None else min(machine, limit)


def _groups() -> Iterator[Path]:
    for line in _read(Path("/proc/self/cgroup")).splitlines():
        _, controllers, path = line.split(":", 2)
        top = Path("/sys/fs/cgroup", controllers)
        below = top / path.lstrip("/")
        yield from (folder for folder in (below, *below.parents) if folder.is_relative_to(top))


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
