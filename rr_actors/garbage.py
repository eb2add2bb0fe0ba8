"""The garbage collector, left alone while a great many objects are made that all stay."""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Generator

_lock = threading.Lock()
_asleep = 0
_was_on = False


@contextlib.contextmanager
def left_alone() -> Generator[None]:
    """Collect nothing in this process until the end of the block, or of the last of those that overlap."""
    global _asleep, _was_on
    with _lock:
        if _asleep == 0:
            _was_on = gc.isenabled()
            gc.disable()
        _asleep += 1
    try:
        yield
    finally:
        with _lock:
            _asleep -= 1
            if _asleep == 0 and _was_on:
                gc.enable()
