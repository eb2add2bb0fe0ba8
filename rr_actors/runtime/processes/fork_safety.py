"""Fork safety: a forked process inherits its parent's running systems, and leaves them to the parent.

It shares the sockets and the epoll of a loop with the parent: closing or freeing them in the child disturbs the parent.
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
    """Register a running object that forked children shall leave to this process.

    Args:
        leave: called with the object in the child, where its result is never freed.
    """
    _running[running] = leave


def discard(running: object) -> None:
    """Forget an object that has ended."""
    _running.pop(running, None)


def _leave_all() -> None:
    _left.extend([leave(running) for running, leave in list(_running.items())])
    _running.clear()


os.register_at_fork(after_in_child=_leave_all)
