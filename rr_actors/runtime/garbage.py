"""The garbage collector, left alone while a great many objects are made that all stay."""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Generator

_lock = threading.Lock()
_asleep = 0
_was_on = False
_shared = False
_frozen = False

_SELDOM = 16  # blocks in a row
_blocks = 0
_collections = 0


@contextlib.contextmanager
def left_alone() -> Generator[None]:
    """Collect nothing in this process until the end of the block, or of the last of those that overlap.

    What there is then counts as old, which is collected seldom, or is shared: else the next collection would go through
    all of it. Python looks at the old when much has become old since it last did, and does not know of what was made
    so here: after some blocks without that it is collected before the next, with what it keeps open.
    """
    global _asleep, _was_on
    with _lock:
        if _asleep == 0:
            _was_on = gc.isenabled()
            if _was_on:
                _look_at_the_old()
            gc.disable()
        _asleep += 1
    try:
        yield
    finally:
        with _lock:
            _asleep -= 1
            if _asleep == 0 and _was_on:
                _make_old()
                gc.enable()


def set_aside() -> None:
    """Let no collection touch what there is so far: modules, which stay until the process ends.

    A collection of this package's modules alone takes a tenth of a fork server's start.
    """
    gc.freeze()


def share() -> None:
    """Let processes that are forked from this one share the memory of what there is: no collection touches it."""
    global _shared
    gc.collect()
    gc.freeze()
    _shared = True


def _look_at_the_old() -> None:
    global _blocks, _collections
    _blocks += 1
    if (collections := gc.get_stats()[-1]["collections"]) != _collections:
        _blocks, _collections = 0, collections
    elif _blocks >= _SELDOM:
        gc.collect()


def _make_old() -> None:
    global _shared, _frozen
    if _shared:  # the first time in a child, which has only begun: nothing of its own is to be collected yet
        _shared = False
        gc.freeze()
        _frozen = True
    elif not _frozen and gc.get_freeze_count():  # what somebody has frozen is to stay so
        _frozen = True  # Python counts all of it each time: 10 ms for half a million objects
    elif not _frozen:
        gc.freeze()
        gc.unfreeze()
