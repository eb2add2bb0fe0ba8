"""Scarcity: whether an error means a want of something outside that may end again; and limits of control groups.

Descriptors, memory, processes, threads and room on disk can be wanting, and a catalog that another process holds.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from typing import cast

from rr_actors.base.errors import CatalogLocked, DescribedError, RrError

_WANTED = {
    errno.EMFILE: "EMFILE: the process has as many descriptors open as it may (ulimit -n)",
    errno.ENFILE: "ENFILE: the machine has as many files open as it may (fs.file-max)",
    errno.ENOMEM: "ENOMEM: there is no memory left for it",
    errno.EAGAIN: "EAGAIN: no more processes or threads can be made (ulimit -u, or the control group's limit)",
    errno.ENOBUFS: "ENOBUFS: the kernel has no memory left for it",
    errno.ENOSPC: "ENOSPC: the disk is full, or has no inode left",
    errno.EDQUOT: "EDQUOT: the user's share of the disk is full",
}


_DRIVERS_RAISE = (errno.EAGAIN, errno.ENOMEM, errno.ENOBUFS)
"""What a driver raises of its device, too: another process has locked it, its request is too large, its bus is off."""

NO_THREAD = _WANTED[errno.EAGAIN]
"""The text for an error when no more threads can be started."""


def wanted_by(error: BaseException) -> str:
    """Name what was wanting, "EMFILE: ..."; "" if the error has another reason."""
    return next((wanted for cause in _causes(error) if (wanted := _wanted(cause))), "")


def wanted_by_callback(error: BaseException) -> str:
    """Name what was wanting as wanted_by() does, for the error of a user's callback, which may be about a device.

    Raises:
        Exception: what an attribute of a user's class raised.
    """
    causes = [one for one in _causes(error) if not (isinstance(one, OSError) and one.errno in _DRIVERS_RAISE)]
    wanted = next((wanted for cause in causes if (wanted := _wanted(cause))), "")
    return wanted if type(wanted) is str else ""


def _wanted(error: BaseException) -> str:
    if isinstance(error, OSError):
        return _WANTED.get(error.errno or 0, "")
    if isinstance(error, MemoryError):
        return _WANTED[errno.ENOMEM]
    if isinstance(error, RuntimeError) and "can't start new thread" in error.args:
        return _WANTED[errno.EAGAIN]
    if isinstance(error, CatalogLocked):
        return "LOCKED: another process has the catalog"
    if isinstance(error, RrError):  # it has come from another process, without its causes
        return error.details.get("wanted", "")
    return ""


def _causes(error: BaseException) -> Iterator[BaseException]:
    """Yield the error, its causes and contexts, and the errors of groups among them, each once."""
    seen: set[int] = set()
    rest: list[BaseException | None] = [error]
    while rest:
        found = rest.pop(0)
        if found is None or id(found) in seen:
            continue
        seen.add(id(found))
        if isinstance(found, DescribedError):
            rest.append(found.error)
            continue
        yield found
        rest += [found.__cause__, None if found.__suppress_context__ else found.__context__]
        if isinstance(found, BaseExceptionGroup):
            rest += cast("BaseExceptionGroup[BaseException]", found).exceptions


# -- limits of this process's control groups, of version 2 and 1, and of the groups above ------------------------------


def group_limit(*names: str) -> int | None:
    """Return the least limit that a file of one of these names has in this process's groups; None: there is none."""
    found = (_read(f"{folder}/{name}").strip() for folder in _groups() for name in names)
    return min((int(text) for text in found if text.isdigit()), default=None)


def memory_bytes() -> int:
    """Return how much memory this process may have: the machine's, or that of its control group if it is less."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = group_limit("memory.max", "memory.limit_in_bytes")
    return machine if limit is None else min(machine, limit)


def _groups() -> Iterator[str]:
    for line in _read("/proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        top, parts = f"/sys/fs/cgroup/{controllers}", [part for part in path.split("/") if part]
        for depth in range(len(parts), -1, -1):
            yield "/".join((top, *parts[:depth]))


def _read(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:  # noqa: PTH123 - a Path takes ten times as long, for 20 files
            return file.read()
    except (OSError, UnicodeDecodeError):
        return ""
