"""Inherited: what a forked process has of its parent's running systems. It leaves them to the parent.

The sockets and the epoll of a loop are shared with the parent: to close or free them in the child is felt there.
"""

from __future__ import annotations

import os
import weakref
from typing import Protocol


class Running(Protocol):
    """Something of this process that a forked child must not go on with."""

    def leave_to_parent(self) -> object:
        """In the child: have nothing to do with it any more. What is returned is never freed there."""
        ...


_running: weakref.WeakSet[Running] = weakref.WeakSet()
_left: list[object] = []


def add(running: Running) -> None:
    """From now on a forked child leaves it to this process."""
    _running.add(running)


def discard(running: Running) -> None:
    """It has ended."""
    _running.discard(running)


def _leave_all() -> None:
    _left.extend([running.leave_to_parent() for running in list(_running)])
    _running.clear()


os.register_at_fork(after_in_child=_leave_all)
