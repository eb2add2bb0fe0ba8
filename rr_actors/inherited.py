"""Inherited: what a forked process has of its parent's running systems. It leaves them to the parent.

The sockets and the epoll of a loop are shared with the parent: to close or free them in the child is felt there.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")

_running: weakref.WeakKeyDictionary[Any, Callable[[Any], object]] = weakref.WeakKeyDictionary()
_left: list[object] = []


def add(running: T, leave: Callable[[T], object]) -> None:
    """From now on a forked child leaves it to this process.

    Args:
        leave: called in the child, which then has nothing to do with it any more. What it returns is never freed there.
    """
    _running[running] = leave


def discard(running: object) -> None:
    """It has ended."""
    _running.pop(running, None)


def _leave_all() -> None:
    _left.extend([leave(running) for running, leave in list(_running.items())])
    _running.clear()


os.register_at_fork(after_in_child=_leave_all)
