"""Scarcity: whether an error means a want of something outside that may end again.

Descriptors, memory, processes, threads and room on disk can be wanting, and a catalog that another process holds.
"""

from __future__ import annotations

import errno
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


NO_THREAD = _WANTED[errno.EAGAIN]
"""The text for an error when no more threads can be started."""


def wanted_by(error: BaseException) -> str:
    """Name what was wanting, "EMFILE: ..."; "" if the error has another reason."""
    return next((wanted for cause in _causes(error) if (wanted := _wanted(cause))), "")


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
