"""Scarcity: whether an error means that the machine has no more descriptors, memory, threads or room on disk."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from typing import cast

_WANTED = {
    errno.EMFILE: "EMFILE: the process has as many descriptors open as it may (ulimit -n)",
    errno.ENFILE: "ENFILE: the machine has as many files open as it may (fs.file-max)",
    errno.ENOMEM: "ENOMEM: there is no memory left for it",
    errno.EAGAIN: "EAGAIN: no more processes or threads can be made (ulimit -u, or the control group's limit)",
    errno.ENOSPC: "ENOSPC: the disk is full",
    errno.EDQUOT: "EDQUOT: the user's share of the disk is full",
}


NO_THREAD = _WANTED[errno.EAGAIN]
"""The text for an error when no more threads can be started."""


def wanted_by(error: BaseException) -> str:
    """Name the resource that the machine lacked, "EMFILE: ..."; "" if the error has another reason."""
    return next((wanted for cause in _causes(error) if (wanted := _wanted(cause))), "")


def _wanted(error: BaseException) -> str:
    if isinstance(error, OSError):
        return _WANTED.get(error.errno or 0, "")
    if isinstance(error, MemoryError):
        return _WANTED[errno.ENOMEM]
    if isinstance(error, RuntimeError) and "can't start new thread" in error.args:
        return _WANTED[errno.EAGAIN]
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
        yield found
        rest += [found.__cause__, None if found.__suppress_context__ else found.__context__]
        if isinstance(found, BaseExceptionGroup):
            rest += cast("BaseExceptionGroup[BaseException]", found).exceptions
